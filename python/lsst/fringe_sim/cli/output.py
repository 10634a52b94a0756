"""Folders that commands write into: one run in each, and one writer at a time."""

from __future__ import annotations

import functools
import os
import shlex
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from glob import escape, has_magic, iglob
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import InputError, shown
from ..files import LOCK, refuse_unfinished
from .command import flag, option

if TYPE_CHECKING:
    from ..report.page import Origin

OURS = (b"ORIGIN  = 'lsst.fringe_sim'", b"FRINGTID=", b"FRINGUND=")
"""What a FITS file of this program says in its first header: its origin, or that fringes were taken or put back."""

AT_WORK = f"{__name__}.at_work"
"""Entry of the memory of a command that has begun to write and has not come to its end."""

PAGE = "report.html"
LONGEST_COMMAND = 300  # Name of pages, and characters of a command that they show

HEADER_BYTES = 57_600  # of a FITS file, in which its ORIGIN is looked for


@dataclass(frozen=True)
class OutputFolder(os.PathLike[str]):
    """Where a command writes.

    ``path``: the folder; it need not exist.
    ``products``: names of what the command writes there; ``*`` and ``[0-9]`` as in the shell.
    ``overwrite``: whether products of an earlier run are cleared. Nothing else ever is.
    ``resumes``: whether the command goes on with what an earlier run has left.
    """

    path: Path
    products: tuple[str, ...]
    overwrite: bool = False
    resumes: bool = False

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    def holding(self, *products: str) -> OutputFolder:
        """The same folder for products that are known only now."""
        return replace(self, products=products)

    def refuse_used(self) -> None:
        """Refuse a folder with products of an earlier run, before long work.

        `InputError`: there are some, and neither are they to be cleared nor to be gone on with; or some that are
            to be cleared are of another program; or the path is a file.
        """
        if self.path.exists() and not self.path.is_dir():
            raise InputError("output folder", str(self), "a folder, not a file")
        if self.overwrite:
            self._refuse_foreign()
            return
        left = [file.name for file in self._left()]
        if left and not self.resumes:
            more = f" and {len(left) - 1} more" if len(left) > 1 else ""
            raise InputError(
                "output folder",
                str(self),
                f"one without products of an earlier run (there is {left[0]}{more}); --overwrite replaces them",
            )

    def prepare(self) -> Path:
        """Make the folder, keep other writers out until the command ends, clear what is to be replaced.

        A folder that was not there, and into which nothing was written, is taken away when the command ends.

        `InputError`: it cannot be made or written, another run writes into it, or it is used (`refuse_used`).
        """
        self.refuse_used()
        new = [path for path in (self.path, *self.path.parents) if not path.exists()]
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            allowed = f"a folder that can be made ({error.strerror})"
            raise InputError("output folder", str(self), allowed) from None
        if not os.access(self.path, os.W_OK):
            raise InputError("output folder", str(self), "a folder that can be written")
        self._lock(new)
        self.refuse_used()
        for part in self._matching(f".{name}.*.part" for name in self.products):
            part.unlink(missing_ok=True)
        if self.overwrite:
            self._clear()
        context = click.get_current_context(silent=True)
        if context is not None:
            context.meta[AT_WORK] = True
        return self.path

    def _left(self) -> list[Path]:
        return self._matching(self.products)

    def _matching(self, patterns: Any) -> list[Path]:
        return sorted({file for pattern in patterns for file in self.path.glob(pattern)})

    def _refuse_foreign(self) -> None:
        # A link is taken away itself, and not what it points to.
        whole = [file for file in self._left() if file.suffix == ".fits" and not file.is_symlink()]
        foreign = [file.name for file in whole if not _is_ours(file)]
        if foreign:
            raise InputError(
                "output folder",
                str(self),
                f"one in which {foreign[0]} was written by this program; nothing is cleared",
            )
        self._refuse_changed()

    def _refuse_changed(self) -> None:
        # A search leaves the beginning of an effect, which a person finishes: that is not there twice.
        from ..model.effects_override import is_as_written

        for file in self._left():
            if (
                file.suffix == ".py"
                and not file.is_symlink()
                and not is_as_written(file.read_text(errors="replace"))
            ):
                allowed = (
                    f"one in which {file.name} is as it was written; it was changed, and nothing is cleared"
                )
                raise InputError("output folder", str(self), allowed)

    def _clear(self) -> None:
        for file in self._left():
            if file.is_dir() and not file.is_symlink():
                shutil.rmtree(file)
            else:
                file.unlink(missing_ok=True)

    def _lock(self, new: Sequence[Path]) -> None:
        """Lock that the system releases when the process ends, however it does.

        ``new``: folders that were made for this run, the innermost first.
        Its file stays beside the products of a run that did not come to its end, which are not all there.
        """
        descriptor = _locked(self.path / LOCK)
        if descriptor is None:
            raise InputError("output folder", str(self), "one into which no other run is writing just now")
        context = click.get_current_context(silent=True)
        if context is not None:
            context.call_on_close(functools.partial(self._release, context.meta, descriptor, new))

    def _release(self, meta: dict[str, Any], descriptor: int, new: Sequence[Path]) -> None:
        lock = self.path / LOCK
        with suppress(OSError):  # the folder may be another one by now, with a lock that is not ours
            if _is_same(lock, descriptor) and not (AT_WORK in meta and self._left()):
                lock.unlink()
        os.close(descriptor)
        with suppress(OSError):  # of a folder that is not empty
            for folder in new:
                folder.rmdir()


