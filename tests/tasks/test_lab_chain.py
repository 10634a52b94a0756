"""From raw files to thickness maps with the real commands on a real repository."""

import datetime
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from lsst.daf.butler import Butler
from task_commands import WAVELENGTHS_NM, Command, Outcome

from lsst.fringe_sim.cli.main import run as run_short
from lsst.fringe_sim.middleware.night import NightPlan, define_night
from lsst.fringe_sim.middleware.repository import recover_repository
from lsst.fringe_sim.mock.raw_frames import MockRun

pytestmark = [pytest.mark.middleware, pytest.mark.slow]

PIPELINE = "resource://lsst.fringe_sim/pipelines/ts8/labFlats.yaml"
DETECTORS = {"RTM-020_S01": 145, "RTM-006_S11": 40}
GOOD, BAD = "RTM-020_S01", "RTM-006_S11"
BAD_NM = 930.0

# The sensors are so small that a kernel of 3 px is a good part of a fringe.
CONFIG = ("-c", "isrFlatPrep:smoothing_sigma_px=1", "-c", "isrFlatPrep:edge_px=2")


def run_lab(
    command: Command, repo: Path, out: str, *extra: object, inputs: str = "LSST-TS8/raw/all"
) -> Outcome:
    where = ("-d", "instrument = 'LSST-TS8'") if "-d" not in extra else ()
    arguments = ("-b", repo, "-i", inputs, "-o", out, *where, "-j", "1", "--register-dataset-types")
    pipeline = () if "-p" in extra else ("-p", PIPELINE, *CONFIG)
    return command("pipetask", "run", *arguments, *pipeline, *extra)


@pytest.fixture(scope="module")
def rafts_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one raft has of its own, for a run of all rafts."""
    path = tmp_path_factory.mktemp("config") / "rafts.py"
    path.write_text(
        "from lsst.fringe_sim.tasks import RaftConfig\n"
        "config.rafts['RTM-020'] = RaftConfig()\n"
        "config.rafts['RTM-020'].effects['bandwidth.fwhm'] = 2.01\n"
    )
    return path


@pytest.fixture(scope="module")
def spoiled(raws: dict[str, MockRun], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Folder of raw frames in which one flat of one sensor saw no light; that file, and what it should be."""
    folder = tmp_path_factory.mktemp("spoiled")
    for name, run in raws.items():
        shutil.copytree(run.paths[0].parent, folder / name)
    run = raws[BAD]
    flat = next(item.path for item in run.flats if item.wavelength_nm == BAD_NM)
    dark = folder / BAD / flat.name
    with fits.open(dark, mode="update") as frame, fits.open(run.bias[0].path) as bias:
        for number in range(1, 17):
            frame[number].data = bias[number].data
    return folder, dark, flat


@pytest.fixture(scope="module")
def first_run(
    command: Command,
    empty_repo: Path,
    spoiled: tuple[Path, Path, Path],
    rafts_file: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Outcome]:
    """Repository after a run in which one flat could not be used."""
    repo = Path(shutil.copytree(empty_repo, tmp_path_factory.mktemp("lab") / "repo"))
    ingested = command("butler", "ingest-fringe-raws", repo, spoiled[0], "--transfer", "direct")
    assert ingested.code == 0, ingested.text
    return repo, run_lab(command, repo, "u/lab", "-C", f"epoxyFit:{rafts_file}")


@pytest.fixture(scope="module")
def second_run(
    command: Command,
    first_run: tuple[Path, Outcome],
    spoiled: tuple[Path, Path, Path],
    rafts_file: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Outcome]:
    """Another repository, in which the frame was sent again and what had failed has run again."""
    repo = Path(shutil.copytree(first_run[0], tmp_path_factory.mktemp("lab") / "repo"))
    _, dark, flat = spoiled
    shutil.copyfile(flat, dark)
    return repo, run_lab(
        command, repo, "u/lab", "-C", f"epoxyFit:{rafts_file}", "--skip-existing-in", "u/lab"
    )


def fitted(repo: Path, collection: str) -> set[int]:
    with Butler.from_config(str(repo)) as butler:
        refs = butler.query_datasets("epoxyThickness", collections=collection, explain=False)
        return {int(ref.dataId["detector"]) for ref in refs}


def test_a_bad_sensor_fails_alone_and_says_why(first_run: tuple[Path, Outcome]) -> None:
    repo, outcome = first_run
    assert outcome.code == 1, outcome.text
    assert fitted(repo, "u/lab") == {DETECTORS[GOOD]}
    said = next(line for line in outcome.text.splitlines() if "UnusableDataError: " in line)
    assert f"UnusableDataError: {BAD}, exposure 2018" in said
    assert "signal" in said
    with Butler.from_config(str(repo), collections="u/lab") as butler:
        flats = butler.query_datasets("fringeFlat")
    assert len(flats) == len(DETECTORS) * len(WAVELENGTHS_NM) - 1


