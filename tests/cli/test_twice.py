"""Every command that writes, run twice: the second time changes nothing."""

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import click
import click.testing
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from lsst.daf.butler import Butler, Config, DatasetType
from lsst.daf.butler.cli.butler import cli as butler_cli
from lsst.daf.butler.cli.utils import LogCliRunner
from product_makers import MAKERS
from raw_frame_maker import write_raw
from toy_repository import put_fringe

from lsst.fringe_sim.cli.main import cli, run
from lsst.fringe_sim.middleware import LsstCamFringe, Ts8Fringe, get_cli_subcommands
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS_NM = np.arange(880.0, 1000.0, 10.0)
CHECKOUT = Path(__file__).resolve().parents[2]

COMMANDS: dict[str, tuple[str, ...]] = {
    "mock-flats": (
        "OUT",
        "--size",
        "256x200",
        "--wavelengths",
        "900,960",
        "--bias-frames",
        "1",
        "--seed",
        "3",
    ),
    "plan-flats": ("--ecsv", "OUT/plan.ecsv", "--wavelengths", "880:990:20", "--candidates", "900,910"),
    "fit": ("CUBE", "--out", "OUT"),
    "sky": ("--thickness", "MAP", "--out", "OUT"),
    "focal-plane": ("--sensor", "R22_S11", "--nights", "1", "--out", "OUT"),
    "export": ("CUBE", "--out", "OUT"),
    "amplitudes": ("--thickness", "MAP", "--lines", "LINES", "--case", "MonoCam", "--out", "OUT"),
}

ELSEWHERE = {
    "demo": "tests/cli/test_demo.py::test_running_it_again_does_nothing_twice",
    "discover": "tests/algorithms/discovery/test_search.py",
    "challenge": "tests/mock/test_hidden_effects.py",
    "mock-visits": "tests/mock/test_visits.py::test_the_command",
    "templates": "tests/cli/test_correct.py",
    "correct": "tests/cli/test_correct.py",
    "fit-sky": "tests/cli/test_fit_sky.py",
    "reproduce-paper": "tests/cli/test_reproduce_paper.py",
    "evidence": "tests/cli/test_evidence.py",
}
"""Minutes of work: the same seed gives the same answer there."""


def writing_commands() -> set[str]:
    """Commands with something to write to: all that offer a dry run."""
    context = click.Context(cli)
    found = set()
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        assert command is not None
        if any("--dry-run" in parameter.opts for parameter in command.params):
            found.add(name)
    return found


def test_no_command_is_forgotten() -> None:
    assert writing_commands() - set(COMMANDS) - set(ELSEWHERE) == set()
    for place in ELSEWHERE.values():
        assert (CHECKOUT / place.partition("::")[0]).is_file()


