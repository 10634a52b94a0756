"""How long a person waits before a command does anything, beside the start of the interpreter."""

from __future__ import annotations

import subprocess
import sys
import time

from ._table import Row

REPEAT = 5
COMMANDS = (("--help",), ("fit", "--help"), ("fit", "raws"), ("setups",), ("effects",))


def run() -> list[Row]:
    bare = waited("-c", "pass")
    return [
        Row("start of a process", "python -c pass", bare),
        *(one_command(arguments, bare) for arguments in COMMANDS),
    ]


def one_command(arguments: tuple[str, ...], bare: float) -> Row:
    seconds = waited("-m", "lsst.fringe_sim", *arguments)
    note = f"{seconds / bare:.1f} starts of the interpreter"
    return Row("start of a process", f"fringe-sim {' '.join(arguments)}", seconds, note=note)


def waited(*arguments: str) -> float:
    """Least time of some runs [s]; the first, which reads files from the disk, is not counted."""
    times = []
    for _ in range(1 + REPEAT):
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], capture_output=True, check=False)
        times.append(time.perf_counter() - start)
    return min(times[1:])
