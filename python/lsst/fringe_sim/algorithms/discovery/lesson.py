"""What the search on one likelihood gives to learn corrections from; see `learning`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt

from ...array_types import BoolArray, FloatArray
from ...effects import ImageGeometry
from ..inference import Hypothesis, Point, Problem, fit, in_best_orders, relaxed
from .cells import CellData
from .channels import State
from .columns import Columns, PlaneColumns, Projected
from .continuation import filled
from .learned_columns import with_learned
from .learning import Part, judging_cells
from .outliers import spoiled_cells
from .preparation import Prepared, data_of, in_shape


def with_corrections(point: Point) -> Point:
    """The same point of a model whose corrections may be set."""
    forward = point.problem.forward
    known = replace(forward, catalogue=with_learned(forward.catalogue), _by_name={})
    return replace(point, problem=replace(point.problem, forward=known))


def in_own_cells(first: Point) -> Point:
    """Levels and thickness of cells that had no part in a fit, at their best for its effects."""
    return relaxed(in_best_orders(relaxed(first, rounds=4)), rounds=6)


def in_all_cells(prepared: Prepared, point: Point) -> Point:
    """A point at all cells, those held out with the shape of the thickness of all: it was guessed there.

    Cells that were searched keep the shape with which effects were chosen.
    """
    cells, held = together(prepared), prepared.unseen.seen.ravel()
    old, (_, own) = point.problem.forward.shape, in_shape(point, cells)
    shape = replace(
        old,
        gradient=np.where(held, own.gradient, old.gradient),
        hessian=np.where(held, own.hessian, old.hessian),
    )
    problem = replace(point.problem, forward=replace(point.problem.forward, shape=shape))
    return problem.at(point.settings, point.levels, point.thickness_um)


@dataclass(frozen=True, eq=False)
class CellPart(Part):
    """Cells at a point, the effects held; levels, response and thickness of the cells are projected out."""

    point: Point
    noise_rms: float
    only: str = ""

    @property
    def settings(self) -> dict[str, float]:
        """Effects by ``name.parameter``."""
        return self.point.settings

    @property
    def geometry(self) -> ImageGeometry:
        """Centres of the cells, wavelengths."""
        return self.point.problem.forward.geometry

    def _image(self, values: FloatArray) -> FloatArray:
        """Values ``(..., N)`` on the grid of the cells."""
        return values.reshape(*values.shape[:-1], *self.geometry.sample_shape)

    @cached_property
    def state(self) -> State:
        """Residual, model and noise."""
        point = self.point
        root, value = self._image(point.root), self._image(point.value * point.levels[:, np.newaxis])
        raw = np.where(root > 0.0, self._image(point.problem.data.value) - value, 0.0)
        residual = self._image(point.unbiased_residual)
        return State(self._image(point.steep), residual, raw, value, self._image(point.thickness_um), root)

    @property
    def chi2(self) -> float:
        """χ² of all cells with response and thickness at their best."""
        return float(self._chi2.sum())

    @cached_property
    def _chi2(self) -> FloatArray:
        point = self.point
        away = (point.thickness_um - point.problem.thickness_um) / point.problem.thickness_sigma_um
        fitted = (point.residual_cells**2).sum(axis=0)
        return np.asarray((point.residual**2).sum(axis=0) + away**2 - fitted)

    def chi2_of(self, cells: BoolArray) -> float:
        """The same of some of the cells ``(ny, nx)``."""
        return float(self._chi2[cells.ravel()].sum())

    @property
    def rms(self) -> float:
        """Rms of data minus model, corrected for the freedom of all that is fitted."""
        return self.noise_rms * self.point.misfit(self.point.problem.free_levels)

    @property
    def planes(self) -> int:
        """Random numbers of a cell: one for each exposure, one for its response, one for its thickness."""
        return len(self.point.levels) + 2

    def change(self, settings: dict[str, float]) -> FloatArray:
        """What other settings change in the data, ``(W, ny, nx)``."""
        point = self.point
        value, _ = point.problem.forward.predict(settings, point.thickness_um)
        return self._image((value - point.value) * point.levels[:, np.newaxis])

    def of_noise(self, numbers: FloatArray) -> FloatArray:
        """Noise of the exposures, scatter of the response, and errors of the first thickness."""
        problem = self.point.problem
        response, steep = self._image(self.point.response), self._image(self.point.steep)
        sigma_um = np.broadcast_to(problem.thickness_sigma_um, self.point.thickness_um.shape)
        moved = self._image(sigma_um) * numbers[-1]
        own = np.where(self._image(self.point.root) > 0.0, numbers[:-2], 0.0)
        return np.asarray(own + response * problem.response_sigma * numbers[-2] + steep * moved)

    def own_scores(self, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scores of the cells, and of the levels with the cells integrated."""
        flat = residual.reshape(len(residual), -1)
        return self._beside(flat, self.point._forward_solved(self.point._along(flat)))

    def own_scores_of_data(self) -> tuple[FloatArray, FloatArray]:
        """The same of the data, with what draws the thickness beside them."""
        return self._beside(self.point.unbiased_residual, self.point.residual_cells)

    def _beside(self, flat: FloatArray, cells: FloatArray) -> tuple[FloatArray, FloatArray]:
        levels = self.point.level_columns
        own = levels.along(flat)
        return cells, own - np.tensordot(levels.cells, cells, axes=([1, 2], [0, 1]))

    def projection(self, columns: Columns) -> tuple[Projected, FloatArray]:
        """Score and information of columns beside levels and cells."""
        point, levels = self.point, self.point.level_columns
        along = [columns.along(self._image(own)) for own in (point.response, point.steep)]
        cells = point._forward_solved(np.stack([own.reshape(len(own), -1) for own in along], axis=1))
        planes = np.arange(len(point.levels))
        design = point.problem.level_design
        own_levels = PlaneColumns(self._image(point.value * point.root), planes, design)
        both = ([1, 2], [1, 2])
        cross = columns.against(own_levels) - np.tensordot(cells, levels.cells, axes=both)
        within = np.linalg.solve(point.information(levels, levels), cross.T)

        def score(residual: FloatArray, own: tuple[FloatArray, FloatArray]) -> FloatArray:
            of_cells = np.tensordot(cells, own[0], axes=([1, 2], [0, 1]))
            return np.asarray(columns.dot(residual) - of_cells - within.T @ own[1])

        return score, np.asarray(columns.gram - np.tensordot(cells, cells, axes=both) - cross @ within)


