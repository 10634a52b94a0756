"""Instruments as the Butler knows them.

Names, detector numbers and physical filters are those that Rubin's own packages use, so that a fringe frame made
here has the data id under which a repository of real images will look for it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from lsst.daf.butler import DataCoordinate, DataId, FormatterV2
from lsst.daf.butler.registry import ConflictingDefinitionError
from lsst.pipe.base import Instrument

from ..errors import InputError, UnknownNameError
from ..instrument.camera import Camera
from ..instrument.detector import Detector

_LOG = logging.getLogger(__name__)

NO_FILTER = "none"  # Physical filter of frames without light and of white light

MONOCHROMATOR = "monochromator"
"""Physical filter of flats whose colour a monochromator sets; the wavelength is ``exposure.target_name``."""

LABORATORY_FILTERS = {NO_FILTER: "white", MONOCHROMATOR: "white"}

PURPOSES = {"science": "SCIENCE", "guider": "GUIDE", "wavefront": "WAVEFRONT"}
"""Purpose of a detector, as the Butler spells it, by its kind."""


class FringeInstrument(Instrument):
    """An instrument whose detectors come from a `Camera`."""

    name: ClassVar[str]
    camera_name: ClassVar[str]
    sky_filters: ClassVar[dict[str, str]]
    """Physical filters for the sky, with their band; the first is the y band."""
    utc_offset_h: ClassVar[float | None]
    """Local time minus UTC, hours; `None` on a test stand, which has no night."""
    exposure_max: ClassVar[int]

    configPaths: Sequence[str] = ("resource://lsst.fringe_sim/config",)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # What all instruments share comes first, what one of them changes afterwards.
        cls.configPaths = (
            *FringeInstrument.configPaths,
            f"{FringeInstrument.configPaths[0]}/{cls.camera_name}",
        )

    @classmethod
    def getName(cls) -> str:
        """Name of the instrument in data ids."""
        return cls.name

    @classmethod
    def camera(cls) -> Camera:
        """Return the camera: detectors, their places and their amplifiers."""
        return Camera.from_name(cls.camera_name)

    @classmethod
    def physical_filters(cls) -> dict[str, str]:
        """Return the band of every physical filter."""
        return {**cls.sky_filters, **LABORATORY_FILTERS}

    @classmethod
    def y_filter(cls) -> str | None:
        """Return the physical filter of the y band; `None` on a test stand."""
        return next((name for name, band in cls.sky_filters.items() if band == "y"), None)

    def applyConfigOverrides(self, name: str, config: Any) -> None:
        """Apply what the package knows of this instrument: its camera, and the files of `configPaths`."""
        if "camera" in config:
            config.camera = self.camera_name
        super().applyConfigOverrides(name, config)

    def getRawFormatter(self, dataId: DataId) -> type[FormatterV2]:
        """Formatter of raw frames."""
        from .formatters import RawFrameFormatter

        return RawFrameFormatter

    def register(self, registry: Any, *, update: bool = False) -> None:
        """Register the instrument, its detectors and its physical filters.

        Registering again changes nothing. Where the repository lacks the storage classes and formatters of this
        package, a warning says how to add them: an instrument alone does no harm there.

        Raises
        ------
        InputError
            The repository has this instrument with another definition, as it has when Rubin's own package
            registered it.
        """
        _warn_unprepared(registry)
        camera = self.camera()
        try:
            with registry.transaction():
                registry.syncDimensionData("instrument", self._instrument_record(camera), update=update)
                for detector in camera.detectors:
                    record = {
                        "instrument": self.getName(),
                        "id": detector.id,
                        "full_name": detector.name,
                        "name_in_raft": detector.slot,
                        "raft": detector.raft,
                        "purpose": PURPOSES[detector.kind],
                    }
                    registry.syncDimensionData("detector", record, update=update)
                for name, band in self.physical_filters().items():
                    self.register_filter(registry, name, band, update=update)
        except ConflictingDefinitionError as error:
            raise InputError(
                "instrument",
                self.getName(),
                f"an instrument that the repository does not define otherwise ({error}); "
                "use a repository of its own, or --update",
            ) from error

    def _instrument_record(self, camera: Camera) -> dict[str, Any]:
        return {
            "name": self.getName(),
            "detector_max": max(detector.id for detector in camera.detectors) + 1,
            "visit_max": self.exposure_max,
            "exposure_max": self.exposure_max,
            # The public name: it outlives a move of this module.
            "class_name": f"lsst.fringe_sim.{type(self).__name__}",
        }

    def register_filter(self, registry: Any, name: str, band: str, *, update: bool = False) -> None:
        """Register one physical filter."""
        record = {"instrument": self.getName(), "name": name, "band": band}
        registry.syncDimensionData("physical_filter", record, update=update)

    def sync_exposure(self, registry: Any, record: Mapping[str, Any]) -> None:
        """Make the record of an exposure, with those of its filter, night and group."""
        name, instrument = str(record["physical_filter"]), record["instrument"]
        self.register_filter(registry, name, self.band_of(name))
        registry.syncDimensionData("day_obs", {"instrument": instrument, "id": record["day_obs"]})
        registry.syncDimensionData("group", {"instrument": instrument, "name": record["group"]})
        registry.syncDimensionData("exposure", record)

    @classmethod
    def band_of(cls, physical_filter: str) -> str:
        """Return the band of a physical filter, also of one that is named like the registered ones (``y_04``).

        Raises
        ------
        InputError
            The name tells no band.
        """
        known = cls.physical_filters()
        if physical_filter in known:
            return known[physical_filter]
        match = re.match(r"(?:HSC-)?([ugrizyUGRIZY])(?:[_~2]|$)", physical_filter)
        if match is None:
            raise InputError("physical filter", physical_filter, f"{', '.join(known)}, or a name like y_04")
        return match.group(1).lower()


def _warn_unprepared(registry: Any) -> None:
    from .repository import unprepared  # an instrument is made far more often than it is registered

    # The middleware hands over the registry of the butler that it has opened, and nothing else.
    config = getattr(getattr(registry, "_butler", None), "_config", None)
    if config is not None:
        repo = "REPO" if config.configFile is None else config.configFile.dirname().ospath
        found = unprepared(config, repo)
        if found is not None:
            _LOG.warning("%s", found)


class LsstCamFringe(FringeInstrument):
    """The LSST Camera on the Simonyi telescope."""

    name = "LSSTCam"
    camera_name = "lsstCam"
    sky_filters: ClassVar[dict[str, str]] = {"y_10": "y"}
    utc_offset_h = -4.0
    exposure_max = 8_000_0000_00000


class Ts8Fringe(FringeInstrument):
    """The raft test stand TS8, at SLAC and at BNL."""

    name = "LSST-TS8"
    camera_name = "ts8"
    sky_filters: ClassVar[dict[str, str]] = {}
    utc_offset_h = None
    exposure_max = 1_000_000_000_000_000


class MonoCamFringe(FringeInstrument):
    """MonoCam, one e2v sensor on a 1.3 m telescope in Flagstaff."""

    name = "MonoCam"
    camera_name = "monocam"
    sky_filters: ClassVar[dict[str, str]] = {"y": "y"}
    utc_offset_h = -7.0
    exposure_max = 8_000_0000_00000


class HscFringe(FringeInstrument):
    """Hyper Suprime-Cam, represented by one detector on the optical axis."""

    name = "HSC"
    camera_name = "hsc"
    sky_filters: ClassVar[dict[str, str]] = {"HSC-Y": "y"}
    utc_offset_h = -10.0
    exposure_max = 8_000_0000_00000


INSTRUMENTS: dict[str, type[FringeInstrument]] = {
    cls.camera_name: cls for cls in (LsstCamFringe, Ts8Fringe, MonoCamFringe, HscFringe)
}
"""Instrument by the name of its camera."""


def sensor_of(data_id: DataCoordinate | Mapping[str, Any]) -> Detector:
    """Sensor of a data id, as the camera of its instrument knows it.

    By the name of the instrument, not by its class: a repository may have it from Rubin's own package.

    ``data_id``: with ``instrument`` and ``detector``.
    `UnknownNameError`: an instrument that this package does not know.
    """
    by_name = {cls.getName(): cls for cls in INSTRUMENTS.values()}
    name = str(data_id["instrument"])
    if name not in by_name:
        raise UnknownNameError("instrument", name, by_name)
    return by_name[name].camera().detector(int(data_id["detector"]))
