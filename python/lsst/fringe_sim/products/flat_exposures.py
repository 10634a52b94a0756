"""How each plane of a cube was illuminated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from ..array_types import FloatArray
from ..errors import FrameFormatError, InputError, OutOfRangeError, named_units, without_unit
from ..notebook import OneLine
from . import _check as check
from . import _fits as io
from .fits_product import Extension


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class FlatExposures(OneLine):
    """How each plane of a cube was illuminated.

    Parameters
    ----------
    wavelength_nm, bandwidth_fwhm_nm, temperature_k : array-like, shape ``(n_wavelengths,)``
        Wavelength, full width at half maximum, and temperature of the sensor. One number for all wavelengths
        is enough, except for the wavelength itself.
    f_number : array-like, shape ``(n_wavelengths,)``, optional
        Focal ratio; infinite (the default) for a collimated beam.
    level_e : array-like, shape ``(n_wavelengths,)``, optional
        Mean level in electrons; 0 (the default) where it is not known.
    dark_time_s : array-like, shape ``(n_wavelengths,)``, optional
        Time in which charge was gathered, in seconds; 0 (the default) where it is not known.
    """

    wavelength_nm: FloatArray
    bandwidth_fwhm_nm: FloatArray
    temperature_k: FloatArray
    f_number: FloatArray = field(default_factory=lambda: np.array(np.inf))
    level_e: FloatArray = field(default_factory=lambda: np.array(0.0))
    dark_time_s: FloatArray = field(default_factory=lambda: np.array(0.0))

    def __post_init__(self) -> None:
        number = None  # that of the wavelengths, which come first
        for column in _COLUMNS:
            array = column.check(getattr(self, column.field), number)
            number = array.size
            object.__setattr__(self, column.field, array)

    def __len__(self) -> int:
        return int(self.wavelength_nm.size)

    def take(self, index: ArrayLike) -> FlatExposures:
        """Exposures at the given positions, in the given order."""
        at = np.asarray(index)
        return FlatExposures(*(getattr(self, column.field)[at] for column in _COLUMNS))


@dataclass(frozen=True)
class _Column:
    """One number for each wavelength: a field of `FlatExposures`, and a column of the table EXPOSURES."""

    field: str
    name: str
    unit: str | None
    zero: bool = False
    infinite: bool = False
    default: float | None = None

    def check(self, values: ArrayLike, number: int | None) -> FloatArray:
        values = without_unit(self.name, values, self.unit or "")
        if number is not None and not isinstance(values, list | tuple) and np.ndim(values) == 0:
            values = np.full(number, values)
        array = check.as_float_array(self.name, values, 1, np.float64)
        if number is not None and array.size != number:
            raise FrameFormatError(self.name, f"{array.size} values", f"{number}, one for each wavelength")
        good = (array >= 0 if self.zero else array > 0) & (array < np.inf if not self.infinite else True)
        if not good.all():
            sign = "not negative" if self.zero else "positive"
            allowed = sign if self.infinite else f"{sign} and finite"
            raise OutOfRangeError(self.name, float(array[~good][0]), allowed)
        return check.read_only(array.astype(np.float64))

    def read(self, table: fits.FITS_rec, source: str) -> NDArray[Any]:
        names = {str(name).lower(): str(name) for name in table.names}
        if self.name in names:
            column = table.columns[names[self.name]]
            return io.in_unit(self.name, np.array(table[column.name]), column.unit, self.unit, source=source)
        if self.default is None:
            raise FrameFormatError(
                "EXPOSURES", f"no column {self.name}", "a column of that name", source=source
            )
        return np.array(self.default)


_COLUMNS = (
    _Column("wavelength_nm", "wavelength", "nm"),
    _Column("bandwidth_fwhm_nm", "bandwidth_fwhm", "nm", zero=True),
    _Column("temperature_k", "temperature", "K"),
    _Column("f_number", "f_number", None, infinite=True, default=np.inf),
    _Column("level_e", "level", "electron", zero=True, default=0.0),
    _Column("dark_time_s", "dark_time", "s", zero=True, default=0.0),
)


class ExposureTable(Extension):
    """How each plane was illuminated."""

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:  # noqa: D102
        rows, number = getattr(product, self.field), len(known["mask"])
        if not isinstance(rows, FlatExposures):
            raise InputError(self.field, type(rows).__name__, "FlatExposures")
        if len(rows) != number:
            raise FrameFormatError(self.name, f"{len(rows)} rows", f"{number}, one for each plane of IMAGE")
        return {self.field: rows}

    def hdu(self, product: Any) -> fits.BinTableHDU:  # noqa: D102
        rows = getattr(product, self.field)
        return io.bintable_hdu(
            self.name, [(column.name, getattr(rows, column.field), column.unit) for column in _COLUMNS]
        )

    def read(self, hdus: fits.HDUList, source: str, native: bool) -> dict[str, Any]:  # noqa: D102
        table = self.table(hdus, source)
        return {self.field: FlatExposures(*(column.read(table, source) for column in _COLUMNS))}
