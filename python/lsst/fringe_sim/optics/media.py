"""Optical media: complex refractive index as a function of wavelength and temperature.

The index is ``n + i k`` with ``k > 0`` for absorption. A medium raises outside the range in which it is known.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import OutOfRangeError, ResourceError, UnknownNameError
from ..resources import read_table, read_yaml

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline, PchipInterpolator

__all__ = ["Medium", "check_range", "constant_medium", "get_medium", "medium_names"]

REFERENCE_TEMPERATURE_K = 300.0
"""Temperature at which Green (2008) tabulates silicon [K]."""

TEMPERATURE_RANGE_K = (100.0, 400.0)
"""Range in which the power law of Green (2008) is used; below about 250 K it is an extrapolation."""


@dataclass(frozen=True)
class Medium:
    """A homogeneous, isotropic optical medium.

    Attributes
    ----------
    name : `str`
        Name by which stacks refer to it.
    wavelength_range_nm : `tuple` [`float`, `float`]
        First and last wavelength in vacuum at which the index is known [nm].
    source : `str`
        Where the numbers come from.
    """

    name: str
    wavelength_range_nm: tuple[float, float]
    source: str
    _index: _ConstantIndex | _TabulatedIndex = field(repr=False)
    index_scale: float = 1.0
    extinction_scale: float = 1.0
    extinction_offset: float = 0.0
    index_offset: float = 0.0
    dispersion_um2: float = 0.0

    def index(self, wavelength_nm: ArrayLike, temperature_k: ArrayLike = 300.0) -> NDArray[np.complex128]:
        """Complex refractive index ``n + i k``.

        Parameters
        ----------
        wavelength_nm : array_like
            Wavelength in vacuum [nm].
        temperature_k : array_like, optional
            Temperature [K], broadcast against ``wavelength_nm``; without effect on media whose temperature
            dependence is not known.

        Returns
        -------
        index : `numpy.ndarray`, complex
            Broadcast shape of the arguments.

        Raises
        ------
        OutOfRangeError
            A wavelength outside `wavelength_range_nm`, or a temperature outside 100–400 K.
        """
        wavelength = np.asarray(wavelength_nm, dtype=float)
        temperature = np.asarray(temperature_k, dtype=float)
        low, high = self.wavelength_range_nm
        check_range(f"wavelength [nm] in medium {self.name}", wavelength, low, high)
        check_range("temperature [K]", temperature, *TEMPERATURE_RANGE_K)
        wavelength, temperature = np.broadcast_arrays(wavelength, temperature)
        n, k = self._index(wavelength, temperature)
        # A Cauchy term relative to 960 nm, the middle of the y band: it tilts without shifting there.
        cauchy = self.dispersion_um2 * ((1000.0 / wavelength) ** 2 - (1000.0 / 960.0) ** 2)
        n = n * self.index_scale + self.index_offset + cauchy
        k = k * self.extinction_scale + self.extinction_offset
        return n + 1j * k

    def modified(self, **changes: float) -> Medium:
        """Return a copy with some of the five modifiers set.

        Parameters
        ----------
        **changes
            ``index_scale``, ``index_offset``, ``extinction_scale``, ``extinction_offset``, or
            ``dispersion_um2`` (Cauchy coefficient added to ``n``, zero at 960 nm).
        """
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class _ConstantIndex:
    n: float
    k: float

    def __call__(
        self, wavelength: NDArray[np.float64], temperature: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.full(wavelength.shape, self.n), np.full(wavelength.shape, self.k)


@dataclass(frozen=True, eq=False)
class _TabulatedIndex:
    """Tabulated ``n`` (cubic spline) and ``k`` (monotone cubic in ``log k``), exact at the nodes."""

    wavelength: NDArray[np.float64]
    n: CubicSpline
    log_k: PchipInterpolator | None
    temperature_n: PchipInterpolator | None = None
    temperature_k: PchipInterpolator | None = None

    def __call__(
        self, wavelength: NDArray[np.float64], temperature: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        n = self.n(wavelength)
        k = np.zeros(wavelength.shape) if self.log_k is None else np.exp(self.log_k(wavelength))
        if self.temperature_n is None or self.temperature_k is None:
            return n, k
        # Green (2008): X(T) = X(300 K) (T/300 K)^(C 300 K), with C tabulated in 1e-4/K.
        log_ratio = np.log(temperature / REFERENCE_TEMPERATURE_K) * REFERENCE_TEMPERATURE_K * 1e-4
        return (
            n * np.exp(self.temperature_n(wavelength) * log_ratio),
            k * np.exp(self.temperature_k(wavelength) * log_ratio),
        )


def constant_medium(
    name: str,
    n: float,
    k: float = 0.0,
    *,
    range_nm: tuple[float, float] = (300.0, 1200.0),
    source: str = "given by the caller",
) -> Medium:
    """Medium whose index does not depend on wavelength.

    Parameters
    ----------
    name : `str`
        Name of the medium.
    n, k : `float`
        Real index and extinction coefficient.
    range_nm : `tuple` [`float`, `float`], optional
        Wavelengths for which the constant is meant [nm].
    source : `str`, optional
        Where the number comes from.
    """
    if not n > 0:
        raise OutOfRangeError(f"index of {name}", n, "a positive number")
    if not k >= 0:
        raise OutOfRangeError(
            f"extinction of {name}", k, "zero or a positive number (n + ik, absorption k > 0)"
        )
    return Medium(name, range_nm, source, _ConstantIndex(float(n), float(k)))


def medium_names() -> tuple[str, ...]:
    """Names that `get_medium` accepts."""
    return tuple(read_yaml("media", "media.yaml"))


@functools.lru_cache(maxsize=64)
def get_medium(name: str) -> Medium:
    """Medium shipped with the package.

    Raises
    ------
    UnknownNameError
        There is no medium of that name.
    """
    entries = read_yaml("media", "media.yaml")
    if name not in entries:
        raise UnknownNameError("medium", name, entries)
    entry: dict[str, Any] = entries[name]
    if "constant" in entry:
        n, k = entry["constant"]
        low, high = entry["range_nm"]
        return constant_medium(name, n, k, range_nm=(low, high), source=entry["source"])
    return _read_tabulated(name, entry)


def _read_tabulated(name: str, entry: dict[str, Any]) -> Medium:
    from scipy.interpolate import CubicSpline, PchipInterpolator

    table = read_table("media", entry["table"])
    wavelength = np.asarray(table["wavelength"].quantity.to_value("nm"), dtype=float)
    if np.any(np.diff(wavelength) <= 0):
        raise ResourceError(f"{entry['table']}: wavelengths must increase")
    k = np.asarray(table["k"], dtype=float)
    if np.all(k == 0.0):
        log_k = None
    else:
        floor = 1e-12  # far below any absorption that matters over a millimetre
        log_k = PchipInterpolator(wavelength, np.log(np.maximum(k, floor)), extrapolate=False)
    coefficients: tuple[PchipInterpolator | None, PchipInterpolator | None] = (None, None)
    if entry.get("temperature") == "green2008":
        coefficients = (
            PchipInterpolator(wavelength, np.asarray(table["C_n"], dtype=float), extrapolate=False),
            PchipInterpolator(wavelength, np.asarray(table["C_k"], dtype=float), extrapolate=False),
        )
    index = _TabulatedIndex(
        wavelength, CubicSpline(wavelength, np.asarray(table["n"], dtype=float)), log_k, *coefficients
    )
    source = f"{table.meta['source']} (doi {table.meta['doi']})"
    return Medium(name, (float(wavelength[0]), float(wavelength[-1])), source, index)


def check_range(what: str, value: NDArray[np.float64], low: float, high: float) -> None:
    """Refuse numbers outside an interval, and such as are none; the first of them is named."""
    # Written so that NaN fails too.
    good = (value >= low) & (value <= high)
    if not np.all(good):
        worst = np.atleast_1d(value)[~np.atleast_1d(good)][0]
        raise OutOfRangeError(what, float(worst), f"{low:g} to {high:g}")
