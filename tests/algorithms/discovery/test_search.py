"""The search on a few sealed cases and what it refuses; `python -m benchmarks panel` judges how well it does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import (
    SearchOptions,
    Verdict,
    discover,
    probability_text,
    read_effects_override,
)
from lsst.fringe_sim.algorithms.discovery.checks import check_setup, headers_apart
from lsst.fringe_sim.challenge.sealed_cases import draw_case, expose
from lsst.fringe_sim.effects import ArCoating, LineTriangle
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products.fringe_cube import FringeCube

SIZE = (48, 64)
MODEL = FringeModel.from_setup("ts8_e2v")


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is_hidden() -> None:
    case = draw_case("none", np.random.default_rng(11), size=SIZE)
    verdict = discover(case.cube, case.setup, rng=np.random.default_rng(0))
    assert verdict.verdict == "no_discrepancy"
    assert verdict.size["of_fringes"] < verdict.size["of_fringes_at_most"] < 0.1
    assert (
        replace(verdict, size={**verdict.size, "of_counts": 0.0})
        .size_text()
        .endswith("% of the fringes (95 %)")
    )
    assert verdict.effects == ()
    # Flats do not see the spectrum of the night sky.
    assert not {"sky_continuum", "oh_bands"} & {item["name"] for item in verdict.candidates}


@pytest.mark.slow
@pytest.mark.parametrize("setup", ["bnl_ts8_e2v", "ts8_itl"])
def test_other_sensors_are_searched(setup: str) -> None:
    """Light of 1 nm shows fringes of the support; behind a black coating those of the silicon, 0.13 µm each."""
    case = draw_case("one", np.random.default_rng(14), size=SIZE, only=["ghost_pedestal"], setup=setup)
    verdict = discover(case.cube, setup, rng=np.random.default_rng(0))
    (found,) = verdict.effects
    assert "ghost_pedestal" in {found.name, *found.ambiguous_with}
    assert found.significance > 10.0


@pytest.mark.slow
def test_a_hidden_effect_is_named(tmp_path: Path) -> None:
    name = "illumination"
    case = draw_case("one", np.random.default_rng(21), size=SIZE, only=[name])
    verdict = discover(case.cube, case.setup, rng=np.random.default_rng(0))
    assert verdict.verdict == "named"
    effect = verdict.effects[0]
    assert name in {effect.name, *effect.ambiguous_with}
    assert effect.probability >= 0.95
    assert verdict.gap.heldout_after < verdict.gap.heldout_before
    path = verdict.write(tmp_path)
    assert Verdict.from_json(path.read_text()).settings == verdict.settings
    assert read_effects_override((tmp_path / "effects.py").read_text()) == verdict.settings
    FringeModel.from_setup(case.setup, verdict.settings)


@pytest.mark.slow
def test_a_cause_outside_the_catalogue_is_not_named() -> None:
    rng, size = np.random.default_rng(22), 0.0
    while size < 0.004:
        case = draw_case("outsider", rng.spawn(1)[0], size=SIZE, only=["annealing"])
        size = case.values["annealing.size"]
    verdict = discover(case.cube, case.setup, rng=np.random.default_rng(0))
    assert verdict.verdict == "unexplained"
    assert verdict.effects == ()


class _NarrowCoating(ArCoating):
    parameters = (replace(ArCoating.parameters[0], bounds=(0.9, 1.1)),)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "key", "value", "named"),
    [
        (_NarrowCoating(), "ar_coating.scale", 1.103, False),
        (ArCoating(), "ar_coating.scale", 1.103, True),
        (LineTriangle(), "line_triangle.fraction", 1.0, True),
    ],
)
def test_what_is_at_the_end_of_what_a_model_is_meant_for_is_not_named(effect, key, value, named) -> None:
    """All the light may be in a triangle, and no coating that is made is a tenth off."""
    rng = np.random.default_rng(17)
    cube, _ = expose(random_field(SIZE, rng, mean=15.0, span=2.0), {key: value}, rng)
    verdict = discover(cube, "ts8_e2v", [effect], rng=np.random.default_rng(0))
    assert (verdict.verdict == "named") == named, verdict.summary()
    if not named:
        assert verdict.unexplained["reason"] == "ar_coating.scale is at the end of its range (1.1)"


def test_poor_data_are_told_to_be_poor() -> None:
    cube = draw_case("none", np.random.default_rng(3), size=SIZE).cube
    verdict = discover(cube.take([4]), "ts8_e2v", rng=np.random.default_rng(0))
    assert verdict.verdict == "unexplained"
    assert verdict.unexplained["too_poor"]
    assert "thickness map" in verdict.unexplained["reason"]
    assert "nan" not in verdict.summary()


def test_the_override_holds_what_was_known_before() -> None:
    """With what was found alone, a sensor of known weak fringes was fitted and forecast with strong ones."""
    cube = draw_case("none", np.random.default_rng(3), size=SIZE).cube
    known = {"contrast_loss.factor": 0.13}
    verdict = discover(cube.take([4]), FringeModel.from_setup("ts8_e2v", known), rng=np.random.default_rng(0))
    assert read_effects_override(verdict.override()) == known
    assert Verdict.from_json(verdict.to_json()).known == known


def test_the_mean_of_a_few_pixels_is_no_level() -> None:
    """Twenty pixels in electrons, a third of a fringe, were named black coating; nothing was missing."""
    cube = draw_case("none", np.random.default_rng(3), size=(4, 5)).cube
    assert cube.unit == "electron"
    verdict = discover(cube, "ts8_e2v", rng=np.random.default_rng(0))
    assert verdict.verdict == "unexplained"
    assert "20 pixel(s) in electrons" in verdict.unexplained["reason"]


def test_contradicting_set_up_is_refused() -> None:
    cube = draw_case("none", np.random.default_rng(3), size=SIZE).cube
    with pytest.raises(InputError, match="bandwidth"):
        discover(cube, "bnl_ts8_e2v", rng=np.random.default_rng(0))
    with pytest.raises(InputError, match="monochromator"):
        discover(cube, "lsst_e2v", rng=np.random.default_rng(0))


def test_a_temperature_that_the_flats_state_is_told_or_refused() -> None:
    """The model keeps that of the set-up: three kelvin would be found as if nobody had known."""
    cube = draw_case("none", np.random.default_rng(3), size=SIZE).cube
    rows = cube.exposures

    def at(kelvin: float) -> FringeCube:
        return replace(cube, exposures=replace(rows, temperature_k=np.full(len(rows.wavelength_nm), kelvin)))

    with pytest.raises(InputError, match=r"\[K\] is 190.0; allowed: within 5 .* temperature.kelvin"):
        check_setup(at(190.0), MODEL)
    check_setup(at(186.5), MODEL)
    assert headers_apart(cube, MODEL) == ()
    (note,) = headers_apart(at(186.5), MODEL)
    assert "186.5 K" in note
    assert "183.15" in note
    assert headers_apart(at(186.5), FringeModel.from_setup("ts8_e2v", {"temperature.kelvin": 186.5})) == ()


@pytest.mark.slow
def test_no_more_effects_are_named_than_may_be() -> None:
    case = draw_case("two", np.random.default_rng(4), size=SIZE, only=["illumination", "bandwidth"])
    options = SearchOptions(most_effects=1)
    verdict = discover(case.cube, case.setup, rng=np.random.default_rng(0), options=options)
    assert verdict.verdict == "unexplained"
    assert [step.added for step in verdict.steps] == [("illumination",)]


@pytest.mark.parametrize(
    ("probability", "text"),
    [(0.9499, "0.949"), (0.95, "0.950"), (0.0, "0.000"), (0.99999, "0.999"), (1.0, "1.000")],
)
def test_a_probability_below_a_threshold_does_not_read_as_if_it_had_reached_it(
    probability: float, text: str
) -> None:
    assert probability_text(probability) == text
