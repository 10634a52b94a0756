"""What the demo hides, and how its search is judged."""

import math

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.algorithms.discovery.verdict import Gap, NamedEffect, ParameterValue, Where
from lsst.fringe_sim.challenge.demo_case import (
    CONTRAST,
    SECOND_EFFECTS,
    DemoCase,
    draw_demo_case,
    found_words,
    of_the_layers,
    thickness_of_demo,
)
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.mock.hidden_effects import validate_effects

SHAPE = (64, 96)
CASE = DemoCase(3, SHAPE, {"contrast_loss.factor": 0.13, "illumination.gradient_x": 0.003})
NOT_A_NUMBER = math.nan


def verdict(*effects: tuple[str, ...]) -> Verdict:
    """A verdict that names the first of each, and cannot tell it from the others."""
    named = tuple(
        NamedEffect(name, {"factor": ParameterValue(0.1, 0.01, "")}, 0.99, tuple(rivals))
        for name, *rivals in effects
    )
    gap = Gap("rms", *[NOT_A_NUMBER] * 5)
    return Verdict("named" if named else "unexplained", named, Where(), gap, (), {}, "ts8_e2v", 0.0)


def test_a_seed_draws_the_weak_contrast_and_one_more_effect() -> None:
    cases = [draw_demo_case(seed, SHAPE) for seed in range(60)]
    assert {case.names[0] for case in cases} == {"contrast_loss"}
    assert {case.names[1:] for case in cases} == {(name,) for name in SECOND_EFFECTS}
    assert all(case.values["contrast_loss.factor"] == CONTRAST for case in cases)
    assert draw_demo_case(7, SHAPE) == cases[7]
    assert len({str(case.values) for case in cases}) == 60
    for case in cases:
        validate_effects(case.values)


def test_the_noise_of_two_seeds_differs() -> None:
    first, again, other = (DemoCase(seed, SHAPE, {}) for seed in (1, 1, 2))
    assert first.frames_rng.random() == again.frames_rng.random() != other.frames_rng.random()
    assert first.frames_rng.random() != first.visits_rng.random()


def test_a_case_is_read_back_from_its_file() -> None:
    assert DemoCase.from_json(CASE.to_json()) == CASE
    for text in ("", "{}", '{"seed": 1}'):
        with pytest.raises(InputError, match="sealed case"):
            DemoCase.from_json(text)


@pytest.mark.parametrize(
    ("effects", "word"),
    [
        ([("contrast_loss",), ("illumination",)], "right"),
        ([("illumination",), ("contrast_loss",)], "right"),
        ([("ghost_pedestal", "contrast_loss"), ("illumination",)], "right class"),
        ([("contrast_loss", "ghost_pedestal"), ("illumination",)], "right class"),
        ([("contrast_loss",)], "wrong"),
        ([("contrast_loss",), ("vignetting",)], "wrong"),
        ([("contrast_loss",), ("illumination",), ("tilt",)], "wrong"),
        ([], "no name"),
    ],
)
def test_a_verdict_is_judged_by_its_classes(effects: list[tuple[str, ...]], word: str) -> None:
    assert found_words(CASE, verdict(*effects)) == word


def test_visits_have_what_the_layers_of_the_sensor_do() -> None:
    assert CASE.on_sky == {"contrast_loss.factor": 0.13}
    found = {"contrast_loss.factor": 0.13, "illumination.gradient_x": 0.003, "amplifier_gain.C00": 0.001}
    assert of_the_layers(found) == {"contrast_loss.factor": 0.13}
    assert of_the_layers({"bandwidth.fwhm": 2.4}) == {"bandwidth.fwhm": 2.4}  # which the fit needs


def test_the_part_of_the_sensor_is_the_same_at_every_size() -> None:
    small, large = thickness_of_demo((64, 64)), thickness_of_demo((256, 256))
    assert small.shape == (64, 64)
    means = large.reshape(64, 4, 64, 4).mean(axis=(1, 3))
    assert np.abs(small - means).max() < 0.002
    assert 1.2 < np.ptp(large) < 2.0


def test_effects_that_are_hidden_are_in_the_catalogue() -> None:
    assert set(SECOND_EFFECTS) <= {effect.name for effect in EFFECTS}