@dataclass(frozen=True, eq=False)
class CellLesson:
    """All cells of a search, those held out among them, split anew into cells that teach and cells that judge."""

    found: Hypothesis
    problem: Problem
    cells: CellData
    held_out: BoolArray
    start: Point

    @classmethod
    def of(cls, prepared: Prepared, found: Hypothesis) -> CellLesson:
        """From a set of effects that was fitted to the part searched."""
        cells, unseen = together(prepared), prepared.unseen.seen
        start = in_all_cells(prepared, unseen_too(prepared, with_corrections(found.point), cells))
        left = (start.problem.data.value - start.levels[:, np.newaxis] * start.value).reshape(cells.shape)
        cells = cells.restricted(~(spoiled_cells(left, cells.weight > 0.0) & unseen))
        # Cells without data stay where they were.
        problem = replace(start.problem.about(start.thickness_um), data=data_of(cells))
        return cls(found, problem, cells, unseen, start)

    @property
    def judged(self) -> BoolArray:
        """Cells that judge, ``(ny, nx)``."""
        judged = judging_cells(self.held_out.shape)
        return judged if (judged & self.cells.seen).any() else np.zeros_like(judged)

    @property
    def noise_floor(self) -> float:
        """Rms of the noise."""
        return self.cells.noise_rms

    def teaching(self) -> CellPart:
        """The cells that teach, with the effects fitted to them."""
        start = self._at(~self.judged, self.start, self.start.settings)
        fitted = fit(self.found.effects, self.found.items, start)
        return CellPart(fitted.point, self.noise_floor)

    def again(self, taught: Part, settings: dict[str, float], only: str) -> CellPart:
        """The same cells with other settings."""
        point = _point_of(taught)
        moved = relaxed(point.moved(point.levels, point.thickness_um, settings), rounds=6)
        return CellPart(moved, self.noise_floor, only)

    def judging(self, taught: Part, settings: dict[str, float]) -> CellPart:
        """The cells that judge."""
        first = self._at(self.judged, _point_of(taught), settings)
        return CellPart(in_own_cells(first), self.noise_floor)

    def _at(self, cells: BoolArray, point: Point, settings: dict[str, float]) -> Point:
        """The data of some of the cells, near a point."""
        problem = replace(self.problem, data=data_of(self.cells.restricted(cells)))
        return problem.at(settings, point.levels, point.thickness_um)


def in_all_data(prepared: Prepared, found: Hypothesis) -> tuple[Hypothesis, Hypothesis]:
    """The unchanged model and a set that was fitted to the part searched, both fitted to all data after selection.

    Cells held out have the shape of a thickness that was fitted to them.
    """
    lesson = CellLesson.of(prepared, found)
    first = fit(found.effects, found.items, replace(lesson.start, problem=lesson.problem))
    reshaped = in_all_cells(prepared, first.point)
    whole, problem = fit(found.effects, found.items, reshaped), reshaped.problem
    unchanged = unseen_too(prepared, with_corrections(prepared.point), together(prepared))
    null = fit((), (), problem.at({}, unchanged.levels, unchanged.thickness_um))
    return null, whole


def _point_of(part: Part) -> Point:
    assert isinstance(part, CellPart)
    return part.point


def unseen_too(prepared: Prepared, point: Point, cells: CellData) -> Point:
    """A fit to the part searched, at all cells; those held out are in their likeliest place.

    Fringes may be a few cells wide, and a thickness that is continued to the middle of a block be in another order.
    So blocks are entered from their rims, and what is found there is continued, twice as far every time.

    ``cells``: see `together`.
    """
    known, shape = prepared.cells.seen, cells.shape[1:]
    away = distance_transform_edt(~known)
    point = point.problem_with(data_of(cells))
    if point.problem.known:
        return point  # they are where it has them
    reach = 1.0
    while not known.all():
        start = filled(point.thickness_um.reshape(shape), known).ravel()
        near = away <= reach
        moves = (near & ~known & cells.seen).ravel()
        point = in_best_orders(point.moved(point.levels, start), moves, rounds=3)
        known, reach = known | near, 2.0 * reach
    return point


def together(prepared: Prepared) -> CellData:
    """The part searched and the part held out, which is over a mean of its own, in the same units."""
    cells, unseen = prepared.cells, prepared.unseen
    level = cells.geometry.level_e
    ratio = np.divide(unseen.geometry.level_e, level, out=np.ones_like(level), where=level > 0.0)
    ratio = np.where(np.isfinite(ratio), ratio, 1.0)[:, np.newaxis, np.newaxis]
    there = unseen.weight > 0.0
    return replace(
        cells,
        value=np.where(there, unseen.value * ratio, cells.value),
        weight=np.where(there, unseen.weight / ratio**2, cells.weight),
    )
