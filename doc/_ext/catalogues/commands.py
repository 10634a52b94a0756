"""Command-line reference from click."""

from __future__ import annotations

import inspect

import click

from lsst.fringe_sim.cli.main import cli
from lsst.fringe_sim.middleware.cli import get_cli_subcommands

from .markdown import cell, code, sections, table


def fringe_sim_commands() -> str:
    """``fringe-sim`` itself and every subcommand."""
    context = click.Context(cli, info_name="fringe-sim")
    parts = ["## fringe-sim", *_body(cli, context)]
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        if command is None:
            raise ValueError(f"fringe-sim lists a command {name} that it does not have")
        parts += [f"## fringe-sim {name}", *_body(command, click.Context(command, context, info_name=name))]
    return sections(parts)


def butler_commands() -> str:
    """Subcommands that the package adds to ``butler``."""
    parent = click.Context(click.Group("butler"), info_name="butler")
    parts = []
    for command in get_cli_subcommands():
        name = str(command.name)
        parts += [f"## butler {name}", *_body(command, click.Context(command, parent, info_name=name))]
    return sections(parts)


def _body(command: click.Command, context: click.Context) -> list[str]:
    usage = command.get_usage(context).removeprefix("Usage:").split()
    parts = [f"```text\n{' '.join(usage)}\n```", *_help(command.help or "")]
    options = [
        item for item in command.get_params(context) if isinstance(item, click.Option) and not item.hidden
    ]
    parts.append(table(("option", "value", "default", ""), [_option(item, context) for item in options]))
    return parts


def _help(text: str) -> list[str]:
    r"""Paragraphs; what click keeps as it is (after ``\b``) becomes code below its first line."""
    parts = []
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        if not paragraph.startswith("\b"):
            parts.append(" ".join(paragraph.split()))
            continue
        first, *rest = paragraph.removeprefix("\b").strip("\n").split("\n")
        parts += [first, "```bash\n" + "\n".join(line.strip() for line in rest) + "\n```"]
    return parts


def _option(option: click.Option, context: click.Context) -> tuple[str, ...]:
    names = " ".join(code(name) for name in (*option.opts, *option.secondary_opts))
    value = "" if option.is_flag else code(_value(option))
    default = option.get_default(context, call=False)
    shown = "" if default in (None, False, ()) or callable(default) else code(default)
    text = cell(option.help or "")
    return names, value, "required" if option.required else shown, text


def _value(option: click.Option) -> str:
    if isinstance(option.type, click.Choice):
        return " | ".join(str(choice) for choice in option.type.choices)
    return option.metavar or option.type.name
