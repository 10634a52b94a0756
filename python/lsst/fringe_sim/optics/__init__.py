"""Thin-film optics: media, stacks, transfer matrices, illumination."""

from .coherence import partially_coherent_absorption
from .illumination import Beam, Illumination, SpectralProfile
from .media import Medium, constant_medium, get_medium, medium_names
from .phase_response import PhaseResponse, reduce_to_phase
from .stack import Layer, LayerStack
from .transfer_matrix import layer_absorption, reflection_transmission

__all__ = [
    "Beam",
    "Illumination",
    "Layer",
    "LayerStack",
    "Medium",
    "PhaseResponse",
    "SpectralProfile",
    "constant_medium",
    "get_medium",
    "layer_absorption",
    "medium_names",
    "partially_coherent_absorption",
    "reduce_to_phase",
    "reflection_transmission",
]
