"""Frames and templates as afw exposures, where afw is installed. It is not needed for anything else."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import InputError
from ..products import MASK_PLANES, FringeFrame, ObservedFrame, mask_bits
from ..products.sky_frame import CORRECTED_BY

UNITS = ("BUNIT", "LSST ISR UNITS")
"""Keywords that name the unit of an exposure: that of FITS, and that of ip_isr."""


def read_exposure(path: str) -> Any:
    """Read the file of a fringe frame as an ``ExposureF``. `InputError`: afw is not installed."""
    try:
        from lsst.afw.image import ExposureF
    except ImportError:
        raise InputError(
            "storage class",
            "ExposureF",
            "FringeFrame; an exposure needs lsst.afw, which is not installed here",
            source=path,
        ) from None
    return ExposureF.readFits(path)


def frame_from_exposure(exposure: Any) -> FringeFrame:
    """Return the fringe frame that an ``ExposureF`` holds.

    ``exposure``: a fringe calibration: zero-mean fractions of the sky, with the time of its making in
        ``CALIB_CREATION_DATETIME``.
    `InputError`: the exposure does not say when it was made, or is no fringe frame.
    """
    header = exposure.getMetadata()
    if "CALIB_CREATION_DATETIME" not in header:
        raise InputError("CALIB_CREATION_DATETIME", None, "YYYY-MM-DDThh:mm:ss in the exposure's metadata")
    corner = exposure.getXY0()
    detector = exposure.getDetector()
    return FringeFrame(
        image=np.array(exposure.image.array, dtype=np.float32),
        mask=_known_planes(exposure.mask),
        variance=np.array(exposure.variance.array, dtype=np.float32),
        physical_filter=str(exposure.getFilter().physicalLabel),
        creation_datetime=str(header["CALIB_CREATION_DATETIME"]),
        detector="" if detector is None else str(detector.getName()),
        xy0=(int(corner[0]), int(corner[1])),
    )


def observed_from_exposure(exposure: Any) -> ObservedFrame:
    """Return the frame that an exposure of Rubin's pipelines holds.

    ``exposure``: a science exposure after the removal of its instrument's signature.
    """
    detector, header = exposure.getDetector(), exposure.getMetadata()
    label = exposure.getFilter()
    return ObservedFrame(
        image=np.array(exposure.image.array, dtype=np.float32),
        mask=_known_planes(exposure.mask),
        variance=np.array(exposure.variance.array, dtype=np.float32),
        unit=next((str(header[name]) for name in UNITS if name in header), ""),
        metadata={name: header[name] for name in CORRECTED_BY if name in header},
        detector="" if detector is None else str(detector.getName()),
        physical_filter="" if label is None else str(label.physicalLabel),
    )


def put_into_exposure(exposure: Any, corrected: ObservedFrame) -> Any:
    """Give an exposure the pixels of its corrected frame; what else it holds (its WCS, its visit) stays.

    ``exposure``: the one that `observed_from_exposure` was asked for. It is changed, and returned.
    ``corrected``: its frame after the correction, whose keywords join those of the exposure.
    """
    exposure.image.array[...] = corrected.image
    without_template = corrected.mask & mask_bits("SUSPECT") != 0
    exposure.mask.array[without_template] |= exposure.mask.getPlaneBitMask("SUSPECT")
    header = exposure.getMetadata()
    for name, value in corrected.metadata.items():
        header[name] = value
    return exposure


def _known_planes(mask: Any) -> np.ndarray:
    """Mask with the planes that both sides know; a pixel masked for another reason becomes BAD."""
    stored = np.asarray(mask.array)
    result = np.zeros(stored.shape, dtype=np.int32)
    for name, bit in mask.getMaskPlaneDict().items():
        plane = MASK_PLANES.get(name, MASK_PLANES["BAD"])
        result |= np.where(stored >> bit & 1, np.int32(1 << plane), np.int32(0))
    return result
