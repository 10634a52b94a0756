"""Hidden effects: identity at null, and a visible change away from it."""

import numpy as np
import pytest

from lsst.fringe_sim.effects import AMPLIFIERS
from lsst.fringe_sim.errors import OutOfRangeError
from lsst.fringe_sim.mock import HIDDEN_EFFECTS, HiddenEffect, e2v_321, setup_optics, validate_effects
from lsst.fringe_sim.mock.hidden_effects import (
    AmplifierState,
    added_silicon,
    hidden_islands,
    with_hidden_optics,
)
from lsst.fringe_sim.mock.sensor_signal import SensorSignal

BY_NAME = {effect.name: effect for effect in HIDDEN_EFFECTS}
STATE = AmplifierState("C03", 1.5, 6.0, 150_000.0)


def exposure_of(values: dict[str, float]) -> float:
    """Wavelength of the exposure [nm] that the first parameter concerns, or of any."""
    name = next(iter(values), "")
    return float(name.removeprefix("at_")) if name.startswith("at_") else 970.0


def reach(effect: HiddenEffect, values: dict[str, float]) -> list[object]:
    """Everything that an effect can touch, after it acted."""
    complete = effect.complete(values)
    touched: list[object] = []
    if effect.on_optics is not None:
        optics = setup_optics("ts8_e2v")[0]
        touched.append(effect.on_optics(optics, complete).flat_field([15.0, 15.1, 19.0], exposure_of(values)))
    light = 1.0 + 0.05 * np.sin(e2v_321((16, 24)) / 0.05)
    if effect.on_island is not None:
        touched.append(effect.on_island((16, 24), complete).part)
    if effect.on_silicon is not None:
        touched.append(effect.on_silicon((16, 24), complete))
    if effect.on_light is not None:
        touched.append(effect.on_light(light, 970.0, complete))
    if effect.on_charge is not None:
        touched.append(effect.on_charge(20_000.0 * light, complete))
    if effect.on_amplifier is not None:
        touched.append(effect.on_amplifier(STATE, complete, 1.3))
    return touched


def untouched(effect: HiddenEffect, values: dict[str, float]) -> list[object]:
    light = 1.0 + 0.05 * np.sin(e2v_321((16, 24)) / 0.05)
    everything: list[tuple[object, object]] = [
        (effect.on_optics, setup_optics("ts8_e2v")[0].flat_field([15.0, 15.1, 19.0], exposure_of(values))),
        (effect.on_island, effect.on_island and effect.on_island((16, 24), effect.complete({})).part),
        (effect.on_silicon, np.zeros((16, 24))),
        (effect.on_light, light),
        (effect.on_charge, 20_000.0 * light),
        (effect.on_amplifier, STATE),
    ]
    return [value for action, value in everything if action is not None]


def same(left: object, right: object) -> bool:
    if isinstance(left, np.ndarray) and isinstance(right, np.ndarray):
        return bool(np.array_equal(left, right))
    return left == right


@pytest.mark.parametrize("effect", HIDDEN_EFFECTS, ids=lambda effect: effect.name)
def test_null_is_the_identity(effect: HiddenEffect) -> None:
    before = untouched(effect, {})
    assert before
    for left, right in zip(reach(effect, {}), before, strict=True):
        assert same(left, right)


@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        (effect.name, parameter.name)
        for effect in HIDDEN_EFFECTS
        for parameter in effect.parameters
        if parameter.name not in AMPLIFIERS or parameter.name == STATE.name
    ],
)
def test_every_parameter_does_something(name: str, parameter: str) -> None:
    effect = BY_NAME[name]
    low, high = effect.parameter(parameter).bounds
    null = effect.parameter(parameter).null
    value = 0.3 * high if np.isnan(null) or null == 0.0 else null + 0.3 * (high - null)
    if name == "temperature":
        value = 210.0
    size = {"tree_rings": ("cosine", 0.02), "void": ("thickness", 100.0)}.get(name)
    others = {size[0]: size[1]} if size and parameter != size[0] else {}  # at a place there must be something
    changed = reach(effect, {**others, parameter: value})
    before = reach(effect, others) if others else untouched(effect, {parameter: value})
    assert not all(same(left, right) for left, right in zip(changed, before, strict=True))
    assert low <= value <= high


def test_settings_may_be_flat_or_nested() -> None:
    flat = validate_effects({"bandwidth.fwhm": 3, "tilt.angle": "4.5"})
    nested = validate_effects({"tilt": {"angle": 4.5}, "bandwidth": {"fwhm": 3.0}})
    assert flat == nested
    assert [effect.name for effect, _ in flat] == ["bandwidth", "tilt"]
    assert validate_effects(None) == ()


@pytest.mark.parametrize("key", ["dark_pedestal.electrons", "dark_current.rate"])
def test_there_are_no_fewer_electrons_than_none(key: str) -> None:
    """The model may fit a negative level; nature counts."""
    with pytest.raises(OutOfRangeError, match="0 to"):
        validate_effects({key: -1.0})


@pytest.mark.parametrize("sigma", [0.2, 0.45, 1.8])
def test_diffusion_lowers_fringes_by_the_transform_of_its_gaussian(sigma: float) -> None:
    """Below 0.7 pixels, a Gaussian sampled at whole pixels would do less: a tenth of it at 0.3."""
    place = np.arange(60) + 0.5
    fringes = np.cos(np.pi * 14 * place / 60)[:, np.newaxis] * np.cos(np.pi * 5 * place[:48] / 48)
    square = (np.pi * 14 / 60) ** 2 + (np.pi * 5 / 48) ** 2
    light = BY_NAME["charge_diffusion"].on_light(1.0 + 0.1 * fringes, 970.0, {"sigma": sigma})
    np.testing.assert_allclose(light, 1.0 + 0.1 * np.exp(-0.5 * sigma**2 * square) * fringes, atol=1e-12)


