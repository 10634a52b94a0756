"""Light of frames of the night sky, summed as fast as a search needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import BarycentricInterpolator

from ...array_types import FloatArray
from ...effects import ImageGeometry
from ...instrument.bandpass import Bandpass
from ...instrument.night import NightHistory
from ...instrument.sky import SkySpectrum, SpectralComponent, blend_components
from ...instrument.telescope import reduce_beam
from ...model import FringeModel
from ...optics import Beam, Illumination
from ...optics.phase_response import PhaseResponse
from ..field_response import SensorPlacement, beam_field
from ..sky_frame import is_band
from ..sky_response import (
    component_factors,
    electrons_on_grid,
    sky_with_effects,
    split_components,
    white_light,
)

Grid = tuple[float, float, int]  # First, step [µm] and number of thicknesses
LINE_ANGLES = 40  # Angles of the beam for lines
CONTINUUM_ANGLES = 8  # Angles for continua, whose fringes average out over wavelength
CONTINUUM_STEP_NM = 0.2  # Spacing of the wavelengths that stand for a continuum [nm]
FLAT_STEP_NM = 0.05  # Spacing of the wavelengths that stand for the light of flat fields [nm]

RADII, FEW_RADII = 8, 3
"""Field radii at which the beams of a sensor are summed in full, and those for what an effect changes."""

LINE_SHIFT_NM = 0.02  # Rms shift of the lines that are merged [nm]

TOLERANCE = 1e-7
"""Error of the sums over harmonics, relative to the fringes of one line, 300 times those of all together."""

_KEPT = 72
"""Sensors whose reductions are kept, 12 MB each: those of all effects, which every set of effects asks for anew."""


@dataclass(eq=False)
class SkyExposures:
    """Light of frames of the night sky, summed as fast as a search needs.

    Few angles and few wavelengths tell well enough what an effect changes; the unchanged model is summed in full
    once, and what the short sums lack of it is added to all. Lines keep the places at which the unchanged sky is
    merged, so that what the sensor makes of every place and angle is worked out once for all skies.
    """

    base: FringeModel  # the model before the search
    sky: SkySpectrum  # lines and continua before any effect
    band: Bandpass  # optics and air
    scales: tuple[Mapping[str, float], ...]  # factors on components of the sky, by name, for each frame
    # How the beam changes over the sensor, in flat-fielded frames; by default it is that of the model
    # everywhere
    field: BeamsOverSensor | None = None
    _places: dict[str, FloatArray] = dataclass_field(init=False, repr=False)
    _reduced: dict[tuple[Any, ...], dict[str, _Reduced]] = dataclass_field(default_factory=dict, repr=False)
    _flat: FloatArray = dataclass_field(init=False, repr=False)
    _missing: dict[Grid, FloatArray] = dataclass_field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        lines, continua = split_components(
            sky_with_effects(self.base, self.sky), self.band, CONTINUUM_STEP_NM
        )
        # Lines that are faint now may be bright in another sky: square roots of the photons tell what may be merged.
        even = [replace(part, photons=np.sqrt(part.photons)) for part in lines]
        merged = blend_components(even, LINE_SHIFT_NM) if lines else []
        self._places = {part.name: part.wavelength_nm for part in [*merged, *continua]}

    def response(self, model: FringeModel, start_um: float, step_um: float, count: int) -> FloatArray:
        """Electrons of every frame on a uniform grid of thickness, at every place: ``(K * F, count)``."""
        grid = (start_um, step_um, count)
        if grid not in self._missing:
            self._missing.clear()
            self._missing[grid] = self._summed_in_full(grid) - self._short(self.base, grid)
            self._flat = self._white_flat(grid)
        light = sky_with_effects(model, self.sky).flat
        flat = self._flat if light is None else self._flat_field(model, light.component(self.band), grid)
        return (self._short(model, grid) + self._missing[grid]) / flat

    def place_weight(self, geometry: ImageGeometry) -> FloatArray:
        """See `Exposures`."""
        return np.ones((1, 1, 1)) if self.field is None else self.field.weight(geometry)

    def further(self) -> list[tuple[str, str, SkyExposures]]:
        """See `Exposures`: the same frames once more, and frames at the hour of a night that is least like theirs."""
        bands = self.sky.lines.bands
        night = NightHistory.guo2022()
        hours = [night.band_scale(time, bands) for time in range(len(night))]
        farthest = max(range(len(night)), key=lambda time: self._unlike(hours[time]))
        number = len(self.scales)
        other = ({**self.scales[0], **hours[farthest]},) * number
        when = f"{night.hours[farthest]:g} h after dusk in the night of Guo et al. 2022"
        return [
            ("repeat", f"the same {number} frames once more", self._with_further(self.scales)),
            (
                "hour",
                f"{number} frames with the OH bands of another hour ({when})",
                self._with_further(other),
            ),
        ]

    def _unlike(self, scale: Mapping[str, float]) -> float:
        """Rms difference of the bands from those of the frames, in powers of e, without what all have in common."""
        now = {name: float(np.mean([own.get(name, 1.0) for own in self.scales])) for name in scale}
        tiny = 1e-3
        return float(np.std([np.log((scale[name] + tiny) / (now[name] + tiny)) for name in scale]))

    def _with_further(self, scales: Sequence[Mapping[str, float]]) -> SkyExposures:
        return replace(self, scales=(*self.scales, *scales), _missing={})

    def _short(self, model: FringeModel, grid: Grid) -> FloatArray:
        """The short sums at every place."""
        if self.field is None:
            return self._summed(model, grid)
        few = np.stack([self._summed(_behind(model, beam), grid) for beam in self.field.few_beams])
        return np.einsum("kl,lfd->kfd", self.field.between, few).reshape(-1, grid[2])

    def _summed_in_full(self, grid: Grid) -> FloatArray:
        beams = [self.base.base_system.beam] if self.field is None else self.field.beams
        parts = sky_with_effects(self.base, self.sky).components(self.band)
        rows = []
        for beam in beams:
            electrons = electrons_on_grid(_behind(self.base, beam), self.sky, self.band, *grid)
            rows.append(self._factors(parts) @ np.stack([electrons[part.name] for part in parts]))
        return np.concatenate(rows)

    def _white_flat(self, grid: Grid) -> FloatArray:
        """What flat fields of white light have taken out of the frames, ``(K * F, count)``."""
        if self.field is None:
            return np.ones((1, 1))
        return self._flat_field(self.base, white_light(self.band, FLAT_STEP_NM), grid)

    def _flat_field(self, model: FringeModel, part: SpectralComponent, grid: Grid) -> FloatArray:
        """The same for flat fields of any light."""
        beams = [model.base_system.beam] if self.field is None else self.field.beams
        rows = []
        for beam in beams:
            light = Illumination.spectrum(part.wavelength_nm, part.photons, reduce_beam(beam, LINE_ANGLES))
            reduced = _behind(model, beam).system.reduce(light)
            rows.append(reduced.averaged_on_grid(light.weight, *grid)[0])
        return np.repeat(rows, len(self.scales), axis=0)

    def _summed(self, model: FringeModel, grid: Grid) -> FloatArray:
        """The short sums behind the beam of a model."""
        sky = sky_with_effects(model, self.sky)
        parts = [part for part in sky.components(self.band, CONTINUUM_STEP_NM) if part.name in self._places]
        reduced = self._reductions(model)
        factors = self._factors(parts)
        result = np.zeros((len(self.scales), grid[2]))
        for numbers in self._together(parts, factors):
            name = parts[numbers[0]].name
            photons = np.sum([_moved_to(self._places[name], parts[number]) for number in numbers], axis=0)
            electrons = _electrons_of(photons, self._places[name], reduced[name], model, grid)
            result += np.outer(factors[:, numbers[0]], electrons)
        return result

    def _together(self, parts: Sequence[SpectralComponent], factors: FloatArray) -> list[list[int]]:
        """Components that can be summed at once: continua with one history."""
        groups: dict[tuple[str, bytes], list[int]] = {}
        for number, part in enumerate(parts):
            band = part.name if is_band(part.name) else ""
            groups.setdefault((band, factors[:, number].tobytes()), []).append(number)
        return list(groups.values())

    def _factors(self, parts: Sequence[SpectralComponent]) -> FloatArray:
        """Factors of the components in every frame, ``(F, C)``."""
        names = tuple(part.name for part in parts)
        photons = np.array([part.photons.sum() for part in parts])
        return np.stack(
            [
                component_factors(names, photons, {name: scale[name] for name in names if name in scale})
                for scale in self.scales
            ]
        )

    def _reductions(self, model: FringeModel) -> dict[str, _Reduced]:
        """What the sensor makes of every place and angle, by component."""
        key: tuple[Any, ...] = tuple(
            (item.effect.name, *sorted(item.values.items()))
            for item in model.effects
            if item.effect.acts_on not in ("spectrum", "response", "image")
        )
        # The model of an island has no effect for it; its layers are in the stack before all effects.
        beam = model.base_system.beam
        before = replace(model.base_system, beam=self.base.base_system.beam)
        key = (*key, before, beam.theta.tobytes(), beam.weight.tobytes())
        self._reduced[key] = self._reduced.pop(key) if key in self._reduced else self._reduce(model)
        while len(self._reduced) > _KEPT:
            self._reduced.pop(next(iter(self._reduced)))
        return self._reduced[key]

    def _reduce(self, model: FringeModel) -> dict[str, _Reduced]:
        beams = {
            True: reduce_beam(model.system.beam, LINE_ANGLES),
            False: reduce_beam(model.system.beam, CONTINUUM_ANGLES),
        }
        done: dict[tuple[bool, bytes], _Reduced] = {}  # continua share their places
        result = {}
        for name, places in self._places.items():
            same = (is_band(name), places.tobytes())
            if same not in done:
                beam = beams[is_band(name)]
                even = Illumination.spectrum(places, np.ones(places.size), beam)
                done[same] = _Reduced(beam, model.system.reduce(even))
            result[name] = done[same]
        return result

    def wavelength_nm(self) -> FloatArray:
        """Mean wavelength of the light of every frame [nm]."""
        parts = self.sky.components(self.band)
        photons = np.array([part.photons.sum() for part in parts])
        means = np.array([part.photons @ part.wavelength_nm for part in parts]) / photons
        weights = self._factors(parts) * photons
        return np.asarray((weights @ means) / weights.sum(axis=1))


@dataclass(frozen=True, eq=False)
class BeamsOverSensor:
    """Beams of a telescope at some field radii of one sensor, and which of them a pixel sees."""

    placement: SensorPlacement  # where the pixels lie
    radius_deg: FloatArray  # (K,): field radii
    beams: tuple[Beam, ...]  # the beams there
    few_radius_deg: FloatArray  # radii enough for what an effect changes
    few_beams: tuple[Beam, ...]  # the beams there

    @classmethod
    def of(cls, telescope: str, placement: SensorPlacement) -> BeamsOverSensor | None:
        """Beams over a sensor; `None` behind a cone, or where they do not depend on the radius alone."""
        beams = beam_field(telescope)
        if beams is None:
            return None
        radii = [_radii(placement.radius_range_deg, number) for number in (RADII, FEW_RADII)]
        many, few = (tuple(beams.beam(radius) for radius in each) for each in radii)
        return cls(placement, radii[0], many, radii[1], few)

    @property
    def between(self) -> FloatArray:
        """From values at the few radii to those at all, ``(K, L)``."""
        return lagrange_matrix(self.few_radius_deg, self.radius_deg)

    def weight(self, geometry: ImageGeometry) -> FloatArray:
        """Weights of the radii for every sample of an image, ``(K, ny, nx)``."""
        radius = self.placement.radius_at_deg(geometry.shape, geometry.y_px, geometry.x_px)
        return np.moveaxis(lagrange_matrix(self.radius_deg, radius.ravel()), 1, 0).reshape(-1, *radius.shape)


def _radii(limits: tuple[float, float], number: int) -> FloatArray:
    """Chebyshev nodes between two radii."""
    low, high = limits
    return 0.5 * (low + high) - 0.5 * (high - low) * np.cos(np.pi * (np.arange(number) + 0.5) / number)


def lagrange_matrix(nodes: FloatArray, places: FloatArray) -> FloatArray:
    """Matrix from values at nodes to the polynomial through them at other places, ``(places, nodes)``."""
    return np.asarray(BarycentricInterpolator(nodes, np.eye(len(nodes)))(places))


def _behind(model: FringeModel, beam: Beam) -> FringeModel:
    """The same sensor in another beam."""
    return replace(model, base_system=replace(model.base_system, beam=beam))


class _Reduced(NamedTuple):
    """A stack of films at the places and angles of one component."""

    beam: Beam
    response: PhaseResponse


def _electrons_of(
    photons: FloatArray, places: FloatArray, reduced: _Reduced, model: FringeModel, grid: Grid
) -> FloatArray:
    """Electrons from photons at some places on a uniform grid of thickness."""
    light = Illumination.spectrum(places, photons, reduced.beam)
    mean = reduced.response.averaged_on_grid(light.weight, *grid, tolerance=TOLERANCE)
    return float(photons.sum()) * model.finish(reduced.response, light, mean, None)[0]


def _moved_to(places: FloatArray, part: SpectralComponent) -> FloatArray:
    """Photons of a component at the nearest of given places."""
    if np.array_equal(places, part.wavelength_nm):
        return part.photons
    middles = 0.5 * (places[1:] + places[:-1])
    near = np.searchsorted(middles, part.wavelength_nm)
    return np.asarray(np.bincount(near, part.photons, places.size), dtype=float)
