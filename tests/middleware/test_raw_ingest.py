import datetime
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astro_metadata_translator import ObservationInfo
from astropy.io import fits
from lsst.daf.butler import Butler, DatasetType
from lsst.resources import ResourcePath
from raw_frame_maker import LSSTCAM_HEADER, write_raw
from toy_repository import Invoke

from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.instrument.raw_files import find_raw_files
from lsst.fringe_sim.instrument.raw_frame import RawFrame, read_raw_header
from lsst.fringe_sim.middleware import Ts8Fringe, get_cli_subcommands, raw_ingest
from lsst.fringe_sim.middleware.adoption import adopt_datasets
from lsst.fringe_sim.middleware.night import NightPlan, airmass_of, define_night
from lsst.fringe_sim.middleware.raw_ingest import IngestReport, ingest_raws
from lsst.fringe_sim.middleware.translators import TRANSLATORS

pytestmark = pytest.mark.middleware

REAL_FRAME = "measured/ts8_raw_201807241028453-RTM-010-S11-det067.fits"


def series(folder: Path, wavelengths: tuple[float, ...] = (880.0, 960.03, 990.0)) -> list[Path]:
    """Two bias frames and flats, ten seconds apart."""
    folder.mkdir(parents=True, exist_ok=True)
    headers: list[dict[str, Any]] = [{"IMGTYPE": "BIAS", "TESTTYPE": "BIAS", "EXPTIME": 0.0}] * 2
    headers += [{"MONOWL": nm} for nm in wavelengths]
    return [
        write_raw(
            folder / f"raw_{number}.fits",
            {**header, "DATE-OBS": f"2018-07-24T10:{number:02d}:45.3", "SEQNUM": number},
        )
        for number, header in enumerate(headers)
    ]


def exposures(butler: Butler, where: str = "") -> list[Any]:
    instrument = "instrument='LSST-TS8'"
    return sorted(
        butler.query_dimension_records(
            "exposure", where=f"{instrument} AND {where}" if where else instrument, explain=False
        ),
        key=lambda record: record.id,
    )


def raws(butler: Butler, run: str = "LSST-TS8/raw/all") -> list[Any]:
    return butler.query_datasets("raw", collections=run, explain=False)


# From the headers to the records


def test_exposures_are_found_by_kind_and_by_wavelength(butler: Butler, tmp_path: Path) -> None:
    series(tmp_path / "raw")
    report = ingest_raws(butler, [str(tmp_path / "raw")])
    assert (len(report.ingested), len(report.present), report.refused) == (5, 0, ())
    assert report.run == {"LSST-TS8": "LSST-TS8/raw/all"}
    assert len(raws(butler)) == 5
    assert len(exposures(butler, "exposure.observation_type = 'bias'")) == 2
    flats = exposures(butler, "exposure.observation_type = 'flat'")
    assert [record.target_name for record in flats] == ["0880.000 nm", "0960.030 nm", "0990.000 nm"]
    assert {record.physical_filter for record in flats} == {"monochromator"}
    some = exposures(butler, "exposure.target_name >= '0900' AND exposure.target_name < '0985'")
    assert [record.target_name for record in some] == ["0960.030 nm"]


def test_record_of_a_flat(butler: Butler, tmp_path: Path) -> None:
    ingest_raws(butler, [str(write_raw(tmp_path / "raw.fits"))])
    (record,) = exposures(butler)
    assert record.id == 201807241028453
    assert (record.day_obs, record.seq_num) == (20180724, 17)
    assert (record.observation_type, record.observation_reason) == ("flat", "lambda")
    assert (record.exposure_time, record.dark_time) == (21.9, 21.9)
    assert record.science_program == "6006D"
    assert record.can_see_sky is False
    assert record.timespan.begin.tai.isot.startswith("2018-07-24T10:28:45.342")
    (ref,) = raws(butler)
    assert dict(ref.dataId.required) == {
        "instrument": "LSST-TS8",
        "detector": 145,
        "exposure": 201807241028453,
    }
    assert butler.registry.expandDataId(ref.dataId).records["detector"].full_name == "RTM-020_S01"


