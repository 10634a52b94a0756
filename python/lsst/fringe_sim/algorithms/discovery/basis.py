"""The thickness field as a nuisance: a smooth spline over the sensor, or one free value per cell."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

from ...array_types import FloatArray
from ...compiled import kernel

RIDGE = 1e-8  # Smallest curvature relative to the largest; keeps coefficients without data where they are

STIFFNESS = 1e-6
"""Curvature along differences of neighbouring coefficients, over the largest, that continues a fitted field."""


class NormalMatrix(ABC):
    """Curvature of χ² in the coefficients of a field."""

    @abstractmethod
    def solve(self, right: FloatArray) -> FloatArray:
        """Apply the inverse to the columns of ``right``, shape ``(M, K)``."""


class FieldBasis(ABC):
    """Linear parametrisation of a field on the cells."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of coefficients."""

    @abstractmethod
    def expand(self, coefficients: FloatArray) -> FloatArray:
        """Field ``(ny, nx)`` of the given coefficients."""

    @abstractmethod
    def gather(self, fields: FloatArray) -> FloatArray:
        """Transpose of `expand` for K fields: ``(K, ny, nx)`` to ``(M, K)``."""

    @property
    @abstractmethod
    def matrix(self) -> sparse.csr_array:
        """`expand` as a sparse matrix, one row per cell."""

    @abstractmethod
    def normal_matrix(self, curvature: FloatArray, prior: FloatArray | float = 0.0) -> NormalMatrix:
        """Normal matrix for the curvature ``(ny, nx)`` of the cells; ``prior`` is the precision of a coefficient."""

    @abstractmethod
    def fit(self, field: FloatArray, weight: FloatArray) -> FloatArray:
        """Weighted least-squares coefficients of a field, which must not be NaN anywhere."""

    def gather_changes(self, fields: FloatArray) -> FloatArray:
        """Transpose of the change per cell along rows and columns: ``(2, K, ny, nx)`` to ``(M, K)``."""
        raise NotImplementedError

    def normal_matrix_with_changes(
        self, curvature: FloatArray, prior: FloatArray | float = 0.0
    ) -> NormalMatrix:
        """Normal matrix where the data see the field and its changes per cell along rows and columns.

        ``curvature`` is that in the three of them, ``(3, 3, ny, nx)``.
        """
        raise NotImplementedError

    @property
    def sees_changes(self) -> bool:
        """Whether there are a `gather_changes` and a `normal_matrix_with_changes`."""
        return False


