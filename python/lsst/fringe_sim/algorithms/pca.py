"""Principal components of fringe frames, in bounded memory, and the templates made from them.

N frames of P pixels are reduced to the N × N Gram matrix of the frames with their pixel means taken away. It is
summed over tiles of rows in double precision, so that only one tile of all frames is ever held beside the inputs;
its eigenvectors give scores and, in a second pass, the components. The result is that of a full singular value
decomposition (scikit-learn's ``PCA(svd_solver="full")``), sign convention included.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from ..array_types import BoolArray, Float32Array, FloatArray
from ..errors import InputError, OutOfRangeError, named_units
from ..model import ResponseTable
from ..products import FringeComponents, FringeFrame, SkyFringe, mask_bits, refuse_corrected
from .frame_stack import TILE_BYTES, FrameStack
from .projection import Projection, project
from .sky_frame import SkyResponse

__all__ = [
    "Projection",
    "ThicknessComponents",
    "decompose_thickness",
    "fit_pca",
    "fit_pca_from_thickness",
    "fringe_templates",
    "noise_eigenvalue",
    "project",
    "significant_components",
]

_ROUNDING = 1e-13  # Share of the variance below which an eigenvalue is rounding of float32 frames
_HISTOGRAM_BINS = 32_768  # Of thickness, over the range of the response; the error falls with their square
_BLOCK = 65_536  # Pixels that are counted at a time


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
        More components than the rank of the frames: the others would be rounding.

    Notes
    -----
    Products of more than 64 frames are in single precision, summed in double precision; components with less than
    1e-7 of the variance cannot be told from rounding there.
    """
    for frame in frames:
        if isinstance(frame, SkyFringe):
            refuse_corrected(frame.metadata, frame.detector or None)
    stack = FrameStack.of(frames, mask, tile_bytes)
    gram, mean = stack.gram_and_mean()
    total = float(np.trace(gram))
    if not total > 0.0:
        raise InputError("frames", "no differences between them", "frames that vary")
    eigenvalues, vectors = _descending(gram)
    if noise_variance is None:
        noise_variance = stack.noise_variance
    if n_components is None:
        n_components = significant_components(
            eigenvalues, stack.pixels, noise_variance, rounding=stack.rounding
        )
    _check_number(n_components, eigenvalues, stack.rounding)
    kept = eigenvalues[:n_components]
    mask = np.zeros(stack.good.shape, np.int32)
    if not stack.good.all():
        mask[~stack.good] = mask_bits("NO_DATA")
    components, sign = stack.components(vectors[:, :n_components] / np.sqrt(kept))
    return FringeComponents(
        mean=mean,
        components=components,
        explained_variance=eigenvalues[:n_components] / (len(frames) - 1),
        explained_variance_ratio=eigenvalues[:n_components] / total,
        scores=vectors[:, :n_components] * np.sqrt(kept) * sign,
        mask=mask,
        metadata={
            **(metadata or {}),
            "NFRAMES": len(frames),
            "NOISEVAR": noise_variance,
            "MEANSKY": stack.unit,
        },
        detector=detector,
        physical_filter=physical_filter,
    )


def _check_number(wanted: int, eigenvalues: FloatArray, rounding: float) -> None:
    """Refuse components whose eigenvalue is rounding of the Gram matrix."""
    rank = int(np.count_nonzero(eigenvalues > rounding * eigenvalues.sum()))
    if not 1 <= wanted <= rank:
        allowed = f"1 to {rank}, the rank of these {len(eigenvalues)} frames about their mean"
        raise OutOfRangeError("number of components", wanted, allowed)


@dataclass(frozen=True, eq=False)
class ThicknessComponents:
    """Principal components of noiseless model frames, as functions of thickness.

    Attributes
    ----------
    table : `ResponseTable`
        Mean frame in the first row, components in the others, over thickness.
    explained_variance, explained_variance_ratio : `numpy.ndarray`, shape ``(K,)``
        Variance of each component, and its share of the whole.
    scores : `numpy.ndarray`, shape ``(N, K)``
        Coefficients of the frames.
    unit : `float`
        Mean sky of the frames, by which they are divided.
    """

    table: ResponseTable
    explained_variance: FloatArray
    explained_variance_ratio: FloatArray
    scores: FloatArray
    unit: float

    @named_units
    def images(self, thickness_um: ArrayLike) -> FringeComponents:
        """Components of the pixels of a thickness map [µm], shape ``(ny, nx)``; NaN is masked.

        Raises
        ------
        OutOfRangeError
            A thickness outside the table.
        """
        thickness = np.asarray(thickness_um)
        good = np.isfinite(thickness)
        images = np.empty((len(self.table.values), *thickness.shape), np.float32)
        single = thickness.astype(np.float32, copy=False)
        for row, image in enumerate(images):
            self.table.frame(single, row, image)
        mask = np.zeros(thickness.shape, np.int32)
        if not good.all():
            images[:, ~good] = 0.0
            mask[~good] = mask_bits("NO_DATA")
        return FringeComponents(
            mean=images[0],
            components=images[1:],
            explained_variance=self.explained_variance,
            explained_variance_ratio=self.explained_variance_ratio,
            scores=self.scores,
            mask=mask,
            metadata={"NFRAMES": len(self.scores), "NOISEVAR": 0.0, "MEANSKY": self.unit},
        )


