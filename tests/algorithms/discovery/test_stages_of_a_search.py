"""Single stages on one small sensor: sets of effects, pairs, and neighbouring minima."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from foreign_sky import foreign_map
from lsst.fringe_sim.algorithms.discovery.fit import Coordinate, Fit, Problem, fit_model
from lsst.fringe_sim.algorithms.discovery.selection import Hypothesis, Selector
from lsst.fringe_sim.algorithms.discovery.validation import disagreement_size, validate
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.discovery import SearchOptions, selection
from lsst.fringe_sim.algorithms.discovery.evaluations import count_evaluations
from lsst.fringe_sim.algorithms.discovery.pairs import fitted_pair, likely_pairs
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare
from lsst.fringe_sim.algorithms.discovery.set_search import SetSearch
from lsst.fringe_sim.array_types import FloatArray
from lsst.fringe_sim.challenge.sealed_cases import expose
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.model import FringeModel

NAMES = ("silicon_thickness", "contrast_loss", "bandwidth", "ghost_pedestal", "amplifier_gain")
HIDDEN = {"silicon_thickness.offset": 0.05, "contrast_loss.factor": 0.95}


def prepared_with(names: Sequence[str]) -> Prepared:
    rng = np.random.default_rng(21)
    cube, _ = expose(foreign_map(rng, (20, 24), 14.0, 14.3), HIDDEN, rng)
    known = [one for one in EFFECTS if one.name in names]
    flats = cube.take(np.arange(0, len(cube.image), 2))
    return prepare(flats, FringeModel.from_setup("ts8_e2v"), known, 20_000)


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepared_with(NAMES)


def selector_of(prepared: Prepared, *, generic: bool = True) -> Selector:
    known = [one for one in EFFECTS if one.name in NAMES]
    shifts = np.linspace(-0.06, 0.06, 5)
    guess = {"silicon_thickness.offset": 0.03}
    return Selector(
        prepared.problem, known, prepared.null, prepared.index, generic=generic, shifts_um=shifts, guess=guess
    )


def told(found: Hypothesis) -> dict[str, object]:
    fit = found.fit
    return {
        "names": found.names, "settings": fit.settings, "chi2": fit.chi2, "spread": fit.spread,
        "evidence": found.log_evidence, "channels": found.channels,
    }  # fmt: skip


def test_sets_of_a_small_sensor_are_as_recorded(prepared: Prepared, recorded: Record) -> None:
    selector = selector_of(prepared)
    one = selector.hypothesis(("silicon_thickness",))
    settled = selector.settled(one)
    pairs = likely_pairs(selector, prepared.null, NAMES)
    assert {name for pair in pairs for name in pair.names} == set(NAMES) - {"amplifier_gain"}  # it has many
    both = fitted_pair(selector, selector.null, pairs[0])
    assert pairs[0].gain == pytest.approx(prepared.null.chi2 - both.fit.chi2, rel=0.3)
    recorded({
        "one": told(one), "settled": told(selector.with_channels(settled)), "both": told(both),
        "pairs": [{"names": pair.names, "starts": pair.starts, "gain": pair.gain} for pair in pairs],
        "scores": [(each.name, each.gain, each.promise) for each in selector.score(one.fit, NAMES[1:])],
        "ends": selector.at_end_of_range(both.fit),
        "spots": [selector.evidence_of_spots(each) for each in (one, both)],
    })  # fmt: skip


def test_a_set_with_an_island_is_as_recorded(recorded: Record) -> None:
    rng = np.random.default_rng(12)
    void = {"void.centre_x": 17.6, "void.centre_y": 13.4, "void.radius": 7.0, "void.thickness": 190.0}
    cube, _ = expose(foreign_map(rng, (28, 32), 14.0, 14.7), void, rng)
    known = [one for one in EFFECTS if one.name == "void"]
    prepared = prepare(cube, FringeModel.from_setup("ts8_e2v"), known, 20_000)
    selector = Selector(
        prepared.problem, known, prepared.null, prepared.index, first_field=prepared.null.field
    )
    starts = selector.score(prepared.null, ["void"])
    found = selector.hypothesis(("void",))
    for key, value in void.items():
        assert found.fit.settings[key] == pytest.approx(value, rel=0.03), key
    recorded({"starts": [(one.gain, one.promise, one.start) for one in starts], "found": told(found)})


def test_few_pixels_are_judged_by_all_their_values(prepared: Prepared) -> None:
    """By what a fit leaves of them, beside the degrees of freedom that are left."""
    selector = selector_of(prepared, generic=False)
    (channel,) = (one for one in selector.null.channels if one.name == "all values")
    problem = prepared.problem
    free = int((problem.cells.weight > 0.0).sum()) - problem.basis.size - problem.level_basis.shape[1]
    assert channel.statistic == prepared.null.chi2
    assert channel.degrees == free
    (beside,) = selector.criticise(selector.hypothesis(("contrast_loss",)).fit)
    assert beside.degrees == free - 1
    assert selector.evidence_of_spots(selector.null) == 0.0


def test_evaluations_are_counted(prepared: Prepared) -> None:
    with count_evaluations() as count:
        fit_model(prepared.problem, (), np.zeros(0), prepared.null.field)
    with count_evaluations() as again:
        for _ in range(2):
            fit_model(prepared.problem, (), np.zeros(0), prepared.null.field)
    assert count.number >= 1
    assert again.number == 2 * count.number


def test_a_scan_of_sizes_goes_from_near_the_null_to_near_the_bound(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the side of the null on which the fit is: in steps of the prior, and in parts of the way to the bound."""
    selector = Selector(
        prepared.problem, [one for one in EFFECTS if one.name in NAMES], prepared.null, prepared.index
    )
    known = selector.hypothesis(("contrast_loss",))
    (item,) = known.fit.coordinates
    assert (item.null, item.low) == (1.0, 0.0)
    assert known.fit.settings[item.key] < 1.0
    begun: list[float] = []

    def fitted(problem: Problem, coordinates: Sequence[Coordinate], start: FloatArray, *rest, **more) -> Fit:
        begun.append(coordinates[0].value(start[0]))
        return fit_model(problem, coordinates, start, *rest, **more)

    monkeypatch.setattr(selection, "fit_model", fitted)
    found = selector.improved(("contrast_loss",), selector.null.fit, scan=True)
    steps = [1.0 - size * item.scale for size in (0.1, 0.3, 1.0, 3.0, 10.0)]
    expected = {*(size for size in steps if size >= 0.0), 0.7, 0.4, 0.1}
    np.testing.assert_allclose(begun, sorted(expected), atol=1e-9)
    assert found.fit.chi2 <= known.fit.chi2