def test_frames_of_the_camera_go_to_the_camera(butler: Butler, tmp_path: Path) -> None:
    camera = {key: value for key, value in LSSTCAM_HEADER.items() if key != "OBSID"}
    write_raw(
        tmp_path / "bias.fits", {"IMGTYPE": "BIAS", "EXPTIME": 0.0, "FILTER": None, "SEQNUM": 1}, base=camera
    )
    write_raw(tmp_path / "y.fits", {"FILTER": "y_04", "SEQNUM": 2}, base=camera)
    write_raw(tmp_path / "lambda.fits", {"FILTER": None, "MONOWL": 950.0, "SEQNUM": 3}, base=camera)
    write_raw(tmp_path / "stand.fits")
    report = ingest_raws(butler, [str(tmp_path)])
    assert report.refused == ()
    assert set(report.run) == {"LSSTCam", "LSST-TS8"}
    records = butler.query_dimension_records("exposure", instrument="LSSTCam")
    assert {record.physical_filter for record in records} == {"none", "y_04", "monochromator"}
    assert len(raws(butler, "LSSTCam/raw/all")) == 3


def test_what_is_taken_for_granted_is_said(repo: Path, tmp_path: Path, invoke: Invoke) -> None:
    """Without INSTRUME and TSTAND the other keywords decide about sensor and exposure number."""
    write_raw(tmp_path / "raw.fits", {"TSTAND": None})
    result = invoke("ingest-fringe-raws", str(repo), str(tmp_path / "raw.fits"))
    assert (
        "1 raw frames: neither INSTRUME nor TSTAND = TS8 in the header: taken as a frame of ts8"
        in result.output
    )


def test_the_airmass_reaches_the_record(butler: Butler, tmp_path: Path) -> None:
    about = {"IMGTYPE": "OBJECT", "AMSTART": 1.2}
    write_raw(tmp_path / "raw.fits", about, base=LSSTCAM_HEADER)
    ingest_raws(butler, [str(tmp_path / "raw.fits")])
    (record,) = butler.query_dimension_records("exposure", instrument="LSSTCam")
    assert airmass_of(record) == pytest.approx(1.2)


def test_translators_are_chosen_by_the_header(tmp_path: Path) -> None:
    for base, camera in ((None, "ts8"), (LSSTCAM_HEADER, "lsstCam")):
        path = write_raw(tmp_path / f"{camera}.fits", **({} if base is None else {"base": base}))
        info = ObservationInfo(read_raw_header(path), filename=str(path), pedantic=True)
        assert info.translator_class_name == TRANSLATORS[camera].__name__
        assert info.ext_temperature_k == pytest.approx(182.65 if camera == "ts8" else 172.982)
    assert info.observation_id == "MC_C_20211212_000310"
    assert info.ext_wavelength_nm is None


@pytest.mark.shared
def test_the_real_frame_is_ingested_and_read_back(butler: Butler, shared_dir: Path) -> None:
    report = ingest_raws(butler, [str(shared_dir / REAL_FRAME)], transfer="direct")
    assert report.refused == ()
    (ref,) = raws(butler)
    assert ref.dataId["detector"] == 67
    frame = butler.get(ref)
    assert isinstance(frame, RawFrame)
    assert np.any(frame.amplifier("C00").data)


# What is there already, and what cannot be used


def test_a_folder_whose_run_was_stopped_is_not_ingested(butler: Butler, tmp_path: Path) -> None:
    (tmp_path / "raws").mkdir()
    (tmp_path / "raws" / ".fringe-sim.lock").touch()
    with pytest.raises(InputError, match="came to its end"):
        ingest_raws(butler, [str(tmp_path / "raws")])


def test_ingesting_again_changes_nothing(butler: Butler, tmp_path: Path) -> None:
    paths = series(tmp_path / "raw")
    ingest_raws(butler, [str(tmp_path / "raw")])
    before = {str(ref) for ref in raws(butler)}
    again = ingest_raws(butler, [str(tmp_path / "raw"), str(paths[0])])
    assert (len(again.ingested), len(again.present), again.refused) == (0, 5, ())
    assert {str(ref) for ref in raws(butler)} == before
    paths.append(write_raw(tmp_path / "raw" / "more.fits", {"DATE-OBS": "2018-07-24T11:00:00.0"}))
    more = ingest_raws(butler, [str(tmp_path / "raw")])
    assert (len(more.ingested), len(more.present)) == (1, 5)


