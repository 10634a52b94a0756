"""Sums over the pixels of a night in pieces of rows are those of whole images."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.night_levels import background_terms
from lsst.fringe_sim.algorithms.night_sums import NightSums, ShiftSums
from lsst.fringe_sim.algorithms.sky_model_error import Envelope
from lsst.fringe_sim.algorithms.smooth_field import Splines

SHAPE = (21, 300)
ORDER_UM = 0.3
FRAMES = 3


@pytest.mark.parametrize("spans", [0, 1, 5])
@pytest.mark.parametrize("with_envelope", [True, False], ids=["envelope", "none"])
def test_sums_are_those_of_whole_images(spans: int, with_envelope: bool) -> None:
    """Rows are longer than a piece and no multiple of one; each has the whole range of the thickness, up and down."""
    rng = np.random.default_rng(8)
    values, weights = rng.standard_normal((2, FRAMES, *SHAPE))
    weights = np.where(weights > 1.0, 0.0, weights**2)
    bands, change = rng.standard_normal((2, 4, *SHAPE))
    layer = 14.0 + 2.5 * np.sin(np.arange(SHAPE[1]) / 40.0) + 0.1 * rng.standard_normal(SHAPE)
    envelope = Envelope.of(0.1, layer + 0.2, ORDER_UM) if with_envelope else None
    sums = NightSums.of(list(zip(values, weights, strict=True)))
    products, side = sums.products(bands, layer, envelope)
    terms = np.concatenate([bands, background_terms(SHAPE)]).reshape(10, -1)
    if envelope is not None:
        terms = np.concatenate([terms, envelope.terms(layer, bands)])
    level = rng.standard_normal((FRAMES, len(terms)))
    splines = Splines.of(SHAPE, spans)
    slopes = ShiftSums.of(sums, (bands, layer, envelope), level, change, splines)
    total, gradient = np.zeros((2, *SHAPE))
    for frame in range(FRAMES):
        weighted = terms * weights[frame].ravel()
        np.testing.assert_allclose(products[frame], weighted @ terms.T, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(side[frame], weighted @ values[frame].ravel(), rtol=1e-9, atol=1e-8)
        slope = np.tensordot(level[frame, :4], change, axes=1)
        residual = values[frame] - (level[frame] @ terms).reshape(SHAPE)
        total += weights[frame] * slope**2
        gradient += weights[frame] * slope * residual
        for term, cross in zip(terms, slopes.cross[frame], strict=True):
            expected = splines.sums(weights[frame] * slope * term.reshape(SHAPE))
            np.testing.assert_allclose(cross, expected, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(slopes.total, total, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slopes.gradient, gradient, rtol=1e-9, atol=1e-8)
