"""Observed frames to templates, and templates to corrected frames with their proof: products in, products out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray

from ..array_types import BoolArray, Float32Array, FloatArray
from ..errors import InputError, named_units
from ..notebook import do_nothing
from ..products import FringeFrame, FringeTemplates, ObservedFrame, mask_bits, refuse_corrected
from ..products.fringe_templates import PER_SKY, input_cards
from ..products.same_light import refuse_equal_pixels
from .correction.constant import without_constant_blocks
from .correction.empirical import TemplateOptions, fit_templates
from .correction.injection import InjectionOptions, inject_sources, injection_table
from .correction.objects import masked_sums, square_sums
from .correction.quality import FrameProof, prove
from .correction.scales import refuse_negative_sky, sky_is_subtracted, steady_weight
from .fringe_correction import CorrectionOptions, FringeCorrection, TemplateSet, correct_fringes
from .image_correlation import LogBins, correlation_function

__all__ = [
    "CorrectedFrame",
    "FrameRecord",
    "correct_frame",
    "first_of_alike",
    "frame_weight",
    "injected_table",
    "make_templates",
    "recover_sources",
    "summary_table",
]

LEAST_FRAMES = 3  # Two frames cannot tell what they share from what either has alone

APERTURE_ARCSEC = 20.0
"""Scale up to which fringes are judged: that of the criterion of the Dark Energy Survey."""

PICTURE_PX = 128
"""Pictures are averaged down to about this many pixels a side, over which noise is smoothed as well."""

SQUARES_IN_APERTURE = 12
"""Squares over which pixels are averaged for the correlation function, in its largest separation."""

LARGEST_PART = 8  # The largest aperture is at most this part of a side: there must be several of them


@dataclass(frozen=True, eq=False)
class CorrectedFrame:
    """A frame after its correction.

    Attributes
    ----------
    frame : `ObservedFrame`
        Corrected image, with `FringeCorrection.cards` in its metadata; pixels without a template keep their value and
        are masked SUSPECT.
    correction : `FringeCorrection`
        Scales and what was fitted beside them.
    proof : `FrameProof`
        Before and after.
    fringes : `numpy.ndarray`, float32, shape ``(ny, nx)``
        What was subtracted.
    """

    frame: ObservedFrame
    correction: FringeCorrection
    proof: FrameProof
    fringes: Float32Array

    def record(self, name: str, injected: Table | None = None) -> FrameRecord:
        """What is kept of a frame when its pixels are written."""
        fitted = self.correction.frame
        good = fitted.fit.weight > 0
        step = max(1, min(self.frame.shape) // PICTURE_PX)
        after, fringes = (_square_means(each, good, step) for each in (fitted.residual, self.fringes))
        before = after + fringes - self.fringes[good].mean(dtype=np.float64)
        correlation = self._correlation(good)
        pictures = (before, _square_means(self.fringes, np.isfinite(self.fringes), step), after)
        found = self.correction
        return FrameRecord(
            name,
            self.frame.detector,
            found.scale,
            found.sigma,
            self.proof,
            pictures,
            step,
            correlation,
            injected,
            self.frame.unit,
            found.of_own_templates,
            sky_is_subtracted(float(np.median(fitted.background)), self._pixel_noise()),
        )

    def _correlation(self, good: BoolArray) -> FloatArray:
        """Separation [px] and correlation before and after, over the variance of a pixel, shape ``(3, B)``.

        Of means over squares, at separations beyond one square, where white noise has none.
        """
        aperture = max(2, min(2 * PICTURE_PX, min(self.frame.shape) // LARGEST_PART))
        side = max(1, aperture // SQUARES_IN_APERTURE)
        fitted = self.correction.frame
        number = square_sums(good, side)
        after, fringes = (_square_means(each, good, side) for each in (fitted.residual, self.fringes))
        before = after + fringes
        bins = LogBins(1.5, max(3.0, aperture / side), 8)
        found = [
            correlation_function(np.nan_to_num(each - np.nanmean(each)), number, bins)
            for each in (before, after)
        ]
        variance = self._pixel_noise() ** 2
        return np.stack([side * found[0].separation_px, *(each.xi / variance for each in found)])

    def _pixel_noise(self) -> float:
        """Standard deviation of a pixel."""
        fit = self.correction.frame.fit
        return math.sqrt(fit.chi2_per_pixel / float(np.median(fit.weight[fit.weight > 0])))


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """A frame in the table and on the page of a night.

    Attributes
    ----------
    name, detector : `str`
        Frame and sensor.
    scale, sigma : `numpy.ndarray`, shape ``(K,)``
        Scales of the templates and their standard deviations.
    proof : `FrameProof`
        Before and after.
    pictures : `tuple` [`numpy.ndarray`, ...]
        Frame before, fringes, frame after, averaged over squares.
    step_px : `int`
        Side of the squares [px].
    correlation : `numpy.ndarray`, shape ``(3, B)``
        Separation [px], and the correlation function before and after the correction, over the variance of a pixel.
    injected : `~astropy.table.Table` or `None`
        Bias and scatter of the fluxes of sources in a copy of the frame (`injection_table`).
    unit : `str`
        Unit of the frame and of the scales; may be empty.
    of_own_templates : `bool`
        Whether the templates were made of this frame itself, and have its noise.
    sky_subtracted : `bool`
        Whether its sky is within the noise of a pixel of 0.
    """

    name: str
    detector: str
    scale: FloatArray
    sigma: FloatArray
    proof: FrameProof
    pictures: tuple[Float32Array, ...]
    step_px: int = 1
    correlation: FloatArray = field(default_factory=lambda: np.zeros((3, 0)))
    injected: Table | None = None
    unit: str = ""
    of_own_templates: bool = False
    sky_subtracted: bool = False


def make_templates(
    frames: Sequence[Callable[[], ObservedFrame]],
    creation_datetime: str,
    options: TemplateOptions | None = None,
    prior: Sequence[FringeFrame] = (),
    metadata: Mapping[str, Any] | None = None,
    advance: Callable[[], None] = do_nothing,
    names: Sequence[str] = (),
) -> FringeTemplates:
    """Make the templates of one sensor in one filter.

    Parameters
    ----------
    frames : sequence of callables
        Each returns a frame with its fringes; they are asked several times, one at a time, so that memory
        does not grow with their number.
    creation_datetime : `str`
        When the templates are made, ``YYYY-MM-DDThh:mm:ss``.
    options : `TemplateOptions`, optional
        Number of templates, background, amplifiers.
    prior : sequence of `FringeFrame`, optional
        Templates of a model; what the frames do not decide is taken from them.
    metadata : mapping, optional
        Further header keywords.
    advance : callable, optional
        Called after each frame of each round.
    names : sequence of `str`, optional
        What messages call the frames.

    Raises
    ------
    InputError
        Fewer than three frames, one frame twice, frames of different sensors, filters, units or sizes, or corrected
        ones.
    UndeterminedError
        The frames do not decide a template.
    """
    chosen = options or TemplateOptions()
    if len(frames) < LEAST_FRAMES:
        raise InputError("frames for templates", len(frames), "three or more, of different places on the sky")
    first, digests = first_of_alike(frames, names, "frames for templates")
    expected = [np.where(each.mask == 0, each.image, 0).astype(np.float32) for each in prior]
    found = fit_templates([partial(_loaded, frame) for frame in frames], chosen, expected, advance)
    unseen = found.coverage < chosen.least_frames
    return FringeTemplates(
        coverage=found.coverage.astype(np.float32),
        patterns=found.patterns,
        variance=found.variance,
        scores=found.scores,
        mask=np.where(unseen, mask_bits("NO_DATA"), 0).astype(np.int32),
        creation_datetime=creation_datetime,
        metadata={
            **(metadata or {}),
            "NFRAMES": len(frames),
            "BGSPACE": float(chosen.spacing_px),
            PER_SKY: found.per_sky,
            **input_cards(digests),
        },
        detector=first.detector,
        physical_filter=first.physical_filter,
    )


@named_units
def correct_frame(
    frame: ObservedFrame,
    templates: TemplateSet | Sequence[FringeFrame],
    options: CorrectionOptions | None = None,
    *,
    pixel_arcsec: float = 0.2,
    header: Mapping[str, Any] | None = None,
) -> CorrectedFrame:
    """Correct a frame, and compare it before and after.

    Parameters
    ----------
    frame : `ObservedFrame`
        A frame with its fringes.
    templates : `TemplateSet`, or sequence of `FringeFrame`
        Templates of its sensor.
    options : `CorrectionOptions`, optional
        Background, amplifiers, detection of objects.
    pixel_arcsec : `float`, optional
        Size of a pixel on the sky [arcsec].
    header : mapping, optional
        Header of the frame, if its metadata do not say all of it.

    Raises
    ------
    InputError
        A frame that was corrected already, or templates of another size.
    UndeterminedError
        Its pixels do not decide the scales.
    """
    chosen = options or CorrectionOptions()
    known = TemplateSet.of(templates)
    done = correct_fringes(
        frame.image,
        known,
        variance=frame.variance,
        mask=frame.mask,
        options=chosen,
        header={**frame.metadata, **(header or {})},
    )
    aperture = max(1, min(round(APERTURE_ARCSEC / pixel_arcsec), min(frame.shape) // LARGEST_PART))
    proof = prove(done.frame, done.frame.sums.weight, aperture, known.variances)
    corrected = dataclasses.replace(
        frame,
        image=done.image,
        mask=frame.mask | np.where(done.uncorrected, mask_bits("SUSPECT"), 0).astype(np.int32),
        metadata={**frame.metadata, **done.cards},
    )
    fringes = np.zeros(frame.shape, dtype=np.float32)
    np.subtract(frame.image, done.image, out=fringes, where=np.isfinite(frame.image))
    return CorrectedFrame(corrected, done, proof, fringes)


@named_units
def recover_sources(
    frame: ObservedFrame,
    corrected: CorrectedFrame,
    templates: TemplateSet,
    options: CorrectionOptions | None = None,
    *,
    pixel_arcsec: float = 0.2,
    sources: InjectionOptions | None = None,
    name: str = "",
) -> Table:
    """Draw sources into a copy of a frame, and find their fluxes before and after its correction.

    Parameters
    ----------
    frame : `ObservedFrame`
        A frame with its fringes; it stays as it is.
    corrected : `CorrectedFrame`
        Its correction, which tells where there are no objects.
    templates : `TemplateSet`
        Templates of its sensor.
    options : `CorrectionOptions`, optional
        Those of the correction.
    pixel_arcsec : `float`, optional
        Size of a pixel on the sky [arcsec].
    sources : `InjectionOptions`, optional
        Kinds and fluxes of the sources.
    name : `str`, optional
        Name of the frame in the table.

    Returns
    -------
    table : `~astropy.table.Table`
        One row for each kind and magnitude, see `injection_table`.

    Raises
    ------
    InputError
        No place where a source would be alone.
    """

    def both(image: Float32Array) -> tuple[Float32Array, Float32Array]:
        done = correct_fringes(image, templates, variance=frame.variance, mask=frame.mask, options=options)
        background = done.frame.background
        return image - background, np.asarray(done.image, dtype=np.float32) - background

    fitted, noise = corrected.correction.frame, corrected._pixel_noise()
    free = fitted.sums.usable & ~fitted.objects
    measured = inject_sources(frame.image, free, noise, pixel_arcsec, both, sources)
    return injection_table(name, measured)


def summary_table(records: Sequence[FrameRecord]) -> Table:
    """One row per frame: scales, structure before and after, and whether the templates may be trusted."""
    table = Table({name: [getattr(each, name) for each in records] for name in ("name", "detector", "unit")})
    for number in range(max((each.scale.size for each in records), default=0)):
        table[f"scale {number}"] = [_at(each.scale, number) for each in records]
        table[f"sigma {number}"] = [_at(each.sigma, number) for each in records]
    for name in (each.name for each in dataclasses.fields(FrameProof)):
        table[name] = [getattr(each.proof, name) for each in records]
    for row, name in ((1, "correlation_before"), (2, "correlation_after")):
        table[name] = [_largest(each.correlation[row]) for each in records]
    table["of_own_templates"] = [each.of_own_templates for each in records]
    table["seen"] = [each.proof.seen for each in records]
    table["passed"] = [each.proof.passed for each in records]
    return table


def injected_table(records: Sequence[FrameRecord]) -> Table | None:
    """Bias and scatter of the fluxes of sources in copies of all frames; `None` if none were drawn."""
    tables = [each.injected for each in records if each.injected is not None]
    return vstack(tables) if tables else None


def _largest(values: FloatArray) -> float:
    """The value that is farthest from 0; NaN without any."""
    known = values[np.isfinite(values)]
    return float(known[np.argmax(np.abs(known))]) if known.size else math.nan


def _at(values: FloatArray, number: int) -> float:
    return float(values[number]) if number < values.size else 0.0


def _square_means(image: NDArray[Any], good: BoolArray, side: int) -> Float32Array:
    """Means over squares of the good pixels; NaN without any."""
    number = square_sums(good, side)
    total = masked_sums(image, good, side)
    return np.divide(total, number, out=np.full(number.shape, np.nan, np.float32), where=number > 0)


def first_of_alike(
    frames: Sequence[Callable[[], ObservedFrame]], names: Sequence[str], purpose: str
) -> tuple[ObservedFrame, list[str]]:
    """The first frame, when all have been found to belong together, each being there once; and digests of all.

    `InputError`: one is of another sensor, filter, unit or size, was corrected, or is there twice.
    """
    first = frames[0]()

    def images() -> Iterator[Float32Array]:
        for frame in frames:
            read = frame()
            _refuse_other(read, first)
            yield read.image

    return first, refuse_equal_pixels(purpose, images(), names)


def _loaded(frame: Callable[[], ObservedFrame]) -> tuple[Float32Array, Float32Array]:
    read = frame()
    return read.image, frame_weight(read)


def frame_weight(frame: ObservedFrame) -> Float32Array:
    """Inverse variance of the background of a frame, 0 where it is masked, no number, or has no noise."""
    good = without_constant_blocks(frame.image, (frame.mask == 0) & np.isfinite(frame.image))
    weight = steady_weight(good, frame.variance, frame.image)
    refuse_negative_sky(frame.image, weight)
    return weight


def _refuse_other(frame: ObservedFrame, first: ObservedFrame) -> None:
    refuse_corrected(frame.metadata, frame.detector or None)
    for name in ("shape", "detector", "physical_filter", "unit"):
        if getattr(frame, name) != getattr(first, name):
            raise InputError(
                f"{name} of a frame", getattr(frame, name), f"{getattr(first, name)}, as of the first"
            )