def _locked(path: Path) -> int | None:
    """Descriptor of a lock, `None` where another process has it. Some network file systems know no locks."""
    import fcntl

    while True:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except OSError:
            return descriptor
        if _is_same(path, descriptor):
            return descriptor
        os.close(descriptor)  # the former holder has just removed it


def _is_same(path: Path, descriptor: int) -> bool:
    """Whether a file still has the name under which it was opened."""
    with suppress(FileNotFoundError):
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    return False


def _is_ours(path: Path) -> bool:
    with path.open("rb") as stream:
        header = stream.read(HEADER_BYTES)
    return any(word in header for word in OURS)


def refuse_among_inputs(folder: Path, inputs: Iterable[str]) -> None:
    """Refuse to write into a folder that is read: the next run would take products for frames.

    ``folder``: where products go; it need not exist.
    ``inputs``: files, folders, which are read with all below them, and patterns.
    `InputError`: the folder is one of the inputs, inside one, or where a pattern finds files.
    """
    target = folder.resolve()
    for given in inputs:
        read = Path(given).resolve()
        inside = Path(given).is_dir() and target.is_relative_to(read)
        if not inside and has_magic(given):
            found = [Path(name) for name in iglob(given, recursive=True)]
            inside = any(
                target.is_relative_to(name.resolve()) if name.is_dir() else target == name.resolve().parent
                for name in found
            )
        if inside:
            allowed = (
                f"a folder that is not in {given}, which is read: a next run would take products for frames"
            )
            raise InputError("output folder", str(folder), allowed)


def _inputs_of(context: click.Context) -> list[str]:
    """What a command is given to read: its arguments, and options with a path that is not to be written.

    Several files of a folder are what a shell makes of a pattern, which finds more in a next run.
    """
    given: list[str] = []
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        if (
            value is not None
            and parameter.name != "out"
            and (isinstance(parameter, click.Argument) or isinstance(parameter.type, click.Path))
            and not getattr(parameter.type, "writable", False)
        ):
            own = [str(item) for item in (value if isinstance(value, tuple) else (value,))]
            files = Counter((Path(item).parent, Path(item).suffix) for item in own if Path(item).is_file())
            given += own
            given += [
                f"{escape(str(folder))}/*{end}" for (folder, end), number in files.items() if number > 1
            ]
    return given


def origin_of(out: Path, given: Iterable[str | os.PathLike[str]]) -> Origin:
    """Command that runs, and pages of this program that lie beside what it was given.

    ``out``: folder of the page to be written.
    ``given``: files and folders that were read, or their names.
    """
    from ..report.page import Origin, title_of

    context = click.get_current_context(silent=True)
    words = None if context is None else context.obj
    if words is not None:  # what replaces an earlier run decides nothing of this one
        words = [word for word in words if word != "--overwrite"]
    command = "" if words is None else shown(shlex.join(["fringe-sim", *words]), LONGEST_COMMAND)
    folders = dict.fromkeys(path if path.is_dir() else path.parent for path in map(Path, given))
    pages = {}
    for page in (folder / PAGE for folder in folders if folder.resolve() != out.resolve()):
        title = title_of(page)
        if title:
            pages[os.path.relpath(page, out)] = title
    return Origin(command, tuple((title, address) for address, title in pages.items()))


def refuse_used_file(option: str, file: Path, overwrite: bool) -> None:
    """Refuse a file that is there already, or cannot be written, before long work.

    `InputError`: it is there and is not to be replaced, is no regular file, or its folder is not there.
    """
    if file.exists() and not (overwrite and file.is_file()):
        allowed = "a file, not something else" if overwrite else "a new file; --overwrite replaces it"
        raise InputError(option, str(file), allowed)
    if not os.access(file.parent, os.W_OK):
        raise InputError(option, str(file), "a file in a folder that is there and can be written")


def output_folder(
    help_text: str,
    *products: str,
    argument: bool = False,
    default: Path | None = None,
    required: bool = True,
    resumes: bool = False,
) -> Any:
    """``--out`` and ``--overwrite`` of a command, which gets them as one `OutputFolder` named ``out``.

    ``help_text``: what ``--out`` says under ``--help``.
    ``*products``: what the command writes there; see `OutputFolder`.
    ``argument``: the folder is the argument OUTDIR, not an option.
    ``default``, ``required``: folder without the option, and whether there must be one.
    ``resumes``: the command goes on with what an earlier run has left.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def with_folder(*, out: Path | None, overwrite: bool, **others: Any) -> None:
            context = click.get_current_context()
            folder = None if out is None else OutputFolder(out, products, overwrite, resumes)
            read = _inputs_of(context)
            if folder is not None:
                folder.refuse_used()
                refuse_among_inputs(folder.path, read)
            refuse_unfinished(read)
            try:
                command(out=folder, **others)
            except click.exceptions.Exit:  # the end too, with frames that were refused
                context.meta.pop(AT_WORK, None)
                raise
            context.meta.pop(AT_WORK, None)

        kind = click.Path(path_type=Path)
        named = option(help_text, default, kind, required=required and default is None)("out")
        if argument:
            named = click.argument("out", metavar="OUTDIR", type=kind)
        clear = flag("Clear what an earlier run of this command left in the folder.")("overwrite")
        made: Callable[..., None] = named(clear(with_folder))
        return made

    return lambda name: decorate
