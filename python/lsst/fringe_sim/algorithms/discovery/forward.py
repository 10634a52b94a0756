"""What the model says of the cells: value and thickness derivative for any effects and any thickness field."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, FloatArray
from ...compiled import contiguous, kernel, run_shares, subkernel
from ...effects import ActiveEffect, Effect, ImageGeometry, activate_effects, apply_to_image
from ...model import FringeModel
from ...optics.illumination import Illumination
from ..exposures import Exposures
from .cells import CellData
from .evaluations import note_evaluation
from .slopes import Slopes

Settings = Mapping[str, float]

TABLE_STEP_UM = 0.004
"""Spacing of the thickness grid [µm]: 75 per fringe order; cubic interpolation is good to 1e-6."""

TABLE_TOLERANCE = 1e-9
"""Error of the tables relative to the fringes; derivatives are differences of tables 1e-5 apart."""

LINE_STEP_NM = 0.1
"""Spacing of wavelength nodes [nm]: five per fringe of detection layer and support together."""

MARGIN_UM = 0.45  # Thickness beyond the field that a table covers [µm]: a step of a fit may not leave it
NO_DISTANCE_PX = 1e-12  # Distance between the centroids of a cell that is rounding
MOST_TABLE_BYTES = 400e6  # Memory of the tables kept for reuse
MOST_ROWS = 8  # Rows kept for each exposure while wavelengths are moved
LEAST_SPREAD = 1e-12  # Variance of the thickness in a cell that is rounding [steps of the table squared]
UNIFORM = 1.8  # Fourth moment of what is uniform, over the square of its second
LEAST_PART = 1e-6  # Part of a cell that is rounding
_LEAST_LOOKUPS = 20_000  # Cells times wavelengths that are worth a thread
_BLOCK = 256  # Cells that a core interpolates at a time

FARTHEST_UM = 3.0
"""Thickness by which a field may leave the first range [µm]: ten fringe orders. What goes farther does not fit."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Model values of the cells."""

    value: FloatArray  # (W, ny, nx): signal relative to its mean over the thicknesses of the tables
    slope: FloatArray  # (W, ny, nx): its derivative with respect to thickness [1/µm]


@dataclass(frozen=True, eq=False)
class _PartOfCells:
    """Thickness in a part of every cell, relative to that of the cell."""

    away_um: FloatArray  # (ny, nx): its mean
    # second, fourth (ny, nx): its moments about that [µm², µm⁴]
    second: FloatArray
    fourth: FloatArray

    @classmethod
    def of(cls, part: FloatArray, moments: FloatArray, whole: tuple[FloatArray, FloatArray]) -> _PartOfCells:
        """From the means over the cells of the thickness and its square in the part, and the moments of the whole."""
        some = (part > LEAST_PART) & (part < 1.0 - LEAST_PART)
        away, square = (np.divide(each, part, out=np.zeros(part.shape), where=some) for each in moments)
        second = np.where(some, np.maximum(square - away**2, 0.0), whole[0])
        return cls(away, second, np.where(some, UNIFORM * second**2, whole[1]))


@dataclass(frozen=True, eq=False)
class _Light:
    """Value of all cells before effects on the image, and for what it is."""

    key: tuple[tuple[tuple[str, float], ...], tuple[float, float]]
    thickness_um: FloatArray
    scatter_um2: FloatArray | None
    value: FloatArray

    def is_at(self, thickness_um: FloatArray, scatter_um2: FloatArray | None) -> bool:
        """Whether it is for these very arrays."""
        return self.thickness_um is thickness_um and self.scatter_um2 is scatter_um2


