"""Tables and YAML shipped with the package, read with their provenance."""

from __future__ import annotations

import functools
import hashlib
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any

import yaml
from astropy.table import Table

from .errors import ResourceError, UnknownNameError

__all__ = ["list_resources", "read_table", "read_yaml", "resource_path", "revision"]

REQUIRED_PROVENANCE = ("source", "doi", "licence")

REVISION_LENGTH = 12


def resource_path(folder: str, name: str) -> Traversable:
    """Path of ``data/<folder>/<name>`` inside the installed package.

    Raises
    ------
    UnknownNameError
        There is no such file; the ones that exist are named.
    """
    base = resources.files("lsst.fringe_sim") / "data"
    for part in folder.split("/"):
        base = base / part
    path = base / name
    if "/" in name or not path.is_file():
        suffix = name.rpartition(".")[2]
        raise UnknownNameError(f"resource in data/{folder}", name, list_resources(folder, f".{suffix}"))
    return path


def list_resources(folder: str, suffix: str = ".yaml") -> tuple[str, ...]:
    """Names of the files in ``data/<folder>`` that end in ``suffix``, sorted."""
    base = resources.files("lsst.fringe_sim") / "data"
    for part in folder.split("/"):
        base = base / part
    return tuple(sorted(entry.name for entry in base.iterdir() if entry.name.endswith(suffix)))


@functools.lru_cache(maxsize=256)
def revision(folder: str, name: str) -> str:
    """Beginning of the SHA-256 of a shipped file: what a header states about the numbers it was made with.

    Raises
    ------
    UnknownNameError
        There is no such file.
    """
    return hashlib.sha256(resource_path(folder, name).read_bytes()).hexdigest()[:REVISION_LENGTH]


@functools.lru_cache(maxsize=64)
def _read_table(folder: str, name: str) -> Table:
    path = resource_path(folder, name)
    with resources.as_file(path) as file:
        table = Table.read(file, format="ascii.ecsv")
    missing = [key for key in REQUIRED_PROVENANCE if not table.meta.get(key)]
    if missing:
        raise ResourceError(f"data/{folder}/{name} does not state its {', '.join(missing)}")
    return table


def read_table(folder: str, name: str) -> Table:
    """Read a shipped ECSV table.

    Parameters
    ----------
    folder, name : `str`
        ``data/<folder>/<name>`` inside the package.

    Returns
    -------
    table : `astropy.table.Table`
        A copy, with units on its columns and ``source``, ``doi`` and ``licence`` in ``meta``.

    Raises
    ------
    UnknownNameError
        There is no such table.
    ResourceError
        The table does not state where its numbers come from.
    """
    return _read_table(folder, name).copy()


def read_yaml(folder: str, name: str) -> dict[str, Any]:
    """Read a shipped YAML mapping with the safe loader.

    Raises
    ------
    UnknownNameError
        There is no such file.
    ResourceError
        The file is not a mapping.
    """
    content = yaml.safe_load(resource_path(folder, name).read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ResourceError(f"data/{folder}/{name} must hold a mapping")
    return content
