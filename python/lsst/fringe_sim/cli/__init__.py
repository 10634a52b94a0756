"""The command line: ``fringe-sim``."""

from .main import main

__all__ = ["main"]
