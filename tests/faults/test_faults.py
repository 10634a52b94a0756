"""What can happen to a run: afterwards nothing is half there, nothing earlier has changed, the rest can be made."""

import contextlib
import datetime
import os
import secrets
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fault_chain import OUT, QUANTA, Chain, Undisturbed, thickness_um
from lsst.daf.butler import Butler

sys.path.insert(0, str(Path(__file__).parent))
from kill_and_resume import check, kill_and_resume

pytestmark = pytest.mark.middleware

KILLS = 4


def finished(chain: Chain, undisturbed: Undisturbed, before: dict[str, str]) -> None:
    """The next run makes what is missing, no more, and the end is as if nothing had happened."""
    missing = QUANTA - chain.complete_quanta()
    ended = chain.run()
    assert ended.code == 0, ended.text
    assert f"Executed {missing} quanta successfully, 0 failed and 0 remain" in ended.text
    check(chain, before, "after the fault")
    assert chain.results() == undisturbed.results


@contextlib.contextmanager
def mounted(folder: Path, *options: str) -> Iterator[None]:
    """A file system of its own over a folder; skips where this user may not mount one."""
    done = subprocess.run(["mount", *options, str(folder)], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"cannot mount here: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_the_chain_finds_the_thickness(undisturbed: Undisturbed) -> None:
    """Ingest, bias, flats and fit by the real commands: within 3 nm of what the raw frames were made of."""
    with Butler.from_config(str(undisturbed.repo), collections=OUT) as butler:
        fitted = butler.get("epoxyThickness", instrument="LSST-TS8", detector=145)
    good = fitted.mask == 0
    assert good.mean() > 0.7
    assert np.median(1e3 * np.abs(fitted.value - thickness_um())[good]) < 3.0


def test_killed_in_the_middle(chain: Chain, undisturbed: Undisturbed) -> None:
    ended = chain.run(kill_at_file=6, kill_after=0.02)
    assert ended.code == -signal.SIGKILL, ended.text
    before = check(chain, {}, "killed")
    assert chain.complete_quanta() < QUANTA
    finished(chain, undisturbed, before)


@pytest.mark.slow
def test_killed_at_random_moments(new_chain: Callable[[], Chain], undisturbed: Undisturbed) -> None:
    """The same with 50 kills and more: ``python tests/faults/kill_and_resume.py``."""
    seed = secrets.randbits(63)
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    seconds = {True: undisturbed.seconds, False: 0.5 * undisturbed.seconds}
    report = kill_and_resume(new_chain, undisturbed.results, seconds, KILLS, rng, lambda line: print(line))
    assert report.kills >= KILLS


@pytest.mark.slow
def test_file_system_full(chain: Chain, undisturbed: Undisturbed, tmp_path: Path) -> None:
    """The repository, registry and all, lies on a file system that runs full in the middle of the run."""
    used = sum(path.stat().st_size for path in chain.repo.rglob("*") if path.is_file())
    small = tmp_path / "small"
    small.mkdir()
    with mounted(small, "-t", "tmpfs", "-o", f"size={used + 1_500_000}", "tmpfs"):
        hurt = Chain.at(Path(shutil.copytree(chain.repo, small / "repo")), root=tmp_path)
        before = hurt.visible()
        ended = hurt.run()
        assert ended.code != 0
        assert "No space left on device" in ended.text or "disk is full" in ended.text, ended.text[-2000:]
        before = check(hurt, before, "file system full")
        larger = Chain.at(Path(shutil.copytree(hurt.repo, tmp_path / "repo")), root=tmp_path)
    finished(larger, undisturbed, before)


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["u", "."])
def test_read_only_output(chain: Chain, undisturbed: Undisturbed, folder: str) -> None:
    """The folder of the outputs, or the whole repository, cannot be written."""
    target = chain.repo / folder
    target.mkdir(exist_ok=True)
    before = chain.visible()
    with read_only(target):
        ended = chain.run()
        assert ended.code != 0
        assert "ead-only" in ended.text or "readonly" in ended.text or "ermission denied" in ended.text
        check(chain, before, "read-only")
    assert chain.number("fringeBias", "*") == 0
    finished(chain, undisturbed, before)


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    if os.geteuid() == 0:  # whom permissions do not stop
        with mounted(folder, "--bind", str(folder)):
            subprocess.run(["mount", "-o", "remount,ro,bind", str(folder)], check=True)
            yield
        return
    mode = folder.stat().st_mode
    folder.chmod(0o555)
    try:
        yield
    finally:
        folder.chmod(mode)


def raw_file(chain: Chain, kind: str = "flat") -> Path:
    with Butler.from_config(str(chain.repo), collections="LSST-TS8/raw/all") as butler:
        refs = butler.query_datasets(
            "raw", where=f"exposure.observation_type = '{kind}'", instrument="LSST-TS8"
        )
        return Path(butler.getURI(sorted(refs)[1]).ospath)


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size * 2 // 3)


