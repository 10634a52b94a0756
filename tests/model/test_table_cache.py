"""The cache: two writers at once, a killed writer, a damaged file, an unwritable folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lsst.fringe_sim.errors import InputError, TableCacheWarning
from lsst.fringe_sim.model import ResponseTable, TableCache

KEY = "0123abcd"


def a_table(seed: int = 1) -> ResponseTable:
    values = np.random.default_rng(seed).uniform(size=(2, 64))
    return ResponseTable(5.0, 0.01, values, np.array([900.0, 960.0]), 1e-7, float("nan"), KEY)


def same(one: ResponseTable, other: ResponseTable) -> bool:
    return (
        np.array_equal(one.values, other.values)
        and np.array_equal(one.wavelength_nm, other.wavelength_nm)
        and (one.start_um, one.step_um, one.interpolation_error, one.key)
        == (other.start_um, other.step_um, other.interpolation_error, other.key)
    )


def never() -> ResponseTable:
    raise AssertionError("the table should have come from the cache")


def test_second_reader_does_not_build(tmp_path: Path) -> None:
    cache = TableCache(tmp_path / "deep" / "folder")
    built = cache.get(KEY, ResponseTable, a_table)
    assert same(cache.get(KEY, ResponseTable, never), built)


@pytest.mark.parametrize("damage", ["truncated", "bit", "text", "empty", "other key"])
def test_damaged_file_is_rebuilt_with_a_warning(tmp_path: Path, damage: str) -> None:
    cache = TableCache(tmp_path)
    cache.get(KEY, ResponseTable, a_table)
    path = cache.path(KEY)
    content = bytearray(path.read_bytes())
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "bit":
        content[len(content) // 3] ^= 0x10
        path.write_bytes(content)
    elif damage == "text":
        path.write_text("not a table")
    elif damage == "empty":
        path.write_bytes(b"")
    else:
        path.rename(cache.path("ffff"))
    key = "ffff" if damage == "other key" else KEY
    with pytest.warns(TableCacheWarning, match="rebuilt"):
        rebuilt = cache.get(key, ResponseTable, a_table)
    assert same(rebuilt, a_table())
    if damage != "other key":
        assert same(cache.get(key, ResponseTable, never), rebuilt)


WRITER = """
import sys, time
import numpy as np
from pathlib import Path
from lsst.fringe_sim.model import ResponseTable, TableCache
import lsst.fringe_sim.model.table_cache as module
folder, mode = Path(sys.argv[1]), sys.argv[2]
values = np.random.default_rng(1).uniform(size=(2, 200_000))
def build():
    return ResponseTable(5.0, 0.01, values, np.array([900.0, 960.0]), 1e-7, float("nan"), "0123abcd")
if mode == "hang":
    def slow(file, table):
        file.write(b"half a table")
        file.flush()
        print("writing", flush=True)
        time.sleep(60)
    module._write = slow
    TableCache(folder).get("0123abcd", ResponseTable, build)
else:
    for _ in range(30):
        TableCache(folder).path("0123abcd").unlink(missing_ok=True)
        table = TableCache(folder).get("0123abcd", ResponseTable, build)
        assert np.array_equal(table.values, values)
"""


def start_writer(folder: Path, mode: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", WRITER, str(folder), mode],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_two_processes_at_once(tmp_path: Path) -> None:
    writers = [start_writer(tmp_path, "race") for _ in range(2)]
    for writer in writers:
        _, errors = writer.communicate(timeout=60)
        assert writer.returncode == 0, errors
    assert not list(tmp_path.glob("*.part"))


def test_killed_writer_leaves_nothing_that_is_read(tmp_path: Path) -> None:
    writer = start_writer(tmp_path, "hang")
    assert writer.stdout is not None
    assert writer.stdout.readline().strip() == "writing"
    writer.send_signal(signal.SIGKILL)
    writer.communicate(timeout=20)
    cache = TableCache(tmp_path)
    leftovers = list(tmp_path.glob("*.part"))
    assert len(leftovers) == 1
    assert not cache.path(KEY).exists()
    old = time.time() - 7200.0
    os.utime(leftovers[0], (old, old))
    assert same(cache.get(KEY, ResponseTable, a_table), a_table())
    assert not list(tmp_path.glob("*.part")), "what a dead writer left is removed"
    assert same(cache.get(KEY, ResponseTable, never), a_table())


def test_unwritable_folder_is_a_warning(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with pytest.warns(TableCacheWarning, match="not kept"):
        table = TableCache(blocked / "cache").get(KEY, ResponseTable, a_table)
    assert same(table, a_table())


def test_folder_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("FRINGE_SIM_CACHE", raising=False)
    assert TableCache.default().directory == tmp_path / "xdg" / "fringe_sim"
    monkeypatch.setenv("FRINGE_SIM_CACHE", str(tmp_path / "own"))
    assert TableCache.default().directory == tmp_path / "own"


@pytest.mark.parametrize("key", ["", "../escape", "a b"])
def test_key_cannot_leave_the_folder(tmp_path: Path, key: str) -> None:
    with pytest.raises(InputError, match="key"):
        TableCache(tmp_path).path(key)
