"""Models of the set-ups of the public data, with the effects under test in those sensors that have them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Protocol

from ...effects import known_effects
from ...instrument.setup import Setup
from ...model import FringeModel

LAB = "ts8_e2v"


EVERY_SENSOR = ("silicon_absorption", "silicon_constants", "diffuse_gate_side")
"""Effects of silicon and gates, which sensors of other vendors have, too; all others are of this stack."""


OTHER_VENDORS = ("hsc", "ts8_itl")


class Models(Protocol):
    """What makes the model of a set-up with the effects under test in it."""

    def __call__(self, setup: str, *, observable: str | None = None) -> FringeModel:
        """The model; the observable is that of the hypothesis if not given."""


def without_bench(settings: Mapping[str, float]) -> dict[str, float]:
    """Settings less those of effects of the bench, which a sensor does not take along."""
    bench = {effect.name for effect in known_effects() if effect.laboratory_only}
    return {key: value for key, value in settings.items() if key.partition(".")[0] not in bench}


def models_with(
    settings: Mapping[str, float], silicon: str | None = None, of_flats: str = "detection"
) -> Models:
    """Models with effects, each in the sensors that have it; ``of_flats``: observable of the laboratory."""

    def made(setup: str, *, observable: str | None = None) -> FringeModel:
        own = dict(settings) if setup == LAB else without_bench(settings)
        if setup in OTHER_VENDORS:
            own = {key: value for key, value in own.items() if key.partition(".")[0] in EVERY_SENSOR}
        seen = observable or (of_flats if setup == LAB else "detection")
        return _plane_layers(setup, silicon, seen).with_effects(own)

    return made


@functools.cache
def _plane_layers(setup: str, silicon: str | None, observable: str) -> FringeModel:
    """Model without effects; the beam of a telescope takes long to reduce."""
    chosen = Setup.from_name(setup)
    chosen = chosen if silicon is None else chosen.with_silicon(silicon)
    return FringeModel.from_setup(chosen, observable=observable)
