"""What became of the cases of a challenge: results one by one, and the tables that sum them up."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from ..array_types import FloatArray
from ..errors import InputError
from ..files import table_text, write_together

CASE_KINDS = ("none", "one", "two", "outsider")

VISIBLE = 10.0  # Signal to noise from which an effect is asked for by name

SIGNAL_EDGES = (0.0, 3.0, 5.0, 10.0, 30.0, 100.0, math.inf)
"""Bins of signal to noise in the table of accuracy."""

PROBABILITY_EDGES = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)
"""Bins of the stated probability in the table of calibration."""


@dataclass(frozen=True)
class CaseResult:
    """What became of a case."""

    number: int  # Which case of which of `CASE_KINDS`
    kind: str
    truth: tuple[str, ...]  # Effects that were in, and those that were named
    values: dict[str, float]
    verdict: str
    found: tuple[str, ...]
    ambiguous: tuple[tuple[str, ...], ...]
    # Every effect that is in was named or is in the class of a named one, and nothing else was named. A
    # second effect below `VISIBLE` need not be named
    right_class: bool
    exact: bool  # The named effects are those that are in
    signal_to_noise: float  # Square root of what the true effects take off χ²
    weakest: float  # Signal to noise of the weakest of several effects beside the others, at their true sizes
    probability: float  # Smallest probability that was stated for a class; 0 if nothing was named
    # Probability, as stated, that every name itself is right and not only its class; 0 if nothing was named
    name_probability: float
    pulls: dict[str, float]  # (found - true) / σ by ``name.parameter``, for exact names
    shrinkage: float  # Part of the oracle's fall of the variance on held-out data that the search reached
    seconds: float

    def to_json(self) -> str:
        """One line of text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> CaseResult:
        """Result from a line that `to_json` wrote."""
        wanted = [item.name for item in fields(cls)]
        try:
            values = json.loads(text)
        except json.JSONDecodeError:
            values = None
        if not isinstance(values, dict) or sorted(values) != sorted(wanted):
            raise InputError("result of a case", text[:60], f"one line of JSON with {', '.join(wanted)}")
        for name in ("truth", "found"):
            values[name] = tuple(values[name])
        values["ambiguous"] = tuple(tuple(group) for group in values["ambiguous"])
        return cls(**values)