@pytest.mark.parametrize("overtaken", [1, 2, 9])
def test_frames_that_another_process_stores_meanwhile(
    overtaken: int, repo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the look at what is there and the storing: found in the second look, however many are new."""
    series(tmp_path / "raw")
    look = raw_ingest._split_by_presence
    looks = 0

    def overtake(butler: Butler, exposures: Any, runs: Any) -> Any:
        nonlocal looks
        looks += 1
        found = look(butler, exposures, runs)
        if looks <= overtaken and found[0]:
            with monkeypatch.context() as other, Butler.from_config(str(repo), writeable=True) as process:
                other.setattr(raw_ingest, "_split_by_presence", look)
                ingest_raws(process, [found[0][0].path, found[0][-1].path], transfer="copy")
        return found

    monkeypatch.setattr(raw_ingest, "_split_by_presence", overtake)
    with Butler.from_config(str(repo), writeable=True) as butler:
        if overtaken < 3:
            report = ingest_raws(butler, [str(tmp_path / "raw")], transfer="copy")
            stored = 2 * overtaken
            assert (len(report.ingested), len(report.present), report.refused) == (5 - stored, stored, ())
            assert all(Path(butler.getURI(ref).ospath).is_file() for ref in raws(butler))
        else:
            monkeypatch.setattr(raw_ingest, "ATTEMPTS", 2)
            with pytest.raises(InputError, match="that no other process ingests at the same time"):
                ingest_raws(butler, [str(tmp_path / "raw")], transfer="copy")


@pytest.mark.parametrize("transfer", ["copy", "direct"])
def test_another_frame_in_the_same_place_is_refused(butler: Butler, tmp_path: Path, transfer: str) -> None:
    """A second series of the same hour tells the same in its headers: its pixels are others."""
    first, second = tmp_path / "first", tmp_path / "second"
    series(first)
    ingest_raws(butler, [str(first)], transfer=transfer)
    before = {str(ref) for ref in raws(butler)}
    shutil.copytree(first, second)
    changed = second / "raw_0.fits"
    with fits.open(changed, mode="update") as hdus:
        for hdu in hdus[1:]:
            hdu.data += 1
    report = ingest_raws(butler, [str(second)], transfer=transfer)
    assert (len(report.ingested), len(report.present), len(report.refused)) == (0, 4, 1)
    assert str(changed) in report.refused[0]
    assert "another frame of exposure 201807241000453" in report.refused[0]
    assert {str(ref) for ref in raws(butler)} == before
    assert len(ingest_raws(butler, [str(second)], transfer=transfer, run="u/second").ingested) == 5


def test_a_frame_whose_file_is_gone_is_there_already(butler: Butler, tmp_path: Path) -> None:
    """A second ingest does not mend the repository."""
    path = write_raw(tmp_path / "raw.fits")
    ingest_raws(butler, [str(path)], transfer="copy")
    (ref,) = raws(butler)
    Path(butler.getURI(ref).ospath).unlink()
    again = ingest_raws(butler, [str(path)], transfer="copy")
    assert (len(again.ingested), len(again.present), again.refused) == (0, 1, ())


def test_a_run_may_be_there_before_its_frames(butler: Butler, tmp_path: Path) -> None:
    """That of a night of the sky, before any raw frame and after the first ones."""
    path = str(write_raw(tmp_path / "raw.fits"))
    for run in ("first", "second"):
        butler.collections.register(run)
        assert len(ingest_raws(butler, [path], run=run, transfer="copy").ingested) == 1
    assert raw_ingest.raw_dataset_type(butler) == DatasetType(
        "raw", ("instrument", "exposure", "detector"), "RawFrame", universe=butler.dimensions
    )


def test_bad_files_stay_out_and_the_others_go_in(butler: Butler, tmp_path: Path) -> None:
    series(tmp_path)
    content = (tmp_path / "raw_0.fits").read_bytes()
    (tmp_path / "truncated.fits").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.fits").write_text("not a FITS file")
    write_raw(tmp_path / "wavelength.fits", {"MONOWL": None, "DATE-OBS": "2018-07-24T11:00:00.0"})
    write_raw(tmp_path / "sensor.fits", {"LSST_NUM": "E2V-CCD250-000", "RAFTNAME": None})
    write_raw(tmp_path / "filter.fits", {"FILTER": "pinhole"}, base=LSSTCAM_HEADER)
    report = ingest_raws(butler, [str(tmp_path), "nowhere/*.fits"])
    assert len(report.ingested) == len(raws(butler)) == 5
    found = "\n".join(report.refused)
    assert len(report.refused) == 6
    assert all("\n" not in message for message in report.refused)
    for part in (
        "truncated.fits: file is",
        "text.fits: file is",
        "wavelength.fits: MONOWL is None; allowed: a wavelength from 200 to 1300 nm",
        "sensor.fits: detector is 'E2V-CCD250-000'",
        "filter.fits: physical filter is 'pinhole'",
        "path is 'nowhere/*.fits'",
    ):
        assert part in found


@pytest.mark.parametrize(
    "header",
    [
        {"DATE-OBS": "2118-07-24T10:00:00"},
        {"DATE-OBS": "1918-07-24T10:00:00"},
        {"DATE-OBS": None, "MJD-OBS": 2458324.0},
        {"DATE-OBS": None, "MJD-OBS": -2458324.0},
    ],
)
def test_a_time_that_no_repository_holds_stops_one_file(
    header: dict[str, Any], butler: Butler, tmp_path: Path
) -> None:
    series(tmp_path / "raw")
    write_raw(tmp_path / "raw" / "wrong.fits", header)
    report = ingest_raws(butler, [str(tmp_path / "raw")])
    assert len(report.ingested) == 5
    (message,) = report.refused
    assert "wrong.fits" in message
    assert "\n" not in message


def test_instrument_that_is_not_registered_is_named(tmp_path: Path) -> None:
    from lsst.daf.butler import Config

    Butler.makeRepo(str(tmp_path / "repo"), config=Config("resource://lsst.fringe_sim/configs/butler.yaml"))
    path = write_raw(tmp_path / "raw.fits")
    with Butler.from_config(str(tmp_path / "repo"), writeable=True) as butler:
        (message,) = ingest_raws(butler, [str(path)]).refused
        with pytest.raises(UnknownNameError, match="nothing is registered"):
            define_night(butler, "LSSTCam", [NightPlan(datetime.date(2026, 11, 21), (20.0,))])
        with pytest.raises(UnknownNameError, match="nothing is registered"):
            adopt_datasets(butler, "epoxyThickness", ["lab"], "LSSTCam", "camera")
    assert "instrument is 'LSST-TS8'; allowed: one that the repository knows (there is none)" in message
    assert "lsst.fringe_sim.Ts8Fringe" in message


def test_raw_frames_of_another_package_are_left_alone(repo: Path, tmp_path: Path, invoke: Invoke) -> None:
    with Butler.from_config(str(repo), writeable=True) as butler:
        butler.registry.registerDatasetType(
            DatasetType("raw", ("instrument", "exposure", "detector"), "Exposure", universe=butler.dimensions)
        )
    result = invoke("ingest-fringe-raws", repo, write_raw(tmp_path / "raw.fits"))
    assert result.exit_code == 1
    assert "Error: dataset type is 'raw'; allowed: one of storage class RawFrame" in result.output


def contradiction(butler: Butler, tmp_path: Path, changes: dict[str, Any]) -> IngestReport:
    """Ingest a frame, then another one with the same start."""
    ingest_raws(butler, [str(write_raw(tmp_path / "first.fits"))])
    return ingest_raws(butler, [str(write_raw(tmp_path / "second.fits", changes))])


def test_exposure_that_the_repository_tells_otherwise_is_refused(butler: Butler, tmp_path: Path) -> None:
    other_sensor = {"LSST_NUM": "E2V-CCD250-319"}
    report = contradiction(butler, tmp_path, {**other_sensor, "MONOWL": 910.0})
    assert report.ingested == ()
    (message,) = report.refused
    assert "second.fits: exposure 201807241028453 of LSST-TS8 is in the repository with other" in message
    assert "0910.000 nm" in message
    assert exposures(butler)[0].target_name == "0960.030 nm"


def test_sensors_read_together_share_an_exposure(butler: Butler, tmp_path: Path) -> None:
    report = contradiction(butler, tmp_path, {"LSST_NUM": "E2V-CCD250-319"})
    assert report.refused == ()
    assert len(exposures(butler)) == 1
    assert sorted(ref.dataId["detector"] for ref in raws(butler)) == [144, 145]


def test_files_that_contradict_each_other_are_named(butler: Butler, tmp_path: Path) -> None:
    write_raw(tmp_path / "a.fits")
    write_raw(tmp_path / "b.fits", {"MONOWL": 910.0, "LSST_NUM": "E2V-CCD250-319"})
    write_raw(tmp_path / "c.fits")
    report = ingest_raws(butler, [str(tmp_path)])
    assert [Path(exposure.path).name for exposure in report.ingested] == ["a.fits"]
    assert len(report.refused) == 2
    assert (
        "b.fits: target_name of exposure 201807241028453 is '0910.000 nm'; allowed: 0960.030 nm"
        in (report.refused[0])
    )
    assert "c.fits: exposure and detector" in report.refused[1]


def test_nothing_is_stored_in_a_rehearsal(butler: Butler, tmp_path: Path) -> None:
    series(tmp_path / "raw")
    report = ingest_raws(butler, [str(tmp_path / "raw")], dry_run=True)
    assert len(report.ingested) == 5
    assert exposures(butler) == []
    assert "LSST-TS8/raw/all" not in butler.collections.query("*")


@pytest.mark.parametrize("transfer", ["copy", "direct", "symlink", "hardlink", "auto", "relsymlink"])
def test_ways_to_bring_files_in(butler: Butler, tmp_path: Path, transfer: str) -> None:
    path = write_raw(tmp_path / "raw.fits")
    ingest_raws(butler, [str(path)], transfer=transfer, run="u/someone/raw")
    (ref,) = raws(butler, "u/someone/raw")
    assert butler.get(ref).metadata.wavelength_nm == 960.03
    assert path.exists()


# Which files are meant


def test_files_directories_and_patterns(tmp_path: Path) -> None:
    (tmp_path / "deep" / "er").mkdir(parents=True)
    names = ["a.fits", "deep/b.fits.fz", "deep/er/c.fits.gz", "deep/er/d.fz", "deep/notes.txt"]
    for name in names:
        (tmp_path / name).touch()
    everything = [str(tmp_path / name) for name in names[:4]]
    assert find_raw_files([str(tmp_path)]) == (everything, [])
    assert find_raw_files([f"{tmp_path}/**/*.fits*"])[0] == everything[:3]
    assert find_raw_files([f"{tmp_path}/de*"])[0] == everything[1:]
    assert find_raw_files([everything[0], str(tmp_path), everything[0]])[0] == everything
    assert find_raw_files([f"{tmp_path}/deep/notes.txt"])[0] == [f"{tmp_path}/deep/notes.txt"]
    files, refused = find_raw_files([f"{tmp_path}/x*", str(tmp_path / "deep" / "nothing")])
    assert files == []
    assert len(refused) == 2


# The command


def test_command_reports_and_sets_its_exit_status(repo: Path, tmp_path: Path, invoke: Invoke) -> None:
    paths = series(tmp_path / "raw")
    rehearsal = invoke("ingest-fringe-raws", repo, tmp_path / "raw", "--dry-run")
    assert rehearsal.exit_code == 0, rehearsal.output
    assert "raw_3.fits: LSST-TS8 RTM-020_S01 exposure 201807241003453 flat monochromator 0960.030 nm" in (
        rehearsal.output
    )
    assert "5 raw frames would be ingested into LSST-TS8/raw/all; 0 were there already; 0 refused" in (
        rehearsal.output
    )
    first = invoke("ingest-fringe-raws", repo, *paths[:3], "--transfer", "copy")
    assert first.exit_code == 0, first.output
    (tmp_path / "raw" / "bad.fits").write_text("bad")
    second = invoke("ingest-fringe-raws", repo, tmp_path / "raw")
    assert second.exit_code == 1
    assert "2 raw frames ingested into LSST-TS8/raw/all; 3 were there already; 1 refused" in second.output
    assert second.output.count("refused: ") == 1
    nothing = invoke("ingest-fringe-raws", repo, tmp_path / "empty")
    assert nothing.exit_code == 1
    assert "path is" in nothing.output


def test_a_repository_of_others_is_prepared_first(
    tmp_path: Path, invoke: Invoke, caplog: pytest.LogCaptureFixture
) -> None:
    repo = tmp_path / "repo"
    Butler.makeRepo(str(repo))
    with Butler.from_config(str(repo), writeable=True) as butler:
        Ts8Fringe().register(butler.registry)
    assert f"butler prepare-fringe-repo {repo}" in caplog.text
    series(tmp_path / "raw")
    refused = invoke("ingest-fringe-raws", repo, tmp_path / "raw", "--transfer", "copy")
    assert refused.exit_code == 1
    assert "prepare-fringe-repo" in refused.output
    before = yaml.safe_load((repo / "butler.yaml").read_text())
    assert invoke("prepare-fringe-repo", repo).exit_code == 0
    after = yaml.safe_load((repo / "butler.yaml").read_text())
    assert after["registry"] == before["registry"]
    assert "nothing is missing" in invoke("prepare-fringe-repo", repo).output
    assert invoke("ingest-fringe-raws", repo, tmp_path / "raw", "--transfer", "copy").exit_code == 0
    caplog.clear()
    with Butler.from_config(str(repo), writeable=True) as butler:
        Ts8Fringe().register(butler.registry)
    assert not caplog.records
    with Butler.from_config(str(repo)) as butler:
        assert isinstance(butler.get(raws(butler)[0]), RawFrame)


def test_commands_say_when_there_is_no_repository(tmp_path: Path, invoke: Invoke) -> None:
    for command in (
        ("ingest-fringe-raws", tmp_path / "nothing", "raw.fits"),
        ("define-fringe-night", tmp_path, "LSSTCam", "--date", "20261121"),
        ("write-fringe-handoff", tmp_path, "collection", "out"),
    ):
        result = invoke(*command)
        assert result.exit_code == 1
        assert "Error: repository is" in result.output
        assert "Traceback" not in result.output


def test_commands_are_known_without_an_entry_point() -> None:
    """The file that an installation by EUPS names in DAF_BUTLER_PLUGINS has the same commands."""
    resource = ResourcePath("resource://lsst.fringe_sim/middleware/butler_commands.yaml")
    listed = yaml.safe_load(resource.read())["cmd"]
    commands = {command.name: command for command in get_cli_subcommands()}
    assert set(listed["commands"]) == set(commands)
    for name, command in commands.items():
        assert getattr(sys.modules[listed["import"]], name.replace("-", "_")) is command


def test_command_in_a_process_of_its_own(repo: Path, tmp_path: Path) -> None:
    """The entry point is installed, and the exit status reaches the shell."""
    (tmp_path / "bad.fits").write_text("bad")
    write_raw(tmp_path / "good.fits")
    butler = Path(sys.executable).with_name("butler")
    command = [butler, "ingest-fringe-raws", repo, tmp_path / "good.fits", tmp_path / "bad.fits"]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})
    assert result.returncode == 1
    assert "1 raw frames ingested" in result.stdout
    assert result.stderr.count("refused: ") == 1
    assert "Traceback" not in result.stderr


def test_translating_makes_no_noise(butler: Butler, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        series(tmp_path / "raw")
        ingest_raws(butler, [str(tmp_path / "raw")])
    assert caplog.records == []
