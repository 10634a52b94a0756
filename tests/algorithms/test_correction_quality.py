"""Measures of structure in a frame, where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.correction.quality import excess_structure, uniform_background_indicator

SIDE, NOISE, APERTURE = 400, 3.0, 20


@pytest.fixture
def white(rng):
    return NOISE * rng.standard_normal((SIDE, SIDE))


@pytest.mark.rng("structure is a fraction of the noise of an aperture")
def test_structure_is_a_fraction_of_the_noise_of_an_aperture(white, rng):
    """A wave averaged over the aperture, against the noise of a pixel divided by the side of the aperture."""
    good = (rng.random(white.shape) > 0.2).astype(float)
    assert excess_structure(white, good, APERTURE) < 0.35
    wave = np.sin(2.0 * np.pi * np.arange(SIDE) / 100.0)
    kept = np.sinc(APERTURE / 100.0) / np.sqrt(2.0)
    expected = kept / (NOISE / APERTURE / np.sqrt(0.8))
    assert excess_structure(white + wave, good, APERTURE) == pytest.approx(expected, rel=0.1)


@pytest.mark.rng("the uniform background indicator of white noise")
def test_the_uniform_background_indicator(white):
    """Weights of pixels at the rim are parts, of which the squares count: sqrt(Σw² / Σw) + 1 / Σw over the disc."""
    good = np.ones(white.shape, dtype=bool)
    assert uniform_background_indicator(white, good) == pytest.approx(0.98, abs=0.02)
    waves = white + NOISE * np.sin(np.arange(SIDE) / 20.0)
    assert uniform_background_indicator(waves, good) > 2.0
    assert np.isnan(uniform_background_indicator(white, ~good))
