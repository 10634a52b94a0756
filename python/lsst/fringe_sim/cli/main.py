"""``fringe-sim``: the group of commands, and what an exception becomes.

Exit status: 0 done, 1 bad input, 2 usage, 3 internal failure, 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import gc
import importlib
import io
import logging
import os
import sys
import traceback
from collections.abc import Sequence

import click

from .. import __version__
from ..errors import LONGEST_MESSAGE, FringeSimError, UnknownNameError, shown

MOST_NEW_OBJECTS = 10_000  # Objects after which Python looks for unused ones

EXIT_BAD_INPUT = 1
EXIT_USAGE = 2
EXIT_INTERNAL = 3
EXIT_STOPPED = 130

# Name of the command, module in which it is written, and its line in the overview.
_COMMANDS = {
    "demo": ("demo", "Run the whole chain on the built-in sensor."),
    "setups": ("catalogue", "List the set-ups: sensors, telescopes, test stands."),
    "effects": ("catalogue", "List the physical effects and their parameters."),
    "mock-flats": ("mock_flats", "Write raw laboratory frames of a simulated sensor."),
    "mock-visits": ("mock_visits", "Write visits of a simulated sensor: fringes, stars, galaxies."),
    "plan-flats": ("plan_flats", "Say which flats a thickness fit needs."),
    "fit": ("fit", "Fit the layer thickness to raw flats."),
    "sky": ("sky", "Simulate the fringes of the night sky."),
    "templates": ("templates", "Make fringe templates from observed frames."),
    "correct": ("correct", "Subtract fringe templates from observed frames."),
    "fit-sky": ("fit_sky", "Hold a thickness map against frames of the sky, and move it."),
    "focal-plane": ("focal_plane", "Forecast the fringes of every sensor of the LSST Camera."),
    "amplitudes": ("amplitudes", "Tabulate the fringe amplitudes of every set-up of the paper."),
    "discover": ("discover", "Find the effect that the model lacks."),
    "evidence": ("evidence", "Judge effects by all public data together."),
    "reproduce-paper": ("reproduce_paper", "Recompute the paper, number by number."),
    "export": ("export", "Write products as NetCDF, for xarray."),
    "provenance": ("provenance", "Say what a product was made with and from."),
    "compile": ("compile", "Compile what the other commands need, once."),
    "completion": ("completion", "Print what makes a shell complete commands, options and names."),
    "challenge": ("challenge", "Hide effects in simulated sensors and count what the search finds."),
}


_LISTED = {"effect": "effects", "set-up": "setups"}  # Commands that list the names of a field


class _LazyGroup(click.Group):
    """Imports a command when it is asked for, so that ``--help`` is quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in _COMMANDS:
            return None
        module = importlib.import_module(f".{_COMMANDS[name][0]}", __package__)
        command: click.Command = getattr(module, name.replace("-", "_"))
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in _COMMANDS and not args[0].startswith("-"):
            import difflib

            near = difflib.get_close_matches(args[0], _COMMANDS, n=2, cutoff=0.5)
            hint = f" Did you mean {' or '.join(near)}?" if near else ""
            ctx.fail(f"There is no command {args[0]!r}.{hint}")
        return super().resolve_command(ctx, args)


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fringe-sim")
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"], case_sensitive=False),
    default="info",
    show_default=True,
    help="How much to say.",
)
def cli(log_level: str) -> None:
    """CCD fringing: simulate, fit, forecast.

    Lengths are in µm for layers and nm for wavelengths, temperatures in kelvin; a number may carry another unit,
    as 0.96um, 14000nm, -100degC.

    \b
    Examples:
      fringe-sim demo
      fringe-sim --log-level debug fit raws --out fit
      fringe-sim completion bash
    """
    logging.basicConfig(
        level=log_level.upper(), format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr, force=True
    )


def _complain(message: str) -> None:
    """One message on standard error; in colour on a terminal, unless NO_COLOR is set (no-color.org)."""
    color = False if os.environ.get("NO_COLOR") else None
    click.secho("fringe-sim:", fg="red", bold=True, nl=False, err=True, color=color)
    click.echo(f" {shown(message, LONGEST_MESSAGE)}", err=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status.

    ``arguments``: in place of ``sys.argv[1:]``.
    """
    # Threads that wait for work by spinning keep a second command on the same machine from its processors. OpenMP
    # reads this when it is loaded, with the first compiled loop.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # So many objects live as long as the command that looking for unused ones among them takes a second.
    gc.set_threshold(MOST_NEW_OBJECTS)
    # A terminal that knows no σ gets an escape for it: no command that has done its work ends in an error over that.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    sys.exit(run(arguments))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    try:
        words = list(sys.argv[1:] if arguments is None else arguments)
        result = cli.main(args=words, prog_name="fringe-sim", standalone_mode=False, obj=words)
    except click.exceptions.Exit as stop:
        return int(stop.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("Stopped.", err=True)
        return EXIT_STOPPED
    except click.UsageError as error:
        error.show()
        return EXIT_USAGE
    except click.ClickException as error:
        error.show()
        return EXIT_BAD_INPUT
    except FringeSimError as error:
        known = _LISTED.get(error.field) if isinstance(error, UnknownNameError) else None
        _complain(f"{error}; fringe-sim {known} lists them" if known else str(error))
        return EXIT_BAD_INPUT
    except OSError as error:
        named = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        _complain(named)
        return EXIT_BAD_INPUT
    except Exception:
        _complain("internal failure; this is a bug of the program.")
        click.echo(traceback.format_exc(), err=True)
        return EXIT_INTERNAL
    return result if isinstance(result, int) else 0
