"""World coordinates of images of a sensor: pixels of the sensor, and millimetres in the focal plane.

Both are alternate descriptions of the FITS standard (Greisen & Calabretta 2002, doi 10.1051/0004-6361:20021326):
``D`` for detector pixels, counted from 0, and ``F`` for the focal plane, as of ``astropy.wcs.WCS(header, key="F")``.
"""

from __future__ import annotations

import math
import os
from typing import Any

from astropy.io import fits

from ..errors import InputError
from ..instrument.detector import Detector
from ._fits import write_hdus

__all__ = ["add_sensor_wcs", "sensor_wcs"]


def sensor_wcs(detector: Detector, shape: tuple[int, int]) -> fits.Header:
    """Header cards for an image that covers a sensor.

    Parameters
    ----------
    detector : `Detector`
        Its size, pitch, and place in the focal plane.
    shape : `tuple` [`int`, `int`]
        Rows and columns of the image; one that has fewer than the sensor covers it all the same, with larger pixels.

    Returns
    -------
    cards : `astropy.io.fits.Header`
        The descriptions ``D`` [px] and ``F`` [mm].

    Raises
    ------
    InputError
        An image without pixels.
    """
    if min(shape) < 1:
        raise InputError("shape of the image", shape, "positive")
    steps = [full / size for full, size in zip(detector.shape, shape, strict=True)][::-1]
    cards = fits.Header()
    cards["WCSAXESD"], cards["WCSNAMED"] = 2, "DETECTOR"
    for axis, step in enumerate(steps, start=1):
        cards[f"CTYPE{axis}D"] = "LINEAR"
        cards[f"CUNIT{axis}D"] = "pix"
        cards[f"CRPIX{axis}D"] = 1.0
        # The first pixel of a thinned image is centred on several of the sensor.
        cards[f"CRVAL{axis}D"] = (0.5 * (step - 1.0), "from 0, [px]")
        cards[f"CDELT{axis}D"] = (step, "pixels of the sensor")
    turn = math.radians(detector.yaw_deg)
    rotation = ((math.cos(turn), -math.sin(turn)), (math.sin(turn), math.cos(turn)))
    cards["WCSAXESF"], cards["WCSNAMEF"] = 2, "FOCAL PLANE"
    for axis, (centre, row) in enumerate(zip((detector.x_mm, detector.y_mm), rotation, strict=True), start=1):
        cards[f"CTYPE{axis}F"] = "LINEAR"
        cards[f"CUNIT{axis}F"] = "mm"
        cards[f"CRPIX{axis}F"] = (0.5 * (shape[2 - axis] + 1), "centre of the sensor")
        cards[f"CRVAL{axis}F"] = (centre, "its place, [mm]")
        for other, (cosine, step) in enumerate(zip(row, steps, strict=True), start=1):
            cards[f"CD{axis}_{other}F"] = cosine * step * 1e-3 * detector.pixel_um
    return cards


def add_sensor_wcs(path: str | os.PathLike[str], detector: Detector) -> None:
    """Write world coordinates into every two-dimensional image of a product.

    Parameters
    ----------
    path : path-like
        A FITS product; it is replaced when the new one is complete.
    detector : `Detector`
        The sensor that its images cover.
    """
    with fits.open(path, memmap=False) as hdus:
        copies = [_unsealed(hdu) for hdu in hdus]
    for hdu in copies:
        shape: tuple[int, ...] = getattr(hdu, "shape", ())
        if hdu.is_image and len(shape) == 2:
            hdu.header.update(sensor_wcs(detector, (shape[0], shape[1])))
    write_hdus(path, copies)


def _unsealed(hdu: Any) -> Any:
    """Copy of an HDU without checksums, which are those of the old header and are computed anew."""
    header = hdu.header.copy()
    for name in ("CHECKSUM", "DATASUM"):
        header.remove(name, ignore_missing=True)
    copied = type(hdu)(data=hdu.data, header=header)
    if isinstance(hdu, fits.PrimaryHDU):
        # astropy drops this card here and puts it back when the file is written, after the checksum.
        copied.header.set("EXTEND", True, after="NAXIS")
    return copied
