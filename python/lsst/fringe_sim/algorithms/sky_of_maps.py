"""Response of a sensor to a sky from the maps of its layers: the one that makes fringes, and the silicon above it.

The silicon has fringes of its own, one every 0.13 µm, and turns the phase of those of the layer below. A response is
tabulated for evenly spaced thicknesses of the silicon, and every pixel interpolates between those about its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import Float32Array, FloatArray
from ..errors import InputError, OutOfRangeError
from ..instrument.camera import Camera
from ..instrument.sky import SkySpectrum
from ..model import FringeModel, Setup
from ..products import ThicknessMap
from .angular_response import silicon_um as silicon_of
from .field_response import SensorPlacement, sensor_response
from .laboratory_shift import widened_um
from .sky_response import FrameTable, Response, bandpass_of

Respond = Callable[[FringeModel, tuple[float, float], tuple[Response, ...]], Response]

NODES_PER_ORDER = 10
"""Thicknesses in one fringe order of the silicon. The error of the interpolation is stated with every frame."""

STENCIL = 6  # Neighbours of a pixel that take part: the polynomial of fifth degree through them

REMAINDER = (2.5 * 1.5 * 0.5) ** 2 / 720.0
"""Largest error of that polynomial in the middle, over the sixth difference."""

MOST_NODES = 400
"""More thicknesses than these, 4 µm of silicon, are refused: they would not fit into the memory."""

SMOOTH_UM = 0.5
"""Range of the silicon over which continua lie on a straight line: they leave it by 1e-6 of the sky [µm]."""

CHECKED = 3
"""Node, a third of an order of the silicon from the first, at which that line is compared with the whole sum; it is
taken where the difference is within the stated error of the sum, as it would not be behind a narrow filter."""

PROBE = 16  # Rows and columns of the thicknesses at which the interpolation is judged
DETECTION = "detection"  # Name of the layer that a map of the silicon is of
BESIDE = "silicon_gradient"  # Effect that a map takes the place of


def known_silicon_um(
    silicon: ThicknessMap, shape: tuple[int, int], setup: Setup, source: str | None = None, sensor: str = ""
) -> FloatArray:
    """Thickness of the silicon [µm] on the pixels of the map of another layer; NaN where there is none.

    ``shape``, ``sensor``: of the other map; no name tells nothing.
    `InputError`: it is of another layer, of another sensor, or of other pixels.
    """
    found = silicon.of_setup(setup, source, DETECTION).known_um().astype(float)
    if Camera.from_name(setup.camera).are_two_sensors(silicon.detector, sensor):
        allowed = f"{sensor}, of which the map of the other layer is"
        raise InputError("sensor of the map of the silicon", silicon.detector, allowed, source=source)
    if found.shape != shape:
        allowed = f"{shape}, that of the other layer"
        raise InputError("shape of the map of the silicon", found.shape, allowed, source=source)
    return found


def silicon_nodes_um(model: FringeModel, silicon_um: FloatArray) -> tuple[float, ...]:
    """Thicknesses of the silicon that are tabulated for a map [µm]; one if it is the same everywhere.

    `InputError`: the set-up varies the silicon alone, or an effect says something else of it.
    `OutOfRangeError`: no known thickness, or a range that is no silicon of one sensor.
    """
    system = model.base_system
    if system.varying == system.detection:
        raise InputError("map of the silicon", system.varying, "a set-up that varies another layer")
    if any(item.effect.name == BESIDE for item in model.effects):
        raise InputError("effects", BESIDE, "none that is in the map of the silicon already")
    known = silicon_um[np.isfinite(silicon_um)]
    if not known.size:
        raise InputError("map of the silicon", "no known thickness", "one in at least one pixel")
    low, high = float(known.min()), float(known.max())
    step = _step_um(model)
    if (high - low) / step > MOST_NODES:
        allowed = f"within {MOST_NODES * step:.1f} um"
        raise OutOfRangeError("thickness of the silicon [um]", (low, high), allowed)
    if high == low:
        return (low,)
    first, last = math.floor(low / step), math.floor(high / step)
    return tuple(step * number for number in range(first - STENCIL // 2 + 1, last + STENCIL // 2 + 2))


def _step_um(model: FringeModel) -> float:
    """Part of an order of the silicon at the shortest wavelength, rounded, so that like maps share a grid."""
    shortest = bandpass_of(model).support()[0]
    stack = model.system.stack
    medium = stack.layers[stack.position(model.system.detection)].medium
    index = float(medium.index(shortest, model.system.temperature_k).real)
    return round(0.5e-3 * shortest / index / NODES_PER_ORDER, 5)


def sky_of_maps(
    model: FringeModel,
    sky: SkySpectrum,
    placement: SensorPlacement,
    thickness_range_um: tuple[float, float],
    silicon_nodes_um: tuple[float, ...] | None = None,
    *,
    phase_sigma: float = 0.0,
    respond: Respond | None = None,
    advance: Callable[[], None] | None = None,
) -> SiliconSeries:
    """Response of a sensor, for the thicknesses of its silicon that `silicon_nodes_um` gives.

    ``phase_sigma``: that of `simulate_sky_frame`. ``respond``: ``(model, range, like) -> response`` of a sensor, by
    default that of `sensor_response`; ``like`` is one of the same sensor with other silicon, or two, or none.
    ``advance``: called after each thickness of the silicon.
    """
    model.checked_thickness_um(thickness_range_um)
    span = widened_um(model, thickness_range_um, phase_sigma)

    def in_every_beam(
        own: FringeModel, range_um: tuple[float, float], like: tuple[Response, ...]
    ) -> Response:
        return sensor_response(own, sky, placement, range_um, like=like)

    make = in_every_beam if respond is None else respond
    if silicon_nodes_um is None:
        return SiliconSeries(np.empty(0), (make(model, span, ()),), span)
    nodes = silicon_nodes_um
    layer = model.base_system.detection
    nominal = model.base_system.stack
    # Effects add to the thickness; the map holds what they add.
    added = silicon_of(model) - nominal.layers[nominal.position(layer)].thickness_um

    def at(number: int, *like: Response) -> Response:
        system = model.base_system.with_layer(layer, thickness_um=nodes[number] - added)
        return make(replace(model, base_system=system), span, like)

    return SiliconSeries(np.array(nodes), _at_all(at, nodes, span, advance or (lambda: None)), span)


def _at_all(
    at: Callable[..., Response],
    nodes: tuple[float, ...],
    span: tuple[float, float],
    advance: Callable[[], None],
) -> tuple[Response, ...]:
    """Responses at all nodes; continua from those at the ends of ranges, if they lie on a straight line."""
    made = {0: at(0)}
    advance()
    pieces = max(math.ceil((nodes[-1] - nodes[0]) / SMOOTH_UM), 1)
    ends = np.unique(np.linspace(0, len(nodes) - 1, pieces + 1).astype(int)).tolist()
    straight: bool | None = None
    for low, high in itertools.pairwise(ends):
        made[high] = at(high, made[0])
        advance()
        for number in range(low + 1, high):
            if straight is None and number == CHECKED:
                made[number] = at(number, made[0])
                whole, between = (
                    _probed(each, span) for each in (made[number], at(number, made[low], made[high]))
                )
                straight = bool(np.abs(whole - between).max() <= made[number].quadrature_error * whole.mean())
            else:
                made[number] = at(number, *((made[low], made[high]) if straight else (made[0],)))
            advance()
    return tuple(made[number] for number in range(len(nodes)))


def _probed(response: Response, thickness_range_um: tuple[float, float]) -> FloatArray:
    """Sky at thicknesses of the whole range."""
    probe = np.linspace(*thickness_range_um, PROBE**2).reshape(PROBE, PROBE)
    return response.sky().frame(probe).astype(float)


@dataclass(frozen=True, eq=False)
class SiliconSeries:
    """Responses for evenly spaced thicknesses of the silicon, or one for that of the stack."""

    node_um: FloatArray  # thicknesses of the silicon [µm]
    responses: tuple[Response, ...]
    thickness_range_um: tuple[float, float]  # of the layer below

    def on(self, silicon_um: FloatArray | None) -> Response:
        """Response of a sensor whose silicon is known at every pixel, ``(ny, nx)``."""
        if silicon_um is None or len(self.responses) == 1:
            return self.responses[0]
        return SiliconResponse(self, silicon_um)


@dataclass(frozen=True, eq=False)
class SiliconResponse:
    """Stands for a `SkyResponse` in `simulate_sky_frame`."""

    series: SiliconSeries
    silicon_um: FloatArray  # (ny, nx)

    @property
    def component(self) -> tuple[str, ...]:
        """Names of the components of the sky."""
        return self.series.responses[0].component

    @property
    def bands(self) -> tuple[str, ...]:
        """Those that are OH bands."""
        return self.series.responses[0].bands

    @property
    def quadrature_error(self) -> float:
        """Estimated error of the sums over lines and angles, relative to the mean sky."""
        return max(each.quadrature_error for each in self.series.responses)

    @property
    def airmass(self) -> float:
        """Airmass of the sky."""
        return self.series.responses[0].airmass

    def sky(self, scale: Mapping[str, float] | None = None) -> SiliconTable:
        """Electrons s⁻¹ m⁻² arcsec⁻² over both thicknesses."""
        tables = tuple(response.sky(scale) for response in self.series.responses)
        low, high = self.series.thickness_range_um
        probe = np.linspace(low, high, PROBE**2).reshape(PROBE, PROBE)
        frames = np.stack([table.frame(probe).astype(float) for table in tables])
        between = REMAINDER * float(np.abs(np.diff(frames, STENCIL, axis=0)).max())
        return SiliconTable(self.series.node_um, tables, self.silicon_um, between)


@dataclass(frozen=True, eq=False)
class SiliconTable:
    """Makes frames from the thickness of the layer below the silicon."""

    node_um: FloatArray
    tables: tuple[FrameTable, ...]
    silicon_um: FloatArray
    error_between: float  # of the interpolation between the nodes

    @property
    def wavelength_nm(self) -> FloatArray:
        """Mean wavelength [nm], shape ``(1,)``."""
        return self.tables[0].wavelength_nm

    @property
    def interpolation_error(self) -> float:
        """Largest error of both interpolations, in the units of the frame."""
        return self.error_between + max(table.interpolation_error for table in self.tables)

    def frame(self, thickness_um: ArrayLike) -> Float32Array:
        """Frame of a thickness map [µm], ``(ny, nx)``; NaN where one of the two is not known."""
        thickness = np.asarray(thickness_um)
        if thickness.shape != self.silicon_um.shape:
            raise InputError("shape of the thickness map", thickness.shape, f"{self.silicon_um.shape}")
        step = float(self.node_um[1] - self.node_um[0])
        place = (self.silicon_um - self.node_um[0]) / step
        known = np.isfinite(place) & np.isfinite(thickness)
        place = np.where(known, place, 0.0)
        nodes = len(self.tables)
        first = np.clip(np.floor(place).astype(np.int16) - (STENCIL // 2 - 1), 0, nodes - STENCIL)
        first[~known] = nodes
        # Pixels in the order of their first node: those that a table is asked for stand together.
        order = np.argsort(first, axis=None, kind="stable")
        edges = np.searchsorted(first.ravel()[order], np.arange(nodes + 1))
        beyond = np.asarray(place - first, dtype=float).ravel()[order]
        image = np.where(known, np.float32(0.0), np.float32(np.nan)).ravel()
        given, asked = thickness.ravel(), np.full(thickness.size, np.nan, thickness.dtype)
        for number, table in enumerate(self.tables):
            lowest = max(number - STENCIL + 1, 0)
            inside = order[edges[lowest] : edges[number + 1]]
            if not inside.size:
                continue
            asked[inside] = given[inside]
            seen = table.frame(asked.reshape(thickness.shape)).ravel()
            asked[inside] = np.nan
            for start in range(lowest, number + 1):
                group = slice(edges[start], edges[start + 1])
                weight = _lagrange(beyond[group], number - start).astype(np.float32)
                image[order[group]] += weight * seen[order[group]]
        return image.reshape(thickness.shape)


def _lagrange(place: FloatArray, node: int) -> FloatArray:
    """Weight of one of the nodes 0, 1, ... of a stencil at places among them."""
    weight = np.ones(place.shape)
    for other in range(STENCIL):
        if other != node:
            weight *= (place - other) / (node - other)
    return weight
