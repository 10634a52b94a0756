"""Thin-film optics: media, stacks, transfer matrices, illumination."""

from .coherence import partially_coherent_absorption
from .convergence import converged, converged_flat_fields, converged_spectrum
from .illumination import Beam, Illumination, LampSpectrum, SpectralProfile
from .media import Medium, constant_medium, get_medium, medium_names
from .phase_response import PhaseResponse, reduce_to_phase
from .sensitivity import ResponseGradient, response_gradient
from .stack import Layer, LayerStack
from .transfer_matrix import layer_absorption, reflection_transmission
from .two_phase_response import ThicknessGrid, TwoPhaseResponse, reduce_to_two_phases

__all__ = [
    "Beam",
    "Illumination",
    "LampSpectrum",
    "Layer",
    "LayerStack",
    "Medium",
    "PhaseResponse",
    "ResponseGradient",
    "SpectralProfile",
    "ThicknessGrid",
    "TwoPhaseResponse",
    "constant_medium",
    "converged",
    "converged_flat_fields",
    "converged_spectrum",
    "get_medium",
    "layer_absorption",
    "medium_names",
    "partially_coherent_absorption",
    "reduce_to_phase",
    "reduce_to_two_phases",
    "reflection_transmission",
    "response_gradient",
]
