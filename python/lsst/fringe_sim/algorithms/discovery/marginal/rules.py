"""The constants that decide, in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Rules:
    """Constants of the search on one likelihood, with where they come from."""

    # groups of effects that are refitted in each round, best scores first; the prototype had eight effects
    refits: int = 6
    # the same where no score reaches the price of an effect: what derivatives at null do not see. Sets with effects
    # are enlarged by their scores alone
    fewest_refits: int = 2
    beam: int = 3  # sets of each size that are enlarged
    # cosine of projected scores from which on two effects are of one group: one explains 0.95² of the other
    twin_cosine: float = 0.95
    class_width: float = 5.0  # difference in log evidence within which sets are one class: odds of 150
    least_probability: float = 0.95  # probability of a class with which it is named, as in the present search
    most_effects: int = 3  # largest set that is named, as in the present search
    # how often noise and slopes are judged again with one effect, as long as another one is the best; with more
    # effects they are judged once
    most_judged: int = 4
    most_turns: int = 4  # repeats of an effect by which a fit goes on, as long as each brings more
    # chance of noise of all critics together below which what is left is no noise, as in the present search
    significance: float = 1e-3
    # prior probability of a cause that is not in the catalogue, as in the present search
    outsider_prior: float = 0.15
    heldout_fraction: float = 0.25  # part of the sensor that no selection sees, as in the present search
    # part of what effects explain in which their form may be wrong, as in the present search
    imprecision: float = 0.01
    precision: float = (
        1e-4  # part of the fringes to which cells are described, as the test against pixels shows
    )
    # error of the thickness of a cell [rad of fringe phase] above which cells are made larger: half of its square
    # is lost of the fringes, and half of that is not in the linear model
    phase_error: float = 0.1
    # largest phase across a cell [rad] for which they are: three places describe it to 1e-3 of the fringes, which
    # are weak then
    cell_phase: float = 3.5
    # part of what an effect brings that derivatives promise; sets that cannot come near the best are not fitted,
    # and an effect that brings less is tried from elsewhere. Seen in the fits of four cases of the panel, where all
    # but a few kept within it
    least_of_promise: float = 0.8
    # departures, in prior scales, at which an effect of one parameter is tried where its linear step does not bring
    # what it promised, and to which its secants reach if it departs to one side or repeats
    sizes: tuple[float, ...] = (0.3, 1.0, 3.0)

    @property
    def sure(self) -> float:
        """Log odds with which something is as probable as what is named."""
        return math.log(self.least_probability / (1.0 - self.least_probability))
