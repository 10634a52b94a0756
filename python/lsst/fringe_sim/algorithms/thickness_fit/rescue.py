"""Pixels that fit badly: one spoilt wavelength, or a void in the layer that is smaller than a cell.

A cosmic ray or a hot pixel spoils one wavelength of a pixel whose others are sound. A void spoils nothing, but
the pixel lies far from the surface on which its search began.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ...array_types import Float32Array
from ...compiled import kernel
from .amplitudes import Amplitudes
from .bands import gather_pixels
from .cells import Cells
from .evidence import OrderEvidence, order_evidence
from .medians import middle_of
from .newton import gauss_newton
from .pixels import PixelFit
from .templates import FlatTemplates

SUSPECT_PROBABILITY = 1e-7  # A pixel whose chi-square is that improbable is not believed
_FEWEST_TO_SPARE = 6  # A wavelength is left out only of so many or more
_COMPACT = 0.5
"""Fraction of its 5 by 5 neighbours that fit badly too, from which a pixel may lie in a void: columns have less."""
_NEIGHBOURS = 25
_MOST_SEARCHED = 200_000
_SAMPLE = 400_000  # Pixels from which the typical misfit is taken


def chi2_limits(most: int) -> Float32Array:
    """Reduced chi-square that is exceeded with `SUSPECT_PROBABILITY`, by number of wavelengths 0 ... ``most``."""
    degrees = np.maximum(np.arange(most + 1) - 1, 1)
    return (chdtri(degrees, SUSPECT_PROBABILITY) / degrees).astype(np.float32)


def rescue_pixels(
    data: Amplitudes,
    templates: FlatTemplates,
    pixels: PixelFit,
    slip: Float32Array,
    order_um: float,
    *,
    range_um: tuple[float, float],
    threads: int = 2,
) -> PixelFit:
    """Fit again the pixels whose chi-square is improbable.

    ``pixels``: the fit so far; its arrays are revised in place, as a full sensor leaves no room for copies; ``slip``:
    probability that the order of a pixel is wrong; raised in place where a pixel had to be looked for by itself,
    float32. Returns them with better values where there are; ``n_wavelengths`` is one less where one was left out.
    """
    limit = typical_misfit(pixels) * chi2_limits(int(pixels.n_wavelengths.max(initial=0)))
    bad = np.empty(pixels.chi2.shape, np.bool_)
    _exceeds(pixels.chi2, limit, pixels.n_wavelengths, bad)
    rows, columns = np.nonzero(bad)
    if rows.size == 0:
        return pixels
    grid = templates.grid()
    for low in range(0, rows.size, _MOST_SEARCHED):
        part = slice(low, low + _MOST_SEARCHED)
        value, weight = gather_pixels(data, rows[part], columns[part])
        _leave_one_out(value, weight, rows[part], columns[part], grid, order_um, bad, limit, pixels)
    # Only bad pixels were changed, and only they can still be.
    bad[rows, columns] = pixels.chi2[rows, columns] > limit[pixels.n_wavelengths[rows, columns]]
    compact = bad[rows, columns] & (_bad_neighbours(bad, rows, columns) > _COMPACT * _NEIGHBOURS)
    rows, columns = (index[compact][:_MOST_SEARCHED] for index in (rows, columns))
    if rows.size:
        value, weight = gather_pixels(data, rows, columns)
        none = np.zeros_like(value)[None]
        single = Cells(value[None], weight[None], none, none, np.arange(2), np.arange(len(rows) + 1))
        found = order_evidence(single, templates, order_um, range_um=range_um, threads=threads)
        _take_what_fits(found, weight, (rows, columns), templates, limit, pixels, slip)
    return pixels


@kernel
def _exceeds(chi2, limit, used, out):  # type: ignore[no-untyped-def]
    """Where chi-square is above the limit for its number of wavelengths."""
    for y in range(chi2.shape[0]):
        for x in range(chi2.shape[1]):
            out[y, x] = chi2[y, x] > limit[used[y, x]]


@kernel
def _bad_neighbours(bad, rows, columns):  # type: ignore[no-untyped-def]
    """Bad pixels among the 5 by 5 around some; the edge of the sensor counts as often as it is met."""
    ny, nx = bad.shape
    found = np.zeros(rows.shape[0], np.int64)
    for k in range(rows.shape[0]):
        for b in range(rows[k] - 2, rows[k] + 3):
            for a in range(columns[k] - 2, columns[k] + 3):
                found[k] += bad[min(max(b, 0), ny - 1), min(max(a, 0), nx - 1)]
    return found


def typical_misfit(pixels: PixelFit) -> float:
    """Median reduced chi-square over its expectation, at least 1: how far the model itself falls short."""
    most = int(pixels.n_wavelengths.max(initial=0))
    if most < 2:
        return 1.0
    # An odd stride does not fall on the same columns in every row.
    for stride in (pixels.chi2.size // _SAMPLE | 1, 1):
        chi2 = pixels.chi2.ravel()[::stride][pixels.n_wavelengths.ravel()[::stride] == most]
        chi2 = chi2[np.isfinite(chi2)]
        if chi2.size > 0:
            break
    else:
        return 1.0
    expected = chdtri(most - 1, 0.5) / (most - 1)
    return max(float(np.median(chi2)) / expected, 1.0)


@kernel
def _leave_one_out(value, weight, rows, columns, grid, order, bad, limit, pixels):  # type: ignore[no-untyped-def]
    """Begin on the surface of the good neighbours, drop the worst wavelength, keep the result if it fits.

    Only bad pixels change, and only good ones are looked at as neighbours: the order does not matter.
    """
    (table, start, step), (thickness, sigma, reduced, used) = grid, pixels
    ny, nx = thickness.shape
    guess = np.empty(49, np.float64)
    for k in range(rows.shape[0]):
        y, x = rows[k], columns[k]
        if used[y, x] < _FEWEST_TO_SPARE:
            continue
        number = np.int64(0)
        for b in range(max(y - 3, 0), min(y + 4, ny)):
            for a in range(max(x - 3, 0), min(x + 4, nx)):
                if not bad[b, a] and np.isfinite(thickness[b, a]):
                    guess[number] = thickness[b, a]
                    number += 1
        if number < 4:
            continue
        place = min(max((middle_of(guess, number) - start) / step, 0.0), table.shape[0] - 1.0)
        below = min(int(place), table.shape[0] - 2)
        share = place - below
        worst, most = -1, 0.0
        for band in range(table.shape[1]):
            model = table[below, band] + share * (table[below + 1, band] - table[below, band])
            miss = weight[k, band] * (value[k, band] - model) ** 2
            if miss > most:
                worst, most = band, miss
        if worst < 0:
            continue
        weight[k, worst] = 0.0
        at, information, chi2 = gauss_newton(table, place, value, weight, k, np.int64(5), 0.03 / step)
        left = used[y, x] - 1
        if chi2 / (left - 1) < limit[left] and abs(at - place) * step < 0.5 * order and information > 0.0:
            thickness[y, x] = start + step * at
            sigma[y, x] = step / np.sqrt(information)
            reduced[y, x] = max(chi2, np.float32(0.0)) / (left - 1)
            used[y, x] = left


def _take_what_fits(
    found: OrderEvidence,
    weight: Float32Array,
    place: tuple[NDArray[np.intp], NDArray[np.intp]],
    templates: FlatTemplates,
    limit: Float32Array,
    pixels: PixelFit,
    slip: Float32Array,
) -> None:
    """Keep what pixels have found by themselves over the whole range, where it fits, in place."""
    used = np.count_nonzero(weight > 0, axis=1)
    reduced = found.chi2[0] / np.maximum(used - 1, 1)
    fits = reduced < limit[used]
    thickness = found.best_um[0][fits].astype(float)
    margin = templates.step_um
    slope = (templates.amplitude_at(thickness + margin) - templates.amplitude_at(thickness - margin)) / (
        2 * margin
    )
    information = (weight[fits, : templates.n_wavelengths] * slope.T**2).sum(axis=1)
    rows, columns = place[0][fits], place[1][fits]
    pixels.value[rows, columns] = thickness
    pixels.sigma[rows, columns] = 1.0 / np.sqrt(np.maximum(information, 1e-30))
    pixels.chi2[rows, columns] = reduced[fits]
    slip[rows, columns] = 1.0 - 1.0 / np.maximum(np.exp(-0.5 * found.evidence[0][fits]).sum(axis=1), 1.0)
