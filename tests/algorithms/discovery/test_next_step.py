"""Which flats to take next, beside flats of many pixels and of one."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import next_step
from lsst.fringe_sim.algorithms.discovery.cells import CellData
from lsst.fringe_sim.algorithms.discovery.next_step import flats_ranked, with_next_measurements
from lsst.fringe_sim.algorithms.discovery.verdict import NamedEffect, ParameterValue
from lsst.fringe_sim.algorithms.next_measurement import RankedMeasurement
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import FringeModel

FLATS = np.linspace(885.0, 985.0, 5)
RIVALS = {"roughness": {"sigma": 60.0}}


def named(*ambiguous: str) -> NamedEffect:
    parameters = {"factor": ParameterValue(0.5, 0.01, "")}
    return NamedEffect("contrast_loss", parameters, 0.99, ambiguous, "", 1.0, 20.0)


def cells_of(side: int) -> CellData:
    places = np.arange(side, dtype=float)
    geometry = ImageGeometry((side, side), places, places, FLATS, np.full(len(FLATS), 2e4))
    shape = (len(FLATS), side, side)
    return CellData(np.ones(shape), np.full(shape, 2e4), geometry, 1)


@pytest.fixture(scope="module")
def usual() -> tuple[RankedMeasurement, ...]:
    """What is asked of flats of many pixels."""
    effect, model = named("roughness"), FringeModel.from_setup("ts8_e2v")
    return flats_ranked(effect, RIVALS, [effect], model, cells_of(6), (13.0, 14.0), EFFECTS)


@pytest.mark.parametrize(("side", "gain"), [(1, 100.0), (4, 25.0), (200, 1.0)])
def test_of_a_few_pixels_more_are_a_measurement(
    usual: tuple[RankedMeasurement, ...], side: int, gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    effect, model = named("roughness"), FringeModel.from_setup("ts8_e2v")
    monkeypatch.setattr(next_step, "rank_measurements", lambda *args, **options: usual)
    few = flats_ranked(effect, RIVALS, [effect], model, cells_of(side), (13.0, 14.0), EFFECTS, few=True)
    (more,) = (item for item in few if item.measurement.name == "more_pixels")
    assert len(few) == len(usual) + 1
    assert [item.separation for item in few] == sorted((item.separation for item in few), reverse=True)
    assert more.separation == pytest.approx(gain * usual[0].pairs[0].separation_now)
    assert more.pairs[0].likeness_after == more.pairs[0].likeness_now
    assert more.measurement.title == "the same 5 flats of 100 x 100 pixels"


def test_effects_that_are_alone_ask_for_nothing() -> None:
    def refused(effect: object, rivals: object) -> tuple[()]:
        raise InputError("effect", 3, "within its bounds")

    alone, at_edge = named(), named("roughness")
    effects, rows = with_next_measurements(
        [alone, at_edge], {"contrast_loss": RIVALS}, refused, lambda text: None
    )
    assert effects[0] is alone
    assert effects[1].break_ambiguity == ("no forecast: effect is 3; allowed: within its bounds")
    assert rows == ()
