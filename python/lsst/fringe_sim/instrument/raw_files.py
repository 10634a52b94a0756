"""Which files of raw frames are meant by paths, folders and patterns."""

from __future__ import annotations

import glob
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from ..errors import InputError
from .raw_frame import RawFrame

SUFFIXES = (".fits", ".fits.fz", ".fits.gz", ".fz")  # Endings of the files that are taken from a directory

_ENDINGS = f"one that ends in {', '.join(SUFFIXES)}, or the file itself as PATH"

_LIKE_FITS = re.compile(r"[^.].*\.(fits|fit|fts)(\.(gz|fz|bz2|xz|zip|z))?", re.IGNORECASE)


def find_raw_files(paths: Iterable[str]) -> tuple[list[str], list[InputError]]:
    """Find the files that are meant by files, directories (with everything below them) and patterns.

    Absolute paths, sorted, each once; and an error for each path that leads to no file, and for each file of a
    directory that is named like a FITS file, but not as those that are taken from one.
    """
    files: set[str] = set()
    refused: list[InputError] = []
    for path in paths:
        found = list(_expand(path))
        if not found:
            allowed = (
                f"a file, a directory that holds {'/'.join(SUFFIXES)} files, or a pattern that matches some"
            )
            refused.append(InputError("path", path, allowed))
        files.update(str(file.absolute()) for file in found)
        refused += [InputError("name", str(other), _ENDINGS) for other in _left_out(Path(path))]
    return sorted(files), refused


def _left_out(folder: Path) -> list[Path]:
    """Files of a directory that look like frames and are not taken."""
    if not folder.is_dir():
        return []
    others = (file for file in folder.rglob("*") if not file.name.endswith(SUFFIXES) and file.is_file())
    return sorted(file for file in others if _LIKE_FITS.fullmatch(file.name))


def pixel_digest(frame: RawFrame) -> str:
    """Digest of all pixels: equal for the same light in a copy, compressed or not, whatever its header says."""
    digest = hashlib.blake2b(digest_size=16)
    for amp in frame.amplifiers:
        digest.update(np.ascontiguousarray(amp.data, "<i4").data)
    return digest.hexdigest()


def _expand(path: str) -> Iterator[Path]:
    entry = Path(path)
    if entry.is_dir():
        yield from (file for file in entry.rglob("*") if file.is_file() and file.name.endswith(SUFFIXES))
    elif entry.is_file():
        yield entry
    else:
        for name in glob.iglob(path, recursive=True):
            if name != path:  # else a pipe, a device, or a link to nothing
                yield from _expand(name)
