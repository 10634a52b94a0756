"""Observed frames to templates, and templates to corrected frames with their proof: products in, products out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from ..errors import InputError, named_units
from ..products import FringeFrame, FringeTemplates, ObservedFrame, mask_bits, refuse_corrected
from ..products.same_light import refuse_equal_pixels
from .correction.background import BackgroundTerms
from .correction.empirical import TemplateOptions, fit_templates
from .correction.quality import FrameProof, prove
from .correction.scales import steady_weight
from .fringe_correction import CorrectionOptions, FringeCorrection, correct_fringes

__all__ = ["CorrectedFrame", "FrameRecord", "correct_frame", "make_templates", "summary_table"]

LEAST_FRAMES = 3
"""Two frames cannot tell what they share from what either has alone."""

APERTURE_ARCSEC = 20.0
"""Scale up to which fringes are judged: that of the criterion of the Dark Energy Survey."""

PICTURE_PX = 128
"""Pictures are averaged down to about this many pixels a side, over which noise is smoothed as well."""

LARGEST_PART = 8
"""The largest aperture is at most this part of a side: there must be several of them."""


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
    fringes: NDArray[np.float32]

    def record(self, name: str) -> FrameRecord:
        """What is kept of a frame when its pixels are written."""
        fitted = self.correction.frame
        good = fitted.fit.weight > 0
        after = np.where(good, fitted.residual, np.nan)
        before = after + np.where(good, self.fringes - self.fringes[good].mean(), np.nan)
        step = max(1, min(self.frame.shape) // PICTURE_PX)
        pictures = tuple(_block_means(each, step) for each in (before, self.fringes, after))
        found = self.correction
        return FrameRecord(name, self.frame.detector, found.scale, found.sigma, self.proof, pictures, step)


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
    """

    name: str
    detector: str
    scale: NDArray[np.float64]
    sigma: NDArray[np.float64]
    proof: FrameProof
    pictures: tuple[NDArray[np.float64], ...]
    step_px: int = 1


def make_templates(
    frames: Sequence[Callable[[], ObservedFrame]],
    creation_datetime: str,
    options: TemplateOptions | None = None,
    prior: Sequence[FringeFrame] = (),
    metadata: Mapping[str, Any] | None = None,
    advance: Callable[[], None] = lambda: None,
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
    first = _first_of_alike(frames, names)
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
        metadata={**(metadata or {}), "NFRAMES": len(frames), "BGSPACE": float(chosen.spacing_px)},
        detector=first.detector,
        physical_filter=first.physical_filter,
    )


@named_units
def correct_frame(
    frame: ObservedFrame,
    templates: Sequence[FringeFrame],
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
    templates : sequence of `FringeFrame`
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
    done = correct_fringes(
        frame.image,
        templates,
        variance=frame.variance,
        mask=frame.mask,
        options=chosen,
        header={**frame.metadata, **(header or {})},
    )
    background = BackgroundTerms(frame.shape, chosen.spacing_px, chosen.amplifiers)
    weight = np.where(done.uncorrected, 0, _weight(frame)).astype(np.float32)
    aperture = max(1, min(round(APERTURE_ARCSEC / pixel_arcsec), min(frame.shape) // LARGEST_PART))
    patterns = [np.where(each.mask == 0, each.image, 0) for each in templates]
    variances = [np.where(each.mask == 0, each.variance, 0) for each in templates]
    proof = prove(frame.image, weight, done.frame.fit, patterns, background, aperture, variances)
    corrected = dataclasses.replace(
        frame,
        image=done.image,
        mask=frame.mask | np.where(done.uncorrected, mask_bits("SUSPECT"), 0).astype(np.int32),
        metadata={**frame.metadata, **done.cards},
    )
    fringes = np.where(np.isfinite(frame.image), frame.image - done.image, 0).astype(np.float32)
    return CorrectedFrame(corrected, done, proof, fringes)


def summary_table(records: Sequence[FrameRecord]) -> Table:
    """One row per frame: scales, structure before and after, and whether the templates may be trusted."""
    table = Table({name: [getattr(each, name) for each in records] for name in ("name", "detector")})
    for number in range(max((each.scale.size for each in records), default=0)):
        table[f"scale {number}"] = [_at(each.scale, number) for each in records]
        table[f"sigma {number}"] = [_at(each.sigma, number) for each in records]
    for name in (field.name for field in dataclasses.fields(FrameProof)):
        table[name] = [getattr(each.proof, name) for each in records]
    table["passed"] = [each.proof.passed for each in records]
    return table


def _at(values: NDArray[np.float64], number: int) -> float:
    return float(values[number]) if number < values.size else 0.0


def _block_means(image: NDArray[Any], side: int) -> NDArray[np.float64]:
    """Means over squares of the pixels that are numbers."""
    ny, nx = (size // side for size in image.shape)
    blocks = image[: ny * side, : nx * side].reshape(ny, side, nx, side).astype(np.float64)
    known = np.isfinite(blocks)
    number = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.divide(total, number, out=np.full((ny, nx), np.nan), where=number > 0)


def _first_of_alike(frames: Sequence[Callable[[], ObservedFrame]], names: Sequence[str]) -> ObservedFrame:
    """The first frame, when all have been read and found to belong together."""
    if len(frames) < LEAST_FRAMES:
        raise InputError("frames for templates", len(frames), "three or more, of different places on the sky")
    first = frames[0]()

    def images() -> Iterator[NDArray[np.float32]]:
        for frame in frames:
            read = frame()
            _refuse_other(read, first)
            yield read.image

    refuse_equal_pixels("frames for templates", images(), names)
    return first


def _loaded(frame: Callable[[], ObservedFrame]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    read = frame()
    return read.image, _weight(read)


def _weight(frame: ObservedFrame) -> NDArray[np.float32]:
    good = (frame.mask == 0) & np.isfinite(frame.image)
    return steady_weight(good, frame.variance, frame.image)


def _refuse_other(frame: ObservedFrame, first: ObservedFrame) -> None:
    refuse_corrected(frame.metadata, frame.detector or None)
    for name in ("shape", "detector", "physical_filter", "unit"):
        if getattr(frame, name) != getattr(first, name):
            raise InputError(
                f"{name} of a frame", getattr(frame, name), f"{getattr(first, name)}, as of the first"
            )
