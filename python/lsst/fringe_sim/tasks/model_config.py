"""What every task that needs the fringe model is configured with: the set-up, the effects, the raft's own.

The same field names in every task make one override file serve them all: what a search for effects has named in
laboratory data reaches the fit, the sky and the templates through ``-C label:effects.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from lsst.pex.config import Config, ConfigDictField, DictField, Field, FieldValidationError

from ..effects import EFFECTS, activate_effects
from ..errors import InputError
from ..model import FringeModel, Setup

__all__ = ["FringeModelConfig", "ModelChoice", "RaftConfig"]

OF_THE_LABORATORY = frozenset(
    {
        "amplifier_gain",
        "amplifier_offset",
        "chromatic_illumination",
        "dark_pedestal",
        "ghost_pedestal",
        "illumination",
        "midline_step",
        "non_linearity",
        "temperature",
        "vignetting",
    }
)
"""Effects that stay in the laboratory, besides all those that act on its light.

A sensor takes its layers and the structure of its back side to the telescope, but not the temperature of the
cryostat, the lamp and the reflections of the bench, nor the calibration of that day's electronics.
"""


@dataclass(frozen=True)
class ModelChoice:
    """Set-up and effects of one sensor.

    Parameters
    ----------
    setup : `str`
        Name of the set-up.
    effects : `Mapping` [`str`, `float`]
        Values by ``name.parameter``.
    """

    setup: str
    effects: Mapping[str, float] = field(default_factory=dict)

    @property
    def applied_effects(self) -> dict[str, float]:
        """Effects that belong to this set-up: on the sky, not those of the laboratory's light and bench."""
        active = activate_effects(self.effects, EFFECTS)
        on_sky = Setup.from_name(self.setup).kind == "sky"
        return {
            f"{item.effect.name}.{parameter}": value
            for item in active
            for parameter, value in item.values.items()
            if not (
                on_sky and (item.effect.acts_on == "illumination" or item.effect.name in OF_THE_LABORATORY)
            )
        }

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the effects that are configured and do not belong to this set-up."""
        return tuple(sorted(set(self.effects) - set(self.applied_effects)))

    def model(self, **kwargs: Any) -> FringeModel:
        """Fringe model with the effects that belong to the set-up; ``kwargs`` as of `FringeModel.from_setup`."""
        return FringeModel.from_setup(self.setup, self.applied_effects, **kwargs)

    def header(self) -> dict[str, Any]:
        """Header keywords that say what was modelled."""
        cards: dict[str, Any] = {"SETUP": self.setup}
        for number, (name, value) in enumerate(sorted(self.applied_effects.items())):
            cards[f"EFFECT{number}"] = name
            cards[f"EFFVAL{number}"] = value
        return cards


class RaftConfig(Config):
    """What one raft has of its own."""

    setup: Field[str] = Field(dtype=str, optional=True, doc="Set-up of this raft, if not that of the task.")
    effects: DictField[str, float] = DictField(
        keytype=str,
        itemtype=float,
        default={},
        doc="Effects of this raft by 'name.parameter'; they win over those of the task.",
    )


class FringeModelConfig(Config):
    """Set-up and effects, with overrides for single rafts."""

    task_name: ClassVar[str] = ""
    """Name of the task; by it a raft's override file finds the file of its camera."""

    setup: Field[str] = Field(
        dtype=str, default="ts8_e2v", doc="Name of the set-up: sensor, temperature and light."
    )
    effects: DictField[str, float] = DictField(
        keytype=str,
        itemtype=float,
        default={},
        doc="Physical effects that the set-up lacks: value by 'name.parameter', as 'bandwidth.fwhm'. "
        "Those of the laboratory's light and bench are left out on the sky.",
    )
    rafts: ConfigDictField = ConfigDictField(
        keytype=str, itemtype=RaftConfig, default={}, doc="What single rafts have of their own, by raft."
    )

    def validate(self) -> None:
        """Refuse set-ups and effects that do not exist.

        Raises
        ------
        lsst.pex.config.FieldValidationError
            The field and what would be allowed are named.
        """
        super().validate()
        for raft in ("", *self.rafts):
            try:
                self.choice(raft).model()
            except InputError as error:
                own = type(self).rafts if raft else type(self).effects
                prefix = f"raft {raft}: " if raft else ""
                raise FieldValidationError(own, self, f"{prefix}{error}") from error

    def choice(self, raft: str = "") -> ModelChoice:
        """Set-up and effects of a sensor in the given raft."""
        effects = dict(self.effects)
        if raft not in self.rafts:
            return ModelChoice(self.setup, effects)
        own = self.rafts[raft]
        return ModelChoice(own.setup or self.setup, {**effects, **own.effects})

    def has_same_effects(self, other: FringeModelConfig) -> bool:
        """Whether two tasks are told of the same effects, raft by raft; for the contracts of pipelines."""
        return all(
            dict(self.choice(raft).effects) == dict(other.choice(raft).effects)
            for raft in {"", *self.rafts, *other.rafts}
        )

    def has_same_setups(self, flats: Any) -> bool:
        """Whether flats were prepared (`IsrFlatPrepConfig`) in the set-ups of this task, raft by raft."""
        return all(
            self.choice(raft).setup == flats.setup_of(raft).name
            for raft in {"", *self.rafts, *flats.raft_setups}
        )

    def has_same_sensor(self, other: FringeModelConfig) -> bool:
        """Whether the set-ups of two tasks have the same stack and the same varying layer, raft by raft."""
        return all(
            _sensor(self.choice(raft).setup) == _sensor(other.choice(raft).setup)
            for raft in {"", *self.rafts, *other.rafts}
        )


def _sensor(setup: str) -> tuple[str, str]:
    found = Setup.from_name(setup)
    return found.stack.name, found.varying
