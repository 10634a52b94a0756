"""Search for a missing effect, beside a refit of every effect at full resolution."""

from __future__ import annotations

import numpy as np

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.cells import bin_cube
from lsst.fringe_sim.algorithms.discovery.lesson import data_of
from lsst.fringe_sim.algorithms.inference import CellShape, Forward, Problem, coordinates_of, fit
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

from ._table import Row, memory_now, memory_watch, timed

SETUP = "ts8_e2v"
LEVEL_E = 20_000.0
HIDDEN = {"bandwidth.fwhm": 2.4}
RESPONSE_SCATTER = 1e-3
REFITTED = ("bandwidth", "roughness", "wavelength_offset")
"""Effects that are refitted at full resolution; the time of all is theirs times the number of effects."""


def run() -> list[Row]:
    """Sensors of a quarter of a megapixel, and a whole one."""
    return [*_searched((512, 512), beside=True), *_searched((4096, 4004), beside=False)]


def _searched(shape: tuple[int, int], *, beside: bool) -> list[Row]:
    cube, truth = _flats(shape)
    work = f"{shape[1]} × {shape[0]} × {cube.shape[0]}, one effect hidden"
    before = memory_now()
    with memory_watch() as peak:
        verdict, wall, cpu = timed(lambda: discover(cube, SETUP, rng=np.random.default_rng(1)))
    found = ", ".join(effect.name for effect in verdict.effects) or verdict.verdict
    note = f"{found}; {peak[0] - before:.2f} GiB beyond the cube of {cube.image.nbytes * 2.5 / 2**30:.2f} GiB"
    if not beside:
        return [Row(work, "discover", wall, cpu=cpu, note=note)]
    naive_wall, naive_cpu = _refits(cube, truth)
    return [
        Row(work, "discover", wall, cpu=cpu, beside=naive_cpu, note=note),
        Row(work, "a refit of every effect, one thickness per pixel", naive_wall, cpu=naive_cpu,
            note=f"{len(REFITTED)} of {len(EFFECTS)} effects timed, from the true thickness"),
    ]  # fmt: skip


def _refits(cube: FringeCube, truth: np.ndarray) -> tuple[float, float]:
    """Wall and processor time of a refit of each effect of the catalogue, a few of them timed."""
    model = FringeModel.from_setup(SETUP)
    cells = bin_cube(cube, 1)
    limits = (float(truth.min()) - 0.5, float(truth.max()) + 0.5)
    forward = Forward(model, EFFECTS, cells.geometry, CellShape.of_field(truth, 1), limits)
    problem = Problem(data_of(cells), forward, truth.ravel(), RESPONSE_SCATTER)
    null = fit((), (), problem.at({}, np.ones(cube.shape[0]), truth.ravel()))
    wall = cpu = 0.0
    for name in REFITTED:
        effect = next(effect for effect in EFFECTS if effect.name == name)
        items = coordinates_of(effect, forward)
        _, own_wall, own_cpu = timed(lambda own=(name,), i=items: fit(own, i, null.point))  # type: ignore[misc]
        wall, cpu = wall + own_wall, cpu + own_cpu
    share = len(EFFECTS) / len(REFITTED)
    return wall * share, cpu * share


def _flats(shape: tuple[int, int]) -> tuple[FringeCube, np.ndarray]:
    rng = np.random.default_rng(7)
    truth = random_field(shape, rng, mean=15.0, span=3.0)
    wavelengths = np.arange(880.0, 991.0, 10.0)
    model = FringeModel.from_setup(SETUP, HIDDEN)
    low, step = float(truth.min()) - 0.02, 0.002
    count = int((float(truth.max()) + 0.02 - low) / step) + 2
    table = model.response_on_grid(wavelengths, low, step, count)
    grid = low + step * np.arange(count)
    image = np.empty((len(wavelengths), *shape), dtype=np.float32)
    for plane, response in enumerate(table):
        light = np.interp(truth, grid, response)
        image[plane] = rng.poisson(LEVEL_E * light / light.mean())
    exposures = FlatExposures(wavelengths, np.array(2.0), np.array(183.15))
    mask = np.zeros(image.shape, dtype=np.int16)
    return FringeCube(image, np.maximum(image, 1.0), mask, exposures, "electron"), truth
