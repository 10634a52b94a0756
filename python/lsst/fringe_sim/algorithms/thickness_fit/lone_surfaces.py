"""Surfaces that touch no other: nobody helps them to find their order.

A large surface rules out false orders by the number of its cells. A small one that masked pixels cut off from all
others has only its own few cells, and what competes with its order may lie anywhere in the range, also between whole
orders. So its cells are compared with the whole range again, now that the mean response is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, Float32Array, FloatArray
from .cells import Cells
from .evidence import IMPOSSIBLE, OrderEvidence, order_evidence, refine_cells
from .templates import FlatTemplates


@dataclass(frozen=True, eq=False)
class LoneSurfaces:
    """Order of the lone surfaces."""

    # thickness of all cells; only those of lone surfaces may have changed, float32, ``(ncy, ncx)``
    thickness_um: Float32Array
    surface: NDArray[np.intp]  # numbers of the lone surfaces, ``(n,)``
    slip: FloatArray  # probability that their order is wrong, ``(n,)``


def settle_lone_surfaces(
    cells: Cells,
    templates: FlatTemplates,
    thickness_um: Float32Array,
    segment: NDArray[np.int32],
    independence: FloatArray,
    order_um: float,
    *,
    range_um: tuple[float, float],
    temper: float,
    most_cells: int,
    threads: int = 2,
) -> LoneSurfaces:
    """Give every lone surface the order that all its cells together prefer.

    ``thickness_um``: thickness so far [µm]; NaN where a cell has no data, float32, ``(ncy, ncx)``; ``segment``:
    number of the surface each cell lies on; -1 where a cell has no data, int32, ``(ncy, ncx)``; ``independence``: how
    much more independent the cells of each surface are than ``temper`` says, ``(n_segments,)``; ``most_cells``:
    largest surface that is looked at; larger ones have cells enough.
    """
    surface = np.flatnonzero(_are_lone(segment) & (np.bincount(segment[segment >= 0]) <= most_cells))
    member = np.flatnonzero(np.isin(segment, surface))
    if member.size == 0:
        return LoneSurfaces(thickness_um, surface, np.zeros(0))
    few = _pick(cells, member)
    found = order_evidence(few, templates, order_um, range_um=range_um, temper=temper, threads=threads)
    place = np.searchsorted(surface, segment.ravel()[member])
    total, own = _totals(found, thickness_um.ravel()[member], place, len(surface))
    shift = np.argmin(total, axis=1) - total.shape[1] // 2
    moved = found.phase_um[0] + order_um * (own + shift[place]).astype(np.float32)
    out = thickness_um.copy()
    out.ravel()[member] = refine_cells(few, templates, moved[None].astype(np.float32), threads)[0]
    excess = independence[surface, None] * (total - total.min(axis=1, keepdims=True))
    slip = 1.0 - 1.0 / np.exp(-0.5 * excess.clip(0.0, 2000.0)).sum(axis=1)
    return LoneSurfaces(out, surface, slip)


def _are_lone(segment: NDArray[np.int32]) -> BoolArray:
    """Which surfaces touch no other."""
    lone = np.ones(int(segment.max(initial=-1)) + 1, bool)
    for near, far in ((segment[1:], segment[:-1]), (segment[:, 1:], segment[:, :-1])):
        touch = (near != far) & (near >= 0) & (far >= 0)
        lone[near[touch]] = False
        lone[far[touch]] = False
    return lone


def _pick(cells: Cells, member: NDArray[np.intp]) -> Cells:
    """Some cells, in one row."""

    def row(part: Float32Array) -> Float32Array:
        return np.ascontiguousarray(part.reshape(-1, part.shape[-1])[member][None])

    return Cells(
        row(cells.value),
        row(cells.weight),
        row(cells.rise_y),
        row(cells.rise_x),
        np.arange(2),
        np.arange(member.size + 1),
    )


def _totals(
    found: OrderEvidence, thickness_um: Float32Array, place: NDArray[np.intp], surfaces: int
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Summed evidence of each surface at shifts of ``-(n-1) ... n-1`` orders, and the order of each cell now."""
    evidence = found.evidence[0]
    orders = evidence.shape[1]
    own = np.rint((thickness_um - found.phase_um[0]) / found.order_um).astype(int)
    total = np.empty((surfaces, 2 * orders - 1))
    for column, shift in enumerate(range(1 - orders, orders)):
        at = own + shift
        inside = (at >= 0) & (at < orders)
        there = np.take_along_axis(evidence, np.clip(at, 0, orders - 1)[:, None], axis=1)[:, 0]
        total[:, column] = np.bincount(place, np.where(inside, there, IMPOSSIBLE), surfaces)
    return total, own
