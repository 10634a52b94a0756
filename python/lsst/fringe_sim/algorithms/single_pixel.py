"""One pixel seen at many wavelengths: which thickness, and how much contrast and offset the data want.

Figure 4 of Guo, Walter, Lage & Lupton 2022 is such a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..errors import InputError, named_units
from ..model import FringeModel
from ..resources import read_table

__all__ = ["SinglePixelFit", "fit_single_pixel", "published_pixel"]

GRID_STEP_UM = 0.002  # Spacing of the searched thicknesses [µm]; 150 per fringe order


@named_units
@dataclass(frozen=True, eq=False)
class SinglePixelFit:
    """Best thickness of one pixel, with the misfit at all others.

    Attributes
    ----------
    thickness_um : `float`
        Thickness at the smallest misfit [µm].
    contrast, offset : `float`
        Factor on the model amplitude and constant added to it.
    rms : `float`
        Root mean square of data minus model at the best thickness.
    predicted : `numpy.ndarray`, shape ``(W,)``
        Model amplitude there.
    searched_um, searched_rms : `numpy.ndarray`, shape ``(N,)``
        Searched thicknesses [µm] and the misfit at each.
    """

    thickness_um: float
    contrast: float
    offset: float
    rms: float
    predicted: FloatArray
    searched_um: FloatArray
    searched_rms: FloatArray


def published_pixel() -> tuple[FloatArray, FloatArray]:
    """Wavelengths [nm] and measured fringe amplitudes of pixel (2100, 2100) of E2V-CCD250-321.

    Read from Figure 4 of Guo, Walter, Lage & Lupton 2022.
    """
    table = read_table("laboratory", "e2v_321_pixel_2100_2100.ecsv")
    wavelength = table["wavelength"].quantity.to_value("nm")
    return np.asarray(wavelength, dtype=float), np.asarray(table["amplitude"], dtype=float)


@named_units
def fit_single_pixel(
    wavelength_nm: ArrayLike,
    amplitude: ArrayLike,
    model: FringeModel,
    *,
    free_contrast: bool = False,
    free_offset: bool = False,
    range_um: tuple[float, float] | None = None,
) -> SinglePixelFit:
    """Find the thickness of one pixel by exhaustive search.

    Parameters
    ----------
    wavelength_nm, amplitude : array_like, shape ``(W,)``
        Nominal wavelengths [nm] and counts / mean - 1.
    model : `FringeModel`
        Model; its response is divided by its mean over fringe phase, as the data by their image mean.
    free_contrast, free_offset : `bool`, optional
        Fit a factor on the model amplitude, and a constant (an illumination error of the pixel).
    range_um : `tuple` [`float`, `float`], optional
        Thicknesses to search [µm]; those of the set-up if not given.

    Returns
    -------
    fit : `SinglePixelFit`

    Raises
    ------
    InputError
        Too few wavelengths for the number of free parameters, shapes that differ, or values that are not finite.
    """
    wavelength, data = np.asarray(wavelength_nm, dtype=float), np.asarray(amplitude, dtype=float)
    if wavelength.ndim != 1 or wavelength.shape != data.shape:
        raise InputError(
            "shapes of wavelengths and amplitudes", (wavelength.shape, data.shape), "equally long"
        )
    needed = 2 + int(free_contrast) + int(free_offset)
    if len(wavelength) < needed:
        raise InputError("number of wavelengths", len(wavelength), f"{needed} or more for these parameters")
    if not np.all(np.isfinite(data)):
        raise InputError("amplitude", data.tolist(), "finite numbers")
    low, high = range_um or model.setup.thickness_range_um
    count = int(np.ceil((high - low) / GRID_STEP_UM)) + 1
    response = model.response_on_grid(wavelength, low, GRID_STEP_UM, count)
    templates = response / response.mean(axis=1, keepdims=True) - 1.0
    contrast, offset, predicted = _scaled(templates, data, free_contrast, free_offset)
    rms = np.sqrt(((data[:, None] - predicted) ** 2).mean(axis=0))
    best = int(np.argmin(rms))
    thickness = low + GRID_STEP_UM * np.arange(count, dtype=np.float64)
    return SinglePixelFit(
        thickness_um=float(thickness[best]),
        contrast=float(contrast[best]),
        offset=float(offset[best]),
        rms=float(rms[best]),
        predicted=predicted[:, best],
        searched_um=thickness,
        searched_rms=rms,
    )


def _scaled(
    templates: FloatArray, data: FloatArray, free_contrast: bool, free_offset: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least-squares contrast and offset for every template column."""
    columns = templates.shape[1]
    centre = templates.mean(axis=0) if free_offset else np.zeros(columns)
    level = data.mean() if free_offset else 0.0
    if free_contrast:
        spread = templates - centre
        power = (spread**2).sum(axis=0)
        along = (spread * (data - level)[:, None]).sum(axis=0)
        # A negative contrast is a shift by half an order in disguise.
        contrast = np.maximum(np.divide(along, power, out=np.zeros(columns), where=power > 0.0), 0.0)
    else:
        contrast = np.ones(columns)
    offset = level - contrast * centre if free_offset else np.zeros(columns)
    return contrast, offset, contrast * templates + offset
