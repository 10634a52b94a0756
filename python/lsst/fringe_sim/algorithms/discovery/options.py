"""Thresholds and sizes of a search."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...errors import OutOfRangeError, UnknownNameError, named_units
from .accuracy import MODEL_ACCURACY
from .selection import Hypothesis

CORES = ("present", "marginal")  # Searches that there are


@named_units
@dataclass(frozen=True)
class SearchOptions:
    """Thresholds and sizes of a search; the defaults were chosen on other seeds than those of the recorded challenge.

    Attributes
    ----------
    most_cells : `int`
        Cells that the data are averaged to, if the pattern allows it.
    significance : `float`
        Chance of noise below which the unchanged model is held to disagree.
    consistency : `float`
        Chance of noise above which a residual is held to be noise.
    least_evidence : `float`
        Gain in log evidence that an added effect must bring.
    class_width : `float`
        Difference in log evidence within which effects are one class.
    least_probability : `float`
        Probability of a class with which it is named.
    most_effects : `int`
        Largest number of effects tried together; three are told, and too many to be named (`outsiders_for_one`).
    refits : `int`
        Effects that are refitted in each round, best scores first; twice as many pairs.
    credit : `float`
        Log evidence that a set may lack if what it leaves is noise and what the other leaves is not.
    parents : `int`
        Sets of nearly equal evidence from which larger ones are made; of single effects all that were refitted, the
        others by the derivatives of what is added alone.
    heldout_fraction : `float`
        Part of the sensor that no selection sees.
    outsider_prior : `float`
        Prior probability of a cause that is not in the catalogue.
    core : {"present", "marginal"}
        Which search: the present one, or an experimental one on one likelihood, which cannot do everything yet and
        may change in any version.
    time_budget_s : `float`
        Time on the clock [s] after which the best answer so far is given; as long as it takes by default. A fifth of
        it is kept for the judgement of that answer on the data held out.
    model_accuracy : `float`
        Error of the fringes of the model at a wavelength, as a part of their amplitude and in radians of their phase;
        a disagreement that such errors may make is within the accuracy of the model. 0 for a model without error.
    """

    most_cells: int = 20_000
    significance: float = 1e-3
    consistency: float = 1e-3
    least_evidence: float = 6.0
    class_width: float = 5.0
    least_probability: float = 0.95
    most_effects: int = 3
    refits: int = 10
    credit: float = 20.0
    parents: int = 5
    heldout_fraction: float = 0.25
    outsider_prior: float = 0.15
    time_budget_s: float = math.inf
    model_accuracy: float = MODEL_ACCURACY
    core: str = "present"

    def __post_init__(self) -> None:
        if not self.time_budget_s > 0.0:
            raise OutOfRangeError("time budget [s]", self.time_budget_s, "a positive number")
        if not 0.0 <= self.model_accuracy < 1.0:
            raise OutOfRangeError("model accuracy", self.model_accuracy, "0 or more, below 1")

        if self.core not in CORES:
            raise UnknownNameError("core", self.core, CORES)

    def is_noise(self, found: Hypothesis) -> bool:
        """Whether a set leaves what noise may be."""
        return found.probability_of_noise > self.consistency
