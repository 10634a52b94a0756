"""Thickness maps from flats at many wavelengths: a global fit, and the walk of the paper as its peer.

Inside, ``order_um`` is the thickness of one fringe order [µm], ``range_um`` the thicknesses that are possible [µm],
and ``temper`` the number of independent cells per cell, or pixels per pixel: below 1 where the noise of neighbours is
correlated.
"""

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
