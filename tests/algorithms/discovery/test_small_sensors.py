"""The search of sensors that are hardly larger than the blocks that it holds out."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import SearchOptions, Verdict, discover
from lsst.fringe_sim.algorithms.discovery.noise import OVERLAP
from lsst.fringe_sim.algorithms.discovery.preparation import prepare
from lsst.fringe_sim.effects import known_effects
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS = np.linspace(880.0, 990.0, 12)
SIDE = 16  # Rows and columns of a sensor of which a part is held out, whatever part
ELECTRONS, PLACES = 50_000.0, 3
DIFFERENCES = 115  # Second differences that the largest blocks leave of such a sensor
STATED = 0.64
"""Variance that is stated over that of the noise."""


def cube_of(rng: np.random.Generator, effects: dict[str, float], stated: float = 1.0) -> FringeCube:
    """Flats of a small sensor, with photon noise."""
    side = SIDE
    y, x = (np.mgrid[: side * PLACES, : side * PLACES] + 0.5) / (32 * PLACES)
    thickness = 15.0 + 0.5 * x + 0.3 * y**2 - 0.2 * x * y
    model = FringeModel.from_setup("ts8_e2v", effects)
    flats = model.respond(model.system.flat_fields(WAVELENGTHS, 0.1), thickness, WAVELENGTHS)
    flats = flats.reshape(12, side, PLACES, side, PLACES).mean(axis=(2, 4))
    image = rng.poisson(flats * ELECTRONS / flats.mean(axis=(1, 2), keepdims=True)).astype(np.float32)
    width, kelvin = model.setup.bandwidth_fwhm_nm, model.base_system.temperature_k
    rows = FlatExposures(WAVELENGTHS, np.full(12, width), np.full(12, kelvin))
    variance = np.float32(stated) * image
    return FringeCube(image, variance, np.zeros(image.shape, np.int32), rows, "electron")


def verdict_of(cube: FringeCube) -> Verdict:
    return discover(cube, "ts8_e2v", rng=np.random.default_rng(5))


@pytest.mark.rng("noise of a small sensor")
def test_noise_is_measured_beside_what_is_held_out(rng: np.random.Generator) -> None:
    model = FringeModel.from_setup("ts8_e2v")
    effects = [effect for effect in known_effects(None) if not effect.sky_only]
    cube = cube_of(rng, {}, STATED)

    prepared = prepare(cube, model, effects, SearchOptions(), np.random.default_rng(5))
    assert prepared.unseen.seen.any()
    error = np.sqrt(OVERLAP / (2.0 * DIFFERENCES * len(WAVELENGTHS)))
    assert float(prepared.noise_factor.mean()) == pytest.approx(STATED**-0.5, rel=4.0 * error)


@pytest.mark.slow
@pytest.mark.parametrize("effects", [{}, {"wavelength_offset.offset": 2.0}], ids=str)
def test_the_answer_is_what_is_hidden(effects: dict[str, float]) -> None:
    verdict = verdict_of(cube_of(np.random.default_rng(list(str(effects).encode())), effects))
    assert verdict.verdict == ("named" if effects else "no_discrepancy"), verdict.summary()
    assert len(verdict.effects) == len(effects)
    for effect, (key, true) in zip(verdict.effects, effects.items(), strict=True):
        name, _, parameter = key.partition(".")
        assert effect.name == name
        found = effect.parameters[parameter]
        assert found.value == pytest.approx(true, abs=3.0 * found.sigma)


def test_dim_flats_are_averaged_until_the_thickness_of_a_cell_is_known(recorded: Record) -> None:
    """Within the error that is stated; the cells are larger than pixels, and the fringes wider than cells."""
    rng, side = np.random.default_rng(9), 28
    y, x = np.mgrid[:side, :side] / 36.0
    thickness = 15.0 + 0.25 * x + 0.15 * y**2 - 0.1 * x * y
    model = FringeModel.from_setup("ts8_e2v")
    flats = model.response(thickness, WAVELENGTHS)
    image = rng.poisson(1500.0 * flats / flats.mean(axis=(1, 2), keepdims=True)).astype(np.float32)
    rows = FlatExposures(WAVELENGTHS, np.full(12, model.setup.bandwidth_fwhm_nm), np.full(12, 183.15))
    cube = FringeCube(image, np.maximum(image, 1.0), np.zeros(image.shape, np.int32), rows, "electron")
    effects = [effect for effect in known_effects(None) if effect.name in ("bandwidth", "contrast_loss")]
    prepared = prepare(cube, model, effects, SearchOptions(), np.random.default_rng(5))
    size = prepared.cells.cell_px
    assert size > 1
    shape = prepared.cells.shape[1:]
    truth = (
        thickness[: size * shape[0], : size * shape[1]]
        .reshape(shape[0], size, shape[1], size)
        .mean(axis=(1, 3))
    )
    pull = ((prepared.free.thickness_um - truth.ravel()) / prepared.free.thickness_sigma_um)[
        prepared.cells.seen.ravel()
    ]
    assert np.abs(np.median(pull)) < 1.0
    assert np.sqrt(np.mean(pull**2)) < 1.5
    recorded({
        "size": size, "thickness": prepared.free.thickness_um, "sigma": prepared.free.thickness_sigma_um,
        "cost": [prepared.free.cost, prepared.point.cost], "noise": prepared.noise_factor,
        "levels": prepared.point.levels,
    })  # fmt: skip


@pytest.mark.rng("memory of a search")
def test_nothing_of_a_search_stays_in_memory(rng: np.random.Generator) -> None:
    def models() -> set[int]:
        gc.collect()
        rooms = ("lsst.fringe_sim.algorithms.inference.", "lsst.fringe_sim.algorithms.discovery.")
        return {
            id(item)
            for item in gc.get_objects()
            if str(getattr(type(item), "__module__", "")).startswith(rooms)
            and type(item).__name__ in ("Forward", "Problem")
        }

    before = models()
    assert verdict_of(cube_of(rng, {})).verdict == "no_discrepancy"
    assert models() <= before
