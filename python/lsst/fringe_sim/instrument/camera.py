"""Cameras as data: detectors, their place in the focal plane, their amplifiers.

Every number comes from a table or a YAML file in ``data/instrument``; a further camera of few sensors is one more
YAML file there (``monocam.yaml`` and ``hsc.yaml`` show the two forms), or anywhere else by `Camera.from_file`.

Coordinates are those of the assembled, trimmed CCD: ``[0, 0]`` is the lower-left pixel, ``y`` up.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..descriptions import is_file_name
from ..errors import InputError, OutOfRangeError, UnknownNameError, printable_name
from ..notebook import OneLine
from ..resources import first_line, list_resources, read_table, read_user_yaml, read_yaml
from .detector import Amplifier, Detector, RawSegment, refuse_misfits

__all__ = ["Amplifier", "Camera", "Detector", "RawSegment"]

VENDORS = {"E2V": "e2v", "ITL": "ITL", "HAMAMATSU": "Hamamatsu"}
"""Vendor as spelled here, by its upper-case spelling."""

READOUT_FROM_LSSTCAM = "median of LSSTCam"
"""Value of ``readout`` in a camera's YAML file for sensors whose own readout is not published."""


@dataclasses.dataclass(frozen=True, repr=False)
class Camera(OneLine):
    """A set of detectors under one name.

    Attributes
    ----------
    name : `str`
        ``lsstCam``, ``ts8``, ``monocam`` or ``hsc``.
    title : `str`
        One line for people.
    detectors : `tuple` [`Detector`, ...]
        Every detector, by number.
    """

    name: str
    title: str
    detectors: tuple[Detector, ...]

    @classmethod
    def from_name(cls, name: str) -> Camera:
        """Return one of the cameras shipped with the package; a name that ends in ``.yaml`` is that of a file.

        Raises
        ------
        UnknownNameError
            There is no such camera; near misses are offered.
        """
        return cls.from_file(name) if is_file_name(name) else _load_camera(name)

    @classmethod
    def from_file(cls, path: str | Path) -> Camera:
        """Return the camera of few sensors that a YAML file describes; it is named after the file.

        Raises
        ------
        InputError
            There is no such file, or it does not describe a camera.
        """
        file = Path(path)
        content = read_user_yaml(file, "camera file")
        try:
            if not isinstance(content, dict):
                raise InputError("content", type(content).__name__, "a mapping")
            return _from_mapping(printable_name("name of the camera", file.stem), content)
        except InputError as error:
            raise error.in_source(str(path)) from None
        except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
            reason = first_line(error)
            raise InputError(
                "content", reason, "the description of a camera in YAML", source=str(path)
            ) from None

    def vendor_of(self, name: str) -> str | None:
        """Vendor of a sensor that a file names, by serial number or by place in this camera, else in any.

        `None` if no table has the name, which a number is not, or if the cameras do not agree.
        """
        key = name.strip().removesuffix("-Dev")
        if not key or key.isdigit():
            return None
        for cameras in ((self,), map(_load_camera, _camera_names())):
            vendors = {one.detectors[one._index[key]].vendor for one in cameras if key in one._index}
            if vendors:
                return vendors.pop() if len(vendors) == 1 else None
        return VENDORS.get(key.partition("-")[0].upper())

    def are_two_sensors(self, first: str, second: str) -> bool:
        """Whether two names, serial numbers or places, are of two sensors of this camera, else of any.

        A name that no table has tells nothing, and a number neither.
        """
        keys = {name.strip().removesuffix("-Dev") for name in (first, second)}
        if any(key.isdigit() for key in keys):
            return False
        for camera in (self, *map(_load_camera, _camera_names())):
            if keys <= camera._index.keys():
                return len({camera._index[key] for key in keys}) == 2
        return False

    @property
    def science(self) -> tuple[Detector, ...]:
        """Detectors that take science images."""
        return tuple(detector for detector in self.detectors if detector.kind == "science")

    @property
    def rafts(self) -> tuple[str, ...]:
        """Names of the rafts, sorted."""
        return tuple(sorted({detector.raft for detector in self.detectors}))

    def detector(self, key: int | str) -> Detector:
        """Return one detector.

        Parameters
        ----------
        key : `int` or `str`
            Its number (``37`` or ``"37"``), its name (``"R11_S01"``) or its serial number
            (``"E2V-CCD250-321"``, also with the suffix ``-Dev`` of the older files). On TS8 the name of the
            place in LSSTCam that a sensor has today is understood too.

        Raises
        ------
        UnknownNameError
            The camera has no such detector; near misses are offered.
        """
        found = self._index.get(str(key).strip().removesuffix("-Dev"))
        if found is None:
            raise UnknownNameError("detector", key, self._names_like(str(key)), source=self.title)
        return self.detectors[found]

    def raft(self, name: str) -> tuple[Detector, ...]:
        """Return the detectors of one raft, by slot.

        Parameters
        ----------
        name : `str`
            Name of the raft (``"R11"``), or the serial number of its module (``"RTM-020"`` or
            ``"LCA-11021_RTM-020"``).

        Raises
        ------
        UnknownNameError
            The camera has no such raft; near misses are offered.
        """
        key = name.strip().removesuffix("-Dev")
        members = [d for d in self.detectors if key in _raft_names(d)]
        if not members and self.name != "lsstCam":
            members = self._of_lsstcam_raft(key)
        if not members:
            known = {known for d in self.detectors for known in _raft_names(d) if known}
            raise UnknownNameError("raft", name, known, source=self.title)
        return tuple(sorted(members, key=lambda detector: detector.slot))

    def _of_lsstcam_raft(self, name: str) -> list[Detector]:
        serials = {d.serial for d in _load_camera("lsstCam").detectors if d.raft == name}
        return [d for d in self.detectors if d.serial and d.serial in serials]

    def _names_like(self, key: str) -> list[str]:
        """Names to offer for a key that is not known: serial numbers if it looks like one."""
        looks_like_serial = key.upper().startswith(("E2V", "ITL"))
        return [d.serial if looks_like_serial else d.name for d in self.detectors]

    @functools.cached_property
    def _index(self) -> dict[str, int]:
        index: dict[str, int] = {}
        for position, detector in enumerate(self.detectors):
            for key in (str(detector.id), detector.name, detector.serial):
                if key:
                    index[key] = position
        if self.name == "ts8":
            for detector in _load_camera("lsstCam").science:
                if detector.serial in index:
                    index.setdefault(detector.name, index[detector.serial])
        return index


