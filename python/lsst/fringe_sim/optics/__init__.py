"""Thin-film optics: media, stacks, transfer matrices, illumination.

The names are imported on first use: some bring a compiler along that a list of set-ups does not need.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .coherence import partially_coherent_absorption as partially_coherent_absorption
    from .convergence import converged as converged
    from .convergence import converged_flat_fields as converged_flat_fields
    from .convergence import converged_spectrum as converged_spectrum
    from .illumination import Beam as Beam
    from .illumination import Illumination as Illumination
    from .illumination import LampSpectrum as LampSpectrum
    from .illumination import SpectralProfile as SpectralProfile
    from .media import Medium as Medium
    from .media import constant_medium as constant_medium
    from .media import get_medium as get_medium
    from .media import medium_names as medium_names
    from .phase_response import PhaseResponse as PhaseResponse
    from .phase_response import reduce_to_phase as reduce_to_phase
    from .sensitivity import ResponseGradient as ResponseGradient
    from .sensitivity import response_gradient as response_gradient
    from .stack import Layer as Layer
    from .stack import LayerStack as LayerStack
    from .transfer_matrix import layer_absorption as layer_absorption
    from .transfer_matrix import reflection_transmission as reflection_transmission
    from .two_phase_response import ThicknessGrid as ThicknessGrid
    from .two_phase_response import TwoPhaseResponse as TwoPhaseResponse
    from .two_phase_response import reduce_to_two_phases as reduce_to_two_phases

_LAZY = {
    "Beam": ".illumination",
    "Illumination": ".illumination",
    "LampSpectrum": ".illumination",
    "Layer": ".stack",
    "LayerStack": ".stack",
    "Medium": ".media",
    "PhaseResponse": ".phase_response",
    "ResponseGradient": ".sensitivity",
    "SpectralProfile": ".illumination",
    "ThicknessGrid": ".two_phase_response",
    "TwoPhaseResponse": ".two_phase_response",
    "constant_medium": ".media",
    "converged": ".convergence",
    "converged_flat_fields": ".convergence",
    "converged_spectrum": ".convergence",
    "get_medium": ".media",
    "layer_absorption": ".transfer_matrix",
    "medium_names": ".media",
    "partially_coherent_absorption": ".coherence",
    "reduce_to_phase": ".phase_response",
    "reduce_to_two_phases": ".two_phase_response",
    "reflection_transmission": ".transfer_matrix",
    "response_gradient": ".sensitivity",
}

__all__ = sorted(_LAZY)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name], __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
