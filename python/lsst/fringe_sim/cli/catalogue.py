"""``fringe-sim setups`` and ``fringe-sim effects``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from ..errors import UnknownNameError
from ..files import json_text
from .command import argument, command, flag
from .parameters import with_effects_from

if TYPE_CHECKING:
    from ..effects import Effect, Parameter


@command()
def setups(as_json: bool = flag("Machine-readable.", "--json")) -> None:
    """List the set-ups: sensors, telescopes and test stands.

    \b
    Example:
      fringe-sim setups
    """
    from ..instrument.setup import Setup, setup_names

    found = [Setup.from_name(name) for name in setup_names()]
    if as_json:
        rows = [
            {
                "name": setup.name,
                "title": setup.title,
                "camera": setup.camera,
                "detector": setup.detector,
                "stack": setup.stack.name,
                "varying": setup.varying,
                "temperature_k": setup.temperature_k,
                "light": setup.kind,
                "source": setup.source,
            }
            for setup in found
        ]
        click.echo(json_text(rows))
        return
    width = max(len(setup.name) for setup in found)
    for setup in found:
        click.echo(f"{setup.name:<{width}}  {setup.title}")
        layers = f"{setup.stack.name}, {setup.varying} {setup.thickness_range_um[0]:g}"
        light = (
            f"{setup.bandwidth_fwhm_nm:g} nm {setup.profile_name} line"
            if setup.kind == "monochromator"
            else f"night sky through {setup.bandpass}"
        )
        click.echo(
            f"{'':<{width}}  {layers}–{setup.thickness_range_um[1]:g} µm, {setup.temperature_k:g} K, {light}"
        )


def _named(known: Sequence[Effect], names: Sequence[str]) -> list[Effect]:
    """The effects of some names; all that are physics if there are none."""
    by_name = {effect.name: effect for effect in known}
    for name in names:
        if name not in by_name:
            raise UnknownNameError("effect", name, by_name)
    return [by_name[name] for name in names] or [effect for effect in known if not effect.learned]


@command()
def effects(
    names: tuple[str, ...] = argument("[NAME]...", required=False),
    as_json: bool = with_effects_from(flag("Machine-readable.", "--json")),
) -> None:
    """List the physical effects that the model knows, or those of some names, with parameters, units, null values.

    \b
    Example, with one of them switched on:
      fringe-sim effects
      fringe-sim effects bandwidth
      fringe-sim mock-flats raws --setup ts8_e2v --effect bandwidth.fwhm=2.6 --seed 1
    """
    from ..effects import known_effects

    shown = _named(known_effects(), names)
    if as_json:
        rows = [
            {
                "name": effect.name,
                "title": effect.title,
                "acts_on": effect.acts_on,
                "reference": effect.reference,
                "parameters": [
                    {
                        "name": parameter.name,
                        "unit": parameter.unit,
                        "null": None if math.isnan(parameter.null) else parameter.null,
                        "bounds": list(parameter.bounds),
                        "prior_scale": parameter.prior_scale,
                        "description": parameter.description,
                    }
                    for parameter in effect.parameters
                ],
            }
            for effect in shown
        ]
        click.echo(json_text(rows))
        return
    for effect in shown:
        click.echo(f"{effect.name}  ({effect.acts_on}: {effect.title})")
        for parameter in effect.parameters:
            click.echo(f"    {_describe(parameter)}")
        click.echo(f"    {effect.reference}")


def _describe(parameter: Parameter) -> str:
    null = "by default as the set-up says" if math.isnan(parameter.null) else f"absent at {parameter.null:g}"
    unit = f" {parameter.unit}" if parameter.unit else ""
    low, high = parameter.bounds
    return f".{parameter.name}: {parameter.description}; {low:g} to {high:g}{unit}, {null}"