def flip_bit(path: Path) -> None:
    """One bit in the header of an amplifier: what the geometry is read from."""
    content = bytearray(path.read_bytes())
    content[content.index(b"DATASEC", len(content) // 2) + 12] ^= 0x40
    path.write_bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [cut, flip_bit], ids=["truncated", "bit"])
def test_input_spoiled(chain: Chain, undisturbed: Undisturbed, spoil: Callable[[Path], None]) -> None:
    """One flat cannot be read: it alone fails, with its name, and when it is back the rest is made."""
    path = raw_file(chain)
    sound = path.read_bytes()
    spoil(path)
    ended = chain.run()
    assert ended.code == 1
    assert path.name in ended.text
    # The sensor is not fitted without the flat: its quantum waits.
    assert chain.number("fringeFlat") == QUANTA - 3
    assert chain.number("epoxyThickness", "*") == 0
    path.write_bytes(sound)
    finished(chain, undisturbed, chain.visible())


@pytest.mark.slow
def test_input_vanished(chain: Chain) -> None:
    """To the middleware a file that is not there is no work: the sensor is fitted to the other flats, and says so."""
    raw_file(chain).unlink()
    ended = chain.run()
    assert ended.code == 0, ended.text
    assert chain.number("fringeFlat") == QUANTA - 3
    with Butler.from_config(str(chain.repo), collections=OUT) as butler:
        fitted = butler.get("epoxyThickness", instrument="LSST-TS8", detector=145)
    assert int(fitted.n_wavelengths.max()) == QUANTA - 3


@pytest.mark.slow
def test_an_intermediate_product_damaged_on_disk(chain: Chain, undisturbed: Undisturbed) -> None:
    """A flipped bit in a stored flat is seen by its checksum before anything is fitted to it."""
    assert chain.run(subset="#fringeBias,isrFlatPrep").code == 0
    with Butler.from_config(str(chain.repo), collections=OUT) as butler:
        path = Path(butler.getURI(sorted(butler.query_datasets("fringeFlat"))[0]).ospath)
    sound = path.read_bytes()
    hurt = bytearray(sound)
    hurt[len(hurt) // 2] ^= 1
    path.write_bytes(hurt)
    ended = chain.run()
    assert ended.code == 1
    assert "hecksum" in ended.text
    assert path.name in ended.text
    assert chain.number("epoxyThickness", "*") == 0
    path.write_bytes(sound)
    finished(chain, undisturbed, chain.visible())


@pytest.mark.slow
def test_two_runs_at_once(chain: Chain, undisturbed: Undisturbed) -> None:
    """Two processes fill one repository, each with a chain of its own."""
    ended = chain.at_once("u/one", "u/two")
    assert [item.code for item in ended] == [0, 0], ended[0].text[-2000:] + ended[1].text[-2000:]
    chain.visible()
    assert chain.results("u/one") == chain.results("u/two") == undisturbed.results


CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>
static long shift(void) { const char *text = getenv("CLOCK_SHIFT_S"); return text ? atol(text) : 0; }
int clock_gettime(clockid_t id, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(id, now);
    if (id == CLOCK_REALTIME) now->tv_sec += shift();
    return code;
}
time_t time(time_t *out) {
    struct timespec now; clock_gettime(CLOCK_REALTIME, &now);
    if (out) *out = now.tv_sec;
    return now.tv_sec;
}
int gettimeofday(struct timeval *out, void *zone) {
    struct timespec now; clock_gettime(CLOCK_REALTIME, &now);
    out->tv_sec = now.tv_sec; out->tv_usec = now.tv_nsec / 1000; return 0;
}
"""
"""A clock that goes wrong for one process, loaded before the C library."""


@pytest.mark.slow
def test_clock_zone_and_language_of_the_machine(
    chain: Chain, undisturbed: Undisturbed, tmp_path: Path
) -> None:
    """A machine whose clock is years late and jumps between two runs, in another zone and language."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    strange = {
        "TZ": "Pacific/Kiritimati",
        "LC_ALL": "de_DE.UTF-8",
        "LANG": "tr_TR.UTF-8",
        "PYTHONHASHSEED": "7",
    }
    late: dict[str, str] = {}
    if compiler:
        source, library = tmp_path / "clock.c", tmp_path / "clock.so"
        source.write_text(CLOCK)
        subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
        late = {"LD_PRELOAD": str(library), "CLOCK_SHIFT_S": str(-20 * 365 * 86400)}
    first = chain.run(subset="#fringeBias,isrFlatPrep", environment={**strange, **late})
    assert first.code == 0, first.text
    with Butler.from_config(str(chain.repo)) as butler:
        (early,) = butler.collections.query("u/lab/*")
    if late:
        # The clock was indeed another one: the run bears its year.
        assert int(early.removeprefix(f"{OUT}/")[:4]) <= datetime.datetime.now(datetime.UTC).year - 19
    finished(chain, undisturbed, chain.visible())
