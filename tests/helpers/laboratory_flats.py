"""Flats of sensors that are not as the model has them, and how a thickness map stands up to them.

The optics are those of `field_matrices`, which share nothing with the package but the tables of the media.
`benchmarks/laboratory.py` prints a table of them.
"""

import time
from dataclasses import dataclass
from typing import Any

import field_matrices
import numpy as np
from field_matrices import ForeignSensor
from scipy.ndimage import gaussian_filter1d
from scipy.special import erfc

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube, ThicknessMap

TEN_NM = np.arange(880.0, 991.0, 10.0)
ORDER_UM = 0.3
GRID_UM = 0.002
CERTAIN = 25.0
READ_NOISE_E = 7.0


@dataclass(frozen=True)
class Laboratory:
    """What differs from the model."""

    contrast: float = 1.0  # Factor on the fringes
    roughness_nm: float = 0.0  # Rms of the layer inside a pixel
    line: float = 1.0  # As of `ForeignSensor`
    epoxy_k: float = 0.0
    gradient: float = 0.0  # Illumination from edge to edge along a random direction, and from middle to edge
    bowl: float = 0.0
    gains: float = 0.0  # Rms of the gains of 8 by 2 amplifiers
    offsets_nm: float = 0.0  # Rms of what the wavelengths miss their labels by
    mislabelled_nm: float = 0.0  # What one flat misses its label by
    electrons: float = 20_000.0  # Level of the flats


ROWS: dict[str, Laboratory] = {
    "as the model": Laboratory(),
    "contrast 0.5": Laboratory(contrast=0.5),
    "contrast 0.25": Laboratory(contrast=0.25),
    "contrast 0.13": Laboratory(contrast=0.13),
    "contrast 0.05": Laboratory(contrast=0.05),
    "contrast 0.05, 5000 e-": Laboratory(contrast=0.05, electrons=5_000.0),
    "epoxy k 0.005": Laboratory(epoxy_k=0.005),
    "roughness 80 nm": Laboratory(roughness_nm=80.0),
    "line of 6 nm": Laboratory(line=3.0),
    "roughness 80 nm, gradient 3 %": Laboratory(roughness_nm=80.0, gradient=0.03),
    "contrast 0.3, gradient 2 %": Laboratory(contrast=0.3, gradient=0.02),
    "gains 1 %": Laboratory(gains=0.01),
    "contrast 0.13, gains 1 %": Laboratory(contrast=0.13, gains=0.01),
    "wavelengths 0.6 nm": Laboratory(offsets_nm=0.6),
    "contrast 0.13, wavelengths 1 nm": Laboratory(contrast=0.13, offsets_nm=1.0),
    "one flat 2 nm off": Laboratory(mislabelled_nm=2.0),
    "contrast 0.13, one flat 2 nm off": Laboratory(contrast=0.13, mislabelled_nm=2.0),
}


@dataclass(frozen=True)
class Result:
    """How a map compares with the truth: shares of pixels, σ in nm, width of the pulls of right orders.

    ``own`` is the width of the pulls about their mean, without the uncertainty that all pixels share; ``common`` is
    the mean error over its uncertainty, one number for a sensor: that of the scale, which all pixels share, and the
    scatter of the means of 4 by 4 parts of the map over their number, as errors of neighbours are not independent.
    ``margin`` is the chi-square by which the next order is
    said to be worse, and ``right`` whether the order of the sensor is right, masked or not. ``foretold`` is the share
    of unmasked pixels that their uncertainty alone puts off by more than half an order.
    """

    wrong: float
    masked: float
    sigma_nm: float
    pull: float
    slip: float
    seconds: float
    misfit: float
    own: float
    common: float
    margin: float
    right: bool
    foretold: float

    def __str__(self) -> str:
        return (
            f"wrong {self.wrong:8.1e} (foretold {self.foretold:7.1e})  masked {self.masked:7.1e}  "
            f"sigma {self.sigma_nm:6.2f} nm  pulls {self.pull:5.2f}  own {self.own:5.2f}  "
            f"common {self.common:+5.2f}  slip {self.slip:7.1e}  misfit {self.misfit:5.2f}  "
            f"margin {self.margin:6.4g}  {self.seconds:5.1f} s"
        )


