"""Set-ups: which sensor, at which temperature, under which light. Each is one YAML file, shipped or from outside."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..descriptions import Description, files_of, is_file_name, with_files_beside
from ..errors import InputError, UnknownNameError, named_units, printable_name
from ..notebook import InNotebook
from ..optics.illumination import (
    Beam,
    GaussianProfile,
    MonochromaticProfile,
    SpectralProfile,
    TriangularProfile,
)
from ..optics.media import read_media
from ..optics.stack import LayerStack
from ..resources import list_resources, read_user_yaml, read_yaml

if TYPE_CHECKING:
    from ..optics.system import OpticalSystem
    from .detector import Detector

__all__ = ["Setup", "setup_names"]

_PROFILES = {"gaussian": GaussianProfile, "triangular": TriangularProfile}
_BEAM_KEYS = {"collimated": set[str](), "cone": {"f_number", "obscuration"}, "telescope": {"telescope"}}


SAME_WAVELENGTH_NM = 1.0  # A flat within this distance of a usual wavelength counts as taken there
LONGEST_EXPOSURE_S = 1e6  # Exposures of the sky up to this are simulated [s]

WAVELENGTH_ACCURACY_NM = 0.5
"""Accuracy of a monochromator where the set-up states none [nm]; an assumption, of the order of what makers state."""


@named_units
@dataclass(frozen=True, repr=False)
class Setup(InNotebook):
    """Sensor, temperature and light of one instrument or test stand.

    Attributes
    ----------
    name, title, source : `str`
        Name, one line of description, and where the numbers come from.
    camera, detector : `str`
        Camera and default detector. Camera, bandpass and telescope are names of what is shipped, or YAML files.
    stack : `LayerStack`
        The sensor; in a file, ``silicon: Si_green2008`` takes its silicon from another table.
    varying : `str`
        Layer whose thickness varies over the sensor.
    thickness_range_um : `tuple` [`float`, `float`]
        Thicknesses of that layer that are searched [µm].
    temperature_k : `float`
        Temperature of the sensor [K].
    kind : {"monochromator", "sky"}
        What illuminates the sensor.
    bandwidth_fwhm_nm : `float`
        Width of the monochromator line [nm]; 0 on the sky, whose lines are listed.
    profile_name : `str`
        Shape of the line.
    wavelengths_nm : `tuple` [`float`, ...]
        Usual wavelengths of the flats [nm]; empty on the sky.
    beam_kind, f_number, obscuration, telescope
        The beam: parallel, a cone, or that of a telescope traced with batoid.
    bandpass : `str`
        Bandpass of the sky ("" in the laboratory).
    effective_area_m2, pixel_scale_arcsec, exposure_s, airmass : `float`
        Of a sky exposure; zero in the laboratory.
    wavelength_accuracy_nm : `float`
        Standard deviation of the wavelengths of the monochromator about what headers state [nm].
    laboratory_temperature_k : `float`, optional
        Of a sensor at a telescope: temperature at which its thickness was measured, where the map does not state it;
        that of the sensor if not given.
    files : `tuple` [`str`, ...]
        Files from outside that describe it, tables too; empty for a set-up that is shipped.
    """

    name: str
    title: str
    source: str
    camera: str
    detector: str
    stack: LayerStack
    varying: str
    thickness_range_um: tuple[float, float]
    temperature_k: float
    kind: str
    bandwidth_fwhm_nm: float
    profile_name: str
    wavelengths_nm: tuple[float, ...]
    beam_kind: str
    f_number: float
    obscuration: float
    telescope: str
    bandpass: str
    effective_area_m2: float
    pixel_scale_arcsec: float
    exposure_s: float
    airmass: float
    wavelength_accuracy_nm: float = WAVELENGTH_ACCURACY_NM
    laboratory_temperature_k: float | None = None
    files: tuple[str, ...] = ()

    @property
    def filter_name(self) -> str:
        """Name of the bandpass, also where a file describes it; "" in the laboratory."""
        return Path(self.bandpass).stem if is_file_name(self.bandpass) else self.bandpass

    @property
    def amplifier_grid(self) -> tuple[int, int]:
        """Rows and columns of amplifiers of the set-up's own sensor."""
        amplifiers = self.sensor().amplifiers
        return len({each.y0 for each in amplifiers}), len({each.x0 for each in amplifiers})

    def sensor(self, name: str | None = None) -> Detector:
        """A sensor of the set-up's camera, by default its own.

        Raises
        ------
        UnknownNameError
            The camera has none of this name.
        InputError
            It is of another vendor than the set-up is for.
        """
        from .camera import Camera

        detector = Camera.from_name(self.camera).detector(name or self.detector)
        self.refuse_other_vendor(detector)
        return detector

    def refuse_vendor_of(self, name: str, source: str) -> None:
        """Refuse a file that names a sensor of another vendor; a name that no table has tells none.

        Raises
        ------
        InputError
            See `refuse_other_vendor`.
        """
        from .camera import Camera

        vendor = Camera.from_name(self.camera).vendor_of(name)
        if vendor is not None:
            self._refuse_vendor(vendor, name, source)

    def refuse_other_vendor(self, detector: Detector) -> None:
        """Refuse a sensor of another vendor than the set-up's own, whose films are others.

        Raises
        ------
        InputError
            It is one; the message names the set-ups that are meant for it.
        """
        self._refuse_vendor(detector.vendor, detector.serial or detector.name, None)

    def _refuse_vendor(self, vendor: str, name: str, source: str | None) -> None:
        own = _vendor_of(self)
        if vendor != own:
            others = [
                name
                for name in setup_names()
                if (setup := _shipped(name)).kind == self.kind
                and setup.camera == self.camera
                and _vendor_of(setup) == vendor
            ]
            meant = " or ".join([f"a set-up for {vendor}", *others])
            allowed = f"one of {own}, which set-up {self.name} is for; or {meant}"
            raise InputError("sensor", f"{name} of {vendor}", allowed, source=source)

    def __repr__(self) -> str:
        """Name and description; `facts` has the numbers."""
        return f"Setup({self.name!r}, {self.title!r})"

    def facts(self) -> dict[str, Any]:
        """Sensor, temperature and light, with units."""
        low, high = self.thickness_range_um
        laboratory = self.kind == "monochromator"
        light = (
            f"monochromator, {self.bandwidth_fwhm_nm:g} nm" if laboratory else f"sky in {self.filter_name}"
        )
        return {
            "name": self.name,
            "title": self.title,
            "camera": Path(self.camera).stem,
            "stack": " / ".join(self.stack.names),
            "varying layer": f"{self.varying}, {low:g} to {high:g} µm",
            "temperature": f"{self.temperature_k:g} K",
            "light": f"{light}, {Path(self.telescope).stem or self.beam_kind}",
        }

    @classmethod
    def from_name(cls, name: str) -> Setup:
        """Set-up shipped with the package; a name that ends in ``.yaml`` is that of a file, as for `from_file`.

        Raises
        ------
        UnknownNameError
            There is no such set-up; near misses are offered.
        """
        if is_file_name(name):
            return cls.from_file(name)
        if name not in setup_names():
            raise UnknownNameError("set-up", name, setup_names())
        return _shipped(name)

    @classmethod
    def from_file(cls, path: str | Path) -> Setup:
        """Set-up described by a YAML file of the user, laid out like the shipped ones.

        ``camera``, ``stack``, ``illumination.bandpass`` and ``illumination.beam.telescope`` may name a YAML file
        each, and ``media`` one with further media. Their paths count from the folder of the set-up's file.

        Raises
        ------
        InputError
            The file is not such a description; the key at fault is named.
        """
        path = Path(path)
        content = with_files_beside(read_user_yaml(path, "set-up file"), path)
        try:
            setup = cls.from_mapping(path.stem, content, source_file=str(path))
            setup.sensor()
        except InputError as error:
            named = error.source is not None and Path(error.source).suffix
            raise (error if named else error.in_source(str(path))) from None
        return replace(setup, files=(str(path), *setup.files))

    @classmethod
    def from_mapping(cls, name: str, content: Any, *, source_file: str | None = None) -> Setup:
        """Set-up from the parsed content of a YAML file; errors as for `from_file`."""
        reader = Description(content, source_file or name)
        printable_name("name of the set-up", name, source=source_file)
        light = reader.section("illumination")
        kind = light.choice("kind", ("monochromator", "sky"))
        beam = light.section("beam")
        beam_kind = beam.choice("kind", tuple(_BEAM_KEYS))
        low, high = reader.numbers("thickness_range_um", count=2)
        if not 0.0 <= low < high:
            raise InputError(
                "thickness_range_um", [low, high], "two increasing numbers", source=reader.source
            )
        temperature_k = reader.number("temperature_k", low=100.0, high=400.0)
        named = [reader.text("camera"), reader.text("stack"), reader.optional("media", "")]
        cone = beam_kind == "cone"
        setup = cls(
            name=name,
            title=reader.text("title"),
            source=reader.text("source"),
            camera=named[0],
            detector=reader.text("detector"),
            stack=_stack(named[1], named[2], reader.optional("silicon", "Si")),
            varying=reader.text("varying"),
            thickness_range_um=(low, high),
            temperature_k=temperature_k,
            kind=kind,
            beam_kind=beam_kind,
            f_number=beam.number("f_number", low=0.5, high=1e6) if cone else float("inf"),
            obscuration=beam.number("obscuration", low=0.0, high=0.999, default=0.0) if cone else 0.0,
            telescope=beam.text("telescope") if beam_kind == "telescope" else "",
            **(
                _of_monochromator(light) if kind == "monochromator" else _of_sky(light, reader, temperature_k)
            ),
        )
        setup.stack.position(setup.varying)
        outside = [text for text in (*named, setup.bandpass, setup.telescope) if is_file_name(text)]
        return replace(setup, files=tuple(file for text in outside for file in files_of(text)))

    @named_units
    def missing_nm(self, found_nm: Iterable[float]) -> tuple[float, ...]:
        """Usual wavelengths that are not among those found [nm]."""
        found = tuple(found_nm)
        return tuple(
            usual
            for usual in self.wavelengths_nm
            if min(abs(one - usual) for one in found) > SAME_WAVELENGTH_NM
        )

    def with_silicon(self, name: str) -> Setup:
        """The same set-up with silicon of another table; see `LayerStack.with_silicon`."""
        return replace(self, stack=self.stack.with_silicon(name))

    @property
    def profile(self) -> SpectralProfile:
        """Shape of the monochromator line; a single wavelength on the sky."""
        if self.kind == "sky" or self.bandwidth_fwhm_nm == 0.0:
            return MonochromaticProfile()
        return _PROFILES[self.profile_name](self.bandwidth_fwhm_nm)

    @named_units
    def beam(self, field_x_deg: float = 0.0, field_y_deg: float = 0.0) -> Beam:
        """Angles of incidence at a field position [deg]; the position matters only behind a telescope."""
        if self.beam_kind == "collimated":
            return Beam.collimated()
        if self.beam_kind == "cone":
            return Beam.cone(self.f_number, self.obscuration)
        from .telescope import telescope_beam

        return telescope_beam(self.telescope, field_x_deg, field_y_deg)

    @named_units
    def optical_system(
        self, *, field_x_deg: float = 0.0, field_y_deg: float = 0.0, observable: str = "detection"
    ) -> OpticalSystem:
        """Stack and light of this set-up without any further effect."""
        from ..optics.system import OpticalSystem  # compiled code

        return OpticalSystem(
            stack=self.stack,
            temperature_k=self.temperature_k,
            profile=self.profile,
            beam=self.beam(field_x_deg, field_y_deg),
            varying=self.varying,
            observable=observable,
            laboratory_temperature_k=self.laboratory_temperature_k,
        )


