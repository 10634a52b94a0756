"""From raw laboratory frames, a fringe cube or a Butler repository to one `FringeCube` of one sensor."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import click

from ..algorithms.flat_prep import combine_biases, prepare_flat
from ..algorithms.flat_prep_options import FlatPrepOptions
from ..errors import FrameFormatError, FringeSimError, InputError
from ..instrument.camera import Camera, Detector
from ..instrument.raw_files import find_raw_files, pixel_digest
from ..instrument.raw_frame import RawFrame, RawMetadata, read_raw_metadata
from ..model import Setup
from ..products import FringeCube, FringeFlat, refuse_noiseless
from ..products.plain_flats import PlainImage, refuse_other_sensors, stack_plain_flats
from ..resources import complete_fits
from .bad_files import refuse_bad


class FrameHeader(Protocol):
    """What a series asks of a frame."""

    @property
    def source(self) -> str:
        """The file."""

    def require_wavelength_nm(self) -> float:
        """Wavelength of a flat [nm]."""


Header = TypeVar("Header", bound=FrameHeader)


@dataclass(frozen=True)
class Series(Generic[Header]):
    """Bias frames and flats of one sensor."""

    serial: str  # serial number or name of the sensor; empty if it is not stated
    # biases, flats: what the headers say; ``source`` of each is the file
    biases: tuple[Header, ...]
    flats: tuple[Header, ...]

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """Different wavelengths of the flats [nm], sorted."""
        return tuple(sorted({flat.require_wavelength_nm() for flat in self.flats}))

    @property
    def steps(self) -> int:
        """Number of frames that are read."""
        return len(self.biases) + len(self.flats)

    @property
    def paths(self) -> tuple[str, ...]:
        """Files of all frames."""
        return tuple(frame.source for frame in (*self.biases, *self.flats))

    def check(self, setup: Setup) -> None:
        """Refuse a set-up of sensors of another vendor, before the frames are read."""

    def missing_nm(self, setup: Setup) -> tuple[float, ...]:
        """Usual wavelengths of a set-up of which there is no flat [nm]."""
        return setup.missing_nm(self.wavelengths_nm)


class LabSeries(Series[RawMetadata]):
    """Raw frames, with an image for each amplifier."""

    def check(self, setup: Setup) -> None:
        """Refuse a set-up of sensors of another vendor, before the frames are read; say whose the gains are."""
        if not self._sensor(setup).serial and self.flats[0].serial:
            click.echo(f"{self.serial} is in no table: gains are those of {setup.detector}", err=True)

    def read(self, setup: Setup, options: FlatPrepOptions, advance: Callable[[], None]) -> FringeCube:
        """Prepare all frames, one at a time.

        ``setup``: decides the bandpass and the focal ratio where the headers do not.
        """
        seen: dict[str, str] = {}

        def frames(several: Sequence[RawMetadata]) -> Any:
            for one in several:
                frame = RawFrame.read(one.source)
                other = seen.setdefault(pixel_digest(frame), one.source)
                if other != one.source:
                    raise FrameFormatError(
                        "pixels", f"those of {other}", "light of its own", source=one.source
                    )
                yield frame
                advance()

        sensor = self._sensor(setup)
        bias = combine_biases(frames(self.biases), options) if self.biases else None

        def prepared(frame: RawFrame) -> FringeFlat:
            try:
                return prepare_flat(
                    frame,
                    bias,
                    sensor.cut_down(frame.detector_shape),
                    bandwidth_fwhm_nm=setup.bandwidth_fwhm_nm,
                    f_number=setup.f_number,
                    options=options,
                )
            except InputError as error:
                raise error.in_source(frame.metadata.source) from None

        flats = (_say_masked(prepared(frame)) for frame in frames(self.flats))
        return FringeCube.from_flats(flats, number=len(self.flats))

    def _sensor(self, setup: Setup) -> Detector:
        camera, first = Camera.from_name(setup.camera), self.flats[0]
        try:
            place = Camera.from_name(first.camera).detector(first.detector)
            sensor = camera.detector(self.serial) if first.serial else place
        except FringeSimError:
            # A sensor that is not in the tables is read with the gains of the set-up's own.
            own = camera.detector(setup.detector)
            vendor = camera.vendor_of(self.serial) or own.vendor
            sensor = replace(own, serial="", name=self.serial, vendor=vendor)
        setup.refuse_other_vendor(sensor)
        return sensor


class PlainSeries(Series[PlainImage]):
    """Images of a sensor without a layout of its own; what their headers do not say, the set-up does."""

    def check(self, setup: Setup) -> None:
        """Refuse a set-up of sensors of another vendor, where the headers name the sensor."""
        setup.refuse_vendor_of(self.serial, self.flats[0].source)

    def read(self, setup: Setup, _: FlatPrepOptions, advance: Callable[[], None]) -> FringeCube:
        """Stack all images; they are not smoothed."""
        return stack_plain_flats(
            (*self.biases, *self.flats),
            temperature_k=setup.temperature_k,
            bandwidth_fwhm_nm=setup.bandwidth_fwhm_nm,
            f_number=setup.f_number,
            advance=advance,
            note=lambda line: click.echo(line, err=True),
        )


def find_series(paths: Sequence[str], *, skip_bad: bool = False) -> LabSeries | PlainSeries:
    """Bias frames and flats among files, folders and patterns: raw frames, or one image in each file.

    ``skip_bad``: report files that cannot be read and go on without them.
    """
    files, refused = find_raw_files(paths)
    plain = _plain_images(files)
    if plain is not None:
        images, spoilt = plain
        refuse_bad([*refused, *spoilt], skip_bad=skip_bad, others=bool(images))
        return _plain_series(images)
    frames: list[RawMetadata] = []
    bad: list[FringeSimError] = []
    for file in files:
        try:
            frames.append(_readable(file))
        except FringeSimError as error:
            bad.append(error)
    refuse_bad([*refused, *bad], skip_bad=skip_bad, others=bool(frames))
    return _raw_series(_each_once(frames), paths)


def announced_series(paths: Sequence[str], setup: Setup, *, skip_bad: bool) -> LabSeries | PlainSeries:
    """What `find_series` finds, named; a set-up of another vendor's sensors is refused."""
    series = find_series(paths, skip_bad=skip_bad)
    found = ", ".join(f"{w:g}" for w in series.wavelengths_nm)
    click.echo(
        f"{series.serial or 'sensor'}: {len(series.biases)} bias frames, {len(series.flats)} flats at {found} nm",
        err=True,
    )
    series.check(setup)
    return series


