"""Illumination as a quadrature: which wavelengths and angles fall on a pixel, with which weight."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, named_units

__all__ = [
    "Beam",
    "GaussianProfile",
    "Illumination",
    "LampSpectrum",
    "MonochromaticProfile",
    "SpectralProfile",
    "TriangularProfile",
]

DEFAULT_STEP_NM = 0.05
"""Spacing of wavelength samples [nm]: eight per fringe of 265 µm of silicon, which the support can produce."""

SIGMA_PER_FWHM = 1.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))


class SpectralProfile(ABC):
    """Shape of a monochromator line around its nominal wavelength."""

    @abstractmethod
    def nodes(self, step_nm: float = DEFAULT_STEP_NM) -> tuple[FloatArray, FloatArray]:
        """Quadrature nodes.

        Parameters
        ----------
        step_nm : `float`, optional
            Largest spacing of the nodes [nm].

        Returns
        -------
        offset_nm, weight : `numpy.ndarray`, shape ``(Q,)``
            Wavelength relative to the nominal one [nm] and weights that sum to 1.
        """


@dataclass(frozen=True)
class MonochromaticProfile(SpectralProfile):
    """A single wavelength."""

    @named_units
    def nodes(self, step_nm: float = DEFAULT_STEP_NM) -> tuple[FloatArray, FloatArray]:
        """One node; see `SpectralProfile.nodes`."""
        return np.zeros(1), np.ones(1)


@named_units
@dataclass(frozen=True)
class GaussianProfile(SpectralProfile):
    """Gaussian line, as the paper assumes (section 2.2).

    Attributes
    ----------
    fwhm_nm : `float`
        Full width at half maximum [nm].
    reach : `float`
        Half width of the sampled interval in standard deviations; 5 leaves 6e-7 of the light out.
    """

    fwhm_nm: float
    reach: float = 5.0

    def __post_init__(self) -> None:
        _check_width(self.fwhm_nm)

    @named_units
    def nodes(self, step_nm: float = DEFAULT_STEP_NM) -> tuple[FloatArray, FloatArray]:
        """Trapezoidal nodes, which converge exponentially here; see `SpectralProfile.nodes`."""
        sigma = self.fwhm_nm * SIGMA_PER_FWHM
        half = max(8, math.ceil(self.reach * sigma / step_nm))
        offset = np.linspace(-self.reach * sigma, self.reach * sigma, 2 * half + 1)
        weight = np.exp(-0.5 * (offset / sigma) ** 2)
        weight[[0, -1]] *= 0.5  # otherwise the cut tail leaves an error of first order in the spacing
        return offset, weight / weight.sum()


@named_units
@dataclass(frozen=True)
class TriangularProfile(SpectralProfile):
    """Slit function of a monochromator with equal entrance and exit slits.

    Attributes
    ----------
    fwhm_nm : `float`
        Full width at half maximum [nm], half of the full base.
    """

    fwhm_nm: float

    def __post_init__(self) -> None:
        _check_width(self.fwhm_nm)

    @named_units
    def nodes(self, step_nm: float = DEFAULT_STEP_NM) -> tuple[FloatArray, FloatArray]:
        """Gauss–Legendre nodes on both flanks; see `SpectralProfile.nodes`."""
        per_flank = max(8, math.ceil(self.fwhm_nm / step_nm))
        x, w = np.polynomial.legendre.leggauss(per_flank)
        offset = 0.5 * self.fwhm_nm * (x + 1.0)
        weight = w * (1.0 - offset / self.fwhm_nm)
        offset = np.concatenate([-offset[::-1], offset])
        weight = np.concatenate([weight[::-1], weight])
        return offset, weight / weight.sum()


@named_units
@dataclass(frozen=True, eq=False)
class LampSpectrum:
    """Spectrum of the lamp in front of the monochromator, e.g. the arc lines of xenon.

    Attributes
    ----------
    wavelength_nm : `numpy.ndarray`, shape ``(K,)``
        Wavelengths [nm], increasing.
    light : `numpy.ndarray`, shape ``(K,)``
        Relative number of photons per wavelength; straight lines between the points.
    """

    wavelength_nm: FloatArray
    light: FloatArray

    def __post_init__(self) -> None:
        wavelength, light = np.asarray(self.wavelength_nm, dtype=float), np.asarray(self.light, dtype=float)
        if wavelength.ndim != 1 or wavelength.shape != light.shape or wavelength.size < 2:
            shapes = (wavelength.shape, light.shape)
            raise InputError("shapes of the lamp spectrum", shapes, "equally long, two points or more")
        if not (np.all(np.isfinite(wavelength)) and np.all(np.diff(wavelength) > 0.0)):
            raise InputError(
                "wavelengths of the lamp spectrum", wavelength.tolist()[:4], "finite and increasing"
            )
        if not (np.all(np.isfinite(light)) and np.all(light >= 0.0) and light.sum() > 0.0):
            raise InputError(
                "light in the lamp spectrum", float(light.min()), "finite, not negative, not all zero"
            )
        object.__setattr__(self, "wavelength_nm", wavelength)
        object.__setattr__(self, "light", light)

    @named_units
    def at(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Relative number of photons at these wavelengths [nm].

        Raises
        ------
        OutOfRangeError
            A wavelength outside the table.
        """
        wavelength = np.asarray(wavelength_nm, dtype=float)
        low, high = self.wavelength_nm[0], self.wavelength_nm[-1]
        if not np.all((wavelength >= low) & (wavelength <= high)):
            worst = wavelength.min() if wavelength.min() < low else wavelength.max()
            raise OutOfRangeError(
                "wavelength [nm] in the lamp spectrum", float(worst), f"{low:g} to {high:g}"
            )
        return np.interp(wavelength, self.wavelength_nm, self.light)


