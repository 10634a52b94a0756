"""Sources in single visits and coadds: laws that hold whatever the fringes."""

import numpy as np
import pytest
from scipy.ndimage import spline_filter

from lsst.fringe_sim.algorithms.coadd_sources import sources_in_coadds
from lsst.fringe_sim.algorithms.coadds import VisitPlaces
from lsst.fringe_sim.algorithms.correction.injection import InjectionOptions
from lsst.fringe_sim.products import SkyFringe

Y, X = np.mgrid[:200, :210]
PATTERNS = np.sin(X / 3.5 + 0.02 * Y), np.cos(Y / 4.0 - X / 9.0)
FEW = InjectionOptions(number=30, signal_to_noise=(10.0, 100.0))


def frame(first: float, second: float = 0.0) -> SkyFringe:
    image = (1.0 + first * PATTERNS[0] + second * PATTERNS[1]).astype(np.float32)
    return SkyFringe(image, np.zeros(image.shape, np.int32), "fraction", 2700.0, 30.0, 1.2, 20.0, None, 0.0)


def alike(visits: int) -> VisitPlaces:
    same = np.ones(visits)
    return VisitPlaces(100.5 * same, 99.0 * same, 0.0 * same, np.zeros(visits, dtype=int))


def of(*frames: SkyFringe, places: VisitPlaces | None = None):
    found = sources_in_coadds(frames, np.random.default_rng(3), places, FEW)
    assert found is not None
    return found


def test_no_fringes_no_bias() -> None:
    found = of(frame(0.0), places=alike(2))
    assert set(found["visits"]) == {1, 2}
    assert (found["number"] >= 9).all()
    for name in ("bias_fringes", "scatter_fringes", "e1_bias_fringes", "size_scatter_fringes"):
        np.testing.assert_allclose(found[name], 0.0, atol=1e-9)
    assert "bias_corrected" not in found.colnames
    # The scatter of the noise is that of the aperture, and a little more from the ring.
    np.testing.assert_allclose(found["scatter_noise"] * found["signal_to_noise"], 1.0, atol=0.5)


def test_biases_of_fluxes_are_those_of_the_fringes_in_the_aperture() -> None:
    """Twice the fringes, twice the bias; ten times the flux, a tenth; the same fringes in each visit stay."""
    one, two = of(frame(2e-3), places=alike(4)), of(frame(4e-3), places=alike(4))
    np.testing.assert_allclose(two["scatter_fringes"], 2.0 * one["scatter_fringes"], rtol=1e-3)
    np.testing.assert_allclose(two["bias_fringes"], 2.0 * one["bias_fringes"], rtol=1e-2, atol=1e-6)
    faint, bright = (one[one["signal_to_noise"] == snr] for snr in (10.0, 100.0))
    np.testing.assert_allclose(faint["magnitude"] - bright["magnitude"], 2.5, atol=1e-9)
    assert 5.0 < np.median(faint["scatter_fringes"] / bright["scatter_fringes"]) < 20.0
    single, coadd = (faint[faint["visits"] == visits] for visits in (1, 4))
    # Half the noise, so that the source has half the flux, in the same fringes.
    np.testing.assert_allclose(coadd["scatter_fringes"], 2.0 * single["scatter_fringes"], rtol=0.5)


def test_dithers_and_corrections_make_the_bias_smaller() -> None:
    found = of(frame(5e-3, 1e-3), frame(5e-3, -1e-3))
    single, coadd = (found[found["visits"] == visits] for visits in (1, 100))
    for quantity in ("", "e1_", "size_"):
        before, after = (np.asarray(found[f"{quantity}scatter_{when}"]) for when in ("fringes", "corrected"))
        assert (after < 0.6 * before).all()
    # A hundred places: a tenth of the fringes on sources of a tenth of the flux.
    ratio = np.asarray(coadd["scatter_fringes"]) / np.asarray(single["scatter_fringes"])
    np.testing.assert_allclose(ratio, 1.0, atol=0.6)


def test_frames_that_are_too_small() -> None:
    image = np.ones((40, 40), dtype=np.float32)
    small = SkyFringe(image, np.zeros(image.shape, np.int32), "fraction", 2700.0, 30.0, 1.2, 20.0, None, 0.0)
    assert sources_in_coadds([small], np.random.default_rng(1)) is None
    assert sources_in_coadds([frame(0.0)], np.random.default_rng(1), pixel_arcsec=1e-6) is None


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0])
def test_a_region_is_cut_as_that_of_the_coadd_is(angle: float) -> None:
    from lsst.fringe_sim.algorithms.coadd_sources import _pieces
    from lsst.fringe_sim.algorithms.coadds import _piece

    places = VisitPlaces(np.array([100.5]), np.array([80.0]), np.array([angle]), np.array([0]))
    pattern = np.sin(X / 11.0 + 1e-3 * Y**2 / 9.0).astype(np.float32)
    piece = _pieces([pattern], {"fringes": np.eye(1)}, places, 0, 31)["fringes"]
    other = _piece(spline_filter(pattern.astype(float), order=3), places, 0, 31, 1)
    np.testing.assert_allclose(piece - piece.mean(), other, atol=5e-3)
