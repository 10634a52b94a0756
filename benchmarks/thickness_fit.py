"""Thickness of a full sensor, 4096 × 4004 × 12: the walk of the paper, interpreted and compiled; the global fit."""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import FlatTemplates, walk_fit
from lsst.fringe_sim.algorithms.thickness_fit.fit import amplitudes_from_cube
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube, ThicknessMap, mask_bits

from ._table import Row, memory_watch, timed

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
NOISE = 0.007
LOOP_PIXELS = 3000
RANGE_UM = (5.0, 30.0)
THICKNESSES = 30_000
"""The paper's table of candidates."""
WINDOW_UM = 0.2
"""Full width of the window of the published code; the text says one order, 0.3 um."""
HALF_ORDER_UM = 0.15
BAD_COLUMNS = slice(300, None, 512)
REPEAT = 3


def full_sensor(model: FringeModel, truth: np.ndarray) -> FringeCube:
    """Flats of 20 000 electrons, relative to their mean, with eight masked columns."""
    rng = np.random.default_rng(5)
    table = model.table((float(truth.min()) - 0.01, float(truth.max()) + 0.01), WAVELENGTHS)
    image = np.empty((len(WAVELENGTHS), *truth.shape), np.float32)
    single = truth.astype(np.float32)
    for row in range(len(WAVELENGTHS)):
        table.frame(single, row, image[row])
        image[row] /= image[row].mean(dtype=np.float64)
        image[row] += NOISE * rng.standard_normal(truth.shape, dtype=np.float32)
    mask = np.full(image.shape, 0, np.int16)
    mask[..., BAD_COLUMNS] = mask_bits("BAD")
    return FringeCube(
        image,
        np.full(image.shape, NOISE**2, np.float32),
        mask,
        FlatExposures(WAVELENGTHS, np.array(2.0), np.array(183.15)),
        "relative",
    )


def paper_templates(model: FringeModel) -> FlatTemplates:
    """Candidates of the paper: 30 000 thicknesses from 5 to 30 um."""
    step = (RANGE_UM[1] - RANGE_UM[0]) / THICKNESSES
    response = model.response_on_grid(WAVELENGTHS, RANGE_UM[0], step, THICKNESSES)
    return FlatTemplates(np.ascontiguousarray(response.T), RANGE_UM[0], step, WAVELENGTHS)


