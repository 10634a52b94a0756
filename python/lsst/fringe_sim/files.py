"""Files that are there whole or not at all."""

from __future__ import annotations

import fcntl
import io
import json
import os
import re
import secrets
import stat
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from glob import has_magic, iglob
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import InputError

if TYPE_CHECKING:
    from astropy.table import Table

LOCK = ".fringe-sim.lock"  # File in a folder into which a command writes, locked as long as it does


@contextmanager
def all_or_nothing(target: Path) -> Iterator[Path]:
    """Path to write in place of a file.

    It becomes that file if the block ends well, and vanishes if not. The content is on the disk before it gets the
    name, so that not even a crash of the machine leaves half of it there.

    ``target``: the file; an existing one is replaced. Where it is a link, the link is replaced and not what
        it points to. What a writer of this file has left that was killed is cleared.
    `OSError`: the folder does not exist or cannot be written, or the disk is full.
    """
    with _temporary(target) as temporary:
        yield temporary
        _to_disk(temporary)
        os.replace(temporary, target)
        with suppress(OSError):  # some file systems of networks know no such thing for folders
            _to_disk(target.parent)


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write text (in UTF-8) or bytes into a file; see `all_or_nothing`."""
    target = Path(path)
    with all_or_nothing(target) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    return target


def write_together(folder: Path, contents: Mapping[str, str]) -> Path:
    """Write files that belong together; the last of them is there only if all the others are those of this call.

    All of them are complete under temporary names before the first gets its own.

    ``folder``: an existing folder.
    ``contents``: text of each file by its name. The last one is the index, by which readers find the others.
    `OSError`: the folder does not exist or cannot be written, or the disk is full: the files of before are
        then untouched.
    """
    *_, index = contents
    with ExitStack() as stack:
        written = {name: stack.enter_context(_temporary(folder / name)) for name in contents}
        for name, text in contents.items():
            written[name].write_bytes(text.encode())
            _to_disk(written[name])
        # An index of before must not stand beside any file of now.
        (folder / index).unlink(missing_ok=True)
        for name, temporary in written.items():
            os.replace(temporary, folder / name)
        with suppress(OSError):
            _to_disk(folder)
    return folder / index


def same_file_key(name: str) -> str:
    """What two names have in common that are one file where a file system does not tell letters apart.

    Those of macOS and Windows take upper and lower case for the same, and accents however they are coded.
    """
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def json_text(value: Any) -> str:
    """A value in JSON, as people read it."""
    return json.dumps(value, indent=2)


def table_text(table: Table) -> str:
    """A table as ECSV, for `write_whole` and `write_together`."""
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    return text.getvalue()


def refuse_unfinished(inputs: Iterable[str]) -> None:
    """Refuse to read series of files from a folder whose run is at work, or was stopped before its end.

    ``inputs``: folders, which are read with all below them, patterns and files. A file alone is whole.
    `InputError`: there is the lock of a run in one of the folders.
    """
    for lock in _locks_in(list(inputs)):
        try:
            descriptor = os.open(lock, os.O_RDONLY | os.O_NOFOLLOW)
        except FileNotFoundError:
            continue
        allowed = (
            "one whose run came to its end: some files may be missing. Run it again with --overwrite, or remove "
            f"{LOCK} there to take what there is"
            if _is_unlocked(descriptor)
            else "one into which no run is writing just now"
        )
        raise InputError("folder that is read", str(lock.parent), allowed)


def _locks_in(inputs: Sequence[str]) -> list[Path]:
    """Where there are locks in folders and below them, and beside several files or what a pattern finds."""
    folders = [Path(given) for given in inputs if Path(given).is_dir()]
    beside = Counter(Path(given).parent for given in inputs if Path(given).is_file())
    found = {folder for folder, number in beside.items() if number > 1}
    for given in inputs:
        if has_magic(given) and not Path(given).exists():
            found |= {Path(name).parent for name in iglob(given, recursive=True)}
    # A repository is written by the middleware, and is large.
    deep = [folder for folder in folders if not (folder / "butler.yaml").exists()]
    return [
        *(folder / LOCK for folder in sorted(found)),
        *(lock for folder in deep for lock in folder.rglob(LOCK)),
    ]


def _is_unlocked(descriptor: int) -> bool:
    """Whether nobody holds the lock of a file, which is closed."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True


@contextmanager
def _temporary(target: Path) -> Iterator[Path]:
    """A new empty file beside one to be written; it is gone in the end, if it has not been renamed.

    It is locked as long as its writer lives: an unlocked one is what a killed writer has left.
    """
    _clear(target)
    while True:
        # A new name that nobody else has, never opened through a link that somebody has put there.
        temporary = target.with_name(f".{target.name}.{secrets.token_hex(6)}.part")
        descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW, 0o666)
        with suppress(OSError):  # some file systems have no locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if temporary.exists():  # else another writer cleared it before it was locked
            break
        os.close(descriptor)
    try:
        with _named_after(target, temporary):
            yield temporary
    finally:
        temporary.unlink(missing_ok=True)
        os.close(descriptor)


@contextmanager
def _named_after(target: Path, temporary: Path) -> Iterator[None]:
    """Let an error over a temporary file name the one that was meant; a full disk names none."""
    try:
        yield
    except OSError as error:
        if error.filename not in (None, str(temporary), temporary):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(target)) from error


def _clear(target: Path) -> None:
    """Remove temporary files of a target whose writers are dead."""
    left: list[str] = []
    name = re.compile(re.escape(f".{target.name}.") + r"[0-9a-f]{12}\.part")
    with suppress(FileNotFoundError), os.scandir(target.parent) as entries:
        left = [entry.path for entry in entries if name.fullmatch(entry.name)]
    for path in left:
        with suppress(OSError):  # locked, or of somebody else
            _remove_unlocked(path)


def _remove_unlocked(path: str) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.unlink(path)
    finally:
        os.close(descriptor)


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
