"""Choices that are made raft by raft, or sensor by sensor: the names must be those of the camera."""

from __future__ import annotations

from collections.abc import Iterable

from lsst.pex.config import Config, Field, FieldValidationError

from ..errors import InputError, UnknownNameError
from ..instrument.camera import Camera
from ..instrument.detector import Detector
from ..middleware.instruments import INSTRUMENTS


class CameraConfig(Config):
    """The camera whose rafts and sensors a configuration names.

    A raft that the camera does not have would silently change nothing: the run would take hours and be that of
    another configuration. It is refused with the configuration, before any graph is built.
    """

    camera = Field[str](
        default="",
        doc="Camera whose rafts and sensors are named in this configuration. The instrument of a pipeline sets "
        "it; without one, the names of all cameras are taken.",
    )

    def validate(self) -> None:
        """Refuse a camera that does not exist."""
        super().validate()
        if self.camera and self.camera not in INSTRUMENTS:
            error = UnknownNameError("camera", self.camera, INSTRUMENTS)
            raise FieldValidationError(CameraConfig.camera, self, str(error))

    def check_rafts(self, field: Field, names: Iterable[str]) -> None:
        """Refuse the name of a raft that the camera does not have."""
        self._check("raft", field, names, {detector.raft for detector in self._detectors()})

    def check_sensors(self, field: Field, names: Iterable[str]) -> None:
        """Refuse the name of a sensor that the camera does not have; as `check_rafts`."""
        self._check("detector", field, names, {detector.name for detector in self._detectors()})

    def _detectors(self) -> tuple[Detector, ...]:
        cameras = (self.camera,) if self.camera else tuple(INSTRUMENTS)
        return tuple(detector for name in cameras for detector in Camera.from_name(name).detectors)

    def _check(self, kind: str, field: Field, names: Iterable[str], known: set[str]) -> None:
        for name in names:
            if name not in known:
                raise FieldValidationError(field, self, str(self._refusal(kind, name, known)))

    def _refusal(self, kind: str, name: str, known: set[str]) -> InputError:
        source = self.camera
        here = _name_here(Camera.from_name(self.camera), kind, name) if self.camera else None
        if here:
            return InputError(kind, name, f"{here}, its name in data ids of this camera", source=source)
        return UnknownNameError(kind, name, known, source=source)


def _name_here(camera: Camera, kind: str, name: str) -> str | None:
    """Name of a raft or sensor that was called by its serial number, or by its place in another camera."""
    try:
        return camera.raft(name)[0].raft if kind == "raft" else camera.detector(name).name
    except UnknownNameError:
        return None
