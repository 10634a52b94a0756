"""Tables and YAML shipped with the package, read with their provenance."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
import os
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml

from .errors import FrameFormatError, InputError, ResourceError, UnknownNameError
from .fits_gate import check_axes

REQUIRED_PROVENANCE = ("source", "doi", "licence")

REVISION_LENGTH = 12

LONGEST_USER_FILE = 1_000_000
"""Characters of a YAML file that a user gives; descriptions of sensors have a few thousand."""

DEEPEST_NESTING = 20

if TYPE_CHECKING:
    from astropy.io import fits
    from astropy.table import Table

    DAMAGE: tuple[type[Exception], ...]
    """What astropy raises when a file is not as its headers say; warnings too, where they are errors."""

_DAMAGE = (
    *(
        OSError,
        EOFError,
        ValueError,
        TypeError,
        IndexError,
        KeyError,
        AttributeError,
        OverflowError,
        MemoryError,
        AssertionError,
        zlib.error,
        zipfile.BadZipFile,
        yaml.YAMLError,
        NotImplementedError,
    ),
    Warning,
)

_SHIPPED = re.compile(r"\w[\w.+-]*")

LARGEST_USER_TABLE = 1 << 26
"""Bytes of a table or document that a user gives; a line list of a whole night sky has a million."""


def __getattr__(name: str) -> Any:
    """`DAMAGE`, one kind of which is astropy's: its import takes longer than most of what else is read here."""
    if name == "DAMAGE":
        return _damage()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@functools.cache
def _damage() -> tuple[type[Exception], ...]:
    from astropy.io.fits import VerifyError

    return (*_DAMAGE, VerifyError)


def _data() -> Traversable:
    return resources.files("lsst.fringe_sim") / "data"


def resource_path(folder: str, name: str) -> Traversable:
    """Path of ``data/<folder>/<name>`` inside the installed package."""
    base = _data()
    # A header from outside names them: nothing but a name of the package itself is looked up.
    if not all(map(_SHIPPED.fullmatch, [*folder.split("/"), name])):
        raise UnknownNameError("resource", f"{folder}/{name}", ())
    for part in folder.split("/"):
        base = base / part
    if not base.is_dir():
        raise UnknownNameError("folder of resources", folder, (item.name for item in _data().iterdir()))
    path = base / name
    if not path.is_file():
        suffix = name.rpartition(".")[2]
        raise UnknownNameError(f"resource in data/{folder}", name, list_resources(folder, f".{suffix}"))
    return path


def list_resources(folder: str, suffix: str = ".yaml") -> tuple[str, ...]:
    """Names of the files in ``data/<folder>`` that end in ``suffix``, sorted."""
    base = _data()
    for part in folder.split("/"):
        base = base / part
    return tuple(sorted(entry.name for entry in base.iterdir() if entry.name.endswith(suffix)))


@functools.lru_cache(maxsize=256)
def revision(folder: str, name: str) -> str:
    """Beginning of the SHA-256 of a shipped file: what a header states about the numbers it was made with."""
    return hashlib.sha256(resource_path(folder, name).read_bytes()).hexdigest()[:REVISION_LENGTH]


@functools.lru_cache(maxsize=64)
def _read_table(folder: str, name: str) -> Table:
    from astropy.table import Table

    path = resource_path(folder, name)
    with resources.as_file(path) as file:
        table = Table.read(file, format="ascii.ecsv")
    missing = [key for key in REQUIRED_PROVENANCE if not table.meta.get(key)]
    if missing:
        raise ResourceError(f"data/{folder}/{name} does not state its {', '.join(missing)}")
    return table


def read_table(folder: str, name: str) -> Table:
    """A copy of ``data/<folder>/<name>`` in ECSV, which must state its ``source``, ``doi`` and ``licence``."""
    return _read_table(folder, name).copy()


