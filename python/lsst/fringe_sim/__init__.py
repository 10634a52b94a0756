"""CCD fringing for the LSST Camera and its relatives.

Thin-film optics, adhesive-thickness fits, night-sky fringe frames, fringe templates, and a search for the
effects that a model still lacks. The heavy parts are imported on first use.
"""

from __future__ import annotations

from .lazy import homes, on_first_use

__version__ = "1.0.0"

_LAZY = homes(middleware="LsstCamFringe Ts8Fringe MonoCamFringe HscFringe")

__all__ = ["__version__", *sorted(_LAZY)]
__getattr__ = on_first_use(__name__, _LAZY)
