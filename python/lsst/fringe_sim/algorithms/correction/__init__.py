"""Fringes of observed frames: background and scales in one fit, templates from frames, proof of a correction."""

from .background import AMPLIFIERS_UNKNOWN, AmplifierGrid, BackgroundTerms
from .scales import ScaleFit, fit_scales, steady_weight

__all__ = [
    "AMPLIFIERS_UNKNOWN",
    "AmplifierGrid",
    "BackgroundTerms",
    "ScaleFit",
    "fit_scales",
    "steady_weight",
]
