"""The effects that may be named: those of the package, of installed ones, and of one's own files and modules."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from ..errors import InputError
from .base import Effect

ENTRY_POINTS = "lsst.fringe_sim.effects"
"""Group of the entry points by which an installed package offers effects: each names a sequence of `Effect`."""

_STATED = ("name", "title", "acts_on", "parameters", "reference")

_own: ContextVar[tuple[tuple[str, Effect], ...]] = ContextVar("_own", default=())
"""Effects of `effects_from`, each with the file or module that it is from."""


def known_effects(given: Iterable[Effect] | None = None) -> tuple[Effect, ...]:
    """All effects that may be named here, in the order in which they are applied.

    Parameters
    ----------
    given : iterable of `Effect`, optional
        A catalogue that takes the place of this one.

    Returns
    -------
    effects : `tuple` [`Effect`, ...]
        `EFFECTS` and `LEARNED`, then those that installed packages offer as entry points of the group
        ``lsst.fringe_sim.effects``, then those of `effects_from`.

    Raises
    ------
    InputError
        An installed package offers something else, or a name that is taken.
    """
    if given is not None:
        return tuple(given)
    return tuple(effect for _, effect in (*_installed(), *_own.get()))


def catalogue_of(name: str) -> str:
    """Where an effect is from: a file or module of `effects_from`, an entry point, or "" for the package itself.

    It is "" for a name that is not known here, too.
    """
    return next((source for source, effect in (*_installed(), *_own.get()) if effect.name == name), "")


@contextmanager
def effects_from(source: str | Path) -> Iterator[tuple[Effect, ...]]:
    """Add effects of one's own to the catalogue for as long as the block lasts.

    Parameters
    ----------
    source : `str` or `~pathlib.Path`
        A Python file, or the dotted name of a module. It is executed, and its ``EFFECTS`` are taken.

    Yields
    ------
    effects : `tuple` [`Effect`, ...]
        What it holds.

    Raises
    ------
    InputError
        There is no such file; it cannot be imported, has no ``EFFECTS``, holds something else, or a name that is
        taken.
    """
    module = _module(source)
    offered = getattr(module, "EFFECTS", None)
    if offered is None:
        raise InputError("EFFECTS", "missing", "a sequence of effects in the module", source=str(source))
    added = _checked(offered, known_effects(), str(source))
    token = _own.set((*_own.get(), *((str(source), effect) for effect in added)))
    try:
        yield added
    finally:
        _own.reset(token)


@functools.cache
def _installed() -> tuple[tuple[str, Effect], ...]:
    from . import EFFECTS, LEARNED

    found = tuple(("", effect) for effect in (*EFFECTS, *LEARNED))
    for entry in sorted(entry_points(group=ENTRY_POINTS), key=lambda item: item.name):
        source = f"entry point {entry.name} = {entry.value}"
        known = tuple(effect for _, effect in found)
        found += tuple((source, effect) for effect in _checked(entry.load(), known, source))
    return found


def _module(source: str | Path) -> ModuleType:
    path = Path(source)
    is_file = path.suffix == ".py" or len(path.parts) > 1
    try:
        if not is_file:
            return importlib.import_module(str(source))
        if not path.is_file():
            raise InputError("file of effects", str(path), "a Python file that is there")
        spec = importlib.util.spec_from_file_location(f"fringe_sim_effects_{path.stem}", path)
        if spec is None or spec.loader is None:
            raise InputError(
                "file of effects", path.name, "a Python file, as my_effects.py", source=str(path)
            )
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # whatever the code of a stranger raises
        told = f"{type(error).__name__}: {error}"
        raise InputError("effects", told, "a module that can be imported", source=str(source)) from error
    return module


def _checked(offered: Any, known: tuple[Effect, ...], source: str) -> tuple[Effect, ...]:
    try:
        effects = tuple(offered)
    except TypeError:
        effects = (offered,)
    taken = {effect.name for effect in known}
    for effect in effects:
        if not isinstance(effect, Effect):
            raise InputError("EFFECTS", repr(effect), "instances of subclasses of Effect", source=source)
        missing = [name for name in _STATED if not _states(effect, name)]
        if missing:
            allowed = f"an effect that states its {', '.join(_STATED)}"
            raise InputError(
                "effect", f"{type(effect).__name__} without {missing[0]}", allowed, source=source
            )
        if not str(effect.name).isidentifier() or effect.name in taken:
            allowed = "an identifier that no other effect of the catalogue has"
            raise InputError("name of an effect", effect.name, allowed, source=source)
        taken.add(effect.name)
    return effects


def _states(effect: Effect, name: str) -> bool:
    try:
        return hasattr(effect, name)
    except Exception:  # a property of a stranger
        return False
