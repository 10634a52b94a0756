"""Pixels near a step in the layer: on which side of it each one lies.

Where the cells around a pixel show several surfaces, the pixel's own amplitudes choose between them, and noise
chooses wrong now and then. Pixels of one surface lie together; so each pixel there is asked again, with a price
for every neighbour from which it would be torn off.
"""

from __future__ import annotations

import numpy as np

from ...array_types import BoolArray, Float32Array
from ...compiled import kernel
from .amplitudes import Amplitudes
from .bands import gather_pixels
from .between_orders import break_price
from .misfit import Misfit, improbability
from .newton import gauss_newton
from .pixels import SAME_SURFACE, PixelFit
from .templates import FlatTemplates

_SHARE_OF_PRICE = 0.25  # A break between two neighbouring pixels costs so much of one between two cells
_SWEEPS = 6
_MOST_SURFACES = 6
_MOST_JUDGED = 20_000  # Pixels that show how far all are off


def settle_borders(
    data: Amplitudes,
    templates: FlatTemplates,
    pixels: PixelFit,
    rough: BoolArray,
    order_um: float,
    temper: float,
) -> tuple[PixelFit, Float32Array]:
    """Revise the pixels near steps.

    ``pixels``: what the pixels found by themselves; its arrays are revised in place; ``rough``: pixels that have more
    than one surface within reach, bool, ``(ny, nx)``. Returns ``pixels``: the revised fit; ``slip``: probability that
    a pixel lies on another of the surfaces; 0 where there is only one, float32, ``(ny, nx)``.
    """
    slip = np.zeros(rough.shape, np.float32)
    rows, columns = np.nonzero(rough & (pixels.n_wavelengths > 0))
    if rows.size == 0:
        return pixels, slip
    value, weight = gather_pixels(data, rows, columns)
    freedom = np.maximum(np.count_nonzero(weight > 0, axis=1) - 1, 1).astype(np.float32)
    misfit = _misfit_of(pixels)
    spread, grid = (misfit.scale, misfit.tail), templates.grid()
    for sweep in range(_SWEEPS):
        backwards = sweep % 2 == 1
        if not _sweep(
            value, weight, freedom, spread, rows, columns, grid, order_um, temper, pixels, slip, backwards
        ):
            break
    return pixels, slip


def _misfit_of(pixels: PixelFit) -> Misfit:
    """How far pixels are off beyond their noise."""
    # An odd stride does not fall on the same columns.
    some = slice(None, None, pixels.chi2.size // _MOST_JUDGED | 1)
    chi2, used = pixels.chi2.ravel()[some], pixels.n_wavelengths.ravel()[some]
    freedom = max(int(used.max(initial=0)) - 1.0, 1.0)
    known = (used == freedom + 1.0) & np.isfinite(chi2)
    return Misfit.of(freedom * chi2[known].astype(float), freedom)


@kernel
def _sweep(  # type: ignore[no-untyped-def]
    value, weight, freedom, misfit, rows, columns, grid, order, temper, pixels, slip, backwards
):
    """Ask every pixel once; returns how many changed their mind."""
    (scale, tail), (table, start, step) = misfit, grid
    thickness, sigma, reduced, _ = pixels
    ny, nx = thickness.shape
    top = table.shape[0] - 1.0
    guess = np.empty(_MOST_SURFACES, np.float64)
    changed = 0
    for number in range(rows.shape[0]):
        k = rows.shape[0] - 1 - number if backwards else number
        y, x = rows[k], columns[k]
        guess[0] = thickness[y, x]
        count = 1
        for b in range(max(y - 1, 0), min(y + 2, ny)):
            for a in range(max(x - 1, 0), min(x + 2, nx)):
                there = thickness[b, a]
                if np.isfinite(there) and count < _MOST_SURFACES:
                    known = False
                    for g in range(count):
                        known = known or abs(guess[g] - there) < SAME_SURFACE * order
                    if not known:
                        guess[count] = there
                        count += 1
        if count == 1:
            slip[y, x] = 0.0
            continue
        best, least, best_place = 0, np.inf, 0.0
        best_information, best_chi2 = np.float32(0.0), np.float32(0.0)
        total = 0.0
        for g in range(count):
            place = min(max((guess[g] - start) / step, 0.0), top)
            place, information, chi2 = gauss_newton(table, place, value, weight, k, np.int64(5), 0.03 / step)
            at = start + step * place
            if g > 0 and abs(at - guess[g]) > SAME_SURFACE * order:
                continue
            # Student's: what a pixel leaves over beyond its noise is error of the model, which chooses no side.
            cost = temper * improbability(chi2, freedom[k], scale, tail)
            for b in range(max(y - 1, 0), min(y + 2, ny)):
                for a in range(max(x - 1, 0), min(x + 2, nx)):
                    if (b != y or a != x) and np.isfinite(thickness[b, a]):
                        cost += _SHARE_OF_PRICE * break_price(thickness[b, a] - at, order)
            if cost < least:
                # Keep the sum of the odds relative to the best so far.
                total = total * np.exp(0.5 * (cost - least)) + 1.0 if least < np.inf else 1.0
                best, least = g, cost
                best_place, best_information, best_chi2 = place, information, chi2
            else:
                total += np.exp(0.5 * (least - cost))
        slip[y, x] = 1.0 - 1.0 / total if total > 0.0 else 1.0
        if best != 0:
            changed += 1
            thickness[y, x] = start + step * best_place
            sigma[y, x] = step / np.sqrt(best_information) if best_information > 0.0 else np.inf
            reduced[y, x] = max(best_chi2, np.float32(0.0)) / freedom[k]
    return changed
