"""Every exception of the package, and when to raise which.

All derive from `FringeSimError`. Whatever a user can mend by changing an input is an `InputError`; the
command line turns it into one line and exit status 1. Raise before long work starts; say the field, the
value and what is allowed.
"""

from __future__ import annotations

import difflib
import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

__all__ = [
    "ConvergenceError",
    "FrameFormatError",
    "FringeSimError",
    "InputError",
    "MissingPackageError",
    "OutOfRangeError",
    "ResourceError",
    "StackError",
    "UndeterminedError",
    "UnknownNameError",
    "has_unit",
    "is_masked",
    "named_units",
    "printable_name",
    "refuse_no_numbers",
    "shown",
    "to_number",
    "without_unit",
]


LONGEST_NAME, LONGEST_VALUE, LONGEST_MESSAGE = 200, 300, 2000
"""Characters of a name from outside, and of what a message repeats of a value and says in all."""


class FringeSimError(Exception):
    """Base of all exceptions that this package raises on purpose."""


class InputError(FringeSimError, ValueError):
    """Something given by the user cannot be used.

    Parameters
    ----------
    field : `str`
        What was given: a parameter, a keyword, a column.
    value : `object`
        The value found.
    allowed : `str`
        What would be accepted.
    source : `str`, optional
        File (or data id) in which the value stands.
    """

    def __init__(self, field: str, value: object, allowed: str, *, source: str | None = None) -> None:
        self.field = field
        self.value = value
        self.allowed = allowed
        self.source = source
        super().__init__(field, value, allowed)

    def __str__(self) -> str:
        where = f"{self.source}: " if self.source else ""
        return shown(f"{where}{self.field} is {_repr(self.value)}; allowed: {self.allowed}", LONGEST_MESSAGE)

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword arguments survive the trip between processes.
        return (_rebuild_input_error, (type(self), self.field, self.value, self.allowed, self.source))

    def in_source(self, source: str) -> InputError:
        """Return the same error with ``source`` as the file in which it stands."""
        return _rebuild_input_error(type(self), self.field, self.value, self.allowed, source)


def _rebuild_input_error(
    kind: type[InputError], field: str, value: object, allowed: str, source: str | None
) -> InputError:
    error = kind.__new__(kind)
    InputError.__init__(error, field, value, allowed, source=source)
    return error


def _repr(value: object) -> str:
    try:
        return shown(repr(value), LONGEST_VALUE)
    except ValueError:
        # Python writes no integer of more than a few thousand digits.
        return f"{type(value).__name__} too long to be shown"


def shown(text: str, most: int) -> str:
    """A text as a terminal can show it: nothing in it moves the cursor or ends a line.

    The middle of a long one is left out.

    Parameters
    ----------
    text : `str`
        Anything.
    most : `int`
        Characters beyond which it is shortened.
    """
    if len(text) > most:
        text = f"{text[: most // 2]} … {text[-most // 4 :]} ({len(text)} characters)"
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def printable_name(field: str, name: str, *, source: str | None = None) -> str:
    """A name from outside, which goes into headers, tables and programs.

    Raises
    ------
    InputError
        A name that is empty, longer than a header holds, or has control characters or half a character in it.
    """
    if not name.strip() or len(name) > LONGEST_NAME or not name.isprintable():
        allowed = f"1 to {LONGEST_NAME} printable characters"
        raise InputError(field, name, allowed, source=source)
    return name


class OutOfRangeError(InputError):
    """A number lies outside the interval in which it is meaningful or tabulated."""


class StackError(InputError):
    """A layer stack is not physical: a finite end, a negative thickness, too few layers."""


class FrameFormatError(InputError):
    """A raw frame, a cube or a map is not laid out as it must be."""


class UndeterminedError(InputError):
    """The data do not decide what is asked for: too few pixels or frames, or templates that are not independent."""


class UnknownNameError(InputError):
    """A name (set-up, detector, raft, medium, effect) is not known; near misses are offered."""

    def __init__(
        self, field: str, value: object, known: Iterable[object], *, source: str | None = None
    ) -> None:
        names = sorted({str(name) for name in known})
        near = difflib.get_close_matches(str(value), names, n=3, cutoff=0.5)
        near += [name for name in names if value and str(value) in name and name not in near][: 3 - len(near)]
        if near:
            others = f" ({len(names)} are known)" if len(names) > len(near) else ""
            allowed = f"did you mean {' or '.join(near)}?{others}"
        else:
            allowed = _shorten(names)
        super().__init__(field, value, allowed, source=source)