@dataclass(frozen=True, eq=False)
class SplineBasis(FieldBasis):
    """Tensor product of uniform cubic B-splines."""

    # along_y, along_x (ny, my) and (nx, mx): basis functions at the rows and columns of cells
    along_y: FloatArray
    along_x: FloatArray

    @classmethod
    def of_grid(cls, shape: tuple[int, int], spacing: float) -> SplineBasis:
        """Splines with knots about every ``spacing`` cells."""
        return cls(*(_uniform_splines(size, spacing) for size in shape))

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.along_y.shape[1] * self.along_x.shape[1]

    def expand(self, coefficients: FloatArray) -> FloatArray:
        """Field on the cells; see `FieldBasis.expand`."""
        square = coefficients.reshape(self.along_y.shape[1], self.along_x.shape[1])
        return self.along_y @ square @ self.along_x.T

    def gather(self, fields: FloatArray) -> FloatArray:
        """Sums over cells; see `FieldBasis.gather`."""
        partial = np.matmul(self.along_y.T, np.matmul(fields, self.along_x))
        return np.ascontiguousarray(partial.reshape(len(fields), -1).T)

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """Outer product of both directions; see `FieldBasis.matrix`."""
        return sparse.kron(sparse.csr_array(self.along_y), sparse.csr_array(self.along_x), format="csr")

    def fit(self, field: FloatArray, weight: FloatArray) -> FloatArray:
        """Coefficients that continue the field evenly where it has no weight; see `FieldBasis.fit`.

        What lies there decides on the slope of the field at the rim.
        """
        middle = float(np.average(field, weights=weight)) if weight.any() else float(np.mean(field))
        right = self.gather((weight * (field - middle))[np.newaxis])
        return np.asarray(middle + self._normal(weight, 0.0, STIFFNESS).solve(right)[:, 0])

    def normal_matrix(self, curvature: FloatArray, prior: FloatArray | float = 0.0) -> NormalMatrix:
        """Banded matrix; see `FieldBasis.normal_matrix`."""
        return self._normal(curvature, prior, 0.0)

    @property
    def sees_changes(self) -> bool:
        """See `FieldBasis.sees_changes`."""
        return min(len(self.along_y), len(self.along_x)) > 1

    @cached_property
    def _changes(self) -> tuple[SplineBasis, SplineBasis]:
        """Change per cell of the basis functions along rows and columns."""
        return (
            SplineBasis(_change_within(self.along_y), self.along_x),
            SplineBasis(self.along_y, _change_within(self.along_x)),
        )

    def gather_changes(self, fields: FloatArray) -> FloatArray:
        """Sums over cells; see `FieldBasis.gather_changes`."""
        return np.asarray(sum(basis.gather(part) for basis, part in zip(self._changes, fields, strict=True)))

    def normal_matrix_with_changes(
        self, curvature: FloatArray, prior: FloatArray | float = 0.0
    ) -> NormalMatrix:
        """Banded matrix; see `FieldBasis.normal_matrix_with_changes`."""
        parts = [basis.matrix for basis in (self, *self._changes)]
        weighted = [
            sum(sparse.diags_array(curvature[row, column].ravel()) @ parts[column] for column in range(3))
            for row in range(3)
        ]
        normal = sum(part.T @ product for part, product in zip(parts, weighted, strict=True))
        rows, columns = self.along_y.shape[1], self.along_x.shape[1]
        reach = (min(4, rows) - 1) * columns + min(4, columns) - 1
        band = np.zeros((reach + 1, rows * columns))
        for away in range(reach + 1):
            diagonal = normal.diagonal(-away)
            band[away, : len(diagonal)] = diagonal
        return self._factored(band, prior)

    def _normal(self, curvature: FloatArray, prior: FloatArray | float, stiffness: float) -> NormalMatrix:
        first_y, first_x = _first_nonzero(self.along_y), _first_nonzero(self.along_x)
        band = _assemble(self.along_y, self.along_x, first_y, first_x, np.ascontiguousarray(curvature))
        return self._factored(band, prior, stiffness)

    def _factored(self, band: FloatArray, prior: FloatArray | float, stiffness: float = 0.0) -> NormalMatrix:
        """Matrix of a lower band, which is overwritten."""
        largest = max(float(band[0].max()), 1e-300)
        band[0] += RIDGE * largest + prior
        if stiffness:
            _stiffen(band, self.along_y.shape[1], self.along_x.shape[1], stiffness * largest)
        return _Banded(cholesky_banded(band, lower=True, overwrite_ab=True))


@dataclass(frozen=True, eq=False)
class CellBasis(FieldBasis):
    """One coefficient per cell."""

    shape: tuple[int, int]  # rows and columns of cells

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.shape[0] * self.shape[1]

    def expand(self, coefficients: FloatArray) -> FloatArray:
        """Field on the cells; see `FieldBasis.expand`."""
        return coefficients.reshape(self.shape)

    def fit(self, field: FloatArray, weight: FloatArray) -> FloatArray:
        """The field itself; cells without weight keep it too, see `FieldBasis.fit`."""
        return np.array(field, dtype=np.float64).ravel()

    def gather(self, fields: FloatArray) -> FloatArray:
        """Cells themselves; see `FieldBasis.gather`."""
        return np.ascontiguousarray(fields.reshape(len(fields), -1).T)

    @property
    def matrix(self) -> sparse.csr_array:
        """Unit matrix; see `FieldBasis.matrix`."""
        return sparse.eye_array(self.size, format="csr")

    def normal_matrix(self, curvature: FloatArray, prior: FloatArray | float = 0.0) -> NormalMatrix:
        """Diagonal matrix; see `FieldBasis.normal_matrix`."""
        diagonal = curvature.ravel() + prior
        return _Diagonal(diagonal + RIDGE * max(float(diagonal.max()), 1e-300))