@named_units
def decompose_thickness(
    thickness_um: ArrayLike,
    response: SkyResponse,
    scales: Sequence[Mapping[str, float]],
    *,
    n_components: int | None = None,
) -> ThicknessComponents:
    """Principal components of noiseless model frames, from the histogram of thickness alone.

    A pixel of a model frame depends on its thickness alone, so that the Gram matrix is a sum over the histogram of
    thickness, and a component is a function of thickness.

    Parameters
    ----------
    thickness_um : array_like, shape ``(ny, nx)``
        Thickness [µm]; NaN does not count.
    response : `SkyResponse`
        Response of the sensor to the components of the sky.
    scales : sequence of mappings
        Factors on the components of the sky, one mapping per frame.
    n_components : `int`, optional
        Components to keep; by default all that are not rounding.

    Raises
    ------
    InputError
        Fewer than two frames, no thickness, or frames that are all alike.
    OutOfRangeError
        A thickness outside the response, or more components than the rank of the frames.
    """
    thickness = np.asarray(thickness_um)
    if len(scales) < 2:
        raise InputError("number of frames", len(scales), "two or more frames")
    count, centre = _thickness_histogram(thickness, response.table)
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
        n_components = significant_components(eigenvalues, int(count.sum()), 0.0)
    _check_number(n_components, eigenvalues, _ROUNDING)
    root = np.sqrt(eigenvalues[:n_components])
    combination = vectors[:, :n_components].T / root[:, None]
    sign = _signs(combination @ centred)
    combination *= sign[:, None]
    # The frames that are wanted are weighted sums of the model frames less their backgrounds.
    weights = np.vstack([np.full(len(scales), 1.0 / len(scales)), combination])
    rows = (weights @ factors) @ (response.level * response.table.values) - (weights @ background)[:, None]
    table = ResponseTable(
        response.table.start_um, response.table.step_um, rows / unit, np.zeros(len(rows)), math.nan
    )
    return ThicknessComponents(
        table,
        eigenvalues[:n_components] / (len(scales) - 1),
        eigenvalues[:n_components] / eigenvalues.sum(),
        vectors[:, :n_components] * root * sign,
        unit,
    )


@named_units
def fit_pca_from_thickness(
    thickness_um: ArrayLike,
    response: SkyResponse,
    scales: Sequence[Mapping[str, float]],
    *,
    n_components: int | None = None,
) -> FringeComponents:
    """Principal components of noiseless model frames, without making the frames: those of `fit_pca`, in pixels.

    The decomposition is that of `decompose_thickness`, which see for the arguments and for what is refused; nearly
    all of the time goes into the images of the components.
    """
    return decompose_thickness(thickness_um, response, scales, n_components=n_components).images(thickness_um)


def noise_eigenvalue(frames: int, pixels: int, noise_variance: float) -> float:
    """Largest eigenvalue that white noise alone gives the Gram matrix of N frames of P pixels.

    ``P sigma² (1 + sqrt(N / P))²`` (Marchenko & Pastur 1967).
    """
    return pixels * noise_variance * (1.0 + math.sqrt(frames / pixels)) ** 2


def significant_components(
    eigenvalues: ArrayLike, pixels: int, noise_variance: float, *, rounding: float = _ROUNDING
) -> int:
    """Number of components that stand above the noise, at least one.

    Parameters
    ----------
    eigenvalues : array_like, shape ``(N,)``
        Eigenvalues of the centred Gram matrix of N frames, descending.
    pixels : `int`
        Good pixels in a frame.
    noise_variance : `float`
        Variance of the noise of a pixel of a frame.
    rounding : `float`, optional
        Share of the variance below which an eigenvalue is rounding.

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
    return max(1, int(np.count_nonzero(values > max(edge, rounding * values.sum()))))


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


def _descending(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    eigenvalues, vectors = scipy.linalg.eigh(gram)
    return np.maximum(eigenvalues[::-1], 0.0), vectors[:, ::-1]


def _signs(components: FloatArray) -> FloatArray:
    """Signs that make the largest entry of every component positive, as scikit-learn does."""
    extreme = components[np.arange(len(components)), np.abs(components).argmax(axis=1)]
    return np.where(extreme < 0.0, -1.0, 1.0)


def _thickness_histogram(thickness: NDArray[Any], table: ResponseTable) -> tuple[FloatArray, FloatArray]:
    """Pixels per bin between the ends of a table, and centres of the bins; empty ones are left out."""
    values = np.ravel(thickness)
    low, width = table.start_um, (table.stop_um - table.start_um) / _HISTOGRAM_BINS
    count = np.zeros(_HISTOGRAM_BINS, dtype=np.int64)
    for start in range(0, values.size, _BLOCK):
        known = values[start : start + _BLOCK].astype(np.float64)
        known = known[~np.isnan(known)]
        if known.size:
            # The table says what is wrong with an end outside; rounding at its own ends is not.
            table.lookup([known.min(), known.max()])
            place = np.clip((known - low) / width, 0, _HISTOGRAM_BINS - 1).astype(np.int64)
            count += np.bincount(place, minlength=_HISTOGRAM_BINS)
    filled = np.flatnonzero(count)
    if filled.size == 0:
        raise InputError("pixels with a thickness", 0, "some pixels")
    return count[filled].astype(np.float64), np.asarray(low + (filled + 0.5) * width, dtype=np.float64)


def _dot(one: FloatArray, two: FloatArray) -> float:
    return float(np.vdot(one, two))


def _zero_mean(image: Float32Array, good: BoolArray) -> FloatArray:
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
