"""Which data to take next where a class is left, and where there are only a few pixels."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.cells import CellData
from lsst.fringe_sim.algorithms.discovery.next_step import more_pixels, with_next_measurements
from lsst.fringe_sim.algorithms.discovery.verdict import NamedEffect, ParameterValue
from lsst.fringe_sim.algorithms.next_measurement import Measurement, PairForecast, RankedMeasurement
from lsst.fringe_sim.effects import ImageGeometry
from lsst.fringe_sim.errors import InputError

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


def ranked(name: str, *separations: float) -> RankedMeasurement:
    """A forecast for pairs that stand apart by one standard deviation more each now, and by so many then."""
    pairs = [
        PairForecast("contrast_loss", f"rival {number}", 0.9, 0.8, 1.0 + number, after)
        for number, after in enumerate(separations)
    ]
    return RankedMeasurement(Measurement(name, f"all of {name}"), tuple(pairs))


@pytest.mark.parametrize(("side", "gain"), [(1, 100.0), (4, 25.0), (200, 1.0)])
def test_the_same_of_many_pixels_knows_as_much_more_as_they_are_more(side: int, gain: float) -> None:
    more = more_pixels(ranked("repeat", 2.0, 3.0), cells_of(side))
    assert more.measurement == Measurement("more_pixels", "the same 5 flats of 100 x 100 pixels")
    assert [pair.separation_after for pair in more.pairs] == pytest.approx([gain, 2.0 * gain])
    assert [pair.separation_now for pair in more.pairs] == [1.0, 2.0]
    assert all(pair.likeness_after == pair.likeness_now for pair in more.pairs)
    assert more.separation == pytest.approx(gain)


def test_what_decides_is_told_of_an_effect_in_a_class() -> None:
    forecast = (ranked("repeat", 9.0), ranked("level", 1.0))
    effects, rows = with_next_measurements(
        [named("roughness")], {"contrast_loss": RIVALS}, lambda effect, rivals: forecast, lambda text: None
    )
    assert "all of repeat" in effects[0].break_ambiguity
    assert [(row["effect"], row["measurement"], row["separation_sigma"]) for row in rows] == [
        ("contrast_loss", "repeat", 9.0), ("contrast_loss", "level", 1.0)
    ]  # fmt: skip


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
