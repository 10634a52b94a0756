"""Optical media: complex refractive index as a function of wavelength and temperature.

The index is ``n + i k`` with ``k > 0`` for absorption. A medium raises outside the range in which it is known.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..descriptions import Description, described, read_table_of
from ..errors import InputError, OutOfRangeError, ResourceError, UnknownNameError, named_units, printable_name
from ..notebook import OneLine
from ..resources import read_table, read_user_yaml, read_yaml

if TYPE_CHECKING:
    from astropy.table import Table
    from scipy.interpolate import CubicSpline, PchipInterpolator

REFERENCE_TEMPERATURE_K = 300.0  # Temperature at which Green (2008) tabulates silicon [K]

TEMPERATURE_RANGE_K = (100.0, 400.0)
"""Temperatures for which silicon is known: measured up to 300 K, by the power law of Green (2008) above."""

COLD_NODES_K = np.array([100.0, 150.0, 200.0, 250.0, 300.0])
"""Temperatures at which silicon was measured (Franta et al. 2017; n of Frey et al. 2006)."""

COLD_TABLE = "nk_Si_franta2017_T.ecsv"
WARM_TABLE = "nk_Si_green2008.ecsv"


@named_units
@dataclass(frozen=True, repr=False)
class Medium(OneLine):
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
    toward: tuple[tuple[str, float], ...] = ()
    """Other tables of the same material, and how far the index lies on the way to each: 0 here, 1 there."""

    @property
    def is_silicon(self) -> bool:
        """Whether it is one of the tables of crystalline silicon."""
        return self.name.partition("_")[0] == "Si"

    @named_units
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
        if max(wavelength.size, temperature.size) > _MOST_REMEMBERED:
            return self._computed(wavelength, temperature)
        asked = ((x.tobytes(), x.shape) for x in (wavelength, temperature))
        return _remembered_index(self, *asked).copy()

    def _computed(
        self, wavelength: NDArray[np.float64], temperature: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """The same of arrays."""
        low, high = self.wavelength_range_nm
        check_range(f"wavelength [nm] in medium {self.name}", wavelength, low, high)
        check_range("temperature [K]", temperature, *TEMPERATURE_RANGE_K)
        n, k = self._index(wavelength, temperature)
        own_n, own_k = n, k
        for name, part in self.toward:
            other_n, other_k = get_medium(name)._index(wavelength, temperature)
            n, k = n + part * (other_n - own_n), k * (other_k / own_k) ** part
        # A Cauchy term relative to 960 nm, the middle of the y band: it tilts without shifting there.
        cauchy = self.dispersion_um2 * ((1000.0 / wavelength) ** 2 - (1000.0 / 960.0) ** 2)
        n = n * self.index_scale + self.index_offset + cauchy
        k = k * self.extinction_scale + self.extinction_offset
        index = np.empty(np.broadcast_shapes(wavelength.shape, temperature.shape), dtype=complex)
        index[...] = n + 1j * k
        return index

    def modified(self, **changes: object) -> Medium:
        """Return a copy with some of the modifiers set.

        Parameters
        ----------
        **changes
            ``index_scale``, ``index_offset``, ``extinction_scale``, ``extinction_offset``,
            ``dispersion_um2`` (Cauchy coefficient added to ``n``, zero at 960 nm), or ``toward`` (parts of the
            difference to other tables: ``n`` is interpolated, ``k`` in its logarithm).
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

    n: CubicSpline
    log_k: PchipInterpolator | None
    law: _PowerLaw | _MeasuredLaw | None = None

    def __call__(
        self, wavelength: NDArray[np.float64], temperature: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if max(wavelength.size, temperature.size) > _MOST_REMEMBERED:
            return self._computed(wavelength, temperature)
        return _remembered(self, *((x.tobytes(), x.shape) for x in (wavelength, temperature)))

    def _computed(
        self, wavelength: NDArray[np.float64], temperature: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        n = self.n(wavelength)
        k = np.zeros(wavelength.shape) if self.log_k is None else np.exp(self.log_k(wavelength))
        if self.law is None:
            return n, k
        return self.law(n, k, wavelength, temperature)


_MOST_REMEMBERED = 4096
"""Wavelengths whose index is remembered: a fit asks for the same few hundred thousands of times."""


@functools.lru_cache(maxsize=256)
def _remembered_index(medium: Medium, *values: tuple[bytes, tuple[int, ...]]) -> NDArray[np.complex128]:
    """Index of a medium for wavelengths and temperatures, not to be changed."""
    wavelength, temperature = (np.frombuffer(text).reshape(shape) for text, shape in values)
    return medium._computed(wavelength, temperature)


@functools.lru_cache(maxsize=64)
def _remembered(
    table: _TabulatedIndex, *values: tuple[bytes, tuple[int, ...]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Index of a table for wavelengths and temperatures, not to be changed."""
    wavelength, temperature = (np.frombuffer(text).reshape(shape) for text, shape in values)
    return table._computed(wavelength, temperature)


@dataclass(frozen=True, eq=False)
class _PowerLaw:
    """X(T) = X(300 K) (T/300 K)^(C 300 K) of Green (2008), with C tabulated in 1e-4/K."""

    coefficient_n: PchipInterpolator
    coefficient_k: PchipInterpolator

    def __call__(
        self,
        n: NDArray[np.float64],
        k: NDArray[np.float64],
        wavelength: NDArray[np.float64],
        temperature: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        log_ratio = np.log(temperature / REFERENCE_TEMPERATURE_K) * REFERENCE_TEMPERATURE_K * 1e-4
        return (
            n * np.exp(self.coefficient_n(wavelength) * log_ratio),
            k * np.exp(self.coefficient_k(wavelength) * log_ratio),
        )


@dataclass(frozen=True, eq=False)
class _MeasuredLaw:
    """n(T) - n(300 K) and k(T) / k(300 K) as measured; above 300 K the power law.

    Between its nodes the polynomial of fourth degree in temperature is taken, of n and of the logarithm of k.
    """

    n: CubicSpline  # over wavelength, one column per node
    log_k: PchipInterpolator
    warm: _PowerLaw
    measured_at_k: float

    def __call__(
        self,
        n: NDArray[np.float64],
        k: NDArray[np.float64],
        wavelength: NDArray[np.float64],
        temperature: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        part = _lagrange(np.minimum(temperature, COLD_NODES_K[-1])) - _lagrange(np.array(self.measured_at_k))
        n = n + (self.n(wavelength) * part).sum(axis=-1)
        k = k * np.exp((self.log_k(wavelength) * part).sum(axis=-1))
        if np.all(temperature <= REFERENCE_TEMPERATURE_K):
            return n, k
        return self.warm(n, k, wavelength, np.maximum(temperature, REFERENCE_TEMPERATURE_K))


def _lagrange(temperature: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of the nodes in the polynomial through all of them, along a last axis."""
    away = temperature[..., np.newaxis] - COLD_NODES_K
    weights = [
        np.prod(np.delete(away, node, axis=-1), axis=-1)
        / np.prod(np.delete(COLD_NODES_K[node] - COLD_NODES_K, node))
        for node in range(COLD_NODES_K.size)
    ]
    return np.stack(weights, axis=-1)


@named_units
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
    return _medium(name, entry, lambda file: read_table("media", file))


def read_media(path: str | Path) -> dict[str, Medium]:
    """Media of a YAML file from outside, laid out like the shipped ``media.yaml``, by name.

    A ``table`` is a file beside it, or one that is shipped.
    """
    content = read_user_yaml(path, "media file")
    reader = Description(content, str(path))
    media = {}
    for name in content:
        printable_name("name of a medium", name, source=str(path))
        reader.section(name)
        allowed = "constant, range_nm and source, or a table with wavelength (in a unit), n and k"
        with described(name, allowed, str(path)):
            media[name] = _medium(name, content[name], lambda file: read_table_of(path, file, "media"))
    return media


def _medium(name: str, entry: dict[str, Any], read: Callable[[str], Table]) -> Medium:
    if "constant" in entry:
        n, k = entry["constant"]
        low, high = entry["range_nm"]
        return constant_medium(name, n, k, range_nm=(low, high), source=entry["source"])
    return _read_tabulated(name, entry, read)


def _read_tabulated(name: str, entry: dict[str, Any], read: Callable[[str], Table]) -> Medium:
    from scipy.interpolate import CubicSpline, PchipInterpolator

    table = read(entry["table"])
    wavelength = _wavelengths(table, entry["table"])
    names = entry.get("columns", ("n", "k"))
    n, k = (np.asarray(table[column], dtype=float) for column in names)
    if n.min() <= 0.0:
        raise InputError(names[0], float(n.min()), "positive numbers in all rows", source=entry["table"])
    if k.min() < 0.0:
        raise InputError(names[1], float(k.min()), "no negative numbers", source=entry["table"])
    if np.all(k == 0.0):
        log_k = None
    else:
        floor = 1e-12  # far below any absorption that matters over a millimetre
        log_k = PchipInterpolator(wavelength, np.log(np.maximum(k, floor)))
    low, high = float(wavelength[0]), float(wavelength[-1])
    law: _PowerLaw | _MeasuredLaw | None = None
    match entry.get("temperature"):
        case "green2008":
            law = _power_law(table, entry["table"])
        case "franta2017":
            law, cold = _measured_law(float(entry.get("measured_at_k", REFERENCE_TEMPERATURE_K)))
            low, high = max(low, float(cold[0])), min(high, float(cold[-1]))
    index = _TabulatedIndex(CubicSpline(wavelength, n), log_k, law)
    return Medium(name, (low, high), f"{table.meta['source']} (doi {table.meta['doi']})", index)


def _wavelengths(table: Table, file: str) -> NDArray[np.float64]:
    wavelength = np.asarray(table["wavelength"].quantity.to_value("nm"), dtype=float)
    if np.any(np.diff(wavelength) <= 0):
        raise ResourceError(f"{file}: wavelengths must increase")
    return wavelength


def _power_law(table: Table, file: str) -> _PowerLaw:
    from scipy.interpolate import PchipInterpolator

    wavelength = _wavelengths(table, file)
    coefficients = (np.asarray(table[name], dtype=float) for name in ("C_n", "C_k"))
    return _PowerLaw(*(PchipInterpolator(wavelength, each, extrapolate=False) for each in coefficients))


def _measured_law(measured_at_k: float) -> tuple[_MeasuredLaw, NDArray[np.float64]]:
    """Law of a table of silicon that was measured at some temperature, and the wavelengths of its measurement."""
    from scipy.interpolate import CubicSpline, PchipInterpolator

    table = read_table("media", COLD_TABLE)
    wavelength = _wavelengths(table, COLD_TABLE)
    n, k = (
        np.stack([np.asarray(table[f"{part}_{node:.0f}K"], dtype=float) for node in COLD_NODES_K], axis=1)
        for part in "nk"
    )
    law = _MeasuredLaw(
        CubicSpline(wavelength, n),
        PchipInterpolator(wavelength, np.log(k)),
        _power_law(read_table("media", WARM_TABLE), WARM_TABLE),
        measured_at_k,
    )
    return law, wavelength


def check_range(what: str, value: NDArray[np.float64], low: float, high: float) -> None:
    """Refuse numbers outside an interval, and such as are none; the first of them is named."""
    # Written so that NaN fails too.
    good = (value >= low) & (value <= high)
    if not np.all(good):
        worst = np.atleast_1d(value)[~np.atleast_1d(good)][0]
        raise OutOfRangeError(what, float(worst), f"{low:g} to {high:g}")
