"""Reference of a module from its ``__all__``."""

from __future__ import annotations

import importlib
import inspect
import types

PACKAGE = "lsst.fringe_sim"


def module_reference(name: str) -> str:
    """Autodoc directives for every public name of ``lsst.fringe_sim.<name>``.

    Names that a package imports on first use are found too. A module that lists nothing is an error: its reference
    would be empty without anybody noticing.
    """
    module = importlib.import_module(f"{PACKAGE}.{name}")
    public = list(getattr(module, "__all__", ()))
    if not public:
        raise ValueError(f"{PACKAGE}.{name} lists no public names")
    lines = [f".. py:module:: {PACKAGE}.{name}", ""]
    members = {member: importable(module, member) for member in public}
    for member, value in sorted(members.items(), key=lambda item: (_rank(item[1]), item[0].lower())):
        if value is None:
            continue
        lines += [f".. {_directive(value)}:: {PACKAGE}.{name}.{member}", *_options(value), ""]
    return "\n".join(["```{eval-rst}", *lines, "```", ""])


def importable(module: types.ModuleType, member: str) -> object | None:
    """Member of a module; `None` if it is announced but its own module does not exist."""
    try:
        return getattr(module, member)
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