def _stiffen(band: FloatArray, rows: int, columns: int, stiffness: float) -> None:
    """Add the squares of the differences of neighbouring coefficients to the lower band of a matrix."""
    number = np.arange(rows * columns).reshape(rows, columns)
    for first, distance in ((number[:, :-1].ravel(), 1), (number[:-1].ravel(), columns)):
        band[0, first] += stiffness
        band[0, first + distance] += stiffness
        band[distance, first] -= stiffness


@dataclass(frozen=True, eq=False)
class _Banded(NormalMatrix):
    factor: FloatArray

    def solve(self, right: FloatArray) -> FloatArray:
        solution: FloatArray = cho_solve_banded((self.factor, True), right)
        return solution


@dataclass(frozen=True, eq=False)
class _Diagonal(NormalMatrix):
    diagonal: FloatArray

    def solve(self, right: FloatArray) -> FloatArray:
        return right / self.diagonal[:, np.newaxis]


def _uniform_splines(size: int, spacing: float) -> FloatArray:
    if size == 1:
        return np.ones((1, 1))
    intervals = max(1, round((size - 1) / spacing))
    degree = min(3, size - 1)
    inner = np.linspace(0.0, size - 1.0, intervals + 1)
    step = inner[1] - inner[0]
    knots = inner[0] + step * np.arange(-degree, intervals + degree + 1)
    # Rounding may leave the last knot of the interior a little before the last cell.
    at = np.clip(np.arange(size, dtype=float), knots[degree], knots[-degree - 1])
    return np.asarray(BSpline.design_matrix(at, knots, degree).toarray())


def _change_within(along: FloatArray) -> FloatArray:
    """Change of the basis functions per cell where they are not 0, so that the normal matrix is as narrow."""
    return np.where(along != 0.0, np.gradient(along, axis=0), 0.0)


def _first_nonzero(basis: FloatArray) -> NDArray[np.int64]:
    first: NDArray[np.int64] = np.argmax(basis != 0.0, axis=1)
    return first


@kernel
def _assemble(
    along_y: FloatArray,
    along_x: FloatArray,
    first_y: NDArray[np.int64],
    first_x: NDArray[np.int64],
    curvature: FloatArray,
) -> FloatArray:  # pragma: no cover - compiled
    """Lower band of the normal matrix; coefficients are numbered row by row."""
    ny, my = along_y.shape
    nx, mx = along_x.shape
    reach_y, reach_x = min(4, my), min(4, mx)
    bandwidth = (reach_y - 1) * mx + reach_x - 1
    band = np.zeros((bandwidth + 1, my * mx))
    row = np.zeros((mx, reach_x))
    for iy in range(ny):
        # Sum over the columns of one row of cells first: the y factors are common to it.
        row[:] = 0.0
        for ix in range(nx):
            h = curvature[iy, ix]
            if h == 0.0:
                continue
            fx = min(first_x[ix], mx - reach_x)
            for a in range(reach_x):
                wa = h * along_x[ix, fx + a]
                for b in range(a + 1):
                    row[fx + b, a - b] += wa * along_x[ix, fx + b]
        fy = min(first_y[iy], my - reach_y)
        for p in range(reach_y):
            for q in range(reach_y):
                wy = along_y[iy, fy + p] * along_y[iy, fy + q]
                if wy == 0.0:
                    continue
                for jx in range(mx):
                    for shift in range(min(reach_x, mx - jx)):
                        value = wy * row[jx, shift]
                        # element ((fy+p, jx+shift), (fy+q, jx)), kept once in the lower triangle
                        i = (fy + p) * mx + jx + shift
                        j = (fy + q) * mx + jx
                        if i >= j:
                            band[i - j, j] += value
                        if shift > 0:
                            i2 = (fy + p) * mx + jx
                            j2 = (fy + q) * mx + jx + shift
                            if i2 >= j2:
                                band[i2 - j2, j2] += value
    return band