def _raft_names(detector: Detector) -> tuple[str, str, str]:
    module = detector.raft_serial.removesuffix("-Dev")
    return detector.raft, module, module.rpartition("_")[2]


def _camera_names() -> tuple[str, ...]:
    return (*_FROM_TABLES, *(file.removesuffix(".yaml") for file in list_resources("instrument", ".yaml")))


@functools.cache
def _load_camera(name: str) -> Camera:
    if name in _FROM_TABLES:
        return _FROM_TABLES[name]()
    if name in _camera_names():
        return _from_mapping(name, read_yaml("instrument", f"{name}.yaml"))
    raise UnknownNameError("camera", name, _camera_names())


def _vendor(spelling: str) -> str:
    try:
        return VENDORS[spelling.upper()]
    except KeyError:
        raise UnknownNameError("vendor", spelling, VENDORS.values()) from None


@dataclasses.dataclass(frozen=True)
class _Readout:
    """Gain, read noise and saturation level of one amplifier, and where they come from."""

    gain: float
    read_noise: float
    saturation: float


@functools.cache
def _lsst_layout(vendor: str) -> tuple[dict[str, Any], ...]:
    """Rows of the raw layout of one vendor, in the order of the HDUs."""
    table = read_table("instrument", "lsst_raw_amp_layout.ecsv")
    rows = [dict(zip(table.colnames, row, strict=True)) for row in table if row["vendor"] == vendor]
    if not rows:
        raise UnknownNameError("vendor", vendor, table["vendor"])
    return tuple(sorted(rows, key=lambda row: row["hdu"]))


