"""Fringe correction of exposures by templates, and how much fringe is left.

The measurement follows that of the LSST Science Pipelines: at many random positions the level of a small aperture
less that of a large one, on the exposure and on every template; the scales of the templates are the least-squares
solution between the two, with outlying positions (sources) clipped away in several rounds. Three things are done
differently. An exposure that offers too few positions is returned as it is, and says so. Inputs are never changed.
And the level of an aperture is the mean of the same pixels on exposure and template, clipped on the exposure: the
median of a noiseless template is another function of the fringe than the median of a noisy exposure, which makes the
scales of fringes below the noise too large (by 16 % for a 30 s exposure of LSST in y).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import uniform_filter

from ..compiled import kernel, run_shares
from ..errors import InputError, OutOfRangeError
from ..products import CORRECTED, FringeFrame, refuse_corrected
from .sky_frame import SkyResponse

__all__ = [
    "ApertureMeasurement",
    "CorrectionOptions",
    "FringeCorrection",
    "ResidualFringe",
    "component_patterns",
    "correct_fringes",
    "measure_apertures",
    "random_positions",
    "residual_fringe",
]

FloatArray = NDArray[np.float64]

_MOST_SAMPLES = 36
"""Pixels along a side of an aperture from which its median is taken."""


@dataclass(frozen=True)
class CorrectionOptions:
    """How the scales of the templates are measured.

    Attributes
    ----------
    positions : `int`
        Random positions.
    small_px, large_px : `int`
        Half sides of the two square apertures [px]; an aperture has ``2 h + 1`` pixels on a side. The small one
        should be below a quarter of a fringe, and as large as that, for it sets the noise.
    least_good : `float`
        Share of good pixels that an aperture needs.
    rounds : `int`
        Most rounds of clipping.
    clip_sigma : `float`
        Positions whose residual exceeds so many standard deviations (from quartiles) are left out, and so are pixels
        of an aperture.
    """

    positions: int = 30_000
    small_px: int = 7
    large_px: int = 50
    least_good: float = 0.5
    rounds: int = 20
    clip_sigma: float = 4.0

    def __post_init__(self) -> None:
        if self.positions < 1 or self.rounds < 1:
            raise OutOfRangeError("positions and rounds", (self.positions, self.rounds), "1 or more each")
        if not 0 <= self.small_px < self.large_px:
            raise OutOfRangeError("apertures [px]", (self.small_px, self.large_px), "small below large")
        if not 0.0 < self.least_good <= 1.0:
            raise OutOfRangeError("share of good pixels", self.least_good, "above 0, at most 1")
        if not self.clip_sigma > 0.0:
            raise OutOfRangeError("clipping [sigma]", self.clip_sigma, "positive")


@dataclass(frozen=True, eq=False)
class ApertureMeasurement:
    """Differences of small and large apertures; NaN where an aperture has too few good pixels.

    Attributes
    ----------
    exposure : `numpy.ndarray`, shape ``(M,)``
        Level of the small aperture less that of the large one.
    template : `numpy.ndarray`, shape ``(M, K)``
        The same of the templates, on the same pixels.
    """

    exposure: FloatArray
    template: FloatArray


@dataclass(frozen=True, eq=False)
class FringeCorrection:
    """A corrected exposure and what was subtracted.

    Attributes
    ----------
    image : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Exposure less the scaled templates; the exposure itself if no solution was found.
    scale : `numpy.ndarray`, shape ``(K,)``
        Scales of the templates, in the units of the exposure; 0 if no solution was found.
    covariance : `numpy.ndarray`, shape ``(K, K)``
        Their covariance; NaN if no solution was found.
    positions_used : `int`
        Positions left after clipping.
    residual_rms : `float`
        Standard deviation of their residuals, in the units of the exposure; NaN if no solution was found.
    """

    image: NDArray[np.float32]
    scale: FloatArray
    covariance: FloatArray
    positions_used: int
    residual_rms: float

    @property
    def solved(self) -> bool:
        """Whether a solution was found."""
        return math.isfinite(self.residual_rms)

    @property
    def cards(self) -> dict[str, float]:
        """Header keywords of the corrected exposure, by which a second correction is refused; none if unsolved."""
        if not self.solved:
            return {}
        scales = {f"FRINGSC{number}": float(scale) for number, scale in enumerate(self.scale)}
        return {CORRECTED: len(self.scale), **scales, "FRINGRES": self.residual_rms}


@dataclass(frozen=True)
class ResidualFringe:
    """What a correction leaves.

    Attributes
    ----------
    rms : `float`
        Standard deviation of the residual fringe, as a fraction of the sky.
    smoothed_rms : `float`
        The same after averaging over a square aperture.
    shot_noise : `float`
        Noise of the sky in that aperture, as a fraction of the sky.
    """

    rms: float
    smoothed_rms: float
    shot_noise: float

    @property
    def ratio(self) -> float:
        """Residual over shot noise on the scale of the aperture; the DES criterion asks for less than 0.1."""
        return self.smoothed_rms / self.shot_noise


def correct_fringes(
    image: ArrayLike,
    templates: Sequence[FringeFrame] | ArrayLike,
    rng: np.random.Generator,
    mask: ArrayLike | None = None,
    options: CorrectionOptions | None = None,
    header: Mapping[str, Any] | None = None,
) -> FringeCorrection:
    """Subtract scaled templates from an exposure.

    Parameters
    ----------
    image : array_like, shape ``(ny, nx)``
        Exposure, sky included.
    templates : sequence of `FringeFrame`, or array_like of shape ``(K, ny, nx)``
        Fringe templates.
    rng : `numpy.random.Generator`
        Source of the random positions.
    mask : array_like, shape ``(ny, nx)``, optional
        Non-zero where the exposure is not to be measured (defects, detected sources). Pixels that a template masks
        are not measured either.
    options : `CorrectionOptions`, optional
        Positions, apertures, clipping.
    header : mapping, optional
        Header of the exposure; one that was corrected before is refused (`FringeCorrection.cards`).

    Returns
    -------
    correction : `FringeCorrection`

    Raises
    ------
    InputError
        An exposure that was corrected already, no template, or shapes that do not belong together.
    """
    refuse_corrected(header or {})
    chosen = CorrectionOptions() if options is None else options
    exposure = np.asarray(image, dtype=np.float32)
    if exposure.ndim != 2:
        raise InputError("shape of the exposure", exposure.shape, "two axes (y, x)")
    patterns, unusable = _templates(templates, exposure.shape)
    good = np.isfinite(exposure) & ~unusable
    if mask is not None:
        flags = np.asarray(mask)
        if flags.shape != exposure.shape:
            raise InputError("shape of the mask", flags.shape, f"{exposure.shape}")
        good &= flags == 0
    places = random_positions(exposure.shape, chosen, rng)
    levels = measure_apertures(exposure, patterns, good, places, chosen)
    usable = np.isfinite(levels.exposure)
    solution = _clipped_solution(levels.exposure[usable], levels.template[usable], chosen)
    if solution is None:
        number = len(patterns)
        return FringeCorrection(
            exposure.copy(), np.zeros(number), np.full((number, number), np.nan), 0, math.nan
        )
    scale, covariance, used, rms = solution
    corrected = exposure.copy()
    for factor, pattern in zip(scale, patterns, strict=True):
        corrected -= np.float32(factor) * pattern
    return FringeCorrection(corrected, scale, covariance, used, rms)


def random_positions(
    shape: tuple[int, int], options: CorrectionOptions, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Centres of apertures that lie inside the image with their small aperture, shape ``(M, 2)`` as y, x.

    Raises
    ------
    InputError
        The image is smaller than the small aperture.
    """
    edge = options.small_px
    if min(shape) <= 2 * edge:
        raise InputError("shape of the exposure", shape, f"more than {2 * edge} pixels on every side")
    return np.stack([rng.integers(edge, side - edge, options.positions) for side in shape], axis=1)


