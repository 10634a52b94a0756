"""CCD fringing for the LSST Camera and its relatives.

Thin-film optics, adhesive-thickness fits, night-sky fringe frames, fringe templates, and a search for the
effects that a model still lacks. The heavy parts are imported on first use.
"""

from __future__ import annotations

from .lazy import on_first_use

__version__ = "1.0.0"

_LAZY = {
    "LsstCamFringe": ".middleware",
    "Ts8Fringe": ".middleware",
    "MonoCamFringe": ".middleware",
    "HscFringe": ".middleware",
}

__all__ = ["__version__", *sorted(_LAZY)]
__getattr__ = on_first_use(__name__, _LAZY)
