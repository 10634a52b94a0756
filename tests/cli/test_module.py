"""``python -m lsst.fringe_sim``."""

import os
import re
import subprocess
import sys

import pytest

from lsst.fringe_sim import __version__


def test_the_package_runs_as_a_module() -> None:
    """With the exit status of ``fringe-sim``, and its name in the messages."""
    command = [sys.executable, "-m", "lsst.fringe_sim"]
    shown = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["fringe-sim,", "version", __version__]
    assert subprocess.run([*command, "nonsense"], capture_output=True, check=False).returncode == 2


@pytest.mark.skipif(sys.platform != "linux", reason="libgomp tells its settings")
@pytest.mark.parametrize("policy", [None, "active"])
def test_threads_wait_without_spinning(policy: str | None) -> None:
    """Two commands beside one another would keep each other from the processors; whoever sets it decides."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("OMP_", "GOMP_"))}
    environment |= {"OMP_DISPLAY_ENV": "VERBOSE"} | ({} if policy is None else {"OMP_WAIT_POLICY": policy})
    # A command whose libraries load OpenMP when they are imported.
    command = [sys.executable, "-m", "lsst.fringe_sim", "amplitudes", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    spins = [int(number) for number in re.findall(r"GOMP_SPINCOUNT = '(\d+)'", done.stderr)]
    assert spins
    assert all((number > 0) == (policy == "active") for number in spins)