def test_what_could_be_fitted_is_the_truth(first_run: tuple[Path, Outcome], raws: dict[str, MockRun]) -> None:
    repo, _ = first_run
    with Butler.from_config(str(repo), collections="u/lab", instrument="LSST-TS8") as butler:
        found = butler.get("epoxyThickness", detector=DETECTORS[GOOD])
    good = found.mask == 0
    assert good.mean() > 0.85
    error_nm = 1e3 * np.abs(found.value - raws[GOOD].truth.thickness_um)[good]
    assert np.median(error_nm) < 3.0
    assert (error_nm > 150.0).mean() == 0.0
    assert found.detector == GOOD


def test_headers_tell_what_entered(first_run: tuple[Path, Outcome]) -> None:
    repo, _ = first_run
    with Butler.from_config(str(repo), collections="u/lab", instrument="LSST-TS8") as butler:
        found = butler.get("epoxyThickness", detector=DETECTORS[GOOD]).metadata
        inputs = {
            str(ref.id) for ref in butler.query_datasets("fringeFlat", where=f"detector = {DETECTORS[GOOD]}")
        }
    number = len(WAVELENGTHS_NM)
    assert {found[f"LSST BUTLER INPUT {n} ID"] for n in range(number)} == inputs
    assert found["LSST BUTLER N_INPUTS"] == number
    assert (found["SETUP"], found["METHOD"], found["NFLATS"]) == ("ts8_e2v", "global", number)
    assert found["MISSING"] == ""
    assert found["FSIMVER"]
    assert 0.0 < found["QUADERR"] < found["INTERR"] < 1e-4


def test_one_command_tells_what_a_dataset_was_made_from(
    first_run: tuple[Path, Outcome], capsys: pytest.CaptureFixture[str]
) -> None:
    repo, _ = first_run
    arguments = ["--dataset-type", "epoxyThickness", "--collections", "u/lab", "--json"]
    assert run_short(["provenance", str(repo), *arguments]) == 0
    (record,) = json.loads(capsys.readouterr().out)
    assert record["setup"] == "ts8_e2v"
    assert record["effects"] == {"bandwidth.fwhm": 2.01}
    assert len(record["configuration"]["this task"]) == 16
    assert len(record["inputs"]) == len(WAVELENGTHS_NM)
    for item in record["inputs"]:
        assert (item["datasettype"], item["run"][:6]) == ("fringeFlat", "u/lab/")
        assert f"'detector': {DETECTORS[GOOD]}" in item["data id"]
    assert {item["here"] for item in record["tables"]} == {"same"}


def test_only_what_failed_runs_again(second_run: tuple[Path, Outcome]) -> None:
    repo, outcome = second_run
    assert outcome.code == 0, outcome.text
    assert "Executed 2 quanta successfully, 0 failed and 0 remain" in outcome.text
    assert fitted(repo, "u/lab") == set(DETECTORS.values())


def runs_of(repo: Path, out: str) -> list[str]:
    with Butler.from_config(str(repo)) as butler:
        return list(butler.collections.query(f"{out}/*"))


def killed_after_one_map(repo: Path, out: str) -> None:
    """Start the fit of both sensors and kill it, without warning, as soon as one of them is done.

    The metadata of a quantum are written last, and tell that it is complete.
    """
    program = Path(sys.executable).with_name("pipetask")
    arguments = ("-b", repo, "-i", "u/lab", "-o", out, "-p", f"{PIPELINE}#epoxyFit")
    where = ("-d", "instrument = 'LSST-TS8'", "-j", "1", "--register-dataset-types")
    fit = subprocess.Popen(
        [program, "run", *arguments, *where],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )
    try:
        while fit.poll() is None and not list((repo / out).rglob("epoxyFit_metadata_*")):
            time.sleep(0.005)
        time.sleep(0.05)  # the file is there a little before the registry knows it
    finally:
        fit.kill()
        fit.wait()
    recover_repository(str(repo))


def complete(repo: Path, run: str) -> int:
    """Number of fits of which all outputs are there."""
    with Butler.from_config(str(repo), collections=run) as butler:
        return len(butler.query_datasets("epoxyFit_metadata", explain=False))


