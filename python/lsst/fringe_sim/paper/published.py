"""Numbers of the paper, and the comparison of a recomputed one with them."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import ResourceError, UnknownNameError
from ..resources import read_yaml


@dataclass(frozen=True)
class PublishedNumber:
    """One number of the paper."""

    item: str  # key
    place: str  # section, equation, table or figure
    # quantity, unit: what the number is, and its unit
    quantity: str
    unit: str
    # low, high: what the paper states, both alike unless it gives a range; NaN where it gives no number
    low: float
    high: float
    tolerance: float  # allowed on either side
    corrected: float = math.nan  # what is right where the paper errs, else NaN
    note: str = ""  # reason
    from_figure: bool = False  # measured in a figure rather than printed

    @classmethod
    def from_mapping(cls, content: Mapping[str, Any]) -> PublishedNumber:
        """Number from an entry of the table."""
        stated = content["published"]
        low, high = stated if isinstance(stated, list) else (stated, stated)
        number = cls(
            item=content["item"],
            place=content["place"],
            quantity=content["quantity"],
            unit=content["unit"],
            low=math.nan if low is None else float(low),
            high=math.nan if high is None else float(high),
            tolerance=float(content["tolerance"]),
            corrected=float(content.get("corrected", math.nan)),
            note=content.get("note", ""),
            from_figure=bool(content.get("figure", False)),
        )
        empty = math.isnan(number.low) and math.isnan(number.corrected)
        unexplained = not math.isnan(number.corrected) and not number.note
        if empty or unexplained or number.low > number.high or not number.tolerance >= 0.0:
            raise ResourceError(f"data/paper/published.yaml: {number.item} is not a number with a tolerance")
        return number

    @property
    def stated(self) -> str:
        """The number as the paper has it."""
        if math.isnan(self.low):
            return "–"
        if math.isinf(self.high):
            return f"> {self.low:g}"
        return f"{self.low:g}" if self.low == self.high else f"{self.low:g}–{self.high:g}"

    def compare(self, value: float, reason: str = "") -> Finding:
        """Compare a recomputed value; NaN means that it could not be computed, for the given reason."""
        if math.isnan(value):
            return Finding(self, value, "skipped", reason)
        if self.low - self.tolerance <= value <= self.high + self.tolerance:
            return Finding(self, value, "agrees", reason)
        right = not math.isnan(self.corrected) and abs(value - self.corrected) <= self.tolerance
        return Finding(self, value, "erratum" if right else "differs", reason)


@dataclass(frozen=True)
class Finding:
    """A recomputed number beside the published one."""

    number: PublishedNumber  # the published number
    value: float  # the recomputed one; NaN if it could not be computed
    # {"agrees", "erratum", "differs", "skipped"}: within the tolerance of the paper; of the corrected number,
    # where the paper errs; of neither; not computed
    status: str
    reason: str = ""  # why it was skipped
    # the same recomputed with silicon as measured in the cold, NaN if it was not; `value` has the paper's
    # constants
    cold: float = math.nan


@functools.lru_cache(maxsize=1)
def published_numbers() -> dict[str, PublishedNumber]:
    """All numbers by item, in the order of the paper.

    `ResourceError`: the table has an entry twice, or one that is not a number.
    """
    numbers: dict[str, PublishedNumber] = {}
    for content in read_yaml("paper", "published.yaml")["numbers"]:
        number = PublishedNumber.from_mapping(content)
        if number.item in numbers:
            raise ResourceError(f"data/paper/published.yaml has {number.item} twice")
        numbers[number.item] = number
    return numbers


def published_number(item: str) -> PublishedNumber:
    """One number. `UnknownNameError`: there is no such item."""
    numbers = published_numbers()
    if item not in numbers:
        raise UnknownNameError("number of the paper", item, tuple(numbers))
    return numbers[item]
