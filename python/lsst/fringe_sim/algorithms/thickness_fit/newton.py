"""Refinement of a thickness by Gauss-Newton steps on a fine table of templates.

These are the innermost loops of the fit: rows of wavelengths are padded so that they fill vector registers, and
the two steps that nearly every pixel needs are taken without a branch.
"""

from __future__ import annotations

import numpy as np

from ...compiled import subkernel

_TINY = np.float32(1e-30)
_CLOSE = np.float32(1.5)
"""A second step shorter than this, in steps of a table with 300 per order, leaves nothing to a third."""


@subkernel(relaxed=True, expand=True)
def _score(table, place, value, weight, item):  # type: ignore[no-untyped-def]
    below = np.uint32(min(int(place), table.shape[0] - 2))
    share = np.float32(place - below)
    low, high = table[below], table[below + 1]
    values, weights = value[item], weight[item]
    gain, information, chi2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for band in range(table.shape[1]):
        start = low[band]
        slope = high[band] - start
        miss = values[band] - (start + share * slope)
        leverage = weights[band] * slope
        gain += leverage * miss
        information += leverage * slope
        chi2 += weights[band] * miss * miss
    return gain, information, chi2


@subkernel(relaxed=True)
def score(table, place, value, weight, item):  # type: ignore[no-untyped-def]
    """Score, information and chi-square at one place of the table, in units of its step.

    ``table``: template amplitudes, ``(n_thickness, padded wavelengths)``; ``place``: thickness in steps of the
    table; between 0 and ``n_thickness - 1``; ``value, weight``: amplitudes and inverse variances; weight 0 where
    there is none, ``(n, padded wavelengths)``; ``item``: which row of them. Returns ``sum w g r``, ``sum w g²`` and
    ``sum w r²`` with the residual ``r`` and the slope ``g``.
    """
    return _score(table, place, value, weight, item)


@subkernel(relaxed=True)
def _go_on(table, place, value, weight, item, step, steps, limit):  # type: ignore[no-untyped-def]
    """Third and further steps."""
    top = table.shape[0] - 1.0
    information, chi2 = np.float32(0.0), np.float32(0.0)
    for _ in range(steps - 2):
        place = min(max(place + min(max(step, -limit), limit), 0.0), top)
        gain, information, chi2 = score(table, place, value, weight, item)
        step = gain / max(information, _TINY)
        if abs(step) <= _CLOSE:
            return min(max(place + step, 0.0), top), information, chi2 - gain * step
    return place, information, chi2


@subkernel(relaxed=True)
def newton_block(table, place, value, weight, count, steps, longest, information, chi2, move):  # type: ignore[no-untyped-def]
    """Like `gauss_newton` for the first ``count`` items, in place.

    All of them take a step before any takes the next: one step waits for the other, but those of different items
    do not, and the processor works on several at a time. ``move`` is room for as many numbers.
    """
    top = table.shape[0] - 1.0
    limit = np.float32(longest)
    for k in range(count):
        gain, seen, _ = _score(table, place[k], value, weight, k)
        step = gain / max(seen, _TINY)
        place[k] = min(max(place[k] + min(max(step, -limit), limit), 0.0), top)
    for k in range(count):
        gain, seen, misfit = _score(table, place[k], value, weight, k)
        step = gain / max(seen, _TINY)
        move[k], information[k], chi2[k] = step, seen, misfit - gain * step
    for k in range(count):
        if abs(move[k]) > _CLOSE:
            place[k], information[k], chi2[k] = _go_on(
                table, place[k], value, weight, k, move[k], steps, limit
            )
        else:
            place[k] = min(max(place[k] + move[k], 0.0), top)


@subkernel(relaxed=True)
def gauss_newton(table, place, value, weight, item, steps, longest):  # type: ignore[no-untyped-def]
    """Least chi-square near a place of the table.

    ``table, value, weight, item``: as for `score`; ``place``: where to begin; ``steps``: largest number of steps,
    at least 3; a second step below half a per cent of an order ends the search; ``longest``: longest single step,
    in steps of the table. Returns where it ended, information there, and chi-square after the last (quadratic)
    step.
    """
    top = table.shape[0] - 1.0
    limit = np.float32(longest)
    gain, information, chi2 = _score(table, place, value, weight, item)
    step = gain / max(information, _TINY)
    place = min(max(place + min(max(step, -limit), limit), 0.0), top)
    gain, information, chi2 = _score(table, place, value, weight, item)
    step = gain / max(information, _TINY)
    if abs(step) > _CLOSE:
        place, information, chi2 = _go_on(table, place, value, weight, item, step, steps, limit)
    else:
        place = min(max(place + step, 0.0), top)
        chi2 -= gain * step
    return place, information, chi2
