"""Thin-film optics: media, stacks, transfer matrices, illumination.

The names are imported on first use: some bring a compiler along that a list of set-ups does not need.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..lazy import homes, on_first_use

if TYPE_CHECKING:
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
    from .stack import Layer as Layer
    from .stack import LayerStack as LayerStack
    from .transfer_matrix import layer_absorption as layer_absorption

_LAZY = homes(
    illumination="Beam Illumination LampSpectrum SpectralProfile",
    media="Medium constant_medium get_medium medium_names",
    phase_response="PhaseResponse reduce_to_phase",
    stack="Layer LayerStack",
    transfer_matrix="layer_absorption",
)

__all__ = sorted(_LAZY)  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__ = on_first_use(__name__, _LAZY)
