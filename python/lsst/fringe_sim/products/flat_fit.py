"""What a thickness fit learned about each flat: contrast, wavelength, misfit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.io import fits

from ..array_types import FloatArray
from ..errors import FrameFormatError, named_units
from . import _fits as io
from ._check import read_only
from .fits_product import Extension

FLAT_COLUMNS = (
    ("wavelength_nm", "nm"),
    ("contrast", None),
    ("contrast_sigma", None),
    ("offset_nm", "nm"),
    ("offset_sigma_nm", "nm"),
    ("misfit", None),
)
"""Columns of the table in a file, with their units."""


@named_units
@dataclass(frozen=True, eq=False)
class FlatFit:
    """Numbers of each flat, in the order of the cube, and a coarse map.

    Parameters
    ----------
    wavelength_nm : array_like, shape ``(n_wavelengths,)``
        Wavelength on the label [nm].
    contrast, contrast_sigma : array_like, shape ``(n_wavelengths,)``
        Fringe amplitude over that of the model, and its standard uncertainty; 1 and 0 if it was held fixed.
    offset_nm, offset_sigma_nm : array_like, shape ``(n_wavelengths,)``
        Wavelength minus that of the label, and its standard uncertainty [nm]; zeros if wavelengths were believed.
    misfit : array_like, shape ``(n_wavelengths,)``
        Mean square of what the fit leaves over in small cells, over their variance.

    Raises
    ------
    FrameFormatError
        Arrays of different lengths.
    """

    wavelength_nm: FloatArray
    contrast: FloatArray
    contrast_sigma: FloatArray
    offset_nm: FloatArray
    offset_sigma_nm: FloatArray
    misfit: FloatArray

    def __post_init__(self) -> None:
        length = np.size(self.wavelength_nm)
        for name, _ in FLAT_COLUMNS:
            array = read_only(np.array(getattr(self, name), dtype=float))
            if array.shape != (length,):
                raise FrameFormatError(f"FLATS.{name}", array.shape, f"({length},)")
            object.__setattr__(self, name, array)


class FlatTable(Extension):
    """Binary table of a `FlatFit`; none if nothing was learned."""

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:  # noqa: D102
        return {self.field: getattr(product, self.field)}

    def hdu(self, product: Any) -> Any:  # noqa: D102
        flats = getattr(product, self.field)
        if flats is None:
            return None
        return io.bintable_hdu(self.name, [(name, getattr(flats, name), unit) for name, unit in FLAT_COLUMNS])

    def read(self, hdus: fits.HDUList, source: str, native: bool) -> dict[str, Any]:  # noqa: D102
        if self.name not in hdus:
            return {self.field: None}
        rows = self.table(hdus, source)
        missing = [name for name, _ in FLAT_COLUMNS if name not in rows.names]
        if missing:
            raise FrameFormatError(self.name, f"without {', '.join(missing)}", "all columns", source=source)
        return {self.field: FlatFit(**{name: rows[name] for name, _ in FLAT_COLUMNS})}
