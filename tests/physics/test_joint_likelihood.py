"""The joint likelihood of public data against own lines: own waves, own misfits, own sums over what is not known.

Only numbers are shared: the tables of the media, the measured values, and the uncertainties that are stated of them.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from field_matrices import ForeignSensor
from foreign_sky import DATA
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp

from lsst.fringe_sim.algorithms.public_evidence.joint import JointFit, Predictor, parse_set
from lsst.fringe_sim.algorithms.public_evidence.kinds import FlatContrast, PixelFlats, PublishedMap

LINE_NM = 2.0
SHIFT_UM = np.arange(-300, 301) / 200.0  # Shifts of the map, five orders either way, all as likely

PHOTON_NOISE, UNEVEN = 7e-4, 0.03
"""Of the pixel's amplitudes: noise, and width of a free offset and of a free slope, at either end of the flats."""

MAP_UM = PixelFlats.published().map_um
"""The published map at pixel (2100, 2100), 17.53 µm by the spline that is shipped of it."""

ABSORPTION = 1e-3 * np.array([*range(17), 20.0, 30.0, 50.0])
"""Absorption of the adhesive at which waves are summed; predictions between are interpolated."""

LOG_FACTOR = 12.0 * np.linspace(0.0, 1.0, 2001) ** 2
"""Logarithm of factors on a stated uncertainty over which a likelihood is summed; every magnitude is as likely."""


def table(name: str) -> dict[str, np.ndarray]:
    """Columns of a shipped table of numbers."""
    text = (DATA / "laboratory" / f"{name}.ecsv").read_text()
    rows = [line.split() for line in text.splitlines() if line[0] != "#"]
    return dict(zip(rows[0], np.array(rows[1:], dtype=float).T, strict=True))


def flat(sensor: ForeignSensor, wavelength_nm: float, adhesive_um: np.ndarray) -> np.ndarray:
    """Light of a Gaussian line of 2 nm that the detection layer takes."""
    away = np.linspace(-3.5, 3.5, 41)
    share = np.exp(-0.5 * away**2) / np.exp(-0.5 * away**2).sum()
    return np.asarray(share @ sensor.absorbed(wavelength_nm + LINE_NM / 2.3548 * away, adhesive_um))


def pixel_amplitudes(sensor: ForeignSensor, contrast: float = 1.0) -> np.ndarray:
    """Fringe amplitudes of the pixel, ``(wavelengths, shifts)``; ``contrast`` is about the mean of one order."""
    rows = []
    for wavelength in table("e2v_321_pixel_2100_2100")["wavelength"]:
        order = MAP_UM + 0.5e-3 * wavelength / 1.6 * np.arange(24) / 24.0
        light, mean = flat(sensor, wavelength, MAP_UM + SHIFT_UM), flat(sensor, wavelength, order).mean()
        light = mean + contrast * (light - mean)
        rows.append(light / light.mean() - 1.0)
    return np.array(rows)


def block_contrasts(sensor: ForeignSensor) -> np.ndarray:
    """Logarithm of the contrast of every block of the 960 nm flat, ``(blocks, 1)``."""
    turn = np.arange(12) / 12.0
    places = table("e2v_321_contrast_960nm")["thickness"][:, np.newaxis] + 0.3 * (turn - 0.5)
    light = flat(sensor, 960.0, places.ravel()).reshape(places.shape)
    first = 2.0 * np.abs((light * np.exp(2j * np.pi * turn)).mean(axis=1)) / light.mean(axis=1)
    return np.log(first)[:, np.newaxis]


