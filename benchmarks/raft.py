"""Nine real sensors at full size: pixels off by more than half an order, of the global fit and of the paper's walk.

The maps are those of RTM-020 as published, with their jumps of whole orders taken out, spread over 4004 × 4096
pixels. Fringes are as weak as measured (0.15 of what the model shows), and the noise is that at which a pixel by
itself finds the wrong order once in ten times (0.002) or once in three (0.004). The walk is given the mean response
of the sensor, which it could not know.

A section in the middle of each sensor is fitted besides by default, where nobody tells the fit the contrast: flats of
20 000 electrons with 0.13, 0.3 and all of the contrast of the model.

The maps are no part of the package: `FRINGE_SIM_SHARED` names the folder that holds them.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.ndimage import median_filter

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import walk_fit
from lsst.fringe_sim.algorithms.thickness_fit.fit import amplitudes_from_cube, make_templates
from lsst.fringe_sim.mock.thickness import E2V_SHAPE, fit_to_sensor
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube, ThicknessMap

from ._table import Row, timed

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
CONTRAST = 0.15
NOISES = (0.002, 0.004)
SECTION = (1000, 1024)
SECTION_CONTRASTS = (0.13, 0.3, 1.0)
SECTION_NOISE = 0.007
ORDER_UM = 0.3
LOCAL_CELLS = 9
"""Cells of the published maps (16.5 pixels) over which a jump of one order cannot be real."""
LOCAL_ROUNDS = 5
WALK_STEPS = 3
"""Steps of the fine templates (1 nm) in one of the walk."""


def repaired(path: Path) -> np.ndarray:
    """Published map of a sensor without jumps of whole orders, in rows and in cells [um above its minimum]."""
    with fits.open(path) as hdus:
        fine = np.asarray(hdus["FINE"].data, dtype=float)
    jumps = ORDER_UM * np.round(np.nanmedian(np.diff(fine, axis=0), axis=1) / ORDER_UM)
    relief = fine - np.concatenate([[0.0], np.cumsum(jumps)])[:, None]
    relief = np.where(np.isfinite(relief), relief, np.nanmedian(relief))
    for _ in range(LOCAL_ROUNDS):
        relief -= ORDER_UM * np.round((relief - median_filter(relief, LOCAL_CELLS)) / ORDER_UM)
    return relief - relief.min()


def sensor_maps() -> dict[str, Path]:
    """Files of the nine maps by sensor, empty if there are none."""
    folder = Path(os.environ.get("FRINGE_SIM_SHARED", "../shared")) / "measured"
    return {path.name.split("_")[2]: path for path in sorted(folder.glob("RTM-020_S??_*_epoxy_map.fits"))}


def flats(truth: np.ndarray, model: FringeModel, noise: float, rng: np.random.Generator) -> FringeCube:
    """Relative flats of a map, one variance and no mask for all pixels."""
    table = model.table((float(truth.min()) - 0.01, float(truth.max()) + 0.01), WAVELENGTHS)
    image = np.empty((len(WAVELENGTHS), *truth.shape), np.float32)
    for row, plane in enumerate(image):
        table.frame(truth, row, plane)
        plane /= plane.mean(dtype=np.float64)
        plane += noise * rng.standard_normal(truth.shape, dtype=np.float32)
    return FringeCube(
        image,
        np.broadcast_to(np.float32(noise**2), image.shape),
        np.broadcast_to(np.int16(0), image.shape),
        FlatExposures(WAVELENGTHS, np.array(2.0), np.array(183.15)),
        "relative",
    )


def drawn_layer(sensor: str, path: Path) -> tuple[np.ndarray, np.random.Generator]:
    """Thickness of a sensor whose absolute thickness is drawn [um], and the generator that goes on."""
    rng = np.random.default_rng(int(sensor[4:]))
    relief = fit_to_sensor(repaired(path), E2V_SHAPE)
    return (relief - relief.min() + rng.uniform(8.0, 14.0)).astype(np.float32), rng


def judged(fitted: ThicknessMap, truth: np.ndarray) -> str:
    """Shares of pixels that are off and masked, and pulls."""
    good = fitted.mask == 0
    error = (fitted.value - truth)[good]
    right = np.abs(error) < 0.5 * ORDER_UM
    pull = (error / fitted.sigma[good])[right]
    if not error.size:
        return f"all masked, margin of the order {fitted.metadata['ORDMARG']:.3g}"
    return (
        f"off by half an order {1.0 - right.mean():.1e}; masked {1.0 - good.mean():.1e}; "
        f"pulls {pull.mean(dtype=float):+.3f} ± {pull.std(dtype=float):.3f}"
    )


def section_rows(sensor: str, path: Path) -> list[Row]:
    """The default fit of the middle of one sensor at several contrasts that it is not told."""
    whole, rng = drawn_layer(sensor, path)
    corner = [(length - part) // 2 for length, part in zip(whole.shape, SECTION, strict=True)]
    truth = np.ascontiguousarray(whole[tuple(slice(c, c + n) for c, n in zip(corner, SECTION, strict=True))])
    model, rows = FringeModel.from_setup("ts8_e2v"), []
    for contrast in SECTION_CONTRASTS:
        shown = FringeModel.from_setup("ts8_e2v", {"contrast_loss.factor": contrast})
        cube = flats(truth, shown, SECTION_NOISE, rng)
        fitted, wall, cpu = timed(partial(fit_thickness, cube, model))
        work = f"{sensor}, middle, {truth.min():.1f} to {truth.max():.1f} µm, contrast {contrast:g}"
        note = f"{judged(fitted, truth)}; contrast found {fitted.metadata['CONTRAST']:.4f}"
        rows.append(Row(work, "`global`", wall, float(truth.size), None, note, cpu))
    return rows


def sensor_rows(sensor: str, path: Path, model: FringeModel, noise: float) -> list[Row]:
    """Both fits of one sensor at one noise."""
    truth, rng = drawn_layer(sensor, path)
    cube = flats(truth, model, noise, rng)
    fitted, wall, cpu = timed(lambda: fit_thickness(cube, model))
    work = f"{sensor}, {truth.min():.1f} to {truth.max():.1f} µm, noise {noise:g}"
    rows = [Row(work, "`global`", wall, float(truth.size), None, judged(fitted, truth), cpu)]
    del fitted
    fine = make_templates(model, WAVELENGTHS, model.setup.thickness_range_um).normalised_to(truth[::8, ::8])
    templates = replace(fine, response=fine.response[::WALK_STEPS], step_um=fine.step_um * WALK_STEPS)
    start = (truth.shape[0] // 2, truth.shape[1] // 2)
    walked, wall, cpu = timed(
        lambda: walk_fit(
            amplitudes_from_cube(cube), templates, start_pixel=start, range_um=model.setup.thickness_range_um
        )
    )
    wrong = np.mean(np.abs(walked.value - truth) > 0.5 * ORDER_UM)
    rows.append(Row(work, "walk", wall, float(truth.size), None, f"off by half an order {wrong:.1e}", cpu))
    return rows


def run() -> list[Row]:
    """Nine sensors at two levels of noise, and their middle at three contrasts."""
    model = FringeModel.from_setup("ts8_e2v", {"contrast_loss.factor": CONTRAST})
    maps = sensor_maps()
    if not maps:
        return [Row("nine real sensors", "–", float("nan"), note="maps not found: set FRINGE_SIM_SHARED")]
    whole = [
        row
        for sensor, path in maps.items()
        for noise in NOISES
        for row in sensor_rows(sensor, path, model, noise)
    ]
    return whole + [row for sensor, path in maps.items() for row in section_rows(sensor, path)]