def measure_apertures(
    exposure: ArrayLike,
    templates: Sequence[ArrayLike],
    good: ArrayLike,
    positions: ArrayLike,
    options: CorrectionOptions,
) -> ApertureMeasurement:
    """Level of a small aperture less that of a large one, at many positions.

    Parameters
    ----------
    exposure : array_like, shape ``(ny, nx)``
        Exposure; its pixels decide which of an aperture are left out.
    templates : sequence of array_like, K of shape ``(ny, nx)``
        Templates.
    good : array_like of `bool`, shape ``(ny, nx)``
        Pixels to be used.
    positions : array_like of `int`, shape ``(M, 2)``
        Centres as y, x.
    options : `CorrectionOptions`
        Sizes of the apertures, and clipping.
    """
    arguments = (
        np.ascontiguousarray(exposure, dtype=np.float32),
        np.stack([np.asarray(template, dtype=np.float32) for template in templates]),
        np.ascontiguousarray(good, dtype=np.bool_),
        np.ascontiguousarray(positions, dtype=np.int64),
        options.small_px,
        options.large_px,
        options.least_good,
        options.clip_sigma,
    )
    count = len(arguments[3])
    levels = np.full((count, 1 + len(arguments[1])), np.nan)
    run_shares(lambda first, last: _aperture_kernel(*arguments, first, last, levels), count, 1)
    return ApertureMeasurement(levels[:, 0], levels[:, 1:])


