"""A measured thickness map that is shipped, and how a map is brought to the size of a sensor.

Every map is an array ``[y, x]`` in µm on the assembled, trimmed sensor, lower-left pixel first.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import map_coordinates

from ..array_types import FloatArray
from ..errors import InputError
from ..resources import read_table

E2V_SHAPE = (4004, 4096)  # Rows and columns of an assembled, trimmed E2V-CCD250

Sampling = Literal["resample", "window"]
"""How a large map becomes a small one: the whole of it on fewer pixels, or the pixels from a ``corner`` on."""


def e2v_321(
    shape: tuple[int, int] = E2V_SHAPE, *, sampling: Sampling = "resample", corner: tuple[int, int] = (0, 0)
) -> FloatArray:
    """Adhesive of E2V-CCD250-321, as a smooth model of the map that Guo et al. (2022) fitted.

    A bicubic spline of 24 × 24 coefficients. It differs from the published map by 9.5 nm rms, which is the
    quantisation of that map. Range 14.03 to 22.01 µm.
    """
    table = read_table("laboratory", "thickness_e2v_321.ecsv")
    count, degree = int(table.meta["coefficients_per_axis"]), int(table.meta["degree"])
    size_y, size_x = table.meta["sensor_shape"]
    coefficients = np.zeros((count, count))
    coefficients[table["iy"], table["ix"]] = table["coefficient"].quantity.to_value("um")
    rows = _positions("rows", shape[0], size_y, sampling, corner[0])
    columns = _positions("columns", shape[1], size_x, sampling, corner[1])
    basis_y = _clamped_basis(rows, size_y, count, degree)
    basis_x = _clamped_basis(columns, size_x, count, degree)
    return basis_y @ coefficients @ basis_x.T


def fit_to_sensor(
    thickness_um: FloatArray,
    shape: tuple[int, int],
    *,
    sampling: Sampling = "resample",
    corner: tuple[int, int] = (0, 0),
) -> FloatArray:
    """Bring any map to the shape of a sensor; resampling is bicubic, from pixel centres to pixel centres."""
    thickness = np.asarray(thickness_um, dtype=float)
    if thickness.ndim != 2:
        raise InputError("thickness map dimensions", thickness.ndim, "2")
    rows = _positions("rows", shape[0], thickness.shape[0], sampling, corner[0])
    columns = _positions("columns", shape[1], thickness.shape[1], sampling, corner[1])
    if sampling == "window" or thickness.shape == tuple(shape):
        return thickness[np.ix_(rows.astype(int), columns.astype(int))]
    grid = np.meshgrid(rows, columns, indexing="ij")
    return map_coordinates(thickness, grid, order=3, mode="nearest")


def _positions(what: str, wanted: int, available: int, sampling: Sampling, first: int) -> FloatArray:
    """Pixel coordinates on the large map of the ``wanted`` pixels of the small one."""
    if wanted < 1:
        raise InputError(f"number of {what}", wanted, "1 or more")
    if sampling == "resample":
        return (np.arange(wanted) + 0.5) * available / wanted - 0.5
    if sampling != "window":
        raise InputError("sampling", sampling, "'resample' or 'window'")
    if first < 0 or first + wanted > available:
        raise InputError(f"window of {what}", (first, first + wanted), f"within 0 to {available}")
    return np.arange(first, first + wanted, dtype=float)


def _clamped_basis(position: FloatArray, size: int, count: int, degree: int) -> FloatArray:
    inner = np.linspace(0.0, size - 1.0, count - degree + 1)
    knots = np.concatenate([[0.0] * degree, inner, [size - 1.0] * degree])
    # Resampled onto more pixels than the sensor has, the outermost centres lie up to half a pixel outside.
    inside = np.clip(position, 0.0, size - 1.0)
    return BSpline.design_matrix(inside, knots, degree).toarray()