def test_a_killed_fit_loses_only_the_sensor_it_was_in(
    command: Command, second_run: tuple[Path, Outcome]
) -> None:
    repo, _ = second_run
    for number in range(5):
        out = f"u/killed{number}"
        killed_after_one_map(repo, out)
        (run,) = runs_of(repo, out)
        if (
            complete(repo, run) == 1
        ):  # else the signal came too late, or before the registry knew of the first
            break
    assert complete(repo, run) == 1
    (kept,) = fitted(repo, run)
    (file,) = (repo / run).rglob("epoxyThickness_*.fits")
    before = file.stat().st_mtime_ns
    outcome = command(
        *("pipetask", "run", "-b", repo, "-i", "u/lab", "-o", out, "-p", f"{PIPELINE}#epoxyFit"),
        *("-d", "instrument = 'LSST-TS8'", "-j", "1", "--skip-existing-in", run),
    )
    assert outcome.code == 0, outcome.text
    assert "Executed 1 quanta successfully, 0 failed and 0 remain" in outcome.text
    (later,) = set(runs_of(repo, out)) - {run}
    assert fitted(repo, later) == set(DETECTORS.values()) - {kept}
    assert file.stat().st_mtime_ns == before
    with Butler.from_config(str(repo), collections=run, instrument="LSST-TS8") as butler:
        assert (butler.get("epoxyThickness", detector=kept).mask == 0).mean() > 0.85


def test_override_of_one_raft_within_a_run_of_all(second_run: tuple[Path, Outcome]) -> None:
    repo, _ = second_run
    with Butler.from_config(str(repo), collections="u/lab", instrument="LSST-TS8") as butler:
        own = butler.get("epoxyThickness", detector=DETECTORS["RTM-020_S01"]).metadata
        other = butler.get("epoxyThickness", detector=DETECTORS["RTM-006_S11"]).metadata
    assert (own["EFFECT0"], own["EFFVAL0"]) == ("bandwidth.fwhm", 2.01)
    assert "EFFECT0" not in other


def test_override_of_one_raft_in_a_run_of_its_own(command: Command, second_run: tuple[Path, Outcome]) -> None:
    repo, _ = second_run
    file = Path(__file__).parents[2] / "config" / "ts8" / "rafts" / "RTM-020.py"
    outcome = run_lab(
        command,
        repo,
        "u/raft",
        *("-p", f"{PIPELINE}#epoxyFit"),
        *("-C", f"epoxyFit:{file}"),
        *("-d", "instrument = 'LSST-TS8' AND detector.raft = 'RTM-020'"),
        inputs="u/lab",
    )
    assert outcome.code == 0, outcome.text
    with Butler.from_config(str(repo), collections="u/raft") as butler:
        assert butler.get("epoxyFit_config").min_wavelengths == 8
        run = butler.query_datasets("epoxyFit_config")[0].run
    # The chain holds the maps of its input too; the run of its own has those of the raft alone.
    assert fitted(repo, run) == {DETECTORS["RTM-020_S01"]}


def test_from_the_stand_to_the_sky(command: Command, second_run: tuple[Path, Outcome]) -> None:
    """The camera adopts the map; its sky frames and template follow."""
    repo, _ = second_run
    with Butler.from_config(str(repo), writeable=True) as butler:
        define_night(butler, "LSSTCam", [NightPlan(datetime.date(2026, 1, 15), (20.0, 23.0))])
    adopted = command(
        "butler", "adopt-sensor-datasets", repo, "epoxyThickness", "u/lab", "LSSTCam", "u/adopted"
    )
    assert adopted.code == 0, adopted.text
    outcome = command(
        *("pipetask", "run", "-b", repo, "-i", "u/adopted", "-o", "u/sky"),
        *("-p", "resource://lsst.fringe_sim/pipelines/lsstCam/skyFringe.yaml"),
        *("-d", "instrument = 'LSSTCam' AND detector.raft = 'R11'", "-j", "1", "--register-dataset-types"),
    )
    # The map of this raft was fitted with an effect of the lamp only, which the sky does not know.
    assert outcome.code == 0, outcome.text
    with Butler.from_config(str(repo), collections="u/sky", instrument="LSSTCam") as butler:
        sky = butler.get(butler.query_datasets("skyFringe")[0])
        template = butler.get("fringe", detector=37, physical_filter="y_10")
        (ref,) = butler.query_datasets("epoxyThickness", collections="u/adopted", where="detector = 37")
    assert sky.metadata["LSST BUTLER INPUT 0 ID"] == str(ref.id)
    assert (sky.detector, template.detector) == ("R11_S01", "R11_S01")
    assert np.isfinite(template.image).all()
    assert abs(template.image[template.mask == 0].mean(dtype=float)) < 1e-6
