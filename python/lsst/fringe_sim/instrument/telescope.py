"""Telescopes: which directions of light arrive at a place of the focal plane.

A telescope is a YAML file in ``data/telescopes``. Its beams come from a ray trace with batoid, or from a cone of
given focal ratio. What the thin-film model needs of some 10⁵ rays is the distribution of ``sin²θ``; a Gauss rule
with respect to that distribution represents it by a few dozen angles (paper, section 4.2 and Eq. 5).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import batoid
import numpy as np

from ..array_types import FloatArray
from ..descriptions import is_file_name, read_description
from ..errors import InputError, OutOfRangeError, ResourceError, UnknownNameError, named_units, printable_name
from ..optics import Beam
from ..resources import first_line, list_resources, read_yaml
from .ray_bundle import BEAM_NODES, RayBundle, beam_of_quantiles, gauss_rule, reduce_beam

__all__ = [
    "ConeOptics",
    "RayBundle",
    "Telescope",
    "TracedOptics",
    "batoid_optic",
    "gauss_rule",
    "reduce_beam",
    "telescope_beam",
]

GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


@named_units
@dataclass(frozen=True)
class TracedOptics:
    """Optics traced with batoid.

    Attributes
    ----------
    prescription : `str`
        Name of a prescription that ships with batoid, e.g. ``LSST_y.yaml``.
    wavelength_nm : `float`
        Wavelength of the traced rays [nm]; the angles depend on it only through the refracting elements.
    axisymmetric : `bool`
        Whether the beam depends on the distance from the axis alone (no spiders, no tilted elements).
    rings, spokes : `int`
        Rays over the entrance pupil: midpoints of equal areas.
    """

    prescription: str
    wavelength_nm: float
    axisymmetric: bool
    rings: int = 400
    spokes: int = 1200

    @named_units
    def trace(self, field_x_deg: float, field_y_deg: float) -> RayBundle:
        """Trace the light of one field position down to the sensor.

        Raises
        ------
        OutOfRangeError
            No ray arrives.
        """
        if not self.axisymmetric:
            return self._trace_pupil(field_x_deg, field_y_deg, self.spokes, 2.0 * np.pi)
        # Mirror and rotation of one half of the pupil give the rest; no ray is left out.
        half = self._trace_pupil(math.hypot(field_x_deg, field_y_deg), 0.0, self.spokes // 2, np.pi)
        along = np.concatenate([half.slope_x, half.slope_x])
        across = np.concatenate([half.slope_y, -half.slope_y])
        azimuth = math.atan2(field_y_deg, field_x_deg)
        cosine, sine = math.cos(azimuth), math.sin(azimuth)
        return RayBundle(cosine * along - sine * across, sine * along + cosine * across, half.kept_fraction)

    def _trace_pupil(self, field_x_deg: float, field_y_deg: float, spokes: int, reach: float) -> RayBundle:
        rays = self.launch(field_x_deg, field_y_deg, spokes, reach)
        batoid_optic(self.prescription).trace(rays)  # leaves them in the coordinates of the sensor
        kept = ~(rays.vignetted | rays.failed)
        if not kept.any():
            raise OutOfRangeError(
                "field angle [deg]",
                (field_x_deg, field_y_deg),
                "a place that light reaches",
                source=self.prescription,
            )
        velocity = rays.v[kept]
        # Slopes along the direction of travel, with z into the sensor whatever the sense of batoid's axis.
        depth = np.abs(velocity[:, 2])
        return RayBundle(velocity[:, 0] / depth, velocity[:, 1] / depth, float(kept.mean()))

    @named_units
    def launch(self, field_x_deg: float, field_y_deg: float, spokes: int, reach: float) -> batoid.RayVector:
        """Rays of a field position at midpoints of equal areas of the pupil, azimuth 0 to ``reach`` [rad]."""
        optic = batoid_optic(self.prescription)
        outer = 0.5 * optic.pupilSize
        inner = outer * optic.pupilObscuration
        ring = np.arange(self.rings)
        radius = np.sqrt(inner**2 + (outer**2 - inner**2) * (ring + 0.5) / self.rings)
        # Every ring starts at another azimuth, so that vignetting edges do not cut all rings alike.
        start = np.mod(ring * GOLDEN, 1.0)
        azimuth = reach * (np.arange(spokes) + start[:, None]) / spokes
        return batoid.RayVector.fromStop(
            (radius[:, None] * np.cos(azimuth)).ravel(),
            (radius[:, None] * np.sin(azimuth)).ravel(),
            optic=optic,
            wavelength=1e-9 * self.wavelength_nm,
            theta_x=math.radians(field_x_deg),
            theta_y=math.radians(field_y_deg),
        )


@dataclass(frozen=True)
class ConeOptics:
    """An aplanatic cone: the pupil is uniform in the direction sines (Abbe sine condition).

    Attributes
    ----------
    f_number : `float`
        Focal ratio N; the marginal ray arrives at ``arcsin(1 / 2N)``.
    obscuration : `float`
        Linear central obscuration, 0 to below 1.
    rings, spokes : `int`
        Rays over the pupil, where rays are asked for.
    """

    f_number: float
    obscuration: float = 0.0
    rings: int = 400
    spokes: int = 1200

    axisymmetric = True

    @named_units
    def trace(self, field_x_deg: float, field_y_deg: float) -> RayBundle:
        """Rays of the cone; the same at every field position."""
        share = (np.arange(self.rings) + 0.5) / self.rings
        outer = (0.5 / self.f_number) ** 2
        sine = np.sqrt(outer * (self.obscuration**2 + (1.0 - self.obscuration**2) * share))
        tangent = sine / np.sqrt(1.0 - sine**2)
        azimuth = 2.0 * np.pi * np.arange(self.spokes) / self.spokes
        return RayBundle(
            np.outer(tangent, np.cos(azimuth)).ravel(), np.outer(tangent, np.sin(azimuth)).ravel(), 1.0
        )

    def beam(self, nodes: int) -> Beam:
        """Angles of incidence at every field position, as a Gauss rule."""
        return Beam.cone(self.f_number, self.obscuration, nodes)


@named_units
@dataclass(frozen=True)
class Telescope:
    """A telescope with its camera.

    Attributes
    ----------
    name : `str`
        Name of the file in ``data/telescopes``.
    optics : `TracedOptics` or `ConeOptics`
        What shapes the beam.
    collecting_area_m2 : `float`
        Effective collecting area on axis [m²].
    pixel_um, pixel_scale_arcsec : `float`
        Pixel pitch [µm] and the angle that it covers [arcsec].
    field_radius_deg : `float`
        Largest field angle at which beams are given [deg].
    """

    name: str
    optics: TracedOptics | ConeOptics
    collecting_area_m2: float
    pixel_um: float
    pixel_scale_arcsec: float
    field_radius_deg: float

    @classmethod
    def from_name(cls, name: str) -> Telescope:
        """Telescope of ``data/telescopes/<name>.yaml``; capitals do not matter; or of a file, by its name.

        Raises
        ------
        UnknownNameError
            There is no such telescope.
        ResourceError
            The file is incomplete.
        """
        if is_file_name(name):
            return cls.from_file(name)
        known = [entry.removesuffix(".yaml") for entry in list_resources("telescopes")]
        stem = name.casefold()
        if stem not in known:
            raise UnknownNameError("telescope", name, known)
        return cls.from_mapping(stem, read_yaml("telescopes", f"{stem}.yaml"))

    @classmethod
    def from_file(cls, path: str | Path) -> Telescope:
        """Telescope that a YAML file describes, laid out like the shipped ones; it is named after the file.

        Raises
        ------
        InputError
            There is no such file, or it does not describe a telescope.
        """
        content = read_description(path, "telescope")
        try:
            return cls.from_mapping(printable_name("name of the telescope", Path(path).stem), content)
        except (ResourceError, ValueError) as error:
            allowed = "every entry that monocam.yaml or lsst.yaml has"
            raise InputError("telescope", first_line(error), allowed, source=str(path)) from None

    @classmethod
    def from_mapping(cls, name: str, content: Mapping[str, Any]) -> Telescope:
        """Telescope described by the mapping of a YAML file.

        Raises
        ------
        ResourceError
            A key is missing, or the kind of optics is unknown.
        """
        try:
            for key in ("source", "doi", "licence"):
                content[key]
            optics = dict(content["optics"])
            kind = optics.pop("kind")
            builders: dict[str, type[TracedOptics] | type[ConeOptics]] = {
                "traced": TracedOptics,
                "cone": ConeOptics,
            }
            return cls(
                name,
                builders[kind](**optics),
                *(
                    float(content[key])
                    for key in ("collecting_area_m2", "pixel_um", "pixel_scale_arcsec", "field_radius_deg")
                ),
            )
        except (KeyError, TypeError) as error:
            raise ResourceError(f"telescope {name}: wrong or missing entry {error}") from error

    @named_units
    def trace(self, field_x_deg: float = 0.0, field_y_deg: float = 0.0) -> RayBundle:
        """Rays that arrive at one field position.

        Raises
        ------
        OutOfRangeError
            The position lies outside the field.
        """
        self._check_field(field_x_deg, field_y_deg)
        return self.optics.trace(field_x_deg, field_y_deg)

    @named_units
    def beam(self, field_x_deg: float = 0.0, field_y_deg: float = 0.0, nodes: int = BEAM_NODES) -> Beam:
        """Angles of incidence at one field position, as a Gauss rule.

        Raises
        ------
        OutOfRangeError
            The position lies outside the field.
        """
        self._check_field(field_x_deg, field_y_deg)
        if isinstance(self.optics, ConeOptics):
            return self.optics.beam(nodes)
        if self.optics.axisymmetric:
            field_x_deg, field_y_deg = math.hypot(field_x_deg, field_y_deg), 0.0
        return beam_of_quantiles(_traced_quantiles(self.optics, field_x_deg, field_y_deg), nodes)

    def _check_field(self, field_x_deg: float, field_y_deg: float) -> None:
        if not math.hypot(field_x_deg, field_y_deg) <= self.field_radius_deg:
            raise OutOfRangeError(
                "field angle [deg]",
                (field_x_deg, field_y_deg),
                f"within {self.field_radius_deg} deg of the axis",
                source=f"telescope {self.name}",
            )


@named_units
def telescope_beam(
    telescope: str | Telescope, field_x_deg: float = 0.0, field_y_deg: float = 0.0, nodes: int = BEAM_NODES
) -> Beam:
    """Angles of incidence of a telescope at one field position.

    Parameters
    ----------
    telescope : `str` or `Telescope`
        A telescope or its name (``lsst``, ``hsc``, ``monocam``).
    field_x_deg, field_y_deg : `float`, optional
        Field angle [deg]; the axis by default.
    nodes : `int`, optional
        Number of angles.

    Returns
    -------
    beam : `Beam`

    Raises
    ------
    UnknownNameError
        The telescope is unknown.
    OutOfRangeError
        The position lies outside the field.
    """
    found = Telescope.from_name(telescope) if isinstance(telescope, str) else telescope
    return found.beam(field_x_deg, field_y_deg, nodes)


@functools.lru_cache(maxsize=8)
def batoid_optic(prescription: str) -> batoid.Optic:
    """Optics that ship with batoid; made once."""
    try:
        return batoid.Optic.fromYaml(prescription)
    except FileNotFoundError as error:
        raise ResourceError(f"batoid has no prescription {prescription}") from error


@functools.lru_cache(maxsize=64)
def _traced_quantiles(optics: TracedOptics, field_x_deg: float, field_y_deg: float) -> FloatArray:
    quantile = optics.trace(field_x_deg, field_y_deg).quantiles()
    quantile.flags.writeable = False
    return quantile
