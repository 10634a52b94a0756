"""What to measure next, so that effects that were left in one class come apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ...errors import FringeSimError
from ..next_measurement import Measurement, RankedMeasurement, break_ambiguity
from .cells import CellData
from .verdict import NamedEffect

MOST_RIVALS = 4  # Members of a class, likeliest first, that a measurement is asked to tell from the effect
MANY_PX = 100  # Side of the part of a sensor that is recommended instead of a few pixels [px]

Values = Mapping[str, Mapping[str, float]]
Ranking = Callable[[NamedEffect, Values], tuple[RankedMeasurement, ...]]
"""Ranks measurements by how well they tell an effect from others, of which the fitted values are given."""


def with_next_measurements(
    named: Sequence[NamedEffect], rivals: Mapping[str, Values], rank: Ranking, report: Callable[[str], None]
) -> tuple[tuple[NamedEffect, ...], tuple[dict[str, Any], ...]]:
    """Effects with the data that would decide between the members of their class, and all that was compared.

    ``rivals``: for each effect, the fitted values of the other members of its class. ``report``: called with a
    line of text at every stage.
    """
    result, table = [], []
    for effect in named:
        if not effect.ambiguous_with:
            result.append(effect)
            continue
        report(f"which measurement would tell {effect.name} from {', '.join(effect.ambiguous_with)}")
        others = {name: rivals[effect.name][name] for name in effect.ambiguous_with[:MOST_RIVALS]}
        ranked: tuple[RankedMeasurement, ...] = ()
        reason = "an effect couples neighbouring pixels, or is in a part of the sensor only"
        try:
            ranked = rank(effect, others)
        except FringeSimError as error:  # an effect at the edge of its bounds has no derivative there
            reason = str(error)
        text = break_ambiguity(ranked) or f"no forecast: {reason}"
        result.append(replace(effect, break_ambiguity=text))
        table += [_row(effect.name, item) for item in ranked]
    return tuple(result), tuple(table)


def more_pixels(ranked: RankedMeasurement, cells: CellData) -> RankedMeasurement:
    """The same flats of many pixels, whatever it is that sets the noise of one."""
    gain = max(MANY_PX / math.sqrt(float(cells.seen.sum()) * cells.cell_px**2), 1.0)
    pairs = [
        replace(pair, likeness_after=pair.likeness_now, separation_after=gain * pair.separation_now)
        for pair in ranked.pairs
    ]
    title = f"the same {cells.shape[0]} flats of {MANY_PX} x {MANY_PX} pixels"
    pairs.sort(key=lambda pair: pair.separation_after)
    return RankedMeasurement(Measurement("more_pixels", title), tuple(pairs))


def _row(name: str, item: RankedMeasurement) -> dict[str, Any]:
    return {
        "effect": name,
        "measurement": item.measurement.name,
        "title": item.measurement.title,
        "separation_sigma": item.separation,
        "decides": item.decides,
        "pairs": [
            {"other": pair.other, "likeness_now": pair.likeness_now, "likeness_after": pair.likeness_after,
             "separation_now": pair.separation_now, "separation_after": pair.separation_after}
            for pair in item.pairs
        ],
    }  # fmt: skip
