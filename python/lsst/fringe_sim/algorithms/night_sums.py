"""Sums over the pixels of a night of frames: products of bands, background and errors of the model, frame by frame.

All frames are summed at once, in pieces of rows that stay in the cache of the processor. Terms of a frame are the
bands, the background of second degree, and the errors of the envelope (`Envelope`), in this order. Of the last only
those are summed in a piece that are not 0 there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..array_types import FloatArray
from ..compiled import kernel, subkernel
from .night_levels import background_terms
from .sky_model_error import Envelope
from .smooth_field import Splines

PIECE_PX = 128  # Pixels of a piece of a row
BACKGROUND = 6  # Terms of a background of second degree, in the order of `background_terms`


@dataclass(frozen=True, eq=False)
class NightSums:
    """Frames of a night, and what of their sums depends on no model."""

    # weight, weighted: weights of the pixels, and these times the values, ``(ny, F, nx)``
    weight: FloatArray
    weighted: FloatArray
    squares: FloatArray  # weighted sums of the squares of the values, ``(F,)``
    # products of the terms of the background with each other and with the values, ``(F, 6, 7)``
    background: FloatArray

    @classmethod
    def of(cls, frames: Sequence[tuple[FloatArray, FloatArray]]) -> NightSums:
        """For values and weights of every frame."""
        weight = np.ascontiguousarray(np.stack([weight for _, weight in frames], axis=1))
        weighted = np.ascontiguousarray(np.stack([weight * value for value, weight in frames], axis=1))
        squares = np.array([float((weight * value**2).sum()) for value, weight in frames])
        terms = background_terms(frames[0][0].shape).reshape(BACKGROUND, -1)
        sums = []
        for value, each in frames:
            beside = np.concatenate([terms, value.reshape(1, -1)])
            sums.append((terms * each.ravel()) @ beside.T)
        return cls(weight, weighted, squares, np.stack(sums))

    def products(
        self, bands: FloatArray, thickness_um: FloatArray, envelope: Envelope | None
    ) -> tuple[FloatArray, FloatArray]:
        """Products of all terms with each other, ``(F, P, P)``, and with the values, ``(F, P)``."""
        told = _told(envelope, bands)
        frames, count, first = self.weight.shape[1], len(bands) + BACKGROUND + 2 * int(told[2]), len(bands)
        sums, side = np.zeros((count, count, frames)), np.zeros((count, frames))
        borders = _borders(bands.shape[2])
        _add_products(
            np.ascontiguousarray(bands), thickness_um, told, (self.weight, self.weighted), _powers(bands.shape[1:]),
            borders, sums, side,
        )  # fmt: skip
        sums = np.moveaxis(sums, 2, 0)
        upper = np.triu(sums) + np.swapaxes(np.triu(sums, 1), 1, 2)
        inner = slice(first, first + BACKGROUND)
        upper[:, inner, inner] = self.background[:, :, :BACKGROUND]
        moments = np.ascontiguousarray(side.T)
        moments[:, inner] = self.background[:, :, BACKGROUND]
        return upper, moments


@dataclass(frozen=True, eq=False)
class ShiftSums:
    """Sums with the change of the fringes of every frame with a shift."""

    # total, gradient: sums over frames of weight times the square of the change, and times change and residual,
    # ``(ny, nx)``
    total: FloatArray
    gradient: FloatArray
    cross: FloatArray  # products of weight, change and terms with the splines, ``(F, P, splines)``

    @classmethod
    def of(
        cls,
        sums: NightSums,
        terms: tuple[FloatArray, FloatArray, Envelope | None],
        level: FloatArray,
        change: FloatArray,
        splines: Splines,
    ) -> ShiftSums:
        """At the levels ``(F, P)`` of all terms.

        ``terms``: bands, thickness [µm], and envelope. ``change``: of the bands with the shift [1/µm].
        """
        bands, thickness_um, envelope = terms
        told, shape = _told(envelope, bands), bands.shape[1:]
        total, gradient = np.zeros(shape), np.zeros(shape)
        k, m = splines.rows.shape[1], splines.columns.shape[1]
        cross = np.zeros((level.shape[1], sums.weight.shape[1], k, m))
        row, column = (_first_of(side, splines.spans) for side in shape)
        _add_slopes(
            (np.ascontiguousarray(bands), np.ascontiguousarray(change), thickness_um),
            told, (sums.weight, sums.weighted), _powers(shape), np.ascontiguousarray(level.T),
            (splines.rows, splines.columns, row, column, _borders(shape[1], column)),
            (total, gradient), cross,
        )  # fmt: skip
        made = np.moveaxis(cross.reshape(level.shape[1], -1, k * m), 1, 0)
        return cls(total, gradient, made)


def _told(envelope: Envelope | None, bands: FloatArray) -> FloatArray:
    """First node, their distance and number, radians per µm, and amplitude of an envelope."""
    if envelope is None:
        return np.array([0.0, 1.0, 0.0, 0.0, 0.0])
    nodes = envelope.nodes_um
    return np.array(
        [nodes[0], nodes[1] - nodes[0], nodes.size, 2 * np.pi / envelope.order_um, envelope.amplitude(bands)]
    )


def _powers(shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Powers 0 to 2 of the places of rows and columns, as in `background_terms`."""
    rows, columns = (np.linspace(-1.0, 1.0, side) ** np.arange(3.0)[:, None] for side in shape)
    return rows, columns


