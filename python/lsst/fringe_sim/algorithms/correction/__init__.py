"""Fringes of observed frames: background and scales in one fit, templates from frames, proof of a correction."""

from .background import AmplifierGrid, BackgroundTerms
from .scales import ScaleFit, fit_scales, steady_weight

__all__ = ["AmplifierGrid", "BackgroundTerms", "ScaleFit", "fit_scales", "steady_weight"]
