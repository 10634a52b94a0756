"""What every task that needs the fringe model is configured with: the set-up, the effects, the raft's own.

The same field names in every task make one override file serve them all: what a search for effects has named in
laboratory data reaches the fit, the sky and the templates through ``-C label:effects.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from lsst.pex.config import Config, ConfigDictField, DictField, Field, FieldValidationError
from lsst.pex.config.configDictField import ConfigDict

from ..effects import activate_effects, known_effects
from ..effects.active import settings_of
from ..errors import InputError
from ..instrument.detector import Detector
from ..model import FringeModel, Setup
from ..model.effects_override import refuse_other_effects
from ..model.provenance import model_cards
from .camera_config import CameraConfig

Value = TypeVar("Value")


@dataclass(frozen=True)
class ModelChoice:
    """Set-up and effects of one sensor."""

    setup: str  # name of the set-up
    effects: Mapping[str, float] = field(default_factory=dict)  # values by ``name.parameter``

    @property
    def applied_effects(self) -> dict[str, float]:
        """Effects that belong to this set-up: on the sky, not those of the laboratory."""
        on_sky = Setup.from_name(self.setup).kind == "sky"
        return settings_of(activate_effects(self.effects, known_effects()), on_sky=on_sky)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the effects that are configured and do not belong to this set-up."""
        return tuple(sorted(set(self.effects) - set(self.applied_effects)))

    def model(self, **kwargs: Any) -> FringeModel:
        """Fringe model with the effects that belong to the set-up; ``kwargs`` as of `FringeModel.from_setup`."""
        return FringeModel.from_setup(self.setup, self.applied_effects, **kwargs)

    def header(self) -> dict[str, Any]:
        """Header keywords that say what was modelled: set-up, effects, revisions of tables."""
        return dict(model_cards(self.setup, self.applied_effects))


class RaftConfig(Config):
    """What one raft has of its own."""

    setup = Field[str](optional=True, doc="Set-up of this raft, if not that of the task.")
    effects: DictField[str, float] = DictField(
        keytype=str,
        itemtype=float,
        default={},
        doc="Effects of this raft by 'name.parameter'; they win over those of the task.",
    )


class SensorConfig(Config):
    """What one sensor has of its own; its set-up is that of its raft, whose sensors come from one vendor."""

    effects: DictField[str, float] = DictField(
        keytype=str,
        itemtype=float,
        default={},
        doc="Effects of this sensor by 'name.parameter'; they win over those of raft and task.",
    )


class _MissingEntryError(InputError, KeyError):
    """There is no entry of this name; a `KeyError`, which mappings rely on."""


class _Entries(ConfigDict):
    """Entries by name; one that is not there is said, and how to make it."""

    def __getitem__(self, key: str) -> Any:
        try:
            return super().__getitem__(key)
        except KeyError:
            field, kind = self._field.name, self._field.itemtype.__name__
            there = ", ".join(map(str, self)) or "none yet"
            allowed = f"one with an entry ({there}); config.{field}[{key!r}] = {kind}() makes one"
            raise _MissingEntryError(f"name in {field}", key, allowed) from None


class _EntriesField(ConfigDictField):
    DictClass = _Entries


