"""The catalogue of physical effects: one file each, one line in `EFFECTS`."""

from .ar_coating import ArCoating
from .bandwidth import Bandwidth
from .base import (
    ActiveEffect,
    Effect,
    Parameter,
    ResponseContext,
    activate_effects,
    apply_to_response,
    apply_to_system,
)
from .contrast_loss import ContrastLoss
from .converging_beam import ConvergingBeam
from .epoxy_absorption import EpoxyAbsorption
from .epoxy_index import EpoxyIndex
from .ghost_pedestal import GhostPedestal
from .interface_roughness import InterfaceRoughness
from .silicon_absorption import SiliconAbsorption
from .silicon_thickness import SiliconThickness
from .temperature import Temperature
from .wavelength_offset import WavelengthOffset
from .wavelength_scale import WavelengthScale

__all__ = [
    "EFFECTS",
    "ActiveEffect",
    "Effect",
    "Parameter",
    "ResponseContext",
    "activate_effects",
    "apply_to_response",
    "apply_to_system",
]

EFFECTS: tuple[Effect, ...] = (
    # stack
    EpoxyIndex(),
    EpoxyAbsorption(),
    SiliconThickness(),
    SiliconAbsorption(),
    Temperature(),
    ArCoating(),
    InterfaceRoughness(),
    # illumination
    Bandwidth(),
    WavelengthOffset(),
    WavelengthScale(),
    ConvergingBeam(),
    # response
    GhostPedestal(),
    ContrastLoss(),
)
"""Every effect that the model knows, in the order in which they are applied."""