def residual_fringe(
    residual: ArrayLike,
    sky_electrons: float,
    aperture_px: int,
    mask: ArrayLike | None = None,
    read_noise_e: float = 0.0,
) -> ResidualFringe:
    """Compare a noiseless residual with the shot noise of the sky on one angular scale.

    Parameters
    ----------
    residual : array_like, shape ``(ny, nx)``
        Fringe less its correction [e⁻]; its mean is subtracted.
    sky_electrons : `float`
        Sky per pixel [e⁻].
    aperture_px : `int`
        Side of the square aperture [px]; 100 is 20 arcsec for LSST.
    mask : array_like, optional
        Non-zero where the residual is not known.
    read_noise_e : `float`, optional
        Read noise per pixel [e⁻].

    Raises
    ------
    InputError
        No good pixel, or a mask that does not fit.
    OutOfRangeError
        A sky or an aperture that is not positive.
    """
    values = np.asarray(residual, dtype=float)
    good = np.isfinite(values)
    if mask is not None:
        if np.shape(mask) != values.shape:
            raise InputError("shape of the mask", np.shape(mask), f"{values.shape}")
        good &= np.asarray(mask) == 0
    if not good.any():
        raise InputError("good pixels", 0, "at least one")
    if not 0.0 < sky_electrons < math.inf or aperture_px < 1:
        raise OutOfRangeError("sky [e] and aperture [px]", (sky_electrons, aperture_px), "positive")
    centred = np.where(good, values - values[good].mean(), 0.0)
    share = uniform_filter(good.astype(float), aperture_px, mode="constant")
    smooth = uniform_filter(centred, aperture_px, mode="constant")
    full = share > 0.9
    averaged = smooth[full] / share[full] if full.any() else np.zeros(1)
    noise = math.sqrt(sky_electrons + read_noise_e**2) / aperture_px
    return ResidualFringe(
        float(centred[good].std() / sky_electrons),
        float(averaged.std() / sky_electrons),
        noise / sky_electrons,
    )


def component_patterns(thickness_um: ArrayLike, response: SkyResponse) -> NDArray[np.float32]:
    """Fringe pattern of every component of the sky: the physical alternative to components found in frames.

    Their span holds the fringes of every night exactly; but they resemble each other, and the scales of so many
    patterns are found with more noise than those of two or three principal components.

    Parameters
    ----------
    thickness_um : array_like, shape ``(ny, nx)``
        Thickness [µm]; NaN gives 0.
    response : `SkyResponse`
        Response of the sensor to the C components of the sky.

    Returns
    -------
    patterns : `numpy.ndarray`, float32, shape ``(C, ny, nx)``
        Zero-mean fringes in the order of ``response.component``, as fractions of the whole sky with every component
        at its reference level.

    Raises
    ------
    InputError
        A map that is not two-dimensional or has no thickness.
    """
    thickness = np.asarray(thickness_um)
    known = np.isfinite(thickness)
    if thickness.ndim != 2 or not known.any():
        raise InputError("thickness map", thickness.shape, "two axes, some finite values")
    shares = response.table.lookup(thickness[known])
    shares /= shares.sum(axis=0).mean()
    patterns = np.zeros((len(shares), *thickness.shape), dtype=np.float32)
    patterns[:, known] = shares - shares.mean(axis=1, keepdims=True)
    return patterns