def _first_of(side: int, spans: int) -> NDArray[np.int64]:
    """The first spline that is not 0, for every pixel along a side."""
    place = (np.arange(side) + 0.5) / side
    return np.minimum((place * spans).astype(np.int64), max(spans - 1, 0))


def _borders(width: int, column: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Where pieces of a row begin, and its end; within a piece the same splines are not 0."""
    begin = np.arange(0, width + PIECE_PX, PIECE_PX).clip(max=width)
    spans = np.zeros(0, dtype=int) if column is None else np.flatnonzero(np.diff(column)) + 1
    return np.unique(np.concatenate([begin, spans])).astype(np.int64)


@subkernel(relaxed=True)
def _fill(bands, thickness, told, place, piece, index, made):  # type: ignore[no-untyped-def]
    """Bands and errors of the envelope in a piece of a row; returned is how many of them there are."""
    y, begin, end = place
    size, number = end - begin, bands.shape[0]
    for band in range(number):
        index[band] = band
        for p in range(size):
            piece[band, p] = bands[band, y, begin + p]
    nodes = int(told[2])
    if nodes == 0:
        return number
    low, high = nodes - 1.0, 0.0
    for p in range(size):
        at = min(max((thickness[y, begin + p] - told[0]) / told[1], 0.0), nodes - 1.0)
        made[0, p] = at
        low, high = min(low, at), max(high, at)
        phase = told[3] * thickness[y, begin + p]
        made[1, p], made[2, p] = told[4] * np.cos(phase), told[4] * np.sin(phase)
    for node in range(int(low), min(int(high) + 2, nodes)):
        for part in range(2):
            index[number] = bands.shape[0] + BACKGROUND + part * nodes + node
            for p in range(size):
                piece[number, p] = max(0.0, 1.0 - abs(made[0, p] - node)) * made[1 + part, p]
            number += 1
    return number


@subkernel(relaxed=True)
def _near(images, columns, y, begin, size, near):  # type: ignore[no-untyped-def]
    """Weights, weighted values and powers of the columns in a piece, one below the other."""
    frames = images[0].shape[1]
    for frame in range(frames):
        for p in range(size):
            near[frame, p] = images[0][y, frame, begin + p]
            near[frames + frame, p] = images[1][y, frame, begin + p]
    for c in range(3):
        for p in range(size):
            near[2 * frames + c, p] = columns[c, begin + p]


@subkernel(relaxed=True)
def _dot(one, other, size):  # type: ignore[no-untyped-def]
    total = 0.0
    for p in range(size):
        total += one[p] * other[p]
    return total


@kernel(relaxed=True)
def _add_products(bands, thickness, told, images, powers, borders, sums, side):  # type: ignore[no-untyped-def]
    rows, columns = powers
    number_bands, frames = bands.shape[0], images[0].shape[1]
    most = number_bands + 2 * int(told[2])
    piece, made = np.zeros((most, PIECE_PX)), np.zeros((3, PIECE_PX))
    near, both = np.zeros((2 * frames + 3, PIECE_PX)), np.zeros(PIECE_PX)
    index = np.zeros(most, dtype=np.int64)
    for y in range(thickness.shape[0]):
        for border in range(borders.size - 1):
            begin, size = borders[border], borders[border + 1] - borders[border]
            number = _fill(bands, thickness, told, (y, begin, begin + size), piece, index, made)
            _near(images, columns, y, begin, size, near)
            for a in range(number):
                for b in range(a, number):
                    for p in range(size):
                        both[p] = piece[a, p] * piece[b, p]
                    first, last = min(index[a], index[b]), max(index[a], index[b])
                    for frame in range(frames):
                        sums[first, last, frame] += _dot(both, near[frame], size)
                for c in range(3):
                    for p in range(size):
                        both[p] = piece[a, p] * near[2 * frames + c, p]
                    for frame in range(frames):
                        total = _dot(both, near[frame], size)
                        for r in range(3 - c):
                            smooth = number_bands + 3 * r - r * (r - 1) // 2 + c
                            first, last = min(index[a], smooth), max(index[a], smooth)
                            sums[first, last, frame] += rows[r, y] * total
                for frame in range(frames):
                    side[index[a], frame] += _dot(piece[a], near[frames + frame], size)


@subkernel(relaxed=True)
def _add_cross(factor, row, columns, place, out):  # type: ignore[no-untyped-def]
    """A piece times the splines that are not 0 in it."""
    size, first_row, first_column = place
    for m in range(min(4, out.shape[1])):
        total = _dot(factor, columns[m], size)
        for k in range(min(4, out.shape[0])):
            out[first_row + k, first_column + m] += row[first_row + k] * total


@subkernel(relaxed=True)
def _heights(level, rows, y, frame, number_bands, height):  # type: ignore[no-untyped-def]
    """Background of a frame in a row, as factors of the powers of the columns."""
    for c in range(3):
        height[c] = 0.0
        for r in range(3 - c):
            height[c] += level[number_bands + 3 * r - r * (r - 1) // 2 + c, frame] * rows[r, y]


@subkernel(relaxed=True)
def _own(piece, index, number, level, places, near, own):  # type: ignore[no-untyped-def]
    """Change of a frame with the shift, and what its terms make of it, in a piece."""
    frame, number_bands, size, height = places
    own[:, :size] = 0.0
    for a in range(number):
        factor = level[index[a], frame]
        for p in range(size):
            own[1, p] += factor * piece[a, p]
        if a < number_bands:
            for p in range(size):
                own[0, p] += factor * near[-number_bands + a, p]
    for c in range(3):
        for p in range(size):
            own[1, p] += height[c] * near[-number_bands - 3 + c, p]


@kernel(relaxed=True)
def _add_slopes(fields, told, images, powers, level, splines, out, cross):  # type: ignore[no-untyped-def]
    bands, change, thickness = fields
    rows, columns = powers
    spline_rows, spline_columns, first_row, first_column, borders = splines
    number_bands, frames = bands.shape[0], images[0].shape[1]
    most = number_bands + 2 * int(told[2])
    piece, made = np.zeros((most, PIECE_PX)), np.zeros((3, PIECE_PX))
    near, both = np.zeros((2 * frames + 3 + number_bands, PIECE_PX)), np.zeros((4, PIECE_PX))
    index, own, along = np.zeros(most, dtype=np.int64), np.zeros((2, PIECE_PX)), np.zeros((4, PIECE_PX))
    height = np.zeros(3)
    for y in range(thickness.shape[0]):
        for border in range(borders.size - 1):
            begin, size = borders[border], borders[border + 1] - borders[border]
            number = _fill(bands, thickness, told, (y, begin, begin + size), piece, index, made)
            _near(images, columns, y, begin, size, near)
            place = (size, first_row[y], first_column[begin])
            for p in range(size):
                for band in range(number_bands):
                    near[2 * frames + 3 + band, p] = change[band, y, begin + p]
                for m in range(min(4, cross.shape[3])):
                    along[m, p] = spline_columns[begin + p, place[2] + m]
            for frame in range(frames):
                _heights(level, rows, y, frame, number_bands, height)
                _own(piece, index, number, level, (frame, number_bands, size, height), near, own)
                for p in range(size):
                    slope = own[0, p]
                    own[0, p] = near[frame, p] * slope
                    out[0][y, begin + p] += own[0, p] * slope
                    out[1][y, begin + p] += slope * (near[frames + frame, p] - near[frame, p] * own[1, p])
                for a in range(number):
                    for p in range(size):
                        both[0, p] = own[0, p] * piece[a, p]
                    _add_cross(both[0], spline_rows[y], along, place, cross[index[a], frame])
                for c in range(3):
                    for p in range(size):
                        both[0, p] = own[0, p] * near[2 * frames + c, p]
                    for r in range(3 - c):
                        both[1, :size] = rows[r, y] * both[0, :size]
                        smooth = number_bands + 3 * r - r * (r - 1) // 2 + c
                        _add_cross(both[1], spline_rows[y], along, place, cross[smooth, frame])