def test_a_set_is_finished_as_recorded(prepared: Prepared, recorded: Record) -> None:
    """From an effect of many parameters in the place of the two that are there, by evidence alone."""
    selector = Selector(
        prepared.problem, [one for one in EFFECTS if one.name in NAMES], prepared.null, prepared.index
    )
    options = SearchOptions(consistency=1e-300, most_effects=3, refits=3, parents=2)
    sets = SetSearch(selector, options, lambda text: None, lambda found: found)
    first = selector.with_channels(selector.hypothesis(("amplifier_gain",)))
    steps = [sets.step(selector.null, first)]
    found = sets.finished(first, steps)
    recorded({
        "found": told(found), "steps": steps, "hopeless": [sets.is_hopeless(each) for each in (first, found)],
        "fitted": {" ".join(sorted(names)): each.fit.chi2 for names, each in selector.fitted.items()},
    })  # fmt: skip


def test_what_is_predicted_of_data_held_out_is_as_recorded(prepared: Prepared, recorded: Record) -> None:
    """Of wavelengths that are left out one by one or every fourth, and of blocks of cells."""
    problem = prepared.problem
    known = replace(problem, level_basis=np.ones((problem.cells.shape[0], 1)))
    (item,) = selector_of(prepared).coordinates["contrast_loss"]
    none, some = np.zeros((2, *problem.cells.shape[1:]), dtype=bool)
    some[4:10, 6:15] = True
    found = []
    for each, out, rich in ((problem, some, True), (problem, none, True), (known, none, False)):
        null = fit_model(each, (), np.zeros(0), prepared.null.field)
        final = fit_model(each, (item,), np.array([item.coordinate(0.95)]), prepared.null.field)
        found.append((validate(each, null, final, out, rich=rich), disagreement_size(each, final)))
    recorded(found)


def test_effects_that_shift_the_phase_are_looked_for_in_other_orders_as_recorded(recorded: Record) -> None:
    """A wrong scale of the wavelengths and a tilted beam look like another thickness, a thinner silicon does not."""
    names = ("wavelength_scale", "tilt", "silicon_thickness")
    prepared = prepared_with(names)
    effects = [one for one in EFFECTS if one.name in names]
    selector = Selector(prepared.problem, effects, prepared.null, prepared.index)
    sets = SetSearch(selector, SearchOptions(), lambda text: None, lambda found: found)
    singles = [selector.hypothesis((name,)) for name in names]
    assert [selector.shifts_phase(each) for each in singles] == [True, True, False]
    recorded({
        "singles": [told(each) for each in singles], "best": sets.best_so_far(),
        "judged with": told(sets.to_judge_with(singles)),
        "settled": told(selector.settled(singles[2])),
    })  # fmt: skip
