"""The likelihood linearised at a point: response and thickness of every cell leave in closed form, 2 x 2 per cell."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import TypeVar

import numpy as np

from ...array_types import BoolArray, FloatArray
from .forward import Forward, Light

SECOND_STEP_UM = 1e-3  # Change of thickness with which the slope is differentiated [µm]


@dataclass(frozen=True, eq=False)
class Data:
    """Values of N cells at W exposures, at any level, and their inverse variances; 0 where there are none."""

    value: FloatArray  # (W, N)
    weight: FloatArray  # (W, N)

    @property
    def seen(self) -> BoolArray:
        """Cells with data, ``(N,)``."""
        return np.asarray((self.weight > 0.0).any(axis=0))


@dataclass(frozen=True, eq=False)
class Problem:
    """Data, model, and the priors of what every cell has for itself."""

    data: Data
    forward: Forward
    thickness_um: FloatArray  # (N,): the first thickness, about which that of a cell is Gaussian
    response_sigma: float  # prior of the response of a cell
    thickness_sigma_um: float | FloatArray = 10.0  # of all or each; many orders pull no cell and favour none
    known: bool = False  # whether the first thickness is measured: it stays, and no cell changes its order
    # free shapes of the levels over the exposures, ``(W, L)``: one of every exposure by default
    level_shapes: FloatArray | None = None
    orders: int = 0  # on both sides of a fit, in which it is tried too: few wavelengths tell no order

    @property
    def phase_share(self) -> float:
        """What the logarithm of the phase per thickness adds to half of that of the curvatures of the cells.

        Nothing where the thickness is measured, or every cell has an error of its own: there its scale has a meaning.
        """
        measured = self.known or np.ndim(self.thickness_sigma_um) > 0
        return 0.0 if measured else 0.5 * float(self.data.seen.sum())

    @property
    def level_design(self) -> FloatArray:
        """Change of the levels with what is free of them, ``(W, L)``."""
        return np.eye(len(self.data.value)) if self.level_shapes is None else self.level_shapes

    @property
    def levels_known(self) -> bool:
        """Whether levels are known but for some shapes: a few cells cannot tell those of all exposures."""
        return self.level_shapes is not None

    @property
    def free_levels(self) -> int:
        """How many parameters the levels have, the first of all dense ones."""
        return len(self.data.value) if self.level_shapes is None else self.level_shapes.shape[1]

    @property
    def freedom(self) -> int:
        """Values beyond what cells and levels have: a response of several exposures, and a thickness not known."""
        own = int(len(self.data.weight) > 1) + int(not self.known)
        return int(np.count_nonzero(self.data.weight)) - own * int(self.data.seen.sum()) - self.free_levels

    def at(self, settings: Mapping[str, float], levels: FloatArray, thickness_um: FloatArray) -> Point:
        """The likelihood linearised about effects, levels ``(W,)`` and thickness ``(N,)``."""
        value, slope = self.forward.predict(settings, thickness_um)
        return Point(self, dict(settings), levels, thickness_um, value, slope)

    def about(self, thickness_um: FloatArray) -> Problem:
        """The same about another first thickness ``(N,)``; one that is known stays."""
        return self if self.known else replace(self, thickness_um=thickness_um)


About = TypeVar("About", "Problem", "Point")
Answer = TypeVar("Answer")


def kept(most: int) -> Callable[[Callable[[About], Answer]], Callable[[About], Answer]]:
    """Keep the latest answers of a function about points or problems, and none longer than their forward model."""

    def keeping(function: Callable[[About], Answer]) -> Callable[[About], Answer]:
        @wraps(function)
        def answered(about: About) -> Answer:
            problem = about if isinstance(about, Problem) else about.problem
            answers: dict[About, Answer] = problem.forward.kept.setdefault(function.__qualname__, {})
            answers[about] = answers.pop(about) if about in answers else function(about)
            while len(answers) > most:
                answers.pop(next(iter(answers)))
            return answers[about]

        return answered

    return keeping


@dataclass(frozen=True, eq=False)
class Columns:
    """Whitened derivatives with respect to K dense parameters, and what they do to the log determinant of a cost.

    The first L may be of one exposure alone each, in the order of the exposures.
    """

    value: FloatArray  # (K - L, W, N): of all exposures
    cells: (
        FloatArray  # (K, 2, N): their part along response and thickness of the cells, in units of unit noise
    )
    log_det: FloatArray  # (K,): derivative of the log determinant of the cells, the thickness following
    alone: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (L, N): of one exposure

    def __len__(self) -> int:
        """Number of parameters."""
        return len(self.log_det)

    def along(self, values: FloatArray) -> FloatArray:
        """Products with whitened values ``(..., W, N)``, shape ``(K, ...)``."""
        one = values.reshape(-1, *values.shape[-2:])
        found = np.empty((len(self), len(one)))
        levels = len(self.alone)
        if levels:
            found[:levels] = np.einsum("ln,kln->lk", self.alone, one[:, :levels])
        found[levels:] = np.tensordot(self.value, one, axes=([1, 2], [1, 2]))
        return found.reshape(len(self), *values.shape[:-2])

    def products(self, other: Columns) -> FloatArray:
        """Products with other columns, ``(K, K')``."""
        if not len(self.alone):
            return other.along(self.value).T
        first = np.zeros((len(self.alone), len(other.alone)))
        if len(other.alone):
            np.fill_diagonal(first, np.einsum("ln,ln->l", self.alone, other.alone))
        levels = np.einsum("ln,kln->lk", self.alone, other.value[:, : len(self.alone)])
        return np.concatenate([np.concatenate([first, levels], axis=1), other.along(self.value).T])

    def combined(self, step: FloatArray) -> FloatArray:
        """What a step of the parameters does, ``(W, N)``."""
        levels = len(self.alone)
        total = np.tensordot(step[levels:], self.value, axes=1)
        if levels:
            total[:levels] += step[:levels, np.newaxis] * self.alone
        return np.asarray(total)


@dataclass(frozen=True, eq=False)
class Point:
    """Effects, levels and thickness, with the model there."""

    problem: Problem
    settings: dict[str, float]
    levels: FloatArray
    thickness_um: FloatArray
    value: FloatArray  # (W, N): model over level
    slope: FloatArray  # (W, N): its derivative with respect to thickness

    @cached_property
    def root(self) -> FloatArray:
        """Inverse standard deviations."""
        return np.sqrt(self.problem.data.weight)

    @cached_property
    def light(self) -> Light:
        """The model over level before effects on the image, and its derivative."""
        return self.problem.forward.light(self.settings, self.thickness_um)

    @cached_property
    def response(self) -> FloatArray:
        """Whitened model: the derivative with respect to the response of a cell."""
        return self.whitened(self.value)

    @cached_property
    def steep(self) -> FloatArray:
        """Whitened derivative with respect to thickness."""
        return self.whitened(self.slope)

    @cached_property
    def residual(self) -> FloatArray:
        """Whitened data minus model."""
        return self.problem.data.value * self.root - self.response

    @cached_property
    def first_residual(self) -> FloatArray:
        """The same at a thickness that was known before the data; where none was, that of the point."""
        if not self.problem.known:
            return self.residual
        return self.residual + self.steep * (self.thickness_um - self.problem.thickness_um)

    def beside_thickness(self, values: FloatArray) -> FloatArray:
        """Whitened values ``(W, N)`` times the inverse covariance of noise and errors of the thickness."""
        precision = (self.steep**2).sum(axis=0) + self.problem.thickness_sigma_um**-2.0
        return np.asarray(values - self.steep * ((self.steep * values).sum(axis=0) / precision))

    def whitened(self, values: FloatArray) -> FloatArray:
        """Model values in units of the noise."""
        return np.asarray(values * self.levels[:, np.newaxis] * self.root)

    # Cells ----------------------------------------------------------------------------------------------------

    @cached_property
    def _precision(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Elements uu, ut, tt of the 2 x 2 precision of every cell."""
        uu = (self.response**2).sum(axis=0) + self.problem.response_sigma**-2
        tt = (self.steep**2).sum(axis=0) + self.problem.thickness_sigma_um**-2
        return uu, (self.response * self.steep).sum(axis=0), tt

    @cached_property
    def _root(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cholesky factor of that: first diagonal, lower, second diagonal."""
        uu, ut, tt = self._precision
        first = np.sqrt(uu)
        lower = ut / first
        return first, lower, np.sqrt(np.maximum(tt - lower**2, 1e-12 * tt))

    def _forward_solved(self, along: FloatArray) -> FloatArray:
        """Inverse of the factor times vectors ``(..., 2, N)``."""
        first, lower, second = self._root
        top = along[..., 0, :] / first
        return np.stack([top, (along[..., 1, :] - lower * top) / second], axis=-2)

    def _back_solved(self, along: FloatArray) -> FloatArray:
        first, lower, second = self._root
        bottom = along[..., 1, :] / second
        return np.stack([(along[..., 0, :] - lower * bottom) / first, bottom], axis=-2)

    def _along(self, values: FloatArray) -> FloatArray:
        """Products of whitened values ``(..., W, N)`` with the derivatives of the cells, ``(..., 2, N)``."""
        both = [np.einsum("wn,...wn->...n", own, values) for own in (self.response, self.steep)]
        return np.stack(both, axis=-2)

    @cached_property
    def _prior_pull(self) -> FloatArray:
        """What the prior of the thickness adds to the products of the residual."""
        pull = (self.problem.thickness_um - self.thickness_um) * self.problem.thickness_sigma_um**-2
        return np.stack([np.zeros_like(pull), pull])

    @cached_property
    def residual_cells(self) -> FloatArray:
        """The residual along the cells, in units of unit noise, ``(2, N)``."""
        return self._forward_solved(self._along(self.residual) + self._prior_pull)

    @cached_property
    def cell_energy(self) -> FloatArray:
        """Half of chi square of every cell with its response at the best, at this thickness, ``(N,)``."""
        own = 0.5 * (self.residual**2).sum(axis=0)
        own -= 0.5 * (self._along(self.residual)[0] / self._root[0]) ** 2
        away = (self.thickness_um - self.problem.thickness_um) / self.problem.thickness_sigma_um
        return np.asarray(own + 0.5 * away**2)

    @property
    def cell_evidence(self) -> FloatArray:
        """Log likelihood of every cell with response and thickness integrated, but for constants, ``(N,)``."""
        first, _, second = self._root
        priors = self.problem.response_sigma * self.problem.thickness_sigma_um
        return np.asarray(-self.cell_energy - np.log(first * second * priors))

    @cached_property
    def log_det(self) -> float:
        """Half of the log determinant of the cells over that of their priors."""
        first, _, second = self._root
        priors = self.problem.response_sigma * self.problem.thickness_sigma_um
        return float(np.log(first).sum() + np.log(second * priors).sum())

    @cached_property
    def _mean_log_det(self) -> float:
        """The same with the curvature that the data have: the mean of the model's and of one number.

        The curvature along thickness at the best is the square of the slope less the second derivative times the
        residual. For fringes of amplitude A in data of amplitude a it is A a k² instead of A² k², with k the phase
        per thickness, so that half of the logarithm depends on A. None may depend on k: fringes are the same with
        thicker cells of a lower index.
        """
        half = 0.5 * float(np.log(self._root[2]).sum())
        return self.log_det - half - self.problem.phase_share * self.problem.forward.log_phase(self.settings)

    @cached_property
    def cost(self) -> float:
        """Minus the log likelihood with the cells integrated, but for constants of the noise and of the data."""
        return float(self.cell_energy.sum()) + self._mean_log_det

    @property
    def linear_cost(self) -> float:
        """The same with the thickness of every cell at the best of the linear model, not where it is."""
        away = (self.thickness_um - self.problem.thickness_um) / self.problem.thickness_sigma_um
        energy = 0.5 * float((self.residual**2).sum() + (away**2).sum() - (self.residual_cells**2).sum())
        return energy + self.log_det

    # Dense parameters -----------------------------------------------------------------------------------------

    def columns(self, values: FloatArray, slopes: FloatArray, log_phase: FloatArray | float = 0.0) -> Columns:
        """Dense columns from whitened derivatives of value and slope, each ``(K, W, N)``.

        ``log_phase`` (K,): derivative of the logarithm of the phase per thickness.
        """
        along = self._along(values)
        cells = self._forward_solved(along)
        us, ts = (np.einsum("wn,...wn->...n", own, slopes) for own in (self.response, self.steep))
        change = self._log_det_change(along, us, ts, cells) - self.problem.phase_share * np.asarray(log_phase)
        return Columns(values, cells, np.asarray(change))

    def bare_columns(self, values: FloatArray) -> Columns:
        """Dense columns ``(K, W, N)``; what they do to the log determinant is not asked."""
        return Columns(values, self._forward_solved(self._along(values)), np.zeros(len(values)))

    @cached_property
    def level_columns(self) -> Columns:
        """Those of the levels."""
        value, slope = self.value * self.root, self.slope * self.root
        shapes = self.problem.level_shapes
        if shapes is not None:
            return self.columns(*(shapes.T[:, :, np.newaxis] * each for each in (value, slope)))
        # Each is of one exposure alone.
        along = np.stack([self.response * value, self.steep * value], axis=-2)
        cells = self._forward_solved(along)
        change = self._log_det_change(along, self.response * slope, self.steep * slope, cells)
        return Columns(np.zeros((0, *self.value.shape)), cells, change, value)

    def _log_det_change(
        self, along: FloatArray, us: FloatArray, ts: FloatArray, cells: FloatArray
    ) -> FloatArray:
        """Change of the log determinant with dense parameters, with the thickness that follows them."""
        direct = self._log_det_by(along, us, ts)
        moved = -self._back_solved(cells)[..., 1, :]
        return np.asarray(direct.sum(axis=-1) + (moved * self._log_det_by_thickness).sum(axis=-1))

    def _log_det_by(self, along: FloatArray, us: FloatArray, ts: FloatArray) -> FloatArray:
        """Change of `_mean_log_det` of cells whose derivatives change, ``(..., N)``."""
        uu, ut, tt = self._precision
        det = (self._root[0] * self._root[2]) ** 2
        both = (tt * along[..., 0, :] - ut * (us + along[..., 1, :]) + uu * ts) / det
        return np.asarray(0.5 * (both + along[..., 0, :] / uu))

    @cached_property
    def curved(self) -> FloatArray:
        """Whitened second derivative with respect to thickness."""
        up, down = (
            self.problem.forward.predict(self.settings, self.thickness_um + sign * SECOND_STEP_UM)[1]
            for sign in (1.0, -1.0)
        )
        return self.whitened((up - down) / (2.0 * SECOND_STEP_UM))

    @cached_property
    def _log_det_by_thickness(self) -> FloatArray:
        along, second = self._along(self.steep), self.curved
        return self._log_det_by(
            along, (self.response * second).sum(axis=0), (self.steep * second).sum(axis=0)
        )

    def information(self, first: Columns, second: Columns) -> FloatArray:
        """Fisher matrix of dense columns with the cells integrated."""
        whole = first.products(second)
        return np.asarray(whole - np.tensordot(first.cells, second.cells, axes=([1, 2], [1, 2])))

    def score(self, columns: Columns) -> FloatArray:
        """Derivative of the log likelihood with respect to dense parameters, without that of the determinant."""
        whole = columns.along(self.residual)
        return np.asarray(whole - np.tensordot(columns.cells, self.residual_cells, axes=([1, 2], [0, 1])))

    def unbiased_score(self, columns: Columns) -> FloatArray:
        """Derivative of the log likelihood, the thickness of every cell at its best, that is 0 on the average.

        A cell that follows its noise leaves a mean residual of second order, half of the variance of its thickness
        times the second derivative; a score that falls on many cells would take that for an effect.
        """
        whole = columns.along(self.unbiased_residual)
        return np.asarray(whole - np.tensordot(columns.cells, self.residual_cells, axes=([1, 2], [0, 1])))

    @cached_property
    def unbiased_residual(self) -> FloatArray:
        """The whitened residual without what a thickness that follows noise leaves on the average."""
        return self.residual + 0.5 * self.projected(self.curved * self.thickness_sigma_um**2)

    def followed_um(self, step: FloatArray, columns: Columns) -> FloatArray:
        """Change of the thickness that goes with a step of dense parameters [µm]."""
        left = self.residual_cells - np.tensordot(step, columns.cells, axes=1)
        return np.asarray(self._back_solved(left)[1])

    def following_um(self, values: FloatArray) -> FloatArray:
        """Change of the thickness with which whitened values ``(W, N)``, added to the model, add the least [µm]."""
        return np.asarray(-self._back_solved(self._forward_solved(self._along(values)))[1])

    @property
    def wanted_um(self) -> FloatArray:
        """Change of the thickness of every cell to its best, all else as it is [µm]."""
        return np.asarray(self._back_solved(self.residual_cells)[1])

    def projected(self, values: FloatArray) -> FloatArray:
        """Whitened values less what response and thickness of the cells make of them."""
        cells = self._back_solved(self._forward_solved(self._along(values)))
        return np.asarray(values - self.response * cells[..., :1, :] - self.steep * cells[..., 1:, :])

    @cached_property
    def noise_share(self) -> FloatArray:
        """Part of the variance of unit noise that the projection leaves, ``(W, N)``."""
        solved = self._forward_solved(np.stack([self.response, self.steep], axis=-2))
        return np.asarray(1.0 - (solved**2).sum(axis=-2))

    def misfit(self, free: int) -> float:
        """Rms of the residual over that of noise, with so many dense parameters fitted."""
        seen = self.problem.data.seen
        left = float((self.projected(self.first_residual)[:, seen] ** 2).sum())
        return float(np.sqrt(left / max(float(self.noise_share[:, seen].sum()) - free, 1.0)))

    @cached_property
    def thickness_sigma_um(self) -> FloatArray:
        """Error of the thickness of every cell, ``(N,)`` [µm]."""
        return np.asarray(1.0 / self._root[2])

    def problem_with(self, data: Data) -> Point:
        """The same point of a problem with other data."""
        return replace(self, problem=replace(self.problem, data=data))

    def levels_after(self, step: FloatArray) -> FloatArray:
        """Levels after a step of what is free of them, the first of a step of all dense parameters."""
        return np.asarray(self.levels + self.problem.level_design @ step[: self.problem.free_levels])

    def moved(
        self, levels: FloatArray, thickness_um: FloatArray, settings: Mapping[str, float] | None = None
    ) -> Point:
        """The same problem elsewhere."""
        return self.problem.at(self.settings if settings is None else settings, levels, thickness_um)


def solved(information: FloatArray, right: FloatArray) -> FloatArray:
    """Solution ``(K, ...)`` of a Fisher matrix ``(K, K)``; parameters along which nothing changes stay.

    The place of an island that lies where there are no data is one.
    """
    scale = np.sqrt(np.diag(information))
    scale = np.where(scale > 0.0, scale, 1.0)
    inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
    return np.asarray((inverse / np.outer(scale, scale)) @ right)


def joined(first: Columns, second: Columns) -> Columns:
    """Columns of two groups of parameters; those of single exposures are in the first."""
    return Columns(
        np.concatenate([first.value, second.value]),
        np.concatenate([first.cells, second.cells]),
        np.concatenate([first.log_det, second.log_det]),
        first.alone,
    )
