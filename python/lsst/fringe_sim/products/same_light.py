"""The same light twice would count twice: images of equal pixels, and frames of different models."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

_MODEL = re.compile(r"SETUP|BEAMS|(EFFECT|EFFVAL|TABLE)\d+")


def pixels_digest(image: NDArray[Any]) -> str:
    """Digest of the pixels of an image."""
    return hashlib.blake2b(np.ascontiguousarray(image, "<f4").tobytes(), digest_size=16).hexdigest()


def refuse_equal_pixels(field: str, images: Iterable[NDArray[Any]], names: Sequence[str] = ()) -> list[str]:
    """Refuse images of which two have equal pixels; images of one value have no light to tell.

    Returns their digests.

    ``names``: what the message calls them, in place of their numbers.
    """
    seen: dict[str, int] = {}
    digests = []
    for number, image in enumerate(images):
        digests.append(pixels_digest(image))
        first = seen.setdefault(digests[-1], number)
        if first != number and image.min() != image.max():
            pair = f"{names[first]} and {names[number]}" if names else f"{first} and {number}"
            raise InputError(field, f"equal pixels in {pair}", "each exposure once")
    return digests


def refuse_mixed_models(metadata: Sequence[Mapping[str, Any]]) -> None:
    """Refuse simulated frames of different set-ups, effects or tables."""
    cards = [{key: value for key, value in one.items() if _MODEL.fullmatch(key)} for one in metadata]
    for number, other in enumerate(cards):
        differ = sorted(key for key in {*cards[0], *other} if cards[0].get(key) != other.get(key))
        if differ:
            key = differ[0]
            found = f"{cards[0].get(key)} in frame 0, {other.get(key)} in frame {number}"
            raise InputError(f"{key} of the frames", found, "frames of one model")
