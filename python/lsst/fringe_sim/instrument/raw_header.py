"""Values of a FITS header, one keyword at a time; what is read is declared, for raw frames in `RAW_KEYWORDS`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from astropy.io import fits

from ..errors import FrameFormatError, InputError, to_number
from .header_keywords import RAW_KEYWORDS
from .stated_facts import SAME_SECONDS

_DECLARED = frozenset(keyword.name for keyword in RAW_KEYWORDS)


def header_value(header: Mapping[str, Any], keyword: str, declared: frozenset[str] | None = None) -> Any:
    """Value of a keyword; `None` if it is absent, undefined or blank.

    ``declared``: those that may be asked for; by default those of raw frames.
    """
    if keyword not in (_DECLARED if declared is None else declared):
        raise LookupError(f"{keyword} is not declared")
    try:
        value = header.get(keyword)
        if isinstance(header, fits.Header) and keyword in header and header.count(keyword) > 1:
            _refuse_different(header, keyword)
    except fits.VerifyError:
        raise FrameFormatError(keyword, "a card that cannot be parsed", "a value as FITS has it") from None
    if isinstance(value, fits.card.Undefined) or (isinstance(value, str) and not value.strip()):
        return None
    return value.strip() if isinstance(value, str) else value


def _differ(values: Sequence[Any]) -> bool:
    """Whether values are not all the same; one that is no number is like itself."""
    return any(value != values[0] and not (value != value and values[0] != values[0]) for value in values)


def _refuse_different(header: fits.Header, keyword: str) -> None:
    values = [header[keyword, number] for number in range(header.count(keyword))]
    if _differ(values):
        raise FrameFormatError(keyword, " and ".join(map(str, values)), "one value, not several that differ")


@dataclasses.dataclass(frozen=True)
class DeclaredHeader:
    """Header of a file, asked for values of a certain kind."""

    cards: Mapping[str, Any]
    source: str
    declared: frozenset[str] | None = None  # Keywords that may be asked for; by default those of raw frames
    # Headers of other HDUs, which may state a keyword too, but not differently
    others: tuple[Mapping[str, Any], ...] = ()

    def value(self, keyword: str) -> Any:
        """Value of a keyword; see `header_value`."""
        try:
            stated = [header_value(cards, keyword, self.declared) for cards in (self.cards, *self.others)]
        except FrameFormatError as error:
            raise error.in_source(self.source) from None
        values = [value for value in stated if value is not None]
        if _differ(values):
            raise self.refuse(keyword, " and ".join(map(str, values)), "one value, not several that differ")
        return values[0] if values else None

    def text(self, keyword: str) -> str:
        """Value as text, empty if there is none."""
        value = self.value(keyword)
        return "" if value is None else str(value)

    def number(self, keyword: str, value: Any, allowed: str, accept: Callable[[float], bool]) -> float:
        """``value`` as a finite number that is accepted, or an error that names the keyword."""
        try:
            number = to_number(keyword, value)
        except InputError:
            number = math.nan
        if not (math.isfinite(number) and accept(number)):
            raise self.refuse(keyword, value, allowed)
        return number

    def seconds_of_light(self, keyword: str, value: Any, kind: str) -> float:
        """An exposure time [s]; 0 of a bias, as in all seven headers of biases that obs_lsst has."""
        if kind == "bias":
            allowed = "0 s for a bias, which sees no light"
            return self.number(keyword, value, allowed, lambda s: 0.0 <= s <= SAME_SECONDS)
        return self.number(keyword, value, "seconds, 0 or more", lambda s: s >= 0)

    def refuse(self, keyword: str, value: Any, allowed: str) -> FrameFormatError:
        """An error over a value."""
        return FrameFormatError(keyword, value, allowed, source=self.source)
