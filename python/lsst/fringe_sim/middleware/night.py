"""Nights of sky exposures that exist as records only, for the simulation of sky fringes.

The exposures carry the time of the night, the exposure time, the filter and the airmass (as zenith angle);
their numbers lie where the LSST data acquisition puts simulated ones, so that they never meet a real exposure.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from astropy.time import Time

from lsst.daf.butler import Butler, Timespan
from lsst.daf.butler.registry import ConflictingDefinitionError

from ..errors import InputError, OutOfRangeError, UnknownNameError
from ..resources import number_of_values
from .instruments import INSTRUMENTS, FringeInstrument

SIMULATED_YEARS = 50_000_000
"""Added to the day in the number of an exposure: the place of controller S, for simulated exposures."""

OBSERVATION_REASON = "night sky"


@dataclasses.dataclass(frozen=True)
class NightPlan:
    """The sky exposures of one night."""

    date: datetime.date  # evening on which the night begins
    hours: tuple[float, ...]  # local time of each exposure, hours; after midnight it goes on beyond 24
    exposure_time_s: float = 30.0  # exposure time, seconds
    airmass: float = 1.2  # airmass of all exposures
    physical_filter: str | None = None  # filter; `None` for the instrument's y filter

    def __post_init__(self) -> None:
        if not self.hours or not all(12 <= hour < 36 for hour in self.hours):
            raise OutOfRangeError("hours", self.hours, "local hours from 12 to 36; 25 is 1 h after midnight")
        if len({_minute(hour) for hour in self.hours}) != len(self.hours):
            raise InputError("hours", self.hours, "exposures at least one minute apart")
        if not (math.isfinite(self.exposure_time_s) and self.exposure_time_s > 0):
            raise OutOfRangeError("exposure time", self.exposure_time_s, "a positive number of seconds")
        if not 1 <= self.airmass <= 40:
            raise OutOfRangeError("airmass", self.airmass, "1 to 40")


def parse_hours(text: str) -> tuple[float, ...]:
    """Read ``19:29`` or ``19:29:0.5``: first, last and step in local hours, the last one included.

    `InputError`: the text is something else, or the step does not lead from the first to the last.
    """
    allowed = "FIRST:LAST or FIRST:LAST:STEP in local hours, as 19:29 or 19:29:0.5"
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        raise InputError("hours", text, allowed) from None
    if len(parts) == 2:
        parts.append(1.0)
    if len(parts) != 3 or not all(map(math.isfinite, parts)) or parts[2] <= 0 or parts[1] < parts[0]:
        raise InputError("hours", text, allowed)
    first, last, step = parts
    return tuple(float(hour) for hour in first + step * np.arange(number_of_values(first, last, step)))


def hour_of_night(record: Any) -> float:
    """Local time at the middle of an exposure, hours; after midnight it goes on beyond 24.

    Parameters
    ----------
    record : `lsst.daf.butler.DimensionRecord`
        Record of an exposure.

    Raises
    ------
    InputError
        The exposure has no time, or its instrument no night.
    """
    if record.timespan is None or record.timespan.begin is None or record.timespan.end is None:
        raise InputError("timespan", record.timespan, "a begin and an end", source=f"exposure {record.id}")
    utc_offset_h = _utc_offset(_instrument(record.instrument))
    begin, end = record.timespan.begin, record.timespan.end
    middle = begin + (end - begin) / 2
    midnight = Time(_day(record.day_obs).isoformat(), scale="utc")
    # Leap seconds aside, local time is UTC moved by the zone.
    return float((middle.utc - midnight).to_value("hour") + utc_offset_h)


def airmass_of(record: Any) -> float | None:
    """Airmass of an exposure, from the zenith angle of its record; `None` where it has none."""
    if record.zenith_angle is None:
        return None
    return 1.0 / math.cos(math.radians(record.zenith_angle))


def define_night(
    butler: Butler, instrument: str, plans: Iterable[NightPlan], *, dry_run: bool = False
) -> list[dict[str, Any]]:
    """Register the exposures of one or more nights, and the run of raw images, which may stay empty.

    ``butler``: the repository, writeable unless ``dry_run``.
    ``instrument``: name of an instrument that the repository knows.
    ``plans``: the nights.
    ``dry_run``: return the records, but store nothing.
    Returns the exposure records.
    `UnknownNameError`: the repository does not know the instrument.
    `InputError`: the instrument has no night, the filter is not one of its sky filters, or the repository has
        one of the exposures with other properties.
    """
    known = [record.name for record in butler.query_dimension_records("instrument", explain=False)]
    if instrument not in known:
        raise UnknownNameError("instrument", instrument, known)
    cls = _instrument(instrument)
    records = [record for plan in plans for record in _records(cls, plan)]
    if not dry_run:
        # A graph needs an input collection, even one without a thickness map.
        butler.collections.register(cls().makeDefaultRawIngestRunName())
        with butler.transaction():
            for record in records:
                _store(butler, cls, record)
    return records


def _instrument(name: str) -> type[FringeInstrument]:
    by_name = {cls.getName(): cls for cls in INSTRUMENTS.values()}
    if name not in by_name:
        raise UnknownNameError("instrument", name, by_name)
    return by_name[name]


def _utc_offset(cls: type[FringeInstrument]) -> float:
    if cls.utc_offset_h is None:
        with_night = [c.getName() for c in INSTRUMENTS.values() if c.utc_offset_h is not None]
        raise InputError("instrument", cls.getName(), f"one on a telescope: {', '.join(with_night)}")
    return cls.utc_offset_h


def _minute(hour: float) -> int:
    """Minutes since local noon."""
    return round((hour - 12) * 60)


def _day(number: int) -> datetime.date:
    return datetime.datetime.strptime(str(number), "%Y%m%d").date()


def _records(cls: type[FringeInstrument], plan: NightPlan) -> list[dict[str, Any]]:
    offset = _utc_offset(cls)
    physical_filter = plan.physical_filter or cls.y_filter()
    if physical_filter not in cls.sky_filters:
        raise UnknownNameError("physical filter", physical_filter, cls.sky_filters, source=cls.getName())
    day_obs = int(plan.date.strftime("%Y%m%d"))
    midnight = datetime.datetime.combine(plan.date, datetime.time())
    return [
        _record(
            cls, plan, str(physical_filter), day_obs, hour, midnight + datetime.timedelta(hours=hour - offset)
        )
        for hour in plan.hours
    ]


def _record(
    cls: type[FringeInstrument],
    plan: NightPlan,
    physical_filter: str,
    day_obs: int,
    hour: float,
    middle_utc: datetime.datetime,
) -> dict[str, Any]:
    """Exposure record; the hour is that of the middle of the exposure."""
    sequence = _minute(hour)
    half = datetime.timedelta(seconds=plan.exposure_time_s / 2)
    begin, end = (Time(t, format="datetime", scale="utc").tai for t in (middle_utc - half, middle_utc + half))
    return {
        "instrument": cls.getName(),
        "id": (day_obs + SIMULATED_YEARS) * 100_000 + sequence,
        "obs_id": f"{cls.getName()}_S_{day_obs}_{sequence:06d}",
        "group": f"{day_obs}_night",
        "day_obs": day_obs,
        "physical_filter": physical_filter,
        "exposure_time": plan.exposure_time_s,
        "dark_time": plan.exposure_time_s,
        "observation_type": "science",
        "observation_reason": OBSERVATION_REASON,
        "seq_num": sequence,
        "seq_start": sequence,
        "seq_end": sequence,
        "target_name": f"night sky {hour:05.2f} h",
        "science_program": "night sky simulation",
        "zenith_angle": math.degrees(math.acos(1.0 / plan.airmass)),
        "has_simulated": True,
        "can_see_sky": True,
        "timespan": Timespan(begin, end),
    }


def _store(butler: Butler, cls: type[FringeInstrument], record: dict[str, Any]) -> None:
    try:
        cls().sync_exposure(butler.registry, record)
    except ConflictingDefinitionError as error:
        raise InputError(
            "exposure",
            record["id"],
            f"an hour of the night that the repository does not have with other properties ({error})",
        ) from error