def misfit(residual: np.ndarray, sigma: np.ndarray, terms: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Least χ² over coefficients of linear terms that are known to be small, ``(..., shifts)``.

    A Gaussian integral over them is that, but for a constant.
    """
    columns = np.moveaxis(residual / sigma[:, np.newaxis], -2, 0).reshape(sigma.size, -1)
    design = np.concatenate([terms * width / sigma[:, np.newaxis], np.eye(width.size)])
    columns = np.concatenate([columns, np.zeros((width.size, columns.shape[1]))])
    left = columns - design @ np.linalg.lstsq(design, columns, rcond=None)[0]
    return np.asarray((left**2).sum(axis=0).reshape(*residual.shape[:-2], residual.shape[-1]))


def scaled(chi2: np.ndarray, number: int) -> np.ndarray:
    """Logarithm of the sum of likelihoods over factors on all uncertainties of a kind of so many values."""
    tried = np.geomspace(1e-3, 1e7, 1500)
    logs = -number * LOG_FACTOR - 0.5 * tried[:, np.newaxis] * np.exp(-2.0 * LOG_FACTOR)
    most = logs.max(axis=1, keepdims=True)
    logs = most[:, 0] + np.log(np.trapezoid(np.exp(logs - most), LOG_FACTOR, axis=1))
    return np.asarray(np.interp(np.log(np.maximum(chi2, tried[0])), np.log(tried), logs))


def log_of_pixel(amplitudes: np.ndarray) -> np.ndarray:
    pixel = table("e2v_321_pixel_2100_2100")
    wavelength = pixel["wavelength"]
    place = (wavelength - wavelength.mean()) / (0.5 * np.ptp(wavelength))
    terms = np.stack([np.ones(12), place], axis=1)
    residual = pixel["amplitude"][:, np.newaxis] - amplitudes
    return scaled(misfit(residual, np.full(12, PHOTON_NOISE), terms, np.full(2, UNEVEN)), 12)


def log_of_contrast(contrasts: np.ndarray) -> np.ndarray:
    """Scatter of 8 % beside the error of every block; 5 % of calibration, 10 % for each term of the place."""
    block = table("e2v_321_contrast_960nm")
    y, x = block["y"] / 2002.0 - 1.0, block["x"] / 2048.0 - 1.0
    terms = np.stack([np.ones_like(y), y, x, y * x, y**2, x**2], axis=1)
    sigma = np.hypot(0.08, block["contrast_error"] / block["contrast"])
    residual = np.log(block["contrast"])[:, np.newaxis] - contrasts
    return scaled(misfit(residual, sigma, terms, np.array([0.05, 0.1, 0.1, 0.1, 0.1, 0.1])), y.size)


def log_of_map() -> np.ndarray:
    """The published map may be an order off."""
    return scaled((SHIFT_UM / 0.3) ** 2, 1)


@dataclass
class Summed:
    """Evidence and posterior of one parameter on a dense grid, with a Cauchy prior about its null."""

    value: np.ndarray
    log_likelihood: np.ndarray  # ``(values, shifts)``
    null: float
    scale: float

    @property
    def log_weight(self) -> np.ndarray:
        prior = 1.0 / (1.0 + ((self.value - self.null) / self.scale) ** 2)
        prior = prior / np.trapezoid(prior, self.value) * np.gradient(self.value)
        return np.asarray(np.log(prior) + logsumexp(self.log_likelihood, axis=-1) - np.log(SHIFT_UM.size))

    @property
    def log_evidence(self) -> float:
        return float(logsumexp(self.log_weight))

    @property
    def moments(self) -> tuple[float, float]:
        weight = np.exp(self.log_weight - self.log_evidence)
        mean = float(weight @ self.value)
        return mean, float(np.sqrt(weight @ (self.value - mean) ** 2))


def test_one_factor_on_the_contrast_of_one_pixel() -> None:
    """Twelve amplitudes and the map: what the factor is, and what it gains over plane layers."""
    kinds = [PixelFlats.published(), PublishedMap.published()]
    none, one = (JointFit(parse_set(names), Predictor(kinds)) for names in ([], ["contrast_loss"]))
    plain, without = pixel_amplitudes(ForeignSensor()), pixel_amplitudes(ForeignSensor(), 0.0)
    assert np.abs(without).max() < 1e-6
    factor = np.linspace(0.0, 1.5, 751)
    own = Summed(factor, log_of_pixel(factor[:, np.newaxis, np.newaxis] * plain) + log_of_map(), 1.0, 0.3)
    of_none = float(logsumexp(log_of_pixel(plain) + log_of_map()) - np.log(SHIFT_UM.size))
    assert none.log_evidence == pytest.approx(of_none, abs=0.03)
    assert one.log_evidence == pytest.approx(own.log_evidence, abs=0.05)
    assert own.log_evidence - of_none > 10.0
    assert one.values["contrast_loss.factor"] == pytest.approx(own.moments, rel=0.03)


@pytest.mark.slow
def test_an_adhesive_that_absorbs_given_pixel_contrast_and_map() -> None:
    """Evidence, value, and what the others say of each kind, with eight free linear terms."""
    kinds = [PixelFlats.published(), FlatContrast.published(), PublishedMap.published()]
    fit = JointFit(parse_set(["epoxy_absorption"]), Predictor(kinds))
    sensors = [ForeignSensor(epoxy_k=float(k)) for k in ABSORPTION]
    k = np.unique(np.concatenate([np.linspace(0.0, 0.012, 481), np.linspace(0.012, 0.05, 77)]))
    logs = []
    for predicted, log_of in ((pixel_amplitudes, log_of_pixel), (block_contrasts, log_of_contrast)):
        smooth = CubicSpline(ABSORPTION, [predicted(sensor) for sensor in sensors])
        logs.append(np.concatenate([log_of(smooth(some)) for some in np.array_split(k, 8)]))
    of_pixel, of_contrast = logs

    def summed(*terms: np.ndarray) -> Summed:
        return Summed(k, sum(terms) + np.zeros((k.size, SHIFT_UM.size)), 0.0, 0.002)

    own = summed(of_pixel, of_contrast, log_of_map())
    assert fit.log_evidence == pytest.approx(own.log_evidence, abs=0.1)
    assert fit.values["epoxy_absorption.k"] == pytest.approx(own.moments, rel=0.03)
    rest = (summed(of_contrast, log_of_map()), summed(of_pixel, log_of_map()), summed(of_pixel, of_contrast))
    for kind, others in zip(kinds, rest, strict=True):
        foretold = own.log_evidence - others.log_evidence
        assert fit.log_predictive(kind) == pytest.approx(foretold, abs=0.1), kind.name
