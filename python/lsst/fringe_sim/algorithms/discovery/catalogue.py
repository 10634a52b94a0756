"""The effects that a search can look for in its data, with their parameters and their price."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...effects import Effect
from ...effects.base import numbered
from ...errors import InputError
from ..inference import Coordinate, Forward, Problem, coordinates_of


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Effects that can be looked for, and why others are left out."""

    items: dict[str, tuple[Coordinate, ...]]
    effects: dict[str, Effect]
    left_out: dict[str, str]
    before: dict[str, str]  # of the second, third, ... of an effect the one before

    @classmethod
    def of(cls, effects: Sequence[Effect], problem: Problem, most: int = 1) -> Catalogue:
        """Coordinates of all effects of a catalogue that these exposures can see.

        ``most``: of an effect of which a sensor may have several.
        """
        forward = problem.forward
        items: dict[str, tuple[Coordinate, ...]] = {}
        left_out: dict[str, str] = {}
        before: dict[str, str] = {}
        for effect in effects:
            try:
                own = coordinates_of(effect, forward)
                _try(own, forward)
            except InputError as error:
                left_out[effect.name] = str(error)
                continue
            if len(own) >= problem.freedom:
                left_out[effect.name] = (
                    f"{len(own)} parameters, and {problem.freedom} values beyond what cells and levels have"
                )
                continue
            if effect.local and type(effect).propose is Effect.propose:
                left_out[effect.name] = "a place that no derivative leads to, and it proposes none"
                continue
            items[effect.name], last = own, effect
            for number in range(2, most + 1) if effect.several else ():
                another = numbered(effect, number)
                items[another.name] = tuple(replace(item, effect=another.name) for item in own)
                effects, before, last = (*effects, another), {**before, another.name: last.name}, another
        return cls(items, {effect.name: effect for effect in effects}, left_out, before)

    @property
    def price(self) -> float:
        """Log of the odds against any one effect before the data are seen."""
        return math.log(max(len(self.items) - len(self.before), 2))

    def may_add(self, name: str, effects: Sequence[str]) -> bool:
        """Whether an effect can be one more of a set."""
        return name not in effects and self.before.get(name, name) in (name, *effects)

    def may_leave(self, names: Sequence[str], effects: Sequence[str]) -> bool:
        """Whether a set without some members is another one, without the second of an effect whose first is gone."""
        return all(self.before.get(other) not in names for other in effects if other not in names)


def _try(items: tuple[Coordinate, ...], forward: Forward) -> None:
    """Raise what an effect raises on these data."""
    middle = np.full(forward.shape.gradient.shape[1], 0.5 * sum(forward.range_um))
    forward.predict({item.key: item.null + item.difference(item.null) for item in items[:1]}, middle)
