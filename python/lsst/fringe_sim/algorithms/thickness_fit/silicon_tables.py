"""The response of flats for several thicknesses of the silicon: model, and tables between which is interpolated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ...array_types import Float32Array, FloatArray
from ...errors import InputError
from ...model import FringeModel
from .amplitudes import Amplitudes
from .templates import FlatTemplates, pad_wavelengths

OFFSET = "silicon_thickness.offset"
SCAN_PER_ORDER = 12  # Tables in one order of the silicon of a scan
NODES_PER_ORDER = 100
"""Thicknesses in one order of the adhesive; linear interpolation is good to 5e-4 of its fringes."""


class SiliconTables(NamedTuple):
    """Response against the adhesive for several thicknesses of the silicon."""

    # response; 0 in the padding, float32, ``(n_silicon, n_thickness, padded wavelengths)``
    response: Float32Array
    # silicon_start_um, silicon_step_um: first silicon, relative to that of the model, and spacing [µm]
    silicon_start_um: float
    silicon_step_um: float
    # start_um, step_um: first thickness of the adhesive and spacing [µm]
    start_um: float
    step_um: float
    wavelengths: int  # number of wavelengths, without padding

    def at(
        self, silicon_um: FloatArray, thickness_um: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Response and its derivatives [1/µm] by the silicon and by the adhesive, each ``(n, wavelengths)``."""
        place = (silicon_um - self.silicon_start_um) / self.silicon_step_um
        first = np.clip(np.floor(place).astype(int) - 1, 0, len(self.response) - 4)
        value, slope = _lagrange(place - first)
        row = (thickness_um - self.start_um) / self.step_um
        below = np.clip(np.floor(row).astype(int), 0, self.response.shape[1] - 2)
        share = (row - below)[:, None]
        found, by_silicon, by_thickness = (np.zeros((len(row), self.wavelengths)) for _ in range(3))
        for k in range(4):
            low = self.response[first + k, below, : self.wavelengths]
            rise = self.response[first + k, below + 1, : self.wavelengths] - low
            here = low + share * rise
            found += value[k][:, None] * here
            by_silicon += slope[k][:, None] * here
            by_thickness += value[k][:, None] * rise
        return found, by_silicon / self.silicon_step_um, by_thickness / self.step_um


@dataclass(frozen=True, eq=False)
class SiliconModel:
    """The response of the flats of a cube, each with its own width of the line, for any silicon.

    Raises `InputError`: the layer that varies is the silicon itself.
    """

    model: FringeModel  # the model
    # wavelength_nm, bandwidth_nm: wavelengths and widths of the lines [nm]. A width as in the set-up, or 0, is that
    # of the model, ``(n_wavelengths,)``
    wavelength_nm: FloatArray
    bandwidth_nm: FloatArray

    def __post_init__(self) -> None:
        system = self.model.base_system
        if system.varying == system.detection:
            raise InputError("varying layer", system.varying, "another than the silicon, for a joint fit")

    def templates(self, like: FlatTemplates, offset_um: float) -> FloatArray:
        """Response on the grid of templates at a thickness of the silicon, ``(n_thickness, n_wavelengths)``."""
        return self.on_grid(offset_um, like.start_um, like.step_um, len(like.response))

    def on_grid(self, offset_um: float, start_um: float, step_um: float, count: int) -> FloatArray:
        """Response on a grid of the adhesive, shape ``(count, n_wavelengths)``."""
        settings = dict(self.model.effect_settings)
        settings[OFFSET] = settings.get(OFFSET, 0.0) + offset_um
        response = np.empty((count, self.wavelength_nm.size))
        usual = self.model.setup.bandwidth_fwhm_nm
        for width in np.unique(self.bandwidth_nm):
            rows = np.flatnonzero(self.bandwidth_nm == width)
            own = {} if abs(width - usual) < 1e-6 or width == 0.0 else {"bandwidth.fwhm": float(width)}
            chosen = self.model.with_effects({**settings, **own})
            response[:, rows] = chosen.response_on_grid(self.wavelength_nm[rows], start_um, step_um, count).T
        return response

    @property
    def order_um(self) -> float:
        """Thickness of one order of the silicon, mean over the flats [µm]."""
        system = self.model.system
        index = system.stack.indices(self.wavelength_nm, system.temperature_k)
        silicon = index[system.stack.position(system.detection)].real
        return float(np.mean(1e-3 * self.wavelength_nm / (2.0 * silicon)))

    def tables(
        self,
        silicon_um: tuple[float, float],
        per_order: int,
        thickness_um: tuple[float, float],
        order_um: float,
    ) -> SiliconTables:
        """Tables that cover ranges of both thicknesses, with two nodes of the silicon beyond each end."""
        step = self.order_um / per_order
        count = int(np.ceil((silicon_um[1] - silicon_um[0]) / step)) + 5
        first = silicon_um[0] - 2.0 * step
        fine = order_um / NODES_PER_ORDER
        rows = int(np.ceil((thickness_um[1] - thickness_um[0]) / fine)) + 2
        padded = [
            pad_wavelengths(self.on_grid(first + step * k, thickness_um[0], fine, rows)) for k in range(count)
        ]
        return SiliconTables(np.stack(padded), first, step, thickness_um[0], fine, self.wavelength_nm.size)


def silicon_free(
    data: Amplitudes, templates: FlatTemplates, model: SiliconModel
) -> tuple[Amplitudes, FlatTemplates]:
    """Flats and model for a first fit that does not know the silicon.

    The model is averaged over one order of the silicon, and what its fringes do to a flat counts as noise.
    """
    flats = model
    shifts = flats.order_um * (np.arange(SCAN_PER_ORDER) + 0.5 - 0.5 * SCAN_PER_ORDER) / SCAN_PER_ORDER
    total = np.zeros(templates.response.shape)
    square = np.zeros(templates.response.shape)
    for shift in shifts:
        response = flats.templates(templates, float(shift))
        total += response
        square += response**2
    mean = total / len(shifts)
    scatter = np.sqrt(np.maximum(square / len(shifts) - mean**2, 0.0)).mean(axis=0) / mean.mean(axis=0)
    extra = (scatter / data.scale) ** 2
    variance = data.variance + np.asarray(extra, np.float32)[:, None, None]
    return replace(data, variance=variance), replace(
        templates, response=mean, mean_response=mean.mean(axis=0)
    )


def _lagrange(place: Any) -> tuple[list[FloatArray], list[FloatArray]]:
    """Weights of nodes 0 to 3 for the value and the derivative of a cubic at a place between them."""
    nodes = range(4)
    values, slopes = [], []
    for k in nodes:
        others = [j for j in nodes if j != k]
        scale = float(np.prod([k - j for j in others]))
        a, b, c = (place - j for j in others)
        values.append(a * b * c / scale)
        slopes.append((a * b + a * c + b * c) / scale)
    return values, slopes
