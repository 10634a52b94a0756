"""Thin-film optics: media, stacks, transfer matrices, illumination."""

from .illumination import Beam, Illumination, LampSpectrum, SpectralProfile
from .media import Medium, constant_medium, get_medium, medium_names
from .phase_response import PhaseResponse, reduce_to_phase
from .stack import Layer, LayerStack
from .transfer_matrix import layer_absorption
from .two_phase_response import ThicknessGrid, TwoPhaseResponse, reduce_to_two_phases

__all__ = [
    "Beam",
    "Illumination",
    "LampSpectrum",
    "Layer",
    "LayerStack",
    "Medium",
    "PhaseResponse",
    "SpectralProfile",
    "ThicknessGrid",
    "TwoPhaseResponse",
    "constant_medium",
    "get_medium",
    "layer_absorption",
    "medium_names",
    "reduce_to_phase",
    "reduce_to_two_phases",
]
