"""What bps needs to run from an environment made from a package index.

bps is at home in Rubin's own installation. Elsewhere two things are missing: the variables by which its commands
find their programs, and the way to a configuration file inside a package (`bps submit resource://…` reads it, and
then stumbles over copying it into the submit directory).
"""

from __future__ import annotations

import os
import shutil
import sys
import types
from pathlib import Path
from typing import Any

from lsst.ctrl.bps import initialize
from lsst.resources import ResourcePath


def point_to_this_environment() -> None:
    """Let the commands of bps find the programs that are installed beside this Python."""
    programs = str(Path(sys.executable).parent)
    for name in ("CTRL_MPEXEC_DIR", "DAF_BUTLER_DIR"):
        os.environ.setdefault(name, sys.prefix)
    path = os.environ.get("PATH", "").split(os.pathsep)
    if programs not in path:
        # Parsl starts its workers by name.
        os.environ["PATH"] = os.pathsep.join([programs, *path])


def accept_resources() -> None:
    """Let bps copy a configuration file that is given as ``resource://…``.

    The module of bps that keeps a copy of the configuration uses `shutil.copy2`, which knows plain paths only.
    It is given one that knows more; nothing else changes, and later calls do nothing.
    """
    if getattr(initialize, "shutil", None) is shutil:
        initialize.shutil = types.SimpleNamespace(**{**vars(shutil), "copy2": _copy})


def _copy(source: Any, target: Any, **kwargs: Any) -> Any:
    """Copy a file as `shutil.copy2` does, or out of a package if its name is a URI."""
    uri = ResourcePath(str(source))
    if uri.scheme in ("", "file"):
        return shutil.copy2(source, target, **kwargs)
    path = Path(target)
    if path.is_dir():
        path = path / uri.basename()
    path.write_bytes(uri.read())
    return str(path)
