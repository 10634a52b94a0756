"""The catalogue of physical effects: files by the place where they act, one line each in `EFFECTS`."""

from .active import (
    ActiveEffect,
    activate_effects,
    apply_to_image,
    apply_to_response,
    apply_to_sky,
    apply_to_system,
)
from .at_telescope import EpoxyTemperature, SensorTemperature
from .base import Effect, Parameter, Residuals, ResponseContext, SearchHints
from .catalogue import catalogue_of, effects_from, known_effects
from .geometry import AMPLIFIERS, ImageGeometry
from .illumination import ChromaticIllumination, IlluminationPattern, Vignetting
from .learned import LearnedAmplifiers, LearnedLight, LearnedMap, LearnedResponse
from .light import (
    Bandwidth,
    ConvergingBeam,
    GhostPedestal,
    LampLines,
    LineTriangle,
    LineWing,
    Tilt,
    WavelengthJitter,
    WavelengthOffset,
    WavelengthScale,
)
from .sensor import (
    AmplifierGain,
    AmplifierOffset,
    BrighterFatter,
    ChargeDiffusion,
    Crosstalk,
    DarkCurrent,
    DarkPedestal,
    MidlineStep,
    NonLinearity,
)
from .silicon_gradient import SiliconGradient
from .sky import FlatFringes, HotRotation, OHBands, RotationalTemperature, SkyContinuum, WaterVapour
from .stack import (
    AirGap,
    ArCoating,
    BlackCoating,
    ContrastLoss,
    DiffuseGateSide,
    EpoxyAbsorption,
    EpoxyIndex,
    GateOxide,
    GateStructure,
    GateThickness,
    Insulation,
    InterfaceRoughness,
    SiliconAbsorption,
    SiliconConstants,
    SiliconThickness,
    SupportCoherence,
    SupportIndex,
    Temperature,
    ThicknessSpread,
)
from .tree_rings import TreeRings
from .void import Void

__all__ = [
    "AMPLIFIERS",
    "EFFECTS",
    "LEARNED",
    "ActiveEffect",
    "Effect",
    "ImageGeometry",
    "Parameter",
    "Residuals",
    "ResponseContext",
    "SearchHints",
    "activate_effects",
    "apply_to_image",
    "apply_to_response",
    "apply_to_sky",
    "apply_to_system",
    "catalogue_of",
    "effects_from",
    "known_effects",
]

EFFECTS: tuple[Effect, ...] = (
    # stack
    EpoxyIndex(),
    EpoxyAbsorption(),
    SiliconThickness(),
    SiliconAbsorption(),
    SiliconConstants(),
    Temperature(),
    ArCoating(),
    InterfaceRoughness(),
    ThicknessSpread(),
    AirGap(),
    SupportIndex(),
    SupportCoherence(),
    GateOxide(),
    GateThickness(),
    GateStructure(),
    Insulation(),
    BlackCoating(),
    DiffuseGateSide(),
    Void(),
    SensorTemperature(),
    EpoxyTemperature(),
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
    IlluminationPattern(),
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
    FlatFringes(),
)
"""Every effect of this package, in the order in which they are applied; `known_effects` has those of others, too."""

LEARNED: tuple[Effect, ...] = (LearnedResponse(), LearnedMap(), LearnedLight(), LearnedAmplifiers())
"""Corrections without a cause, which a search learns: they can be set as effects, and nothing looks for them."""
