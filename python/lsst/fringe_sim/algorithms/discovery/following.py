"""Thickness that follows an effect: what is left of a shift of the fringes when the layer may take it up."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...array_types import FloatArray
from .comparison import FEW_CELLS, chi2_with_free_fringes, fringe_order_um, sampled_part
from .fit import Problem

SHIFTS_PER_ORDER, ORDERS_TRIED = 10, 1.5
"""Shifts that are compared before the first step, up to some fringe orders on either side.

Steps find no more than the nearest fringe, and the thickness that suits a model without the effect may lie an order
from the right one.
"""

STEPS = 5
LARGEST_STEP_UM = 0.03
LARGEST_TILT_UM = 0.15
"""Change of thickness in one step, and difference between middle and end in all [µm]: a tenth and half an order."""

SETTLED_UM = 2e-4


class ThicknessFollower:
    """Moves a thickness, in proportion to a straight line in itself, to where an effect at a finite size wants it.

    Many effects shift the fringes first, as a change of thickness does, and weaken or tilt them second. With the
    thickness held, only the shift would be seen; a line in thickness takes it up but for what no thickness can do.

    ``thickness_um``: thickness that is moved [µm], ``(ny, nx)``; ``index``: refractive index of the layer, for the
    fringe order.
    """

    def __init__(self, problem: Problem, thickness_um: FloatArray, index: float) -> None:
        self.problem, self.thickness_um = problem, thickness_um
        order = fringe_order_um(problem.cells.wavelength_nm, index)
        most = round(ORDERS_TRIED * SHIFTS_PER_ORDER)
        self._shifts = np.arange(-most, most + 1) * (order / SHIFTS_PER_ORDER)
        problem.forward.cover(thickness_um + self._shifts[0])
        problem.forward.cover(thickness_um + self._shifts[-1])
        cells = problem.cells
        part, few = sampled_part(thickness_um.size), sampled_part(thickness_um.size, FEW_CELLS)
        self._sample, self._few = thickness_um[part[1:]], thickness_um[few[1:]]
        self._value, self._root = cells.value[part], np.sqrt(cells.weight[part])
        self._compared = cells.value[few], cells.weight[few]
        seen = thickness_um[cells.seen]
        self._middle = float(seen.mean())
        self._half = max(0.5 * float(np.ptp(seen)), 1e-6)

    def places(self, settings: Mapping[str, float]) -> list[FloatArray]:
        """Thicknesses of all cells where the fringes of a model with some effects lie well on the data [µm].

        The best one less than half an order away, and that in another order if it looks better.
        """
        near, best = self._best_shifts(settings)
        return [self._settled(settings, shift) for shift in dict.fromkeys((near, best))]

    def _settled(self, settings: Mapping[str, float], shift: float) -> FloatArray:
        """Thickness of all cells to which steps from a shift lead [µm]."""
        line = np.array([shift, 0.0])
        for _ in range(STEPS):
            step = self._step(settings, line)
            step /= max(1.0, float(np.abs(step).sum()) / LARGEST_STEP_UM)
            line += step
            if abs(line[1]) > LARGEST_TILT_UM:  # other orders at the ends; not for steps to find
                return self.thickness_um
            if np.abs(step).sum() < SETTLED_UM:
                break
        return self.thickness_um + self._along(self.thickness_um) @ line

    def _best_shifts(self, settings: Mapping[str, float]) -> tuple[float, float]:
        """Shifts of all thicknesses with which fringes of any contrast fit best [µm]: of the nearest, and of all."""
        forward = self.problem.forward
        moved = self._few + self._shifts[:, None, None]
        chi2 = chi2_with_free_fringes(forward.sampled(settings, moved).value, *self._compared)
        near = np.abs(np.arange(len(chi2)) - len(chi2) // 2) <= SHIFTS_PER_ORDER // 2
        nearest = np.flatnonzero(near)[int(np.argmin(chi2[near]))]
        return float(self._shifts[nearest]), float(self._shifts[int(np.argmin(chi2))])

    def _along(self, thickness: FloatArray) -> FloatArray:
        depth = np.clip((thickness - self._middle) / self._half, -1.5, 1.5)
        return np.stack([np.ones_like(depth), depth], axis=-1)

    def _step(self, settings: Mapping[str, float], line: FloatArray) -> FloatArray:
        """Gauss-Newton step of the line, with the level of each wavelength free."""
        columns = self._along(self._sample)
        signal = self.problem.forward.sampled(settings, self._sample + columns @ line)
        model = self._root * signal.value
        square = np.maximum((model**2).sum(axis=(1, 2)), 1e-300)[:, None, None]

        def without_level(values: FloatArray) -> FloatArray:
            return values - model * ((model * values).sum(axis=(1, 2))[:, None, None] / square)

        data = self._root * self._value
        level = (model * data).sum(axis=(1, 2))[:, None, None] / square
        features = np.stack(
            [without_level(level * self._root * signal.slope * columns[..., k]).ravel() for k in range(2)]
        )
        matrix = features @ features.T
        matrix[np.diag_indices(2)] *= 1.0 + 1e-9
        if not matrix[1, 1] > 0.0:  # all of one thickness
            return np.array([features[0] @ without_level(data).ravel() / max(matrix[0, 0], 1e-300), 0.0])
        return np.asarray(np.linalg.solve(matrix, features @ without_level(data).ravel()))