def read_yaml(folder: str, name: str) -> dict[str, Any]:
    """The mapping in ``data/<folder>/<name>``, read with the safe loader."""
    content = yaml.safe_load(resource_path(folder, name).read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ResourceError(f"data/{folder}/{name} must hold a mapping")
    return content


def read_user_yaml(path: str | os.PathLike[str], what: str) -> Any:
    """Content of a YAML file from outside; ``what`` it should be is for the message, as ``settings file``."""
    return parse_user_yaml(read_user_text(path, what, 4 * LONGEST_USER_FILE), what, source=str(path))


def read_user_text(path: str | os.PathLike[str], what: str, most: int = LARGEST_USER_TABLE) -> str:
    """Text of a file from outside, which may be anything; refused unless regular, UTF-8, of ``most`` bytes."""
    file = Path(path)
    if not file.is_file():
        raise InputError(what, str(path), "an existing file")
    if file.stat().st_size > most:
        raise InputError(what, f"{file.stat().st_size} bytes", f"up to {most}", source=str(path))
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(what, str(error), "text in UTF-8", source=str(path)) from None


def read_user_table(path: str | os.PathLike[str], what: str) -> Table:
    """Read an ECSV table that a user gives, and which may be anything.

    Its header is YAML, and may be no more than `parse_user_yaml` allows.
    """
    from astropy.table import Table

    text = read_user_text(path, what)
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    header = "\n".join(line[2:] for line in lines if not line.startswith("# %"))
    with refuse_damage(what, "an undamaged ECSV table", str(path)):
        _check_length(header, what, str(path))
        _check_events(header, what, str(path))
        return Table.read(text, format="ascii.ecsv")


def parse_user_yaml(text: str, what: str, *, source: str | None = None) -> Any:
    """Parse YAML from a user with the safe loader, without references and not deeper than a description is.

    A key that stands twice is refused, as nothing says which of its values is meant.
    References are refused because a text of a few lines can stand for more values than there is memory.
    """
    _check_length(text, what, source)
    try:
        _check_events(text, what, source)
        return yaml.load(text, Loader=_EachKeyOnce)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError, ArithmeticError, TypeError, AttributeError, LookupError) as error:
        if isinstance(error, InputError):
            raise (error if error.source or source is None else error.in_source(source)) from None
        reason = first_line(error)
        raise InputError(what, reason, "YAML", source=source) from None


class _EachKeyOnce(yaml.SafeLoader):
    """Safe loader that refuses a mapping with a key twice, of which yaml takes the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for place, key in enumerate(keys):
            if key in keys[:place]:
                raise InputError(
                    "key", key, f"a key once (again in line {node.value[place][0].start_mark.line + 1})"
                )
        return super().construct_mapping(node, deep=deep)


def _check_length(text: str, what: str, source: str | None) -> None:
    if len(text) > LONGEST_USER_FILE:
        raise InputError(what, f"{len(text)} characters", f"up to {LONGEST_USER_FILE}", source=source)


def _check_events(text: str, what: str, source: str | None) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise InputError(what, f"reference *{event.anchor}", "YAML without references", source=source)
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > DEEPEST_NESTING:
            raise InputError(what, f"nested {depth} deep", f"up to {DEEPEST_NESTING}", source=source)


_ROUNDING = 1e-9  # of a number of steps


def number_of_values(first: float, last: float, step: float) -> int:
    """How many values ``first:last:step`` stands for; the last one is among them if the steps lead there."""
    return math.floor((last - first) / step + _ROUNDING) + 1


def first_line(error: Exception) -> str:
    """What an error says, in one line; its kind if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


@contextmanager
def open_user_fits(
    path: str | os.PathLike[str],
    *,
    warning: Literal["ignored", "truncated", "error"] = "ignored",
    memmap: bool = False,
    **options: Any,
) -> Iterator[fits.HDUList]:
    """Open a FITS file from outside, which may be anything; see `check_axes`, else one of `DAMAGE`.

    ``warning``: which warnings of astropy are errors: none, that the file is too short, or all. ``memmap`` and
    ``options`` are those of `astropy.io.fits.open`.
    """
    from astropy.io import fits

    if not Path(path).is_file():
        raise FrameFormatError("file", str(path), "an existing regular file")
    # The stream is opened here because astropy leaves its own open when it stumbles.
    with warnings.catch_warnings(), open(path, "rb") as stream:
        warnings.simplefilter("error" if warning == "error" else "ignore")
        if warning == "truncated":  # of which astropy warns, and goes on
            warnings.filterwarnings("error", message=".*truncated.*")
        check_axes(stream, str(path))
        with fits.open(stream, memmap=memmap, **options) as hdus:
            yield hdus


@contextmanager
def complete_fits(path: str | os.PathLike[str]) -> Iterator[fits.HDUList]:
    """Open a FITS file from outside, headers first; one that is damaged or cut short is refused by its name."""
    with (
        refuse_damage("file", "a complete FITS file", str(path)),
        open_user_fits(path, warning="truncated") as hdus,
    ):
        yield hdus


@contextmanager
def refuse_damage(field: str, allowed: str, source: str) -> Iterator[None]:
    """Turn what astropy raises over a damaged file (`DAMAGE`) into one error that names it."""
    try:
        yield
    except InputError as error:
        raise (error if error.source else error.in_source(source)) from None
    except _damage() as error:
        raise FrameFormatError(field, first_line(error), allowed, source=source) from error
