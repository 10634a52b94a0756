"""Types of command-line arguments: quantities with units, ranges, sizes, set-ups, effect settings.

What a conversion needs is imported by it, so that help and complaints about usage come at once.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from ..errors import InputError, OutOfRangeError
from .command import Declare, Decorate, option

if TYPE_CHECKING:  # none of it for --help
    from ..effects import Parameter
    from ..instrument.setup import Setup


BUILT_IN = "e2v_321"  # Name of the thickness map that needs no file


class Quantity(click.ParamType):
    """A number, with or without a unit: ``960``, ``960nm``, ``0.96um``, ``-90degC``.

    ``unit``: unit of a bare number and of the result, in astropy's spelling.
    """

    def __init__(self, unit: str) -> None:
        self.name = unit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Number in the unit of this type."""
        if isinstance(value, int | float):
            return float(value)
        from astropy import units

        wanted = units.Unit(self.name)
        text = str(value).strip().replace("µ", "u").replace("°", "deg")
        match = re.fullmatch(r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([A-Za-z_]*)", text)
        if match is None:
            self.fail(f"{value!r} is not a number with a unit, such as 1{wanted}", param, ctx)
        number, suffix = match.groups()
        try:
            given = units.Unit({"degC": "deg_C", "C": "deg_C"}.get(suffix, suffix)) if suffix else wanted
            return float((float(number) * given).to_value(wanted, equivalencies=units.temperature()))
        except (ValueError, units.UnitsError):
            self.fail(f"{value!r} is not in {wanted} or a unit that converts to it", param, ctx)


class _Wavelengths(click.ParamType):
    """``880:990:10`` (end included), a comma-separated list, or one number; nm."""

    name = "wavelengths"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        quantity = Quantity("nm")
        if ":" in value:
            from ..resources import number_of_values

            parts = [quantity.convert(part, param, ctx) for part in value.split(":")]
            if len(parts) != 3 or parts[2] <= 0.0 or parts[1] < parts[0]:
                self.fail(f"{value!r} is not first:last:step with first <= last and step > 0", param, ctx)
            first, last, step = parts
            count = number_of_values(first, last, step)
            if count > 1000:
                self.fail(f"{value!r} asks for {count} wavelengths; at most 1000", param, ctx)
            return tuple(float(first + i * step) for i in range(count))
        return tuple(quantity.convert(part, param, ctx) for part in value.split(","))


class _ThicknessRange(click.ParamType):
    """``7:15`` or ``7um:15um``: two increasing, positive numbers; µm."""

    name = "low:high"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        quantity = Quantity("um")
        parts = [quantity.convert(part, param, ctx) for part in str(value).split(":")]
        if len(parts) != 2 or not 0.0 < parts[0] < parts[1]:
            self.fail(f"{value!r} is not low:high with 0 < low < high", param, ctx)
        return parts[0], parts[1]


class _Size(click.ParamType):
    """``512x512``: columns times rows."""

    name = "NXxNY"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        sides = [int(side) for side in str(value).strip().lower().split("x") if side.isdecimal()]
        if str(value).strip().lower().count("x") != 1 or len(sides) != 2 or min(sides) < 1:
            self.fail(f"{value!r} is not columns x rows, such as 512x512", param, ctx)
        return sides[0], sides[1]


class SetupType(click.ParamType):
    """A set-up by its name, or a YAML file laid out like the shipped ones.

    ``kind`` {"monochromator", "sky", ""}: light that the command is for; any if empty.
    ``wanted``: the same in words.
    """

    name = "NAME|FILE.yaml"

    def __init__(self, kind: str, wanted: str) -> None:
        self.kind = kind
        self.wanted = wanted

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Setup:
        """The set-up."""
        from ..instrument.setup import Setup

        if isinstance(value, Setup):
            return value
        text = str(value)
        setup = Setup.from_name(text)
        if self.kind and setup.kind != self.kind:
            raise InputError("set-up", text, self.wanted)
        return setup

    def option(self, default: str, help_text: str) -> Any:
        """``--setup``, read when all else on the command line is known to be well formed.

        ``default``, ``help_text``: set-up without the option, and what it says under ``--help``.
        """

        def declare(name: str) -> Decorate:
            def decorate(command: Callable[..., None]) -> Callable[..., None]:
                @functools.wraps(command)
                def with_setup(**given: Any) -> None:
                    command(**{**given, name: self.convert(given[name], None, None)})

                made: Callable[..., None] = self.name_option(default, help_text)(name)(with_setup)
                return made

            return decorate

        return declare

    def name_option(self, default: str, help_text: str) -> Any:
        """``--setup`` as it was written."""
        return option(help_text, default, metavar=self.name, shell_complete=self.shell_complete)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Names of this kind; files where none fits."""
        from ..instrument.setup import Setup, setup_names

        fitting = [
            name
            for name in setup_names()
            if name.startswith(incomplete) and self.kind in ("", Setup.from_name(name).kind)
        ]
        return [CompletionItem(name) for name in fitting] or [CompletionItem(incomplete, type="file")]


class _EffectSetting(click.ParamType):
    """``name.parameter=value``, the value with or without a unit."""

    name = "name.parameter=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        key, equals, number = (part.strip() for part in str(value).partition("="))
        if not equals or "." not in key:
            self.fail(f"{value!r} is not name.parameter=value", param, ctx)
        try:
            return key, float(number)
        except ValueError:
            pass
        unit = next((parameter.unit for name, parameter in _parameters() if name == key), None)
        if not unit:
            self.fail(f"the value in {value!r} is not a number", param, ctx)
        return key, Quantity(unit).convert(number, param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Parameters of the catalogue with their units."""
        return [
            CompletionItem(f"{name}=", help=f"{parameter.description} [{parameter.unit or 1}]")
            for name, parameter in _parameters()
            if name.startswith(incomplete)
        ]


def _parameters() -> list[tuple[str, Parameter]]:
    """All parameters of the catalogue by ``name.parameter``."""
    from ..effects import known_effects

    return [
        (f"{effect.name}.{parameter.name}", parameter)
        for effect in known_effects()
        for parameter in effect.parameters
    ]


WAVELENGTHS = _Wavelengths()
THICKNESS_RANGE = _ThicknessRange()
SIZE = _Size()
EFFECT = _EffectSetting()
LABORATORY = SetupType("monochromator", "a laboratory set-up with a monochromator")
ANY_LIGHT = SetupType("", "a set-up")
SKY = SetupType("sky", "one behind a telescope, as lsst_e2v, monocam or hsc")


def shape_of(size: tuple[int, int] | None, whole: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of a cut-down sensor by ``--size``, those of the whole one without.

    `OutOfRangeError`: it is larger than the whole.
    """
    shape = (size[1], size[0]) if size else whole
    if shape[0] > whole[0] or shape[1] > whole[1]:
        allowed = f"up to the {whole[1]}x{whole[0]} of the sensor"
        raise OutOfRangeError("--size", f"{shape[1]}x{shape[0]}", allowed)
    return shape


laboratory_of_the_mock = LABORATORY.name_option("ts8_e2v", "Laboratory set-up: name or file.")
"""Set-up that the mock reads itself: the command gets it as it was written."""


EFFECTS_FILE_HELP = "YAML, or what a search has left: effects.py, learned.py."


@dataclass(frozen=True)
class ChosenEffects:
    """Effects that a command was given."""

    settings: dict[str, Any]
    files: tuple[Path, ...]  # where they were read


def model_effects(
    help_text: str = "Effect in the model; may be repeated.",
    file_help: str = EFFECTS_FILE_HELP,
    *,
    own: bool = True,
) -> Any:
    """``--effect`` and ``--effects-file`` of a command, which gets them as `ChosenEffects`, here named ``effects``.

    An option wins over the file; an option with two values is refused. ``own``: with ``--effects-from``.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def with_effects(
            *, effects: tuple[tuple[str, float], ...], effects_file: Path | None, **others: Any
        ) -> None:
            from .inputs import read_settings

            settings = {} if effects_file is None else read_settings(effects_file)
            files = () if effects_file is None else (effects_file,)
            command(effects=ChosenEffects({**settings, **effect_settings(effects)}, files), **others)

        one = option(help_text, kind=EFFECT, names="--effect", multiple=True)
        made = one("effects")(effects_file_option(file_help)("effects_file")(with_effects))
        return _effects_from(made) if own else made

    return lambda name: decorate


def with_effects_from(declare: Declare) -> Any:
    """``--effects-from`` after another option: effects of one's own are known until the command ends."""
    return lambda name: lambda command: declare(name)(_effects_from(command))


def _effects_from(command: Callable[..., None]) -> Any:
    def put(ctx: click.Context, param: click.Parameter, sources: tuple[str, ...]) -> None:
        for source in sources:
            from ..effects import effects_from

            ctx.with_resource(effects_from(source))

    text = "Python file or module with effects of your own, as EFFECTS; it is executed."
    hidden: Any = {"is_eager": True, "expose_value": False, "callback": put}
    return option(text, multiple=True, metavar="FILE.py|MODULE", **hidden)("effects_from")(command)


def effects_file_option(help_text: str = "YAML.") -> Any:
    """``--effects-file`` as it was written."""
    return option(help_text, kind=click.Path(exists=True, dir_okay=False, path_type=Path))


def effect_settings(settings: tuple[tuple[str, float], ...]) -> dict[str, float]:
    """Mapping from repeated ``--effect`` options, each of another name.

    `InputError`: one of them is given two values.
    """
    found: dict[str, float] = {}
    for name, value in settings:
        if found.setdefault(name, value) != value:
            raise InputError("--effect", f"{name} = {found[name]:g} and {value:g}", "one value for each")
    return found