def make_flats(
    laboratory: Laboratory,
    thickness_um: np.ndarray,
    rng: np.random.Generator,
    bands: np.ndarray = TEN_NM,
    noisy: bool = True,
) -> FringeCube:
    """Flats of a map in electrons over their mean; without noise, but with its variances, if not ``noisy``."""
    sensor = ForeignSensor(line=laboratory.line, epoxy_k=laboratory.epoxy_k)
    true_nm = bands + laboratory.offsets_nm * rng.standard_normal(bands.size)
    true_nm[bands.size // 2] += laboratory.mislabelled_nm
    grid = np.arange(thickness_um.min() - 0.5, thickness_um.max() + 0.5, GRID_UM)
    away = np.linspace(-3.5, 3.5, 81)
    share = np.exp(-0.5 * away**2)
    share /= share.sum()
    width = laboratory.line * field_matrices.LINE_NM / np.sqrt(8.0 * np.log(2.0))
    light = illumination(laboratory, thickness_um.shape, rng)
    images = []
    for middle in true_nm:
        response = share @ sensor.absorbed(middle + width * away, grid)
        if laboratory.roughness_nm:
            response = gaussian_filter1d(response, 1e-3 * laboratory.roughness_nm / GRID_UM)
        response = response.mean() + laboratory.contrast * (response - response.mean())
        image = np.interp(thickness_um, grid, response) * light
        images.append(laboratory.electrons * image / image.mean())
    counts = np.array(images)
    variance = counts + READ_NOISE_E**2
    counts = counts + noisy * np.sqrt(variance) * rng.standard_normal(counts.shape)
    return FringeCube(
        (counts / laboratory.electrons).astype(np.float32),
        (variance / laboratory.electrons**2).astype(np.float32),
        np.zeros(counts.shape, np.int16),
        FlatExposures(bands, np.array(2.0), np.array(field_matrices.KELVIN)),
        "relative",
    )


def illumination(laboratory: Laboratory, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Light times gain, the same at all wavelengths."""
    y, x = (2.0 * index / (length - 1) - 1.0 for index, length in zip(np.indices(shape), shape, strict=True))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    light = 1.0 + 0.5 * laboratory.gradient * (np.cos(angle) * x + np.sin(angle) * y)
    light = light - laboratory.bowl * 0.5 * (x * x + y * y)
    gains = 1.0 + laboratory.gains * rng.standard_normal((2, 8))
    rows = (np.arange(shape[0]) >= shape[0] // 2).astype(int)
    columns = np.searchsorted([shape[1] * k // 8 for k in range(1, 8)], np.arange(shape[1]), side="right")
    return np.asarray(light * gains[rows][:, columns])


def judge(fitted: ThicknessMap, truth: np.ndarray, seconds: float = 0.0) -> Result:
    """Compare a map with the truth."""
    good = fitted.mask == 0
    error = (fitted.value - truth)[good]
    right = np.abs(error) < 0.5 * ORDER_UM
    sigma = fitted.sigma[good].astype(float)
    pull = (error / sigma)[right]
    shared = float(fitted.metadata.get("SCALESIG", 0.0)) * fitted.value[good].astype(float)
    mean = float(error[right].mean()) if right.any() else float("nan")
    uneven = scatter_of_mean(np.where(good, fitted.value - truth, np.nan))
    own = ((error - mean) / np.sqrt(np.maximum(sigma**2 - shared**2, 1e-12)))[right]
    return Result(
        float(1.0 - right.mean()) if right.size else 0.0,
        float(1.0 - good.mean()),
        1e3 * float(np.median(fitted.sigma[good])) if good.any() else float("nan"),
        float(np.sqrt(np.mean(pull.astype(float) ** 2))) if pull.size else float("nan"),
        float(np.median(fitted.slip_probability)),
        seconds,
        float(fitted.metadata.get("MISFIT", 0.0)),
        float(np.sqrt(np.mean(own**2))) if own.size else float("nan"),
        float(mean / np.hypot(shared.mean(), uneven)) if own.size and shared.any() else 0.0,
        float(fitted.metadata.get("ORDMARG", np.inf)),
        abs(float(np.nanmedian(fitted.value - truth))) < 0.5 * ORDER_UM,
        float(np.mean(erfc(0.5 * ORDER_UM / (np.sqrt(2.0) * sigma)))) if good.any() else 0.0,
    )


def scatter_of_mean(error: np.ndarray) -> float:
    """Uncertainty of the mean error of right orders, from its scatter over 4 by 4 parts of a map."""
    right = np.where(np.abs(error) < 0.5 * ORDER_UM, error, np.nan)
    parts = [part for strip in np.array_split(right, 4) for part in np.array_split(strip, 4, axis=1)]
    means = [float(np.nanmean(part)) for part in parts if np.isfinite(part).any()]
    return float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else 0.0


def draw_map(rng: np.random.Generator, size: int) -> np.ndarray:
    """Thickness of a sensor [um]."""
    mean, span = rng.uniform(10.0, 18.0), rng.uniform(1.0, 2.5) * size / 256.0
    return random_field((size, size), rng, mean=mean, span=span)


def fit_one(
    laboratory: Laboratory, seed: int, model: FringeModel, size: int, noisy: bool = True, **options: Any
) -> tuple[ThicknessMap, Result]:
    """Fit one map that a seed draws."""
    rng = np.random.default_rng(seed)
    truth = draw_map(rng, size)
    cube = make_flats(laboratory, truth, rng, noisy=noisy)
    start = time.process_time()
    fitted = fit_thickness(cube, model, **options)
    return fitted, judge(fitted, truth, time.process_time() - start)


def expected_margin(laboratory: Laboratory, seed: int, model: FringeModel, size: int) -> float:
    """Chi-square by which the best rival of the true order is worse, all nuisances being free; 0 if one is better.

    The chi-square differences of flats without noise, with its variances, are those expected.
    """
    result = fit_one(laboratory, seed, model, size, noisy=False)[1]
    return result.margin if result.right else 0.0
