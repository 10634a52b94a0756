"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["all_or_nothing", "write_whole"]


@contextmanager
def all_or_nothing(target: Path) -> Iterator[Path]:
    """Path to write in place of a file.

    It becomes that file if the block ends well, and vanishes if not. The content is on the disk before it gets the
    name, so that not even a crash of the machine leaves half of it there.

    Parameters
    ----------
    target : `pathlib.Path`
        The file; an existing one is replaced. Where it is a link, the link is replaced and not what it points to.

    Raises
    ------
    OSError
        The folder does not exist or cannot be written, or the disk is full.
    """
    # A new name that nobody else has, never opened through a link that somebody has put there.
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(6)}.part")
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW, 0o666))
    try:
        yield temporary
        _to_disk(temporary)
        os.replace(temporary, target)
        with suppress(OSError):  # some file systems of networks know no such thing for folders
            _to_disk(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write text (in UTF-8) or bytes into a file; see `all_or_nothing`."""
    target = Path(path)
    with all_or_nothing(target) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    return target


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
