"""What the model says of the cells: a pure function of effects and thickness."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.polynomial.hermite_e import hermegauss

from ...array_types import BoolArray, FloatArray
from ...effects import Effect, ImageGeometry, activate_effects, apply_to_image
from ...effects.active import ActiveEffect, another
from ...model import FringeModel
from ...optics.illumination import Illumination
from ...optics.phase_response import PhaseResponse
from ..evaluations import note_evaluation
from ..exposures import Exposures
from .cell_average import CellShape, look_up

Settings = Mapping[str, float]
_Key = tuple[tuple[str, float], ...]
_Nodes = tuple[FloatArray, FloatArray]
Light = tuple[FloatArray, FloatArray]
_Kept = TypeVar("_Kept")

TABLE_STEP_UM = 0.004
"""Spacing of the thickness grid [µm]: 75 per fringe order; cubic interpolation is good to 1e-6."""

TABLE_TOLERANCE = 1e-9
"""Error of the tables relative to the fringes; derivatives are differences of tables 1e-3 of a prior scale apart."""

LINE_STEP_NM = 0.1  # Spacing of wavelength nodes [nm]

NUDGE_UM = 1e-3
"""Change of thickness with which effects on the image are differentiated [µm]; they are nearly linear."""

RIM_PLACES = 3  # Places along an axis that stand for a blur where it crosses the rim of an island

PHASE_STEP_NM = 0.5  # Spacing of wavelength nodes where the mean phase of a line is all that is asked [nm]

MOST_PARTS = 4  # Sets of islands, and of effects on the image, that are kept for reuse

MOST_TABLES = 400  # Tables kept for reuse; which of them are there changes no answer


@dataclass(frozen=True, eq=False)
class Forward:
    """Model of one sensor on cells."""

    model: FringeModel  # the model as it is known before the search
    catalogue: Sequence[Effect]  # effects that may be set
    geometry: ImageGeometry  # centres of the cells, wavelengths, levels
    shape: CellShape  # what the thickness does within the cells
    # thicknesses of the tables [µm]; the light is relative to its tapered mean over them, whatever is asked
    range_um: tuple[float, float]
    # where the good pixels of a cell have their mean, from its centre [px], ``(2, W, N)``
    centroid: FloatArray | None = None
    contrast: float = (
        1.0  # contrast of the fringes over that of the model; 1 but while noise and cells are judged
    )
    exposures: Exposures | None = None  # the light, monochromator flats by default
    # weights of the places of the field whose light is known, for every cell, ``(K, N)``; one place by default
    place_weight: FloatArray | None = None
    # answers about points that are kept as long as the model, by the name of the function
    kept: dict[str, dict[Any, Any]] = field(default_factory=dict, repr=False)
    _tables: dict[_Key, FloatArray] = field(default_factory=dict, repr=False)
    _levels: dict[_Key, FloatArray] = field(default_factory=dict, repr=False)
    _rows: dict[tuple[_Key, int, float], tuple[FloatArray, float]] = field(default_factory=dict, repr=False)
    _by_name: dict[str, Effect] = field(default_factory=dict, repr=False)
    _of_key: dict[str, Effect] = field(default_factory=dict, repr=False)
    _images: dict[_Key, tuple[tuple[ActiveEffect, ...], float]] = field(default_factory=dict, repr=False)
    _phases: dict[_Key, float] = field(default_factory=dict, repr=False)
    _parts: dict[tuple[Any, ...], tuple[list[FloatArray], list[_Nodes]]] = field(
        default_factory=dict, repr=False
    )

    def __post_init__(self) -> None:
        self._by_name.update({effect.name: effect for effect in self.catalogue})

    @property
    def waves(self) -> int:
        """Number of exposures."""
        return len(self.geometry.wavelength_nm)

    @cached_property
    def order_um(self) -> float:
        """Thickness of one fringe order in the middle of the wavelengths [µm]."""
        return float(self.model.fringe_order_um(np.median(self.geometry.wavelength_nm)))

    def log_phase(self, settings: Settings) -> float:
        """Mean logarithm, over the exposures, of the fringe phase per thickness over that of the unchanged model.

        Of the places that are not on islands.
        """
        return self._log_phase(settings) - self._log_phase({})

    def effect_of(self, key: str) -> Effect:
        """The effect that a setting belongs to."""
        if key not in self._of_key:
            name = key.partition(".")[0]
            if name not in self._by_name:
                self._by_name[name] = another(name, self._by_name)
            self._of_key[key] = self._by_name[name]
        return self._of_key[key]

    def predict(self, settings: Settings, thickness_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signal of the cells relative to its mean level, and its derivative with respect to thickness [1/µm].

        ``thickness_um`` (N,): thickness in the middle of the cells. Returns two arrays ``(W, N)``.
        """
        return self.imaged(settings, self.light(settings, thickness_um))

    def light(self, settings: Settings, thickness_um: FloatArray) -> Light:
        """The same before effects on the image, but for their blur."""
        everything = {**self.model.effect_settings, **settings}
        optical = {key: value for key, value in everything.items() if self.effect_of(key).acts_on != "image"}
        value, slope = self._light(optical, thickness_um, self._image_of(everything)[1])
        return 1.0 + self.contrast * (value - 1.0), self.contrast * slope

    def imaged(self, settings: Settings, light: Light) -> Light:
        """What effects on the image make of the light of some settings."""
        note_evaluation()
        active, _ = self._image_of({**self.model.effect_settings, **settings})
        if not active:
            return light
        value, slope = light
        changed = self._on_image(active, value)
        return changed, (self._on_image(active, value + NUDGE_UM * slope) - changed) / NUDGE_UM

    def is_of_image(self, key: str) -> bool:
        """Whether a setting leaves the light as it is."""
        effect = self.effect_of(key)
        return effect.acts_on == "image" and not self._is_blur(effect)

    def _image_of(self, settings: Settings) -> tuple[tuple[ActiveEffect, ...], float]:
        """Effects on the image that do something, and the blur of all others [px]; the latest are kept."""
        image = {key: value for key, value in settings.items() if self.effect_of(key).acts_on == "image"}
        if not image:
            return (), 0.0
        key = tuple(image.items())
        if key not in self._images:
            if len(self._images) >= MOST_PARTS:
                self._images.clear()
            active = activate_effects(image, self.catalogue)
            blurs = [item.effect.blur_px(item.values) for item in active if self._is_blur(item.effect)]
            rest = tuple(item for item in active if not self._is_blur(item.effect))
            some = not all(item.is_null(self.model.base_system) for item in rest)
            self._images[key] = rest if some else (), math.hypot(*blurs)
        return self._images[key]

    def on_image(self, settings: Settings) -> bool:
        """Whether effects change the image, so that cells may depend on each other; blurs do not."""
        return any(self.is_of_image(key) for key in {**self.model.effect_settings, **settings})

    def of_cells(self, rows: slice, columns: slice, inside: BoolArray) -> Forward:
        """The same of the cells of some rows and columns, ``inside`` (N,) is true of them."""
        geometry = self.geometry
        return replace(
            self,
            geometry=replace(geometry, y_px=geometry.y_px[rows], x_px=geometry.x_px[columns]),
            shape=self.shape.of_cells(inside),
            centroid=None if self.centroid is None else self.centroid[..., inside],
            place_weight=None if self.place_weight is None else self.place_weight[:, inside],
            _parts={},
        )

    def _light(
        self, optical: Settings, thickness_um: FloatArray, blur_px: float
    ) -> tuple[FloatArray, FloatArray]:
        """The same before effects on the image."""
        everywhere = {key: value for key, value in optical.items() if not self.effect_of(key).local}
        islands = self._model(optical).islands if len(everywhere) < len(optical) else ()
        parts, (outside, *on) = self._parts_of(tuple(item for item, _ in islands), blur_px)
        value, slope = self._looked_up(self.table(everywhere), thickness_um, outside)
        for (item, model), part, nodes in zip(islands, parts, on, strict=True):
            own = {f"{item.effect.name}.{name}": x for name, x in item.values.items()}
            places = {f"{item.effect.name}.{name}" for name in item.effect.search.places}
            key = tuple(sorted({**everywhere, **{k: v for k, v in own.items() if k not in places}}.items()))
            inside = self._looked_up(self._island_table(key, everywhere, model), thickness_um, nodes)
            value, slope = (
                all_ + part * (here - all_) for all_, here in zip((value, slope), inside, strict=True)
            )
        return value, slope

    def _parts_of(
        self, islands: tuple[ActiveEffect, ...], blur_px: float
    ) -> tuple[list[FloatArray], list[_Nodes]]:
        """Parts of the cells on islands, and places in thickness outside all and of each; the latest are kept."""
        values = [(item.effect.name, *sorted(item.values.items())) for item in islands]
        key = self.shape, blur_px, *values
        if key not in self._parts:
            if len(self._parts) >= MOST_PARTS:
                self._parts.clear()
            covered = [self._covered(item, blur_px) for item in islands]
            self._parts[key] = [part for part, _ in covered], self._nodes_of_parts(covered, blur_px)
        return self._parts[key]

    def _covered(self, item: ActiveEffect, blur_px: float) -> tuple[FloatArray, FloatArray]:
        """Part of every cell on an island, ``(N,)``, and its moments, ``(5, N)``: means over the reach of a blur."""
        places, shares = hermegauss(RIM_PLACES) if blur_px else (np.zeros(1), np.ones(1))
        part, moments = np.zeros(self.geometry.sample_shape), np.zeros((5, *self.geometry.sample_shape))
        for (j, up), (i, right) in itertools.product(enumerate(blur_px * places), repeat=2):
            there = replace(self.geometry, y_px=self.geometry.y_px + up, x_px=self.geometry.x_px + right)
            own = item.coverage(self.model.base_system, there)
            first_y, first_x, *second = item.coverage_moments(self.model.base_system, there)
            y, x = up / there.cell_px[0], right / there.cell_px[1]
            share = shares[j] * shares[i] / shares.sum() ** 2
            part += share * own
            moments += share * np.stack([
                first_y + y * own, first_x + x * own, second[0] + 2.0 * y * first_y + y**2 * own,
                second[1] + y * first_x + x * first_y + y * x * own, second[2] + 2.0 * x * first_x + x**2 * own,
            ])  # fmt: skip
        return part.ravel(), moments.reshape(5, -1)

    def _nodes_of_parts(
        self, covered: Sequence[tuple[FloatArray, FloatArray]], blur_px: float
    ) -> list[_Nodes]:
        """Places in thickness outside all islands, and of each."""
        if not covered:
            return [self.shape.nodes(blur_px)]
        down, along = self.geometry.cell_px
        blurred = np.array([0.0, 0.0, (blur_px / down) ** 2, 0.0, (blur_px / along) ** 2])
        even = np.array([0.0, 0.0, 1.0, 0.0, 1.0]) / 12.0 + blurred
        parts, moments = zip(*covered, strict=True)
        rest = 1.0 - np.sum(parts, axis=0), even[:, np.newaxis] - np.sum(moments, axis=0)
        return [self.shape.nodes_of_part(*each, blur_px) for each in (rest, *covered)]

    def _looked_up(
        self, table: FloatArray, thickness_um: FloatArray, nodes: tuple[FloatArray, ...]
    ) -> tuple[FloatArray, FloatArray]:
        value, slope = (
            self._at_places(rows)
            for rows in look_up(table, self.range_um[0], TABLE_STEP_UM, thickness_um, nodes)
        )
        if self.centroid is not None:
            value = value + slope * np.einsum("an,awn->wn", self.shape.gradient, self.centroid)
        return value, slope

    def _at_places(self, rows: FloatArray) -> FloatArray:
        """Cells ``(W, N)``, each at its own place, from those of all places ``(K * W, N)``."""
        if self.place_weight is None:
            return rows
        return np.asarray(
            np.einsum("kn,kwn->wn", self.place_weight, rows.reshape(-1, self.waves, rows.shape[1]))
        )

    def _on_image(self, active: tuple[ActiveEffect, ...], value: FloatArray) -> FloatArray:
        image = value.reshape(self.waves, *self.geometry.sample_shape)
        return apply_to_image(active, self.model.base_system, image, self.geometry).reshape(value.shape)

    @staticmethod
    def _is_blur(effect: Effect) -> bool:
        """Whether all that an effect on the image does is to spread signal alike."""
        return type(effect).blur_px is not Effect.blur_px

    def _log_phase(self, settings: Settings) -> float:
        everywhere = {
            key: value
            for key, value in {**self.model.effect_settings, **settings}.items()
            if self.effect_of(key).acts_on != "image" and not self.effect_of(key).local
        }
        key = tuple(sorted(everywhere.items()))
        if key not in self._phases and self.exposures is None:
            self._tables.pop(key, None)
            self.table(everywhere)  # which tells it too
        elif key not in self._phases:
            system = self._model(everywhere).system
            light = system.flat_fields(self.geometry.wavelength_nm, PHASE_STEP_NM)
            _keep(self._phases, key, float(_log_phases(system.reduce(light), light).mean()))
        return self._phases[key]

    # Tables ---------------------------------------------------------------------------------------------------

    def _model(self, settings: Settings) -> FringeModel:
        return self.model.with_effects({**self.model.effect_settings, **settings}, self.catalogue)

    @property
    def _count(self) -> int:
        return math.ceil((self.range_um[1] - self.range_um[0]) / TABLE_STEP_UM) + 1

    def table(self, settings: Settings) -> FloatArray:
        """Response ``(W, D)`` on the grid of thickness over its tapered mean, of effects that are everywhere.

        Light that changes over the field has such rows for each of its places, ``(K * W, D)``.
        """
        key = tuple(sorted(settings.items()))
        if key not in self._tables:
            response = self._response(settings)
            _keep(self._levels, key, self._level(response))
            _keep(self._tables, key, response / self._levels[key])
        return self._tables[key]

    def _island_table(self, key: _Key, everywhere: Settings, model: FringeModel) -> FloatArray:
        """The same where a local effect is, over the mean of all other places."""
        if key not in self._tables:
            around = tuple(sorted(everywhere.items()))
            if around not in self._levels:
                _keep(self._levels, around, self._level(self._response(everywhere)))
            _keep(self._tables, key, self._fresh(model)[0] / self._levels[around])
        return self._tables[key]

    @property
    def _taper(self) -> FloatArray:
        return np.hanning(self._count + 2)[1:-1]

    def _level(self, response: FloatArray) -> FloatArray:
        """Mean level of the rows of a table, that of all places, ``(rows, 1)``."""
        mean = np.average(response, axis=1, weights=self._taper).reshape(-1, self.waves).mean(axis=0)
        return np.resize(mean, len(response))[:, np.newaxis]

    def _fresh(self, model: FringeModel) -> tuple[FloatArray, FloatArray]:
        """Response of all exposures on the grid of thickness, and of flats the logarithms of their phases."""
        if self.exposures is not None:
            own = self.exposures.response(model, self.range_um[0], TABLE_STEP_UM, self._count)
            return own, np.zeros(0)
        light = model.system.flat_fields(self.geometry.wavelength_nm, LINE_STEP_NM)
        return self._grid_response(model, light, slice(None))

    def _response(self, settings: Settings) -> FloatArray:
        """Response of all exposures; those whose wavelength stays are not computed again.

        The mean logarithm of the phase of flats is kept beside.
        """
        model = self._model(settings)
        moving = {key for key in settings if self.effect_of(key).search.moves_wavelengths}
        if self.exposures is not None or (settings and not moving):
            response, phases = self._fresh(model)
        else:
            response, phases = self._with_known_rows(model, settings, moving)
        if phases.size:
            _keep(self._phases, tuple(sorted(settings.items())), float(phases.mean()))
        return response

    def _with_known_rows(
        self, model: FringeModel, settings: Settings, moving: set[str]
    ) -> tuple[FloatArray, FloatArray]:
        """The same as `_fresh` of flats, with the exposures that are known."""
        light = model.system.flat_fields(self.geometry.wavelength_nm, LINE_STEP_NM)
        rest = tuple(sorted((key, value) for key, value in settings.items() if key not in moving))
        keys = [(rest, row, float(first)) for row, first in enumerate(light.wavelength_nm[:, 0])]
        fresh = [row for row, key in enumerate(keys) if key not in self._rows]
        if fresh:
            if len(self._rows) > MOST_TABLES:
                self._rows.clear()
                fresh = list(range(self.waves))
            found = zip(*self._grid_response(model, light, fresh), strict=True)
            self._rows.update(
                {keys[row]: (own, float(phase)) for row, (own, phase) in zip(fresh, found, strict=True)}
            )
        rows, phases = zip(*(self._rows[key] for key in keys), strict=True)
        return np.stack(rows), np.array(phases)

    def _grid_response(
        self, model: FringeModel, light: Illumination, rows: list[int] | slice
    ) -> tuple[FloatArray, FloatArray]:
        part = Illumination(light.wavelength_nm[rows], light.theta[rows], light.weight[rows])
        wavelength, reduced = self.geometry.wavelength_nm[rows], model.system.reduce(part)
        response = reduced.averaged_on_grid(
            part.weight, self.range_um[0], TABLE_STEP_UM, self._count, tolerance=TABLE_TOLERANCE
        )
        return model.finish(reduced, part, response, wavelength), _log_phases(reduced, part)


def _log_phases(reduced: PhaseResponse, light: Illumination) -> FloatArray:
    """Logarithm of the mean phase per thickness of every exposure, of its states but harmonics that were added."""
    return np.asarray(np.log(np.average(reduced.kappa[0].real, axis=1, weights=light.weight)))


def _keep(kept: dict[_Key, _Kept], key: _Key, value: _Kept) -> None:
    """Keep a value for reuse, and of all values the latest."""
    kept[key] = value
    if len(kept) > MOST_TABLES:
        kept.pop(next(iter(kept)))