@dataclass(eq=False)
class Forward:
    """Model of one sensor on cells."""

    model: FringeModel  # the model as it is known before the search
    catalogue: Sequence[Effect]  # effects that may be set
    geometry: ImageGeometry
    cell_px: int  # side of a cell [px]
    # Thicknesses that the tables cover; grows on demand, by `FARTHEST_UM` at most, which changes no answer
    range_um: tuple[float, float]
    centroid: FloatArray | None = None  # (2, W, ny, nx): see `CellData`
    # (ny, nx): cells with data; by default all. The thickness of others is not known, and slopes do not
    # lean on it.
    seen: BoolArray | None = None
    exposures: Exposures | None = None  # the light; monochromator flats by default
    # (ny, nx): variance of the thickness at which a cell is looked up about the true one [µm²]; by
    # default none
    scatter_um2: FloatArray | None = None
    # Places along the side of a pixel at which it sees the thickness; 0, the default, for all of its
    # area, as real pixels do
    places: int = 0
    reference_um: tuple[float, float] | None = (
        None  # thicknesses over which the mean light is 1: the first range
    )
    _tables: dict[tuple[tuple[str, float], ...], tuple[FloatArray, FloatArray]] = field(
        default_factory=dict, repr=False
    )
    _rows: dict[tuple[int, float], FloatArray] = field(default_factory=dict, repr=False)
    _rows_of: tuple[tuple[str, float], ...] | None = field(default=None, repr=False)
    place_weight: FloatArray | None = field(init=False, repr=False, default=None)
    _limits_um: tuple[float, float] = field(init=False, repr=False)
    _by_name: dict[str, Effect] = field(init=False, repr=False)
    _last_light: _Light | None = field(init=False, repr=False, default=None)
    _centroids: tuple[FloatArray, FloatArray | None] | None = field(init=False, repr=False, default=None)
    _slopes: Slopes | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        self._by_name = {effect.name: effect for effect in self.catalogue}
        if self.reference_um is None:
            self.reference_um = self.range_um
        low, high = self.reference_um
        self._limits_um = (max(low - FARTHEST_UM, 0.05), high + FARTHEST_UM)
        if self.centroid is not None:
            common = self.centroid.mean(axis=1)
            rest = self.centroid - common[:, np.newaxis]
            differ = bool(np.abs(rest).max() > NO_DISTANCE_PX)
            self._centroids = common, rest if differ else None
        if self.exposures is not None:
            weight = self.exposures.place_weight(self.geometry)
            self.place_weight = weight if len(weight) > 1 else None

    @classmethod
    def of_cells(
        cls,
        model: FringeModel,
        catalogue: Sequence[Effect],
        cells: CellData,
        range_um: tuple[float, float],
        exposures: Exposures | None = None,
    ) -> Forward:
        """Forward model of the cells of ``cells`` for a thickness range [µm]."""
        return cls(
            model, catalogue, cells.geometry, cells.cell_px, range_um, cells.centroid, cells.seen, exposures
        )

    def with_places(self, places: int) -> Forward:
        """The same with pixels that see their area (0), or so many places on each side; tables are kept."""
        return self._with(places=places)

    def with_seen(self, seen: BoolArray) -> Forward:
        """The same with data in fewer cells; tables are kept."""
        return self._with(seen=seen)

    def with_scatter(self, scatter_um2: FloatArray | None) -> Forward:
        """The same with thicknesses that scatter so much about the true ones; tables are kept."""
        return self._with(scatter_um2=scatter_um2)

    def _with(self, **changes: Any) -> Forward:
        """The same with changes that leave the tables as they are."""
        return replace(self, _tables=dict(self._tables), _rows=dict(self._rows), **changes)

    def scatter_of(self, thickness_um: FloatArray, errors_um: FloatArray) -> FloatArray:
        """Variance of a thickness that has such errors, ``(K, ny, nx)``, and what their slopes do to the cells [µm²].

        Cells average the fringes over their slope, which has errors too.
        """
        plain = self._spread_of_pixels(self.gradient(thickness_um))[0]
        spreads = [self._spread_of_pixels(self.gradient(thickness_um + error))[0] for error in errors_um]
        return np.asarray((errors_um**2).mean(axis=0) + np.mean(spreads, axis=0) - plain)

    def table(self, settings: Settings) -> FloatArray:
        """Response ``(W, D)`` on the grid of thickness, relative to its mean, as flats are.

        Light that changes over the field has such rows for each of its places, ``(K * W, D)``.
        Effects on the image are parts of that mean, whatever effects on the response make of it. Local effects are
        not in it.
        """
        return self._table_and_level(settings)[0]

    def _table_and_level(self, settings: Settings) -> tuple[FloatArray, FloatArray]:
        """The table, and the level of each of its rows, ``(rows, 1)``."""
        key = self._key({**self.model.effect_settings, **self._optical(settings)})
        if key not in self._tables:
            low, count = self._grid()
            response = self._response(settings, low, count)
            first, last = self._grid_indices(self._reference)
            # Tapered, so that a broken fringe order at an end of the range does not count.
            taper = np.hanning(last - first + 3)[1:-1]
            mean = np.average(response[:, first : last + 1], axis=1, weights=taper)
            each = mean.reshape(-1, len(self.geometry.wavelength_nm)).mean(axis=0)  # over all places
            level = np.resize(each, len(mean))[:, np.newaxis]
            self._keep(key, (response / level, level))
        return self._tables[key]

    def _island_tables(self, settings: Settings) -> list[tuple[ActiveEffect, FloatArray]]:
        """Local effects, each with the table of where it is, relative to the level of all other places."""
        found = []
        for item, model in self.model_with(settings).islands:
            key = self._key({**model.effect_settings, **self._own(item)})
            if key not in self._tables:
                level = self._table_and_level(settings)[1]
                self._keep(key, (self._fresh_response(model, *self._grid()) / level, level))
            found.append((item, self._tables[key][0]))
        return found

    @staticmethod
    def _own(item: ActiveEffect) -> dict[str, float]:
        """What a local effect changes where it is."""
        places = item.effect.search.places
        return {f"{item.effect.name}.{name}": x for name, x in item.values.items() if name not in places}

    @staticmethod
    def _key(settings: Settings) -> tuple[tuple[str, float], ...]:
        return tuple(sorted(settings.items()))

    def _keep(self, key: tuple[tuple[str, float], ...], table: tuple[FloatArray, FloatArray]) -> None:
        self._tables[key] = table
        while len(self._tables) * table[0].nbytes > MOST_TABLE_BYTES and len(self._tables) > 2:
            self._tables.pop(next(iter(self._tables)))

    @property
    def _reference(self) -> tuple[float, float]:
        assert self.reference_um is not None
        return self.reference_um

    def _grid(self) -> tuple[float, int]:
        """First thickness of the tables [µm], and their number of thicknesses."""
        return self.range_um[0], self._grid_indices(self.range_um)[1] + 1

    def _grid_indices(self, range_um: tuple[float, float]) -> tuple[int, int]:
        """First and last place of the tables for a range that begins at one of them."""
        first = round((range_um[0] - self.range_um[0]) / TABLE_STEP_UM)
        return first, first + math.ceil((range_um[1] - range_um[0]) / TABLE_STEP_UM)

    def _fresh_response(self, model: FringeModel, low_um: float, count: int) -> FloatArray:
        """Response ``(W, count)`` of a model on the grid, or of all places of the field."""
        wavelength = self.geometry.wavelength_nm
        if self.exposures is not None:
            return self.exposures.response(model, low_um, TABLE_STEP_UM, count)
        light = model.system.flat_fields(wavelength, LINE_STEP_NM)
        return model.respond_on_grid(
            light, low_um, TABLE_STEP_UM, count, wavelength, tolerance=TABLE_TOLERANCE
        )

    def _response(self, settings: Settings, low_um: float, count: int) -> FloatArray:
        """The same for some effects; what an exposure sees is kept while only others are moved."""
        model, wavelength = self.model_with(settings), self.geometry.wavelength_nm
        if self.exposures is not None:
            return self._fresh_response(model, low_um, count)
        light = model.system.flat_fields(wavelength, LINE_STEP_NM)
        rest = self._key(
            {key: value for key, value in self._optical(settings).items() if not self._moves_wavelengths(key)}
        )
        if rest != self._rows_of:
            self._rows_of = rest
            self._rows.clear()
        keys = [(row, float(place)) for row, place in enumerate(light.wavelength_nm[:, 0])]
        fresh = [key for key in keys if key not in self._rows]
        if fresh:
            rows = [row for row, _ in fresh]
            part = Illumination(light.wavelength_nm[rows], light.theta[rows], light.weight[rows])
            response = model.respond_on_grid(
                part, low_um, TABLE_STEP_UM, count, wavelength[rows], tolerance=TABLE_TOLERANCE
            )
            self._rows.update(zip(fresh, response, strict=True))
        result = np.stack([self._rows[key] for key in keys])
        while len(self._rows) > MOST_ROWS * len(keys):
            self._rows.pop(next(iter(self._rows)))
        return result

    def _moves_wavelengths(self, key: str) -> bool:
        return self._effect(key.partition(".")[0]).search.moves_wavelengths

    def model_with(self, settings: Settings) -> FringeModel:
        """The model with those of some effects that do not act on the image."""
        known = {**self.model.effect_settings, **self._of_light(settings)}
        return self.model.with_effects(known, self.catalogue)

    def cover(self, thickness_um: FloatArray) -> None:
        """Extend the tables so that they cover a thickness field with a margin, as far as it may go."""
        low, high = self.range_um
        lowest, highest = self._limits_um
        wanted_low = max(float(thickness_um.min()) - MARGIN_UM, lowest)
        wanted_high = min(float(thickness_um.max()) + MARGIN_UM, highest)
        if wanted_low < low or wanted_high > high:
            below = max(min(wanted_low - MARGIN_UM, low), lowest)
            # Whole steps, so that what was in the tables stays where it was.
            steps = math.ceil((self._reference[0] - below) / TABLE_STEP_UM - 1e-9)
            self.range_um = (
                self._reference[0] - steps * TABLE_STEP_UM,
                min(max(wanted_high + MARGIN_UM, high), highest),
            )
            self._tables.clear()
            self._rows.clear()

    def predict(self, settings: Settings, thickness_um: FloatArray) -> Prediction:
        """Model of the cells.

        ``thickness_um`` (ny, nx): thickness at the centres of the cells, within the tables.
        """
        value, slope = self._light(settings, thickness_um)
        image_settings = self._image(settings)
        if not image_settings:
            return Prediction(value, slope)
        changed = self._on_image(image_settings, value)
        nudge = 1e-3  # µm; effects on the image are nearly linear in the signal
        beside = self._on_image(image_settings, value + nudge * slope)
        return Prediction(changed, (beside - changed) / nudge)

    def slope_changes(self, settings: Settings, thickness_um: FloatArray) -> FloatArray:
        """Derivative with respect to the change of the thickness per cell along rows and columns, ``(2, W, ny, nx)``.

        A blur carries what the thickness does beside a cell into it. Together with the slope of `predict`, which is
        that of a field that moves as a whole, they are exact where it changes evenly.
        """
        nearby = {**settings, **self._without_far_reaching(settings)}
        nudge = 1e-7  # µm from one cell to the next: linear over the whole field
        # Not what is known already: other tables than those of the tilted ones are too far off.
        before = self.predict(nearby, thickness_um)
        found = []
        for place in np.meshgrid(
            *(np.arange(size) - 0.5 * size for size in thickness_um.shape), indexing="ij"
        ):
            tilted = self.predict(nearby, thickness_um + nudge * place).value
            found.append((tilted - before.value) / nudge - place * before.slope)
        return np.stack(found)

    def _without_far_reaching(self, settings: Settings) -> dict[str, float]:
        """Null values of the effects that carry signal farther than the thickness changes evenly."""
        found = {}
        for key in self._image(settings):
            name, _, parameter = key.partition(".")
            if self._effect(name).search.reach == "far":
                found[key] = self._effect(name).parameter(parameter).null
        return found

    def change(self, before: Settings, after: Settings, thickness_um: FloatArray) -> FloatArray:
        """What other settings do to the cells, ``(W, ny, nx)``: the difference of two predictions."""
        images = self._image(before), self._image(after)
        if any(images) or self._has_islands(before) or self._has_islands(after):
            first, second = (self._kept_light(each, thickness_um) for each in (before, after))
            return self._on_image(images[1], second) - self._on_image(images[0], first)
        table = self.table(after) - self.table(before)
        if self.place_weight is not None:
            return self._at_cells(table, thickness_um)[0]
        # Effects on single exposures leave most planes as they are.
        rows = np.flatnonzero(table.any(axis=1))
        result = np.zeros((len(table), *thickness_um.shape))
        if rows.size:
            result[rows] = self._at_cells(table, thickness_um, rows)[0]
        return result

    def _has_islands(self, settings: Settings) -> bool:
        known = {**self.model.effect_settings, **settings}
        return any(self._effect(key.partition(".")[0]).local for key in known)

    def _islands(self, settings: Settings) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Part of every cell, ``(ny, nx)``, that has a local effect, its moments, and the table there."""
        if not self._has_islands(settings):
            return []
        return [
            (
                item.coverage(self.model.base_system, self.geometry),
                item.coverage_moments(self.model.base_system, self.geometry),
                table,
            )
            for item, table in self._island_tables(settings)
        ]

    def _parted(
        self, islands: Sequence[tuple[FloatArray, FloatArray, FloatArray]], thickness_um: FloatArray
    ) -> list[_PartOfCells | None]:
        """Thickness in what lies outside all islands, and on each of them."""
        if not islands:
            return [None]
        gradient = self.gradient(thickness_um)
        whole = self._spread_of_pixels(gradient)
        parts = [part for part, _, _ in islands]
        moments = [_along(gradient, moment) for _, moment, _ in islands]
        rest = 1.0 - np.sum(parts, axis=0)
        left = np.stack([np.zeros(rest.shape), whole[0]]) - np.sum(moments, axis=0)
        return [
            _PartOfCells.of(part, moment, whole)
            for part, moment in zip([rest, *parts], [left, *moments], strict=True)
        ]

    def _light(self, settings: Settings, thickness_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value and slope at all cells before effects on the image."""
        islands = self._islands(settings)
        outside, *on = self._parted(islands, thickness_um)
        value, slope = self._at_cells(self.table(settings), thickness_um, seen=outside)
        for (part, _, table), seen in zip(islands, on, strict=True):
            inside = self._at_cells(table, thickness_um, seen=seen)
            value, slope = (
                all_ + part * (own - all_) for all_, own in zip((value, slope), inside, strict=True)
            )
        return value, slope

    def _kept_light(self, settings: Settings, thickness_um: FloatArray) -> FloatArray:
        """Value before effects on the image; kept, as derivatives of many of them ask for it at one thickness."""
        key = self._key(self._of_light(settings)), self.range_um
        last = self._last_light
        if last is None or last.key != key or not last.is_at(thickness_um, self.scatter_um2):
            value = self._light(settings, thickness_um)[0]
            last = self._last_light = _Light(key, thickness_um, self.scatter_um2, value)
        return last.value

    def _on_image(self, settings: Settings, value: FloatArray) -> FloatArray:
        """Cells with effects on the image."""
        active = activate_effects(settings, self.catalogue)
        return apply_to_image(active, self.model.base_system, value, self.geometry)

    def _at_cells(
        self,
        table: FloatArray,
        thickness_um: FloatArray,
        rows: NDArray[np.intp] | None = None,
        seen: _PartOfCells | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Value and slope of some rows of a table, averaged over the cells or a part; shape ``(R, ny, nx)``."""
        note_evaluation()
        gradient = self.gradient(thickness_um)
        spread = self._spread_of_pixels(gradient)
        place, rest = self._at_centroids(thickness_um, gradient)
        if seen is not None:
            place, spread = place + seen.away_um, (seen.second, seen.fourth)
        second, fourth = self._without_scatter(*spread)
        used = table if rows is None else table[rows]
        value, slope = (
            part.reshape(len(used), *thickness_um.shape)
            for part in _interpolate(
                used, self.range_um[0], TABLE_STEP_UM, place.ravel(), second.ravel(), fourth.ravel()
            )
        )
        if self.place_weight is not None:
            value, slope = self._at_places(value), self._at_places(slope)
        if rest is not None:
            planes = np.arange(len(value)) if rows is None else rows
            _move_to_centroids(
                *(part.reshape(len(planes), -1) for part in (value, slope)),
                gradient.reshape(2, -1), rest.reshape(*rest.shape[:2], -1), planes,
            )  # fmt: skip
        return value, slope

    def gradient(self, thickness_um: FloatArray) -> FloatArray:
        """Change of the thickness from cell to cell along rows and columns, ``(2, ny, nx)``."""
        if self._slopes is None:
            self._slopes = Slopes(np.ones(thickness_um.shape, bool) if self.seen is None else self.seen)
        return self._slopes(thickness_um)

    def _at_places(self, rows: FloatArray) -> FloatArray:
        """Cells of the rows of all places, each seen at its own: ``(K * W, ny, nx)`` to ``(W, ny, nx)``."""
        weight = self.place_weight
        assert weight is not None
        return np.asarray(np.einsum("kyx,kwyx->wyx", weight, rows.reshape(len(weight), -1, *rows.shape[1:])))

    def sampled(self, settings: Settings, thickness_um: FloatArray) -> Prediction:
        """Response at any thicknesses within the tables, without effects on the image; shapes ``(W, ...)``.

        Of light that changes over the field, that at its first place.
        """
        return self._sampled(self.table(settings), thickness_um)

    def sampled_on_island(self, name: str, settings: Settings, thickness_um: FloatArray) -> Prediction:
        """The same where a local effect is."""
        return self._sampled(self._island_table(name, settings), thickness_um)

    def on_and_off_island(
        self,
        name: str,
        settings: Settings,
        field_um: FloatArray,
        cells: NDArray[np.intp] | None = None,
        places_um: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Some cells where a local effect is, and where it is not, as wide as the slopes of a field make them.

        Effects on the image are left out.

        ``field_um`` (ny, nx). ``cells`` (n,): numbers of the cells; all by default. ``places_um`` (S, n):
        thicknesses of the cells; those of the field by default. Returns (W, S, n).
        """
        return (
            self.within_cells(settings, field_um, cells, places_um, island=name),
            self.within_cells(settings, field_um, cells, places_um),
        )

    def within_cells(
        self,
        settings: Settings,
        field_um: FloatArray,
        cells: NDArray[np.intp] | None = None,
        places_um: FloatArray | None = None,
        *,
        island: str = "",
    ) -> FloatArray:
        """One of the two of `on_and_off_island`: where the local effect of that name is, or outside of all."""
        table = self._island_table(island, settings) if island else self.table(settings)
        own = np.arange(field_um.size) if cells is None else cells
        places = field_um.ravel()[own][np.newaxis] if places_um is None else places_um
        spread = [
            np.broadcast_to(moment.ravel()[own], places.shape)
            for moment in self._spread_in_cell(self.gradient(field_um))
        ]
        return self._sampled(table, places, *spread).value

    def _island_table(self, name: str, settings: Settings) -> FloatArray:
        (table,) = (table for item, table in self._island_tables(settings) if item.effect.name == name)
        return table

    def coverage(self, name: str, settings: Settings) -> FloatArray:
        """Part of every cell that has a local effect, ``(ny, nx)``."""
        own = {key: value for key, value in settings.items() if key.partition(".")[0] == name}
        (item,) = activate_effects(own, self.catalogue)
        return item.coverage(self.model.base_system, self.geometry)

    def on_islands(self, settings: Settings) -> BoolArray:
        """Cells with a local effect, shape ``(ny, nx)``."""
        covered = np.zeros(self.geometry.sample_shape, dtype=bool)
        for part in self.island_parts(settings):
            covered |= part > 0.0
        return covered

    def island_parts(self, settings: Settings) -> list[FloatArray]:
        """Part of every cell that is on the island of each local effect, each ``(ny, nx)``."""
        return [part for part, _, _ in self._islands(settings)]

    def has_island(self, name: str, settings: Settings) -> bool:
        """Whether a local effect is anywhere, and not at its null."""
        return any(item.effect.name == name for item, _ in self.model_with(settings).islands)

    def is_island(self, name: str) -> bool:
        """Whether an effect is in a part of the sensor only."""
        return self._effect(name).local

    def _sampled(
        self,
        table: FloatArray,
        thickness_um: FloatArray,
        second: FloatArray | None = None,
        fourth: FloatArray | None = None,
    ) -> Prediction:
        spread = (
            np.zeros(thickness_um.size) if moment is None else moment.ravel() for moment in (second, fourth)
        )
        both = _interpolate(table, self.range_um[0], TABLE_STEP_UM, thickness_um.ravel(), *spread)
        value, slope = (
            part.reshape(len(table), *thickness_um.shape)[: len(self.geometry.wavelength_nm)] for part in both
        )
        return Prediction(value, slope)

    def _at_centroids(
        self, thickness_um: FloatArray, gradient: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        """Thickness where the good pixels lie at all wavelengths, and how far those of single ones lie from there."""
        if self._centroids is None:
            return thickness_um, None
        common, rest = self._centroids
        return thickness_um + (gradient * common).sum(axis=0), rest

    def _spread_in_cell(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Second and fourth moment of the thickness within each cell [µm², µm⁴], without the scatter of its place.

        Pixels of a cell average the fringes. A thickness that is known only so well averages them once more, in the
        mean over many cells: as much is taken off before.
        """
        return self._without_scatter(*self._spread_of_pixels(gradient))

    def _without_scatter(self, second: FloatArray, fourth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moments of the thickness less those of the scatter of its place."""
        if self.scatter_um2 is None:
            return second, fourth
        scatter = self.scatter_um2
        return second - scatter, fourth + 3.0 * scatter**2 - 6.0 * second * scatter

    def _spread_of_pixels(self, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Second and fourth moment of the thickness over the area of each cell, from the gradient of the field."""
        # Uniform along both axes; places stand evenly, and their distributions are discrete.
        square, inverse = gradient**2, 1.0 / (self.cell_px * self.places) ** 2 if self.places else 0.0
        along = square * (1.0 - inverse) / 12.0
        fourth = (square**2).sum(axis=0) * (1.0 - inverse) * (3.0 - 7.0 * inverse) / 240.0
        return along.sum(axis=0), fourth + 6.0 * along[0] * along[1]

    def is_image_effect(self, name: str) -> bool:
        """Whether an effect acts on the image and not on the response."""
        return self._effect(name).acts_on == "image"

    def noise_correlation(self, settings: Settings) -> float:
        """Correlation that effects on the image give the noise of neighbouring cells."""
        active = activate_effects(self._image(settings), self.catalogue)
        return sum(item.effect.noise_correlation(item.values, self.geometry) for item in active)

    def couples_pixels(self, name: str) -> bool:
        """Whether an effect carries signal from cell to cell."""
        return self._effect(name).search.reach != "pixel"

    def blurs(self, name: str) -> bool:
        """Whether an effect spreads signal over the nearest cells."""
        return self._effect(name).search.reach == "near"

    def blur_px(self, settings: Settings) -> float:
        """Rms radius along one axis by which effects, those of the model among them, spread all light [px]."""
        active = activate_effects(self._image(settings), self.catalogue)
        return math.hypot(*(item.effect.blur_px(item.values) for item in active))

    def charge_spread_px2(self, settings: Settings) -> float:
        """Variance along one axis by which effects of the charge spread what arrives last [px²]."""
        level = float(self.geometry.level_e.mean())
        active = activate_effects(self._image(settings), self.catalogue)
        return sum(item.effect.charge_spread_px2(item.values, level) for item in active)

    def _effect(self, name: str) -> Effect:
        return self._by_name[name]

    def _optical(self, settings: Settings) -> dict[str, float]:
        effects = {key: self._effect(key.split(".")[0]) for key in settings}
        return {
            key: value
            for key, value in settings.items()
            if effects[key].acts_on != "image" and not effects[key].local
        }

    def _of_light(self, settings: Settings) -> dict[str, float]:
        """Those that do not act on the image."""
        return {key: x for key, x in settings.items() if not self.is_image_effect(key.partition(".")[0])}

    def _image(self, settings: Settings) -> dict[str, float]:
        known = {**self.model.effect_settings, **settings}
        return {key: value for key, value in known.items() if self.is_image_effect(key.split(".")[0])}


def _along(gradient: FloatArray, moments: FloatArray) -> FloatArray:
    """First and second moment of the thickness, ``(2, ny, nx)``, from those of the places ``(5, ny, nx)``."""
    down, along = gradient
    first = down * moments[0] + along * moments[1]
    second = down**2 * moments[2] + 2.0 * down * along * moments[3] + along**2 * moments[4]
    return np.stack([first, second])


def _interpolate(
    table: FloatArray,
    start: float,
    step: float,
    thickness: FloatArray,
    second: FloatArray,
    fourth: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Cubic interpolation of value and slope, averaged over the thickness spread.

    Three places have its second and fourth moment: of a uniform spread those of Gauss and Legendre.
    """
    column = contiguous(table.T)  # the wavelengths of a node side by side
    cells = tuple(contiguous(each, float) for each in (thickness, second, fourth))
    value, slope = np.empty((len(table), thickness.size)), np.empty((len(table), thickness.size))

    def work(first: int, last: int) -> None:
        _interpolate_blocks(column, start, step, *cells, first, last, value, slope)

    run_shares(work, -(-thickness.size // _BLOCK), max(1, _LEAST_LOOKUPS // (_BLOCK * len(table))))
    return value, slope


@kernel
def _interpolate_blocks(  # type: ignore[no-untyped-def]
    column, start, step, thickness, second, fourth, first_block, last_block, value, slope
):  # pragma: no cover - compiled
    waves = column.shape[1]
    for block in range(first_block, last_block):
        first = block * _BLOCK
        number = min(_BLOCK, thickness.size - first)
        own_value, own_slope = np.zeros((number, waves)), np.zeros((number, waves))
        for j in range(number):
            i = first + j
            position = (thickness[i] - start) / step
            spread, tail = second[i] / (step * step), fourth[i] / (step * step) ** 2
            away, weight, places = 0.0, 0.0, 1
            if not abs(spread) < LEAST_SPREAD:
                if not (spread > 0.0 and tail >= spread * spread):
                    _add_series(own_value[j], own_slope[j], column, position, 0.5 * spread, tail / 24.0, step)
                    continue
                away, weight, places = math.sqrt(tail / spread), 0.5 * spread * spread / tail, 3
            for part in range(places):  # in the middle, before and behind; the code of one call is there once
                place = position if part == 0 else (position - away if part == 1 else position + away)
                share = 1.0 - 2.0 * weight if part == 0 else weight
                _add_lookup(own_value[j], own_slope[j], column, place, share, step)
        for w in range(waves):
            for j in range(number):
                value[w, first + j] = own_value[j, w]
                slope[w, first + j] = own_slope[j, w]


@kernel
def _move_to_centroids(
    value: FloatArray,
    slope: FloatArray,
    gradient: FloatArray,
    rest: FloatArray,
    planes: NDArray[np.intp],
) -> None:  # pragma: no cover - compiled
    """Add to the cells ``(R, n)`` of some planes what their centroids ``(2, W, n)`` change, to first order."""
    for row in range(len(planes)):
        plane = planes[row]
        for i in range(value.shape[1]):
            moved = gradient[0, i] * rest[0, plane, i] + gradient[1, i] * rest[1, plane, i]
            value[row, i] += slope[row, i] * moved


@subkernel(expand=True)
def _add_lookup(value, slope, column, position, weight, step):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Add the Lagrange polynomial through four nodes, and its derivative, at one place, all wavelengths."""
    # Cells without data may be anywhere; beyond the table they stay at its ends.
    inside = min(max(position, 1.0), column.shape[0] - 2.0)
    k = min(int(np.floor(inside)), column.shape[0] - 3)
    x = inside - k
    for w in range(value.size):
        a, b, c, d = column[k - 1, w], column[k, w], column[k + 1, w], column[k + 2, w]
        c1 = c - a / 3.0 - b / 2.0 - d / 6.0
        c2 = 0.5 * (a + c) - b
        c3 = (d - a) / 6.0 + 0.5 * (b - c)
        value[w] += weight * (b + x * (c1 + x * (c2 + x * c3)))
        slope[w] += weight * (c1 + x * (2.0 * c2 + 3.0 * x * c3)) / step


@subkernel(expand=True)
def _add_series(value, slope, column, position, half, rest, step):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """The same with moments that no spread has: they are taken into the nodes, by second and fourth differences."""
    inside = min(max(position, 3.0), column.shape[0] - 4.0)
    k = min(int(np.floor(inside)), column.shape[0] - 5)
    x = inside - k
    for w in range(value.size):
        o, p, a, b = column[k - 3, w], column[k - 2, w], column[k - 1, w], column[k, w]
        c, d, q, r = column[k + 1, w], column[k + 2, w], column[k + 3, w], column[k + 4, w]
        a, b, c, d = (
            _spread_node(o, p, a, b, c, half, rest),
            _spread_node(p, a, b, c, d, half, rest),
            _spread_node(a, b, c, d, q, half, rest),
            _spread_node(b, c, d, q, r, half, rest),
        )
        c1 = c - a / 3.0 - b / 2.0 - d / 6.0
        c2 = 0.5 * (a + c) - b
        c3 = (d - a) / 6.0 + 0.5 * (b - c)
        value[w] += b + x * (c1 + x * (c2 + x * c3))
        slope[w] += (c1 + x * (2.0 * c2 + 3.0 * x * c3)) / step


@subkernel(expand=True)
def _spread_node(a, b, c, d, e, half, rest):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Node ``c`` of five averaged over a spread of variance ``2 half`` and fourth moment ``24 rest``."""
    second = (16.0 * (b + d) - a - e - 30.0 * c) / 12.0
    return c + half * second + rest * (a - 4.0 * b + 6.0 * c - 4.0 * d + e)
