"""Timing, and rows of a table."""

from __future__ import annotations

import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One line of the table.

    ``seconds`` is the median wall time of the whole work; ``evaluations`` turns it into a time per evaluation and
    ``beside`` (seconds per evaluation, or per work without ``evaluations``) into a ratio.
    """

    work: str
    method: str
    seconds: float
    evaluations: float = 1.0
    beside: float | None = None
    note: str = ""

    @property
    def per_evaluation(self) -> float:
        return self.seconds / self.evaluations

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
    lines = ["| work | method | time | per evaluation | times faster | note |", "|---|---|---|---|---|---|"]
    for row in rows:
        ratio = (
            "" if row.ratio is None else f"{row.ratio:,.3g}×" if row.ratio < 1000 else f"{row.ratio:,.0f}×"
        )
        each = "" if row.evaluations == 1.0 else seconds(row.per_evaluation)
        lines.append(
            f"| {row.work} | {row.method} | {seconds(row.seconds)} | {each} | {ratio} | {row.note} |"
        )
    return "\n".join(lines)
