"""Every effect on every kind of sample, as recorded, and what is known of each in closed form.

`test_effects` holds their effect on a small sensor of pixels; here are cells of several pixels, a sensor beyond whose
edges nothing is read, exposures that differ, and what a search asks of them.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.effects import EFFECTS, Effect, ImageGeometry, apply_to_image
from lsst.fringe_sim.effects.active import ActiveEffect, flat_settings, settings_of
from lsst.fringe_sim.effects.base import Residuals
from lsst.fringe_sim.effects.catalogue import catalogue_of, effects_from, known_effects
from lsst.fringe_sim.effects.ring_search import find_rings
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel

BY_NAME = {effect.name: effect for effect in known_effects()}
WAVE = np.array([884.0, 935.0, 990.0])


def cells(levels: float = 30_000.0) -> ImageGeometry:
    """Cells of six by five pixels of a sensor whose amplifiers are not of one size."""
    y, x = 2.5 + 6.0 * np.arange(12.0), 2.0 + 5.0 * np.arange(20.0)
    level, dark = levels * np.array([0.7, 1.0, 1.3]), np.array([10.0, 15.0, 30.0])
    edges = (0, 10, 25, 38, 50, 62, 75, 90, 100)
    return ImageGeometry((72, 100), y, x, WAVE, level, (0, 34, 72), edges, dark)


def sizes_of(effect: Effect) -> dict[str, float]:
    """Three eighths of the bounds of each parameter, a little more from one to the next; places on the sensor."""
    values = {}
    for number, item in enumerate(effect.parameters):
        low, high = item.bounds
        values[item.name] = low + (0.3 + 0.1 * np.sin(number)) * (high - low)
    places = {"centre_x": 41.0, "centre_y": 30.0, "radius": 17.0, "period": 23.0}
    return {name: places.get(name, value) for name, value in values.items()}


@pytest.mark.parametrize("effect", BY_NAME.values(), ids=lambda effect: effect.name)
def test_samples_of_a_sensor(effect: Effect, recorded: Record) -> None:
    """What becomes of an image, and everything else that is asked of an effect."""
    system, geometry = FringeModel.from_setup("ts8_e2v").base_system, cells()
    y, x = np.indices(geometry.sample_shape)
    image = 1.0 + 0.05 * np.sin(0.4 * x + 0.2 * y) * np.array([1.0, 0.8, 0.3])[:, np.newaxis, np.newaxis]
    values = sizes_of(effect)
    found: dict[str, Any] = {
        "image": apply_to_image([ActiveEffect(effect, values)], system, image, geometry),
        "covered": [effect.coverage(values, geometry), effect.coverage_moments(values, geometry)],
        "blur": [effect.blur_px(values), effect.charge_spread_px2(values, 20_000.0)],
        "noise": effect.noise_correlation(values, geometry),
        "bounds": [effect.bounds_on(item, geometry) for item in effect.parameters][:5],
        "seen": [item.name for item in effect.seen_parameters(geometry)] if not effect.learned else None,
        "null": list(effect.null_values(system).values()),
    }
    try:
        effect.check_search(geometry)
    except InputError as error:
        found["refused"] = error.field
    recorded(found)


def rings(
    shape: tuple[int, int], cell: float, centre: tuple[float, float], period: float, size: float
) -> Any:
    """A map with rings and noise of unit variance, where it is, and the middle of the sensor."""
    rng = np.random.default_rng(31)
    y, x = (cell * (np.arange(number) + 0.5) for number in shape)
    middle = np.array([0.5 * cell * number for number in shape])
    radius = np.hypot(y[:, np.newaxis] - centre[0], x - centre[1]) - np.hypot(*(middle - centre))
    image = size * np.cos(2.0 * np.pi * radius / period + 0.7) + rng.standard_normal(shape)
    return image, rng.random(shape) > 0.1, y, x, middle


@pytest.mark.parametrize(
    ("shape", "centre", "period"),
    [
        ((36, 40), (700.0, -500.0), 210.0),
        ((30, 44), (500.0, 900.0), 260.0),
        ((110, 36), (-700.0, 300.0), 330.0),
        ((104, 60), (1000.0, -900.0), 125.0),
        ((190, 24), (1500.0, -1800.0), 130.0),
    ],
)
def test_rings_are_found_where_they_are(
    shape: tuple[int, int], centre: tuple[float, float], period: float, recorded: Record
) -> None:
    image, used, y, x, middle = rings(shape, 40.0, centre, period, 1.0)
    found = find_rings(image, used, y, x, middle)
    assert found is not None
    assert np.hypot(found.centre[0] - centre[0], found.centre[1] - centre[1]) < 60.0
    assert found.period == pytest.approx(period, rel=0.02)
    assert abs(found.amplitude) == pytest.approx(1.0, abs=0.12)
    assert np.angle(found.amplitude) == pytest.approx(-0.7, abs=0.25)
    recorded(dataclasses.asdict(found))
    residuals = Residuals(
        np.where(used, image, 7.0)[np.newaxis] * np.ones((2, 1, 1)),
        np.where(used, 1.0, 0.0)[np.newaxis] * np.array([1.0, 3.0])[:, np.newaxis, np.newaxis],
        ImageGeometry((40 * shape[0], 40 * shape[1]), y - 0.5, x - 0.5, WAVE[:2], np.ones(2)),
    )
    (proposed,) = BY_NAME["tree_rings"].propose(residuals)
    assert proposed["period"] == pytest.approx(found.period)
    assert proposed["centre_y"] == pytest.approx(found.centre[0] - 0.5, abs=0.1)
    assert proposed["cosine"] == pytest.approx(found.amplitude.real, abs=1e-3)
    assert proposed["sine"] == pytest.approx(found.amplitude.imag, abs=1e-3)


def test_no_rings_where_there_are_none() -> None:
    """In noise, in a plane wave, in a map of one value, in one of few cells."""
    image, used, y, x, middle = rings((30, 30), 40.0, (0.0, 0.0), 200.0, 0.0)
    assert find_rings(image, used, y, x, middle) is None
    wave = image + 2.0 * np.cos(2.0 * np.pi * (0.6 * y[:, np.newaxis] + 0.8 * x) / 200.0)
    assert find_rings(wave, used, y, x, middle) is None
    assert find_rings(np.ones_like(image), used, y, x, middle) is None
    # Rings of less than 2.3 cells may be any other wave of the grid.
    for cells, seen in ((2.15, False), (2.45, True)):
        dense, *places = rings((30, 30), 40.0, (400.0, -200.0), cells * 40.0, 3.0)
        found = find_rings(dense, *places)
        assert (found is not None and found.period == pytest.approx(cells * 40.0, rel=0.02)) is seen
    bent, used, y, x, middle = rings((30, 30), 40.0, (300.0, 300.0), 200.0, 2.0)
    few = np.zeros_like(used)
    few.flat[:499] = True
    assert find_rings(bent, few, y, x, middle) is None
    few.flat[:500] = True
    assert find_rings(bent, few, y, x, middle) is not None


def test_samples_lie_where_they_are_said_to() -> None:
    geometry = cells()
    assert geometry.sample_shape == (12, 20)
    assert geometry.cell_px == (6.0, 5.0)
    np.testing.assert_allclose(geometry.v.ravel(), (geometry.y_px - 35.5) / 35.5)
    np.testing.assert_allclose(geometry.u.ravel(), (geometry.x_px - 49.5) / 49.5)
    rows = np.repeat(np.arange(72) >= 34, 1)[geometry.y_px.astype(int)]
    np.testing.assert_array_equal(geometry.upper_half.ravel(), rows)
    columns = np.searchsorted([10, 25, 38, 50, 62, 75, 90], np.ceil(geometry.x_px), side="right")
    np.testing.assert_array_equal(geometry.amplifier, 8 * rows[:, np.newaxis] + columns)
    alone = ImageGeometry.of_pixels((1, 2), [900.0])
    assert alone.cell_px == (1.0, 1.0)
    assert alone.v.tolist() == [[0.0]]
    assert alone.u.tolist() == [[-1.0, 1.0]]
    whole = ImageGeometry.of_pixels((40, 64), WAVE, [1.0, 2.0, 3.0], 4.0)
    assert (whole.y_edges, whole.x_edges) == ((0, 20, 40), tuple(range(0, 65, 8)))
    assert np.bincount(whole.amplifier.ravel()).tolist() == [160] * 16
    assert (whole.level_e.tolist(), whole.dark_time_s.tolist()) == ([1.0, 2.0, 3.0], [4.0] * 3)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"y_edges": (0, 72)}, "amplifier borders"),
        ({"x_edges": (0, 100)}, "amplifier borders"),
        ({"level_e": np.ones(2)}, "levels"),
        ({"wavelength_nm": np.ones((1, 3)), "level_e": np.ones((1, 3))}, "levels"),
        ({"dark_time_s": np.ones(2)}, "dark times"),
    ],
)
def test_samples_that_contradict_themselves_are_refused(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        dataclasses.replace(cells(), **changes)
    assert caught.value.field == field


@pytest.mark.parametrize("name", ["brighter_fatter", "dark_current", "non_linearity", "amplifier_offset"])
def test_what_an_effect_needs_is_asked_for(name: str) -> None:
    system, image = FringeModel.from_setup("ts8_e2v").base_system, np.ones((3, 12, 20))
    active = [ActiveEffect(BY_NAME[name], sizes_of(BY_NAME[name]))]
    unknown = {"level_e": np.array([1.0, 0.0, 1.0]), "dark_time_s": np.array([1.0, 0.0, 1.0])}
    with pytest.raises(InputError, match="above 0"):
        apply_to_image(active, system, image, dataclasses.replace(cells(), **unknown))


def test_dark_charge_of_several_effects_is_one_part_of_the_level() -> None:
    """Light is what is left beside all of it, in any order."""
    system, geometry = FringeModel.from_setup("ts8_e2v").base_system, cells()
    image = 1.0 + 0.1 * np.sin(np.arange(240.0)).reshape(12, 20) * np.ones((3, 1, 1))
    pair = [ActiveEffect(BY_NAME["dark_pedestal"], {"electrons": 500.0}),
            ActiveEffect(BY_NAME["dark_current"], {"rate": 20.0})]  # fmt: skip
    part = ((500.0 + 20.0 * geometry.dark_time_s) / geometry.level_e)[:, np.newaxis, np.newaxis]
    for active in (pair, pair[::-1]):
        found = apply_to_image(active, system, image, geometry)
        np.testing.assert_allclose(found, (1.0 - part) * image + part, rtol=1e-14)


def test_settings_go_in_and_out() -> None:
    effects = [BY_NAME["epoxy_index"], BY_NAME["bandwidth"]]
    active = [ActiveEffect(effects[0], {"offset": 0.01}), ActiveEffect(effects[1], {"fwhm": 3.0})]
    assert settings_of(active) == {"epoxy_index.offset": 0.01, "bandwidth.fwhm": 3.0}
    assert settings_of(active, on_sky=True) == {"epoxy_index.offset": 0.01}
    assert flat_settings({"a": {"b": 1}, "c.d": 2}) == {"a.b": 1, "c.d": 2}
    for wrong in ({"a": {"b": 1}, "a.b": 1}, {".b": 1}, {"a.": 1}, {"ab": 1}):
        with pytest.raises(InputError, match="effect setting"):
            flat_settings(wrong)
        with pytest.raises(InputError, match=r"^here: effect setting"):
            flat_settings(wrong, "here")
    with pytest.raises(OutOfRangeError, match=r"ar_coating.scale \[1\] is 9"):
        ActiveEffect(BY_NAME["ar_coating"], {"scale": 9.0})
    with pytest.raises(OutOfRangeError, match=r"bandwidth.fwhm \[nm\] is 90"):
        ActiveEffect(BY_NAME["bandwidth"], {"fwhm": 90.0})


OWN = """
from lsst.fringe_sim.effects import Effect, Parameter
from lsst.fringe_sim.effects.base import PlainNullEffect

