"""Sources in copies of frames, whose fluxes are known."""

import galsim
import numpy as np
import pytest
from observed_night import observed_night

from lsst.fringe_sim.algorithms.correction.injection import (
    InjectionOptions,
    Source,
    inject_sources,
    injection_table,
)
from lsst.fringe_sim.errors import InputError

PIXEL = 0.4


def measured(image, fringes, free, **options):
    """Fluxes where the fringes are known, and taken off by hand."""
    level = np.float32(np.median(image))
    return inject_sources(
        image,
        free,
        45.0,
        PIXEL,
        lambda crowded: (crowded - level, (crowded - level - fringes).astype(np.float32)),
        InjectionOptions(**options),
    )


@pytest.mark.rng("fringes scatter the fluxes of faint sources")
def test_fringes_scatter_the_fluxes_of_faint_sources(rng):
    night = observed_night(rng, 1, side=400, strength=0.05, stars=0)
    image, fringes = night.images[0], night.fringes[0]
    free = np.ones(image.shape, dtype=bool)
    free[:, 198:202] = False
    before = image.copy()
    table = injection_table("one", measured(image, fringes, free, number=40))
    np.testing.assert_array_equal(image, before)
    assert set(table["kind"]) == {"point", "extended"}
    assert (table["number"] > 20).all()
    assert (np.abs(table["bias_after"]) < 4.0 * table["bias_after_sigma"]).all()
    faint = table[table["magnitude"] > np.median(table["magnitude"])]
    assert (faint["scatter_after"] < 0.7 * faint["scatter_before"]).all()
    # The noise of the sky in the aperture, and that of the ring's median, which is smaller.
    stars = table[table["kind"] == "point"]
    np.testing.assert_allclose(stars["scatter_after"] * [10.0, 30.0, 100.0], 1.0, atol=0.45)


@pytest.mark.rng("sources without fringes keep their fluxes")
def test_bright_sources_keep_their_fluxes(rng):
    image = rng.normal(1000.0, 1.0, (300, 300)).astype(np.float32)
    found = measured(image, np.zeros(image.shape), image > 0.0, number=5, signal_to_noise=(1000.0,))
    for each in found:
        np.testing.assert_allclose(each.before, 0.0, atol=2e-3)


def test_fluxes_sizes_and_ellipticities_are_those_of_the_drawn():
    """A star that is longer by a known distortion, and one that is wider, on a sky that is not 0."""
    star, _ = Source.of_all(InjectionOptions(), 0.2)
    side = star.stamp.shape[0]
    for shape, size in ((0.0, 1.0), (0.05, 1.0), (0.0, 1.1)):
        drawn = galsim.Moffat(beta=3.0, fwhm=0.8 * size).shear(e1=shape)
        image = 40.0 + 500.0 * drawn.drawImage(nx=side, ny=side, scale=0.2).array
        flux, e1, e2, larger = star.departure(image, 500.0)
        # The pixel is round and does not grow: it takes a few per cent off both.
        assert e1 == pytest.approx(shape, rel=0.1, abs=1e-6)
        assert e2 == pytest.approx(0.0, abs=1e-6)
        assert larger == pytest.approx(size - 1.0, rel=0.15, abs=2e-3)
        if size == 1.0:
            assert flux == pytest.approx(0.0, abs=2e-3)


@pytest.mark.rng("an image without a source has no shape")
def test_a_source_without_a_shape_is_counted(rng):
    image = rng.normal(0.0, 45.0, (300, 300)).astype(np.float32)
    found = measured(
        image, np.zeros(image.shape), np.ones(image.shape, dtype=bool), number=20, signal_to_noise=(0.3,)
    )
    table = injection_table("one", found)
    assert (table["shapes"] < table["number"]).any()
    assert np.isfinite(table["bias_after"]).all()


def test_a_frame_without_free_places_is_refused():
    with pytest.raises(InputError, match="free places"):
        measured(np.ones((50, 50), dtype=np.float32), np.zeros((50, 50)), np.zeros((50, 50), dtype=bool))
