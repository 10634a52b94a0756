"""Principal components of fringe frames, in bounded memory, and the templates made from them.

N frames of P pixels are reduced to the N × N Gram matrix of the frames with their pixel means taken away. It is
summed over tiles of rows in double precision, so that only one tile of all frames is ever held beside the inputs;
its eigenvectors give scores and, in a second pass, the components. The result is that of a full singular value
decomposition (scikit-learn's ``PCA(svd_solver="full")``), sign convention included.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from ..errors import InputError, OutOfRangeError
from ..model import ResponseTable
from ..products import FringeComponents, FringeFrame, SkyFringe, mask_bits, refuse_corrected
from .sky_frame import SkyResponse

__all__ = [
    "Projection",
    "fit_pca",
    "fit_pca_from_thickness",
    "fringe_templates",
    "noise_eigenvalue",
    "project",
    "significant_components",
]

FloatArray = NDArray[np.float64]

TILE_BYTES = 4 * 2**20
"""Memory of one tile of all frames."""

_ROUNDING = 1e-13
"""Share of the variance below which an eigenvalue is rounding of float32 frames."""

_HISTOGRAM_BINS = 32_768
_PARTS = 8
"""Parts of a sensor that may be counted at the same time."""


def fit_pca(
    frames: Sequence[Any],
    *,
    mask: ArrayLike | None = None,
    n_components: int | None = None,
    noise_variance: float | None = None,
    tile_bytes: int = TILE_BYTES,
    metadata: Mapping[str, Any] | None = None,
    detector: str = "",
    physical_filter: str = "",
) -> FringeComponents:
    """Principal components of frames of one sensor.

    Parameters
    ----------
    frames : sequence, N of shape ``(ny, nx)``
        Arrays are taken as they are; anything that can be sliced by rows will do (a memory map, an open data set).
        Of a `SkyFringe` in electrons its mean is subtracted, and all are divided by their common mean sky, so that
        the frames are fringes in units of the sky of the night.
    mask : array_like, shape ``(ny, nx)``, optional
        Non-zero where a pixel is not to be used, besides those that a frame masks or that are not finite.
    n_components : `int`, optional
        Components to keep; by default those above the noise.
    noise_variance : `float`, optional
        Variance of the noise of a pixel of a frame, in the units of the frames. By default it is that of the photons
        and the amplifier for simulated exposures, and none for other frames.
    tile_bytes : `int`, optional
        Memory that a tile may take.
    metadata, detector, physical_filter
        Go into the product.

    Returns
    -------
    components : `FringeComponents`
        Mean and components are 0 in masked pixels.

    Raises
    ------
    InputError
        Fewer than two frames, shapes that differ, no good pixel, frames that are all alike, or one from which the
        fringes were subtracted.
    OutOfRangeError
        A number of components that N frames do not have.
    """
    for frame in frames:
        if isinstance(frame, SkyFringe):
            refuse_corrected(frame.metadata, frame.detector or None)
    reader = _TileReader.of(frames, mask, tile_bytes)
    # Tiles are small: more than one thread of a matrix product would mostly wait.
    with threadpool_limits(limits=1, user_api="blas"):
        gram, pixels = reader.gram()
    total = float(np.trace(gram))
    if not total > 0.0:
        raise InputError("frames", "no differences between them", "frames that vary")
    eigenvalues, vectors = _descending(gram)
    if noise_variance is None:
        noise_variance = reader.noise_variance
    if n_components is None:
        n_components = significant_components(eigenvalues, pixels, noise_variance)
    if not 1 <= n_components <= len(frames):
        raise OutOfRangeError("number of components", n_components, f"1 to {len(frames)}")
    kept = np.maximum(eigenvalues[:n_components], np.finfo(float).tiny)
    with threadpool_limits(limits=1, user_api="blas"):
        mean, components, sign = reader.components(vectors[:, :n_components] / np.sqrt(kept))
    return FringeComponents(
        mean=mean,
        components=components,
        explained_variance=eigenvalues[:n_components] / (len(frames) - 1),
        explained_variance_ratio=eigenvalues[:n_components] / total,
        scores=vectors[:, :n_components] * np.sqrt(kept) * sign,
        mask=np.where(reader.good, 0, mask_bits("NO_DATA")).astype(np.int32),
        metadata={
            **(metadata or {}),
            "NFRAMES": len(frames),
            "NOISEVAR": noise_variance,
            "MEANSKY": reader.unit,
        },
        detector=detector,
        physical_filter=physical_filter,
    )


def fit_pca_from_thickness(
    thickness_um: ArrayLike,
    response: SkyResponse,
    scales: Sequence[Mapping[str, float]],
    *,
    n_components: int | None = None,
    bins: int = _HISTOGRAM_BINS,
    metadata: Mapping[str, Any] | None = None,
    detector: str = "",
    physical_filter: str = "",
) -> FringeComponents:
    """Principal components of noiseless model frames, without making the frames.

    A pixel of a model frame depends on its thickness alone, so that the Gram matrix is a sum over the histogram of
    thickness, and a component is a function of thickness.

    Parameters
    ----------
    thickness_um : array_like, shape ``(ny, nx)``
        Thickness [µm]; NaN is masked.
    response : `SkyResponse`
        Response of the sensor to the components of the sky.
    scales : sequence of mappings
        Factors on the components of the sky, one mapping per frame.
    n_components : `int`, optional
        Components to keep; by default all that are not rounding.
    bins : `int`, optional
        Bins of the histogram; the error falls with their square.
    metadata, detector, physical_filter
        Go into the product.

    Returns
    -------
    components : `FringeComponents`
        Of frames as `fit_pca` makes them from `SkyFringe`.

    Raises
    ------
    InputError
        Fewer than two frames, or no thickness.
    """
    thickness = np.asarray(thickness_um)
    good = np.isfinite(thickness)
    if len(scales) < 2 or not good.any():
        raise InputError(
            "frames and pixels", (len(scales), int(good.sum())), "two or more frames, some pixels"
        )
    count, centre = _thickness_histogram(thickness, bins)
    factors = np.stack([response.factors(scale) for scale in scales])
    levels = factors @ (response.level * response.table.lookup(centre))
    background = levels @ count / count.sum()
    unit = float(background.mean())
    curves = (levels - background[:, None]) / unit
    centred = curves - curves.mean(axis=0)
    eigenvalues, vectors = _descending((centred * count) @ centred.T)
    if not eigenvalues.sum() > 0.0:
        raise InputError("scales of the frames", "no differences between frames", "frames that vary")
    if n_components is None:
        n_components = significant_components(eigenvalues, int(good.sum()), 0.0)
    if not 1 <= n_components <= len(scales):
        raise OutOfRangeError("number of components", n_components, f"1 to {len(scales)}")
    root = np.sqrt(np.maximum(eigenvalues[:n_components], np.finfo(float).tiny))
    combination = vectors[:, :n_components].T / root[:, None]
    sign = _signs(combination @ centred)
    combination *= sign[:, None]
    # The frames that are wanted are weighted sums of the model frames less their backgrounds.
    weights = np.vstack([np.full(len(scales), 1.0 / len(scales)), combination])
    rows = (weights @ factors) @ (response.level * response.table.values) - (weights @ background)[:, None]
    table = ResponseTable(
        response.table.start_um, response.table.step_um, rows / unit, np.zeros(len(rows)), math.nan
    )
    images = np.empty((len(rows), *thickness.shape), np.float32)
    single = thickness.astype(np.float32, copy=False)
    for row, image in enumerate(images):
        table.frame(single, row, image)
    mask = np.zeros(thickness.shape, np.int32)
    if not good.all():
        images[:, ~good] = 0.0
        mask[~good] = mask_bits("NO_DATA")
    return FringeComponents(
        mean=images[0],
        components=images[1:],
        explained_variance=eigenvalues[:n_components] / (len(scales) - 1),
        explained_variance_ratio=eigenvalues[:n_components] / eigenvalues.sum(),
        scores=vectors[:, :n_components] * root * sign,
        mask=mask,
        metadata={**(metadata or {}), "NFRAMES": len(scales), "NOISEVAR": 0.0, "MEANSKY": unit},
        detector=detector,
        physical_filter=physical_filter,
    )


def noise_eigenvalue(frames: int, pixels: int, noise_variance: float) -> float:
    """Largest eigenvalue that white noise alone gives the Gram matrix of N frames of P pixels.

    ``P sigma² (1 + sqrt(N / P))²`` (Marchenko & Pastur 1967).
    """
    return pixels * noise_variance * (1.0 + math.sqrt(frames / pixels)) ** 2


def significant_components(eigenvalues: ArrayLike, pixels: int, noise_variance: float) -> int:
    """Number of components that stand above the noise, at least one.

    Parameters
    ----------
    eigenvalues : array_like, shape ``(N,)``
        Eigenvalues of the centred Gram matrix of N frames, descending.
    pixels : `int`
        Good pixels in a frame.
    noise_variance : `float`
        Variance of the noise of a pixel of a frame.

    Notes
    -----
    A component is kept if its eigenvalue exceeds the edge of the noise by more than five standard deviations of that
    edge, which fluctuates as ``P sigma² sqrt(2 / P)``.
    """
    values = np.asarray(eigenvalues, dtype=float)
    if not 0.0 <= noise_variance < math.inf:
        raise OutOfRangeError("noise variance", noise_variance, "finite and not negative")
    edge = noise_eigenvalue(values.size, pixels, noise_variance)
    edge += 5.0 * noise_variance * math.sqrt(2.0 * pixels)
    return max(1, int(np.count_nonzero(values > max(edge, _ROUNDING * values.sum()))))


def fringe_templates(
    components: FringeComponents,
    creation_datetime: str,
    *,
    least_rms: float = 2e-5,
    most: int | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> list[FringeFrame]:
    """Templates for fringe correction: the mean fringe, then what varies beside it.

    Parameters
    ----------
    components : `FringeComponents`
        Fringes in units of the sky, as `fit_pca` makes them from `SkyFringe`.
    creation_datetime : `str`
        When the calibration was made, ``YYYY-MM-DDThh:mm:ss``.
    least_rms : `float`, optional
        A template is left out if it contributes less than this to a typical frame, as a fraction of the sky. The
        photon noise of an LSST y exposure averaged over 20 arcsec is 2e-4; 2e-5 is a tenth of it, and a fainter
        template would bring more noise than it takes away.
    most : `int`, optional
        Largest number of templates.
    metadata : mapping, optional
        Further header keywords.

    Returns
    -------
    templates : `list` [`FringeFrame`]
        Zero-mean fractional frames, orthogonal to each other. The first is the mean fringe over the mean sky; the
        others are scaled to the rms with which they occur in the training frames.

    Notes
    -----
    The first principal component is the change of the mean pattern's strength and nearly parallel to it, so that both
    together would make the solution of the scales degenerate. Here each pattern is taken once.
    """
    good = components.mask == 0
    mean = _zero_mean(components.mean, good)
    patterns = [_zero_mean(each, good) for each in components.components]
    overlap = _dot(mean, mean)
    along = np.array([_dot(each, mean) / overlap for each in patterns])
    beside = [each - share * mean for each, share in zip(patterns, along, strict=True)]
    gram = np.array([[_dot(one, two) for two in beside] for one in beside])
    # Second moments of what the training frames hold beside the mean pattern, in an orthonormal basis of it.
    values, axes = np.linalg.eigh(gram)
    usable = values > 1e-9 * max(float(values.max()), np.finfo(float).tiny)
    basis = axes[:, usable] * np.sqrt(values[usable])
    moments = (components.scores @ basis).T @ (components.scores @ basis) / len(components.scores)
    strength, turn = _descending(moments)
    to_patterns = (axes[:, usable] / np.sqrt(values[usable])) @ turn
    frames_used = int(components.metadata["NFRAMES"])
    noise = float(components.metadata["NOISEVAR"])
    # A component is a sum of frames with weights of norm 1 / sqrt(eigenvalue).
    component_noise = noise / np.maximum(
        (frames_used - 1) * components.explained_variance, np.finfo(float).tiny
    )
    found = [(mean, noise / frames_used)]
    for number in range(strength.size):
        if math.sqrt(strength[number] / good.sum()) < least_rms:
            break
        weights = to_patterns[:, number] * math.sqrt(strength[number])
        found.append((np.tensordot(weights, np.stack(beside), axes=1), float(weights**2 @ component_noise)))
    return [
        _as_template(image, variance, components, creation_datetime, {**(metadata or {}), "TEMPLATE": number})
        for number, (image, variance) in enumerate(found[:most])
    ]


@dataclass(frozen=True, eq=False)
class Projection:
    """Coefficients of a frame in a basis.

    Attributes
    ----------
    coefficient : `numpy.ndarray`, shape ``(K,)``
        Least-squares coefficients.
    covariance : `numpy.ndarray`, shape ``(K, K)``
        Their covariance.
    background : `float`
        Constant level fitted beside them.
    chi2_per_pixel : `float`
        Mean squared residual in units of the variance.
    """

    coefficient: FloatArray
    covariance: FloatArray
    background: float
    chi2_per_pixel: float


def project(
    frame: ArrayLike, basis: ArrayLike, variance: ArrayLike | float, mask: ArrayLike | None = None
) -> Projection:
    """Fit a frame by a constant and the patterns of a basis.

    Parameters
    ----------
    frame : array_like, shape ``(ny, nx)``
        Image.
    basis : array_like, shape ``(K, ny, nx)``
        Patterns.
    variance : array_like or `float`
        Variance of the frame; broadcasts to it.
    mask : array_like, shape ``(ny, nx)``, optional
        Non-zero where a pixel is not to be used.

    Raises
    ------
    InputError
        Shapes that do not belong together, too few good pixels, or patterns that are not independent.
    """
    image, patterns = np.asarray(frame), np.asarray(basis)
    if patterns.ndim != 3 or patterns.shape[1:] != image.shape:
        raise InputError("shape of the basis", patterns.shape, f"(patterns, {image.shape})")
    noise = np.broadcast_to(np.asarray(variance, dtype=float), image.shape)
    flags = None if mask is None else np.asarray(mask)
    if flags is not None and flags.shape != image.shape:
        raise InputError("shape of the mask", flags.shape, f"{image.shape}")
    size = len(patterns) + 1
    normal, moment, square, used = np.zeros((size, size)), np.zeros(size), 0.0, 0
    rows = max(1, TILE_BYTES // (16 * size * image.shape[1]))
    for start in range(0, image.shape[0], rows):
        part = slice(start, start + rows)
        good = np.isfinite(image[part]) & (noise[part] > 0.0) & np.isfinite(patterns[:, part]).all(axis=0)
        if flags is not None:
            good &= flags[part] == 0
        weight = 1.0 / np.sqrt(noise[part][good])
        design = np.vstack([np.ones(weight.size), patterns[:, part][:, good]]) * weight
        data = image[part][good] * weight
        normal += design @ design.T
        moment += design @ data
        square += float(data @ data)
        used += weight.size
    if used <= size:
        raise InputError("good pixels", used, f"more than {size}")
    try:
        factor = scipy.linalg.cho_factor(normal)
    except np.linalg.LinAlgError:
        raise InputError("basis", "dependent patterns", "patterns that are independent") from None
    solution = scipy.linalg.cho_solve(factor, moment)
    covariance = scipy.linalg.cho_solve(factor, np.eye(size))
    return Projection(
        solution[1:],
        covariance[1:, 1:],
        float(solution[0]),
        max(square - float(solution @ moment), 0.0) / used,
    )


@dataclass(frozen=True, eq=False)
class _TileReader:
    """Frames as ``(frame - offset) / unit`` in double precision, a few rows of all of them at a time."""

    frames: tuple[Any, ...]
    good: NDArray[np.bool_]
    offset: FloatArray
    unit: float
    noise_variance: float
    rows: int

    @classmethod
    def of(cls, frames: Sequence[Any], mask: ArrayLike | None, tile_bytes: int) -> _TileReader:
        if len(frames) < 2:
            raise InputError("number of frames", len(frames), "two or more")
        images = tuple(each.image if isinstance(each, SkyFringe) else each for each in frames)
        shape = tuple(np.shape(images[0]))
        for number, image in enumerate(images):
            if tuple(np.shape(image)) != shape or len(shape) != 2:
                raise InputError(f"shape of frame {number}", np.shape(image), f"{shape}, two axes")
        # A tile of all frames in double precision, once as read and once as used.
        rows = max(1, min(shape[0], tile_bytes // (16 * len(images) * shape[1])))
        good = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask) == 0
        if good.shape != shape:
            raise InputError("shape of the mask", good.shape, f"{shape}")
        offset, unit, noise = np.zeros(len(images)), 1.0, 0.0
        if all(isinstance(each, SkyFringe) for each in frames):
            skies = [each for each in frames if isinstance(each, SkyFringe)]
            for sky in skies:
                good &= sky.mask == 0
        for start in range(0, shape[0], rows):
            part = slice(start, start + rows)
            for image in images:
                good[part] &= np.isfinite(np.asarray(image[part]))
        if not good.any():
            raise InputError("good pixels", 0, "at least one in which all frames have a value")
        if all(isinstance(each, SkyFringe) and each.unit == "electron" for each in frames):
            offset = np.array([image.mean(dtype=np.float64, where=good) for image in images])
            unit = float(offset.mean())
            noise = float(np.mean([_noise_of(each) for each in skies])) / unit**2
        return cls(images, good, offset, unit, noise, rows)

    def tiles(self) -> Iterator[tuple[slice, NDArray[np.bool_], FloatArray]]:
        """Rows, their good pixels, and the values ``[N, good pixels]``."""
        for start in range(0, self.good.shape[0], self.rows):
            part = slice(start, start + self.rows)
            good = self.good[part]
            tile = np.empty((len(self.frames), int(good.sum())))
            whole = bool(good.all())
            for number, image in enumerate(self.frames):
                values = np.asarray(image[part])
                chosen = values.ravel() if whole else values[good]
                np.subtract(chosen, self.offset[number], out=tile[number], dtype=np.float64)
            if self.unit != 1.0:
                tile *= 1.0 / self.unit
            yield part, good, tile

    def gram(self) -> tuple[FloatArray, int]:
        """Gram matrix of the frames less their mean over frames, and the number of good pixels."""
        total = np.zeros((len(self.frames), len(self.frames)))
        for _, _, tile in self.tiles():
            tile -= tile.mean(axis=0)
            total += tile @ tile.T
        return total, int(self.good.sum())

    def components(
        self, combination: FloatArray
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], FloatArray]:
        """Mean frame, components ``combination.T @ (frames - mean)`` and the signs that were given to them."""
        frames, number = combination.shape
        # Weights of zero sum need no frames less their mean.
        weights = np.vstack([np.full(frames, 1.0 / frames), (combination - combination.mean(axis=0)).T])
        images = np.zeros((1 + number, *self.good.shape), dtype=np.float32)
        largest = np.zeros(number)
        for part, good, tile in self.tiles():
            values = weights @ tile
            for image, row in zip(images, values, strict=True):
                if row.size == good.size:
                    image[part] = row.reshape(good.shape)
                else:
                    image[part][good] = row
            if values.shape[1]:
                extreme = values[np.arange(1, 1 + number), np.abs(values[1:]).argmax(axis=1)]
                largest = np.where(np.abs(extreme) > np.abs(largest), extreme, largest)
        sign = np.where(largest < 0.0, -1.0, 1.0)
        for index in np.flatnonzero(sign < 0.0):
            np.negative(images[1 + index], out=images[1 + index])
        return images[0], images[1:], sign


def _noise_of(frame: SkyFringe) -> float:
    """Variance of the noise of a simulated exposure [e⁻²]; 0 without noise."""
    if frame.seed is None:
        return 0.0
    return frame.mean_electrons + float(frame.metadata.get("RDNOISE", 0.0)) ** 2


def _descending(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    eigenvalues, vectors = scipy.linalg.eigh(gram)
    return np.maximum(eigenvalues[::-1], 0.0), vectors[:, ::-1]


def _signs(components: FloatArray) -> FloatArray:
    """Signs that make the largest entry of every component positive, as scikit-learn does."""
    extreme = components[np.arange(len(components)), np.abs(components).argmax(axis=1)]
    return np.where(extreme < 0.0, -1.0, 1.0)


def _thickness_histogram(thickness: NDArray[np.floating], bins: int) -> tuple[FloatArray, FloatArray]:
    """Pixels per bin and their mean thickness, empty bins left out; pixels that are no number do not count."""
    values = np.ascontiguousarray(thickness).ravel()
    low, high = (float(each) for each in _finite_range(values, _PARTS))
    counts, totals = _fill_histogram(values, low, bins / max(high - low, 1e-12), bins, _PARTS)
    count, total = counts.sum(axis=0), totals.sum(axis=0)
    filled = count > 0
    # Sums are of what is above the lowest thickness, so that nothing is lost to rounding.
    return count[filled], np.clip(low + total[filled] / count[filled], low, high)


@numba.njit(cache=True, parallel=True)
def _finite_range(values: NDArray, parts: int) -> tuple[float, float]:  # pragma: no cover - compiled
    lows, highs = np.full(parts, np.inf), np.full(parts, -np.inf)
    for part in numba.prange(parts):
        low, high = np.inf, -np.inf
        for k in range(values.size * part // parts, values.size * (part + 1) // parts):
            value = float(values[k])
            if np.isfinite(value):
                low, high = min(low, value), max(high, value)
        lows[part], highs[part] = low, high
    return lows.min(), highs.max()


@numba.njit(cache=True, parallel=True)
def _fill_histogram(
    values: NDArray, low: float, scale: float, bins: int, parts: int
) -> tuple[NDArray, NDArray]:  # pragma: no cover - compiled
    """One histogram for each of a fixed number of parts, so that threads do not change the sums."""
    counts, totals = np.zeros((parts, bins)), np.zeros((parts, bins))
    for part in numba.prange(parts):
        count, total = counts[part], totals[part]
        for k in range(values.size * part // parts, values.size * (part + 1) // parts):
            above = float(values[k]) - low
            if np.isfinite(above):
                place = min(int(above * scale), bins - 1)
                count[place] += 1.0
                total[place] += above
    return counts, totals


def _dot(one: FloatArray, two: FloatArray) -> float:
    return float(np.vdot(one, two))


def _zero_mean(image: NDArray[np.float32], good: NDArray[np.bool_]) -> FloatArray:
    values = np.where(good, image, 0.0).astype(np.float64)
    return np.where(good, values - values.sum() / good.sum(), 0.0)


def _as_template(
    image: FloatArray,
    variance: float,
    components: FringeComponents,
    creation_datetime: str,
    metadata: Mapping[str, Any],
) -> FringeFrame:
    return FringeFrame(
        image=image.astype(np.float32),
        mask=components.mask,
        variance=np.full(image.shape, variance, dtype=np.float32),
        physical_filter=components.physical_filter or "unknown",
        creation_datetime=creation_datetime,
        metadata=metadata,
        detector=components.detector,
    )
