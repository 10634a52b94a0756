"""Flats of a sensor from matrices of the fields; nothing but the tables of the media is shared with the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lsst.fringe_sim.optics import get_medium

__all__ = ["ForeignSensor"]

KELVIN = 183.15
LINE_NM = 2.0
"""Full width of a Gaussian line [nm]."""

LAYERS = (
    ("MgF2", 0.1221),
    ("Ta2O5", 0.0441),
    ("Si", 100.0),
    ("SiO2", 0.1),
    ("Si", 0.3),
    ("SiO2", 1.0),
    ("epoxy", np.nan),
    ("Si", 165.0),
)
"""Layers of the e2v sensor under vacuum, from the light on, with their thickness [µm]; the support lies below."""

SUPPORT = "Si3N4"
DETECTION, INSULATION, EPOXY = 2, 5, 6


@dataclass(frozen=True)
class ForeignSensor:
    """A sensor that may differ from the one of the set-up.

    Attributes
    ----------
    line : `float`
        Factor on the width of the line.
    epoxy_k : `float`
        Absorption of the adhesive.
    thicker_um : mapping
        What is added to the thickness of a layer, by its number [µm].
    """

    line: float = 1.0
    epoxy_k: float = 0.0
    thicker_um: Mapping[int, float] = field(default_factory=dict)

    def absorbed(self, wavelength_nm: np.ndarray, epoxy_um: np.ndarray) -> np.ndarray:
        """Light absorbed in the detection layer at normal incidence, ``(wavelengths, thicknesses)``."""
        wavelength = 1e-3 * np.asarray(wavelength_nm)[:, np.newaxis]
        below = get_medium(SUPPORT).index(np.asarray(wavelength_nm), KELVIN)[:, np.newaxis]
        # Electric and magnetic field at the upper face of what has been passed so far; one wave leaves downwards.
        electric = np.ones((len(wavelength), len(epoxy_um)), complex)
        magnetic = below * electric
        flux = {}
        for number in reversed(range(len(LAYERS))):
            name, thickness = LAYERS[number]
            index = get_medium(name).index(np.asarray(wavelength_nm), KELVIN)[:, np.newaxis] + 0j
            passed = np.full(len(epoxy_um), thickness + self.thicker_um.get(number, 0.0))
            if number == EPOXY:
                index, passed = index + 1j * self.epoxy_k, np.asarray(epoxy_um)
            phase = 2.0 * np.pi * index * passed / wavelength
            electric, magnetic = (
                np.cos(phase) * electric - 1j * np.sin(phase) / index * magnetic,
                np.cos(phase) * magnetic - 1j * np.sin(phase) * index * electric,
            )
            flux[number] = np.real(np.conj(electric) * magnetic)
        incident = np.abs(0.5 * (electric + magnetic)) ** 2
        return np.asarray((flux[DETECTION] - flux[DETECTION + 1]) / incident)

    def flats(self, wavelength_nm: np.ndarray, epoxy_um: np.ndarray, px: int) -> np.ndarray:
        """Relative flats of a map with ``px`` by ``px`` places in a pixel, shape ``(wavelengths, ny, nx)``."""
        grid = np.linspace(epoxy_um.min(), epoxy_um.max(), int(np.ptp(epoxy_um) / 0.002) + 2)
        away = np.linspace(-3.5, 3.5, 81)
        share = np.exp(-0.5 * away**2)
        sigma = self.line * LINE_NM / np.sqrt(8.0 * np.log(2.0))
        ny, nx = (length // px for length in epoxy_um.shape)
        images = []
        for middle in wavelength_nm:
            response = share @ self.absorbed(middle + sigma * away, grid) / share.sum()
            image = np.interp(epoxy_um, grid, response).reshape(ny, px, nx, px).mean(axis=(1, 3))
            images.append(image / image.mean())
        return np.array(images)
