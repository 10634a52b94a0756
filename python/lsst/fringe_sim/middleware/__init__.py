"""The Rubin middleware's side: instruments, raw ingest, storage classes, formatters, butler commands.

Importing this package makes its storage classes known, so that pipelines build without a repository.
"""

from __future__ import annotations

import importlib
from typing import Any

from .storage_classes import register_storage_classes

_LAZY = {
    "FringeInstrument": ".instruments",
    "HscFringe": ".instruments",
    "LsstCamFringe": ".instruments",
    "MonoCamFringe": ".instruments",
    "Ts8Fringe": ".instruments",
    "get_cli_subcommands": ".cli",
    "hour_of_night": ".night",
}

__all__ = ["register_storage_classes", *sorted(_LAZY)]

register_storage_classes()


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name], __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
