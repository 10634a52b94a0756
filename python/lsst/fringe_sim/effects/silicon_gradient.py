"""Detection layer that is thicker on one side of the sensor."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..errors import InputError
from ..optics.system import OpticalSystem
from .base import FloatArray, Parameter, PlainNullEffect, Values
from .geometry import ImageGeometry

NODE_UM = 2.0  # Silicon thicknesses from which the response is interpolated: nominal, and so much on both sides [µm]

RIPPLE_UM = 0.13
RIPPLE_PLACES = np.array([-0.375, -0.125, 0.125, 0.375])
"""Period of the fringes of the silicon itself at 930 nm [µm], and the parts of it over which they are averaged."""

STEP_UM, STEPS = 0.025, 60  # Grid of the varying layer, five fringe orders, on which responses are compared
LEAST_SPAN_NM = 20.0  # Span of wavelengths below which a gradient of the silicon is one of the light


class SiliconGradient(PlainNullEffect):
    """The detection layer is a wedge; its mean thickness is that of the stack.

    Where it is thicker more of the deep red is absorbed, and less light comes back from behind it: the signal rises
    and the fringes change their height. At one wavelength the response of a thicker layer is that of the nominal one
    times a factor plus an offset (to 1e-3 of the change, over 6 µm), so that this needs no map of the layer that
    varies. Fringes of the silicon itself stay those of the mean thickness; a line of 2 nm leaves 1e-4 of them.
    """

    name = "silicon_gradient"
    title = "silicon thicker on one side"
    acts_on = "image"
    reference = (
        "Guo, Walter, Lage & Lupton 2022, section 5.2 (silicon of HSC varies by 0.7 um), Table 1 (constant)"
    )
    parameters = (
        Parameter("gradient_x", "um", 0.0, (-10.0, 10.0), 1.0, "rise from the left to the right edge"),
        Parameter("gradient_y", "um", 0.0, (-10.0, 10.0), 1.0, "rise from the lower to the upper edge"),
    )

    def change_image_of(
        self, system: OpticalSystem, image: FloatArray, values: Values, geometry: ImageGeometry
    ) -> FloatArray:
        """Interpolate between responses of thinner and thicker silicon.

        Raises
        ------
        InputError
            The layer of the set-up that varies is the detection layer.
        """
        if system.varying == system.detection:
            raise InputError(f"effect {self.name}", system.varying, "a set-up that varies another layer")
        thicker = 0.5 * (values["gradient_x"] * geometry.u + values["gradient_y"] * geometry.v)
        first, second = _coefficients(system, tuple(geometry.wavelength_nm.tolist()))
        offset, factor = (first[part] * thicker + second[part] * thicker**2 for part in (0, 1))
        square = (values["gradient_x"] ** 2 + values["gradient_y"] ** 2) / 12.0
        mean = 1.0 + square * second.sum(axis=0)
        return np.asarray((image * (1.0 + factor) + offset) / mean)

    def check_search(self, geometry: ImageGeometry) -> None:
        """Refuse exposures of one colour.

        Raises
        ------
        InputError
            In them it is uneven light.
        """
        span = float(np.ptp(geometry.wavelength_nm))
        if span < LEAST_SPAN_NM:
            raise InputError("span of the wavelengths [nm]", span, f"{LEAST_SPAN_NM:g} or more")


@functools.lru_cache(maxsize=16)
def _coefficients(system: OpticalSystem, wavelength_nm: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Offset and factor of the relative response per µm and per µm² of silicon, ``(2, W, 1, 1)`` each.

    The response ``R`` of a layer thicker by ``t``, over the mean of the nominal one, is ``R + offset + factor R``.
    """
    nominal = _response(system, wavelength_nm, 0.0)
    mean = nominal.mean(axis=1)
    centred = nominal - mean[:, np.newaxis]
    changes = []
    for node in (-NODE_UM, NODE_UM):
        change = _response(system, wavelength_nm, node) - nominal
        factor = (centred * change).sum(axis=1) / np.maximum((centred**2).sum(axis=1), math.ulp(0.0))
        changes.append([change.mean(axis=1) / mean - factor, factor])
    below, above = np.array(changes)[..., np.newaxis, np.newaxis]
    return (above - below) / (2.0 * NODE_UM), (above + below) / (2.0 * NODE_UM**2)


def _response(system: OpticalSystem, wavelength_nm: tuple[float, ...], thicker_um: float) -> FloatArray:
    """Response on a grid of the varying layer, fringes of the silicon averaged; shape ``(W, STEPS)``."""
    layer = system.stack.layers[system.stack.position(system.detection)]
    start = max(system.stack.layers[system.stack.position(system.varying)].thickness_um, STEP_UM)
    light = system.flat_fields(np.array(wavelength_nm))
    total = np.zeros((len(wavelength_nm), STEPS))
    for place in RIPPLE_PLACES:
        changed = layer.thickness_um + thicker_um + RIPPLE_UM * place
        reduced = system.with_layer(system.detection, thickness_um=changed).reduce(light)
        total += reduced.averaged_on_grid(light.weight, start, STEP_UM, STEPS)
    return total / len(RIPPLE_PLACES)
