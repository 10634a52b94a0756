"""How a public name or argument goes: it works for one more minor version, and says what takes its place."""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

from .errors import InputError

__all__ = ["deprecated"]

Callee = TypeVar("Callee", bound=Callable[..., Any])


def deprecated(
    since: str, instead: str, *, removed_in: str, argument: str = ""
) -> Callable[[Callee], Callee]:
    """Let a function, a class or one argument work as before, with a warning.

    A function or class warns when it is called. With ``argument``, calls that pass it by keyword warn, and its value
    goes to the argument ``instead``, which is the only one that the function still has, or nowhere. The docstring
    gets the ``deprecated`` directive of numpydoc.

    Parameters
    ----------
    since : `str`
        First version that warns.
    instead : `str`
        Name of what takes its place; empty for an argument that has no effect any more.
    removed_in : `str`
        First version without it.
    argument : `str`, optional
        Former name of an argument; without it, the whole function or class goes.

    Returns
    -------
    decorate : callable
        Decorator of a function, method or class. A class is changed in place.

    Raises
    ------
    ValueError
        Of the decorator: the function has no argument ``instead``, or still has the former one.
    InputError
        Of the decorated function: both names of an argument are given.

    Notes
    -----
    The warning is a `FutureWarning`, which Python shows by default: those who call this package are its users.
    """

    def decorate(callee: Callee) -> Callee:
        told = f"{f'argument {argument!r} of ' if argument else ''}{callee.__qualname__}"
        end = f"use {instead}" if instead else "it has no effect"
        message = f"{told} is deprecated since version {since} and will be removed in {removed_in}; {end}"
        kept = callee.__init__ if inspect.isclass(callee) else callee
        if argument:
            _check_names(kept, argument, instead)

        @functools.wraps(kept)
        def with_warning(*args: Any, **kwargs: Any) -> Any:
            if argument in kwargs or not argument:
                warnings.warn(message, FutureWarning, stacklevel=2)
            if argument in kwargs:
                if instead in kwargs:
                    raise InputError(
                        argument, kwargs[argument], f"one value, as {instead}, its name since {since}"
                    )
                value = kwargs.pop(argument)
                if instead:
                    kwargs[instead] = value
            return kept(*args, **kwargs)

        changed: Any = with_warning
        if inspect.isclass(callee):
            callee.__init__ = with_warning  # type: ignore[method-assign]
            changed = callee
        changed.__doc__ = _with_directive(callee.__doc__, since, message)
        return changed

    return decorate


def _check_names(callee: Callable[..., Any], former: str, instead: str) -> None:
    parameters = inspect.signature(callee).parameters
    if former in parameters or (instead and instead not in parameters):
        raise ValueError(f"{callee.__qualname__} must have {instead or 'nothing'!r} in place of {former!r}")


def _with_directive(doc: str | None, since: str, message: str) -> str:
    """Docstring with the directive after its first paragraph."""
    first, _, rest = inspect.cleandoc(doc or "").partition("\n\n")
    return "\n\n".join(part for part in (first, f".. deprecated:: {since}\n   {message}.", rest) if part)
