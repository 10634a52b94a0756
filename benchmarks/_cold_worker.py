"""Run one command and print as JSON how long it compiled: `python -m benchmarks._cold_worker COMMAND...`."""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any

from numba.core import event


class _Compiling(event.Listener):
    """Seconds of processor time in the compiler, and functions compiled; those inside others count once."""

    def __init__(self) -> None:
        self.seconds, self.functions = 0.0, 0
        self._nested = threading.local()

    def on_start(self, event: Any) -> None:
        starts = self._nested.__dict__.setdefault("starts", [])
        starts.append(time.thread_time())

    def on_end(self, event: Any) -> None:
        start = self._nested.starts.pop()
        self.functions += 1
        if not self._nested.starts:
            self.seconds += time.thread_time() - start


def main() -> None:
    compiling = _Compiling()
    event.register("numba:compile", compiling)
    from lsst.fringe_sim.cli.main import run

    status = run(sys.argv[1:])
    print(
        json.dumps({"status": status, "seconds": compiling.seconds, "functions": compiling.functions}),
        file=sys.__stdout__,
    )


if __name__ == "__main__":
    main()
