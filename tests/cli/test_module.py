"""``python -m lsst.fringe_sim``."""

from __future__ import annotations

import subprocess
import sys

from lsst.fringe_sim import __version__


def test_the_package_runs_as_a_module() -> None:
    """With the exit status of ``fringe-sim``, and its name in the messages."""
    command = [sys.executable, "-m", "lsst.fringe_sim"]
    shown = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["fringe-sim,", "version", __version__]
    assert subprocess.run([*command, "nonsense"], capture_output=True, check=False).returncode == 2