class MissingPackageError(FringeSimError, ImportError):
    """Something was asked for that needs a package which is not installed; the package does without it otherwise.

    Parameters
    ----------
    wanted : `str`
        What was asked for.
    package : `str`
        What it needs.
    extra : `str`
        Extra of this distribution that installs it.
    """

    def __init__(self, wanted: str, package: str, extra: str) -> None:
        super().__init__(wanted, package, extra)
        self.wanted, self.package, self.extra = wanted, package, extra

    def __str__(self) -> str:
        return (
            f"{self.wanted} needs {self.package}, which is not installed here: "
            f"pip install 'lsst-fringe-sim[{self.extra}]'"
        )


class ResourceError(FringeSimError):
    """A table shipped with the package is missing, malformed or lacks its provenance."""


class ConvergenceError(FringeSimError):
    """A quadrature or an iteration did not reach the tolerance that was asked for."""


def to_number(field: str, value: Any, allowed: str = "a number", *, source: str | None = None) -> float:
    """Value from a user as a float, which may be infinite or NaN.

    Parameters
    ----------
    field : `str`
        What was given.
    value : `object`
        A number, or text that is one.
    allowed : `str`
        What would be accepted.
    source : `str`, optional
        File in which the value stands.

    Raises
    ------
    InputError
        Not a number; true and false are none.
    OutOfRangeError
        An integer beyond the largest float.
    """
    if type(value).__name__ in TRUTHS or is_masked(value):
        raise InputError(field, value, allowed, source=source)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(field, value, allowed, source=source) from None
    except OverflowError:
        sign = -math.inf if value < 0 else math.inf
        raise OutOfRangeError(field, sign, f"{allowed} below 1.8e308", source=source) from None


TRUTHS = ("bool", "bool_")  # Types of Python and numpy that are no numbers, though both count them as 0 and 1


def is_masked(value: Any) -> bool:
    """Whether an array has masked entries, whose numbers mean nothing and which numpy drops the mask of."""
    mask = getattr(value, "mask", None)
    return mask is not None and bool(getattr(mask, "any", lambda: mask)())


def refuse_no_numbers(field: str, value: Any) -> None:
    """Refuse what is no number, or array or sequence of numbers; `None` stands for no value.

    Raises
    ------
    InputError
        Truth values, text, complex numbers, objects, or masked entries.
    """
    if type(value) is float or value is None:
        return
    dtype = getattr(value, "dtype", None)
    if dtype is not None:
        if getattr(dtype, "kind", "f") not in "fiu":
            raise InputError(field, f"of type {dtype}", "a number or an array of numbers")
        if is_masked(value):
            raise InputError(
                field, "masked in part", "numbers without a mask; fill in what is masked, or NaN"
            )
    elif isinstance(value, tuple | list):
        for item in value:
            refuse_no_numbers(field, item)
        if len(set(map(_length, value))) > 1:
            raise InputError(field, value, "numbers in rows of one length")
    elif isinstance(value, int) and not isinstance(value, bool):
        to_number(field, value)
    elif isinstance(value, bool | str | bytes | complex | Mapping) or not hasattr(value, "__iter__"):
        raise InputError(field, value, "a number or an array of numbers")


def _length(value: Any) -> tuple[int, ...]:
    """Length of a row; nothing of a number."""
    return (len(value),) if isinstance(value, tuple | list) else tuple(getattr(value, "shape", ()))[:1]


def without_unit(field: str, value: Any, unit: str = "") -> Any:
    """Number or array in a unit: a quantity of astropy is converted, anything else is returned as it is.

    Parameters
    ----------
    field : `str`
        What was given.
    value : `object`
        A number, an array, or an `astropy.units.Quantity` or column of a table.
    unit : `str`, optional
        Unit that is wanted, as astropy writes it; empty for a number without unit.

    Raises
    ------
    InputError
        A quantity of another kind.
    """
    value = getattr(value, "quantity", value) if getattr(value, "unit", None) is not None else value
    if not hasattr(value, "to_value"):
        return value
    try:
        return value.to_value(unit)
    except (ValueError, TypeError):
        raise InputError(
            field, f"a quantity in {value.unit}", f"one in {unit}, or numbers" if unit else "plain numbers"
        ) from None


