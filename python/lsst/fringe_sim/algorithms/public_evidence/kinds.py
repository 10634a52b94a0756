"""Kinds of public data: what each holds, what a model says of it, and how far off that is.

A prediction is an array ``[..., S]`` whose last axis runs over shifts of the published map of the adhesive; kinds
that do not depend on the shift have one entry there. All are smooth in the parameters of effects, so that they are
computed on a few values and interpolated.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...array_types import ComplexArray, FloatArray
from ...errors import InputError
from ...instrument.bandpass import Bandpass
from ...instrument.measured_thickness import e2v_321
from ...instrument.sky import SkySpectrum, blend_components
from ...instrument.telescope import reduce_beam
from ...model import FringeModel
from ...optics import Beam, Illumination
from ...optics.illumination import GaussianProfile
from ...resources import read_table
from ..single_pixel import published_pixel
from ..sky_response import is_band
from .models import LAB, Models

SHIFT_UM = np.linspace(-1.5, 1.5, 601)
"""Shifts of the published map that are allowed [µm]: five fringe orders either way."""

PIXEL = (2115, 2148)
"""Row and column on the full sensor of pixel (2100, 2100) of the frame trimmed by 15 rows and 48 columns."""


PIXEL_NOISE = 7e-4
"""Photon noise of the pixel, 0.7 % smoothed by a Gaussian of 3 px; the scale of all misfits is free."""

ILLUMINATION = 0.03
"""Width of the free offset of the pixel, and of its slope from the middle to either end of the wavelengths."""

ORDER_UM = 0.3
PHASES = 32
LEAST_CONTRAST = 1e-9
"""Added to the first harmonic, so that a fringe that is gone has a logarithm and a phase."""

CONTRAST_SCATTER = 0.08
"""Scatter of the logarithm of the contrast among blocks, about a smooth run over the sensor."""

POSITION_TERMS = 0.1
"""Width of the free change of that logarithm from the middle to the edge, for each term up to second order."""

CONTRAST_CALIBRATION = 0.05
SHAPE_SIGMA = 0.03
"""Uncertainty of the second harmonic: fitted phases of the map cluster, which bends every fringe alike."""

PHASE_SIGMA = 0.1  # Uncertainty of the phase of the map [rad], 5 nm of adhesive

MAP_SIGMA_UM = 0.3
"""A walk may slip by an order, and the observable of the paper turns the fringe by half an order."""

QE_NM = np.arange(880.0, 1061.0, 20.0)
QE_SIGMA, QE_LEVEL = 0.03, 0.03
QE_LINE_NM = 6.0  # Width of the line in which the efficiency is computed: the silicon makes no fringes in it

LINE_SHIFT_NM, LEAST_SHARE = 0.02, 0.97
SKY_NODES = {"monocam": 12, "hsc": 24, "lsst_e2v": 64}
SKY_UM = {"monocam": (14.0, 22.0), "hsc": (199.0, 201.0), "lsst_e2v": (14.0, 22.0)}
SKY_SAMPLES = 801
TREND = 3
"""Degree of the run of the level with thickness, which is no fringe: an adhesive that absorbs has one."""


class Kind(Protocol):
    """Data of one kind."""

    @property
    def name(self) -> str:
        """Short name."""

    @property
    def size(self) -> int:
        """Number of values."""

    @property
    def setup(self) -> str:
        """Set-up in which they were measured."""

    @property
    def on_the_bench(self) -> bool:
        """Whether what is wrong with the bench of the laboratory is in them."""

    def predict(self, models: Models) -> FloatArray:
        """What the model says, ``[values, S or 1]``."""

    def chi2(self, prediction: FloatArray) -> FloatArray:
        """Misfit over the stated uncertainty, for predictions ``[..., values, S]``."""

    def misfit(self, prediction: FloatArray) -> FloatArray:
        """Root mean square of what a person would call the error, ``[..., S]``."""


@dataclass(frozen=True, eq=False)
class _Gaussian:
    """Values with a covariance."""

    name: str
    values: FloatArray
    covariance: FloatArray
    setup: str
    on_the_bench: bool

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.values)

    @functools.cached_property
    def _whitening(self) -> FloatArray:
        return np.linalg.inv(np.linalg.cholesky(self.covariance))

    def residual(self, prediction: FloatArray) -> FloatArray:
        """Data minus prediction, ``[..., values, S]``."""
        return np.asarray(self.values[:, np.newaxis] - prediction)

    def chi2(self, prediction: FloatArray) -> FloatArray:
        """Misfit over the stated uncertainty."""
        white = self._whitening @ self.residual(prediction)
        return np.asarray((white**2).sum(axis=-2))

    def misfit(self, prediction: FloatArray) -> FloatArray:
        """Rms of data minus prediction."""
        return np.asarray(np.sqrt((self.residual(prediction) ** 2).mean(axis=-2)))


@dataclass(frozen=True, eq=False)
class PixelFlats(_Gaussian):
    """One pixel in flats of many wavelengths; an offset and a slope in wavelength are free."""

    wavelength_nm: FloatArray
    map_um: float

    @classmethod
    def published(cls) -> PixelFlats:
        """Pixel (2100, 2100) of E2V-CCD250-321, Figure 4."""
        wavelength, amplitude = published_pixel()
        place = (wavelength - wavelength.mean()) / (0.5 * np.ptp(wavelength))
        covariance = PIXEL_NOISE**2 * np.eye(len(wavelength))
        covariance += ILLUMINATION**2 * (1.0 + np.outer(place, place))
        layer = float(e2v_321((1, 1), sampling="window", corner=PIXEL)[0, 0])
        return cls("pixel, 12 wavelengths", amplitude, covariance, LAB, True, wavelength, layer)

    def predict(self, models: Models) -> FloatArray:
        """Fringe amplitudes at every shift."""
        return self.amplitudes(models(LAB))

    def amplitudes(self, model: FringeModel, *, absolute: bool = False) -> FloatArray:
        """Fringe amplitudes at every shift, ``(W, S)``; ``absolute``: less the mean, not divided by it."""
        step = float(SHIFT_UM[1] - SHIFT_UM[0])
        start = self.map_um + float(SHIFT_UM[0])
        response = model.response_on_grid(self.wavelength_nm, start, step, len(SHIFT_UM))
        mean = response.mean(axis=1, keepdims=True)
        return np.asarray(response - mean if absolute else response / mean - 1.0)

    def misfit(self, prediction: FloatArray) -> FloatArray:
        """Rms after offset and slope."""
        return np.asarray(np.sqrt((self._left(self.residual(prediction)) ** 2).mean(axis=-2)))

    def _left(self, residual: FloatArray) -> FloatArray:
        place = self.wavelength_nm - self.wavelength_nm.mean()
        basis, _ = np.linalg.qr(np.stack([np.ones_like(place), place], axis=1))
        return np.asarray(residual - basis @ (basis.T @ residual))

    def without(self, number: int) -> PixelFlats:
        """The same less one wavelength."""
        keep = np.arange(self.size) != number
        return PixelFlats(
            self.name, self.values[keep], self.covariance[np.ix_(keep, keep)], self.setup, self.on_the_bench,
            self.wavelength_nm[keep], self.map_um,
        )  # fmt: skip

    def foretold(self, prediction: FloatArray, number: int) -> FloatArray:
        """One amplitude from the others, with the offset and the slope that they want, ``[..., S]``."""
        keep = np.arange(self.size) != number
        gain = np.linalg.solve(self.covariance[np.ix_(keep, keep)], self.covariance[keep, number])
        residual = self.residual(prediction)
        return np.asarray(prediction[..., number, :] + gain @ residual[..., keep, :])


@dataclass(frozen=True, eq=False)
class FlatContrast(_Gaussian):
    """Logarithm of the contrast of the blocks of a flat; level and a smooth run over the sensor are uncertain."""

    thickness_um: FloatArray
    wavelength_nm: float

    @classmethod
    def published(cls) -> FlatContrast:
        """The 960 nm flat of E2V-CCD250-321, Figure 2."""
        table = read_table("laboratory", "e2v_321_contrast_960nm.ecsv")
        y, x = (
            np.asarray(table[name], dtype=float) / half - 1.0 for name, half in (("y", 2002.0), ("x", 2048.0))
        )
        contrast, error = (np.asarray(table[name], dtype=float) for name in ("contrast", "contrast_error"))
        terms = np.stack([y, x, y * x, y**2, x**2], axis=1)
        covariance = np.diag(CONTRAST_SCATTER**2 + (error / contrast) ** 2)
        covariance += POSITION_TERMS**2 * terms @ terms.T + CONTRAST_CALIBRATION**2
        layer = np.asarray(table["thickness"], dtype=float)
        wavelength = float(table.meta["wavelength_nm"])
        name = "contrast of the 960 nm flat"
        return cls(name, np.log(contrast), covariance, LAB, True, layer, wavelength)

    def predict(self, models: Models) -> FloatArray:
        """Logarithm of the contrast at the thickness of every block."""
        layer, first, _ = harmonics(models(LAB), self.wavelength_nm)
        run = np.polynomial.Polynomial.fit(layer, np.log(np.abs(first)), 3)
        return np.asarray(run(self.thickness_um))[:, np.newaxis]

    def slope(self, prediction: FloatArray) -> float:
        """Change of the predicted logarithm per µm."""
        return float(np.polyfit(self.thickness_um, prediction[:, 0], 1)[0])


@dataclass(frozen=True, eq=False)
class FlatShape(_Gaussian):
    """Second harmonic of a flat over its first, in the frame of the first: in phase with it, and beside."""

    wavelength_nm: float

    @classmethod
    def published(cls) -> FlatShape:
        """The 960 nm flat of E2V-CCD250-321."""
        table = read_table("laboratory", "e2v_321_contrast_960nm.ecsv")
        values = np.array([np.mean(table["second_cos"]), np.mean(table["second_sin"])])
        covariance, wavelength = SHAPE_SIGMA**2 * np.eye(2), float(table.meta["wavelength_nm"])
        return cls("shape of the 960 nm fringe", values, covariance, LAB, True, wavelength)

    def predict(self, models: Models) -> FloatArray:
        """Mean over the thicknesses of the sensor."""
        _, first, second = harmonics(models(LAB), self.wavelength_nm)
        ratio = np.mean(second / np.abs(first) * np.exp(-2j * np.angle(first)))
        return np.array([[ratio.real], [ratio.imag]])


@dataclass(frozen=True, eq=False)
class FlatPhase(_Gaussian):
    """Phase of the fringe of a flat against the published map: which shifts are allowed, but for whole orders."""

    wavelength_nm: float

    @classmethod
    def published(cls) -> FlatPhase:
        """The 960 nm flat of E2V-CCD250-321."""
        table = read_table("laboratory", "e2v_321_contrast_960nm.ecsv")
        phase = np.array([np.mean(table["phase"])])
        covariance, wavelength = PHASE_SIGMA**2 * np.eye(1), float(table.meta["wavelength_nm"])
        return cls("phase of the 960 nm flat", phase, covariance, LAB, True, wavelength)

    def predict(self, models: Models) -> FloatArray:
        """Phase at every shift, as a continuous number of radians."""
        _, first, _ = harmonics(models(LAB), self.wavelength_nm)
        phase = float(np.angle(np.mean(first / np.abs(first))))
        return phase + 2.0 * np.pi * SHIFT_UM[np.newaxis] / ORDER_UM

    def residual(self, prediction: FloatArray) -> FloatArray:
        """Difference within half a turn."""
        return np.asarray((self.values[:, np.newaxis] - prediction + np.pi) % (2.0 * np.pi) - np.pi)


@dataclass(frozen=True, eq=False)
class PublishedMap(_Gaussian):
    """The published map itself: how far it may be shifted."""

    @classmethod
    def published(cls) -> PublishedMap:
        """The map of E2V-CCD250-321, Figure 5."""
        return cls("published map", np.zeros(1), MAP_SIGMA_UM**2 * np.eye(1), LAB, True)

    def predict(self, models: Models) -> FloatArray:
        """The shift."""
        return SHIFT_UM[np.newaxis]


@dataclass(frozen=True, eq=False)
class Efficiency(_Gaussian):
    """Logarithm of the quantum efficiency of a vendor's sensors against wavelength; its level is uncertain."""

    @classmethod
    def published(cls, setup: str, column: str) -> Efficiency:
        """Mean of many sensors of one vendor."""
        table = read_table("sky", "qe_lsst_detectors.ecsv")
        measured = np.interp(QE_NM, np.asarray(table["wavelength"]), np.asarray(table[column]))
        covariance = QE_SIGMA**2 * np.eye(len(QE_NM)) + QE_LEVEL**2
        return cls(f"quantum efficiency, {column[:3]}", np.log(measured), covariance, setup, False)

    def predict(self, models: Models) -> FloatArray:
        """Logarithm of what the stack detects, averaged over the fringe."""
        model = models(self.setup, observable="detection")
        model = model.with_effects({**model.effect_settings, "bandwidth.fwhm": QE_LINE_NM})
        system = model.base_system
        layer = float(system.stack.thickness_um[system.stack.position(system.varying)])
        order = 1e-3 * 0.5 * 960.0 / (1.6 if system.varying != system.detection else 3.56)
        thickness = layer + order * np.arange(16) / 16.0
        return np.asarray(np.log(model.response(thickness, QE_NM).mean(axis=1)))[:, np.newaxis]


