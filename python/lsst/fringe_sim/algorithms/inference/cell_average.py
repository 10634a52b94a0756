"""The response averaged over a cell: a few places in thickness stand for all of its area."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.special import erf

from ...array_types import BoolArray, FloatArray
from ...compiled import contiguous, kernel

LEAST_SPREAD_UM2 = 1e-14  # Variance of the thickness in a cell that is rounding [µm²]

STIFFNESSES, BISECTIONS = (1e-4, 1e10), 30
"""Least and largest weight of third differences, and how often the range is halved."""

LEAST_PART = 1e-6  # Part of a cell that is none
UNIFORM = 1.8  # Fourth moment of an even distribution over its squared variance

BLURRED_PLACES = 7  # Places that stand for a blur: a Gaussian of 2 rad rms of fringe phase is right to 1e-3

WIDE_UM, GRID_UM, REACH = 0.04, 0.024, 4.0
"""Rms of the thickness that a blur brings to a cell, a seventh of a fringe order, from which on it is that of a grid
of places up to four of its radii away; these are gathered in steps of a twelfth of an order."""

MOST_BENT = 0.4, 0.06
"""Largest skewness over 6 and excess over 24 of them; where fringes are at rest they mean nothing."""


@dataclass(frozen=True, eq=False)
class CellShape:
    """What the thickness does within each of N cells: its change and its curvature.

    A cell is the sum of its area and of a blur, which are independent. The moments of the thickness follow
    from theirs to the second order of the curvature.
    """

    gradient: FloatArray  # (2, N): change along rows and columns [µm/px]
    hessian: FloatArray  # (3, N): second derivatives yy, yx, xx [µm/px²]
    cell_px: int
    area: bool = True  # whether pixels see all of their area; otherwise the point in their middle
    edge_px: FloatArray | None = (
        None  # (2, N): from the nearest edges, at which blurs are mirrored; far if absent
    )

    @classmethod
    def of_field(
        cls, thickness_um: FloatArray, cell_px: int, error_um: float = 0.0, *, area: bool = True
    ) -> CellShape:
        """From the thickness of all cells ``(ny, nx)``, through a spline that follows it but for its error."""
        rows, columns = (cell_px * np.arange(size, dtype=float) for size in thickness_um.shape)
        away = [
            np.where(own <= own[::-1], own + 0.5 * cell_px, -own[::-1] - 0.5 * cell_px)
            for own in (rows, columns)
        ]
        edge = np.stack([axis.ravel() for axis in np.meshgrid(*away, indexing="ij")])
        if min(thickness_um.shape) < 4:
            empty = np.zeros((3, thickness_um.size))
            return cls(empty[:2], empty, cell_px, area, edge)
        spline = RectBivariateSpline(rows, columns, _smoothed(thickness_um, error_um))

        def derivative(dy: int, dx: int) -> FloatArray:
            return np.asarray(spline(rows, columns, dx=dy, dy=dx)).ravel()

        first = np.stack([derivative(1, 0), derivative(0, 1)])
        return cls(
            first, np.stack([derivative(2, 0), derivative(1, 1), derivative(0, 2)]), cell_px, area, edge
        )

    def of_cells(self, inside: BoolArray) -> CellShape:
        """The same of those cells of which ``inside`` (N,) is true."""
        edge = None if self.edge_px is None else self.edge_px[:, inside]
        return replace(self, gradient=self.gradient[:, inside], hessian=self.hessian[:, inside], edge_px=edge)

    def nodes(self, blur_px: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Places of every cell about its own thickness [µm], and their weights; each ``(M, N)``.

        ``blur_px``: rms radius along one axis of a Gaussian blur. The places have the second, third and fourth moment
        of the thickness. Without a blur there are three: of an even slope those of Gauss and Legendre. A blur
        reaches over more of a fringe order and takes seven.
        """
        return self._unblurred if blur_px == 0.0 else self._blurred(blur_px)

    def _blurred(self, blur_px: float) -> tuple[FloatArray, FloatArray]:
        moments = self._moments(blur_px)
        places, shares = _bent_places(*moments)
        wide = np.flatnonzero(moments[1] > WIDE_UM**2)
        if not wide.size:
            return places, shares
        own_places, own_shares = _gridded(*self._of_blur(blur_px, wide))
        more = max(len(own_places) - len(places), 0)
        places, shares = (np.pad(part, ((0, more), (0, 0))) for part in (places, shares))
        places[:, wide], shares[:, wide] = 0.0, 0.0
        places[: len(own_places), wide], shares[: len(own_places), wide] = own_places, own_shares
        return places, shares

    def _of_blur(self, blur_px: float, cells: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Thickness over that of some cells at the places of a grid, ``(M, n)``, and the weight of each, ``(M,)``.

        A sum over an even grid is exact for a Gaussian but for waves shorter than twice its step.
        """
        radius = math.sqrt(blur_px**2 + (self.cell_px**2 - (0.0 if self.area else 1.0)) / 12.0)
        step = min(float(self.cell_px), 0.5 * radius)
        reach = math.ceil(REACH * radius / step)
        y, x = step * np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
        inside = np.hypot(y, x) <= REACH * radius
        y, x = y[inside], x[inside]
        weight = np.exp(-0.5 * (y**2 + x**2) / radius**2)
        away = np.repeat(np.stack([y, x])[:, :, np.newaxis], cells.size, axis=2)
        if self.edge_px is not None:
            edge = self.edge_px[:, np.newaxis, cells]
            beyond = np.where(edge > 0.0, away < -edge, away > -edge)
            away = np.where(beyond, -2.0 * edge - away, away)
        (down, along), (yy, yx, xx) = self.gradient[:, cells], self.hessian[:, cells]
        rise, run = away
        thickness = down * rise + along * run + 0.5 * (yy * rise**2 + 2.0 * yx * rise * run + xx * run**2)
        return thickness, weight / weight.sum()

    @cached_property
    def _unblurred(self) -> tuple[FloatArray, FloatArray]:
        return _three_places(*self._moments(0.0))

    def nodes_of_part(
        self, part: FloatArray, moments: FloatArray, blur_px: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """The same as `nodes` of a part of every cell, such as the one that lies on an island.

        ``part`` (N,): share of the area. ``moments`` (5, N): means over the cell of y, x, y², yx and x² where the
        part is and of 0 elsewhere, from the middle of the cell and in units of its side. Where there is a blur, both
        are means over all that it brings to the cell. A cell that is all or none of the part has the places of the
        whole.
        """
        places, shares = self.nodes(blur_px)
        crossed = np.flatnonzero((part > LEAST_PART) & (part < 1.0 - LEAST_PART))
        if not crossed.size or not (self.area or blur_px):
            return places, shares
        y, x, *square = moments[:, crossed] / part[crossed] * self.cell_px
        yy, yx, xx = (self.cell_px * each for each in square)
        down, along = self.gradient[:, crossed]
        bent = self.hessian[:, crossed]
        mean = down * y + along * x
        second = down**2 * yy + 2.0 * down * along * yx + along**2 * xx - mean**2
        second = np.maximum(second, 0.0)
        mean = mean + 0.5 * (bent[0] * yy + 2.0 * bent[1] * yx + bent[2] * xx)
        blurred = np.minimum(blur_px**2 * (down**2 + along**2), second)
        fourth = 3.0 * second**2 - (3.0 - UNIFORM) * (second - blurred) ** 2
        places, shares = places.copy(), shares.copy()
        among = _bent_places if blur_px else _three_places
        own = among(mean, second, np.zeros_like(mean), fourth)
        for values, new in zip((places, shares), own, strict=True):
            values[:, crossed] = 0.0
            values[: len(new), crossed] = new
        return places, shares

    def _moments(self, blur_px: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Mean, and second to fourth moment of the thickness about that, from the place in the middle."""
        side = float(self.cell_px)
        point = 0.0 if self.area else 1.0
        shift, blur = self._blur(blur_px)
        rise, run = (side**2 - point) / 12.0 + blur
        cumulant = -(side**4 - point) / 120.0
        down, along = self.gradient
        yy, yx, xx = self.hessian
        mean = 0.5 * (rise * yy + run * xx) + (shift * self.gradient).sum(axis=0)
        second = rise * down**2 + run * along**2
        second += 0.5 * (rise**2 * yy**2 + 2.0 * rise * run * yx**2 + run**2 * xx**2)
        second += 0.25 * cumulant * (yy**2 + xx**2)
        own = 0.5 * ((2.0 * rise**2 + cumulant) * down**2 * yy + (2.0 * run**2 + cumulant) * along**2 * xx)
        third = 3.0 * (own + 2.0 * rise * run * down * along * yx)
        fourth = 3.0 * second**2 + cumulant * (down**4 + along**4)
        return mean, second, third, fourth

    def _blur(self, blur_px: float) -> tuple[FloatArray, FloatArray]:
        """Mean and variance along both axes of a blur that is mirrored at the edges, ``(2, N)`` or ``(2, 1)``."""
        even = np.full((2, 1), blur_px**2)
        if self.edge_px is None or blur_px == 0.0:
            return np.zeros((2, 1)), even
        reach = np.abs(self.edge_px) / blur_px
        mean = math.sqrt(2.0 / math.pi) * np.exp(-0.5 * reach**2) + reach * erf(reach / math.sqrt(2.0))
        return blur_px * np.sign(self.edge_px) * (mean - reach), blur_px**2 * (reach**2 + 1.0 - mean**2)


def _gridded(thickness_um: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same spread over an even grid of thickness, ``(M, n)``: each place by its four neighbours (Lagrange)."""
    number = thickness_um.shape[1]
    first = np.floor(thickness_um / GRID_UM).astype(np.intp)
    low = first.min(axis=0) - 1
    x, rows = thickness_um / GRID_UM - first, int((first - low).max()) + 3
    each = (
        -x * (x - 1.0) * (x - 2.0) / 6.0, (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0,
        -(x + 1.0) * x * (x - 2.0) / 2.0, (x + 1.0) * x * (x - 1.0) / 6.0,
    )  # fmt: skip
    shares = np.zeros(rows * number)
    cells = np.arange(number)
    for shift, part in enumerate(each):
        where = (first - low - 1 + shift) * number + cells
        shares += np.bincount(where.ravel(), (part * weight[:, np.newaxis]).ravel(), rows * number)
    return GRID_UM * (low + np.arange(rows)[:, np.newaxis]), shares.reshape(rows, number)


def _bent_places(
    shift: FloatArray, second: FloatArray, third: FloatArray, fourth: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Places of Gauss and Hermite, bent to the third and fourth cumulant (Cornish & Fisher 1938)."""
    second = np.maximum(second, LEAST_SPREAD_UM2)
    skew = np.clip(third / (6.0 * second**1.5), -MOST_BENT[0], MOST_BENT[0])
    tail = np.clip((fourth / second**2 - 3.0) / 24.0 - 2.0 * skew**2, -MOST_BENT[1], MOST_BENT[1])
    even = np.sqrt(1.0 - 2.0 * skew**2 - 6.0 * tail**2)
    x, share = hermegauss(BLURRED_PLACES)
    x = x[:, np.newaxis]
    places = np.sqrt(second) * (even * x + skew * (x**2 - 1.0) + tail * (x**3 - 3.0 * x))
    shares = np.repeat((share / share.sum())[:, np.newaxis], places.shape[1], axis=1)
    return places + shift, shares


def _three_places(
    shift: FloatArray, second: FloatArray, third: FloatArray, fourth: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Three places and their weights, ``(3, N)``, with a mean and moments about that."""
    some = second > LEAST_SPREAD_UM2
    safe = np.where(some, second, 1.0)
    skew = np.where(some, third / safe, 0.0)
    tail = np.where(some, fourth / safe, 0.0)
    skew = np.clip(skew, -np.sqrt(0.25 * tail), np.sqrt(0.25 * tail))
    product = tail - skew**2  # of the two distances on both sides
    width = np.sqrt(skew**2 + 4.0 * product)
    upper, lower = 0.5 * (width + skew), 0.5 * (width - skew)
    shares = [
        np.divide(second, width * side, out=np.zeros_like(width), where=some) for side in (upper, lower)
    ]
    places = np.stack([np.zeros_like(width), upper, -lower]) + shift
    return places, np.stack([1.0 - shares[0] - shares[1], *shares])


def _smoothed(field: FloatArray, error: float) -> FloatArray:
    """The field ``(ny, nx)`` of least squared third differences that departs from another by an error rms.

    The stiffness is found by bisection: both axes have the eigenvectors of their differences for modes, of which each
    is made smaller by a factor of its own. (A spline of few knots with that departure, as FITPACK has it, may swing
    by orders between its knots.)
    """
    (rows, down), (columns, along) = (_modes(size) for size in field.shape)
    modes, bends = down.T @ field @ along, rows[:, np.newaxis] + columns
    low, high = STIFFNESSES
    for _ in range(BISECTIONS if error > 0.0 else 0):
        middle = math.sqrt(low * high)
        left = modes * (1.0 - 1.0 / (1.0 + middle * bends))
        low, high = (middle, high) if (left**2).mean() < error**2 else (low, middle)
    return np.asarray(down @ (modes / (1.0 + low * bends)) @ along.T) if error > 0.0 else field


def _modes(size: int) -> tuple[FloatArray, FloatArray]:
    """Squared third differences of the modes of an axis, and the modes, which are of unit length."""
    differences = np.diff(np.eye(size), 3, axis=0)
    bends, modes = np.linalg.eigh(differences.T @ differences)
    bends[:3] = 0.0  # parabolas have none
    return bends, modes


def look_up(
    table: FloatArray,
    start_um: float,
    step_um: float,
    thickness_um: FloatArray,
    nodes: tuple[FloatArray, ...],
) -> tuple[FloatArray, FloatArray]:
    """Value and derivative of the rows of a table ``(W, D)``, averaged over the nodes of N cells; each ``(W, N)``."""
    value, slope = np.zeros((2, len(table), thickness_um.size))
    column = contiguous(table.T, float)
    _look_up(column, start_um, step_um, contiguous(thickness_um, float), *nodes, value, slope)
    return value, slope


@kernel
def _look_up(  # type: ignore[no-untyped-def]
    column, start, step, thickness, away, share, value, slope
):  # pragma: no cover - compiled
    waves = column.shape[1]
    own, steep = np.zeros(waves), np.zeros(waves)
    for i in range(thickness.size):
        own[:] = 0.0
        steep[:] = 0.0
        for j in range(away.shape[0]):
            q = share[j, i]
            if q == 0.0:
                continue
            place = min(max((thickness[i] + away[j, i] - start) / step, 1.0), column.shape[0] - 2.0)
            k = min(math.floor(place), column.shape[0] - 3)
            x = place - k
            for w in range(waves):
                a, b, c, d = column[k - 1, w], column[k, w], column[k + 1, w], column[k + 2, w]
                c1 = c - a / 3.0 - b / 2.0 - d / 6.0
                c2 = 0.5 * (a + c) - b
                c3 = (d - a) / 6.0 + 0.5 * (b - c)
                own[w] += q * (b + x * (c1 + x * (c2 + x * c3)))
                steep[w] += q * (c1 + x * (2.0 * c2 + 3.0 * x * c3)) / step
        for w in range(waves):
            value[w, i] = own[w]
            slope[w, i] = steep[w]
