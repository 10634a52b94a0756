"""A sensor and its amplifiers: numbers, positions, flips.

Coordinates are those of the assembled, trimmed CCD: ``[0, 0]`` is the lower-left pixel, ``y`` up.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from ..errors import InputError, UnknownNameError, named_units
from ..notebook import OneLine


@dataclasses.dataclass(frozen=True)
class RawSegment:
    """Where the pixels of one amplifier stand in its raw image, read-out order."""

    hdu: int  # Number of the FITS HDU; 0 is the primary header
    extname: str  # ``Segment10``
    shape: tuple[int, int]  # Rows and columns of the raw image
    # First imaging row and column, counted from 0. Columns before ``data_x0`` are serial prescan; columns
    # right of the imaging section are serial overscan, rows above it parallel overscan
    data_y0: int
    data_x0: int


@dataclasses.dataclass(frozen=True)
class Amplifier:
    """One output of a CCD."""

    name: str  # ``C00`` … ``C17`` for LSST sensors
    channel: int  # Number, from 1, in the order of the raw file
    y0: int  # Lower-left pixel of the amplifier in the assembled, trimmed CCD
    x0: int
    height: int  # Imaging rows and columns
    width: int
    flip_y: bool  # Whether the raw image is reversed along that axis when the CCD is assembled
    flip_x: bool
    gain: float  # Electrons per ADU
    read_noise: float  # Electrons rms
    saturation: float  # ADU above bias
    # Layout of the raw image; `None` for cameras whose raw files are not in the LSST layout
    raw: RawSegment | None = None

    @property
    def section(self) -> tuple[slice, slice]:
        """The amplifier's pixels in the assembled CCD, as ``[y, x]`` slices."""
        return slice(self.y0, self.y0 + self.height), slice(self.x0, self.x0 + self.width)


@named_units
@dataclasses.dataclass(frozen=True, repr=False)
class Detector(OneLine):
    """One sensor."""

    id: int  # Number within the camera
    name: str  # ``R11_S01`` in LSSTCam, ``RTM-020_S01`` on TS8
    raft: str  # The two parts of the name
    slot: str
    vendor: str  # ``e2v``, ``ITL`` or ``Hamamatsu``
    kind: str  # ``science``, ``guider`` or ``wavefront``
    serial: str  # Serial numbers of the sensor and of its raft; empty where not known
    raft_serial: str
    x_mm: float  # Centre of the sensor in the focal plane, mm
    y_mm: float
    field_x_deg: float  # Field angle of the centre, degrees; nan on a test stand, which has no telescope
    field_y_deg: float
    yaw_deg: float  # Rotation of the sensor in the focal plane, degrees
    pixel_um: float  # Pixel pitch, µm
    amplifiers: tuple[Amplifier, ...]  # Outputs, in the order of the raw file
    readout_source: str  # Where gains and read noises come from

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the assembled, trimmed CCD."""
        return (
            max(amp.y0 + amp.height for amp in self.amplifiers),
            max(amp.x0 + amp.width for amp in self.amplifiers),
        )

    @property
    def own_layout(self) -> bool:
        """Whether raw frames of the sensor are not in the LSST layout."""
        return any(amp.raw is None for amp in self.amplifiers)

    @property
    def gain(self) -> float:
        """Mean gain of the amplifiers, electrons per ADU."""
        return float(np.mean([amp.gain for amp in self.amplifiers]))

    @property
    def read_noise(self) -> float:
        """Mean read noise of the amplifiers, electrons rms."""
        return float(np.mean([amp.read_noise for amp in self.amplifiers]))

    @property
    def field_radius_deg(self) -> float:
        """Distance of the centre from the optical axis, degrees; nan on a test stand."""
        return math.hypot(self.field_x_deg, self.field_y_deg)

    def amplifier(self, name: str) -> Amplifier:
        """Return one amplifier by name."""
        for amp in self.amplifiers:
            if amp.name == name:
                return amp
        raise UnknownNameError("amplifier", name, (amp.name for amp in self.amplifiers), source=self.name)

    def cut_down(self, shape: tuple[int, int]) -> Detector:
        """Return the same sensor with fewer (or more) pixels per amplifier.

        Names, order, gains, flips and the widths of prescan and overscan stay; what changes is the number of
        imaging rows and columns.
        """
        first_x, first_y = (sorted({getattr(amp, at) for amp in self.amplifiers}) for at in ("x0", "y0"))
        n_rows, n_columns = len(first_y), len(first_x)
        height, rest_y = divmod(shape[0], n_rows)
        width, rest_x = divmod(shape[1], n_columns)
        if rest_y or rest_x or height < 1 or width < 1:
            raise InputError(
                "detector shape (rows, columns)",
                shape,
                f"positive multiples of {n_rows} rows and {n_columns} columns",
                source=self.name,
            )
        amplifiers = tuple(
            _resized(amp, first_y.index(amp.y0), first_x.index(amp.x0), height, width)
            for amp in self.amplifiers
        )
        return dataclasses.replace(self, amplifiers=amplifiers)


def refuse_misfits(amplifiers: Sequence[Amplifier]) -> None:
    """Refuse amplifiers that do not share the pixels of a rectangle among them."""
    if not amplifiers:
        raise InputError("amplifiers", "none", "one amplifier or more")
    for one in amplifiers:
        if min(one.x0, one.y0) < 0 or min(one.width, one.height) < 1:
            place = [one.x0, one.y0, one.width, one.height]
            raise InputError(
                f"x0, y0, width, height of {one.name}", place, "places from 0 and sizes from 1 pixel on"
            )
    for one, other in itertools.combinations(amplifiers, 2):
        if one.name == other.name:
            raise InputError("name of an amplifier", one.name, "a name of its own for each amplifier")
        if abs(2 * (one.x0 - other.x0) + one.width - other.width) < one.width + other.width and (
            abs(2 * (one.y0 - other.y0) + one.height - other.height) < one.height + other.height
        ):
            raise InputError(
                "place of amplifiers", f"shared by {one.name} and {other.name}", "pixels of its own for each"
            )
    rows, columns = (
        max(amp.y0 + amp.height for amp in amplifiers),
        max(amp.x0 + amp.width for amp in amplifiers),
    )
    empty = rows * columns - sum(amp.height * amp.width for amp in amplifiers)
    if empty:
        raise InputError(
            "pixels without an amplifier", empty, f"none in a sensor of {columns} x {rows}, which they span"
        )


def _resized(amp: Amplifier, row: int, column: int, height: int, width: int) -> Amplifier:
    """An amplifier of another size, in a row and column of amplifiers."""
    raw = amp.raw
    if raw is not None:
        shape = (raw.shape[0] + height - amp.height, raw.shape[1] + width - amp.width)
        raw = dataclasses.replace(raw, shape=shape)
    return dataclasses.replace(amp, y0=row * height, x0=column * width, height=height, width=width, raw=raw)
