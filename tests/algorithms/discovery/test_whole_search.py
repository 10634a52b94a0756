"""What a search concludes: held-out data, a stand-in, the accuracy of the model, what is left."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import SearchOptions, Verdict, discover
from lsst.fringe_sim.algorithms.discovery.accuracy import evidence_within, told_accuracy
from lsst.fringe_sim.algorithms.discovery.heldout import Unseen, judge_unseen
from lsst.fringe_sim.algorithms.discovery.lesson import in_all_data
from lsst.fringe_sim.algorithms.discovery.pace import Pace
from lsst.fringe_sim.algorithms.discovery.preparation import Prepared, prepare
from lsst.fringe_sim.algorithms.discovery.telling import size_of
from lsst.fringe_sim.algorithms.inference import Hypothesis, coordinates_of, fit
from lsst.fringe_sim.effects import EFFECTS, Effect
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS = np.linspace(880.0, 990.0, 8)
SIDE = 32
ELECTRONS = 20_000.0
Y, X = np.mgrid[:SIDE, :SIDE] / SIDE
PRIOR = SearchOptions().outsider_prior


def flats_of(effects: dict[str, float], contrast: np.ndarray | float = 1.0) -> np.ndarray:
    """Expected electrons of a small sensor."""
    thickness = 15.0 + 0.5 * X + 0.3 * Y**2 - 0.2 * X * Y
    model = FringeModel.from_setup("ts8_e2v", effects)
    flats = model.respond(model.system.flat_fields(WAVELENGTHS, 0.1), thickness, WAVELENGTHS)
    mean = flats.mean(axis=(1, 2), keepdims=True)
    return ELECTRONS * (1.0 + np.reshape(contrast, (-1, 1, 1)) * (flats / mean - 1.0))


def cube_of(rng: np.random.Generator, flats: np.ndarray) -> FringeCube:
    model = FringeModel.from_setup("ts8_e2v")
    image = rng.poisson(flats).astype(np.float32)
    rows = FlatExposures(
        WAVELENGTHS, np.full(8, model.setup.bandwidth_fwhm_nm), np.full(8, model.base_system.temperature_k)
    )
    return FringeCube(image, np.maximum(image, 1.0), np.zeros(image.shape, np.int32), rows, "electron")


def catalogue(*names: str) -> list[Effect]:
    return [one for one in EFFECTS if one.name in names]


def prepared_of(cube: FringeCube, *names: str) -> Prepared:
    model = FringeModel.from_setup("ts8_e2v")
    return prepare(cube, model, catalogue(*names), SearchOptions(), np.random.default_rng(5))


def fitted(prepared: Prepared, name: str, **values: float) -> Hypothesis:
    """An effect, fitted to the part searched."""
    forward, point = prepared.problem.forward, prepared.point
    items = coordinates_of(forward.effect_of(name), forward)
    settings = {f"{name}.{key}": value for key, value in values.items()}
    return fit((name,), items, point.moved(point.levels, point.thickness_um, settings))


def verdict_of(cube: FringeCube, *names: str, **limits: float) -> Verdict:
    options = SearchOptions(**limits)
    return discover(cube, "ts8_e2v", catalogue(*names), rng=np.random.default_rng(5), options=options)


# Data held out -----------------------------------------------------------------------------------------------


@pytest.mark.rng("an effect in the part searched alone")
def test_selection_does_not_see_an_effect_in_the_part_held_out(rng: np.random.Generator) -> None:
    """With it there the effect has its name; without it the same choice is made, and refused."""
    names = ("contrast_loss", "roughness", "vignetting")
    hidden = {"contrast_loss.factor": 0.9}
    state = rng.bit_generator.state
    with_it = cube_of(rng, flats_of(hidden))
    rng.bit_generator.state = state
    without = cube_of(rng, flats_of({}))
    held = prepared_of(with_it, *names).unseen.seen
    assert 0.1 < held.mean() < 0.4
    planted = replace(with_it, image=np.where(held, without.image, with_it.image))
    everywhere, outside = verdict_of(with_it, *names), verdict_of(planted, *names)
    assert everywhere.verdict == "named"
    (found,) = everywhere.effects
    assert "contrast_loss" in (found.name, *found.ambiguous_with)
    assert everywhere.gap.heldout_after < everywhere.gap.heldout_before
    assert outside.candidates == everywhere.candidates
    assert outside.steps == everywhere.steps
    assert outside.verdict == "unexplained"
    assert "data held out are not predicted better" in outside.unexplained["reason"]
    assert outside.unexplained["like"] == []


@pytest.mark.rng("what all data show")
def test_what_a_set_leaves_and_takes_off_is_judged_in_all_data(rng: np.random.Generator) -> None:
    """The part held out has the χ² of the rest; with waves in it alone a set has no name."""
    cube = cube_of(rng, flats_of({"contrast_loss.factor": 0.9}))
    prepared = prepared_of(cube, "contrast_loss")
    found = fitted(prepared, "contrast_loss", factor=0.9)
    null, whole = in_all_data(prepared, found)
    taken, held = prepared.null.chi2 - found.chi2, prepared.unseen.seen.ravel()
    assert null.chi2 - whole.chi2 > 1.15 * taken
    energy = whole.point.cell_energy
    assert energy[held].mean() == pytest.approx(energy[~held].mean(), rel=0.1)
    assert whole.values == pytest.approx(found.values, abs=3.0 * np.sqrt(found.covariance[0, 0]))
    wave = np.cos(0.7 * SIDE * X) * np.linspace(-0.02, 0.02, len(WAVELENGTHS))[:, np.newaxis, np.newaxis]
    planted = replace(cube, image=(cube.image * (1.0 + wave * prepared.unseen.seen)).astype(np.float32))
    verdict = verdict_of(planted, "contrast_loss")
    assert verdict.verdict == "unexplained"
    assert "with contrast_loss a residual remains" in verdict.unexplained["reason"]
    assert verdict_of(cube, "contrast_loss").verdict == "named"


@pytest.mark.rng("points in all data")
def test_the_part_held_out_sees_what_the_rest_sees(rng: np.random.Generator) -> None:
    """Pixels of these flats see a point: taken for areas, all data would have another offset."""
    prepared = prepared_of(cube_of(rng, flats_of({"wavelength_offset.offset": 1.5})), "wavelength_offset")
    assert not prepared.problem.forward.shape.area
    found = fitted(prepared, "wavelength_offset", offset=1.5)
    _, whole = in_all_data(prepared, found)
    assert not whole.point.problem.forward.shape.area
    assert whole.values == pytest.approx([1.5], abs=3.0 * np.sqrt(whole.covariance[0, 0]))


@pytest.fixture(scope="module")
def bright_stain() -> Prepared:
    """A stain that catalogue effects explain a part of."""
    rng = np.random.default_rng(12)
    stain = 0.02 * np.exp(-((X - 0.4) ** 2 + (Y - 0.55) ** 2) / 0.08)
    return prepared_of(cube_of(rng, flats_of({}) * (1.0 - stain)), "illumination", "vignetting")


def test_a_stand_in_beats_an_effect_that_is_not_the_cause(bright_stain: Prepared) -> None:
    """Light that falls off in a line takes off some of a stain, and a smooth shape of as many parameters more."""
    found = fitted(bright_stain, "illumination")
    unseen = judge_unseen(bright_stain, found)
    assert unseen is not None
    assert unseen.gain > 0.0
    assert unseen.stand_in_gain > unseen.gain + 10.0
    assert "pattern over the sensor" in unseen.why_not(PRIOR)


@pytest.mark.rng("a stand-in loses")
def test_a_stand_in_loses_against_the_cause(rng: np.random.Generator) -> None:
    prepared = prepared_of(cube_of(rng, flats_of({"bandwidth.fwhm": 2.6})), "bandwidth")
    unseen = judge_unseen(prepared, fitted(prepared, "bandwidth", fwhm=2.3))
    assert unseen is not None
    assert unseen.gain > unseen.stand_in_gain > 0.0
    # Two of eight wavelengths are predicted, in three quarters of the sensor.
    assert 0.3 * unseen.gain < unseen.waves_gain < 1.5 * unseen.gain
    assert unseen.why_not(PRIOR) == ""
    assert unseen.after_rms < unseen.before_rms


def test_an_effect_wins_at_equal_likelihood() -> None:
    """The prior odds of a cause outside the catalogue are against the stand-in."""
    odds = np.log((1.0 - PRIOR) / PRIOR)
    equal = Unseen(10.0, 1.0, 1.0, "a pattern", 10.0 + 0.99 * odds)
    assert equal.why_not(PRIOR) == ""
    assert "with as many parameters" in replace(equal, stand_in_gain=10.0 + 1.01 * odds).why_not(PRIOR)
    assert "wavelengths that are left out" in replace(equal, waves_gain=-10.1).why_not(PRIOR)
    assert replace(equal, waves_gain=-9.9).why_not(PRIOR) == ""
    assert Unseen(-0.1, 1.0, 1.0).why_not(PRIOR) == "data held out are not predicted better"


# Accuracy of the model ---------------------------------------------------------------------------------------


@pytest.mark.rng("contrasts of a table")
def test_errors_of_the_tables_are_within_the_accuracy_of_the_model(rng: np.random.Generator) -> None:
    """Contrasts that are off by a percent, each by itself, are explained by that accuracy, and by none."""
    contrast = 1.0 + 0.014 * rng.standard_normal(len(WAVELENGTHS))
    cube = cube_of(rng, 100.0 * flats_of({}, contrast))
    prepared = prepared_of(cube, "contrast_loss")
    model = FringeModel.from_setup("ts8_e2v")
    layer = model.system.stack.layers[model.system.stack.position(model.system.varying)]
    index = np.real(layer.medium.index(WAVELENGTHS, model.system.temperature_k))
    null, rules = prepared.null, SearchOptions()
    assert told_accuracy(null, null, index, rules, 1e-6, 0.0)["chance"] < 1e-9
    assert told_accuracy(null, null, index, rules, 0.014, 0.0)["chance"] > rules.significance
    # What a mean of these errors is, an effect need not be.
    loss = fitted(prepared, "contrast_loss", factor=0.99)
    told = told_accuracy(null, loss, index, rules, 0.014, 0.0)
    assert told["log_evidence_within"] < rules.sure
    assert told["log_evidence"] == loss.log_evidence - null.log_evidence
    assert evidence_within(null, 1e-9) == pytest.approx(0.0, abs=1e-3)
    verdict = verdict_of(cube, "vignetting")
    assert verdict.verdict == "no_discrepancy"
    assert verdict.within_accuracy
    assert verdict.learned == {}
    assert "no more than the tables" in verdict.unexplained["reason"]
    assert verdict_of(cube, "vignetting", model_accuracy=0.0).verdict == "unexplained"


@pytest.mark.rng("a pattern of all exposures has a size")
def test_what_all_exposures_share_has_its_size(rng: np.random.Generator) -> None:
    """A response that scatters takes it up, and must not hide it."""
    pattern = 0.02 * np.sign(np.sin(40.0 * np.pi * X))
    scatter = 0.005 * rng.standard_normal(X.shape)
    prepared = prepared_of(cube_of(rng, flats_of({}) * (1.0 + scatter)), "vignetting")
    assert size_of(prepared)["of_counts"] < 0.003
    null = prepared.null.point
    value = prepared.cells.value * (1.0 + pattern)
    data = replace(null.problem.data, value=value.reshape(len(value), -1))
    changed = replace(prepared, null=fit((), (), null.problem_with(data)))
    assert size_of(changed)["of_counts"] == pytest.approx(0.02, rel=0.1)


@pytest.mark.rng("another significance")
def test_the_significance_is_that_which_was_asked_for(rng: np.random.Generator) -> None:
    verdict = verdict_of(cube_of(rng, flats_of({})), "vignetting", significance=1.0 - 1e-9)
    assert verdict.verdict == "unexplained"
    assert verdict.global_probability > 1e-3


def test_a_round_tells_what_it_takes_still(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = {"now": 0.0}
    monkeypatch.setattr("time.monotonic", lambda: clock["now"])
    pace = Pace()
    pace.left = 3
    with pace.fit():
        clock["now"] = 2.0
    assert pace.text == "; at most 2 more in this round, about 4 s"
    for _ in range(3):
        with pace.fit():
            pass
    assert pace.text == ""
