"""Thickness maps from flats at many wavelengths: a global fit, and the walk of the paper as its peer."""

from ..thickness_fit_options import SILICON_FIELDS
from .amplitudes import Amplitudes
from .conclusion import remarks, says_misfit
from .fit import FIT_METHODS, fit_thickness, make_templates
from .global_fit import GlobalFit, global_fit
from .guo2022 import walk_fit
from .nuisances import NuisanceFit, Nuisances
from .pixels import PixelFit
from .silicon import find_silicon
from .silicon_result import SiliconFit, SiliconForecast, SiliconSearch, silicon_map
from .silicon_tables import SiliconModel
from .templates import FlatTemplates

__all__ = [
    "FIT_METHODS",
    "SILICON_FIELDS",
    "Amplitudes",
    "FlatTemplates",
    "GlobalFit",
    "NuisanceFit",
    "Nuisances",
    "PixelFit",
    "SiliconFit",
    "SiliconForecast",
    "SiliconModel",
    "SiliconSearch",
    "find_silicon",
    "fit_thickness",
    "global_fit",
    "make_templates",
    "remarks",
    "says_misfit",
    "silicon_map",
    "walk_fit",
]
