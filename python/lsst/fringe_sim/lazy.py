"""Names of a package that are imported on first use: some bring a compiler or a Butler along."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def homes(**names: str) -> dict[str, str]:
    """The module of each name, relative to its package; given are the names in each module, between blanks."""
    return {name: f".{module}" for module, listed in names.items() for name in listed.split()}


def on_first_use(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """``__getattr__`` of a package whose names are in the modules ``homes``, relative to it."""

    def getattribute(name: str) -> Any:
        if name in homes:
            return getattr(importlib.import_module(homes[name], package), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return getattribute
