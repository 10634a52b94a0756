"""Facts that a header states more than once, compared in one place: two statements are one, or the frame is refused.

How far two statements may lie apart stands beside each fact, with what it comes from.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import FrameFormatError, InputError, to_number

SETTING_NM = 1.0
"""What two readings of one setting of the monochromator may differ by; steps between flats are 5 nm or more."""

SAME_CELSIUS = 5.0
"""What a measured temperature may differ by from its set point or another sensor's [°C].

In headers of obs_lsst that state both (TS3, TS8) it is 0.1 to 0.5; flats of one series may lie as far apart as this.
"""

NO_READING_C = -200.0
"""Readings up to this are those of a sensor of temperature that is not connected, as -260 [°C]."""

SAME_SECONDS = 0.1  # Digits of exposure times: those of obs_lsst are repeated to a millisecond
Statement = tuple[str, Any]  # A keyword, with its HDU where that is not the first, and its value


@dataclass(frozen=True)
class Fact:
    """What several keywords, or one keyword in several HDUs, say of the same thing.

    ``apart``: difference of two numbers that are the same; `None` for words, which are equal. ``meaning``: a value as
    it is compared, `None` where it says nothing of the fact.
    """

    name: str
    keywords: tuple[str, ...]
    apart: float | None = None
    unit: str = ""
    because: str = ""
    meaning: Callable[[Any], Any] = lambda value: value

    def refuse_different(self, statements: Iterable[Statement], source: str) -> None:
        """Refuse statements that are not all the same; those without a value say nothing."""
        stated = [(said, value) for said, value in statements if value is not None]
        if len(stated) < 2:  # whoever uses it says what is wrong with it
            return
        meant = [(said, value, self._compared(said, value, source)) for said, value in stated]
        meant = [one for one in meant if one[2] is not None]
        for place, one in enumerate(meant):
            for other in meant[place + 1 :]:
                if self._differ(one[2], other[2]):
                    said = f"{one[0]} and {other[0]}"
                    raise FrameFormatError(said, f"{one[1]} and {other[1]}", self.allowed, source=source)

    @property
    def allowed(self) -> str:
        """What would be accepted."""
        within = "" if self.apart is None else f", stated within {self.apart:g} {self.unit}"
        return f"one {self.name}{within}"

    def _compared(self, said: str, value: Any, source: str) -> Any:
        if self.apart is None:
            return self.meaning(value)
        try:
            number = to_number(said, value, f"a number of {self.unit}", source=source)
        except InputError as error:
            raise FrameFormatError(said, value, error.allowed, source=source) from None
        return self.meaning(number)

    def _differ(self, one: Any, other: Any) -> bool:
        return bool(one != other) if self.apart is None else not abs(one - other) <= self.apart


def _word(value: Any) -> str:
    return str(value).upper()


def _bay(value: Any) -> str | None:
    return str(value) if re.fullmatch(r"R\d\d", str(value)) else None


RAW_FACTS = (
    Fact(
        "temperature of the sensor",
        ("CCDTEMP", "SENSTEMP", "TEMP_SET"),
        SAME_CELSIUS,
        "°C",
        "set point and measurement differ by 0.1 to 0.5 °C in real headers, flats of one series by up to 5; -200 and "
        "less is no reading",
        lambda celsius: celsius if celsius > NO_READING_C else None,
    ),
    Fact(
        "wavelength",
        ("MONOWL",),
        SETTING_NM,
        "nm",
        "two readings of one setting; flats are 5 nm or more apart. 0 and less is no setting",
        lambda number: number if number > 0 else None,
    ),
    Fact("exposure time", ("EXPTIME",), SAME_SECONDS, "s", "digits of the header"),
    Fact("type of image", ("IMGTYPE",), meaning=_word),
    Fact("slot of the sensor", ("SLOTNAME", "CCDSLOT"), meaning=_word),
    Fact("raft bay", ("RAFTBAY", "RAFTNAME"), because="RAFTNAME where it is R and two digits", meaning=_bay),
    Fact(
        "serial number",
        ("LSST_NUM",),
        because="without -Dev",
        meaning=lambda value: str(value).removesuffix("-Dev"),
    ),
    Fact("instrument", ("INSTRUME",), meaning=_word),
    Fact("filter", ("FILTER",), meaning=_word),
)
"""Of raw frames: in the primary header and in every other HDU."""


def refuse_contradictions(
    headers: Sequence[tuple[str, Mapping[str, Any]]],
    value: Callable[[Mapping[str, Any], str], Any],
    source: str,
    facts: Sequence[Fact] = RAW_FACTS,
) -> None:
    """Compare all that headers of one file say of each fact."""
    for fact in facts:
        statements = [
            (f"{keyword} of {name}" if name else keyword, found)
            for keyword in fact.keywords
            for name, header in headers
            if (found := value(header, keyword)) is not None
        ]
        fact.refuse_different(statements, source)


FILTER_RANGE_NM: Mapping[str, tuple[float, float]] = {
    "u": (320.0, 411.0),
    "g": (385.0, 571.0),
    "r": (526.0, 710.0),
    "i": (660.0, 841.0),
    "z": (796.0, 942.0),
    "y": (879.0, 1100.0),
    "SDSSz": (770.0, 1114.0),
}
"""Where a filter passes 0.001 of its most [nm]: LSST throughputs 1.9, SDSS 2010; of g, r, i the wider one."""

_NARROW_NM, _EDGE_NM = 25.0, 10.0
"""Half of the distance of two narrow filters of the camera's test stand; slope of a long-pass filter."""


def _passed(name: str) -> tuple[float, float] | None:
    """Wavelengths that a filter of this name passes [nm]; `None` of one whose name does not tell."""
    band = re.fullmatch(r"(?:SDSS)?([ugrizy])(?:_\d+)?", name, re.ASCII)
    if band:
        return FILTER_RANGE_NM.get(name, FILTER_RANGE_NM[band.group(1)])
    narrow, long_pass = re.fullmatch(r"(\d{3,4})nm", name), re.fullmatch(r"(\d{3,4})CutOn", name)
    if narrow:
        middle = float(narrow.group(1))
        return middle - _NARROW_NM, middle + _NARROW_NM
    return (float(long_pass.group(1)) - _EDGE_NM, 1e4) if long_pass else None


def refuse_other_filter(name: str, wavelength_nm: float | None, source: str) -> None:
    """Refuse a monochromatic flat whose light its filter would not have passed."""
    passed = _passed(name)
    if passed is None or wavelength_nm is None or passed[0] <= wavelength_nm <= passed[1]:
        return
    allowed = f"a filter that passes the {wavelength_nm:g} nm of MONOWL; {name} passes {passed[0]:g} to "
    raise FrameFormatError("FILTER", name, f"{allowed}{passed[1]:g} nm", source=source)
