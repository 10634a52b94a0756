"""Thickness of a full sensor, 4096 × 4004 × 12: the walk of the paper, interpreted and compiled; the global fit."""

from __future__ import annotations

import os
import resource
import time

import numpy as np

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

from ._table import Row

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
NOISE = 0.007
LOOP_PIXELS = 3000
STEP_UM = 0.0025
WINDOW_STEPS = 60
HALF_ORDER_UM = 0.15


def full_sensor(model: FringeModel, truth: np.ndarray) -> FringeCube:
    """Flats of 20 000 electrons, relative to their mean."""
    rng = np.random.default_rng(5)
    table = model.table((float(truth.min()) - 0.01, float(truth.max()) + 0.01), WAVELENGTHS)
    image = np.empty((len(WAVELENGTHS), *truth.shape), np.float32)
    single = truth.astype(np.float32)
    for row in range(len(WAVELENGTHS)):
        table.frame(single, row, image[row])
        image[row] /= image[row].mean(dtype=np.float64)
        image[row] += NOISE * rng.standard_normal(truth.shape, dtype=np.float32)
    return FringeCube(
        image,
        np.full(image.shape, NOISE**2, np.float32),
        np.zeros(image.shape, np.int16),
        FlatExposures(WAVELENGTHS, np.array(2.0), np.array(183.15)),
        "relative",
    )


def published_loop(cube: FringeCube, model: FringeModel, first_um: float) -> float:
    """Seconds per pixel of the walk as an interpreted loop: window of one order, chi-square of each candidate."""
    low, high = model.setup.thickness_range_um
    count = int((high - low) / STEP_UM)
    response = model.response_on_grid(WAVELENGTHS, low, STEP_UM, count)
    templates = response / response.mean(axis=1, keepdims=True) - 1.0
    column = np.asarray(cube.image[:, :LOOP_PIXELS, cube.shape[2] // 2], dtype=float) - 1.0
    place = round((first_um - low) / STEP_UM)
    start = time.perf_counter()
    for pixel in range(column.shape[1]):
        window = slice(max(place - WINDOW_STEPS, 0), place + WINDOW_STEPS + 1)
        chi2 = ((column[:, pixel, None] - templates[:, window]) ** 2).sum(axis=0) / NOISE**2
        place = window.start + int(np.argmin(chi2))
    return (time.perf_counter() - start) / column.shape[1]


def run() -> list[Row]:
    model = FringeModel.from_setup("ts8_e2v")
    truth = e2v_321()
    cube = full_sensor(model, truth)
    pixels = float(truth.size)
    work = f"{truth.shape[1]} × {truth.shape[0]} × {len(WAVELENGTHS)}, noise {NOISE:g}"
    loop = published_loop(cube, model, float(truth[0, truth.shape[1] // 2]))
    rows = [Row(work, f"walk, interpreted loop ({LOOP_PIXELS} pixels)", loop * pixels, pixels)]
    for method in ("guo2022", "global"):
        fit_thickness(cut(cube), model, method)  # compiles
        start = time.perf_counter()
        fitted = fit_thickness(cube, model, method)
        seconds = time.perf_counter() - start
        good = fitted.mask == 0
        error = (fitted.value - truth)[good]
        note = (
            f"rms error {1e3 * error.std():.2f} nm, rms of stated σ "
            f"{1e3 * np.sqrt(np.mean(fitted.sigma[good].astype(float) ** 2)):.2f} nm, "
            f"off by half an order {np.mean(np.abs(error) > HALF_ORDER_UM):.1e}, masked {1.0 - good.mean():.1e}, "
            f"load {os.getloadavg()[0]:.1f}, "
            f"peak so far {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB with the cube"
        )
        rows.append(Row(work, method, seconds, pixels, loop, note))
    return rows


def cut(cube: FringeCube) -> FringeCube:
    """A corner of the cube."""
    part = (slice(None), slice(0, 128), slice(0, 128))
    return FringeCube(cube.image[part], cube.variance[part], cube.mask[part], cube.exposures, cube.unit)
