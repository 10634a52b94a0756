"""Fringe templates of one sensor that were made from observed frames."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..array_types import Float32Array, FloatArray
from ..errors import FrameFormatError
from .fits_product import DETECTOR, FILTER, MASK, Card, FitsProduct, Image
from .fringe_frame import FringeFrame
from .mask import mask_bits

PER_SKY = "PERSKY"
"""Keyword of templates: whether they are parts of the sky; otherwise they are in the unit of the frames."""

INPUT = re.compile(r"INPUT\d+")  # Keywords of templates with the digests of the frames that they were made of
DIGITS = 16  # Digits of a digest that a keyword holds


def input_cards(digests: Sequence[str]) -> dict[str, str]:
    """Keywords of templates that name the frames that they were made of, by digests of their pixels."""
    return {f"INPUT{number}": digest[:DIGITS] for number, digest in enumerate(digests)}


def made_of(metadata: Mapping[str, Any], digest: str) -> bool:
    """Whether the keywords of a template name a frame among those that it was made of."""
    return any(INPUT.fullmatch(name) and value == digest[:DIGITS] for name, value in metadata.items())


@dataclass(frozen=True, eq=False, repr=False)
class FringeTemplates(FitsProduct):
    """Patterns that frames share, strongest first.

    A frame with sky b holds their sum with scales, of which the root mean square of the first is about b.

    Parameters
    ----------
    coverage : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Frames that see each pixel.
    patterns : `numpy.ndarray`, float32, shape ``(K, ny, nx)``
        Templates, in fractions of the sky, or in the unit of the frames (`per_sky`); every pixel a number.
    variance : `numpy.ndarray`, float32, shape ``(K, ny, nx)``
        Variance of their noise.
    scores : `numpy.ndarray`, float64, shape ``(N, K)``
        Scale of every template in every frame.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; NO_DATA where too few frames see the sky.
    creation_datetime : `str`
        When they were made, ``YYYY-MM-DDThh:mm:ss``.
    metadata : `Mapping`
        Further header keywords.
    detector, physical_filter : `str`
        Sensor and filter; empty if not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or a pixel without a number.
    """

    coverage: Float32Array
    patterns: Float32Array
    variance: Float32Array
    scores: FloatArray
    mask: NDArray[np.int32]
    creation_datetime: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    physical_filter: str = ""

    @property
    def per_sky(self) -> bool:
        """Whether the frames had a sky, of which the patterns are parts."""
        return bool(self.metadata.get(PER_SKY, True))

    def _picture(self) -> tuple[NDArray[Any], str, bool]:
        if not self.per_sky:
            return self.patterns[0], "first template [unit of the frames]", True
        return 100.0 * self.patterns[0], "first template [% of the sky]", True

    CARDS = (DETECTOR, FILTER, Card("creation_datetime", "CALIB_CREATION_DATETIME", "", kind=str))
    EXTENSIONS = (
        Image("coverage", "COVERAGE", "frames", everywhere=True, nonnegative=True),
        Image("patterns", "PATTERNS", ndim=3, everywhere=True),
        Image("variance", "VARIANCE", ndim=3, everywhere=True, nonnegative=True),
        MASK,
        Image("scores", "SCORES", dtype=np.float64, everywhere=True, on_sensor=False),
    )

    def _check(self) -> None:
        if self.scores.shape[1] != len(self.patterns) or self.variance.shape != self.patterns.shape:
            shapes = (self.patterns.shape, self.variance.shape, self.scores.shape)
            raise FrameFormatError("PATTERNS, VARIANCE, SCORES", shapes, "as many templates in each")

    def frames(self) -> list[FringeFrame]:
        """The templates one by one, as a correction takes them and as ``ip_isr`` reads them."""
        good, known = self.mask == 0, (self.mask & mask_bits("NO_DATA")) == 0
        made = []
        for number, (pattern, variance) in enumerate(zip(self.patterns, self.variance, strict=True)):
            level = pattern[good].mean(dtype=np.float64) if good.any() else 0.0
            made.append(
                FringeFrame(
                    image=np.where(known, pattern - level, 0.0).astype(np.float32),
                    mask=self.mask,
                    variance=variance,
                    physical_filter=self.physical_filter or "unknown",
                    creation_datetime=self.creation_datetime,
                    metadata={**self.metadata, "TEMPLATE": number},
                    detector=self.detector,
                )
            )
        return made
