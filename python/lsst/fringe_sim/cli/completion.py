"""``fringe-sim completion``."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from .command import argument, command

VARIABLE = "_FRINGE_SIM_COMPLETE"
"""Environment variable by which a shell asks for completions; click derives it from the name of the program."""


@command()
def completion(shell: str = argument(kind=click.Choice(["bash", "zsh", "fish"]), nargs=1)) -> None:
    """Print the lines that make a shell complete commands, options, set-ups and effects.

    \b
    Examples:
      eval "$(fringe-sim completion bash)"
      fringe-sim completion zsh >> ~/.zshrc
      fringe-sim completion fish > ~/.config/fish/completions/fringe-sim.fish
    """
    from .main import cli

    found = get_completion_class(shell)
    if found is None:
        raise click.UsageError(f"no completion for {shell}")
    click.echo(found(cli, {}, "fringe-sim", VARIABLE).source())