@dataclass(frozen=True, eq=False)
class SeenOnSky(_Gaussian):
    """Logarithm of the amplitude that one telescope has seen."""

    amplitude: str

    @classmethod
    def published(cls, setup: str) -> SeenOnSky:
        """MonoCam or Hyper Suprime-Cam."""
        table = read_table("sky", "fringes_seen_by_telescopes.ecsv")
        rows = table[table["setup"] == setup]
        if not len(rows):
            raise InputError("set-up", setup, f"one of {sorted(table['setup'])}")
        row = rows[0]
        values = np.array([np.log(float(row["value"]))])
        spread = np.array([[float(row["scatter"]) ** 2]])
        return cls(f"sky of {setup}", values, spread, setup, False, str(row["amplitude"]))

    def predict(self, models: Models) -> FloatArray:
        """Logarithm of the amplitude [%] of the lines, diluted by the continuum."""
        return np.log(np.array([[max(sky_amplitude(models, self.setup, self.amplitude), 1e-9)]]))


def sky_amplitude(models: Models, setup: str, amplitude: str) -> float:
    """Fringes of a dark sky [%] about the smooth run of the level over all thicknesses of the sensor.

    ``amplitude`` is ``rms`` or ``half_peak_to_peak``.
    """
    light, share = _sky_light(setup)
    low, high = SKY_UM[setup]
    step = (high - low) / (SKY_SAMPLES - 1)
    response = models(setup).respond_on_grid(light, low, step, SKY_SAMPLES, tolerance=1e-5)[0]
    place = np.linspace(-1.0, 1.0, SKY_SAMPLES)
    run = np.polynomial.Polynomial.fit(place, response, TREND)(place)
    fringe = 100.0 * share * (response - run) / response.mean()
    return float(fringe.std() if amplitude == "rms" else 0.5 * np.ptp(fringe))