@dataclass(frozen=True)
class ChallengeResult:
    """All cases of a challenge with the numbers that sum them up."""

    seed: int
    cases: tuple[CaseResult, ...]
    options: dict[str, Any] = field(default_factory=dict)

    def of_kind(self, kind: str) -> list[CaseResult]:
        """Cases of a kind."""
        return [case for case in self.cases if case.kind == kind]

    def confusion(self) -> Table:
        """How often each truth led to each verdict."""
        counts: dict[tuple[str, str], int] = {}
        for case in self.cases:
            row = "+".join(case.truth) or "none"
            column = "+".join(sorted(case.found)) if case.found else case.verdict
            counts[row, column] = counts.get((row, column), 0) + 1
        rows = [(truth, found, number) for (truth, found), number in sorted(counts.items())]
        return Table(rows=rows or None, names=("truth", "found", "cases"), dtype=(str, str, int))

    def table(self) -> Table:
        """One row per case."""
        rows = [
            (c.number, c.kind, "+".join(c.truth), c.verdict, "+".join(c.found),
             " ".join("|".join(a) for a in c.ambiguous), c.right_class, c.exact, c.signal_to_noise, c.weakest,
             c.probability, c.name_probability, c.shrinkage, c.seconds)
            for c in self.cases
        ]  # fmt: skip
        names = ("number", "kind", "truth", "verdict", "found", "ambiguous_with", "right_class", "exact",
                 "signal_to_noise", "weakest", "probability", "name_probability", "shrinkage", "seconds")  # fmt: skip
        kinds = (int, str, str, str, str, str, bool, bool, *[float] * 6)
        return Table(rows=rows or None, names=names, dtype=kinds)

    def pulls(self) -> FloatArray:
        """All pulls of exactly named effects."""
        return np.array([pull for case in self.cases for pull in case.pulls.values()])

    def pull_weights(self) -> FloatArray:
        """Weights of the pulls, by which every named effect counts once.

        Parameters of one effect share their error: wavelengths of all exposures, for one, are off together.
        """
        effects = [
            (case.kind, case.number, name.partition(".")[0]) for case in self.cases for name in case.pulls
        ]
        number = Counter(effects)
        return np.array([1.0 / number[effect] for effect in effects])

    def summary(self) -> dict[str, Any]:
        """The numbers of the protocol."""
        null, one = self.of_kind("none"), self.of_kind("one")
        two, outside = self.of_kind("two"), self.of_kind("outsider")
        strong = [case for case in one if case.signal_to_noise >= VISIBLE]
        both = [case for case in two if case.weakest >= VISIBLE]
        faint = [case for case in two if not case.weakest >= VISIBLE]
        pulls, weights = self.pulls(), self.pull_weights()
        pull_mean, pull_std = _moments(pulls, weights)
        shrink = [case.shrinkage for case in strong if case.right_class and math.isfinite(case.shrinkage)]
        named = [case for case in self.cases if case.verdict == "named"]
        alone = [case for case in strong if case.verdict == "named" and not any(case.ambiguous)]
        return {
            "false_discoveries": [sum(case.verdict == "named" for case in null), len(null)],
            "no_discrepancy": [sum(case.verdict == "no_discrepancy" for case in null), len(null)],
            "one_right_class": [sum(case.right_class for case in strong), len(strong)],
            "one_exact": [sum(case.exact for case in strong), len(strong)],
            "one_exact_where_separable": [sum(case.exact for case in alone), len(alone)],
            "two_right_class": [sum(case.right_class for case in both), len(both)],
            "one_of_two_faint_right": [sum(case.right_class for case in faint), len(faint)],
            "outsiders_named": [sum(case.verdict == "named" for case in outside), len(outside)],
            "pulled_effects": round(weights.sum()),
            "pull_mean": pull_mean,
            "pull_median": float(np.median(pulls)) if pulls.size else math.nan,
            "pull_width": float(1.4826 * np.median(np.abs(pulls - np.median(pulls))))
            if pulls.size
            else math.nan,
            "pull_std": pull_std,
            "shrinkage_median": float(np.median(shrink)) if shrink else math.nan,
            "stated_probability": float(np.mean([case.probability for case in named])) if named else math.nan,
            "named_right": [sum(case.right_class for case in named), len(named)],
            "median_seconds": float(np.median([case.seconds for case in self.cases]))
            if self.cases
            else math.nan,
        }

    def accuracy(self) -> Table:
        """Part of single effects in the right class, and exactly named, against signal to noise."""
        rows = []
        for low, high in itertools.pairwise(SIGNAL_EDGES):
            inside = [c for c in self.of_kind("one") if low <= c.signal_to_noise < high]
            if inside:
                right, exact = (
                    np.mean([getattr(c, name) for c in inside]) for name in ("right_class", "exact")
                )
                rows.append((low, high, len(inside), float(right), float(exact)))
        names = ("signal_to_noise_from", "signal_to_noise_to", "cases", "right_class", "exact")
        return Table(rows=rows or None, names=names, dtype=(float, float, int, float, float))

    def calibration(self) -> Table:
        """Stated probability that the names are right against how often they are.

        Cases of all kinds in which something was named. The uncertainty is that of the part which was right.
        """
        named = [case for case in self.cases if case.verdict == "named"]
        rows = []
        for low, high in itertools.pairwise(PROBABILITY_EDGES):
            inside = [c for c in named if low < c.name_probability <= high]
            if inside:
                stated, right = (
                    float(np.mean(values))
                    for values in (
                        [c.name_probability for c in inside],
                        [set(c.found) <= set(c.truth) for c in inside],
                    )
                )
                # With one success and one failure added, none of few is not certainty.
                smooth = (right * len(inside) + 1.0) / (len(inside) + 2.0)
                rows.append(
                    (low, high, len(inside), stated, right, math.sqrt(smooth * (1.0 - smooth) / len(inside)))
                )
        names = ("stated_from", "stated_to", "cases", "stated", "right", "right_sigma")
        return Table(rows=rows or None, names=names, dtype=(float, float, int, float, float, float))

    def pull_table(self) -> Table:
        """One row for every parameter of an exactly named effect."""
        rows = [
            (c.number, c.kind, name, c.signal_to_noise, pull)
            for c in self.cases
            for name, pull in c.pulls.items()
        ]
        names = ("number", "kind", "parameter", "signal_to_noise", "pull")
        return Table(rows=rows or None, names=names, dtype=(int, str, str, float, float))

    def write(self, out_dir: str | Path) -> Path:
        """Write the tables of the challenge, that of the cases last; returns its path."""
        folder = Path(out_dir)
        folder.mkdir(parents=True, exist_ok=True)
        cases = self.table()
        cases.meta.update({"seed": self.seed, **self.summary()})
        tables = {
            "confusion": self.confusion(),
            "accuracy": self.accuracy(),
            "calibration": self.calibration(),
            "pulls": self.pull_table(),
            "challenge": cases,
        }
        return write_together(folder, {f"{name}.ecsv": table_text(table) for name, table in tables.items()})


def _moments(values: FloatArray, weights: FloatArray) -> tuple[float, float]:
    """Weighted mean and standard deviation; not a number where there are no values."""
    if not values.size:
        return math.nan, math.nan
    mean = float(np.average(values, weights=weights))
    return mean, math.sqrt(float(np.average((values - mean) ** 2, weights=weights)))
