"""The search of small frames of the night sky: their light, what is found, and what would decide."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from sky_frames import bright_sky, sky_frames_of

from lsst.fringe_sim.algorithms.discovery import Verdict, discover_sky, sky_search
from lsst.fringe_sim.algorithms.discovery.sky_search import SKY_SEARCH, BeamsOverSensor, SkyExposures
from lsst.fringe_sim.algorithms.field_response import SensorPlacement
from lsst.fringe_sim.algorithms.inference import CellShape, Forward
from lsst.fringe_sim.algorithms.sky_response import bandpass_of
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model import FringeModel

NAMES = ("contrast_loss", "sky_continuum", "epoxy_temperature", "sensor_temperature")
SIDE, LINES, MAP_UM, ELECTRONS = 24, 6, 0.002, 4e6


def verdict_of(settings: dict[str, float], seed: int, **options: object) -> Verdict:
    sky = bright_sky(LINES)
    frames, known = sky_frames_of("monocam", settings, seed, ELECTRONS, shape=(SIDE, SIDE), span=1.4, sky=sky)
    return discover_sky(
        frames, known, MAP_UM, "monocam", [effect for effect in EFFECTS if effect.name in NAMES],
        rng=np.random.default_rng(seed), sky=sky, options=replace(SKY_SEARCH, **options),
    )  # fmt: skip


def test_every_cell_sees_the_light_at_its_own_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a beam that is narrower away from the axis, against the light of each place by itself."""
    base = FringeModel.from_setup("lsst_e2v")
    cone = base.base_system.beam
    slower = SimpleNamespace(beam=lambda radius: replace(cone, theta=cone.theta * (1.0 - 0.3 * radius)))
    monkeypatch.setattr(sky_search, "beam_field", lambda telescope: slower)
    detector = Camera.from_name(base.setup.camera).detector("R22_S01")
    field = BeamsOverSensor.of(
        base.setup.telescope, SensorPlacement.of(detector, base.setup.pixel_scale_arcsec)
    )
    assert field is not None
    sky, shape = bright_sky(2), (2, 12, 10)
    light = SkyExposures(base, sky, bandpass_of(base), ({}, {sky.lines.bands[0]: 0.5}), field)
    y, x = (300.0 * np.arange(size) for size in shape[1:])
    geometry = ImageGeometry((3600, 3000), y, x, light.wavelength_nm(), np.full(2, 1000.0))
    limits, thickness = (13.0, 13.6), 13.2 + 1e-4 * (y[:, np.newaxis] + 0.5 * x) / 3.0
    nodes, half = np.polynomial.legendre.leggauss(4)
    share = 0.25 * np.outer(half, half).ravel()
    within = thickness[..., np.newaxis] + 0.005 * np.add.outer(nodes, 0.5 * nodes).ravel()  # a cell is even
    weight = light.place_weight(geometry)
    ours = Forward(
        base, EFFECTS, geometry, CellShape.of_field(thickness, 1), limits,
        exposures=light, place_weight=weight.reshape(len(weight), -1),
    )  # fmt: skip
    for settings in ({}, {"contrast_loss.factor": 0.7}):
        rows = light.response(FringeModel.from_setup("lsst_e2v", settings), limits[0], 0.004, 151)
        of_places = CubicSpline(limits[0] + 0.004 * np.arange(151), rows, axis=1)
        expected, steep = (
            np.einsum(
                "kyx,kwyxn,n->wyx", weight, of_places(within, nu).reshape(len(weight), *shape, 16), share
            )
            for nu in (0, 1)
        )
        level = expected.mean(axis=(1, 2), keepdims=True)
        fringes, steep = expected / level - 1.0, steep / level
        value, slope = (part.reshape(shape) for part in ours.predict(settings, thickness.ravel()))
        mean = value.mean(axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(value / mean - 1.0, fringes, atol=1e-4 * fringes.std())
        np.testing.assert_allclose(slope / mean, steep, atol=1e-3 * steep.std())
        one_place = replace(ours, place_weight=np.eye(len(weight))[:1].T @ np.ones((1, thickness.size)))
        off = one_place.predict(settings, thickness.ravel())[0] - value.reshape(2, -1)
        assert np.ptp(off) > 0.1 * fringes.std()  # it matters


def test_an_effect_of_the_sky_is_compared_with_the_sensor_and_not_with_its_voids() -> None:
    """Light that is kept: of voids of two depths after each other, and of a sky that changes after that."""
    base, grid = FringeModel.from_setup("monocam"), (13.0, 0.01, 40)
    brighter = FringeModel.from_setup("monocam", {"sky_continuum.scale": 1.0 + 1e-6})
    shallow, deep = (
        inside
        for size_nm in (60.0, 120.0)
        for _, inside in FringeModel.from_setup("monocam", {"void.thickness": size_nm}).islands
    )

    def light_of() -> SkyExposures:
        return SkyExposures(base, bright_sky(2), bandpass_of(base), ({},))

    light, other = light_of(), light_of()
    on_deep, unchanged = other.response(deep, *grid), light_of().response(base, *grid)
    on_shallow = light.response(shallow, *grid)
    np.testing.assert_array_equal(light.response(deep, *grid), on_deep)
    np.testing.assert_allclose(light.response(brighter, *grid), unchanged, rtol=1e-6)
    fringes = np.ptp(unchanged)
    assert np.abs(on_shallow - unchanged).max() > 0.3 * fringes
    assert np.abs(on_deep - on_shallow).max() > 0.3 * fringes


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"contrast_loss.factor": 0.8},
        {"sensor_temperature.offset": 4.0},
        {"epoxy_temperature.phase_per_10k": 0.2},
    ],
    ids=str,
)
def test_the_answer_is_what_is_hidden(settings: dict[str, float]) -> None:
    verdict = verdict_of(settings, 31)
    assert verdict.verdict == ("named" if settings else "no_discrepancy"), verdict.summary()
    assert len(verdict.effects) == len(settings)
    for effect, (key, true) in zip(verdict.effects, settings.items(), strict=True):
        name, _, parameter = key.partition(".")
        assert name in (effect.name, *effect.ambiguous_with)
        if effect.name == name:
            found = effect.parameters[parameter]
            assert found.value == pytest.approx(true, abs=3.0 * found.sigma)


