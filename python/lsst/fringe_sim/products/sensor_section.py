"""Which pixels of which sensor an image shows, and the world coordinates that follow.

Both descriptions are alternate ones of the FITS standard (Greisen & Calabretta 2002,
doi 10.1051/0004-6361:20021326): ``D`` for detector pixels, counted from 0, and ``F`` for millimetres in the focal
plane, as of ``astropy.wcs.WCS(header, key="F")``.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from astropy.io import fits

from ..array_types import FloatArray
from ..errors import FrameFormatError, InputError, OutOfRangeError
from ..instrument.detector import Detector

SECTION_KEYWORDS = ("DETSEC", "CCDSEC")
"""Keywords in which the header of an image says what it shows: ``[x1:x2,y1:y2]``, from 1, both ends included."""

_SECTION = re.compile(r"\s*\[\s*(\d+)\s*:\s*(\d+)\s*,\s*(\d+)\s*:\s*(\d+)\s*\]\s*")


@dataclasses.dataclass(frozen=True)
class SensorSection:
    """Pixels of a sensor.

    Parameters
    ----------
    detector : `Detector`
        The sensor: its size, pitch, and place in the focal plane.
    x, y : `tuple` [`int`, `int`]
        First and last column and row, from 0. The last may be below the first: the image is then reversed.

    Raises
    ------
    OutOfRangeError
        Pixels that the sensor does not have.
    """

    detector: Detector
    x: tuple[int, int]
    y: tuple[int, int]

    def __post_init__(self) -> None:
        for axis, ends, size in zip("yx", (self.y, self.x), self.detector.shape, strict=True):
            if not all(0 <= end < size for end in ends):
                raise OutOfRangeError(
                    f"{axis} of the section", ends, f"0 to {size - 1}", source=self.detector.name or None
                )

    @classmethod
    def whole(cls, detector: Detector) -> Self:
        """All pixels of a sensor."""
        ny, nx = detector.shape
        return cls(detector, (0, nx - 1), (0, ny - 1))

    @classmethod
    def of_image(cls, detector: Detector, shape: tuple[int, int], header: Mapping[str, Any]) -> Self | None:
        """What an image shows, by its header or by its size.

        Parameters
        ----------
        detector : `Detector`
            The sensor.
        shape : `tuple` [`int`, `int`]
            Rows and columns of the image.
        header : `Mapping`
            Keywords; the first of `SECTION_KEYWORDS` that is there decides.

        Returns
        -------
        section : `SensorSection` or `None`
            `None` if the header says nothing and the image is not as large as the sensor: nobody knows then.

        Raises
        ------
        FrameFormatError
            The keyword is no section.
        OutOfRangeError
            Pixels that the sensor does not have.
        """
        for keyword in SECTION_KEYWORDS:
            if header.get(keyword):
                return cls(detector, *_ends(keyword, header[keyword]))
        return cls.whole(detector) if tuple(shape) == detector.shape else None

    @property
    def keyword(self) -> str:
        """The section as a header has it."""
        return f"[{self.x[0] + 1}:{self.x[1] + 1},{self.y[0] + 1}:{self.y[1] + 1}]"

    def cards(self, shape: tuple[int, ...]) -> fits.Header:
        """World coordinates of an image of this section.

        Parameters
        ----------
        shape : `tuple` [`int`, ...]
            Planes, if any, then rows and columns. Fewer rows and columns than the section has are larger pixels.

        Returns
        -------
        cards : `astropy.io.fits.Header`
            The descriptions ``D`` [px] and ``F`` [mm]; planes are counted from 0 in both.

        Raises
        ------
        InputError
            An image without pixels, or of less than two dimensions.
        """
        if len(shape) < 2 or min(shape) < 1:
            raise InputError("shape of the image", shape, "two or more axes, all positive")
        steps = [_step(self.x, shape[-1]), _step(self.y, shape[-2])]
        cards = fits.Header()
        for key, name in (("D", "DETECTOR"), ("F", "FOCAL PLANE")):
            cards[f"WCSAXES{key}"], cards[f"WCSNAME{key}"] = len(shape), name
        self._detector_cards(cards, steps)
        self._focal_plane_cards(cards, steps, shape)
        for axis in range(3, len(shape) + 1):
            for key, step in (("D", f"CDELT{axis}D"), ("F", f"CD{axis}_{axis}F")):
                cards[f"CTYPE{axis}{key}"] = ("LINEAR", "number of the plane, from 0")
                cards[f"CRPIX{axis}{key}"], cards[f"CRVAL{axis}{key}"], cards[step] = 1.0, 0.0, 1.0
        return cards

    def _detector_cards(self, cards: fits.Header, steps: list[float]) -> None:
        for axis, ((first, last), step) in enumerate(zip((self.x, self.y), steps, strict=True), start=1):
            cards[f"CTYPE{axis}D"] = "LINEAR"
            cards[f"CUNIT{axis}D"] = "pix"
            cards[f"CRPIX{axis}D"] = 1.0
            # The first pixel of a thinned image is centred on several of the sensor.
            cards[f"CRVAL{axis}D"] = (_first_centre((first, last), step), "from 0, [px]")
            cards[f"CDELT{axis}D"] = (step, "pixels of the sensor")

    def _focal_plane_cards(self, cards: fits.Header, steps: list[float], shape: tuple[int, ...]) -> None:
        detector = self.detector
        turn = math.radians(detector.yaw_deg)
        rotation = ((math.cos(turn), -math.sin(turn)), (math.sin(turn), math.cos(turn)))
        # The reference is the middle of the image, and its distance from that of the sensor in millimetres.
        off_mm = [
            1e-3 * detector.pixel_um * (0.5 * (first + last) - 0.5 * (size - 1))
            for (first, last), size in zip((self.x, self.y), detector.shape[::-1], strict=True)
        ]
        for axis, (centre, row) in enumerate(
            zip((detector.x_mm, detector.y_mm), rotation, strict=True), start=1
        ):
            place = centre + row[0] * off_mm[0] + row[1] * off_mm[1]
            cards[f"CTYPE{axis}F"] = "LINEAR"
            cards[f"CUNIT{axis}F"] = "mm"
            cards[f"CRPIX{axis}F"] = (0.5 * (shape[-axis] + 1), "middle of the image")
            cards[f"CRVAL{axis}F"] = (place, "its place, [mm]")
            for other, (cosine, step) in enumerate(zip(row, steps, strict=True), start=1):
                cards[f"CD{axis}_{other}F"] = cosine * step * 1e-3 * detector.pixel_um


def section_pixels(shape: tuple[int, int], header: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Rows and columns of the sensor at which the pixels of an image are centred.

    ``header``: its keywords; without one of `SECTION_KEYWORDS` the image begins at pixel 0. Returns (ny,) and
    (nx,): from 0 [px].
    """
    ends = ((0, shape[1] - 1), (0, shape[0] - 1))
    for keyword in SECTION_KEYWORDS:
        if header.get(keyword):
            ends = _ends(keyword, header[keyword])
            break
    return _centres(ends[1], shape[0]), _centres(ends[0], shape[1])


def _ends(keyword: str, text: object) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last column, first and last row, from 0."""
    match = _SECTION.fullmatch(str(text))
    if match is None:
        raise FrameFormatError(keyword, text, "[x1:x2,y1:y2], from 1")
    x1, x2, y1, y2 = (int(group) - 1 for group in match.groups())
    return (x1, x2), (y1, y2)


def _step(ends: tuple[int, int], size: int) -> float:
    """Pixels of the sensor in one of the image; negative in a reversed one."""
    first, last = ends
    return math.copysign(abs(last - first) + 1, last - first) / size


def _first_centre(ends: tuple[int, int], step: float) -> float:
    """Where the first pixel of an image is centred; a large one covers several of the sensor."""
    return ends[0] + 0.5 * (step - math.copysign(1.0, step))


def _centres(ends: tuple[int, int], size: int) -> FloatArray:
    step = _step(ends, size)
    return _first_centre(ends, step) + step * np.arange(size, dtype=np.float64)
