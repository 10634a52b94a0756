"""Finished tables on disk, found by a hash of their content.

A table is written under another name and then renamed, so that a reader sees it whole or not at all however many
processes write at once or die while writing. A file that cannot be read back is rebuilt, with a warning.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import InputError, TableCacheWarning

__all__ = ["TableCache"]

Table = TypeVar("Table")

_ABANDONED_AFTER_S = 3600.0
"""Age at which an unfinished file is taken to be that of a writer that died [s]."""


@dataclass(frozen=True)
class TableCache:
    """A folder of tables, one ``.npz`` file without pickled objects each.

    Attributes
    ----------
    directory : `pathlib.Path`
        The folder; made when the first table is stored.
    """

    directory: Path

    @classmethod
    def default(cls) -> TableCache:
        """Folder ``FRINGE_SIM_CACHE``, or else ``fringe_sim`` in ``XDG_CACHE_HOME`` (``~/.cache``)."""
        chosen = os.environ.get("FRINGE_SIM_CACHE")
        if chosen:
            return cls(Path(chosen))
        base = os.environ.get("XDG_CACHE_HOME")
        return cls((Path(base) if base else Path.home() / ".cache") / "fringe_sim")

    def path(self, key: str) -> Path:
        """File of the table with this key."""
        if not key or not key.isalnum():
            raise InputError("key of a table", key, "letters and digits")
        return self.directory / f"{key}.npz"

    def get(self, key: str, kind: type[Table], build: Callable[[], Table]) -> Table:
        """Return the table with this key; build and store it if it is not there or cannot be read.

        Parameters
        ----------
        key : `str`
            Hash of the content.
        kind : `type`
            A dataclass of arrays, numbers and strings, one of them called ``key``.
        build : callable
            Makes the table.

        Warns
        -----
        TableCacheWarning
            A file is damaged, or the folder cannot be written; the table is returned all the same.
        """
        path = self.path(key)
        try:
            return _read(path, key, kind)
        except (FileNotFoundError, NotADirectoryError):
            pass
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            _warn(f"{path}: cannot be read ({error}); it is rebuilt")
        table = build()
        try:
            self._store(path, table)
        except OSError as error:
            _warn(f"{path}: cannot be written ({error}); the table is not kept")
        return table

    def _store(self, path: Path, table: Any) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        self._remove_abandoned()
        handle, temporary = tempfile.mkstemp(dir=self.directory, prefix=f"{path.stem[:16]}.", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                _write(file, table)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise

    def _remove_abandoned(self) -> None:
        before = time.time() - _ABANDONED_AFTER_S
        for leftover in self.directory.glob("*.part"):
            with contextlib.suppress(OSError):
                if leftover.stat().st_mtime < before:
                    leftover.unlink()


def _write(file: Any, table: Any) -> None:
    arrays, scalars = {}, {}
    for item in fields(table):
        value = getattr(table, item.name)
        if isinstance(value, np.ndarray):
            arrays[item.name] = value
        else:
            scalars[item.name] = value
    np.savez(file, allow_pickle=False, **arrays, _scalars=np.array(json.dumps(scalars)))


def _read(path: Path, key: str, kind: type[Table]) -> Table:
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
        # Reading a member verifies its checksum.
        scalars = json.loads(str(content["_scalars"]))
        arrays = {name: content[name] for name in content.files if name != "_scalars"}
    if scalars.get("key") != key:
        raise ValueError("it belongs to another key")
    return kind(**arrays, **scalars)


def _warn(message: str) -> None:
    warnings.warn(message, TableCacheWarning, stacklevel=3)
