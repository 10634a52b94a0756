"""Rings of the silicon crystal."""

from __future__ import annotations

import math

import numpy as np

from .base import FloatArray, Parameter, PlainNullEffect, Residuals, SearchHints, Values
from .geometry import ImageGeometry
from .ring_search import find_rings

MEAN_SAMPLES = 64  # Samples along each axis from which the mean of the pattern over a sensor is taken

LONGEST_PERIOD = 0.7
"""Period of rings over the side of the sensor, beyond which they are not told from uneven light."""


class TreeRings(PlainNullEffect):
    """Rings about the axis of the crystal: its doping changed while it grew, and moves the borders of pixels.

    The light is multiplied by 1 + cosine cos(2π (r - r₀) / period) + sine sin(2π (r - r₀) / period), averaged over
    each pixel: r is the distance from the centre of the rings, r₀ that of the middle of the sensor.
    """

    name = "tree_rings"
    title = "tree rings of the silicon"
    acts_on = "image"
    reference = "Plazas, Bernstein & Sheldon 2014, doi 10.1086/677682 (tree rings in flats of thick CCDs)"
    parameters = (
        Parameter("cosine", "", 0.0, (-0.05, 0.05), 1e-3, "amplitude of the cosine, phase 0 in the middle"),
        Parameter("sine", "", 0.0, (-0.05, 0.05), 1e-3, "amplitude of the sine"),
        Parameter("centre_x", "px", 0.0, (-10_000.0, 14_000.0), 3000.0, "column of their centre"),
        Parameter("centre_y", "px", 0.0, (-10_000.0, 14_000.0), 3000.0, "row of their centre"),
        Parameter("period", "px", 50.0, (2.0, 500.0), 50.0, "distance of rings"),
    )
    search = SearchHints(
        sought=True,
        places=("centre_x", "centre_y", "period"),
        steps={"centre_x": 0.01, "centre_y": 0.01, "period": 1e-4},
    )

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Multiply by the pattern over its mean; the phase is 0 in the middle of the sensor."""
        rows, columns = (np.linspace(0.0, size - 1.0, min(size, MEAN_SAMPLES)) for size in geometry.shape)
        middle = _middle(geometry)
        mean = _pattern(values, middle, rows, columns, (1.0, 1.0)).mean()
        pattern = _pattern(values, middle, geometry.y_px, geometry.x_px, geometry.cell_px)
        return image * ((1.0 + pattern) / (1.0 + mean))

    def propose(self, residuals: Residuals) -> tuple[dict[str, float], ...]:
        """Centre, period and amplitudes of the clearest rings in what all exposures have in common."""
        weight, geometry = residuals.weight, residuals.geometry
        total = weight.sum(axis=0)
        used = total > 0.0
        common = np.divide(
            (weight * residuals.value).sum(axis=0), total, out=np.zeros(total.shape), where=used
        )
        rings = find_rings(common, used, geometry.y_px, geometry.x_px, _middle(geometry))
        if rings is None:
            return ()
        return ({
            "cosine": rings.amplitude.real, "sine": rings.amplitude.imag,
            "centre_x": rings.centre[1], "centre_y": rings.centre[0], "period": rings.period,
        },)  # fmt: skip

    def bounds_on(self, parameter: Parameter, geometry: ImageGeometry) -> tuple[float, float]:
        """A wave longer than the sensor is a gradient of the light."""
        low, high = parameter.bounds
        if parameter.name != "period":
            return low, high
        across = max(float(np.ptp(geometry.y_px)), float(np.ptp(geometry.x_px)))
        return low, min(high, max(LONGEST_PERIOD * across, 1.01 * parameter.null))


def _middle(geometry: ImageGeometry) -> FloatArray:
    """Row and column of the middle of the sensor."""
    return 0.5 * (np.array(geometry.shape) - 1.0)


def _pattern(
    values: Values, middle: FloatArray, rows: FloatArray, columns: FloatArray, cell: tuple[float, float]
) -> FloatArray:
    """Departure of the pattern from one, averaged over pixels or cells, ``(ny, nx)``."""
    down, along = rows[:, np.newaxis] - values["centre_y"], columns[np.newaxis, :] - values["centre_x"]
    radius = np.hypot(down, along)
    nearer = math.hypot(middle[0] - values["centre_y"], middle[1] - values["centre_x"])
    phase = 2.0 * np.pi * (radius - nearer) / values["period"]
    wave = values["cosine"] * np.cos(phase) + values["sine"] * np.sin(phase)
    cycles = 1.0 / (np.maximum(radius, 1e-9) * values["period"])
    return np.asarray(wave * np.sinc(cell[0] * down * cycles) * np.sinc(cell[1] * along * cycles))
