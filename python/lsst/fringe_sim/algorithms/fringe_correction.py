"""Fringe correction of exposures by templates, and how much fringe is left.

All templates are fitted at once by weighted least squares over the good pixels, with the background and steps between
amplifiers beside them; objects are found where both are subtracted. Inputs are never changed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import BoolArray, Float32Array, FloatArray
from ..compiled import run_threaded
from ..errors import InputError, OutOfRangeError, named_units, to_number
from ..products import CORRECTED, FringeFrame, refuse_corrected
from ..products.fringe_templates import INPUT, made_of
from ..products.same_light import pixels_digest
from .correction.background import AMPLIFIERS_UNKNOWN, SPACING_PX, AmplifierGrid, BackgroundTerms
from .correction.constant import without_constant_blocks
from .correction.objects import ROUNDS, FrameFit, fit_frame
from .correction.scales import ScaleFit, refuse_negative_sky, steady_weight
from .sky_frame import SkyResponse

__all__ = [
    "CorrectionOptions",
    "FringeCorrection",
    "TemplateSet",
    "component_patterns",
    "correct_fringes",
    "refuse_uncorrected",
    "undo_correction",
]

Templates: TypeAlias = "TemplateSet | Sequence[FringeFrame] | ArrayLike"

_ROWS = 128  # Rows that are worked on at a time, which the memory of a processor holds
TEMPLATE_ID = "FRINGTID"  # Keyword of a corrected exposure: which templates were subtracted


@dataclass(frozen=True)
class CorrectionOptions:
    """What is fitted beside the templates.

    Attributes
    ----------
    spacing_px : `float`
        Distance between the knots of the background [px].
    amplifiers : `AmplifierGrid`
        Amplifiers with levels of their own; by default the frame tells whether levels differ (`LevelSpread`).
    find_objects : `bool`
        Whether objects are looked for; otherwise the mask names all of them.
    """

    spacing_px: float = SPACING_PX
    amplifiers: AmplifierGrid = AMPLIFIERS_UNKNOWN
    find_objects: bool = True


@dataclass(frozen=True, eq=False)
class TemplateSet:
    """Templates as the fit wants them; made once for all frames of a sensor.

    Attributes
    ----------
    patterns : `list` of `numpy.ndarray`, float32, shape ``(ny, nx)``
        Templates of mean 0; 0 where they have no value.
    variances : `list` of `numpy.ndarray`, float32
        Variance of the noise of each, 0 where nobody knows it.
    unknown : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Pixels in which one of them has no value.
    identity : `str`
        Beginning of the SHA-256 of all their pixels that have a value.
    metadata : `list` of mapping
        Header keywords of each, as far as they have some.
    """

    patterns: list[Float32Array]
    variances: list[Float32Array]
    unknown: BoolArray
    identity: str
    metadata: list[Mapping[str, Any]] = field(default_factory=list)

    @classmethod
    def of(cls, templates: Templates) -> TemplateSet:
        """Take templates in.

        Raises
        ------
        InputError
            No template, or templates of several shapes.
        """
        if isinstance(templates, TemplateSet):
            return templates
        pairs = [_pattern(template) for template in templates]  # type: ignore[union-attr]
        if not pairs:
            raise InputError("templates", 0, "one or more")
        digest = hashlib.sha256()
        unknown = np.zeros(pairs[0][0].shape, dtype=bool)
        patterns, variances = [], []
        for (image, missing), template in zip(pairs, templates, strict=True):  # type: ignore[arg-type]
            unknown |= _of_shape("template", missing, unknown.shape)
            digest.update(np.where(missing, np.float32(np.nan), image).astype("<f4").tobytes())
            # A pedestal is no fringe, and would take sky along.
            pedestal = image.mean(where=~missing, dtype=np.float64) if not missing.all() else 0.0
            patterns.append(np.where(missing, np.float32(0.0), image - np.float32(pedestal)))
            if isinstance(template, FringeFrame):
                variances.append(np.where(missing, np.float32(0.0), template.variance.astype(np.float32)))
        cards = [template.metadata for template in templates if isinstance(template, FringeFrame)]  # type: ignore[union-attr]
        return cls(patterns, variances, unknown, digest.hexdigest()[:16], cards)

    def made_of(self, image: NDArray[Any]) -> bool:
        """Whether they were made of this frame, among others."""
        named = [cards for cards in self.metadata if any(map(INPUT.fullmatch, cards))]
        digest = pixels_digest(image) if named else ""
        return any(made_of(each, digest) for each in named)

    def refuse_other_shape(self, shape: tuple[int, ...]) -> None:
        """Refuse an exposure of another size.

        Raises
        ------
        InputError
            It is not as large as the templates.
        """
        if shape != self.unknown.shape:
            raise InputError("shape of the frame", shape, f"{self.unknown.shape}, that of the templates")


@dataclass(frozen=True, eq=False)
class FringeCorrection:
    """A corrected exposure and what was subtracted.

    Attributes
    ----------
    image : `numpy.ndarray`, shape ``(ny, nx)``
        Exposure less the scaled templates, in the floating type of the exposure; where a template has no value, or if
        their fringes are not seen, the exposure itself.
    uncorrected : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Pixels in which a template has no value.
    scale : `numpy.ndarray`, shape ``(K,)``
        Measured scales of the templates, in the unit of the exposure over that of the templates.
    covariance : `numpy.ndarray`, shape ``(K, K)``
        Their covariance.
    frame : `FrameFit`
        Background, objects and residual.
    templates : `TemplateSet`
        The templates.
    of_own_templates : `bool`
        Whether the templates were made of this exposure, among others: what is left cannot be judged from it.
    """

    image: NDArray[Any]
    uncorrected: BoolArray
    scale: FloatArray
    covariance: FloatArray
    frame: FrameFit
    templates: TemplateSet
    of_own_templates: bool = False

    @property
    def template_id(self) -> str:
        """Which templates they are (`TemplateSet.identity`)."""
        return self.templates.identity

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the scales."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def seen(self) -> bool:
        """Whether the exposure has the fringes of the templates; otherwise nothing was subtracted."""
        return self.frame.fit.seen

    def applied(self, image: NDArray[Any]) -> NDArray[Any]:
        """The same exposure in another floating type, corrected; whole numbers become single precision."""
        return _subtracted(image, self.templates, self.frame.fit)

    @property
    def cards(self) -> dict[str, Any]:
        """Header keywords of the corrected exposure: by them it is refused a second time, and restored."""
        subtracted = self.scale if self.seen else np.zeros(0)
        scales = {f"FRINGSC{number}": float(scale) for number, scale in enumerate(subtracted)}
        sigmas = {f"FRINGSE{number}": float(sigma) for number, sigma in enumerate(self.sigma)}
        return {CORRECTED: subtracted.size, TEMPLATE_ID: self.template_id, **scales, **sigmas}


def correct_fringes(
    image: ArrayLike,
    templates: Templates,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    options: CorrectionOptions | None = None,
    header: Mapping[str, Any] | None = None,
) -> FringeCorrection:
    """Subtract scaled templates from an exposure, unless their fringes are not seen in it.

    Parameters
    ----------
    image : array_like, shape ``(ny, nx)``
        Exposure; its sky may be subtracted already, as long as the fringes are not.
    templates : `TemplateSet`, sequence of `FringeFrame`, or array_like of shape ``(K, ny, nx)``
        Fringe templates; NaN, or masked, where they have no value.
    variance : array_like, shape ``(ny, nx)``, optional
        Variance of the exposure; by default one for all pixels, from the differences of neighbours. The errors of the
        scales do not rely on it.
    mask : array_like, shape ``(ny, nx)``, optional
        Non-zero where the exposure is not to be measured (defects, known objects). It is corrected there all
        the same.
    options : `CorrectionOptions`, optional
        Background, amplifiers, detection of objects.
    header : mapping, optional
        Header of the exposure; one that was corrected before is refused (`FringeCorrection.cards`).

    Returns
    -------
    correction : `FringeCorrection`

    Raises
    ------
    InputError
        An exposure that was corrected already or has a negative sky, no template, or shapes that do not belong
        together.
    UndeterminedError
        Too few good pixels, or templates that the background or each other can stand for.
    """
    refuse_corrected(header or {})
    chosen = options or CorrectionOptions()
    exposure = np.asarray(image)
    if exposure.ndim != 2:
        raise InputError("shape of the exposure", exposure.shape, "two axes (y, x)")
    shape = (exposure.shape[0], exposure.shape[1])
    known = TemplateSet.of(templates)
    known.refuse_other_shape(shape)
    unknown = known.unknown
    good = np.isfinite(exposure) & ~unknown
    if mask is not None:
        good &= _of_shape("mask", mask, shape) == 0
    good = without_constant_blocks(exposure, good)
    weight = steady_weight(
        good, None if variance is None else _of_shape("variance", variance, shape), exposure
    )
    refuse_negative_sky(exposure, weight)
    background = BackgroundTerms(shape, chosen.spacing_px, chosen.amplifiers)
    rounds = ROUNDS if chosen.find_objects else 1
    frame = fit_frame(exposure, weight, known.patterns, background, rounds=rounds)
    corrected = _subtracted(exposure, known, frame.fit)
    own = known.made_of(exposure)
    return FringeCorrection(corrected, unknown, frame.fit.scale, frame.fit.covariance, frame, known, own)


def undo_correction(image: ArrayLike, templates: Templates, header: Mapping[str, Any]) -> NDArray[Any]:
    """Add the fringes again that `correct_fringes` subtracted; the exposure is what it was, to rounding.

    Parameters
    ----------
    image : array_like, shape ``(ny, nx)``
        Corrected exposure.
    templates : `TemplateSet`, sequence of `FringeFrame`, or array_like of shape ``(K, ny, nx)``
        The templates of the correction.
    header : mapping
        Header of the corrected exposure.

    Raises
    ------
    InputError
        The header states no correction of ours, or other templates.
    """
    refuse_uncorrected(header)
    known = TemplateSet.of(templates)
    if header.get(TEMPLATE_ID) != known.identity:
        allowed = f"{known.identity}, which the templates given have"
        raise InputError(TEMPLATE_ID, header.get(TEMPLATE_ID), allowed)
    corrected = np.asarray(image)
    known.refuse_other_shape(corrected.shape)
    return np.asarray(corrected + _fringes(known, _stated_scales(header, known.patterns), corrected))


def refuse_uncorrected(header: Mapping[str, Any], source: str | None = None) -> None:
    """Refuse an exposure of which the header does not say that this package has corrected it.

    Raises
    ------
    InputError
        It does not.
    """
    if header.get(CORRECTED) is None:
        raise InputError(CORRECTED, None, "an exposure that was corrected by this package", source=source)


def _stated_scales(header: Mapping[str, Any], patterns: Sequence[NDArray[Any]]) -> FloatArray:
    """Scales of all templates by a header of ours; 0 if they were not seen, and nothing was subtracted."""
    if header[CORRECTED] == 0:
        return np.zeros(len(patterns))
    if header[CORRECTED] != len(patterns):
        raise InputError(CORRECTED, header[CORRECTED], f"{len(patterns)}, the number of the templates")
    names = [f"FRINGSC{item}" for item in range(len(patterns))]
    scale = np.array([to_number(name, header.get(name)) for name in names])
    for name, value in zip(names, scale, strict=True):
        if not abs(value) < np.finfo(np.float32).max:
            raise OutOfRangeError(name, float(value), "a finite number of electrons")
    return scale


@named_units
def component_patterns(thickness_um: ArrayLike, response: SkyResponse) -> Float32Array:
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


def _pattern(template: FringeFrame | ArrayLike) -> tuple[Float32Array, BoolArray]:
    """A template, and where it has no value."""
    if isinstance(template, FringeFrame):
        return template.image, template.mask != 0
    image = np.asarray(template, dtype=np.float32)
    return image, ~np.isfinite(image)


def _of_shape(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
    array = np.asarray(values)
    if array.shape != shape:
        raise InputError(f"shape of the {name}", array.shape, f"{shape}")
    return array


def _fringes(known: TemplateSet, scale: FloatArray, exposure: NDArray[Any]) -> NDArray[Any]:
    """What is subtracted, in the floating type of the exposure."""
    kind = _floating(exposure)
    total = np.empty(exposure.shape, dtype=kind)

    def one(band: int) -> None:
        rows = slice(band * _ROWS, (band + 1) * _ROWS)
        part = total[rows]
        part[...] = 0.0
        for factor, pattern in zip(scale, known.patterns, strict=True):
            part += kind.type(factor) * pattern[rows]
        part[known.unknown[rows]] = 0.0

    run_threaded(one, -(-len(total) // _ROWS))
    return total


def _subtracted(exposure: NDArray[Any], known: TemplateSet, fit: ScaleFit) -> NDArray[Any]:
    """An exposure without its fringes, if they are seen."""
    if not fit.seen:
        return exposure.astype(_floating(exposure))
    fringes = _fringes(known, fit.scale, exposure)
    return np.subtract(exposure, fringes, out=fringes, casting="unsafe")


def _floating(exposure: NDArray[Any]) -> np.dtype[Any]:
    """Type in which an exposure is corrected: its own, or single precision for whole numbers."""
    return exposure.dtype.newbyteorder("=") if exposure.dtype.kind == "f" else np.dtype(np.float32)