def _lsst_amplifiers(vendor: str, readout: Mapping[str, _Readout]) -> tuple[Amplifier, ...]:
    """Amplifiers of an LSST sensor; those without readout (half of a wavefront sensor) are left out."""
    rows = [row for row in _lsst_layout(vendor) if row["amp"] in readout]
    bottom = min(int(row["ccd_y0"]) for row in rows)
    return tuple(
        Amplifier(
            name=str(row["amp"]),
            channel=int(row["channel"]),
            y0=int(row["ccd_y0"]) - bottom,
            x0=int(row["ccd_x0"]),
            height=int(row["data_h"]),
            width=int(row["data_w"]),
            flip_y=bool(row["flip_y"]),
            flip_x=bool(row["flip_x"]),
            gain=readout[str(row["amp"])].gain,
            read_noise=readout[str(row["amp"])].read_noise,
            saturation=readout[str(row["amp"])].saturation,
            raw=RawSegment(
                hdu=int(row["hdu"]),
                extname=str(row["extname"]),
                shape=(int(row["naxis2"]), int(row["naxis1"])),
                data_y0=int(row["data_y0"]),
                data_x0=int(row["data_x0"]),
            ),
        )
        for row in rows
    )


@functools.cache
def _lsstcam_readout() -> dict[int, dict[str, _Readout]]:
    table = read_table("instrument", "lsstcam_amps.ecsv")
    readout: dict[int, dict[str, _Readout]] = {}
    for row in table:
        readout.setdefault(int(row["detector"]), {})[str(row["amp"])] = _Readout(
            float(row["gain"]), float(row["read_noise"]), float(row["saturation"])
        )
    return readout


@functools.cache
def _median_readout(vendor: str) -> dict[str, _Readout]:
    """Median over the LSSTCam science sensors of one vendor, amplifier by amplifier."""
    sensors = [{amp.name: amp for amp in d.amplifiers} for d in _load_lsstcam().science if d.vendor == vendor]
    return {
        name: _Readout(
            float(np.median([amps[name].gain for amps in sensors])),
            float(np.median([amps[name].read_noise for amps in sensors])),
            float(np.median([amps[name].saturation for amps in sensors])),
        )
        for name in sensors[0]
    }


@functools.cache
def _load_lsstcam() -> Camera:
    table = read_table("instrument", "lsstcam_detectors.ecsv")
    readout = _lsstcam_readout()
    detectors = tuple(
        Detector(
            id=int(row["detector"]),
            name=str(row["name"]),
            raft=str(row["raft"]),
            slot=str(row["slot"]),
            vendor=_vendor(str(row["vendor"])),
            kind=str(row["kind"]),
            serial=str(row["ccd_serial"]),
            raft_serial=str(row["raft_serial"]),
            x_mm=float(row["x"]),
            y_mm=float(row["y"]),
            field_x_deg=float(row["field_x"]),
            field_y_deg=float(row["field_y"]),
            yaw_deg=float(row["yaw"]),
            pixel_um=10.0,
            amplifiers=_lsst_amplifiers(_vendor(str(row["vendor"])), readout[int(row["detector"])]),
            readout_source="LSSTCam electro-optical tests (data/instrument/lsstcam_amps.ecsv)",
        )
        for row in table
    )
    return Camera("lsstCam", "LSST Camera", detectors)


SENSOR_PITCH_MM = 42.25
"""Distance between neighbouring sensors of a raft (data/instrument/lsstcam_detectors.ecsv)."""


def _load_ts8() -> Camera:
    by_serial = {d.serial: d for d in _load_lsstcam().science}
    detectors = tuple(_ts8_detector(row, by_serial) for row in read_table("instrument", "ts8_detectors.ecsv"))
    return Camera("ts8", "LSST raft test stand TS8 (SLAC and BNL)", detectors)