@named_units
@dataclass(frozen=True, eq=False)
class Beam:
    """Distribution of the angle of incidence on the sensor.

    Attributes
    ----------
    theta : `numpy.ndarray`, shape ``(A,)``
        Quadrature nodes [rad], 0 ≤ θ < π/2.
    weight : `numpy.ndarray`, shape ``(A,)``
        Weights; they sum to 1.

    Raises
    ------
    OutOfRangeError
        An angle outside ``[0, π/2)``.
    InputError
        Weights that are negative, or whose sum is not 1 within 1e-9.
    """

    theta: FloatArray
    weight: FloatArray

    def __post_init__(self) -> None:
        theta, weight = np.asarray(self.theta, dtype=float), np.asarray(self.weight, dtype=float)
        if theta.ndim != 1 or theta.shape != weight.shape or theta.size == 0:
            raise InputError("beam nodes and weights", (theta.shape, weight.shape), "equally long, not empty")
        if not np.all((theta >= 0.0) & (theta < 0.5 * np.pi)):
            raise OutOfRangeError("angle of incidence [rad]", float(np.max(theta)), "0 to below pi/2")
        if not np.all(weight >= 0.0) or not abs(weight.sum() - 1.0) < 1e-9:
            raise InputError("sum of beam weights", float(weight.sum()), "1, none negative")
        object.__setattr__(self, "theta", theta)
        object.__setattr__(self, "weight", weight)

    @classmethod
    @named_units
    def collimated(cls, theta: float = 0.0) -> Beam:
        """Parallel light at one angle [rad]."""
        return cls(np.array([theta]), np.ones(1))

    @classmethod
    def cone(cls, f_number: float, obscuration: float = 0.0, nodes: int = 64) -> Beam:
        """Converging beam of an aplanatic telescope.

        Parameters
        ----------
        f_number : `float`
            Focal ratio N; the marginal ray arrives at ``arcsin(1 / 2N)``. Infinite for collimated light.
        obscuration : `float`, optional
            Linear central obscuration, 0 to below 1.
        nodes : `int`, optional
            Number of Gauss–Legendre nodes in ``sin²θ``, in which the pupil is uniform (Abbe sine condition).
        """
        if math.isinf(f_number) and f_number > 0:
            return cls.collimated()
        if not f_number > 0.5:
            raise OutOfRangeError("f-number", f_number, "above 0.5")
        if not 0.0 <= obscuration < 1.0:
            raise OutOfRangeError("central obscuration", obscuration, "0 to below 1")
        outer = (0.5 / f_number) ** 2
        inner = outer * obscuration**2
        x, w = np.polynomial.legendre.leggauss(nodes)
        sin_squared = inner + 0.5 * (outer - inner) * (x + 1.0)
        return cls(np.arcsin(np.sqrt(sin_squared)), w / w.sum())

    @property
    def mean_angle(self) -> float:
        """Mean angle of incidence [rad]."""
        return float(self.weight @ self.theta)