UNIT_OF_SUFFIX = {"um": "um", "nm": "nm", "k": "K", "deg": "deg", "arcsec": "arcsec", "s": "s", "h": "h"}
"""Unit of a parameter by what follows the last underscore of its name."""
UNIT_OF_NAME = {"theta": "rad", "hour": "h", "hours": "h", "wavelength": "nm", "d": "nm"}
"""Unit of a parameter by its name; thickness ``d`` and ``wavelength`` have the same one, whatever it is."""

Callee = TypeVar("Callee", bound=Callable[..., Any])


def named_units(callee: Callee) -> Callee:
    """Convert quantities of astropy to the unit that the name of a parameter states, as ``nm`` of ``wavelength_nm``.

    Numbers and arrays pass as they are; what is no number is refused. Of a class, the parameters of its construction
    are converted. Without this, numpy takes the number out of a quantity and leaves its unit behind, takes numbers
    under a mask for good ones, and true for 1.

    Parameters
    ----------
    callee : callable
        Function, method or class.

    Raises
    ------
    InputError
        From the callee: a quantity of another kind, truth values, text, complex numbers or masked entries; the
        parameter is named.
    """
    if inspect.isclass(callee):
        callee.__init__ = named_units(callee.__init__)  # type: ignore[method-assign]
        return callee
    parameters = inspect.signature(callee).parameters
    names = list(parameters)
    units = {name: unit for name in names if (unit := _unit_of(name))}
    places = {names.index(name): name for name in units}
    # Some hold records with a key for each wavelength.
    numbers = {at: name for at, name in places.items() if "dict" not in str(parameters[name].annotation)}

    relative = {"d", "wavelength"} <= units.keys()

    @functools.wraps(callee)
    def with_plain_numbers(*args: Any, **kwargs: Any) -> Any:
        for place, name in numbers.items():
            refuse_no_numbers(name, args[place] if place < len(args) else kwargs.get(name))
        stated = {places[place] for place in places if place < len(args) and has_unit(args[place])}
        stated |= {name for name in units.keys() & kwargs.keys() if has_unit(kwargs[name])}
        if not stated:
            return callee(*args, **kwargs)
        if relative and len(stated & {"d", "wavelength"}) == 1:
            raise InputError("unit", f"stated of {stated & {'d', 'wavelength'}} only", "of d and wavelength")
        plain = [
            _plain(places[place], value, units[places[place]]) if places.get(place) in stated else value
            for place, value in enumerate(args)
        ]
        named = {
            name: _plain(name, value, units[name]) if name in stated else value
            for name, value in kwargs.items()
        }
        return callee(*plain, **named)

    return with_plain_numbers  # type: ignore[return-value]


def _unit_of(name: str) -> str | None:
    first, underscore, last = name.rpartition("_")
    if not underscore:
        return UNIT_OF_NAME.get(name)
    return None if first == "per" or first.endswith("_per") else UNIT_OF_SUFFIX.get(last)


def has_unit(value: Any) -> bool:
    """Whether a value, or one in a list, is a quantity of astropy or a column with a unit."""
    if isinstance(value, tuple | list):
        return any(map(has_unit, value))
    return getattr(value, "unit", None) is not None


def _plain(name: str, value: Any, unit: str) -> Any:
    if not isinstance(value, tuple | list):
        return without_unit(name, value, unit)
    # 0 and infinity are the same in all units.
    bare = [item for item in value if not has_unit(item) and isinstance(item, int | float)]
    if any(item != 0 and math.isfinite(item) for item in bare):
        raise InputError(name, f"{bare} beside quantities", "a unit for each number")
    return type(value)(_plain(name, item, unit) if has_unit(item) else item for item in value)


def _shorten(names: list[str], most: int = 10) -> str:
    """All names of a short list; of a long one, in which none is like what was given, three as examples."""
    if not names:
        return "nothing is registered"
    return ", ".join(names) if len(names) <= most else f"{', '.join(names[:3])}, … ({len(names)} in all)"
