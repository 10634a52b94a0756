"""Commands in odd surroundings: no temporary files, other locales, any number of threads, one wavelength."""

import functools
import gc
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from made_once import made_once
from observed_night import observed_night

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube, ThicknessMap
from lsst.fringe_sim.products.mask import mask_bits

pytestmark = pytest.mark.slow

WAVELENGTHS_NM = np.arange(880.0, 1000.0, 10.0)
PAGES = {"report.html"}  # Pages state the time of their making


def field_um(rows: int, columns: int) -> np.ndarray:
    y, x = np.mgrid[:rows, :columns] / 32
    return 13.5 + 0.8 * x + 0.5 * y**2


def cube_of(wavelength: np.ndarray, shape: tuple[int, int] = (32, 32), **given: np.ndarray) -> FringeCube:
    """Flats of a small sensor with photon noise."""
    response = FringeModel.from_setup("ts8_e2v").response(field_um(*shape), wavelength)
    response /= response.mean(axis=(1, 2), keepdims=True)
    image = np.random.default_rng(3).poisson(30_000 * response).astype(np.float32)
    kind = {"bandwidth_fwhm_nm": 2.0, "temperature_k": 183.15, **given}
    return FringeCube.from_arrays(image, wavelength, variance=image, **kind)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cube, a map, frames of a night and their templates."""

    def make(folder: Path) -> None:
        cube_of(WAVELENGTHS_NM).write_fits(folder / "cube.fits")
        value, empty = field_um(32, 32), np.zeros((32, 32))
        ThicknessMap(value, empty + 0.01, empty, empty, empty.astype(int), "adhesive").write_fits(
            folder / "map.fits"
        )
        (folder / "night").mkdir()
        for number, image in enumerate(observed_night(np.random.default_rng(44), 3, 72, stars=4).images):
            fits.PrimaryHDU(image).writeto(folder / "night" / f"{number}.fits")
        words = ["templates", folder / "night", "--components", "1", "--out", folder / "templates"]
        assert run([str(word) for word in words]) == 0

    return made_once(tmp_path_factory, "surroundings", make)


def command(given: Path, name: str, out: Path) -> list[str]:
    kind = {
        "sky": ["--thickness", str(given / "map.fits"), "--setup", "monocam"],
        "fit": [str(given / "cube.fits"), "--setup", "ts8_e2v"],
        "discover": [str(given / "cube.fits"), "--setup", "ts8_e2v", "--seed", "3", "--cells", "400"],
        "mock-flats": ["--size", "64x64", "--wavelengths", "900,950", "--bias-frames", "1", "--seed", "1"],
        "export": [str(given / "map.fits")],
        "correct": [str(given / "night" / "0.fits"), "--templates", str(given / "templates")],
    }
    if name == "mock-flats":
        return [name, str(out), *kind[name]]
    return [name, *kind[name], "--out", str(out)]


def files_of(words: list[str], out: Path, **environment: str) -> dict[str, bytes]:
    """What a command writes in a process of its own; without pages, and without the folder it wrote to."""
    started = {key: value for key, value in os.environ.items() if not key.startswith(("LC_", "LANG"))}
    done = subprocess.run(
        [sys.executable, "-m", "lsst.fringe_sim", *words],
        capture_output=True,
        check=False,
        env={**started, **environment},
    )
    assert done.returncode == 0, done.stderr.decode("utf-8", "replace")[-3000:]
    assert b"Traceback" not in done.stderr
    found = {path.name: path.read_bytes() for path in out.iterdir() if path.name not in PAGES}
    assert found
    return {name: content.replace(os.fsencode(out), b"OUT") for name, content in found.items()}


@pytest.fixture(scope="module")
def usual(given: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, bytes]]:
    """What a command writes in usual surroundings."""

    @functools.cache
    def made(name: str) -> dict[str, bytes]:
        out = tmp_path_factory.mktemp("usual") / "out"
        return files_of(command(given, name, out), out)

    return made


Usual = Callable[[str], dict[str, bytes]]


def compared(found: Mapping[str, bytes], wanted: Mapping[str, bytes]) -> None:
    assert found.keys() == wanted.keys()
    assert not [name for name in wanted if found[name] != wanted[name]]


@pytest.mark.parametrize("name", ["sky", "discover"])
def test_any_number_of_threads_gives_the_same_bytes(name: str, given: Path, tmp_path: Path) -> None:
    made = {}
    for number in (1, 2, 64):
        out = tmp_path / str(number)
        threads = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(number))
        made[number] = files_of(command(given, name, out), out, **threads)
    compared(made[2], made[1])
    compared(made[64], made[1])


@pytest.mark.parametrize("place", ["/dev/full", "/proc/self", "missing"])
def test_without_room_for_temporary_files(place: str, given: Path, tmp_path: Path, usual: Usual) -> None:
    """TMPDIR is no folder, cannot be written, or is not there: products are made beside their places."""
    folder = place if place.startswith("/") else str(tmp_path / place)
    compared(files_of(command(given, "sky", tmp_path / "out"), tmp_path / "out", TMPDIR=folder), usual("sky"))


@pytest.mark.parametrize(
    "locale",
    [{"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}, {"LC_ALL": "POSIX", "PYTHONIOENCODING": "latin-1"}],
)
def test_locales_that_are_not_utf8(locale: dict[str, str], given: Path, tmp_path: Path, usual: Usual) -> None:
    out = tmp_path / "für"
    compared(files_of(command(given, "sky", out), out, PYTHONUTF8="0", **locale), usual("sky"))


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """A file that grows beyond it cannot be written, as on a full disk or beyond a quota."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [0, 5000])
@pytest.mark.parametrize("name", ["sky", "fit", "discover", "mock-flats", "export", "correct"])
def test_a_full_disk(
    name: str, size: int, given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One sentence that names the file; nothing that is half of a file, and nothing that a reader takes."""
    out = tmp_path / "out"
    out.mkdir()
    with files_of_at_most(size):
        status = run(command(given, name, out))
    said = capsys.readouterr().err
    assert status == 1
    (line,) = [line for line in said.splitlines() if line.startswith("fringe-sim:")]
    assert "Traceback" not in said
    assert str(out) in line
    left = [path.name for path in out.rglob("*") if path.is_file()]
    assert not [name for name in left if name.endswith((".fits", ".nc", ".part", ".json"))]
    assert run([*command(given, name, out), *(["--overwrite"] if any(out.iterdir()) else [])]) == 0


def test_two_hundred_wavelengths() -> None:
    """Every 0.6 nm: the fit takes them all, and its errors are those that the noise makes."""
    wavelength = np.linspace(880.0, 1000.0, 200)
    fitted = fit_thickness(cube_of(wavelength), FringeModel.from_setup("ts8_e2v"))
    good = fitted.mask == 0
    assert good.mean() > 0.99
    pull = ((fitted.value - field_um(32, 32)) / fitted.sigma)[good]
    assert abs(np.median(pull)) < 1.0
    assert 0.5 < np.std(pull) < 2.0


MOST_GROWTH_BYTES = 2 << 20  # In each run: the arrays of a run here are larger


@pytest.mark.parametrize("name", ["sky", "fit"])
def test_ten_runs_in_one_process(name: str, given: Path, tmp_path: Path) -> None:
    """The same bytes each time, and memory that does not grow."""
    resident, made = [], []
    for number in range(10):
        out = tmp_path / str(number)
        assert run(command(given, name, out)) == 0
        found = {path.name: path.read_bytes() for path in out.iterdir() if path.name not in PAGES}
        made.append({key: content.replace(os.fsencode(out), b"OUT") for key, content in found.items()})
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        resident.append(pages * resource.getpagesize())
    print(name, [round(size / 2**20, 1) for size in resident])
    for other in made[1:]:
        compared(other, made[0])
    assert np.polyfit(np.arange(5), resident[5:], 1)[0] < MOST_GROWTH_BYTES


def test_one_wavelength() -> None:
    """It cannot tell the order: refused, or every pixel says so."""
    try:
        fitted = fit_thickness(cube_of(np.array([960.0])), FringeModel.from_setup("ts8_e2v"))
    except InputError:
        return
    assert np.all(fitted.mask & mask_bits("SLIP", "NO_DATA", "LOW_SIGNAL"))