def test_a_wedge_of_silicon_is_that_of_every_column() -> None:
    optics = setup_optics("ts8_e2v")[0]
    thickness = np.linspace(15.0, 15.4, 40)[:, np.newaxis] * np.ones(8)
    wedge = BY_NAME["silicon_gradient"]
    added = added_silicon(thickness.shape, [(wedge, {"gradient_x": 0.14})])
    assert added is not None
    signal = SensorSignal.of(optics, thickness, [900.0, 980.0], added)
    assert added_silicon(thickness.shape, [(BY_NAME["bandwidth"], {"fwhm": 2.4})]) is None
    nominal = optics.films[optics.position("detection")].thickness_um
    for column in (0, 3, 7):
        thicker = optics.with_film("detection", thickness_um=nominal + added[0, column])
        alone = SensorSignal.of(thicker, thickness, [900.0, 980.0])
        for row in (0, 1):
            np.testing.assert_allclose(signal.flat(row)[:, column], alone.flat(row)[:, column], rtol=5e-5)
    assert np.ptp(signal.flat(1)[0]) > 4e-4 * signal.flat(1).mean()


@pytest.mark.slow
def test_light_that_comes_back_incoherently_leaves_a_wedge_as_it_is() -> None:
    """No fringes are left, and silicon that is thicker absorbs as much more as it does with them."""
    optics, _ = setup_optics("ts8_e2v")
    order = 0.98 / (2.0 * optics.films[optics.position("adhesive")].index(np.array([980.0]), 183.15)[0].real)
    thickness = 15.0 + order * np.arange(8)[:, np.newaxis] / 8.0 * np.ones(6)
    added = np.linspace(-0.5, 0.5, 6) * np.ones((8, 1))
    loss = BY_NAME["contrast_loss"].on_optics
    with_fringes = SensorSignal.of(optics, thickness, [980.0], added).flat(0)
    without, half = (
        SensorSignal.of(loss(optics, {"factor": part}), thickness, [980.0], added).flat(0)
        for part in (0.0, 0.5)
    )
    np.testing.assert_allclose(without, np.ones((8, 1)) * with_fringes.mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(half, 0.5 * (with_fringes + without), rtol=1e-6)
    assert np.ptp(with_fringes[:, 0]) > 0.05 * with_fringes.mean()
    assert np.ptp(without[0]) > 0.002 * without.mean()


def test_an_island_sees_its_own_optics() -> None:
    optics, _ = setup_optics("ts8_e2v")
    thickness = np.linspace(15.0, 15.4, 20)[:, np.newaxis] * np.ones(30)
    values = {"thickness": 120.0, "centre_x": 12.0, "centre_y": 9.0, "radius": 5.0}
    active = [(BY_NAME["void"], values)]
    assert with_hidden_optics(optics, active) is optics
    islands = hidden_islands(optics, thickness.shape, active)
    ((island, inside),) = islands
    part, whole = island.part, np.ones(thickness.shape, bool)
    whole[island.rows, island.columns] = False
    assert part.sum() == pytest.approx(np.pi * 25.0, rel=0.01)
    mixed, outside, gap = (
        SensorSignal.of(*stack).flat(0)
        for stack in (
            (optics, thickness, [960.0], None, islands),
            (optics, thickness, [960.0]),
            (inside, thickness, [960.0]),
        )
    )
    np.testing.assert_allclose(mixed[whole], (outside + part * (gap - outside))[whole], rtol=1e-12)
    assert np.abs(gap - outside).max() > 0.01 * outside.mean()


def test_pixels_of_a_rim_see_each_stack_at_the_thickness_of_their_own_part_of_it() -> None:
    optics, _ = setup_optics("ts8_e2v")
    values, finer = {"thickness": 120.0, "centre_x": 7.3, "centre_y": 9.1, "radius": 4.6}, 15
    place = {key: finer * value + finer // 2 for key, value in values.items() if key.startswith("centre")}
    fine = {"thickness": 120.0, **place, "radius": finer * values["radius"]}

    def flat(size: int, step_um: float, values: dict[str, float]) -> np.ndarray:
        rows = np.arange(20 * size) - size // 2
        thickness = 15.0 + step_um / size * np.add.outer(rows, 0.3 * rows)
        islands = hidden_islands(optics, thickness.shape, [(BY_NAME["void"], values)])
        return SensorSignal.of(optics, thickness, [960.0], None, islands).flat(0)

    true = flat(finer, 0.05, fine).reshape(20, finer, 20, finer).mean(axis=(1, 3))
    np.testing.assert_allclose(flat(1, 0.05, values), true, rtol=5e-4)


def test_an_island_beside_the_sensor_changes_nothing() -> None:
    optics, _ = setup_optics("ts8_e2v")
    thickness = np.linspace(15.0, 15.4, 20)[:, np.newaxis] * np.ones(30)
    values = {"thickness": 120.0, "centre_x": 90.0, "centre_y": 9.0, "radius": 5.0}
    beside = SensorSignal.with_effects(optics, thickness, [960.0], [(BY_NAME["void"], values)])
    np.testing.assert_array_equal(beside.flat(0), SensorSignal.of(optics, thickness, [960.0]).flat(0))