@named_units
@dataclass(frozen=True, eq=False)
class Illumination:
    """Quadrature over wavelength and angle, for one or several exposures.

    Attributes
    ----------
    wavelength_nm, theta, weight : `numpy.ndarray`, shape ``(W, Q)``
        Nodes [nm, rad] and weights of W exposures; the weights of each sum to 1.
    """

    wavelength_nm: FloatArray
    theta: FloatArray
    weight: FloatArray

    def __post_init__(self) -> None:
        shapes = {self.wavelength_nm.shape, self.theta.shape, self.weight.shape}
        if len(shapes) != 1 or self.weight.ndim != 2 or self.weight.size == 0:
            raise InputError("shapes of the illumination", shapes, "one common shape (exposures, nodes)")
        if not np.allclose(self.weight.sum(axis=1), 1.0, rtol=0.0, atol=1e-9):
            raise InputError("sum of the weights", self.weight.sum(axis=1).tolist(), "1 for every exposure")

    @property
    def mean_wavelength_nm(self) -> FloatArray:
        """Mean wavelength of every exposure [nm], shape ``(W,)``."""
        mean: FloatArray = (self.weight * self.wavelength_nm).sum(axis=1)
        return mean

    @classmethod
    @named_units
    def flat_fields(
        cls,
        wavelength_nm: ArrayLike,
        profile: SpectralProfile,
        beam: Beam,
        step_nm: float = DEFAULT_STEP_NM,
        lamp: LampSpectrum | None = None,
    ) -> Illumination:
        """Monochromator flats, one per nominal wavelength.

        Parameters
        ----------
        wavelength_nm : array_like, shape ``(W,)``
            Central wavelengths [nm].
        profile : `SpectralProfile`
            Line shape.
        beam : `Beam`
            Angles of incidence.
        step_nm : `float`, optional
            Largest spacing of the wavelength nodes [nm].
        lamp : `LampSpectrum`, optional
            Spectrum of the lamp, by which the line profile is multiplied; white if not given.
        """
        centre = np.atleast_1d(np.asarray(wavelength_nm, dtype=float))
        offset, weight = profile.nodes(step_nm)
        per_exposure = np.outer(weight, beam.weight).ravel()
        shape = (len(centre), per_exposure.size)
        wave = centre[:, None] + np.repeat(offset, beam.theta.size)[None, :]
        theta = np.broadcast_to(np.tile(beam.theta, offset.size), shape)
        if lamp is None:
            return cls(wave, theta, np.broadcast_to(per_exposure, shape))
        photons = per_exposure * lamp.at(wave)
        total = photons.sum(axis=1, keepdims=True)
        if not np.all(total > 0.0):
            raise InputError(
                "lamp light at wavelength [nm]", float(centre[np.argmin(total)]), "more than none"
            )
        return cls(wave, theta, photons / total)

    @classmethod
    @named_units
    def spectrum(cls, wavelength_nm: ArrayLike, weight: ArrayLike, beam: Beam) -> Illumination:
        """One exposure to a spectrum of lines (or of continuum nodes); Eq. 5 of the paper.

        Parameters
        ----------
        wavelength_nm, weight : array_like, shape ``(K,)``
            Wavelengths [nm] and relative numbers of photons (normalised here).
        beam : `Beam`
            Angles of incidence.
        """
        wave, photons = np.asarray(wavelength_nm, dtype=float), np.asarray(weight, dtype=float)
        if wave.ndim != 1 or wave.shape != photons.shape or wave.size == 0:
            raise InputError("shapes of the spectrum", (wave.shape, photons.shape), "equally long, not empty")
        if not np.all(photons >= 0.0) or not photons.sum() > 0.0:
            raise InputError("weights of the spectrum", float(photons.min()), "not negative, not all zero")
        joint = np.outer(photons / photons.sum(), beam.weight).ravel()
        return cls(
            np.repeat(wave, beam.theta.size)[None, :], np.tile(beam.theta, wave.size)[None, :], joint[None, :]
        )


def _check_width(fwhm_nm: float) -> None:
    if not 0.0 < fwhm_nm < 200.0:
        raise OutOfRangeError("bandwidth FWHM [nm]", fwhm_nm, "above 0 and below 200")
