"""The data of a fit: fringe amplitudes of one sensor, read out of a cube without copying it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...array_types import Float32Array, FloatArray
from ...errors import InputError, OutOfRangeError


@dataclass(frozen=True, eq=False)
class Amplitudes:
    """Fringe amplitudes ``image * scale - 1`` with their variance and mask.

    Parameters
    ----------
    image : `numpy.ndarray`, shape ``(n_wavelengths, ny, nx)``
        Counts, or counts over their mean; may be memory-mapped, of any byte order.
    variance : `numpy.ndarray`, shape of ``image``
        Variance of ``image``; may be broadcast.
    bad : `numpy.ndarray`, shape of ``image``
        Non-zero where a pixel is not to be used; may be broadcast. Pixels whose image is not finite or
        whose variance is not positive are never used.
    scale : array_like, shape ``(n_wavelengths,)``
        One over the mean level of each wavelength.
    noise_correlation_px : `float`, optional
        Standard deviation of the Gaussian kernel that was applied to the images [px]. The variance is that
        of the smoothed image; this number says how far its noise is correlated.
    offset : `numpy.ndarray`, float32, shape ``(n_wavelengths, ncy, ncx)``, optional
        Light on each cell of a grid, less one; flats are to be divided by it.
    y_edges, x_edges : `numpy.ndarray` of `int`, optional
        Edges of the cells of ``offset`` [px].

    Raises
    ------
    InputError
        Shapes that do not fit together.
    OutOfRangeError
        A scale that is not positive, or a negative kernel.
    """

    image: NDArray[Any]
    variance: NDArray[Any]
    bad: NDArray[Any]
    scale: FloatArray
    noise_correlation_px: float = 0.0
    offset: Float32Array = field(default_factory=lambda: np.zeros((0, 1, 1), np.float32))
    y_edges: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    x_edges: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        if self.image.ndim != 3:
            raise InputError("shape of the image", self.image.shape, "(wavelength, y, x)")
        for name, array in (("variance", self.variance), ("mask", self.bad)):
            if array.shape != self.image.shape:
                raise InputError(
                    f"shape of the {name}", array.shape, f"{self.image.shape}, that of the image"
                )
        scale = np.asarray(self.scale, dtype=float)
        if scale.shape != self.image.shape[:1] or not np.all(scale > 0):
            raise OutOfRangeError("scale", scale.tolist(), f"{self.image.shape[0]} positive numbers")
        if not 0.0 <= self.noise_correlation_px < np.inf:
            raise OutOfRangeError("noise correlation [px]", self.noise_correlation_px, "0 or more")
        object.__setattr__(self, "scale", scale)

    @classmethod
    def from_arrays(
        cls,
        amplitude: ArrayLike,
        variance: ArrayLike,
        bad: ArrayLike | None = None,
        *,
        noise_correlation_px: float = 0.0,
    ) -> Self:
        """Amplitudes that are given as ``counts / mean - 1``.

        Parameters
        ----------
        amplitude : array_like, shape ``(n_wavelengths, ny, nx)``
            Fringe amplitude.
        variance : array_like
            Its variance; broadcasts against ``amplitude``.
        bad : array_like, optional
            Non-zero where not to be used; broadcasts against ``amplitude``.
        noise_correlation_px : `float`, optional
            See the class.
        """
        values = np.asarray(amplitude, dtype=np.float32)
        if values.ndim != 3:
            raise InputError("shape of the amplitude", values.shape, "(wavelength, y, x)")
        flags = np.zeros((1, 1, 1), np.int32) if bad is None else np.asarray(bad)
        return cls(
            values + np.float32(1),
            np.broadcast_to(np.asarray(variance, dtype=np.float32), values.shape),
            np.broadcast_to(flags, values.shape),
            np.ones(len(values)),
            noise_correlation_px,
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Wavelengths, rows, columns."""
        return (self.image.shape[0], self.image.shape[1], self.image.shape[2])

    def cell_of_row(self) -> NDArray[np.int64]:
        """Row of cells of ``offset`` in which each row of pixels lies; zeros if there is no offset."""
        if len(self.offset) == 0:
            return np.zeros(self.shape[1], np.int64)
        return np.repeat(np.arange(len(self.y_edges) - 1), np.diff(self.y_edges))

    def rows(
        self, start: int, stop: int, wavelengths: slice = slice(None)
    ) -> tuple[Float32Array, Float32Array, NDArray[np.int16]]:
        """Image, variance and mask of some rows, in native byte order; without a copy where they are so.

        The mask is non-zero where a pixel is not to be used; its bits mean nothing.
        """
        return (
            native(self.image[wavelengths, start:stop], np.float32),
            native(self.variance[wavelengths, start:stop], np.float32),
            _flags(self.bad[wavelengths, start:stop]),
        )


def core(array: NDArray[Any]) -> NDArray[Any]:
    """Array with broadcast axes shrunk to length 1, which is how kernels know them."""
    return array[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in array.strides)]


def _flags(bad: NDArray[Any]) -> NDArray[np.int16]:
    """Mask as int16, non-zero where it was; other types are only asked whether they are zero."""
    if bad.dtype == np.int16:
        return native(bad, np.int16)
    return np.broadcast_to((core(bad) != 0).astype(np.int16), bad.shape)


def native(array: NDArray[Any], dtype: Any) -> NDArray[Any]:
    """Array of the given type in native byte order; broadcast axes stay broadcast."""
    kind = np.dtype(dtype)
    if array.dtype == kind and array.dtype.isnative:
        return np.asarray(array)
    return np.broadcast_to(core(array).astype(kind), array.shape)
