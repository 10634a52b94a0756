"""Timing, and rows of a table."""

from __future__ import annotations

import gc
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Row:
    """One line of the table.

    ``seconds`` is the wall time of the whole work, ``cpu`` its processor time over all threads; ``evaluations``
    turns them into times per evaluation and ``beside`` (seconds per evaluation, or per work without
    ``evaluations``) into a ratio. Where the processor time is given, it is what is compared: it hardly depends on
    what else the machine does.
    """

    work: str
    method: str
    seconds: float
    evaluations: float = 1.0
    beside: float | None = None
    note: str = ""
    cpu: float | None = None

    @property
    def per_evaluation(self) -> float:
        """Seconds per evaluation, of processor time where it is known."""
        return (self.seconds if self.cpu is None else self.cpu) / self.evaluations

    @property
    def ratio(self) -> float | None:
        """How many times faster than what it stands beside."""
        return None if self.beside is None else self.beside / self.per_evaluation


def median_time(function: Callable[[], object], repeat: int = 5, *, cpu: bool = False) -> float:
    """Median wall (or processor) time [s]; the first call, which may compile, is not counted."""
    function()
    clock = time.process_time if cpu else time.perf_counter
    times = []
    for _ in range(repeat):
        start = clock()
        function()
        times.append(clock() - start)
    return statistics.median(times)


def timed(function: Callable[[], T]) -> tuple[T, float, float]:
    """Result, wall time and processor time of all threads [s] of one call."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = function()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def best_of(function: Callable[[], object], repeat: int = 3) -> tuple[float, float]:
    """Least wall and least processor time [s]; the first call, which may compile, is not counted."""
    function()
    times = [timed(function)[1:] for _ in range(repeat)]
    return min(wall for wall, _ in times), min(cpu for _, cpu in times)


@contextmanager
def memory_watch(every_s: float = 0.01) -> Iterator[list[float]]:
    """Append to the list the largest memory of this process [GiB] while the block ran: without files, and with.

    The first is what a process needs (anonymous memory); the second has the pages of mapped files in it, which the
    system takes back when it wants them.
    """
    largest = [0.0, 0.0]
    done = Event()

    def look() -> None:
        while not done.wait(every_s):
            for k, amount in enumerate(_resident()):
                largest[k] = max(largest[k], amount)

    watcher = Thread(target=look, daemon=True)
    watcher.start()
    found: list[float] = []
    try:
        yield found
    finally:
        done.set()
        watcher.join()
        found.extend(largest)


def memory_now() -> float:
    """Anonymous memory of this process now [GiB]."""
    gc.collect()
    return _resident()[0]


def _resident() -> tuple[float, float]:
    """Anonymous and whole resident memory [GiB]."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return tuple(int(fields[name].split()[0]) / 2**20 for name in ("RssAnon", "VmRSS"))  # type: ignore[return-value]


def machine() -> str:
    """Processor, cores, load and Python of this run."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [
            line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        model = lines[0] if lines else model
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return (
        f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"load average {load:.1f} when this was measured"
    )


def seconds(value: float) -> str:
    """Time with a fitting unit."""
    if math.isnan(value):
        return ""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if value >= scale:
            return f"{value / scale:.3g} {unit}"
    return f"{value * 1e9:.3g} ns"


def markdown(rows: list[Row]) -> str:
    """Rows as a Markdown table."""
    lines = [
        "| work | method | time | processor | per evaluation | times faster | note |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        ratio = (
            "" if row.ratio is None else f"{row.ratio:,.3g}×" if row.ratio < 1000 else f"{row.ratio:,.0f}×"
        )
        cpu = "" if row.cpu is None else seconds(row.cpu)
        each = "" if row.evaluations == 1.0 else seconds(row.per_evaluation)
        lines.append(
            f"| {row.work} | {row.method} | {seconds(row.seconds)} | {cpu} | {each} | {ratio} | {row.note} |"
        )
    return "\n".join(lines)
