"""Joint fit of effects, levels and thickness field to the cells, and the projections that go with it."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ...array_types import BoolArray, FloatArray
from ...effects import Effect, Parameter
from .basis import FieldBasis, NormalMatrix
from .cells import CellData
from .comparison import chi2_with_free_levels
from .forward import Forward, Prediction

PRIOR_WIDTH = 3.0
"""Width of the weak Cauchy prior of a parameter in units of its prior scale: what is large is not drawn to null."""

LARGEST_PHASE_STEP_UM = 0.06  # Largest step of the fringe phase, as a thickness: a fifth of a fringe order
WIDE_BLUR = 0.5  # Rms radius of a blur [cells] from which on a cell sees the thickness beside it

MOST_ITERATIONS = 25
CONVERGED = 0.02  # Change of χ² at which a fit stops

FAR_BEHIND = 100.0
CATCHING_UP = 75.0
FEWEST_ITERATIONS = 4
STEEPER = 4
"""Distance in χ² from which on a fit may be behind a better one for good, the steps that it would have to catch up,
those that it gets in any case, and by how much those that are left to it may bring more than the last one did."""


@dataclass(frozen=True)
class Coordinate:
    """A parameter of an effect in the coordinate in which its onset is linear.

    The coordinate is 0 at null. An effect that starts with the square of its parameter (roughness, aperture) is
    followed in the square, so that data and coordinate are in proportion near the null.
    """

    # effect, parameter: whose coordinate it is
    effect: str
    parameter: str
    # null, low, high, scale: null value, bounds and prior scale of the parameter
    null: float
    low: float
    high: float
    scale: float
    quadratic: bool  # whether the coordinate is the square of the departure from null
    unit: str = ""  # unit of the parameter
    # Distance of neighbouring minima of the misfit in the coordinate; 0 if there is only one
    neighbour: float = 0.0
    of_one_exposure: bool = False  # whether it concerns the exposures at one wavelength only
    place: bool = False  # whether it says where an effect is; see `SearchHints`
    step: float = 0.0  # largest step of a derivative; 0 for a thousandth of the scale
    refinement: int = 0  # 0 for what the effect surely has; see `SearchHints`
    exchangeable: bool = False  # whether it is one of many draws about null; see `SearchHints`

    @property
    def key(self) -> str:
        """``name.parameter``."""
        return f"{self.effect}.{self.parameter}"

    @property
    def unit_step(self) -> float:
        """Coordinate of a departure by one prior scale."""
        return self.scale**2 if self.quadratic else self.scale

    @property
    def one_sided(self) -> bool:
        """Whether the null is at a bound."""
        return self.quadratic or self.null <= self.low or self.null >= self.high

    def value(self, coordinate: float) -> float:
        """Value of the parameter, within its bounds."""
        if self.quadratic:
            departure = np.sqrt(max(coordinate, 0.0))
            departure = departure if self.null < self.high else -departure
        else:
            departure = coordinate
        return float(np.clip(self.null + departure, self.low, self.high))

    def departure(self, coordinate: float) -> float:
        """Distance of a value from null in prior scales."""
        return abs(self.value(coordinate) - self.null) / self.scale

    def coordinate(self, value: float) -> float:
        """Coordinate of a value."""
        departure = value - self.null
        return departure**2 if self.quadratic else departure

    def clip(self, coordinate: float) -> float:
        """Nearest coordinate within the bounds."""
        return self.coordinate(self.value(coordinate))

    def is_inside(self, coordinate: float) -> bool:
        """Whether a coordinate is within the bounds, but for rounding."""
        return abs(self.clip(coordinate) - coordinate) <= 1e-9 * max(abs(coordinate), self.unit_step)

    def value_sigma(self, coordinate: float, sigma: float) -> float:
        """Uncertainty of the value from that of the coordinate."""
        if not self.quadratic:
            return sigma
        upper = self.value(coordinate + sigma)
        lower = self.value(max(coordinate - sigma, 0.0))
        return 0.5 * abs(upper - lower) if coordinate > sigma else abs(upper - self.value(coordinate))


def coordinates_of(effect: Effect, forward: Forward, thickness_um: FloatArray) -> tuple[Coordinate, ...]:
    """Coordinates of an effect; how it starts is found by trying."""
    nulls, hints = effect.null_values(forward.model.base_system), effect.search
    repeats = (
        hints.repeats_after if forward.exposures is None else {**hints.repeats_on_sky, **hints.repeats_after}
    )
    found = []
    for parameter in effect.seen_parameters(forward.geometry):
        name = parameter.name
        null, (low, high) = nulls[name], effect.bounds_on(parameter, forward.geometry)
        one_sided = null <= low or null >= high
        quadratic = one_sided and _starts_quadratically(effect.name, parameter, null, forward, thickness_um)
        found.append(
            Coordinate(
                effect.name, name, null, low, high, parameter.prior_scale, quadratic, parameter.unit,
                repeats.get(name, 0.0), parameter.wavelength_nm > 0.0, name in hints.places,
                hints.steps.get(name, 0.0), hints.refinements.get(name, 0), hints.exchangeable,
            )
        )  # fmt: skip
    return tuple(found)


def _starts_quadratically(
    effect: str, parameter: Parameter, null: float, forward: Forward, thickness: FloatArray
) -> bool:
    sign = 1.0 if null < parameter.bounds[1] else -1.0
    small, large = (
        np.abs(forward.change({}, {f"{effect}.{parameter.name}": value}, thickness)).max()
        for value in (null + sign * size * parameter.prior_scale for size in (0.05, 0.1))
    )
    return bool(large > 3.0 * small)


@dataclass(frozen=True, eq=False)
class Whitener:
    """Turns differences of cells into numbers with unit noise, response scatter included.

    Noise of a cell: independent with variance ``1 / weight``, and a factor on its response common to all
    wavelengths with variance ``scatter²``.
    """

    root: FloatArray
    direction: FloatArray
    gamma: FloatArray

    @classmethod
    def of_cells(cls, cells: CellData, reference: FloatArray) -> Whitener:
        """Whitener for the noise of ``cells`` about the model ``reference``."""
        root = np.sqrt(cells.weight)
        direction = root * reference
        square = (direction**2).sum(axis=0)
        gamma = np.zeros(square.shape)
        if cells.response_scatter > 0.0:
            share = square / (1.0 / cells.response_scatter**2 + square)
            np.divide(1.0 - np.sqrt(1.0 - share), square, out=gamma, where=square > 0.0)
        return cls(root, direction, gamma)

    def __call__(self, values: FloatArray) -> FloatArray:
        """Whitened ``(..., W, ny, nx)``."""
        scaled = self.root * values
        if not self.gamma.any():
            return scaled
        return self.decorrelate(scaled)

    def decorrelate(self, scaled: FloatArray) -> FloatArray:
        """Symmetric part that takes the common response out of values in units of their own noise."""
        if not self.gamma.any():
            return scaled
        along = np.einsum("wyx,...wyx->...yx", self.direction, scaled)
        return scaled - self.direction * (self.gamma * along)[..., np.newaxis, :, :]


@dataclass(frozen=True, eq=False)
class FullColumns:
    """Whitened derivatives that touch any wavelength, ``(L, W, ny, nx)``."""

    values: FloatArray

    @property
    def flat(self) -> FloatArray:
        """One row for each column, ``(L, W * ny * nx)``."""
        return self.values.reshape(len(self.values), math.prod(self.values.shape[1:]))

    def dot(self, values: FloatArray) -> FloatArray:
        """Products with whitened ``(..., W, ny, nx)``, shape ``(..., L)``."""
        return np.asarray(values.reshape(*values.shape[:-3], self.flat.shape[1]) @ self.flat.T)

    def along(self, slope: FloatArray) -> FloatArray:
        """Products cell by cell with a whitened slope ``(W, ny, nx)``, shape ``(L, ny, nx)``."""
        return np.einsum("wyx,kwyx->kyx", slope, self.values)

    @functools.cached_property
    def gram(self) -> FloatArray:
        """Products with one another, shape ``(L, L)``."""
        return self.flat @ self.flat.T

    def against(self, levels: PlaneColumns) -> FloatArray:
        """Products with other columns, shape ``(L, their L)``."""
        return levels.dot(self.values)


@dataclass(frozen=True, eq=False)
class PlaneColumns:
    """Whitened derivatives each of which concerns one wavelength, as those with respect to the levels.

    Written out, such columns would be zeros but for one plane in ``W``, and what the common response makes of it.
    """

    amplitude: FloatArray  # (C, ny, nx): derivatives in units of the noise
    plane: NDArray[np.int64]  # (C,): the wavelength that each belongs to
    basis: FloatArray  # (C, L): free parameters of which they are made
    whiten: Whitener

    def dot(self, values: FloatArray) -> FloatArray:
        """Products with whitened ``(..., W, ny, nx)``, shape ``(..., L)``."""
        planes = self.whiten.decorrelate(values)
        result = np.empty((*values.shape[:-3], len(self.plane)))
        for wave in np.unique(self.plane):
            own = self.plane == wave
            flat = self.amplitude[own].reshape(int(own.sum()), -1)
            result[..., own] = planes[..., wave, :, :].reshape(*values.shape[:-3], flat.shape[1]) @ flat.T
        return np.asarray(result @ self.basis)

    def along(self, slope: FloatArray) -> FloatArray:
        """Products cell by cell with a whitened slope ``(W, ny, nx)``, shape ``(L, ny, nx)``."""
        planes = self.amplitude * self.whiten.decorrelate(slope)[self.plane]
        return np.tensordot(self.basis.T, planes, axes=1)

    @functools.cached_property
    def gram(self) -> FloatArray:
        """Products with one another, shape ``(L, L)``."""
        return self.against(self)

    def against(self, levels: PlaneColumns) -> FloatArray:
        """Products with other columns of the same noise, shape ``(L, their L)``."""
        pair = (self, levels)
        first, second = (each.amplitude.reshape(len(each.plane), -1) for each in pair)
        planes = np.where(self.plane[:, np.newaxis] == levels.plane, first @ second.T, 0.0)
        if self.whiten.gamma.any():
            direction, gamma = self.whiten.direction, self.whiten.gamma
            share = np.sqrt(2.0 * gamma - gamma**2 * (direction**2).sum(axis=0))
            first, second = (
                (direction[each.plane] * each.amplitude * share).reshape(len(each.plane), -1) for each in pair
            )
            planes = planes - first @ second.T
        return np.asarray(self.basis.T @ planes @ levels.basis)


class Columns(Protocol):
    """Whitened derivatives, written out or not; see `FullColumns`."""

    @property
    def gram(self) -> FloatArray:
        """Products with one another, shape ``(L, L)``."""

    def dot(self, values: FloatArray) -> FloatArray:
        """Products with whitened ``(..., W, ny, nx)``, shape ``(..., L)``."""

    def along(self, slope: FloatArray) -> FloatArray:
        """Products cell by cell with a whitened slope ``(W, ny, nx)``, shape ``(L, ny, nx)``."""

    def against(self, levels: PlaneColumns) -> FloatArray:
        """Products with other columns, shape ``(L, their L)``."""


Projected = Callable[[FloatArray, tuple[FloatArray, FloatArray]], FloatArray]
"""Score of columns for a whitened residual and the scores of the nuisances."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Data, model and nuisances of one search."""

    cells: CellData
    forward: Forward
    basis: FieldBasis  # the thickness field
    level_basis: FloatArray  # (W, L): free levels: the unit matrix, or a few smooth functions of wavelength
    # Precision of the coefficients of the field about `field_centre` [1/µm²]; 0 for a free field
    field_prior: float = 0.0
    field_centre: FloatArray | None = None  # (M,): coefficients of a map that is known; needed with a prior
    # Whether the fringes of each wavelength have an amplitude of their own: the ``W`` contrasts, relative
    # to the model's, follow the levels
    free_contrast: bool = False
    # (W, ny, nx): light of the cells that the scatter of their response multiplies; that of the first
    # guess by default. With it, χ² means the same in all fits.
    reference: FloatArray | None = None

    @property
    def order_um(self) -> float:
        """Thickness from one fringe to the next at the middle wavelength [µm]."""
        return float(self.forward.model.fringe_order_um(float(np.median(self.cells.wavelength_nm))))

    def whitener(self, value: FloatArray) -> Whitener:
        """Whitener for the noise about `reference`, or about the prediction ``value`` if there is none."""
        if self.reference is not None:
            return Whitener.of_cells(self.cells, self.reference)
        weight = self.cells.weight  # where there are no data, the prediction may be anything
        return Whitener.of_cells(
            self.cells, value / max(float((weight * value).sum() / weight.sum()), 1e-300)
        )

    @property
    def n_levels(self) -> int:
        """Number of free levels, contrasts among them."""
        return self.level_basis.shape[1] + (self.cells.shape[0] if self.free_contrast else 0)

    def amplitudes(self, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Level and amplitude of the fringes at each wavelength, ``(W, 1, 1)``."""
        number = self.level_basis.shape[1]
        level = (self.level_basis @ levels[:number])[:, np.newaxis, np.newaxis]
        if not self.free_contrast:
            return level, level
        return level, levels[number:][:, np.newaxis, np.newaxis]

    def expected(self, levels: FloatArray, value: FloatArray) -> FloatArray:
        """Data that the model says, from its prediction."""
        level, fringes = self.amplitudes(levels)
        return level + fringes * (value - 1.0) if self.free_contrast else level * value

    def expected_of(self, fit: Fit) -> FloatArray:
        """Data that a fit says."""
        value = self.forward.predict(fit.settings, self.basis.expand(fit.field)).value
        return self.expected(fit.levels, value)

    def chi2_at(self, settings: Mapping[str, float], thickness_um: FloatArray) -> float:
        """χ² of effects at a thickness of every cell [µm], with the best level at each wavelength."""
        self.forward.cover(thickness_um)
        value = self.forward.predict(settings, thickness_um).value
        return chi2_with_free_levels(value, self.cells.value, self.cells.weight)

    def level_columns(self, value: FloatArray, whiten: Whitener) -> PlaneColumns:
        """Derivatives of the expected data with respect to the levels."""
        planes = np.arange(self.cells.shape[0])
        if not self.free_contrast:
            return PlaneColumns(whiten.root * value, planes, self.level_basis, whiten)
        basis = block_diag(self.level_basis, np.eye(len(planes)))
        amplitude = np.concatenate([whiten.root, whiten.root * (value - 1.0)])
        return PlaneColumns(amplitude, np.tile(planes, 2), basis, whiten)

    def field_pull(self, coefficients: FloatArray) -> FloatArray:
        """Half the gradient of χ² from the map that is known, ``(M,)``."""
        if self.field_centre is None:
            return np.zeros(len(coefficients))
        return self.field_prior * (coefficients - self.field_centre)

    def field_penalty(self, coefficients: FloatArray) -> float:
        """χ² of the field against the map that is known."""
        if self.field_centre is None:
            return 0.0
        return self.field_prior * float(((coefficients - self.field_centre) ** 2).sum())

    def with_cells(self, cells: CellData) -> Problem:
        """Same problem with other data on the same cells."""
        return replace(self, cells=cells)

    def without_cells(self, out: BoolArray) -> Problem:
        """Same problem without the data of some cells, of shape ``(ny, nx)``: their thickness is not known either."""
        cells = self.cells.restricted(~out)
        return replace(self, cells=cells, forward=self.forward.with_seen(cells.seen))


@dataclass(frozen=True, eq=False)
class Design:
    """Linearised model at one point, nuisances included."""

    basis: FieldBasis
    slope: FloatArray  # (W, ny, nx): whitened derivative with respect to thickness
    levels: PlaneColumns  # derivatives with respect to the levels
    effects: FullColumns  # derivatives with respect to the effects
    # (M,): what draws the coefficients of the field besides the residual: half a gradient of χ²
    pull: FloatArray
    normal: NormalMatrix  # curvature in the coefficients of the thickness field
    # (2, W, ny, nx): whitened derivatives with respect to the change of the thickness per cell along rows
    # and columns, where a blur lets cells see that
    slope_changes: FloatArray | None
    _coupling: FloatArray
    _curvature: FloatArray

    @classmethod
    def build(
        cls,
        basis: FieldBasis,
        slope: FloatArray,
        levels: PlaneColumns,
        effects: FullColumns,
        prior: float,
        pull: FloatArray,
        slope_changes: FloatArray | None = None,
    ) -> Design:
        """Assemble normal matrices; ``prior`` is the precision of a field that is known."""
        if slope_changes is None:
            normal = basis.normal_matrix((slope**2).sum(axis=0), prior)
        else:
            both = np.concatenate([slope[np.newaxis], slope_changes])
            normal = basis.normal_matrix_with_changes(np.einsum("iwyx,jwyx->ijyx", both, both), prior)
        coupling = _against_field(basis, (levels, effects), slope, slope_changes)
        cross = effects.against(levels)
        curvature = np.block([[levels.gram, cross.T], [cross, effects.gram]])
        curvature = curvature - coupling.T @ normal.solve(coupling)
        return cls(basis, slope, levels, effects, pull, normal, slope_changes, coupling, curvature)

    @property
    def curvature(self) -> FloatArray:
        """Curvature in levels and effects with the field profiled out."""
        return self._curvature

    def _field_score(self, residual: FloatArray) -> FloatArray:
        """Half the fall of χ² along each coefficient of the field; none at a minimum."""
        return self._along_field(residual) - self.pull

    def _along_field(self, values: FloatArray) -> FloatArray:
        """Products of the derivatives with respect to the field with whitened ``(W, ny, nx)``."""
        one = (FullColumns(values[np.newaxis]),)
        return _against_field(self.basis, one, self.slope, self.slope_changes)[:, 0]

    def _products(self, values: FloatArray) -> FloatArray:
        """Products of levels and effects with whitened ``(W, ny, nx)``."""
        return np.concatenate([self.levels.dot(values), self.effects.dot(values)])

    @functools.cached_property
    def _inverse_curvature(self) -> FloatArray:
        """Inverse of the curvature; what the data do not tell apart stays where it is."""
        scale = np.sqrt(np.maximum(np.diag(self._curvature), 1e-300))
        values, vectors = np.linalg.eigh(self._curvature / np.outer(scale, scale))
        keep = values > 1e-10
        inverse: FloatArray = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T / np.outer(scale, scale)
        return inverse

    def step(
        self, residual: FloatArray, ridge: FloatArray, pull: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Newton step of levels, effects and field; ``ridge`` is a prior precision, ``pull`` its gradient."""
        field_side = self._field_score(residual)
        solved = self.normal.solve(np.column_stack([field_side, self._coupling]))
        right = self._products(residual) - self._coupling.T @ solved[:, 0] - pull
        step = solve_symmetric(self._curvature + np.diag(ridge), right)
        return step, solved[:, 0] - solved[:, 1:] @ step

    def field_errors(self, draws: Iterable[FloatArray]) -> FloatArray:
        """What draws of whitened noise ``(W, ny, nx)`` make of the field, levels and effects held, in its unit."""
        moved = [self._along_field(noise) for noise in draws]
        solved = self.normal.solve(np.stack(moved, axis=1))
        return np.stack([self.basis.expand(one) for one in solved.T])

    def project(self, columns: Columns, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Score and information of further columns with all nuisances of this design projected out.

        ``residual`` (W, ny, nx): whitened residual at the minimum of this design. Returns (F,) and (F, F).
        """
        score, information = self.projection(columns)
        return score(residual, self.own_scores(residual)), information

    def own_scores(self, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scores of the nuisances: of the field, and of levels and effects with the field profiled out."""
        field_side = self._field_score(residual)
        own = self._products(residual) - self._coupling.T @ self.normal.solve(field_side[:, np.newaxis])[:, 0]
        return field_side, own

    def projection(self, columns: Columns) -> tuple[Projected, FloatArray]:
        """What `project` does, for one residual after the other; the scores of the nuisances are `own_scores`."""
        coupling = _against_field(self.basis, (columns,), self.slope, self.slope_changes)
        solved = self.normal.solve(coupling)
        cross = np.concatenate([columns.against(self.levels).T, columns.dot(self.effects.values)])
        cross = cross - self._coupling.T @ solved
        within = self._inverse_curvature @ cross

        def score(residual: FloatArray, own: tuple[FloatArray, FloatArray]) -> FloatArray:
            return columns.dot(residual) - solved.T @ own[0] - within.T @ own[1]

        return score, columns.gram - coupling.T @ solved - cross.T @ within


def _against_field(
    basis: FieldBasis, columns: Sequence[Columns], slope: FloatArray, slope_changes: FloatArray | None
) -> FloatArray:
    """Products of the derivatives with respect to a field with others, ``(M, F)``."""

    def along(part: FloatArray) -> FloatArray:
        return np.concatenate([each.along(part) for each in columns])

    products = basis.gather(along(slope))
    if slope_changes is not None:
        products = products + basis.gather_changes(np.stack([along(part) for part in slope_changes]))
    return products


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit."""

    settings: dict[str, float]  # effects by ``name.parameter``, those held fixed included
    coordinates: tuple[Coordinate, ...]  # the free ones
    position: FloatArray  # values of the coordinates
    levels: FloatArray  # coefficients of the levels, ``(L,)``
    field: FloatArray  # coefficients of the thickness, ``(M,)``
    chi2: float  # whitened sum of squares, and that of the field against a map that is known
    information: FloatArray  # curvature in the free coordinates, nuisances profiled out, without prior
    iterations: int = 0
    converged: bool = True
    # rms distance of other minima that the data allow, by coordinate
    spread: FloatArray = dataclass_field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.spread.size != len(self.coordinates):
            object.__setattr__(self, "spread", np.zeros(len(self.coordinates)))

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the coordinates from the data and the weak prior alone, ``(P, P)``."""
        total = self.information + np.diag(_ridge(self.coordinates, self.position))
        return np.asarray(np.linalg.pinv(total, hermitian=True))

    @property
    def sigma(self) -> FloatArray:
        """Uncertainty of the coordinates, neighbouring minima included.

        What the data hardly see is drawn to null by the weak prior, and off by as much as it really scatters.
        """
        if not self.coordinates:
            return np.zeros(0)
        drawn = _ridge(self.coordinates, self.position) ** 2 * _scatter(self.coordinates, self.position)
        covariance = self.covariance
        variance = np.maximum(np.diag(covariance @ (self.information + np.diag(drawn)) @ covariance), 0.0)
        return np.asarray(np.sqrt(variance + self.spread**2))

    def without(self, name: str) -> Fit:
        """The same place with one effect taken out; not a minimum."""
        kept = [number for number, item in enumerate(self.coordinates) if item.effect != name]
        settings = {key: value for key, value in self.settings.items() if key.partition(".")[0] != name}
        return replace(self._with_free(kept), settings=settings)

    def holding(self, number: int) -> Fit:
        """The same place with one coordinate held."""
        return self._with_free([other for other in range(len(self.coordinates)) if other != number])

    def _with_free(self, kept: Sequence[int]) -> Fit:
        """The same place with some of the coordinates free."""
        numbers = list(kept)
        return replace(
            self,
            coordinates=tuple(self.coordinates[number] for number in numbers),
            position=self.position[numbers],
            information=self.information[np.ix_(numbers, numbers)],
            spread=self.spread[numbers],
        )

    def held(self) -> Fit:
        """The same place with all effects held."""
        return self._with_free(())


def _prior_widths(coordinates: Sequence[Coordinate]) -> FloatArray:
    return np.array([PRIOR_WIDTH * item.unit_step for item in coordinates])


def _ridge(coordinates: Sequence[Coordinate], position: FloatArray) -> FloatArray:
    """Precision of the Gaussian prior that pulls at a position as the Cauchy prior does."""
    return np.asarray(1.0 / (_prior_widths(coordinates) ** 2 + position**2))


def _scatter(coordinates: Sequence[Coordinate], position: FloatArray) -> FloatArray:
    """Variance of the coordinates besides the data, once they are fitted: draws from one distribution tell its width.

    A few of them hardly say so.
    """
    variance = 1.0 / _ridge(coordinates, position)
    owners = np.array([item.effect if item.exchangeable else "" for item in coordinates])
    for name in set(owners) - {""}:
        own = owners == name
        if own.sum() > 2:
            width = float((position[own] ** 2).sum()) / (own.sum() - 2)
            variance[own] = np.minimum(variance[own], width)
    return variance


@dataclass(eq=False)
class _Point:
    """State of an iteration."""

    position: FloatArray
    levels: FloatArray
    coefficients: FloatArray
    prediction: Prediction = dataclass_field(init=False)
    residual: FloatArray = dataclass_field(init=False)
    chi2: float = dataclass_field(init=False)


def fit_model(
    problem: Problem,
    coordinates: Sequence[Coordinate],
    start: FloatArray,
    field_start: FloatArray,
    levels_start: FloatArray | None = None,
    fixed: Mapping[str, float] | None = None,
    *,
    iterations: int = MOST_ITERATIONS,
    rival: float = math.inf,
) -> Fit:
    """Minimise χ² in effects, levels and thickness field together (Gauss–Newton with damping).

    ``field_start`` (M,). ``levels_start``: first levels; all 1 by default. ``rival``: χ² of another fit to the
    same data: one that will not come near it need not converge.
    """
    solver = _Solver(problem, tuple(coordinates), dict(fixed or {}))
    return solver.run(np.asarray(start, dtype=float), field_start, levels_start, iterations, rival)


class _Solver:
    def __init__(
        self, problem: Problem, coordinates: tuple[Coordinate, ...], fixed: dict[str, float]
    ) -> None:
        self.problem, self.coordinates, self.fixed = problem, coordinates, fixed
        self.prior_widths = _prior_widths(coordinates)

    def settings(self, position: FloatArray) -> dict[str, float]:
        values = {c.key: c.value(x) for c, x in zip(self.coordinates, position, strict=True)}
        return {**self.fixed, **values}

    def evaluate(self, point: _Point) -> _Point:
        problem = self.problem
        thickness = problem.basis.expand(point.coefficients)
        problem.forward.cover(thickness)
        point.prediction = problem.forward.predict(self.settings(point.position), thickness)
        expected = problem.expected(point.levels, point.prediction.value)
        point.residual = self.whiten(problem.cells.value - expected)
        point.chi2 = float((point.residual**2).sum()) + problem.field_penalty(point.coefficients)
        return point

    def penalty(self, point: _Point) -> float:
        return float(np.log1p((point.position / self.prior_widths) ** 2).sum())

    def run(
        self,
        start: FloatArray,
        field_start: FloatArray,
        levels_start: FloatArray | None,
        iterations: int,
        rival: float,
    ) -> Fit:
        problem = self.problem
        thickness = problem.basis.expand(field_start)
        problem.forward.cover(thickness)
        reference = problem.forward.predict(self.settings(start), thickness).value
        self.whiten = problem.whitener(reference)
        levels = self._first_levels(reference) if levels_start is None else levels_start.copy()
        # Effects that start at a size need their own thickness before they are judged.
        point = self._relax(self.evaluate(_Point(start.copy(), levels, field_start.copy())))
        damping, converged, count = 0.0, False, 0
        while count < iterations:
            count += 1
            design = self.linearise(point)
            trial, damping = self._improve(point, design, damping)
            if trial is None:
                converged = True
                break
            gain = point.chi2 + self.penalty(point) - trial.chi2 - self.penalty(trial)
            point = trial
            if gain < CONVERGED:
                converged = True
                break
            further = min(CATCHING_UP, STEEPER * (iterations - count)) * gain
            if count >= FEWEST_ITERATIONS and point.chi2 - rival > max(FAR_BEHIND, further):
                break
        design = self.linearise(point)
        number = len(self.coordinates)
        return Fit(
            self.settings(point.position), self.coordinates, point.position, point.levels, point.coefficients,
            point.chi2, _profile(design.curvature, number), count, converged,
        )  # fmt: skip

    def _first_levels(self, reference: FloatArray) -> FloatArray:
        cells, basis = self.problem.cells, self.problem.level_basis
        weight = (cells.weight * reference**2).sum(axis=(1, 2))
        ratio = (cells.weight * reference * cells.value).sum(axis=(1, 2)) / np.maximum(weight, 1e-300)
        root = np.sqrt(weight)
        levels = np.linalg.lstsq(root[:, None] * basis, root * ratio, rcond=None)[0]
        return np.concatenate([levels, basis @ levels]) if self.problem.free_contrast else levels

    def linearise(self, point: _Point, *, effects: bool = True) -> Design:
        """Design at a point: levels, then coordinates (if ``effects``)."""
        problem = self.problem
        thickness = problem.basis.expand(point.coefficients)
        _, level = problem.amplitudes(point.levels)
        columns = np.empty((len(self.coordinates) if effects else 0, *point.residual.shape))
        for number in range(len(columns)):
            columns[number] = self.whiten(level * self.derivative(point, thickness, number))
        slope = self.whiten(level * point.prediction.slope)
        changes = None
        if problem.basis.sees_changes and self._is_blurred(point):
            parts = problem.forward.slope_changes(self.settings(point.position), thickness)
            changes = np.stack([self.whiten(level * part) for part in parts])
        levels = problem.level_columns(point.prediction.value, self.whiten)
        pull = problem.field_pull(point.coefficients)
        return Design.build(
            problem.basis, slope, levels, FullColumns(columns), problem.field_prior, pull, changes
        )

    def _is_blurred(self, point: _Point) -> bool:
        """Whether light is carried so far that a cell sees how the thickness changes from cell to cell."""
        blur_px = self.problem.forward.blur_px(self.settings(point.position))
        return blur_px > WIDE_BLUR * self.problem.cells.cell_px

    def derivative(self, point: _Point, thickness: FloatArray, number: int) -> FloatArray:
        """Derivative of the prediction with respect to one coordinate, by a difference."""
        return coordinate_derivative(
            self.problem.forward, self.coordinates[number], point.position[number], self.settings(point.position),
            thickness,
        )  # fmt: skip

    def _relax(self, point: _Point) -> _Point:
        """Let levels and field follow a step of the effects: the valley in which phase is constant is curved."""
        if not self.coordinates:
            return point
        for _ in range(2):
            design = self.linearise(point, effects=False)
            nothing = np.zeros(self.problem.n_levels)
            step, field_step = design.step(point.residual, nothing, nothing)
            scale = 1.0 / max(1.0, self._phase_change(design, step, field_step) / LARGEST_PHASE_STEP_UM)
            better = self.evaluate(
                _Point(point.position, point.levels + scale * step, point.coefficients + scale * field_step)
            )
            gain = point.chi2 + self.penalty(point) - better.chi2 - self.penalty(better)
            if gain > 0.0:
                point = better
            if gain < 1.0:
                break
        return point

    def _phase_change(self, design: Design, step: FloatArray, field_step: FloatArray) -> float:
        """Largest change of fringe phase in a step, as a thickness [µm]: of the field and of the effects together."""
        thickness = self.problem.basis.expand(field_step)
        square = (design.slope**2).sum(axis=0)
        levels = self.problem.n_levels
        change = design.slope * thickness
        change = change + np.tensordot(step[levels:], design.effects.values, axes=1)
        along = (design.slope * change).sum(axis=0)
        used = square > 0.01 * square.max()
        return float(np.percentile(np.abs(along[used] / square[used]), 98.0))

    def _improve(self, point: _Point, design: Design, damping: float) -> tuple[_Point | None, float]:
        levels = self.problem.n_levels
        own = _ridge(self.coordinates, point.position)
        ridge = np.concatenate([np.zeros(levels), own])
        pull = np.concatenate([np.zeros(levels), own * point.position])
        before = point.chi2 + self.penalty(point)
        held = np.zeros(len(ridge), dtype=bool)
        for _ in range(8):
            extra = damping * np.diag(design.curvature)
            extra = extra + np.where(held, 1e30, 0.0)
            step, field_step = design.step(point.residual, ridge + extra, pull)
            position = point.position + step[levels:]
            clipped = np.array([c.clip(x) for c, x in zip(self.coordinates, position, strict=True)])
            at_bound = np.concatenate([np.zeros(levels, bool), clipped == point.position])
            if np.any(at_bound & ~held):
                held |= at_bound
                continue
            scale = 1.0 / max(1.0, self._phase_change(design, step, field_step) / LARGEST_PHASE_STEP_UM)
            position = point.position + scale * (clipped - point.position)
            trial = _Point(
                position, point.levels + scale * step[:levels], point.coefficients + scale * field_step
            )
            trial = self._relax(self.evaluate(trial))
            if trial.chi2 + self.penalty(trial) <= before + 1e-9:
                return trial, 0.2 * damping if damping > 1e-6 else 0.0
            damping = max(10.0 * damping, 1e-3)
        return None, damping


def coordinate_derivative(
    forward: Forward,
    coordinate: Coordinate,
    at: float,
    settings: Mapping[str, float],
    thickness_um: FloatArray,
) -> FloatArray:
    """Derivative of the prediction with respect to a coordinate, by a central difference where the bounds allow.

    A one-sided difference of a phase would keep a part of its curvature, which no thickness absorbs, and make
    degenerate parameters look well measured.
    """
    size = coordinate.step or 1e-3 * coordinate.unit_step
    if coordinate.quadratic:
        size = max(size, 1e-3 * at)
    points = [point if coordinate.is_inside(point) else at for point in (at - size, at + size)]
    if coordinate.quadratic:
        points[0] = max(at - size, 0.0)
    low, high = ({**settings, coordinate.key: coordinate.value(point)} for point in points)
    return forward.change(low, high, thickness_um) / (points[1] - points[0])


def _profile(curvature: FloatArray, number: int) -> FloatArray:
    """Curvature of the last ``number`` columns with the others profiled out."""
    if number == 0:
        return np.zeros((0, 0))
    first = len(curvature) - number
    a, b, c = curvature[:first, :first], curvature[:first, first:], curvature[first:, first:]
    return c - b.T @ solve_symmetric(a, b)


def solve_symmetric(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution scaled to a unit diagonal; directions without information stay put."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    keep = values > 1e-12 * max(float(values.max()), 1e-300)
    column = right.reshape(len(right), -1) / scale[:, np.newaxis]
    solution = (vectors[:, keep] / values[keep]) @ (vectors[:, keep].T @ column)
    return (solution / scale[:, np.newaxis]).reshape(right.shape)


def linearise_at(problem: Problem, fit: Fit) -> tuple[Design, FloatArray, Prediction, FloatArray, Whitener]:
    """Design at a finished fit, its whitened residual, the prediction, the thickness and the whitener."""
    solver = _Solver(problem, fit.coordinates, dict(fit.settings))
    thickness = problem.basis.expand(fit.field)
    problem.forward.cover(thickness)
    reference = problem.forward.predict(fit.settings, thickness).value
    solver.whiten = problem.whitener(reference)
    point = solver.evaluate(_Point(fit.position, fit.levels, fit.field))
    return solver.linearise(point), point.residual, point.prediction, thickness, solver.whiten
