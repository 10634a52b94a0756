"""The tutorial on sensors of one's own: every command of it runs, outside the package, and ends as the page says."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.cli.mock_flats import thickness_map
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.products import FringeFrame, ThicknessMap, read_plain_flats

TUTORIALS = Path(__file__).resolve().parents[2] / "doc" / "tutorials"
SECTION = re.compile(r"^## (.+)\n((?:(?!^## ).*\n)+)", re.MULTILINE)
BASH = re.compile(r"^```bash\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def commands(*titles: str) -> list[list[str]]:
    """Commands of some sections of the page, in its order."""
    page = (TUTORIALS / "own_sensor.md").read_text(encoding="utf-8")
    sections = dict(SECTION.findall(page))
    lines = [
        line for title in titles for block in BASH.findall(sections[title]) for line in block.splitlines()
    ]
    return [shlex.split(line) for line in lines]


def follow(*titles: str) -> None:
    for program, *arguments in commands(*titles):
        assert program == "fringe-sim"
        assert run(arguments) == 0, arguments


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with nothing but what the page says to copy."""
    shutil.copytree(TUTORIALS / "own_sensor", tmp_path / "own_sensor")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def assert_right(fitted: str, setup: str, seed: int) -> None:
    """A map has the thickness of which its flats were made, to what it states."""
    found = ThicknessMap.read_fits(fitted)
    truth = thickness_map("random", Setup.from_name(setup), found.value.shape, np.random.default_rng(seed))
    good = found.mask == 0
    assert good.mean() > 0.95
    pull = (found.value - truth)[good] / found.sigma[good]
    assert np.abs(pull).max() < 6.0
    # 1.00 ± 0.01 if the noise is as stated and neighbours are independent.
    assert abs(pull.std() - 1.0) < 0.1


def test_flats_of_ones_own_sensor_become_a_map(work: Path) -> None:
    follow("Flats and their thickness")
    assert_right("fit/thickness.fits", "own_sensor/ccd290/flats.yaml", seed=1)


@pytest.mark.slow
def test_the_rest_of_the_page(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    follow("Flats and their thickness", "The night sky and its template")
    assert "own/nk_N-BK7.ecsv" in capsys.readouterr().out
    template = FringeFrame.read_fits("sky/fringe_S00_0.fits")
    assert template.image.shape == (64, 64)
    assert 1e-3 < template.image.std() < 1e-2
    follow("Is the description right?")
    verdict, wide = (
        json.loads(Path(name, "discovery.json").read_text()) for name in ("verdict", "verdict_wide")
    )
    assert verdict["verdict"] == "no_discrepancy"
    assert any(
        "epoxy_index, epoxy_absorption" in note and "were left out" in note for note in verdict["notes"]
    )
    (found,) = wide["effects"]
    assert (wide["verdict"], found["name"]) == ("named", "bandwidth")
    assert abs(found["parameters"]["fwhm"]["value"] - 1.6) < 0.01
    follow("An effect of one's own")
    plain, icy = (fits.getheader(f"{name}/sky_S00_00.fits") for name in ("sky", "sky_with_ice"))
    assert (icy["EFFECT0"], icy["EFFVAL0"]) == ("ice.thickness", 100.0)
    assert icy["FRINGRMS"] > 1.2 * plain["FRINGRMS"]


@pytest.mark.slow
def test_four_outputs(work: Path) -> None:
    follow("Four outputs and 200 µm")
    assert_right("fit_of_four/thickness.fits", "own_sensor/hamamatsu/flats.yaml", seed=2)
    cube = read_plain_flats(
        sorted(Path("flats_of_four").iterdir()), temperature_k=173.15, bandwidth_fwhm_nm=0.2
    )
    assert (cube.shape, cube.detector, cube.metadata["NBIAS"]) == ((10, 64, 64), "HPK-01", 5)
    with fits.open(next(Path("flats_of_four").glob("*flat*.fits"))) as hdus:
        assert [hdu.name for hdu in hdus[1:]] == ["A1", "A2", "A3", "A4"]
        assert hdus[0].header["INSTRUME"] == "camera"
    assert len(list(Path("corrected_of_four").glob("*.fits"))) == 3