def test_what_would_decide_is_a_frame_or_a_flat() -> None:
    """Of a class that is made wide; what all frames show alike is no scatter of the response."""
    verdict = verdict_of({"contrast_loss.factor": 0.6}, 32, class_width=1e4)
    assert verdict.verdict == "named", verdict.summary()
    (effect,) = verdict.effects
    assert effect.name == "contrast_loss"
    assert effect.parameters["factor"].value == pytest.approx(
        0.6, abs=5.0 * effect.parameters["factor"].sigma
    )
    assert verdict.data["response_scatter"] < 0.3 * ELECTRONS**-0.5
    assert verdict.accuracy.get("assumed") is None
    assert verdict.learned == {}
    assert effect.ambiguous_with
    assert {row["measurement"] for row in verdict.next_measurements} == {"repeat", "hour", "laboratory"}


@pytest.mark.slow
def test_an_effect_whose_derivative_promises_too_little_is_found() -> None:
    """Fringes grow with every degree: the derivative promises a fifth of what six degrees explain, others more."""
    seed, settings = 12622742, {"sensor_temperature.offset": 6.0}
    frames, known = sky_frames_of("monocam", settings, seed, 1e5)
    catalogue = [effect for effect in EFFECTS if effect.name in (*NAMES, "oh_bands")]
    verdict = discover_sky(
        frames, known, MAP_UM, "monocam", catalogue,
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    assert verdict.verdict == "named", verdict.summary()
    (found,) = verdict.effects
    offset = found.parameters["offset"]
    assert found.name == "sensor_temperature"
    assert offset.value == pytest.approx(6.0, abs=5.0 * offset.sigma)