class FringeModelConfig(CameraConfig):
    """Set-up and effects, with overrides for single rafts and sensors."""

    task_name: ClassVar[str] = ""
    """Name of the task; by it a raft's override file finds the file of its camera."""

    setup = Field[str](
        default="ts8_e2v", doc="Set-up: sensor, temperature and light; a name, or the path of a YAML file."
    )
    effects: DictField[str, float] = DictField(
        keytype=str,
        itemtype=float,
        default={},
        doc="Physical effects that the set-up lacks: value by 'name.parameter', as 'bandwidth.fwhm'. "
        "Those of the laboratory's light and bench are left out on the sky.",
    )
    written_effects = Field[str](
        default="",
        doc="Names of the effects that an override of a search sets, and a hash of their values: one that was cut "
        "short or changed is refused. The override sets it.",
    )
    rafts: ConfigDictField = _EntriesField(
        keytype=str, itemtype=RaftConfig, default={}, doc="What single rafts have of their own, by raft."
    )
    sensors: ConfigDictField = _EntriesField(
        keytype=str,
        itemtype=SensorConfig,
        default={},
        doc="What single sensors have of their own, by name, as 'R11_S01'.",
    )

    def validate(self) -> None:
        """Refuse rafts, sensors, set-ups and effects that do not exist.

        Raises
        ------
        lsst.pex.config.FieldValidationError
            The field and what would be allowed are named.
        """
        super().validate()
        kind = type(self)
        try:
            refuse_other_effects(self.written_effects, dict(self.effects))
        except InputError as error:
            raise FieldValidationError(kind.written_effects, self, str(error)) from error
        self.check_rafts(kind.rafts, self.rafts)
        self.check_sensors(kind.sensors, self.sensors)
        self._check_model(kind.effects, "")
        for raft in self.rafts:
            self._check_model(kind.rafts, f"raft {raft}: ", raft)
        for sensor in self.sensors:
            self._check_model(kind.sensors, f"sensor {sensor}: ", _raft_of(sensor), sensor)

    def _check_model(self, field: Any, prefix: str, raft: str = "", sensor: str = "") -> None:
        try:
            self.choice(raft, sensor).model()
        except InputError as error:
            raise FieldValidationError(field, self, f"{prefix}{error}") from error

    def choice(self, raft: str = "", sensor: str = "") -> ModelChoice:
        """Set-up and effects of the task, of a raft, or of a sensor in it."""
        setup, effects = self.setup, dict(self.effects)
        if raft in self.rafts:
            setup = self.rafts[raft].setup or setup
            effects |= dict(self.rafts[raft].effects)
        if sensor in self.sensors:
            effects |= dict(self.sensors[sensor].effects)
        return ModelChoice(setup, effects)

    def choice_of(self, detector: Detector) -> ModelChoice:
        """Set-up and effects of a sensor; `InputError` if the set-up is for those of another vendor."""
        choice = self.choice(detector.raft, detector.name)
        Setup.from_name(choice.setup).refuse_other_vendor(detector)
        return choice

    @property
    def effects_by_raft(self) -> dict[str, dict[str, float]]:
        """Effects of the task under ``""``, and those of rafts, and of sensors, that differ; for contracts."""
        by_name = by_raft({raft: dict(self.choice(raft).effects) for raft in ("", *self.rafts)})
        for sensor in self.sensors:
            raft = _raft_of(sensor)
            own = dict(self.choice(raft, sensor).effects)
            if own != dict(self.choice(raft).effects):
                by_name[sensor] = own
        return by_name

    @property
    def setup_by_raft(self) -> dict[str, str]:
        """Set-up of the task under ``""``, and those of rafts that differ."""
        return by_raft({raft: self.choice(raft).setup for raft in ("", *self.rafts)})

    @property
    def sensor_by_raft(self) -> dict[str, tuple[str, str]]:
        """Stack and varying layer of the task under ``""``, and those of rafts that differ."""
        return by_raft({raft: _sensor(self.choice(raft).setup) for raft in ("", *self.rafts)})


def by_raft(values: Mapping[str, Value]) -> dict[str, Value]:
    """Drop the rafts that differ in nothing, so that two tasks agree if and only if their mappings are equal."""
    return {raft: value for raft, value in values.items() if not raft or value != values[""]}


def _raft_of(sensor: str) -> str:
    """Raft in the name of a sensor, as R11 in R11_S01."""
    return sensor.rpartition("_")[0]


def _sensor(setup: str) -> tuple[str, str]:
    found = Setup.from_name(setup)
    return found.stack.name, found.varying