def public_kinds() -> tuple[Kind, ...]:
    """All kinds of public data on fringes of LSST sensors, and of what bears on them."""
    return (
        PixelFlats.published(),
        FlatContrast.published(),
        FlatShape.published(),
        FlatPhase.published(),
        PublishedMap.published(),
        Efficiency.published("ts8_e2v", "e2v_QE"),
        Efficiency.published("ts8_itl", "itl_QE"),
        SeenOnSky.published("monocam"),
        SeenOnSky.published("hsc"),
    )


def harmonics(model: FringeModel, wavelength_nm: float) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """First and second harmonic of the fringe over its mean, at thicknesses from 14 to 22 µm."""
    order = float(model.fringe_order_um(wavelength_nm))
    layer = order * np.arange(np.ceil(14.0 / order), 22.0 / order, 4.0)
    phase = np.arange(PHASES) / PHASES
    response = model.response(layer[:, np.newaxis] + order * phase, [wavelength_nm])[0]
    wave = 2.0 * np.fft.fft(response, axis=1) / (PHASES * response.mean(axis=1, keepdims=True))
    return layer + 0.5 * order, wave[:, 1] + LEAST_CONTRAST, wave[:, 2]


@functools.cache
def _sky_light(setup: str) -> tuple[Illumination, float]:
    """The stronger lines of a dark sky in the beam of a telescope, and the share of all lines in what is detected."""
    model = FringeModel.from_setup(setup)
    parts = SkySpectrum.dark(airmass=model.setup.airmass).components(Bandpass.from_name(model.setup.bandpass))
    lines = [item for item in parts if is_band(item.name)]
    beam = reduce_beam(model.system.beam, SKY_NODES[setup])
    efficiency = _efficiency(model, beam, setup)
    total, of_lines = (
        sum(float(item.photons @ np.interp(item.wavelength_nm, *efficiency)) for item in some)
        for some in (parts, lines)
    )
    share = of_lines / total
    blended = blend_components(lines, LINE_SHIFT_NM)
    wavelength = np.concatenate([item.wavelength_nm for item in blended])
    photons = np.concatenate([item.photons for item in blended])
    order = np.argsort(-photons)
    count = int(np.searchsorted(np.cumsum(photons[order]), LEAST_SHARE * photons.sum())) + 1
    return Illumination.spectrum(wavelength[order[:count]], photons[order[:count]], beam), share


def _efficiency(model: FringeModel, beam: Beam, setup: str) -> tuple[FloatArray, FloatArray]:
    """Wavelengths of the band [nm], and what the sensor detects there, averaged over the fringes of all layers."""
    low, high = Bandpass.from_name(model.setup.bandpass).support()
    wavelength = np.arange(low, high, 10.0)
    light = Illumination.flat_fields(wavelength, GaussianProfile(QE_LINE_NM), beam)
    first, last = SKY_UM[setup]
    step = (last - first) / (SKY_SAMPLES - 1)
    response = model.respond_on_grid(light, first, step, SKY_SAMPLES, tolerance=1e-5)
    return wavelength, np.asarray(response.mean(axis=1))