def published_loop(cube: FringeCube, templates: FlatTemplates, first_um: float) -> tuple[float, float]:
    """Wall and processor seconds per pixel of the walk as an interpreted loop over the candidates of a window."""
    amplitude = np.ascontiguousarray(templates.amplitude().T)
    half = round(0.5 * WINDOW_UM / templates.step_um)
    column = np.asarray(cube.image[:, :LOOP_PIXELS, cube.shape[2] // 2], dtype=float) - 1.0

    def walk() -> None:
        place = round((first_um - templates.start_um) / templates.step_um)
        for pixel in range(column.shape[1]):
            window = slice(max(place - half, 0), place + half + 1)
            chi2 = ((column[:, pixel, None] - amplitude[:, window]) ** 2).sum(axis=0) / NOISE**2
            place = window.start + int(np.argmin(chi2))

    _, wall, cpu = min((timed(walk) for _ in range(REPEAT)), key=lambda each: each[2])
    return wall / column.shape[1], cpu / column.shape[1]


def compiled_walk(cube: FringeCube, templates: FlatTemplates) -> tuple[float, float]:
    """Wall and processor seconds of one compiled walk over the sensor, the same candidates being asked."""

    def walk(part: FringeCube) -> None:
        start = (part.shape[1] // 2, part.shape[2] // 2)
        walk_fit(
            amplitudes_from_cube(part),
            templates,
            start_pixel=start,
            range_um=(6.0, 29.0),
            window_um=WINDOW_UM,
        )

    walk(cut(cube))  # compiles
    return timed(lambda: walk(cube))[1:]


def run() -> list[Row]:
    model = FringeModel.from_setup("ts8_e2v")
    truth = e2v_321().astype(np.float32)
    cube = full_sensor(model, truth)
    pixels = float(truth.size)
    work = f"{truth.shape[1]} × {truth.shape[0]} × {len(WAVELENGTHS)}, noise {NOISE:g}"
    templates = paper_templates(model)
    wall, loop = published_loop(cube, templates, float(truth[0, truth.shape[1] // 2]))
    rows = [
        Row(work, f"walk, interpreted loop ({LOOP_PIXELS} pixels)", wall * pixels, pixels, cpu=loop * pixels)
    ]
    wall, cpu = compiled_walk(cube, templates)
    rows.append(Row(work, "walk alone, compiled", wall, pixels, loop, cpu=cpu))
    compiled = cpu / pixels
    fitted, wall, cpu = _fit(cube, model, "guo2022", 1)
    note = "walks twice, asks every pixel how sure it is, and loses its way at masked columns; " + quality(
        fitted, truth
    )
    rows.append(Row(work, "`guo2022`", wall, pixels, loop, note, cpu))
    del fitted
    with memory_watch() as memory:
        fitted, wall, cpu = _fit(cube, model, "global", REPEAT)
    note = (
        f"{compiled * pixels / cpu:.1f}× the compiled walk alone; {quality(fitted, truth)}; "
        f"peak {memory[0]:.2f} GiB, of which the cube {size_gib(cube):.2f}; load {os.getloadavg()[0]:.1f}"
    )
    rows.append(Row(work, "`global`", wall, pixels, loop, note, cpu))
    del fitted
    lean = replace(
        cube,
        variance=np.broadcast_to(cube.variance[:, :1, :1].copy(), cube.shape),
        mask=np.broadcast_to(cube.mask[:1].copy(), cube.shape),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cube.fits"
        cube.write_fits(path)
        del cube
        rows.append(_lean(work + ", one variance and one mask", lean, model, loop))
        del lean
        mapped = FringeCube.read_fits(path, memmap=True)
        rows.append(_lean(work + ", cube mapped from its file", mapped, model, loop))
    return rows


def _lean(work: str, cube: FringeCube, model: FringeModel, loop: float) -> Row:
    """The global fit where the cube does not lie in memory three times over."""
    with memory_watch() as memory:
        _, wall, cpu = _fit(cube, model, "global", REPEAT)
    note = f"peak {memory[0]:.2f} GiB; load {os.getloadavg()[0]:.1f}"
    return Row(work, "`global`", wall, float(np.prod(cube.shape[1:])), loop, note, cpu)


def _fit(cube: FringeCube, model: FringeModel, method: str, repeat: int) -> tuple[ThicknessMap, float, float]:
    """Result, and least wall and processor time."""
    fit_thickness(cut(cube), model, method)  # compiles
    walls, cpus = [], []
    for _ in range(repeat):
        fitted = None  # the last result is not to lie beside the next
        fitted, wall, cpu = timed(lambda: fit_thickness(cube, model, method))
        walls.append(wall)
        cpus.append(cpu)
        time.sleep(0.1)
    assert fitted is not None
    return fitted, min(walls), min(cpus)


def quality(fitted: ThicknessMap, truth: np.ndarray) -> str:
    """Errors of the good pixels."""
    good = fitted.mask == 0
    error = (fitted.value - truth)[good]
    bound = float(np.sqrt(np.mean(fitted.sigma[good].astype(float) ** 2)))
    slipped = int(np.count_nonzero(np.abs(error) > HALF_ORDER_UM))
    rms = 1e3 * float(error.std(dtype=float))
    return f"rms error {rms:.2f} nm, bound {1e3 * bound:.2f} nm, {slipped} pixels off by half an order"


def size_gib(cube: FringeCube) -> float:
    """Memory of a cube."""
    return sum(part.nbytes for part in (cube.image, cube.variance, cube.mask)) / 2**30


def cut(cube: FringeCube) -> FringeCube:
    """A corner of the cube."""
    part = (slice(None), slice(0, 128), slice(0, 128))
    return FringeCube(cube.image[part], cube.variance[part], cube.mask[part], cube.exposures, cube.unit)