def _ts8_detector(row: Mapping[str, Any], by_serial: Mapping[str, Detector]) -> Detector:
    """One sensor on the test stand: alone with its raft, on no telescope."""
    raft, slot, serial = str(row["raft"]), str(row["slot"]), str(row["ccd_serial"])
    vendor = _vendor(str(row["vendor"]))
    in_camera = by_serial.get(serial)
    if in_camera is not None:
        amplifiers = in_camera.amplifiers
        source = f"LSSTCam electro-optical tests of {in_camera.name}, the same sensor"
    else:
        amplifiers = _lsst_amplifiers(vendor, _median_readout(vendor))
        source = f"median of the {vendor} science sensors of LSSTCam"
    return Detector(
        id=int(row["detector"]),
        name=f"{raft}_{slot}",
        raft=raft,
        slot=slot,
        vendor=vendor,
        kind="science",
        serial=serial,
        raft_serial=str(row["raft_serial"]),
        x_mm=(int(slot[2]) - 1) * SENSOR_PITCH_MM,
        y_mm=(int(slot[1]) - 1) * SENSOR_PITCH_MM,
        field_x_deg=math.nan,
        field_y_deg=math.nan,
        yaw_deg=0.0,
        pixel_um=10.0,
        amplifiers=amplifiers,
        readout_source=source,
    )


def _from_mapping(name: str, content: Mapping[str, Any]) -> Camera:
    """Camera of few sensors, described in YAML."""
    try:
        amplifiers, source = _yaml_amplifiers(content)
        detectors = tuple(
            _yaml_detector(content, entry, amplifiers, source) for entry in content["detectors"]
        )
        title = str(content["title"])
    except KeyError as missing:
        raise InputError("entry", missing.args[0], "every entry that monocam.yaml or hsc.yaml has") from None
    for field in ("id", "name"):
        _refuse_twins(field, [getattr(detector, field) for detector in detectors])
    if not detectors:
        raise InputError("detectors", "none", "one detector or more")
    return Camera(name, title, detectors)


def _yaml_amplifiers(content: Mapping[str, Any]) -> tuple[tuple[Amplifier, ...], str]:
    if content.get("readout") == READOUT_FROM_LSSTCAM:
        vendor = _vendor(str(content["vendor"]))
        source = f"median of the {vendor} science sensors of LSSTCam"
        return _lsst_amplifiers(str(content["layout"]), _median_readout(vendor)), source
    amplifiers = tuple(
        Amplifier(
            name=str(amp["name"]),
            channel=channel,
            y0=int(amp["y0"]),
            x0=int(amp["x0"]),
            height=int(amp["height"]),
            width=int(amp["width"]),
            flip_y=False,
            flip_x=False,
            gain=_positive("gain", amp["gain"]),
            read_noise=_positive("read_noise", amp["read_noise"]),
            saturation=_positive("saturation", amp["saturation"]),
        )
        for channel, amp in enumerate(content["amplifiers"], start=1)
    )
    refuse_misfits(amplifiers)
    return amplifiers, str(content["source"])


def _yaml_detector(
    content: Mapping[str, Any], entry: Mapping[str, Any], amplifiers: tuple[Amplifier, ...], source: str
) -> Detector:
    return Detector(
        id=int(entry["id"]),
        name=str(entry["name"]),
        raft=str(entry.get("raft", "")),
        slot=str(entry.get("slot", "")),
        vendor=_own_vendor(content),
        kind="science",
        serial=str(entry.get("serial", "")),
        raft_serial=str(entry.get("raft_serial", "")),
        x_mm=float(entry.get("x_mm", 0.0)),
        y_mm=float(entry.get("y_mm", 0.0)),
        field_x_deg=float(entry.get("field_x_deg", 0.0)),
        field_y_deg=float(entry.get("field_y_deg", 0.0)),
        yaw_deg=0.0,
        pixel_um=_positive("pixel_um", content["pixel_um"]),
        amplifiers=amplifiers,
        readout_source=source,
    )


def _own_vendor(content: Mapping[str, Any]) -> str:
    """Vendor of the sensors of a camera, which may be any; known ones as they are spelled here."""
    name = printable_name("vendor", str(content["vendor"]).strip())
    return VENDORS.get(name.upper(), name)


def _positive(field: str, value: Any) -> float:
    number = float(value)
    if not (math.isfinite(number) and number > 0):
        raise OutOfRangeError(field, value, "a positive number")
    return number


def _refuse_twins(field: str, values: Sequence[Any]) -> None:
    for value in values:
        if values.count(value) > 1:
            raise InputError(f"{field} of a detector", value, "a value of its own for each detector")


_FROM_TABLES: dict[str, Callable[[], Camera]] = {"lsstCam": _load_lsstcam, "ts8": _load_ts8}
