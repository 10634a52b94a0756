"""Which further flats would tell effects apart that a search has left in one class, by its own likelihood.

As for frames of the sky (`.next_frames`): further flats are of the same cells, with the thickness and the response
that these have, and with levels of their own. What two effects do differently is taken between their fits, each at
the thickness that suits it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...array_types import FloatArray
from ...errors import InputError
from ...model import FringeModel
from ..inference import Data, Forward, Hypothesis, Point, Problem, solved
from ..next_measurement import (
    FlatMeasurement,
    FlatSeries,
    Measurement,
    PairForecast,
    RankedMeasurement,
    candidate_measurements,
)
from .cells import CellData
from .next_step import more_pixels

MOST_CELLS = 4096  # Cells for which a forecast is made; of more, so many stand for all
MARGIN_UM = 0.1  # Thickness beyond that of the cells which tables of further flats cover [µm]


@dataclass(frozen=True, eq=False)
class Seen:
    """What some flats show of every cell that stands for the sensor."""

    value: FloatArray  # (W, N)
    slope: FloatArray
    weight: FloatArray
    asked: FloatArray  # (K, W, N): differences and derivatives


@dataclass(frozen=True, eq=False)
class FlatForecast:
    """Information of flats that are there, and of flats that could be taken, about effects of a class."""

    best: Hypothesis
    model: FringeModel  # as it is known before the search
    cells: CellData

    def ranked(self, name: str, rivals: Mapping[str, Hypothesis]) -> tuple[RankedMeasurement, ...]:
        """Flats by how well they would tell an effect from others, best first.

        ``rivals``: the best set with another effect in its place, by that effect.
        """
        here = self._seen(self.best.point.problem.forward, None, name, rivals)
        present = self._information([here])
        found = []
        for measurement, after in self._further(name, rivals, here):
            pairs, first = [], 1
            for other, rival in rivals.items():
                own = slice(first, first + 1 + len(rival.items))
                first = own.stop
                now, then = pair_of(present, own), pair_of(after, own)
                pairs.append(PairForecast(name, other, now[0], then[0], now[1], then[1]))
            pairs.sort(key=lambda pair: pair.separation_after)
            found.append(RankedMeasurement(measurement, tuple(pairs)))
        found.sort(key=lambda item: -item.separation)
        if self.best.point.problem.levels_known and found:
            found.append(more_pixels(found[0], self.cells))
        return tuple(sorted(found, key=lambda item: -item.separation))

    def _further(
        self, name: str, rivals: Mapping[str, Hypothesis], here: Seen
    ) -> Iterator[tuple[Measurement, FloatArray]]:
        """What could be measured, and the information of all data then; ``here``: what those show that are there."""
        for measurement in self._candidates():
            try:
                further = self._seen(self._forward(measurement.series), measurement.series, name, rivals)
            except InputError:  # what the effects cannot be under these conditions
                continue
            yield measurement, self._information([here, further])

    def _candidates(self) -> tuple[FlatMeasurement, ...]:
        geometry = self.cells.geometry
        levels = geometry.level_e[np.isfinite(geometry.level_e) & (geometry.level_e > 0.0)]
        times = geometry.dark_time_s.tolist()
        known = {"level_e": float(levels.mean())} if levels.size else {}
        return candidate_measurements(
            self.model, self.cells.wavelength_nm.tolist(), **known,
            dark_time_s=times if min(times) > 0.0 else (),
        )  # fmt: skip

    @property
    def _order(self) -> NDArray[np.int64]:
        """Cells that stand for all."""
        seen = np.flatnonzero(self.best.point.problem.data.seen)
        if len(seen) <= MOST_CELLS:
            return seen
        return seen[np.linspace(0, len(seen) - 1, MOST_CELLS).astype(int)]

    def _forward(self, series: FlatSeries) -> Forward:
        """Model of the cells under the conditions of further flats."""
        forward, thickness = self.best.point.problem.forward, self.best.point.thickness_um
        waves = np.array(series.wavelength_nm)
        times = np.array(series.dark_time_s) if series.dark_time_s else np.zeros(len(waves))
        geometry = replace(
            forward.geometry,
            wavelength_nm=waves,
            level_e=np.full(len(waves), series.level_e),
            dark_time_s=times,
        )
        reach = max(float(thickness.min()) - MARGIN_UM, 0.05), float(thickness.max()) + MARGIN_UM
        if self.best.point.problem.levels_known:
            reach = forward.range_um  # levels are those of the same thicknesses
        model = series.conditions(self.model)
        return Forward(model, forward.catalogue, geometry, forward.shape, reach)

    def _seen(
        self, forward: Forward, series: FlatSeries | None, name: str, rivals: Mapping[str, Hypothesis]
    ) -> Seen:
        """What flats show; ``series``: conditions of further ones, none for those that are there."""
        order, own = self._order, self.best.point
        value, slope = forward.predict(self._under(series, own.settings), own.thickness_um)
        rest = {key: x for key, x in own.settings.items() if key.partition(".")[0] != name}
        asked = [value - forward.predict(self._under(series, rest), own.thickness_um)[0]]
        for rival in rivals.values():
            there, at = rival.point.thickness_um, rival.point.settings
            other = forward.predict(self._under(series, at), there)[0]
            asked.append(value - other)
            for item in rival.items:
                now = at.get(item.key, item.null)
                step = item.difference(now)
                moved = self._under(series, {**at, item.key: now + step})
                asked.append((forward.predict(moved, there)[0] - other) / step)
        if series is None:
            weight = own.problem.data.weight[:, order] * own.levels[:, np.newaxis] ** 2
            weight = np.resize(
                weight, (len(value), len(order))
            )  # further frames have the noise of those there
        else:
            weight = np.full((len(value), len(order)), series.level_e * self.cells.cell_px**2)
        weight = weight * (own.problem.data.seen.sum() / len(order))
        return Seen(value[:, order], slope[:, order], weight, np.stack(asked)[:, :, order])

    def _under(self, series: FlatSeries | None, settings: Mapping[str, float]) -> Mapping[str, float]:
        """Settings under other conditions: those whose null a set-up states keep their ratio to it."""
        if series is None:
            return settings
        forward = self.best.point.problem.forward
        model = self.model.with_effects({**self.model.effect_settings, **settings}, forward.catalogue)
        return {
            f"{item.effect.name}.{key}": value
            for item in series.conditions(model).effects
            for key, value in item.values.items()
        }

    def _information(self, seen: list[Seen], problem: Problem | None = None) -> FloatArray:
        """Products of what is asked with one another, all that is free projected out.

        ``problem``: what is known of the cells beforehand; that of the search by default.
        """
        value, slope, weight = (
            np.concatenate([getattr(one, name) for one in seen]) for name in ("value", "slope", "weight")
        )
        asked = np.concatenate([one.asked for one in seen], axis=1)
        at = self.best.point.thickness_um[self._order]
        data = Data(value, weight)
        problem = problem or self.best.point.problem
        # Each stands for several, which are known better together.
        several = problem.data.seen.sum() / len(at)
        sigma = np.broadcast_to(problem.thickness_sigma_um, problem.thickness_um.shape)[self._order]
        problem = replace(problem, data=data, thickness_um=at, thickness_sigma_um=sigma / np.sqrt(several))
        point = Point(problem, {}, np.ones(len(value)), at, value, slope)
        columns = point.bare_columns(point.whitened(asked))
        shapes = np.ones((len(value), 1)) if problem.levels_known else np.eye(len(value))
        levels = point.bare_columns(shapes.T[:, :, np.newaxis] * point.response)
        across = point.information(levels, columns)
        within = np.linalg.solve(point.information(levels, levels), across)
        return np.asarray(point.information(columns, columns) - across.T @ within)


def pair_of(information: FloatArray, own: slice) -> tuple[float, float]:
    """Likeness of the effect and another one, and the standard deviations by which the other fits worse."""
    difference, tangent = own.start, slice(own.start + 1, own.stop)
    cross = information[tangent, difference]
    moved = float(cross @ solved(information[tangent, tangent], cross))
    left = max(float(information[difference, difference]) - moved, 0.0)
    strength = float(information[0, 0])
    likeness = math.sqrt(max(1.0 - left / strength, 0.0)) if strength > 0.0 else math.nan
    return likeness, math.sqrt(left)