def _templates(
    templates: Sequence[FringeFrame] | ArrayLike, shape: tuple[int, ...]
) -> tuple[list[NDArray[np.float32]], NDArray[np.bool_]]:
    unusable = np.zeros(shape, dtype=bool)
    patterns: list[NDArray[np.float32]] = []
    for template in templates:  # type: ignore[union-attr]
        image = (
            template.image if isinstance(template, FringeFrame) else np.asarray(template, dtype=np.float32)
        )
        if image.shape != shape:
            raise InputError("shape of a template", image.shape, f"{shape}")
        unusable |= ~np.isfinite(image)
        if isinstance(template, FringeFrame):
            unusable |= template.mask != 0
        patterns.append(image)
    if not patterns:
        raise InputError("templates", 0, "one or more")
    return patterns, unusable


def _clipped_solution(
    wanted: FloatArray, design: FloatArray, options: CorrectionOptions
) -> tuple[FloatArray, FloatArray, int, float] | None:
    """Least squares with positions clipped until none leaves; None if there are too few or they do not decide."""
    number = design.shape[1]
    keep = np.ones(wanted.size, dtype=bool)
    scale: FloatArray = np.zeros(number)
    residual = wanted
    for _ in range(options.rounds):
        if keep.sum() <= 2 * number:
            return None
        solution = np.linalg.lstsq(design[keep], wanted[keep], rcond=1e-10)
        scale, rank = np.asarray(solution[0], dtype=float), int(solution[2])
        if rank < number:
            return None
        residual = wanted - design @ scale
        low, high = np.percentile(residual[keep], [25.0, 75.0])
        spread = 0.7413 * (high - low)
        if spread == 0.0:
            break
        closer = np.abs(residual - 0.5 * (low + high)) <= options.clip_sigma * spread
        if np.array_equal(closer, keep):
            break
        keep = closer
    rms = float(residual[keep].std())
    covariance = np.asarray(rms**2 * np.linalg.inv(design[keep].T @ design[keep]), dtype=float)
    return scale, covariance, int(keep.sum()), rms


@kernel
def _aperture_kernel(
    exposure: NDArray,
    templates: NDArray,
    good: NDArray,
    positions: NDArray,
    small: int,
    large: int,
    least_good: float,
    clip: float,
    first: int,
    last: int,
    out: NDArray,
) -> None:  # pragma: no cover - compiled
    height, width = exposure.shape
    number = len(templates)
    for place in range(first, last):
        y, x = positions[place, 0], positions[place, 1]
        level = np.empty((2, 1 + number))
        complete = True
        for which in range(2):
            half = small if which == 0 else large
            # A thousand pixels of the large aperture tell its level better than the small one is known.
            step = 1 + (2 * half) // _MOST_SAMPLES
            values = np.empty((2 * half + 1) ** 2, dtype=np.float32)
            count, seen = 0, 0
            for row in range(max(y - half, 0), min(y + half + 1, height), step):
                for column in range(max(x - half, 0), min(x + half + 1, width), step):
                    seen += 1
                    if good[row, column]:
                        values[count] = exposure[row, column]
                        count += 1
            if count == 0 or count < least_good * seen:
                complete = False
                break
            quartiles = np.percentile(values[:count], np.array([25.0, 50.0, 75.0]))
            reach = max(clip * 0.7413 * (quartiles[2] - quartiles[0]), 1e-6 * abs(quartiles[1]))
            sums, kept = np.zeros(1 + number), 0
            for row in range(max(y - half, 0), min(y + half + 1, height), step):
                for column in range(max(x - half, 0), min(x + half + 1, width), step):
                    if good[row, column] and abs(exposure[row, column] - quartiles[1]) <= reach:
                        kept += 1
                        sums[0] += exposure[row, column]
                        for item in range(number):
                            sums[1 + item] += templates[item, row, column]
            level[which] = sums / kept
        if complete:
            out[place] = level[0] - level[1]
