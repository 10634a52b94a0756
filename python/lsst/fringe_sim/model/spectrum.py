"""Where light of each wavelength ends in a stack of plane layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..array_types import FloatArray
from ..errors import InputError, named_units
from ..notebook import InNotebook, axes_or_new
from ..optics.system import OpticalSystem
from ..optics.transfer_matrix import layer_absorption

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["StackSpectrum", "spectrum_of"]


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class StackSpectrum(InNotebook):
    """Fractions of the incident photons over wavelength.

    Attributes
    ----------
    wavelength_nm : `numpy.ndarray`, shape ``(W,)``
        Wavelength in vacuum [nm].
    reflected, transmitted : `numpy.ndarray`, shape ``(W,)``
        What comes back, and what leaves the last layer.
    absorbed : `dict` [`str`, `numpy.ndarray`], shapes ``(W,)``
        What each inner layer takes, by its name. All of it and the other two sum to 1; behind a rough face what is
        missing is scattered out of the beam.
    detection : `str`
        Layer whose absorption is the signal.
    varying : `str`
        Layer whose thickness varies over the sensor.
    thickness_um : `float`
        Its thickness [µm].
    """

    wavelength_nm: FloatArray
    reflected: FloatArray
    transmitted: FloatArray
    absorbed: dict[str, FloatArray]
    detection: str
    varying: str
    thickness_um: float

    @property
    def quantum_efficiency(self) -> FloatArray:
        """Electrons per incident photon, one for each that the detection layer absorbs; shape ``(W,)``."""
        return self.absorbed[self.detection]

    def facts(self) -> dict[str, str]:
        """Range, thickness, and means over the range."""
        low, high = self.wavelength_nm.min(), self.wavelength_nm.max()
        shown = {"wavelengths": f"{low:g} to {high:g} nm", self.varying: f"{self.thickness_um:g} µm"}
        means = {"reflected": self.reflected, **self.absorbed, "transmitted": self.transmitted}
        return {**shown, **{f"{name}, mean": f"{values.mean():.3g}" for name, values in means.items()}}

    def __repr__(self) -> str:
        told = ", ".join(f"{name}: {value}" for name, value in self.facts().items())
        return f"{type(self).__name__}({told})"

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw every fraction that is not negligible over wavelength; on new axes by default."""
        drawn = axes_or_new(axes)
        parts = {"reflected": self.reflected, "transmitted": self.transmitted, **self.absorbed}
        for name, values in parts.items():
            if values.max() > NEGLIGIBLE:
                label = f"{name} (detected)" if name == self.detection else name
                drawn.plot(self.wavelength_nm, values, label=label)
        drawn.set(xlabel="wavelength [nm]", ylabel="fraction of the photons", ylim=(0.0, 1.0))
        drawn.set_title(f"{self.varying} {self.thickness_um:g} µm")
        drawn.legend()
        return drawn


NEGLIGIBLE = 1e-3  # A line that nobody would see in a picture from 0 to 1


@named_units
def spectrum_of(system: OpticalSystem, wavelength_nm: FloatArray, thickness_um: float) -> StackSpectrum:
    """Fractions for strictly monochromatic light, averaged over the angles of the beam.

    Raises
    ------
    InputError
        The system is more than plane layers: light that comes back diffusely, a structure, a layer of which the
        thickness varies inside a pixel.
    """
    beyond = {
        "diffuse": system.diffuse is not None,
        "structure": system.structure is not None,
        "thickness spread": bool(np.any(system.stack.thickness_spread_um)),
    }
    if any(beyond.values()):
        found = ", ".join(name for name, there in beyond.items() if there)
        raise InputError("effects", found, "plane layers alone (the response has the others)")
    stack = system.stack.replace_layer(system.varying, thickness_um=thickness_um)
    index = stack.indices(wavelength_nm, system.temperature_k)
    total = np.zeros(index.shape)
    for theta, weight in zip(system.beam.theta.tolist(), system.beam.weight.tolist(), strict=True):
        total += weight * layer_absorption(
            index,
            stack.thickness_um[:, None],
            1e-3 * wavelength_nm,
            theta,
            system.polarization,
            roughness=1e-3 * stack.roughness_nm,
        )
    inner = dict(zip(stack.names[1:-1], total[1:-1], strict=True))
    return StackSpectrum(
        wavelength_nm, total[0], total[-1], inner, system.detection, system.varying, thickness_um
    )
