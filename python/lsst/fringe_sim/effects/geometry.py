"""Where the samples of an image lie on the sensor: what an effect on the image may know."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..array_types import BoolArray, FloatArray
from ..errors import InputError, named_units

AMPLIFIERS = tuple(f"C{row}{column}" for row in (0, 1) for column in range(8))
"""Amplifiers of an LSST sensor in the order of `ImageGeometry.amplifier`: lower row first, x increasing."""


@named_units
@dataclass(frozen=True, eq=False)
class ImageGeometry:
    """Positions of the samples of an image cube on the sensor.

    The samples are the pixels, or the centres of square cells of ``cell_px`` pixels over which an image was averaged.

    Attributes
    ----------
    shape : `tuple` [`int`, `int`]
        Rows and columns of the sensor [px].
    y_px, x_px : `numpy.ndarray`, shapes ``(ny,)`` and ``(nx,)``
        Row and column of the samples, counted from the centre of the lower-left pixel; uniform steps.
    wavelength_nm : `numpy.ndarray`, shape ``(W,)``
        Wavelength of each plane [nm].
    level_e : `numpy.ndarray`, shape ``(W,)``
        Mean level of each plane [electrons]; 0 where it is not known.
    y_edges, x_edges : `tuple` [`int`, ...]
        Borders of the amplifiers [px]; by default two rows of eight of equal size.
    dark_time_s : `numpy.ndarray`, shape ``(W,)``
        Time in which each plane gathered charge [s]; 0, the default, where it is not known.
    """

    shape: tuple[int, int]
    y_px: FloatArray
    x_px: FloatArray
    wavelength_nm: FloatArray
    level_e: FloatArray
    y_edges: tuple[int, ...] = field(default=())
    x_edges: tuple[int, ...] = field(default=())
    dark_time_s: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        rows, columns = self.shape
        if not self.y_edges:
            object.__setattr__(self, "y_edges", tuple(rows * i // 2 for i in range(3)))
        if not self.x_edges:
            object.__setattr__(self, "x_edges", tuple(columns * i // 8 for i in range(9)))
        if len(self.y_edges) != 3 or len(self.x_edges) != 9:
            raise InputError("amplifier borders", (self.y_edges, self.x_edges), "3 rows and 9 columns")
        if self.wavelength_nm.shape != self.level_e.shape or self.wavelength_nm.ndim != 1:
            raise InputError("levels", self.level_e.shape, f"{self.wavelength_nm.shape}, one for each plane")
        if not self.dark_time_s.size:
            object.__setattr__(self, "dark_time_s", np.zeros(self.level_e.shape))
        if self.dark_time_s.shape != self.level_e.shape:
            raise InputError(
                "dark times", self.dark_time_s.shape, f"{self.level_e.shape}, one for each plane"
            )

    @classmethod
    @named_units
    def of_pixels(
        cls,
        shape: tuple[int, int],
        wavelength_nm: FloatArray,
        level_e: FloatArray | float = 0.0,
        dark_time_s: FloatArray | float = 0.0,
    ) -> ImageGeometry:
        """Geometry of a full image, one sample per pixel."""
        wavelength = np.atleast_1d(np.asarray(wavelength_nm, dtype=float))
        level, dark_time = (
            np.full(wavelength.shape, each, dtype=float)
            if np.ndim(each) == 0
            else np.asarray(each, dtype=float)
            for each in (level_e, dark_time_s)
        )
        y, x = (np.arange(size, dtype=float) for size in shape)
        return cls(shape, y, x, wavelength, level, dark_time_s=dark_time)

    @property
    def sample_shape(self) -> tuple[int, int]:
        """Rows and columns of samples."""
        return (self.y_px.size, self.x_px.size)

    @property
    def cell_px(self) -> tuple[float, float]:
        """Distance of neighbouring samples along y and x [px]; 1 where there is only one."""
        return (
            float(self.y_px[1] - self.y_px[0]) if self.y_px.size > 1 else 1.0,
            float(self.x_px[1] - self.x_px[0]) if self.x_px.size > 1 else 1.0,
        )

    @property
    def v(self) -> FloatArray:
        """Position along y from -1 at the first to 1 at the last row, shape ``(ny, 1)``."""
        return unit_place(self.y_px, self.shape[0])[:, np.newaxis]

    @property
    def u(self) -> FloatArray:
        """Position along x from -1 at the first to 1 at the last column, shape ``(1, nx)``."""
        return unit_place(self.x_px, self.shape[1])[np.newaxis, :]

    @property
    def upper_half(self) -> BoolArray:
        """Samples above the midline of the sensor, shape ``(ny, 1)``."""
        upper: BoolArray = (self.y_px >= self.y_edges[1] - 0.5)[:, np.newaxis]
        return upper

    @property
    def amplifier(self) -> NDArray[np.int64]:
        """Position in `AMPLIFIERS` of the amplifier that reads each sample, shape ``(ny, nx)``."""
        row = np.clip(np.searchsorted(np.array(self.y_edges) - 0.5, self.y_px, side="right") - 1, 0, 1)
        place: NDArray[np.int64] = 8 * row[:, np.newaxis] + self.amplifier_column[np.newaxis, :]
        return place

    @property
    def amplifier_column(self) -> NDArray[np.int64]:
        """Column of amplifiers, 0 to 7, that each column of samples lies in, shape ``(nx,)``."""
        column: NDArray[np.int64] = np.clip(
            np.searchsorted(np.array(self.x_edges) - 0.5, self.x_px, side="right") - 1, 0, 7
        )
        return column

    def require_levels(self, effect: str) -> FloatArray:
        """Levels [electrons] as ``(W, 1, 1)``.

        Raises
        ------
        InputError
            A level is not known.
        """
        if not np.all(self.level_e > 0.0):
            raise InputError(
                f"level of the flats (effect {effect})", self.level_e.tolist(), "electrons, above 0"
            )
        return self.level_e[:, np.newaxis, np.newaxis]

    def require_dark_times(self, effect: str) -> FloatArray:
        """Dark times [s] as ``(W, 1, 1)``.

        Raises
        ------
        InputError
            One is not known.
        """
        if not np.all(self.dark_time_s > 0.0):
            raise InputError(
                f"dark time of the flats (effect {effect})", self.dark_time_s.tolist(), "seconds, above 0"
            )
        return self.dark_time_s[:, np.newaxis, np.newaxis]


def unit_place(position: FloatArray, size: int) -> FloatArray:
    """Pixels along one side as places from -1 at the first to 1 at the last of ``size``."""
    half = 0.5 * (size - 1)
    scaled: FloatArray = (position - half) / max(half, 0.5)
    return scaled
