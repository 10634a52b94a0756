"""Constants that decide in a search, in one place, with where they come from."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...deprecation import deprecated
from ...errors import OutOfRangeError, named_units

MODEL_ACCURACY = 0.014
"""Error of the fringes of the model at a wavelength, as a part of their amplitude and in radians of their phase.

It is that of the absorption of silicon at 1 µm. No other table of optical constants states an uncertainty there.
"""


@deprecated("1.1", "", removed_in="1.2", argument="consistency")
@deprecated("1.1", "", removed_in="1.2", argument="least_evidence")
@deprecated("1.1", "", removed_in="1.2", argument="credit")
@deprecated("1.1", "", removed_in="1.2", argument="parents")
@named_units
@dataclass(frozen=True)
class SearchOptions:
    """Thresholds and sizes of a search; the defaults were chosen on other seeds than those of the recorded challenge.

    Attributes
    ----------
    most_cells : `int`
        Cells that the data are averaged to, if the pattern allows it.
    significance : `float`
        Chance of noise, of all critics together, below which what is left is no noise.
    least_probability : `float`
        Probability of a class with which it is named.
    class_width : `float`
        Difference in log evidence within which sets are one class: odds of 150.
    most_effects : `int`
        Largest set that is tried; three are told, and too many to be named (`outsiders_for_one`).
    heldout_fraction : `float`
        Part of the sensor that no selection sees.
    outsider_prior : `float`
        Prior probability of a cause that is not in the catalogue.
    refits : `int`
        Groups of effects that are refitted in each round, best scores first.
    fewest_refits : `int`
        The same where no score reaches the price of an effect: what derivatives at null do not see. Sets with effects
        are enlarged by their scores alone.
    beam : `int`
        Sets of each size that are enlarged.
    twin_cosine : `float`
        Cosine of projected scores from which on two effects are of one group: one explains 0.95² of the other.
    most_judged : `int`
        How often noise and slopes are judged again with one effect, as long as another one is the best; with more
        effects they are judged once.
    most_turns : `int`
        Repeats of an effect by which a fit goes on, as long as each brings more.
    imprecision : `float`
        Part of what effects explain in which their form may be wrong.
    precision : `float`
        Part of the fringes to which cells are described, as the test against pixels shows.
    phase_error : `float`
        Error of the thickness of a cell [rad of fringe phase] above which cells are made larger: half of its square
        is lost of the fringes, and half of that is not in the linear model.
    cell_phase : `float`
        Largest phase across a cell [rad] for which they are: three places describe it to 1e-3 of the fringes, which
        are weak then.
    least_of_promise : `float`
        Part of what an effect brings that derivatives promise; sets that cannot come near the best are not fitted,
        and an effect that brings less is tried from elsewhere. Seen in the fits of four cases of the panel, where all
        but a few kept within it.
    sizes : `tuple` [`float`]
        Departures, in prior scales, at which an effect of one parameter is tried where its linear step does not bring
        what it promised, and to which its secants reach if it departs to one side or repeats.
    time_budget_s : `float`
        Time on the clock [s] after which the best answer so far is given; as long as it takes by default. A fifth of
        it is kept for the judgement of that answer on the data held out.
    model_accuracy : `float`
        Error of the fringes of the model at a wavelength, as a part of their amplitude and in radians of their phase;
        a disagreement that such errors may make is within the accuracy of the model. 0 for a model without error.
    """

    most_cells: int = 20_000
    significance: float = 1e-3
    least_probability: float = 0.95
    class_width: float = 5.0
    most_effects: int = 3
    heldout_fraction: float = 0.25
    outsider_prior: float = 0.15
    refits: int = 6
    fewest_refits: int = 2
    beam: int = 3
    twin_cosine: float = 0.95
    most_judged: int = 4
    most_turns: int = 4
    imprecision: float = 0.01
    precision: float = 1e-4
    phase_error: float = 0.1
    cell_phase: float = 3.5
    least_of_promise: float = 0.8
    sizes: tuple[float, ...] = (0.3, 1.0, 3.0)
    time_budget_s: float = math.inf
    model_accuracy: float = MODEL_ACCURACY

    def __post_init__(self) -> None:
        if not self.time_budget_s > 0.0:
            raise OutOfRangeError("time budget [s]", self.time_budget_s, "a positive number")
        if not 0.0 <= self.model_accuracy < 1.0:
            raise OutOfRangeError("model accuracy", self.model_accuracy, "0 or more, below 1")

    @property
    def sure(self) -> float:
        """Log odds with which something is as probable as what is named."""
        return math.log(self.least_probability / (1.0 - self.least_probability))
