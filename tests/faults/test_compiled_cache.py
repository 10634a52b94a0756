"""What numba keeps of compiled functions: on a full disk, in a folder that cannot be written, and damaged."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import resource
import sys

most = int(sys.argv[1])
if most:
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
from lsst.fringe_sim.compiled import kernel


@kernel
def add(a, b):
    return a + b


print(add(1.0, 2.0))
"""

pytestmark = pytest.mark.slow


def added(folder: Path, cache: str, most: int = 0) -> str:
    """What a process says that compiles a function, or finds it compiled; ``most``: bytes of a file."""
    program = folder / "program.py"
    if not program.exists():
        program.write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, str(program), str(most)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "NUMBA_CACHE_DIR": cache},
    )
    assert (done.returncode, done.stdout) == (0, "3.0\n"), done.stderr
    return done.stderr


@pytest.mark.parametrize("most", [1, 1000])
def test_no_room(tmp_path: Path, most: int) -> None:
    assert "cannot be kept" in added(tmp_path, str(tmp_path / "cache"), most)
    # The next one, with room, keeps it.
    assert not added(tmp_path, str(tmp_path / "cache"))
    assert list((tmp_path / "cache").rglob("*.nbc"))


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    """Numba keeps it beside the program, if it can."""
    added(tmp_path, "/proc/self/nowhere")


@pytest.mark.parametrize("kind", ["*.nbc", "*.nbi"])
@pytest.mark.parametrize("left", [b"", b"half a file"])
def test_what_is_damaged_is_made_again(tmp_path: Path, kind: str, left: bytes) -> None:
    cache = tmp_path / "cache"
    assert not added(tmp_path, str(cache))
    (path,) = cache.rglob(kind)
    path.write_bytes(left)
    assert "cannot be read" in added(tmp_path, str(cache))
    assert not added(tmp_path, str(cache))


def test_a_folder_that_is_only_read_is_used(tmp_path: Path) -> None:
    """As that of an image, by whoever may not write it; numba by itself passes over it."""
    cache = tmp_path / "cache"
    assert not added(tmp_path, str(cache))
    folders = [cache, *(path for path in cache.rglob("*") if path.is_dir())]
    program = tmp_path / "program.py"
    check = f"import runpy; print(runpy.run_path({str(program)!r})['add'].stats.cache_hits)"
    powerless = ["setpriv", "--bounding-set", "-dac_override"] if os.geteuid() == 0 else []
    if powerless and shutil.which(powerless[0]) is None:
        pytest.skip("root may write everything")
    try:
        for folder in folders:
            folder.chmod(0o555)
        done = subprocess.run(
            [*powerless, sys.executable, "-c", check, "0"],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
        )
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert done.stdout == "3.0\nCounter({(float64, float64): 1})\n", done.stderr
