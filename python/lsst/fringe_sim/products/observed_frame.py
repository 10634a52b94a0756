"""A frame as it comes from a pipeline: signature removed, objects and fringes in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..array_types import Float32Array
from .fits_product import DETECTOR, FILTER, MASK, Card, Image, SensorProduct
from .sky_frame import SkyFringe


@dataclass(frozen=True, eq=False, repr=False)
class ObservedFrame(SensorProduct):
    """Exposure of one sensor after the removal of its signature.

    Parameters
    ----------
    image : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Counts in ``unit``; NaN where there are none.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; 0 is good.
    variance : `numpy.ndarray`, float32, shape ``(ny, nx)``, or `None`
        Variance in the square of ``unit``; `None` if nobody knows it.
    unit : `str`
        Unit of the image, as its file names it; may be empty.
    metadata : `Mapping`
        Header keywords.
    detector, physical_filter : `str`
        Sensor and filter; empty if not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape.
    InputError
        Metadata that a header cannot hold.
    """

    image: Float32Array
    mask: NDArray[np.int32]
    variance: Float32Array | None = None
    unit: str = ""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    physical_filter: str = ""

    CARDS = (DETECTOR, FILTER, Card("unit", "IMGUNIT", "unit of IMAGE", kind=str, default=""))
    EXTENSIONS = (
        Image("image", "IMAGE", None, gaps=True),
        MASK,
        Image("variance", "VARIANCE", None, gaps=True, optional=True),
    )


def observed_from_simulation(frame: SkyFringe) -> ObservedFrame:
    """A simulated frame of the sky, as if it had been observed."""
    electrons = frame.image
    if frame.unit == "fraction":
        electrons = (frame.mean_electrons * (1.0 + frame.image)).astype(np.float32)
    return ObservedFrame(
        image=electrons,
        mask=frame.mask,
        unit="electron",
        metadata=frame.metadata,
        detector=frame.detector,
        physical_filter=frame.physical_filter,
    )
