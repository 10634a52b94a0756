"""Median of a few numbers inside compiled loops, where the general sort would take seconds to compile."""

from __future__ import annotations

from ...compiled import subkernel


@subkernel
def _sort_first(values, count):  # type: ignore[no-untyped-def]
    """Sort the first ``count`` numbers in place (Shell 1959, gaps of Ciura 2001)."""
    for gap in (701, 301, 132, 57, 23, 10, 4, 1):
        for k in range(gap, count):
            item = values[k]
            j = k
            while j >= gap and values[j - gap] > item:
                values[j] = values[j - gap]
                j -= gap
            values[j] = item


@subkernel
def middle_of(values, count):  # type: ignore[no-untyped-def]
    """Sort the first ``count`` numbers in place and return the middle one (the upper of two)."""
    _sort_first(values, count)
    return values[count // 2]
