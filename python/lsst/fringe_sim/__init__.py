"""CCD fringing for the LSST Camera and its relatives.

Thin-film optics, epoxy-thickness fits, night-sky fringe frames, fringe templates, and a search for the
effects that a model still lacks. The heavy parts are imported on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.2.0"

_LAZY = {
    "LsstCamFringe": ".middleware",
    "Ts8Fringe": ".middleware",
    "MonoCamFringe": ".middleware",
    "HscFringe": ".middleware",
}

__all__ = ["__version__", *sorted(_LAZY)]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name], __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
