"""Rounds of mean response and orders of a narrow sensor, with solutions that are made up."""

from typing import Any, cast

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.thickness_fit import solver as module
from lsst.fringe_sim.algorithms.thickness_fit.narrow_sensor import NarrowSensor
from lsst.fringe_sim.algorithms.thickness_fit.nuisances import Nuisances
from lsst.fringe_sim.algorithms.thickness_fit.solver import Solver, State

ORDER_UM, RANGE_UM, SHAPE = 0.3, (8.0, 13.0), (10, 12)


def relief(number: float) -> np.ndarray:
    """A map with one cell that is the farther off the larger the number is."""
    thickness = np.full(SHAPE, 10.0, dtype=np.float32)
    thickness[1, 2] += 0.3 * number * ORDER_UM
    return thickness


def state(number: float, joined: float, range_um: tuple[float, float]) -> State:
    """A solution of all cells; joined by phases alone it has another relief."""
    some, none = np.zeros(SHAPE, dtype=np.float32), cast(Any, None)
    return State(none, some, some, relief(number), none, none, "range", cast(Any, relief(joined)), range_um)


class MadeUpSensor:
    """The solutions of each round by their chi-square, and what is asked for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, rounds: list[list[float]], new: bool = True) -> None:
        self.rounds, self.new, self.away_um = rounds, new, 0.0
        self.asked: list[list[float]] = []
        self.earlier: list[list[float]] = []
        self.ranges: list[tuple[float, float]] = []
        self.relief = 0
        monkeypatch.setattr(module, "settle_narrow_sensor", self.settled)
        monkeypatch.setattr(module, "solve_orders", lambda cells, found, sure: found)
        monkeypatch.setattr(Solver, "_state", self.state)

    def settled(self, cells: object, templates: object, shapes: list[np.ndarray], *_: object, **options: Any):
        self.asked.append([round(float(np.ptp(shape)) / (0.3 * ORDER_UM), 3) for shape in shapes])
        self.earlier.append([one.chi2 for one in options["earlier"]])
        away_um = self.away_um if len(self.asked) == 1 else 0.0
        return [
            NarrowSensor(
                cast(Any, None), (9.0, 9.5), 0.2, 0.01, chi2, np.zeros(1, int), np.full(1, 10.0 + away_um)
            )
            for chi2 in self.rounds[len(self.asked) - 1]
        ]

    def state(self, cells: object, mean: object, nuisance: object, name: str, range_um: Any) -> State:
        self.relief += 2
        self.ranges.append(range_um)
        return state(self.relief if self.new else 0, self.relief + 1 if self.new else 0, range_um)

    def solve(self) -> State:
        solver = Solver(ORDER_UM, RANGE_UM, 1.0, Nuisances(), 1, cast(Any, None))
        return solver._narrow(cast(Any, None), state(0, 0, RANGE_UM))


@pytest.mark.parametrize(
    ("rounds", "away", "shapes"),
    [
        ([[100.0, 199.0], [60.0, 121.0]], 0.0, [1, 4]),
        ([[100.0, 201.0]], 0.0, [1]),
        ([[100.0, 201.0]], 0.24, [1]),
        ([[100.0], [60.0]], 0.26, [1, 2]),  # no rival, but the map of all cells has other orders
        ([[100.0] + [150.0] * 5, [60.0]], 0.0, [1, 8]),  # of the first four alone a mean is tried
        ([[100.0, 150.0], [99.5, 120.0]], 0.0, [1, 4]),  # a round that gains little is the last
        ([[100.0, 150.0], [98.5, 120.0], [98.0, 120.0]], 0.0, [1, 4, 4]),
        ([[100.0, 150.0], [80.0, 120.0], [60.0, 70.0], [40.0, 50.0], [20.0]], 0.0, [1, 4, 4, 4]),
    ],
)
def test_rivals_of_a_narrow_sensor_are_followed_as_long_as_that_helps(
    monkeypatch: pytest.MonkeyPatch, rounds: list[list[float]], away: float, shapes: list[int]
) -> None:
    sensor = MadeUpSensor(monkeypatch, rounds)
    sensor.away_um = away * ORDER_UM
    found = sensor.solve()
    assert [len(asked) for asked in sensor.asked] == shapes
    assert sensor.asked[0] == [0.0]
    assert len({shape for asked in sensor.asked for shape in asked}) == sum(shapes)
    assert sensor.earlier == [[], *rounds[: len(shapes) - 1]]
    assert set(sensor.ranges) == {(9.0 - 3.0 * ORDER_UM, 9.5 + 3.0 * ORDER_UM)}
    assert (found.common_slip, found.common_sigma_um, found.searched) == (0.2, 0.01, True)


@pytest.mark.parametrize(("rival", "means"), [(199.0, 2), (201.0, 1)])
def test_reliefs_that_are_known_are_not_asked_for_again(
    monkeypatch: pytest.MonkeyPatch, rival: float, means: int
) -> None:
    sensor = MadeUpSensor(monkeypatch, [[100.0, rival]], new=False)
    sensor.solve()
    assert sensor.asked == [[0.0]]
    assert len(sensor.ranges) == means
