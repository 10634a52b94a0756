"""Reference of a module from its ``__all__``."""

from __future__ import annotations

import importlib
import inspect
import types

PACKAGE = "lsst.fringe_sim"


def module_reference(name: str) -> str:
    """Autodoc directives for every public name of ``lsst.fringe_sim.<name>``.

    Names that a package imports on first use are found too. A module that lists nothing is an error: its reference
    would be empty without anybody noticing. What the package above exports too is documented there, and
    what comes from another room in that room.
    """
    module = importlib.import_module(f"{PACKAGE}.{name}")
    public = list(getattr(module, "__all__", ()))
    if not public:
        raise ValueError(f"{PACKAGE}.{name} lists no public names")
    lines = [f".. py:module:: {PACKAGE}.{name}", ""]
    above = _exported_above(name)
    members = {member: importable(module, member) for member in public if member not in above}
    for member, value in sorted(members.items(), key=lambda item: (_rank(item[1]), item[0].lower())):
        if value is None or _is_of_another_room(value, name):
            continue
        path = f"{PACKAGE}.{name}.{member}"
        if isinstance(getattr(module, member), types.ModuleType):
            # Once it is imported, a module hides the function that is called like it.
            path = f"{path}.{member}"
        lines += [f".. {_directive(value)}:: {path}", *_options(value), ""]
    return "\n".join(["```{eval-rst}", *lines, "```", ""])


def _exported_above(name: str) -> frozenset[str]:
    parent = name.rpartition(".")[0]
    if not parent:
        return frozenset()
    return frozenset(getattr(importlib.import_module(f"{PACKAGE}.{parent}"), "__all__", ()))


def _is_of_another_room(value: object, name: str) -> bool:
    home = str(getattr(value, "__module__", "") or "").removeprefix(f"{PACKAGE}.")
    return inspect.isclass(value) and home.partition(".")[0] != name.partition(".")[0]


def importable(module: types.ModuleType, member: str) -> object | None:
    """Member of a module; `None` if it is announced but its own module does not exist."""
    try:
        value: object = getattr(module, member)
        return getattr(value, member) if isinstance(value, types.ModuleType) else value
    except ModuleNotFoundError as error:
        if not str(error.name).startswith(PACKAGE):
            raise
        return None


def _rank(value: object) -> int:
    return 0 if inspect.isclass(value) else 1 if inspect.isroutine(value) else 2


def _directive(value: object) -> str:
    if inspect.isclass(value):
        return "autoexception" if issubclass(value, BaseException) else "autoclass"
    return "autofunction" if inspect.isroutine(value) else "autodata"


def _options(value: object) -> list[str]:
    if inspect.isclass(value):
        return ["   :members:", "   :show-inheritance:"]
    return [] if inspect.isroutine(value) else ["   :no-value:"]
