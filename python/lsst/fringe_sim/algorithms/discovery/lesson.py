"""What the search with a smooth field gives to learn corrections from; see `learning`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...array_types import BoolArray, FloatArray
from ...effects import ImageGeometry
from .channels import State
from .fit import Columns, Design, Fit, Problem, Projected, fit_model, linearise_at
from .learned_columns import with_learned
from .learning import Learned, Part, best_evidence, judging_cells, learn
from .validation import misfit_rms, thickness_starts


def learned_beside(
    problem: Problem, null: Fit, best: Fit, held_out: BoolArray, rng: np.random.Generator, least: float
) -> Learned | None:
    """What is learned beside the best fit.

    ``null``, ``best``: fits of the unchanged model and of the best effects to all data. ``held_out`` (ny, nx): cells
    that the choice of effects has not seen. ``rng``, ``least``: see `learn`.
    """
    return learn(_Lesson(_with_learned(problem), null, best, held_out), rng, least)


def evidence_of_correction(problem: Problem, fit: Fit) -> float:
    """Largest log evidence of a correction beside a fit, in all cells, over none; 0 where nothing speaks for one."""
    return best_evidence(_Part(_with_learned(problem), fit.held()))


def _with_learned(problem: Problem) -> Problem:
    """The same problem with corrections among the effects that may be set."""
    forward = problem.forward
    return replace(problem, forward=replace(forward, catalogue=with_learned(forward.catalogue)))


@dataclass(frozen=True, eq=False)
class _Part(Part):
    problem: Problem
    fit: Fit  # without free effects
    only: str = ""

    @property
    def settings(self) -> dict[str, float]:
        return self.fit.settings

    @property
    def geometry(self) -> ImageGeometry:
        return self.problem.cells.geometry

    @cached_property
    def state(self) -> State:
        design, residual, prediction, thickness, whiten = linearise_at(self.problem, self.fit)
        value = self.problem.expected(self.fit.levels, prediction.value)
        cells = self.problem.cells
        raw = np.where(cells.weight > 0, cells.value - value, 0.0)
        return State(design, residual, raw, value, thickness, whiten)

    @property
    def chi2(self) -> float:
        return self.fit.chi2

    @property
    def rms(self) -> float:
        return misfit_rms(self.problem, self.fit)

    @property
    def planes(self) -> int:
        return self.problem.cells.shape[0]

    def chi2_of(self, cells: BoolArray) -> float:
        expected = self.problem.expected_of(self.fit)
        residual = self.problem.whitener(expected)(self.problem.cells.value - expected)
        return float((residual[:, cells] ** 2).sum())

    def change(self, settings: dict[str, float]) -> FloatArray:
        _, level = self.problem.amplitudes(self.fit.levels)
        return level * self.problem.forward.change(self.settings, settings, self.state.thickness_um)

    def of_noise(self, numbers: FloatArray) -> FloatArray:
        return np.where(self.state.residual != 0.0, numbers, 0.0)

    def own_scores(self, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self._design.own_scores(residual)

    def projection(self, columns: Columns) -> tuple[Projected, FloatArray]:
        return self._design.projection(columns)

    @property
    def _design(self) -> Design:
        return self.state.design


@dataclass(frozen=True, eq=False)
class _Lesson:
    problem: Problem
    null: Fit
    best: Fit
    held_out: BoolArray

    @property
    def judged(self) -> BoolArray:
        judged = judging_cells(self.held_out.shape)
        return judged if (judged & self.problem.cells.seen).any() else np.zeros_like(judged)

    @property
    def noise_floor(self) -> float:
        return self.problem.cells.noise_rms

    @cached_property
    def _inside(self) -> Problem:
        return self.problem.without_cells(self.judged)

    @cached_property
    def _outside(self) -> Problem:
        return self.problem.with_cells(self.problem.cells.restricted(self.judged))

    def teaching(self) -> _Part:
        best = self.best
        free = fit_model(
            self._inside, best.coordinates, best.position, best.field, best.levels, best.settings
        )
        # Beside the effects as they are: free ones would take a part of the correction back.
        return _Part(self._inside, free.held())

    def again(self, taught: Part, settings: dict[str, float], only: str) -> _Part:
        before = _fit_of(taught)
        fit = fit_model(self._inside, (), np.zeros(0), before.field, before.levels, settings)
        return _Part(self._inside, fit, only)

    def judging(self, taught: Part, settings: dict[str, float]) -> _Part:
        fitted, problem = _fit_of(taught), self.problem
        starts = thickness_starts(problem, self.null, fitted, self.judged)
        fields = [problem.basis.fit(thickness, np.ones(self.judged.shape)) for thickness in starts]
        ends = [fit_model(self._outside, (), np.zeros(0), field, fitted.levels, settings) for field in fields]
        return _Part(self._outside, min(ends, key=lambda fit: fit.chi2))


def _fit_of(part: Part) -> Fit:
    assert isinstance(part, _Part)
    return part.fit