class Haze(PlainNullEffect):
    name, title, acts_on, reference = "{name}", "haze", "image", "none"
    parameters = (Parameter("size", "", 0.0, (0.0, 1.0), 0.1, "how much"),)

EFFECTS = {effects}
"""


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"name": "bandwidth"}, "bandwidth"),
        ({"name": "two words"}, "an identifier"),
        ({"effects": "(3,)"}, "EFFECTS"),
        ({"effects": "()"}, ""),
        ({"effects": "(Haze(), Haze())"}, "haze"),
        ({"effects": "(Haze,)"}, "EFFECTS"),
    ],
)
def test_effects_of_ones_own(changes: dict[str, str], said: str, tmp_path) -> None:
    path = tmp_path / "own.py"
    path.write_text(OWN.format(**{"name": "haze", "effects": "(Haze(),)", **changes}))
    before = known_effects()
    if said:
        with pytest.raises(InputError, match=said), effects_from(path):
            pass
        assert known_effects() == before
        return
    with effects_from(path) as added:
        assert known_effects() == (*before, *added)
        assert [catalogue_of(effect.name) for effect in added] == [str(path)] * len(added)
        assert catalogue_of("bandwidth") == catalogue_of("nosuch") == ""
        if added:
            with pytest.raises(InputError, match="haze"), effects_from(path):
                pass
    assert known_effects() == before
    assert known_effects(iter(before[:2])) == before[:2]


def test_effects_are_told_apart_by_their_name() -> None:
    assert len(BY_NAME) == len(known_effects()) > len(EFFECTS)


def test_effects_on_a_system_that_has_them_already(recorded: Record) -> None:
    """A lamp seen through its own lines twice, a layer that grows, a cone of rays about a tilted beam."""
    system = FringeModel.from_setup("ts8_e2v").base_system

    def twice(name: str, values: dict[str, float]) -> tuple[Any, Any]:
        effect = BY_NAME[name]
        once = effect.change_system(system, values)
        return once, effect.change_system(once, values)

    one, two = (each.lamp for each in twice("lamp_lines", {"strength": 0.3}))
    np.testing.assert_allclose(two.at(two.wavelength_nm), one.at(two.wavelength_nm) ** 2)
    assert two.wavelength_nm.size == one.wavelength_nm.size
    assert np.ptp(two.at(two.wavelength_nm)) > 0.1
    for name, layer, scale in (("black_coating", "black_coating", 1.0), ("air_gap", "air_gap", 1e-3)):
        thickness = [
            each.stack.layers[each.stack.position(layer)].thickness_um
            for each in twice(name, {"thickness": 0.5})
        ]
        assert thickness == pytest.approx([0.5 * scale, scale])
    tilted = BY_NAME["tilt"].change_system(system, {"angle": 8.0})
    cones = [
        BY_NAME["converging_beam"].change_system(each, {"numerical_aperture": 0.2})
        for each in (system, tilted)
    ]
    for cone in cones:
        assert cone.beam.weight.sum() == pytest.approx(1.0)
    assert cones[1].beam.theta.max() > cones[0].beam.theta.max() > 0.9 * np.arcsin(0.2)
    recorded([[cone.beam.theta, cone.beam.weight] for cone in cones])


def test_the_adhesive_turns_the_fringe_on_its_way_to_the_telescope() -> None:
    """By so much for 10 K between the temperatures; in the laboratory neither of both effects is known."""
    bench, sky = (FringeModel.from_setup(name).base_system for name in ("ts8_e2v", "lsst_e2v"))
    adhesive, sensor = BY_NAME["epoxy_temperature"], BY_NAME["sensor_temperature"]
    turned, warmer = {"phase_per_10k": 0.3}, {"offset": 5.0}
    assert adhesive.change_system(bench, turned) is bench
    assert sensor.change_system(bench, warmer) is bench
    assert sensor.change_system(sky, warmer).temperature_k == sky.temperature_k + 5.0
    colder = dataclasses.replace(sky, laboratory_temperature_k=sky.temperature_k + 17.0)
    phase = []
    for system in (colder, adhesive.change_system(colder, turned)):
        layer = system.stack.layers[system.stack.position("adhesive")]
        index = float(layer.medium.index(960.0, system.temperature_k).real)
        phase.append(4.0 * np.pi * index * layer.thickness_um / 0.96)
    assert phase[1] - phase[0] == pytest.approx(0.3 * 1.7)
    alike = dataclasses.replace(sky, laboratory_temperature_k=sky.temperature_k)
    assert adhesive.change_system(alike, turned) is alike
