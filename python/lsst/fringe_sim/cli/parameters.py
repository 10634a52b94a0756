"""Types of command-line arguments: quantities with units, ranges, sizes, effect settings."""

from __future__ import annotations

import re
from typing import Any

import click
import numpy as np
from astropy import units

__all__ = ["EFFECT", "SIZE", "THICKNESS_RANGE", "WAVELENGTHS", "Quantity", "effect_settings"]


class Quantity(click.ParamType):
    """A number, with or without a unit: ``960``, ``960nm``, ``0.96um``, ``-90degC``.

    Parameters
    ----------
    unit : `str`
        Unit of a bare number and of the result, in astropy's spelling.
    """

    def __init__(self, unit: str) -> None:
        self.unit = units.Unit(unit)
        self.name = unit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Number in the unit of this type."""
        if isinstance(value, int | float):
            return float(value)
        text = str(value).strip().replace("µ", "u").replace("°", "deg")
        match = re.fullmatch(r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([A-Za-z_]*)", text)
        if match is None:
            self.fail(f"{value!r} is not a number with a unit, such as 1{self.unit}", param, ctx)
        number, suffix = match.groups()
        try:
            given = units.Unit({"degC": "deg_C", "C": "deg_C"}.get(suffix, suffix)) if suffix else self.unit
            return float((float(number) * given).to_value(self.unit, equivalencies=units.temperature()))
        except (ValueError, units.UnitsError):
            self.fail(f"{value!r} is not in {self.unit} or a unit that converts to it", param, ctx)


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
            parts = [quantity.convert(part, param, ctx) for part in value.split(":")]
            if len(parts) != 3 or parts[2] <= 0.0 or parts[1] < parts[0]:
                self.fail(f"{value!r} is not first:last:step with first <= last and step > 0", param, ctx)
            first, last, step = parts
            count = int(np.floor((last - first) / step + 1e-9)) + 1
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
        match = re.fullmatch(r"(\d+)[xX](\d+)", str(value).strip())
        if match is None:
            self.fail(f"{value!r} is not columns x rows, such as 512x512", param, ctx)
        return int(match.group(1)), int(match.group(2))


class _EffectSetting(click.ParamType):
    """``name.parameter=value``."""

    name = "name.parameter=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        key, equals, number = str(value).partition("=")
        if not equals or "." not in key:
            self.fail(f"{value!r} is not name.parameter=value", param, ctx)
        try:
            return key.strip(), float(number)
        except ValueError:
            self.fail(f"the value in {value!r} is not a number", param, ctx)


WAVELENGTHS = _Wavelengths()
THICKNESS_RANGE = _ThicknessRange()
SIZE = _Size()
EFFECT = _EffectSetting()


def effect_settings(settings: tuple[tuple[str, float], ...]) -> dict[str, float]:
    """Mapping from repeated ``--effect`` options; the last of equal names wins."""
    return dict(settings)