def _stack(name: str, media: str, silicon: str) -> LayerStack:
    """Stack by its name or its file; media by their names, or those of a file."""
    known = read_media(media) if media else {}
    stack = LayerStack.from_file(name, known) if is_file_name(name) else LayerStack.from_resource(name)
    return stack.with_silicon(silicon, known)


def setup_names() -> tuple[str, ...]:
    """Names of the set-ups shipped with the package."""
    return tuple(name.removesuffix(".yaml") for name in list_resources("setups"))


def _vendor_of(setup: Setup) -> str:
    """Vendor of the set-up's own sensor."""
    from .camera import Camera

    return Camera.from_name(setup.camera).detector(setup.detector).vendor


@functools.lru_cache(maxsize=32)
def _shipped(name: str) -> Setup:
    return Setup.from_mapping(name, read_yaml("setups", f"{name}.yaml"), source_file=f"set-up {name}")


def _of_monochromator(light: Description) -> dict[str, Any]:
    """What a set-up of the laboratory says of its light, and nothing of the sky."""
    return {
        "bandwidth_fwhm_nm": light.number("bandwidth_fwhm_nm", low=0.0, high=200.0),
        "profile_name": light.choice("profile", tuple(_PROFILES)),
        "wavelengths_nm": tuple(light.numbers("wavelengths_nm")),
        "wavelength_accuracy_nm": light.number(
            "wavelength_accuracy_nm", low=0.0, high=20.0, default=WAVELENGTH_ACCURACY_NM
        ),
        "bandpass": "",
        "effective_area_m2": 0.0,
        "pixel_scale_arcsec": 0.0,
        "exposure_s": 0.0,
        "airmass": 0.0,
    }


def _of_sky(light: Description, reader: Description, temperature_k: float) -> dict[str, Any]:
    """What a set-up at a telescope says of the sky, and nothing of a lamp."""
    limits = {
        "effective_area_m2": (1e-6, 1e6),
        "pixel_scale_arcsec": (1e-6, 1e4),
        "exposure_s": (0.0, LONGEST_EXPOSURE_S),
        "airmass": (1.0, 10.0),
    }
    return {
        "bandpass": light.text("bandpass"),
        **{name: light.number(name, low=low, high=high) for name, (low, high) in limits.items()},
        "laboratory_temperature_k": reader.number(
            "laboratory_temperature_k", low=100.0, high=400.0, default=temperature_k
        ),
        "bandwidth_fwhm_nm": 0.0,
        "profile_name": "",
        "wavelengths_nm": (),
        "wavelength_accuracy_nm": 0.0,
    }
