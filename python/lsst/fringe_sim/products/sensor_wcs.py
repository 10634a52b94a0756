"""World coordinates for images that were written without: pixels of the sensor, millimetres in the focal plane."""

from __future__ import annotations

import os
from typing import Any

from astropy.io import fits

from ..instrument.detector import Detector
from ._fits import write_hdus
from .sensor_section import SensorSection

__all__ = ["add_sensor_wcs", "sensor_wcs"]


def sensor_wcs(detector: Detector, shape: tuple[int, int]) -> fits.Header:
    """Header cards for an image that covers a whole sensor.

    Parameters
    ----------
    detector : `Detector`
        Its size, pitch, and place in the focal plane.
    shape : `tuple` [`int`, `int`]
        Rows and columns of the image; one that has fewer than the sensor covers it all the same, with larger pixels.

    Returns
    -------
    cards : `astropy.io.fits.Header`
        The descriptions ``D`` [px] and ``F`` [mm] of `SensorSection.cards`.

    Raises
    ------
    InputError
        An image without pixels.
    """
    return SensorSection.whole(detector).cards(shape)


def add_sensor_wcs(path: str | os.PathLike[str], detector: Detector) -> None:
    """Write world coordinates into every two-dimensional image of a FITS file.

    Products take them as they are written: ``write_fits(path, section=SensorSection.whole(detector))``.

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
