"""Fit of one pixel, and the one public set of laboratory numbers."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.single_pixel import fit_single_pixel, published_pixel
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import FringeModel, Setup

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)


@pytest.fixture(scope="module")
def detection() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def amplitude_of(model: FringeModel, thickness_um: float) -> np.ndarray:
    low, high = model.setup.thickness_range_um
    mean = model.response(np.linspace(low, high, 4001), WAVELENGTHS).mean(axis=1)
    return model.response(thickness_um, WAVELENGTHS) / mean - 1.0


@pytest.mark.rng("recovers thickness contrast and offset")
def test_recovers_thickness_contrast_and_offset(detection, rng) -> None:
    truth = rng.uniform(6.0, 28.0)
    data = 0.4 * amplitude_of(detection, truth) - 0.003
    fit = fit_single_pixel(WAVELENGTHS, data, detection, free_contrast=True, free_offset=True)
    assert fit.thickness_um == pytest.approx(truth, abs=0.0021)
    assert fit.contrast == pytest.approx(0.4, rel=0.02)
    assert fit.offset == pytest.approx(-0.003, abs=5e-4)


def test_refuses_too_few_wavelengths(detection) -> None:
    with pytest.raises(InputError, match="4 or more"):
        fit_single_pixel([900, 910, 920], [0, 0, 0], detection, free_contrast=True, free_offset=True)


def test_refuses_missing_values(detection) -> None:
    with pytest.raises(InputError, match="finite"):
        fit_single_pixel([900, 910, 920], [0, np.nan, 0], detection)


@pytest.mark.shared
def test_shipped_numbers_are_the_published_ones(shared_dir) -> None:
    from astropy.table import Table

    table = Table.read(shared_dir / "measured" / "fit_example_amplitudes.ecsv", format="ascii.ecsv")
    wavelength, amplitude = published_pixel()
    np.testing.assert_allclose(wavelength, table["wavelength"])
    np.testing.assert_allclose(amplitude, table["amp_measured"], atol=1e-6)


class TestPublishedPixel:
    """What the twelve measured points say (section 3 of the paper, with its observable corrected)."""

    def test_undamped_detection_layer_is_far_too_strong(self, detection) -> None:
        fit = fit_single_pixel(*published_pixel(), detection, free_offset=True)
        damped = fit_single_pixel(*published_pixel(), detection, free_contrast=True, free_offset=True)
        assert fit.rms > 5.0 * damped.rms

    def test_one_contrast_and_one_offset_explain_most(self) -> None:
        """With the constants of silicon that the paper uses, and to which the numbers belong."""
        detection = FringeModel.from_setup(Setup.from_name("ts8_e2v").with_silicon("Si_green2008"))
        wavelength, amplitude = published_pixel()
        contrast_only = fit_single_pixel(wavelength, amplitude, detection, free_contrast=True)
        both = fit_single_pixel(wavelength, amplitude, detection, free_contrast=True, free_offset=True)
        assert contrast_only.rms == pytest.approx(0.0064, abs=0.0002)
        assert both.rms == pytest.approx(0.0030, abs=0.0002)
        assert both.contrast == pytest.approx(0.13, abs=0.01)
        assert both.offset == pytest.approx(-0.0058, abs=0.0005)

    def test_cold_silicon_leaves_more_contrast(self, detection) -> None:
        """It absorbs more, so that less light comes back from the adhesive."""
        fit = fit_single_pixel(*published_pixel(), detection, free_contrast=True, free_offset=True)
        assert fit.contrast == pytest.approx(0.146, abs=0.005)
        assert fit.rms < 0.0033

    def test_the_two_observables_differ_by_half_an_order(self, detection) -> None:
        """Absorption in the detection layer and 1 - R - T are anti-correlated in thickness."""
        total = FringeModel.from_setup("ts8_e2v", observable="total")
        options = {"free_contrast": True, "free_offset": True, "range_um": (16.2, 17.4)}
        by_detection = fit_single_pixel(*published_pixel(), detection, **options)
        by_total = fit_single_pixel(*published_pixel(), total, **options)
        assert abs(by_total.thickness_um - by_detection.thickness_um) == pytest.approx(0.15, abs=0.03)
