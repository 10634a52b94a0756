"""First commands of a new environment, with an empty cache of compiled functions, beside the same commands again.

Seconds in the compiler are processor time in numba's ``numba:compile`` events.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from ._table import Row

SIZE = "1024x1000"
"""Pixels of the sensor, at twelve wavelengths."""


def run() -> list[Row]:
    """Each command twice, first with an empty cache; a search after a fit; and what fills the cache beforehand."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raws = folder / "raws"
        _command(folder / "raws_cache", "mock-flats", str(raws), "--seed", "1", "--size", SIZE)
        commands = {
            f"fit of {SIZE} × 12": ("fit", str(raws)),
            "one sky frame": ("sky", "--thickness", "e2v_321", "--one-frame"),
            f"search in {SIZE} × 12": ("discover", str(raws)),
        }
        for work, command in commands.items():
            cache = folder / f"cache_{command[0]}"
            cold, warm = (
                _command(cache, *command, "--out", str(folder / f"{command[0]}_{state}"))
                for state in ("cold", "warm")
            )
            note = f"{cold['seconds']:.1f} s in the compiler, {cold['functions']} functions"
            rows.append(Row(work, "empty cache", cold["wall"], note=note))
            note = f"{cold['wall'] - warm['wall']:.1f} s less; {warm['functions']} functions compiled"
            rows.append(Row(work, "again", warm["wall"], beside=cold["wall"], note=note))
        *_, (work, search) = commands.items()
        after = _command(folder / "cache_fit", *search, "--out", str(folder / "discover_after_fit"))
        note = f"{after['functions']} functions compiled, {after['seconds']:.1f} s"
        rows.append(Row(work, "after the first fit", after["wall"], note=note))
        cache = folder / "cache_compile"
        start = time.perf_counter()
        _run(cache, [sys.executable, "-m", "lsst.fringe_sim", "compile"])
        rows.append(Row("fringe-sim compile", "empty cache", time.perf_counter() - start))
        for work, command in commands.items():
            after = _command(cache, *command, "--out", str(folder / f"{command[0]}_compiled"))
            note = f"{after['functions']} functions compiled, {after['seconds']:.1f} s"
            rows.append(Row(work, "after fringe-sim compile", after["wall"], note=note))
    return rows


def _command(cache: Path, *command: str) -> dict[str, Any]:
    """Wall time, and what was compiled, of one command."""
    start = time.perf_counter()
    done = _run(cache, [sys.executable, "-m", "benchmarks._cold_worker", *command])
    found: dict[str, Any] = json.loads(done.splitlines()[-1])
    if found["status"] != 0:
        raise RuntimeError(f"{' '.join(command)} ended with status {found['status']}")
    return found | {"wall": time.perf_counter() - start}


def _run(cache: Path, command: list[str]) -> str:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
