"""Quadratures: normalised, and exact on what they claim."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.optics import Beam, Illumination, LampSpectrum, LayerStack, SpectralProfile
from lsst.fringe_sim.optics.illumination import (
    SIGMA_PER_FWHM,
    GaussianProfile,
    MonochromaticProfile,
    TriangularProfile,
)
from lsst.fringe_sim.optics.system import OpticalSystem

PROFILES = [MonochromaticProfile(), GaussianProfile(2.0), TriangularProfile(2.0)]


def system(profile: SpectralProfile, beam: Beam | None = None, temperature: float = 183.0) -> OpticalSystem:
    return OpticalSystem(
        LayerStack.from_resource("e2v_ccd250"), temperature, profile, beam or Beam.collimated()
    )


@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: type(profile).__name__)
def test_profiles_are_normalised_and_centred(profile: SpectralProfile) -> None:
    offset, weight = profile.nodes()
    assert weight.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.all(weight >= 0.0)
    assert weight @ offset == pytest.approx(0.0, abs=1e-12)


def test_line_shapes_damp_a_fringe_as_their_fourier_transform() -> None:
    """Closed forms: Gaussian, triangle (sinc²)."""
    frequency = 2.0 * np.pi / 1.2

    def contrast(profile: SpectralProfile) -> float:
        offset, weight = profile.nodes()
        return float(weight @ np.cos(frequency * offset))

    assert contrast(GaussianProfile(1.0)) == pytest.approx(
        np.exp(-0.5 * (frequency * SIGMA_PER_FWHM) ** 2), abs=1e-6
    )
    sinc = (np.sin(0.5 * frequency) / (0.5 * frequency)) ** 2
    assert contrast(TriangularProfile(1.0)) == pytest.approx(sinc, abs=1e-12)


def test_lamp_reweights_and_a_white_lamp_changes_nothing() -> None:
    white = LampSpectrum(np.array([800.0, 1100.0]), np.array([2.0, 2.0]))
    plain = system(GaussianProfile(2.0)).flat_fields([900.0, 960.0])
    lit = dataclasses.replace(system(GaussianProfile(2.0)), lamp=white).flat_fields([900.0, 960.0])
    np.testing.assert_allclose(lit.weight, plain.weight, rtol=1e-13)
    slope = LampSpectrum(np.array([800.0, 1100.0]), np.array([0.0, 3.0]))
    tilted = dataclasses.replace(system(GaussianProfile(2.0)), lamp=slope).flat_fields([900.0, 960.0])
    sigma = 2.0 * SIGMA_PER_FWHM
    # A straight spectrum moves the mean wavelength by sigma² times its logarithmic slope.
    np.testing.assert_allclose(
        tilted.mean_wavelength_nm, [900.0 + sigma**2 / 100.0, 960.0 + sigma**2 / 160.0], atol=1e-5
    )
    with pytest.raises(OutOfRangeError, match="lamp"):
        dataclasses.replace(system(GaussianProfile(2.0)), lamp=slope).flat_fields([1099.0])
    dark = LampSpectrum(np.array([800.0, 1000.0, 1100.0]), np.array([0.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="lamp"):
        dataclasses.replace(system(GaussianProfile(2.0)), lamp=dark).flat_fields([900.0])


def test_cone_fills_the_pupil_uniformly() -> None:
    """Abbe: the pupil is uniform in sin²θ, between the edge of the obscuration and the marginal ray."""
    beam = Beam.cone(1.234, 0.61)
    outer = 0.5 / 1.234
    squared = np.sin(beam.theta) ** 2
    assert beam.weight @ squared == pytest.approx(0.5 * outer**2 * (1.0 + 0.61**2), rel=1e-12)
    assert np.degrees(np.arcsin(outer)) == pytest.approx(23.9, abs=0.05)  # not arctan
    assert beam.theta.min() > np.arcsin(0.61 * outer)
    assert beam.theta.max() < np.arcsin(outer)
    np.testing.assert_array_equal(Beam.cone(np.inf).theta, [0.0])
    exact = quad(lambda s: np.cos(60.0 * np.sqrt(1.0 - s)), (0.61 * outer) ** 2, outer**2)[0]
    width = outer**2 * (1.0 - 0.61**2)
    assert beam.weight @ np.cos(60.0 * np.cos(beam.theta)) == pytest.approx(exact / width, abs=1e-12)


def test_coarse_sampling_of_the_bandpass_aliases() -> None:
    """Known trap: 41 samples over a 2 nm bandpass are wrong by about 1e-4, twice as many by some 1e-6."""
    optics = system(GaussianProfile(2.0))
    thickness = np.linspace(14.0, 15.0, 301)
    wavelengths = np.arange(880.0, 991.0, 10.0)
    reference = optics.flat_fields(wavelengths, 0.01)
    exact = optics.reduce(reference).averaged(reference.weight, thickness)
    errors = []
    for samples in (41, 81):
        offset = np.linspace(-5.0, 5.0, samples)
        weight = np.exp(-0.5 * (offset / (2.0 * SIGMA_PER_FWHM)) ** 2)
        wave = wavelengths[:, None] + offset
        light = Illumination(wave, np.zeros(wave.shape), np.broadcast_to(weight / weight.sum(), wave.shape))
        errors.append(np.abs(optics.reduce(light).averaged(light.weight, thickness) - exact).max())
    assert 1e-5 < errors[0] < 1e-3
    assert errors[1] < 0.1 * errors[0]


def test_impossible_requests_are_refused() -> None:
    for profile in (
        lambda: GaussianProfile(0.0),
        lambda: TriangularProfile(-1.0),
        lambda: LampSpectrum(np.array([900.0, 900.0]), np.ones(2)),
        lambda: LampSpectrum(np.array([900.0, 901.0]), np.array([-1.0, 2.0])),
        lambda: LampSpectrum(np.array([900.0]), np.array([1.0])),
        lambda: Beam.cone(0.4),
        lambda: Beam.cone(2.0, 1.0),
        lambda: Beam(np.array([0.1]), np.array([0.9])),
        lambda: Beam(np.array([1.6]), np.array([1.0])),
        lambda: Illumination.spectrum([900.0], [-1.0], Beam.collimated()),
        lambda: Illumination(np.ones((1, 2)), np.ones((1, 2)), np.ones((1, 2))),
    ):
        with pytest.raises(InputError):
            profile()
