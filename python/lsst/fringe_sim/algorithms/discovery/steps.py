"""Steps of the thickness that a local effect explains as well, where the data do not tell which it is."""

from __future__ import annotations

from ...effects.disc_search import find_step
from ..inference import Hypothesis
from .options import SearchOptions
from .scores import residuals_of
from .set_search import SetSearch


def told_of_steps(sets: SetSearch, found: Hypothesis, options: SearchOptions) -> list[str]:
    """Sentences for a verdict on local effects beside which the thickness of a set steps no more.

    That layers do not step is knowledge that no flat holds: only what no thickness of the cells explains counts as
    evidence for an effect.
    """
    if find_step(residuals_of(found.point)) is None:
        return []
    told = []
    for one in sets.scores(found):
        effect = sets.catalogue.effects[one.name]
        if one.start is None or not effect.local or one.gain < -options.class_width:
            continue
        if find_step(residuals_of(one.start)) is None:
            values = ", ".join(
                f"{item.parameter} {one.start.settings[item.key]:.3g} {item.unit}".strip()
                for item in sets.catalogue.items[one.name]
            )
            told.append(
                f"the thickness steps on an island as {one.name} would make it seem (about {values}): "
                "these data cannot tell the two apart"
            )
    return told