def contents(folder: Path) -> dict[str, str]:
    """Digest of every file; of pages without the time of their making."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Files that the commands are given, by the word for them in the table."""
    folder = tmp_path_factory.mktemp("given")
    thickness = e2v_321((64, 96))
    response = FringeModel.from_setup("ts8_e2v").response(thickness.ravel(), WAVELENGTHS_NM)
    image = (20000.0 * response / response.mean(axis=1, keepdims=True)).reshape(-1, *thickness.shape)
    FringeCube(
        image=image.astype(np.float32),
        variance=image.astype(np.float32),
        mask=np.zeros(image.shape, np.int32),
        exposures=FlatExposures(WAVELENGTHS_NM, np.array(2.0), np.array(173.15)),
    ).write_fits(folder / "cube.fits")
    fits.PrimaryHDU(thickness.astype(np.float32)).writeto(folder / "map.fits")
    Table({"wavelength": [940.0, 960.0], "intensity": [1.0, 2.0]}).write(
        folder / "lines.ecsv", format="ascii.ecsv"
    )
    return {
        "CUBE": str(folder / "cube.fits"),
        "MAP": str(folder / "map.fits"),
        "LINES": str(folder / "lines.ecsv"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_second_time_changes_nothing(
    name: str, given: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pages state when they were made, so that the time is given."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")
    out = tmp_path / "out"
    out.mkdir()
    words = {"OUT": str(out), **given}
    arguments = [re.sub("OUT|CUBE|MAP|LINES", lambda word: words[word[0]], text) for text in COMMANDS[name]]
    if name == "mock-flats":
        arguments[0] = str(out / "raws")
    assert run([name, *arguments]) == 0
    first = contents(out)
    assert first
    assert run([name, *arguments]) == 1
    assert contents(out) == first
    arguments.append("--overwrite")
    assert run([name, *arguments]) == 0
    assert contents(out) == first


# Subcommands of butler


def ingest(repo: Path, folder: Path) -> list[list[str]]:
    write_raw(folder / "raw.fits", {})
    return [["ingest-fringe-raws", str(repo), str(folder), "--transfer", "copy"]]


def night(repo: Path, folder: Path) -> list[list[str]]:
    return [["define-fringe-night", str(repo), "LSSTCam", "--date", "20260115", "--hours", "19:21"]]


def adopt(repo: Path, folder: Path) -> list[list[str]]:
    with Butler.from_config(str(repo), writeable=True) as butler:
        kind = DatasetType(
            "epoxyThickness", ("instrument", "detector"), "ThicknessMap", universe=butler.dimensions
        )
        butler.registry.registerDatasetType(kind)
        butler.collections.register("u/lab")
        butler.put(MAKERS["ThicknessMap"](), kind, instrument="LSST-TS8", detector=145, run="u/lab")
    return [["adopt-sensor-datasets", str(repo), "epoxyThickness", "u/lab", "LSSTCam", "u/adopted"]]


def hand_off(repo: Path, folder: Path) -> list[list[str]]:
    with Butler.from_config(str(repo), writeable=True) as butler:
        put_fringe(butler, "u/fringe", (37,))
    return [["write-fringe-handoff", str(repo), "u/fringe", str(folder / "handoff")]]


def recover(repo: Path, folder: Path) -> list[list[str]]:
    return [["recover-fringe-repo", str(repo)]]


def prepare(repo: Path, folder: Path) -> list[list[str]]:
    return [["prepare-fringe-repo", str(repo)]]


SUBCOMMANDS: dict[str, Callable[[Path, Path], list[list[str]]]] = {
    "ingest-fringe-raws": ingest,
    "define-fringe-night": night,
    "adopt-sensor-datasets": adopt,
    "write-fringe-handoff": hand_off,
    "recover-fringe-repo": recover,
    "prepare-fringe-repo": prepare,
}


def shown(repo: Path) -> set[str]:
    """Everything that the repository shows: datasets, exposures, collections."""
    with Butler.from_config(str(repo)) as butler:
        found = {f"collection {name}" for name in butler.collections.query("*")}
        found |= {str(record) for record in butler.query_dimension_records("exposure", explain=False)}
        for kind in butler.registry.queryDatasetTypes("*"):
            if not kind.isComponent():
                found |= {repr(ref) for ref in butler.registry.queryDatasets(kind, collections="*")}
        return found


def test_no_subcommand_is_forgotten() -> None:
    assert {command.name for command in get_cli_subcommands()} == set(SUBCOMMANDS)


@pytest.mark.middleware
@pytest.mark.parametrize("name", sorted(SUBCOMMANDS))
def test_a_subcommand_changes_nothing_the_second_time(name: str, tmp_path: Path) -> None:
    repo, folder = tmp_path / "repo", tmp_path / "files"
    folder.mkdir()
    Butler.makeRepo(str(repo), config=Config("resource://lsst.fringe_sim/configs/butler.yaml"))
    with Butler.from_config(str(repo), writeable=True) as butler:
        for instrument in (Ts8Fringe, LsstCamFringe):
            instrument().register(butler.registry)
    for arguments in SUBCOMMANDS[name](repo, folder):
        first = LogCliRunner().invoke(butler_cli, arguments)
        assert first.exit_code == 0, first.output
        there, files = shown(repo), contents(folder)
        again = LogCliRunner().invoke(butler_cli, arguments)
        # A hand-off into a folder that has one is refused; all else is done already.
        assert again.exit_code == (1 if name == "write-fringe-handoff" else 0), again.output
        assert shown(repo) == there
        assert contents(folder) == files
