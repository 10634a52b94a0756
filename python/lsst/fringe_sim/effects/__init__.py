"""The catalogue of physical effects: one file each, one line in `EFFECTS`."""

from .air_gap import AirGap
from .amplifier_gain import AmplifierGain
from .amplifier_offset import AmplifierOffset
from .ar_coating import ArCoating
from .bandwidth import Bandwidth
from .base import (
    ActiveEffect,
    Effect,
    Parameter,
    ResponseContext,
    activate_effects,
    apply_to_image,
    apply_to_response,
    apply_to_sky,
    apply_to_system,
)
from .black_coating import BlackCoating
from .brighter_fatter import BrighterFatter
from .charge_diffusion import ChargeDiffusion
from .chromatic_illumination import ChromaticIllumination
from .contrast_loss import ContrastLoss
from .converging_beam import ConvergingBeam
from .crosstalk import Crosstalk
from .dark_current import DarkCurrent
from .dark_pedestal import DarkPedestal
from .epoxy_absorption import EpoxyAbsorption
from .epoxy_index import EpoxyIndex
from .gate_oxide import GateOxide
from .gate_thickness import GateThickness
from .ghost_pedestal import GhostPedestal
from .hot_rotation import HotRotation
from .illumination import Illumination
from .image_geometry import AMPLIFIERS, ImageGeometry
from .insulation import Insulation
from .interface_roughness import InterfaceRoughness
from .lamp_lines import LampLines
from .line_triangle import LineTriangle
from .line_wing import LineWing
from .midline_step import MidlineStep
from .non_linearity import NonLinearity
from .oh_bands import OHBands
from .rotational_temperature import RotationalTemperature
from .silicon_absorption import SiliconAbsorption
from .silicon_gradient import SiliconGradient
from .silicon_thickness import SiliconThickness
from .sky_continuum import SkyContinuum
from .support_coherence import SupportCoherence
from .support_index import SupportIndex
from .temperature import Temperature
from .thickness_spread import ThicknessSpread
from .tilt import Tilt
from .tree_rings import TreeRings
from .vignetting import Vignetting
from .void import Void
from .water_vapour import WaterVapour
from .wavelength_jitter import WavelengthJitter
from .wavelength_offset import WavelengthOffset
from .wavelength_scale import WavelengthScale

__all__ = [
    "AMPLIFIERS",
    "EFFECTS",
    "ActiveEffect",
    "Effect",
    "ImageGeometry",
    "Parameter",
    "ResponseContext",
    "activate_effects",
    "apply_to_image",
    "apply_to_response",
    "apply_to_sky",
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
    ThicknessSpread(),
    AirGap(),
    SupportIndex(),
    SupportCoherence(),
    GateOxide(),
    GateThickness(),
    Insulation(),
    BlackCoating(),
    Void(),
    # illumination
    Bandwidth(),
    LineWing(),
    LineTriangle(),
    LampLines(),
    WavelengthOffset(),
    WavelengthScale(),
    WavelengthJitter(),
    ConvergingBeam(),
    Tilt(),
    # response
    GhostPedestal(),
    ContrastLoss(),
    # image, from the light to the file
    SiliconGradient(),
    Illumination(),
    ChromaticIllumination(),
    Vignetting(),
    MidlineStep(),
    TreeRings(),
    DarkPedestal(),
    DarkCurrent(),
    ChargeDiffusion(),
    BrighterFatter(),
    NonLinearity(),
    Crosstalk(),
    AmplifierGain(),
    AmplifierOffset(),
    # night sky
    RotationalTemperature(),
    HotRotation(),
    OHBands(),
    SkyContinuum(),
    WaterVapour(),
)
"""Every effect that the model knows, in the order in which they are applied."""
