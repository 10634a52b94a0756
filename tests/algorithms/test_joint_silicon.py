"""Silicon and adhesive fitted together, where flats with a narrow line allow it."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from scipy.stats import chi2

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.algorithms.thickness_fit import (
    Nuisances,
    SiliconFit,
    SiliconForecast,
    SiliconModel,
    SiliconSearch,
    find_silicon,
    silicon_map,
)
from lsst.fringe_sim.algorithms.thickness_fit.fit import amplitudes_from_cube
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import FringeSimError, InputError, OutOfRangeError
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube, ThicknessMap

SHAPE = (96, 104)
BROAD = np.arange(880.0, 991.0, 10.0)
NARROW = np.array([925.0, 938.0, 946.0, 957.0, 969.0, 983.0])
NARROW_NM = 0.3
NOISE = 0.004
ORDER_UM = 0.3


def places(size: int) -> np.ndarray:
    """Places of pixels: -1 in the first, 1 in the last, as in the effects of a sensor."""
    return np.linspace(-1.0, 1.0, size)


def sensor(
    coefficients: tuple[float, ...],
    rng: np.random.Generator,
    narrow_nm: float | None = NARROW_NM,
    noise: float = NOISE,
) -> tuple[FringeModel, np.ndarray, FringeCube]:
    """Broad flats, and narrow ones if wanted, of a sensor with tilted silicon.

    The response of every pixel comes from the model with the silicon of its column, not from the tables of the fit:
    the tilt is along x alone.
    """
    model = FringeModel.from_setup("ts8_e2v")
    truth = random_field(SHAPE, rng, mean=14.0, span=2.0)
    narrow = NARROW if narrow_nm is not None else NARROW[:0]
    wavelength = np.concatenate([BROAD, narrow])
    width = np.concatenate([np.full(BROAD.size, 2.0), np.full(narrow.size, narrow_nm or 0.0)])
    offset = coefficients[0] + (coefficients[1] if len(coefficients) > 1 else 0.0) * places(SHAPE[1])
    image = np.empty((wavelength.size, *SHAPE))
    columns_of = {value: np.flatnonzero(offset == value) for value in np.unique(offset)}
    for value, columns in columns_of.items():
        for rows in (slice(0, BROAD.size), slice(BROAD.size, None)):
            if width[rows].size == 0:
                continue
            settings = {"silicon_thickness.offset": float(value), "bandwidth.fwhm": float(width[rows][0])}
            seen = model.with_effects(settings)
            found = seen.response(truth[:, columns].ravel(), wavelength[rows])
            image[rows, :, columns] = found.reshape(-1, SHAPE[0], columns.size)
    image /= image.mean(axis=(1, 2), keepdims=True)
    image += noise * rng.standard_normal(image.shape)
    cube = FringeCube(
        image.astype(np.float32),
        np.full(image.shape, max(noise, 1e-6) ** 2, np.float32),
        np.zeros(image.shape, np.int16),
        FlatExposures(wavelength, width, np.array(model.setup.temperature_k)),
        "relative",
    )
    return model, truth, cube


def pulls(fitted, truth: np.ndarray) -> np.ndarray:
    good = fitted.mask == 0
    assert good.mean() > 0.98
    error = (fitted.value - truth)[good]
    assert np.count_nonzero(np.abs(error) > 0.5 * ORDER_UM) == 0
    return np.asarray(error / fitted.sigma[good])


def test_the_header_of_a_fit_holds_the_map_of_its_silicon() -> None:
    """Value and uncertainty with all correlations; none where the flats did not decide."""
    search = SiliconSearch(degree=2)
    spread = np.array([2e-4, 3e-4, 1e-4, 5e-4, 2e-4, 4e-4])
    correlation = np.eye(6)
    correlation[0, 3] = correlation[3, 0] = -0.7
    forecast = SiliconForecast(1e-4, 1e-6, 0.13, np.zeros(2), True, "seen")
    coefficients = np.array([0.3, -0.02, 0.01, 0.04, 0.0, -0.03])
    covariance = correlation * np.outer(spread, spread)
    found = SiliconFit(search, coefficients, covariance, 1.0, 1e-6, forecast)
    one = np.ones(SHAPE, np.float32)
    fitted = ThicknessMap(
        14.0 * one, 0.001 * one, one, 0.0 * one, np.zeros(SHAPE, np.int32), "adhesive", found.cards()
    )
    model = FringeModel.from_setup("ts8_e2v")
    silicon = silicon_map(fitted, model)
    assert silicon is not None
    offset, sigma = found.offset_um(SHAPE)
    np.testing.assert_allclose(silicon.value, 100.0 + offset, atol=1e-5)
    np.testing.assert_allclose(silicon.sigma, sigma, rtol=1e-3)
    undecided = replace(fitted, metadata={**fitted.metadata, "SIFIT": False})
    assert silicon_map(undecided, model) is None


@pytest.mark.slow
@pytest.mark.rng("one silicon for the sensor")
def test_one_silicon_for_the_sensor(rng, tmp_path, capsys) -> None:
    """Nearly three of its orders from the model, found with its uncertainty; without it the adhesive is wrong."""
    model, truth, cube = sensor((0.37,), rng)
    fitted = fit_thickness(cube, model, silicon=SiliconSearch())
    found = fitted.metadata
    assert found["SIFIT"] is True
    assert found["SICOEF0"] == pytest.approx(0.37, abs=5.0 * found["SISIGM0"] + 1e-6)
    assert 0.0 < found["SISIGM0"] < 1e-4
    pull = pulls(fitted, truth)
    assert pull.mean() == pytest.approx(0.0, abs=0.05)
    assert pull.std() == pytest.approx(1.0, abs=0.1)
    ignored = fit_thickness(cube, model)
    assert ((ignored.value - truth) / ignored.sigma).std() > 2.0
    cube.write_fits(tmp_path / "cube.fits")
    out = tmp_path / "fit"
    assert run(["fit", str(tmp_path / "cube.fits"), "--silicon", "sensor", "--out", str(out)]) == 0
    assert "silicon minus that of the model" in capsys.readouterr().out
    assert fits.getheader(out / "thickness.fits")["SICOEF0"] == found["SICOEF0"]
    silicon = ThicknessMap.read_any(out / "silicon.fits", "detection")
    np.testing.assert_allclose(silicon.value, 100.0 + found["SICOEF0"], rtol=1e-7)
    np.testing.assert_allclose(silicon.sigma, found["SISIGM0"], rtol=1e-5)
    assert silicon.metadata["LABTEMP"] == model.setup.temperature_k


@pytest.mark.slow
@pytest.mark.rng("tilted silicon")
def test_tilted_silicon(rng) -> None:
    """A tilt of almost two orders across the sensor."""
    model, truth, cube = sensor((-0.52, 0.11), rng)
    fitted = fit_thickness(cube, model, silicon=SiliconSearch(degree=1))
    found = fitted.metadata
    expected = (-0.52, 0.11, 0.0)
    for number, value in enumerate(expected):
        assert found[f"SICOEF{number}"] == pytest.approx(value, abs=5.0 * found[f"SISIGM{number}"] + 5e-6)
    silicon = silicon_map(fitted, model)
    assert silicon is not None
    offset = np.broadcast_to(-0.52 + 0.11 * places(SHAPE[1]), SHAPE)
    error = silicon.value.astype(float) - (100.0 + offset)
    assert np.abs(error).max() < 5.0 * silicon.sigma.max() + 2e-5  # single precision of 100 um
    # The mean of the sensor is known better than its edges.
    assert silicon.sigma[48, 52] < silicon.sigma[0, 0]
    pull = pulls(fitted, truth)
    assert pull.mean() == pytest.approx(0.0, abs=0.05)
    assert pull.std() == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.rng("pulls of a plane of silicon")
def test_pulls_of_a_plane(rng) -> None:
    """Mean and slopes scatter as stated when noise alone differs; a slope is from the middle to the last pixel."""
    true, draws = np.array([0.03, 0.1, 0.0]), 6
    model, truth, cube = sensor((0.03, 0.1), rng, noise=0.0)
    flats = SiliconModel(model, cube.wavelength_nm, cube.exposures.bandwidth_fwhm_nm)
    search = SiliconSearch(degree=1, span_um=0.1, tilt_um=0.12)
    total, variance = 0.0, np.full(cube.image.shape, NOISE**2, np.float32)
    for _ in range(draws):
        image = cube.image + NOISE * rng.standard_normal(cube.image.shape, np.float32)
        seen = amplitudes_from_cube(replace(cube, image=image, variance=variance))
        found = find_silicon(seen, truth.astype(np.float32), flats, search, ORDER_UM)
        error = found.coefficients - true
        total += float(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], true.size * draws)
    assert low < total < high


@pytest.mark.slow
@pytest.mark.rng("broad flats cannot tell and say so")
def test_broad_flats_cannot_tell_and_say_so(rng, tmp_path, capsys) -> None:
    """The adhesive is found all the same, with the fringes of the silicon as noise."""
    _, truth, cube = sensor((0.37,), rng, None)
    cube.write_fits(tmp_path / "cube.fits")
    out = tmp_path / "fit"
    assert run(["fit", str(tmp_path / "cube.fits"), "--silicon", "sensor", "--out", str(out)]) == 0
    assert "silicon not fitted" in capsys.readouterr().out
    assert not (out / "silicon.fits").exists()
    header = fits.getheader(out / "thickness.fits")
    assert header["SIFIT"] is False
    assert "SICOEF0" not in header
    value = fits.getdata(out / "thickness.fits", "VALUE")
    assert np.mean(np.abs(value - truth) > 0.5 * ORDER_UM) == 0.0


@pytest.mark.slow
@pytest.mark.rng("the forecast holds")
def test_the_forecast_holds(rng) -> None:
    """Narrower lines tell more, noise tells less, and the uncertainty found is the one foretold."""
    model, truth, cube = sensor((0.1,), rng)
    data = amplitudes_from_cube(cube)
    search = SiliconSearch()
    foretold = {}
    for width in (0.3, 0.6, 1.0):
        widths = np.where(cube.exposures.bandwidth_fwhm_nm < 1.0, width, 2.0)
        flats = SiliconModel(model, cube.wavelength_nm, widths)
        foretold[width] = find_silicon(data, truth, flats, search, ORDER_UM).forecast
    assert foretold[0.3].sigma_um < 0.5 * foretold[0.6].sigma_um < 0.25 * foretold[1.0].sigma_um
    flats = SiliconModel(model, cube.wavelength_nm, cube.exposures.bandwidth_fwhm_nm)
    assert foretold[0.3].fringe[: BROAD.size].max() < 0.05 * foretold[0.3].fringe[BROAD.size :].min()
    found = find_silicon(data, truth.astype(np.float32), flats, search, ORDER_UM)
    assert found.decided
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(found.forecast.sigma_um, rel=0.3)
    assert found.chi2 == pytest.approx(1.0, abs=0.05)
    offset, sigma = found.offset_um((5, 7))
    assert offset.shape == sigma.shape == (5, 7)
    assert np.ptp(offset) == 0.0


@pytest.mark.rng("what cannot be combined is refused")
def test_what_cannot_be_combined_is_refused(rng) -> None:
    model = FringeModel.from_setup("ts8_e2v")
    _, _, cube = sensor((0.0,), rng, None)
    for choice in ({"method": "guo2022"}, {"nuisances": Nuisances(level=True)}):
        with pytest.raises(InputError, match="silicon"):
            fit_thickness(cube, model, silicon=SiliconSearch(), **choice)
    with pytest.raises(InputError, match="varying layer"):
        SiliconModel(FringeModel.from_setup("ts8_itl"), BROAD, np.full(BROAD.size, 2.0))
    for choice in ({"degree": 3}, {"span_um": 0.0}, {"tilt_um": -1.0}, {"slip_limit": 2.0}):
        with pytest.raises(OutOfRangeError):
            SiliconSearch(**choice)
    assert issubclass(OutOfRangeError, FringeSimError)
