"""Backgrounds as afw writes them: means of bins, drawn by splines or a polynomial as afw draws them.

Layout and rules are those of ``BackgroundList.writeFits``, ``BackgroundMI::doGetImage``, ``Interpolate`` and
``Approximate`` in the package afw of the LSST Science Pipelines (https://github.com/lsst/afw).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from astropy.io import fits
from scipy.interpolate import CubicSpline

from ..array_types import FloatArray
from ..errors import FrameFormatError

CONSTANT, LINEAR, NATURAL, CUBIC, AKIMA = 0, 1, 2, 3, 5
"""Numbers of ``Interpolate::Style``; the periodic ones are not in use."""

_LEAST_POINTS = {CONSTANT: 1, LINEAR: 2, NATURAL: 3, CUBIC: 3, AKIMA: 5}
_OF_POINTS = (CONSTANT, CONSTANT, LINEAR, CUBIC, CUBIC)

_REDUCE = 1  # Number of the ``UndersampleStyle`` that takes a simpler spline where there are too few bins
_CHEBYSHEV = 0  # Number of ``ApproximateControl::Style``; -1 is none
_PARTS = 3  # HDUs of a background: means of the bins, mask, variance


def is_afw_background(hdus: fits.HDUList) -> bool:
    """Whether a file is a list of backgrounds of afw."""
    return len(hdus) % _PARTS == 0 and "INTERPSTYLE" in hdus[0].header


def afw_background(hdus: fits.HDUList) -> FloatArray:
    """Sum of all backgrounds of a file, of the shape of the image that they were made of.

    Raises `FrameFormatError`: backgrounds of different images, a spline that is not known, or bins that are too few
    for it.
    """
    total = np.zeros(())
    for number in range(0, len(hdus), _PARTS):
        made = _drawn(hdus[number], hdus[number + 2])
        if number and made.shape != total.shape:
            raise FrameFormatError("shape of a background", made.shape, f"{total.shape}, that of the first")
        total = total + made
    return total


def _drawn(bins: Any, variance: Any) -> FloatArray:
    header = bins.header
    values = np.array(bins.data, dtype=float)
    shape = int(header["BKGD_HEIGHT"]), int(header["BKGD_WIDTH"])
    rows, columns = (_centres(side, number) for side, number in zip(shape, values.shape, strict=True))
    reduce = int(header["UNDERSAMPLESTYLE"]) == _REDUCE
    style = _usable(int(header["INTERPSTYLE"]), values.shape, reduce)
    if int(header.get("APPROXSTYLE", -1)) == _CHEBYSHEV:
        weighted = bool(header.get("APPROXWEIGHTING", True))
        weight = 1.0 / np.array(variance.data, dtype=float) if weighted else np.ones(values.shape)
        return _polynomial(values, weight, (rows, columns), shape, int(header.get("APPROXORDERX", 1)))
    along = np.full((shape[0], columns.size), np.nan)
    for column in range(columns.size):
        good = ~np.isnan(values[:, column])
        if good.any():
            curve = _curve(rows[good], values[good, column : column + 1], style, reduce=reduce)
            along[:, column] = curve(np.arange(shape[0]))[:, 0]
    good = ~np.isnan(along[0])
    if not good.any():
        return np.full(shape, np.nan)
    across = _curve(columns[good], along[:, good].T, style, reduce=reduce)(np.arange(shape[1]))
    return np.asarray(across.T)


def _centres(side: int, bins: int) -> FloatArray:
    """Middles of bins whose borders are rounded to whole pixels."""
    ends = ((np.arange(bins + 1) * side + bins // 2) // bins).clip(max=side)
    return 0.5 * (ends[:-1] + ends[1:] - 1)


def _usable(style: int, bins: tuple[int, ...], reduce: bool) -> int:
    """The style that as many bins allow."""
    if style not in _LEAST_POINTS:
        raise FrameFormatError("INTERPSTYLE", style, f"one of {', '.join(map(str, _LEAST_POINTS))}")
    if min(bins) >= _LEAST_POINTS[style]:
        return style
    if not reduce:
        raise FrameFormatError("bins", bins, f"{_LEAST_POINTS[style]} or more along each side")
    return _of_points(min(bins))


def _of_points(number: int) -> int:
    return _OF_POINTS[number] if number < len(_OF_POINTS) else AKIMA


def _curve(x: FloatArray, y: FloatArray, style: int, *, reduce: bool) -> Callable[[Any], FloatArray]:
    """Interpolation of the columns of ``y``; beyond the points it is the parabola of the end."""
    if x.size < _LEAST_POINTS[style]:
        if not reduce:
            raise FrameFormatError("bins with a value", x.size, f"{_LEAST_POINTS[style]} or more")
        style = _of_points(x.size)
    if style == CONSTANT:
        return _steps(x, y)
    if style == LINEAR:
        zero = np.zeros_like(y[1:])
        return _pieces(x, y, (np.diff(y, axis=0) / np.diff(x)[:, None], zero, zero))
    if style == AKIMA:
        return _pieces(x, y, _akima(x, y))
    spline = CubicSpline(x, y, axis=0, bc_type="natural")
    return _pieces(x, y, (spline.c[2], spline.c[1], spline.c[0]))


def _steps(x: FloatArray, y: FloatArray) -> Callable[[Any], FloatArray]:
    """What afw calls constant: means of neighbours between the points, and the ends beyond."""
    if x.size == 1:
        return lambda place: np.repeat(y, np.size(place), axis=0)
    levels = np.concatenate([y[:1], 0.5 * (y[:-1] + y[1:]), y[-1:]])
    first, last = 0.5 * (3 * x[0] - x[1]), 0.5 * (3 * x[-1] - x[-2])
    borders = np.concatenate([[first], 0.5 * (x[:-1] + x[1:]), [last]])
    return lambda place: levels[np.clip(np.searchsorted(borders, place, side="right") - 1, 0, x.size)]


def _akima(x: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
    """Coefficients of Akima (1970, J. ACM 17, 589), with those of GSL where neighbouring slopes are equal."""
    step = np.diff(x)[:, None]
    inner = np.diff(y, axis=0) / step
    slope = np.concatenate(
        [
            [3 * inner[0] - 2 * inner[1], 2 * inner[0] - inner[1]],
            inner,
            [2 * inner[-1] - inner[-2], 3 * inner[-1] - 2 * inner[-2]],
        ]
    )
    before, after = np.abs(np.diff(slope[:-2], axis=0)), np.abs(np.diff(slope[2:], axis=0))
    both = before + after
    share = np.divide(before, both, out=np.zeros_like(both), where=both > 0)
    tangent = (1 - share) * slope[1:-2] + share * slope[2:-1]
    straight = both[:-1] == 0
    end = np.where(both[1:] == 0, inner, tangent[1:])
    first = np.where(straight, inner, tangent[:-1])
    second = np.where(straight, 0.0, (3 * inner - 2 * first - end) / step)
    return first, second, np.where(straight, 0.0, (first + end - 2 * inner) / step**2)


def _pieces(x: FloatArray, y: FloatArray, parts: tuple[FloatArray, ...]) -> Callable[[Any], FloatArray]:
    """Piecewise cubics from their coefficients, of the first power first."""
    first, second, third = parts

    def drawn(place: Any) -> FloatArray:
        places = np.asarray(place, dtype=float)
        piece = np.clip(np.searchsorted(x, places, side="right") - 1, 0, x.size - 2)
        # Beyond the last point the parabola has the slope and the curvature of the end.
        away = np.clip(places, x[0], x[-1]) - x[piece]
        beyond = (places - np.clip(places, x[0], x[-1]))[:, None]
        off = away[:, None]
        value = y[piece] + off * (first[piece] + off * (second[piece] + off * third[piece]))
        slope = first[piece] + off * (2 * second[piece] + 3 * off * third[piece])
        return np.asarray(value + beyond * (slope + beyond * (second[piece] + 3 * off * third[piece])))

    return drawn


def _polynomial(
    values: FloatArray,
    weight: FloatArray,
    centres: tuple[FloatArray, FloatArray],
    shape: tuple[int, int],
    order: int,
) -> FloatArray:
    """Chebyshev polynomial of a total degree, fitted to the bins by weighted least squares."""

    def terms(places: FloatArray, side: int) -> FloatArray:
        return np.asarray(np.polynomial.chebyshev.chebvander(places / side, order), dtype=np.float64)

    chosen = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    down, across = (terms(place, side) for place, side in zip(centres, shape, strict=True))
    design = np.stack([np.outer(down[:, i], across[:, j]).ravel() for i, j in chosen], axis=1)
    good = np.isfinite(values + weight).ravel()
    if np.count_nonzero(good) < len(chosen):
        raise FrameFormatError("bins with a value", np.count_nonzero(good), f"{len(chosen)} or more")
    root = np.sqrt(weight.ravel()[good])
    found = np.linalg.lstsq(design[good] * root[:, None], values.ravel()[good] * root, rcond=None)[0]
    matrix = np.zeros((order + 1, order + 1))
    for (i, j), coefficient in zip(chosen, found, strict=True):
        matrix[i, j] = coefficient
    down, across = (terms(np.arange(side, dtype=float), side) for side in shape)
    return np.asarray(down @ matrix @ across.T)