def _plain_images(files: Sequence[str]) -> tuple[list[PlainImage], list[FringeSimError]] | None:
    """Images and what is wrong with other files; `None` if there are none, or a file that is no plain image.

    Those that cannot be read do not decide what the others are.
    """
    images: list[PlainImage] = []
    bad: list[FringeSimError] = []
    for file in files:
        try:
            image = PlainImage.read(file)
        except FringeSimError as error:
            bad.append(error)
            continue
        if image is None:
            return None
        images.append(image)
    return (images, bad) if files else None


def _plain_series(images: Sequence[PlainImage]) -> PlainSeries:
    refuse_other_sensors(images)
    flats = sorted((image for image in images if image.kind == "flat"), key=PlainImage.require_wavelength_nm)
    biases = tuple(image for image in images if image.kind == "bias")
    if len(biases) + len(flats) < len(images):
        others = ", ".join(image.source for image in images if image.kind not in ("bias", "flat"))
        click.echo(f"neither flats nor bias images, left out: {others}", err=True)
    name = next((flat.detector for flat in flats if flat.detector), "")
    click.echo(
        "plain flats" + ("" if biases else ", taken as bias-subtracted: there are no bias images"), err=True
    )
    return PlainSeries(name, biases, tuple(flats))


def _raw_series(frames: Sequence[RawMetadata], paths: Sequence[str]) -> LabSeries:
    for note in dict.fromkeys(note for frame in frames for note in frame.notes):
        click.echo(note, err=True)
    flats = [frame for frame in frames if frame.observation_type == "flat"]
    if not flats:
        kinds = ", ".join(sorted({frame.observation_type for frame in frames})) or "no frame"
        raise InputError("flats", kinds, "one flat or more (IMGTYPE FLAT)", source=" ".join(paths))
    serials = sorted({_sensor_name(frame) for frame in flats})
    if len(serials) > 1:
        raise InputError("sensors", ", ".join(serials), "frames of one sensor", source=" ".join(paths))
    _refuse_other_cameras(flats, paths)
    flats.sort(key=lambda frame: (frame.require_wavelength_nm(), frame.exposure_id))
    biases = [
        frame for frame in frames if frame.observation_type == "bias" and _sensor_name(frame) == serials[0]
    ]
    _say_left_out(frames, [*biases, *flats])
    return LabSeries(serials[0], tuple(biases), tuple(flats))


