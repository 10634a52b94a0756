"""Corrections that a search learned from what no effect explains: they are no physics, and nobody looks for them.

A person who has found the cause writes an effect for it and sets these to null.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from ..errors import InputError
from ..optics.system import OpticalSystem
from .base import FloatArray, Parameter, PlainNullEffect, Values
from .geometry import AMPLIFIERS, ImageGeometry

LEARNED_NODES_NM = tuple(range(800, 1051, 10))
"""Wavelengths at which corrections are stated [nm]: in a straight line between them, constant beyond."""

LEARNED_HARMONICS = (1, 2, 3)

COLOUR_NM = 50.0  # Distance in wavelength at which the colour of amplifiers is stated [nm]
COLOUR_MIDDLE_NM = 935.0  # Wavelength at which it vanishes [nm]

MAP_ORDER, LINE_ORDER, LIGHT_ORDER = 16, 64, 8
"""Orders of the cosines of a map along both sides, of lines along one, and of light that differs by exposure."""

_ORIGIN = "learned from the residuals of a search; marks what a physical effect is still to be written for"


class _LearnedEffect(PlainNullEffect):
    """A correction: whatever holds for all of them."""

    learned = True
    reference = _ORIGIN
    _places: ClassVar[dict[str, Parameter]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls._places = {parameter.name: parameter for parameter in cls.parameters}

    def parameter(self, name: str) -> Parameter:
        """Parameter called ``name``: there are hundreds."""
        return self._places.get(name) or super().parameter(name)

    def check_search(self, geometry: ImageGeometry) -> None:
        """Refuse to be looked for: it would explain anything."""
        raise InputError(
            "effect", self.name, "a physical one: this is a correction that a search has learned"
        )


class LearnedResponse(_LearnedEffect):
    """A wave form in the fringe phase, another one at each wavelength: parts of the mean response.

    The phase is that of the round trip in the varying layer, ``4π n d cos(θ) / λ``.
    """

    name = "learned_response"
    title = "learned: wave form over the fringe phase (not physics)"
    acts_on = "response"
    parameters = tuple(
        Parameter(
            f"{wave}{harmonic}_{node}", "", 0.0, (-1.0, 1.0), 0.01,
            f"{wave} of {harmonic} times the fringe phase at {node} nm", wavelength_nm=float(node),
        )
        for harmonic in LEARNED_HARMONICS
        for wave in ("cos", "sin")
        for node in LEARNED_NODES_NM
    )  # fmt: skip

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Add the harmonics to the response of the stack."""
        table = tuple(
            (harmonic, tuple((float(node), values[f"cos{harmonic}_{node}"], values[f"sin{harmonic}_{node}"])
                             for node in LEARNED_NODES_NM))
            for harmonic in LEARNED_HARMONICS
        )  # fmt: skip
        return replace(system, added_harmonics=table)


class LearnedAmplifiers(_LearnedEffect):
    """A factor for each amplifier, and how it changes with wavelength."""

    name = "learned_amplifiers"
    title = "learned: factors of the amplifiers (not physics)"
    acts_on = "image"
    parameters = (
        *(Parameter(name, "", 0.0, (-0.5, 0.5), 0.01, f"relative signal of {name}") for name in AMPLIFIERS),
        *(
            Parameter(f"{name}_colour", "", 0.0, (-0.5, 0.5), 0.01, f"its change per {COLOUR_NM:g} nm")
            for name in AMPLIFIERS
        ),
    )

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Multiply every amplifier by its factor, which has a mean of one over all."""
        grey, colour = (
            np.array([values[f"{name}{end}"] for name in AMPLIFIERS])[geometry.amplifier]
            for end in ("", "_colour")
        )
        change = grey + amplifier_colour(geometry.wavelength_nm)[:, np.newaxis, np.newaxis] * colour
        return image * (1.0 + change - change.mean(axis=(1, 2), keepdims=True))


def amplifier_colour(wavelength_nm: FloatArray) -> FloatArray:
    """What the colour of an amplifier is multiplied by, ``(W,)``."""
    return (wavelength_nm - COLOUR_MIDDLE_NM) / COLOUR_NM


def map_orders() -> list[tuple[int, int]]:
    """Orders along y and x of the cosines of a map: all coarse ones, and fine lines along either side."""
    coarse = [(j, i) for j in range(MAP_ORDER) for i in range(MAP_ORDER) if j or i]
    fine = range(MAP_ORDER, LINE_ORDER)
    return [*coarse, *((0, i) for i in fine), *((j, 0) for j in fine)]


def light_orders() -> list[tuple[int, int]]:
    """Orders along y and x of the cosines of light that changes with the exposure."""
    return [(j, i) for j in range(LIGHT_ORDER) for i in range(LIGHT_ORDER - j) if j or i]


def cosines(geometry: ImageGeometry, orders: int) -> tuple[FloatArray, FloatArray]:
    """Cosines along both sides, ``(ny, orders)`` and ``(nx, orders)``: whole half waves over the sensor."""
    order = 0.5 * np.pi * np.arange(orders)
    return np.cos((geometry.v.ravel()[:, np.newaxis] + 1.0) * order), np.cos(
        (geometry.u.ravel()[:, np.newaxis] + 1.0) * order
    )


class LearnedMap(_LearnedEffect):
    """A pattern over the sensor, the same at all wavelengths."""

    name = "learned_map"
    title = "learned: pattern over the sensor (not physics)"
    acts_on = "image"
    laboratory_only = True
    parameters = tuple(
        Parameter(f"y{j}x{i}", "", 0.0, (-1.0, 1.0), 0.01, f"{j} half waves along y, {i} along x")
        for j, i in map_orders()
    )

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Multiply by the pattern."""
        table = np.zeros((LINE_ORDER, LINE_ORDER))
        for j, i in map_orders():
            table[j, i] = values[f"y{j}x{i}"]
        down, along = cosines(geometry, LINE_ORDER)
        return image * (1.0 + down @ table @ along.T)


class LearnedLight(_LearnedEffect):
    """A pattern over the sensor, another one in each exposure."""

    name = "learned_light"
    title = "learned: pattern over the sensor in each exposure (not physics)"
    acts_on = "image"
    laboratory_only = True
    parameters = tuple(
        Parameter(
            f"at_{node}_y{j}x{i}", "", 0.0, (-1.0, 1.0), 0.01,
            f"{j} half waves along y, {i} along x at {node} nm", wavelength_nm=float(node),
        )
        for node in LEARNED_NODES_NM
        for j, i in light_orders()
    )  # fmt: skip

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Multiply each plane by its pattern."""
        tables = np.zeros((len(LEARNED_NODES_NM), LIGHT_ORDER, LIGHT_ORDER))
        for number, node in enumerate(LEARNED_NODES_NM):
            for j, i in light_orders():
                tables[number, j, i] = values[f"at_{node}_y{j}x{i}"]
        shares = node_shares(geometry.wavelength_nm)
        down, along = cosines(geometry, LIGHT_ORDER)
        return image * (1.0 + down @ np.tensordot(shares, tables, axes=1) @ along.T)


def node_shares(wavelength_nm: FloatArray) -> FloatArray:
    """Part that every node has in what is stated between nodes, ``(W, nodes)``."""
    nodes = np.array(LEARNED_NODES_NM, dtype=float)
    return np.stack([np.interp(wavelength_nm, nodes, own) for own in np.eye(len(nodes))], axis=-1)
