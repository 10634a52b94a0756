"""Of the pixels that are said to slip with some probability, that share does."""

import itertools

import numpy as np
import pytest

from lsst.fringe_sim.algorithms import fit_thickness, forecast_flats
from lsst.fringe_sim.algorithms.flat_plan import PlannedFlat
from lsst.fringe_sim.algorithms.thickness_fit import Amplitudes, make_templates
from lsst.fringe_sim.algorithms.thickness_fit.cells import Cells
from lsst.fringe_sim.algorithms.thickness_fit.evidence import order_evidence
from lsst.fringe_sim.algorithms.thickness_fit.templates import pad_wavelengths
from lsst.fringe_sim.algorithms.thickness_fit.uncertainty import lone_slip_probability
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube, mask_bits

TEN_NM = np.arange(880.0, 991.0, 10.0)
RANGE_UM = (7.0, 15.0)
SEARCH_UM = (5.0, 20.0)
SIDE_PX, PITCH_PX, ISLANDS = 8, 16, 24
READ_NOISE_E = 7.0
BINS = (0.0, 0.01, 0.05, 0.1, 0.2, 0.4, 1.01)


def archipelago(
    model: FringeModel, wavelengths: np.ndarray, electrons: float, slope: float, rng: np.random.Generator
) -> tuple[np.ndarray, FringeCube]:
    """Islands of good pixels that masked ones keep apart, so that each must find its order alone."""
    size = ISLANDS * PITCH_PX
    truth = np.full((size, size), np.nan)
    ramp = slope * np.add.outer(np.arange(SIDE_PX) - 3.5, np.arange(SIDE_PX) - 3.5)
    for y in range(0, size, PITCH_PX):
        for x in range(0, size, PITCH_PX):
            truth[y : y + SIDE_PX, x : x + SIDE_PX] = rng.uniform(*RANGE_UM) + ramp
    known = np.isfinite(truth)
    table = model.table((RANGE_UM[0] - 0.5, RANGE_UM[1] + 0.5), wavelengths)
    filled = np.where(known, truth, RANGE_UM[0]).astype(np.float32)
    counts = np.stack([table.frame(filled, row) for row in range(len(wavelengths))]).astype(float)
    counts *= electrons / counts[:, known].mean(axis=1)[:, None, None]
    variance = counts + READ_NOISE_E**2
    image = counts + np.sqrt(variance) * rng.standard_normal(counts.shape)
    mask = np.broadcast_to(np.where(known, 0, mask_bits("BAD")).astype(np.int16), image.shape).copy()
    exposures = FlatExposures(wavelengths, np.array(2.0), np.array(183.15))
    return truth, FringeCube(
        (image / electrons).astype(np.float32),
        (variance / electrons**2).astype(np.float32),
        mask,
        exposures,
        "relative",
    )


def check_reliability(said: np.ndarray, wrong: np.ndarray, tolerance: float) -> None:
    """In every bin of probability the share that is wrong is the mean that was said, within the count error."""
    for low, high in itertools.pairwise(BINS):
        chosen = (said >= low) & (said < high)
        if chosen.sum() >= 20:
            mean, share = float(said[chosen].mean()), float(wrong[chosen].mean())
            error = np.sqrt(mean * (1.0 - mean) / chosen.sum()) + 1.0 / chosen.sum()
            assert abs(share - mean) < tolerance * mean + 4.0 * error, (low, high, mean, share, chosen.sum())


@pytest.mark.parametrize(
    ("contrast", "step", "electrons", "slope"),
    [
        (0.15, 1, 8_000.0, 1e-4),
        (0.15, 1, 8_000.0, 2e-3),
        (0.3, 2, 20_000.0, 1e-4),
        # Most sensors slip at twice the forecast, and two of eleven at six and fourteen times it: of these the fit
        # itself says so, the forecast does not.
        pytest.param(
            1.0, 3, 20_000.0, 0.0, marks=pytest.mark.xfail(reason="forecast of four flats too good")
        ),
    ],
)
@pytest.mark.rng("slips of regions")
def test_regions_slip_as_often_as_said_and_as_forecast(contrast, step, electrons, slope, rng) -> None:
    model = FringeModel.from_setup("ts8_e2v", {"contrast_loss.factor": contrast})
    wavelengths = TEN_NM[::step]
    said, wrong, unflagged = [], [], 0
    centre = slice(SIDE_PX // 2, None, PITCH_PX)
    for _ in range(3):
        truth, cube = archipelago(model, wavelengths, electrons, slope, rng)
        fitted = fit_thickness(cube, model, range_um=SEARCH_UM, cell_px=SIDE_PX)
        off = (np.abs(fitted.value - truth) > 0.1)[centre, centre]
        said.append(fitted.slip_probability[centre, centre].ravel())
        wrong.append(off.ravel())
        unflagged += int((off & (fitted.mask[centre, centre] == 0)).sum())
    said, wrong = np.concatenate(said), np.concatenate(wrong)
    check_reliability(said, wrong, tolerance=0.35)
    forecast = forecast_flats(
        model,
        [PlannedFlat(float(value), electrons) for value in wavelengths],
        RANGE_UM,
        search_um=SEARCH_UM,
        read_noise_e=READ_NOISE_E,
        region_px=SIDE_PX**2,
    )
    expected = float(forecast.region_slip.mean())
    assert wrong.mean() == pytest.approx(expected, rel=0.35, abs=4.0 * np.sqrt(expected / wrong.size))
    assert unflagged <= 0.002 * wrong.size


@pytest.mark.parametrize(("step", "electrons"), [(1, 20_000.0), (2, 20_000.0)])
@pytest.mark.rng("lone pixels slip as often as said")
def test_lone_pixels_slip_as_often_as_said(step, electrons, rng) -> None:
    """Every pixel by itself, without neighbours and without a path: the order of least chi-square."""
    model = FringeModel.from_setup("ts8_e2v")
    wavelengths = TEN_NM[::step]
    search = (6.0, 14.0)
    templates = make_templates(model, wavelengths, search).normalised_to(np.linspace(7.0, 12.0, 20_001))
    truth = rng.uniform(7.0, 12.0, (100, 100))
    clean = templates.amplitude_at(truth)
    variance = (electrons * (1.0 + clean) + READ_NOISE_E**2) / electrons**2
    noisy = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
    value, weight = (pad_wavelengths(np.moveaxis(part, 0, -1)) for part in (noisy, 1.0 / variance))
    none = np.zeros_like(value)
    order = templates.order_um()
    single = Cells(value, weight, none, none, np.arange(101), np.arange(101))
    best = order_evidence(single, templates, order, range_um=search).best_um
    said = lone_slip_probability(Amplitudes.from_arrays(noisy, variance), templates, best, order)
    wrong = np.abs(best - truth) > 0.25 * order
    check_reliability(said.ravel(), wrong.ravel(), tolerance=0.1)
    assert said.mean() == pytest.approx(wrong.mean(), rel=0.1, abs=3.0 * np.sqrt(wrong.mean() / wrong.size))
