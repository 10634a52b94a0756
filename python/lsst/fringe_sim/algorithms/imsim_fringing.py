"""Fringe maps for imSim: a class that is called like ``imsim.sky_model.CCD_Fringing``, with optics behind it.

imSim (https://github.com/LSSTDESC/imSim, v2) multiplies the sky of an e2v sensor by

    CCD_Fringing(true_center, boresight, seed, spatial_vary).calculate_fringe_amplitude(x, y)

where the pattern is a cosine of a random height field. Here it is what the sensor does to the lines of the night sky.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, named_units
from ..instrument.camera import Camera
from ..instrument.night import AirglowField
from ..instrument.sky import SkySpectrum
from ..model import FringeModel, Setup
from ..products.thickness_map import thickness_span_um
from .island_response import response_with_islands
from .sky_frame import sky_response
from .thickness_stand_in import ThicknessField

__all__ = ["CCDFringing", "SkyDirection"]

SENSOR = "R22_S11"  # All e2v sensors are of this shape


class _Angle(Protocol):
    @property
    def deg(self) -> float: ...


class SkyDirection(Protocol):
    """What is asked of a direction on the sky; `galsim.CelestialCoord` has it."""

    def project(self, other: Any) -> tuple[_Angle, _Angle]:
        """Offsets of another direction in the tangent plane of this one."""


@named_units
class CCDFringing:
    """Fringe pattern of one e2v sensor in a y-band exposure, relative to the sky.

    Parameters
    ----------
    true_center : `galsim.CelestialCoord`
        Centre of the sensor on the sky.
    boresight : `galsim.CelestialCoord`
        Centre of the field; the distance of the two decides the angles of the light.
    seed : `int`
        Number of the sensor (imSim takes a hash of its serial number). Decides the thickness of its adhesive, a
        random field with the statistics of measured sensors, unless ``thickness_um`` is given.
    spatial_vary : `bool`
        Vary the strength of the OH lines over the field as imSim's table says; continua stay as they are.
    thickness_um : array_like, shape ``(ny, nx)``, optional
        Adhesive of this sensor [µm], as fitted. The frame has this shape then.
    setup : `Setup`, optional
        Sensor and telescope; ``lsst_e2v`` by default.
    effects : mapping, optional
        Effects in the model, ``{"roughness.sigma": 25.0}``.
    airmass : `float`, optional
        Airmass of the sky; by default that of the set-up.

    Raises
    ------
    InputError
        A thickness map that is no image or has pixels without a number.
    OutOfRangeError
        The sensor is farther from the boresight than any sensor of the camera.
    """

    def __init__(
        self,
        true_center: SkyDirection,
        boresight: SkyDirection,
        seed: int,
        spatial_vary: bool,
        *,
        thickness_um: ArrayLike | None = None,
        setup: Setup | None = None,
        effects: Mapping[str, float] | None = None,
        airmass: float | None = None,
    ) -> None:
        self.true_center = true_center
        self.boresight = boresight
        self.seed = seed
        self.spatial_vary = spatial_vary
        self.setup = setup or Setup.from_name("lsst_e2v")
        self.effects = dict(effects or {})
        self.airmass = self.setup.airmass if airmass is None else airmass
        dx, dy = boresight.project(true_center)
        self.field_x_deg, self.field_y_deg = float(dx.deg), float(dy.deg)
        self.thickness_um = self._stand_in() if thickness_um is None else _checked(thickness_um)
        self._model = FringeModel.from_setup(
            self.setup, self.effects, field_x_deg=self.field_x_deg, field_y_deg=self.field_y_deg
        )

    def fringe_variation_level(self) -> float:
        """Brightness of the OH lines at the sensor over that at the centre of the field; 1 without variation.

        Raises
        ------
        OutOfRangeError
            The table does not reach so far.
        """
        if not self.spatial_vary:
            return 1.0
        field = AirglowField.imsim()
        return float(field.at(self.field_x_deg, self.field_y_deg) / field.at(0.0, 0.0))

    def simulate_fringes(self, amp: float | None = None) -> FloatArray:
        """Pattern of the whole sensor, zero on average.

        Parameters
        ----------
        amp : `float`, optional
            Half the range between the 1st and the 99th percentile, for patterns of a strength of one's own. By
            default it is what optics and sky make of it.

        Returns
        -------
        pattern : `numpy.ndarray`, shape ``(ny, nx)``
            Sky over mean sky, minus one.
        """
        pattern = self._pattern
        if amp is None:
            return pattern.copy()
        low, high = np.percentile(pattern, [1.0, 99.0])
        return pattern * (amp / (0.5 * (high - low)))

    def calculate_fringe_amplitude(
        self, x: ArrayLike, y: ArrayLike, amplitude: float | None = None
    ) -> FloatArray:
        """Factor by which fringes change the sky of pixels.

        Parameters
        ----------
        x, y : array_like
            Columns and rows, from 0, of any common shape; between pixels the map is interpolated linearly.
        amplitude : `float`, optional
            As in `simulate_fringes`, times the variation over the field, as in imSim; from the optics by default.

        Returns
        -------
        factor : `numpy.ndarray`, shape of ``x``
            One plus the pattern.

        Raises
        ------
        OutOfRangeError
            A position outside the sensor.
        """
        amp = None if amplitude is None else amplitude * self.fringe_variation_level()
        pattern = self.simulate_fringes(amp)
        columns, rows = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        for name, place, size in (("x", columns, pattern.shape[1]), ("y", rows, pattern.shape[0])):
            if place.size and not (place.min() >= 0.0 and place.max() <= size - 1):
                raise OutOfRangeError(
                    f"position {name} [px]", f"{place.min():g} to {place.max():g}", f"0 to {size - 1}"
                )
        if np.all(columns % 1.0 == 0.0) and np.all(rows % 1.0 == 0.0):
            found = pattern[rows.astype(int), columns.astype(int)]
        else:
            found = map_coordinates(pattern, [rows.ravel(), columns.ravel()], order=1).reshape(columns.shape)
        return np.asarray(1.0 + found)

    @functools.cached_property
    def _pattern(self) -> FloatArray:
        dark, span = SkySpectrum.dark(airmass=self.airmass), thickness_span_um(self.thickness_um, 1e-6)
        response = response_with_islands(
            self._model, lambda own: sky_response(own, dark, thickness_range_um=span)
        )
        level = self.fringe_variation_level()
        table = response.sky(dict.fromkeys(response.bands, level))
        frame = np.asarray(table.frame(self.thickness_um), dtype=float)
        return frame / frame.mean() - 1.0

    def _stand_in(self) -> FloatArray:
        detector = Camera.from_name("lsstCam").detector(SENSOR)
        rows, columns = detector.shape
        size_mm = 1e-3 * detector.pixel_um * rows, 1e-3 * detector.pixel_um * columns
        drawn = ThicknessField.of(self.setup).draw(detector.shape, size_mm, np.random.default_rng(self.seed))
        return np.asarray(drawn, dtype=float)


def _checked(thickness_um: ArrayLike) -> FloatArray:
    thickness = np.asarray(thickness_um, dtype=float)
    if thickness.ndim != 2:
        raise InputError("shape of the thickness map", thickness.shape, "two axes (y, x)")
    if not np.isfinite(thickness).all():
        missing = int((~np.isfinite(thickness)).sum())
        raise InputError("thickness map", f"{missing} pixels without a number", "a number for every pixel")
    return thickness