def _sensor_name(frame: RawMetadata) -> str:
    """Serial number, or the place where the header states none."""
    return frame.serial or f"{frame.raft}_{frame.slot}"


def _say_left_out(frames: Sequence[RawMetadata], used: Sequence[RawMetadata]) -> None:
    """Frames that are neither flats nor bias frames of the sensor."""
    sources = {frame.source for frame in used}
    others = [frame for frame in frames if frame.source not in sources]
    if others:
        kinds = Counter(f"{frame.observation_type} of {_sensor_name(frame)}" for frame in others)
        told = ", ".join(f"{number} {kind}" for kind, number in sorted(kinds.items()))
        click.echo(f"neither flats nor bias frames of this sensor, left out: {told}", err=True)


def _refuse_other_cameras(flats: Sequence[RawMetadata], paths: Sequence[str]) -> None:
    """One sensor has a number in each camera, and its exposures are numbered by the camera."""
    places = {
        (frame.camera, Camera.from_name(frame.camera).detector(frame.detector).name): frame for frame in flats
    }
    if len(places) > 1:
        told = "; ".join(f"{name} of {camera} in {frame.source}" for (camera, name), frame in places.items())
        allowed = "one camera and place for the frames of a sensor (INSTRUME, TSTAND, RAFTBAY, SLOTNAME)"
        raise InputError("sensors", told, allowed, source=" ".join(paths))


def _say_masked(flat: FringeFlat) -> FringeFlat:
    if flat.metadata["BADAMPS"] != "none":
        found = flat.metadata["BADAMPS"]
        click.echo(
            f"{flat.wavelength_nm:g} nm: amplifiers masked whole (dead, hot or saturated): {found}", err=True
        )
    return flat


def _each_once(frames: Sequence[RawMetadata]) -> list[RawMetadata]:
    """Frames without the copies of an exposure."""
    kept: dict[tuple[object, ...], RawMetadata] = {}
    copies = []
    for frame in frames:
        first = kept.setdefault((frame.camera, _sensor_name(frame), frame.exposure_id), frame)
        if first is frame:
            continue
        if pixel_digest(RawFrame.read(first.source)) != pixel_digest(RawFrame.read(frame.source)):
            allowed = f"an exposure of its own: {first.source} has the same with other pixels"
            raise FrameFormatError("exposure", frame.exposure_id, allowed, source=frame.source)
        copies.append(frame.source)
    if copies:
        click.echo(f"copies of other frames, not counted again: {', '.join(copies)}", err=True)
    return list(kept.values())


def read_cube(path: str, setup: Setup) -> FringeCube | None:
    """The fringe cube in a file, or `None` if the path is something else.

    `InputError`: it names a sensor of another vendor than that of the set-up, or says that it has no noise.
    """
    if not Path(path).is_file():
        return None
    with complete_fits(path) as hdus:
        if "EXPOSURES" not in hdus or "IMAGE" not in hdus:
            return None
    cube = of_vendor(FringeCube.read_fits(path), setup, path)
    refuse_noiseless(cube.metadata, path)
    return cube


def of_vendor(cube: FringeCube, setup: Setup, source: str) -> FringeCube:
    """The cube itself, if it names no sensor of another vendor than that of the set-up."""
    for name in (str(cube.metadata.get("SERIAL", "")), cube.detector):
        setup.refuse_vendor_of(name, source)
    return cube


def _readable(file: str) -> RawMetadata:
    metadata = read_raw_metadata(file)
    if metadata.observation_type == "flat":
        metadata.require_wavelength_nm()
        metadata.require_temperature_k()
    return metadata
