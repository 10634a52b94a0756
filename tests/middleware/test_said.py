"""Every line that the commands for repositories print, on which stream, and what headers become."""

from __future__ import annotations

import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from astro_metadata_translator import ObservationInfo
from lsst.daf.butler import Butler, ButlerConfig, DatasetType
from lsst.resources import ResourcePath
from product_makers import thickness
from raw_frame_maker import LSSTCAM_HEADER, write_raw
from toy_repository import Invoke, put_fringe

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.raw_frame import read_raw_header
from lsst.fringe_sim.middleware import raw_ingest
from lsst.fringe_sim.middleware.instruments import INSTRUMENTS, _warn_unprepared
from lsst.fringe_sim.middleware.night import NightPlan, define_night
from lsst.fringe_sim.middleware.raw_ingest import examine, ingest_raws
from lsst.fringe_sim.middleware.translators import TRANSLATORS

pytestmark = pytest.mark.middleware


@pytest.fixture
def say(invoke: Invoke, tmp_path: Path) -> Any:
    """Exit status and both streams of a command, with the folder of the test left out."""

    def said(*arguments: object) -> tuple[int, list[str], list[str]]:
        result = invoke(*arguments)
        out, err = (text.replace(str(tmp_path), "…").splitlines() for text in (result.stdout, result.stderr))
        return result.exit_code, out, err

    return said


def test_raw_frames(repo: Path, tmp_path: Path, say: Any) -> None:
    raw = tmp_path / "raw"
    raw.mkdir()
    write_raw(raw / "a.fits", {"DATE-OBS": "2018-07-24T10:28:45.342"})
    write_raw(
        raw / "b.fits", {"TSTAND": None, "DATE-OBS": "2018-07-24T11:00:00.0", "SEQNUM": 18, "MONOWL": 884.0}
    )
    (raw / "c.fits").write_text("text")
    taken = "1 raw frames: neither INSTRUME nor TSTAND = TS8 in the header: taken as a frame of ts8"
    status, out, err = say("ingest-fringe-raws", repo, raw, "--dry-run")
    assert status == 1
    assert out == [
        "…/raw/a.fits: LSST-TS8 RTM-020_S01 exposure 201807241028453 flat monochromator 0960.030 nm",
        "…/raw/b.fits: LSST-TS8 RTM-020_S01 exposure 201807241100000 flat monochromator 0884.000 nm",
        "2 raw frames would be ingested into LSST-TS8/raw/all; 0 were there already; 1 refused",
    ]
    assert err[0].startswith("refused: …/raw/c.fits: file is")
    assert err[-1].startswith(taken)
    (raw / "c.fits").unlink()
    assert say("ingest-fringe-raws", repo, raw, "--output-run", "u/raw", "--transfer", "direct")[:2] == (
        0,
        ["2 raw frames ingested into u/raw; 0 were there already; 0 refused"],
    )
    status, out, err = say("ingest-fringe-raws", repo, raw, "--output-run", "u/raw", "--transfer", "direct")
    assert (status, out) == (0, ["0 raw frames ingested into u/raw; 2 were there already; 0 refused"])
    assert err[-1].startswith(taken)
    (tmp_path / "d.fits").write_text("text")
    assert say("ingest-fringe-raws", repo, tmp_path / "d.fits")[1] == [
        "0 raw frames ingested into no run; 0 were there already; 1 refused"
    ]


def test_nights(repo: Path, say: Any) -> None:
    night = (
        "define-fringe-night",
        repo,
        "HSC",
        "--date",
        "20261121",
        "--hours",
        "23:24:0.5",
        "--airmass",
        "1.5",
    )
    lines = [
        f"exposure {7026112100000 + minute}  night sky {hour} h  HSC-Y  12.5 s"
        for minute, hour in ((660, "23.00"), (690, "23.50"), (720, "24.00"))
    ]
    assert say(*night, "--exposure-time", "12.5", "-n") == (
        0,
        [*lines, "3 exposures would be registered"],
        [],
    )
    assert say(*night, "--exposure-time", "12.5") == (0, [*lines, "3 exposures registered"], [])


def test_records_of_a_night(butler: Butler) -> None:
    """All of a record: the middle of the exposure is the hour that was asked for, in TAI 37 s after UTC."""
    (record,) = define_night(
        butler,
        "LSSTCam",
        [NightPlan(datetime.date(2026, 11, 21), (25.5,), 30.0, 2.0)],
        dry_run=True,
    )
    span = record.pop("timespan")
    assert (span.begin.scale, span.end.scale) == ("tai", "tai")
    assert span.begin.isot == "2026-11-22T05:30:22.000000"
    assert span.end.isot == "2026-11-22T05:30:52.000000"
    assert record.pop("zenith_angle") == pytest.approx(60.0)
    assert record == {
        "instrument": "LSSTCam",
        "id": 7026112100810,
        "obs_id": "LSSTCam_S_20261121_000810",
        "group": "20261121_night",
        "day_obs": 20261121,
        "physical_filter": "y_10",
        "exposure_time": 30.0,
        "dark_time": 30.0,
        "observation_type": "science",
        "observation_reason": "night sky",
        "seq_num": 810,
        "seq_start": 810,
        "seq_end": 810,
        "target_name": "night sky 25.50 h",
        "science_program": "night sky simulation",
        "has_simulated": True,
        "can_see_sky": True,
    }
    assert list(butler.query_dimension_records("exposure", explain=False)) == []


def test_fringe_frames_and_maps_of_others(repo: Path, tmp_path: Path, say: Any) -> None:
    with Butler.from_config(str(repo), writeable=True) as butler:
        put_fringe(butler, "u/fringe", (37, 94))
        kind = DatasetType(
            "epoxyThickness", ("instrument", "detector"), "ThicknessMap", universe=butler.dimensions
        )
        butler.registry.registerDatasetType(kind)
        butler.collections.register("lab")
        for number, detector in enumerate((145, 0)):
            butler.put(thickness(number=number), kind, instrument="LSST-TS8", detector=detector, run="lab")
    status, out, err = say("write-fringe-handoff", repo, "u/fringe", tmp_path / "out", "--dry-run")
    assert (status, err) == (0, [])
    assert len(out) == 3
    assert [("37" in line, "94" in line) for line in out[:2]] == [(True, False), (False, True)]
    assert out[2] == "2 fringe frames would be written to …/out"
    assert not (tmp_path / "out").exists()
    assert say("write-fringe-handoff", repo, "u/fringe", tmp_path / "out")[1][2] == (
        "2 fringe frames written to …/out"
    )
    adopt = ("adopt-sensor-datasets", repo, "epoxyThickness", "lab", "LSSTCam", "camera")
    homeless = ["not in LSSTCam: RTM-002_S00"]
    line = "epoxyThickness LSSTCam 37"
    assert say(*adopt, "-n") == (
        0, [line, "1 datasets would be adopted into camera; 0 were there already"], homeless
    )  # fmt: skip
    assert say(*adopt) == (0, [line, "1 datasets adopted into camera; 0 were there already"], homeless)
    assert say(*adopt) == (0, ["0 datasets adopted into camera; 1 were there already"], homeless)


def test_prepared_and_in_order(repo: Path, tmp_path: Path, say: Any) -> None:
    other = tmp_path / "other"
    Butler.makeRepo(str(other))
    status, out, err = say("prepare-fringe-repo", other)
    assert (status, err) == (0, [])
    assert len(out) == 1
    assert out[0].startswith("…/other: added ")
    words = out[0].removeprefix("…/other: added ").split(", ")
    assert len(words) == len(set(words)) > 5
    assert "RawFrame" in words
    assert not {"storageClasses", "datastore", "formatters"} & set(words)
    assert say("prepare-fringe-repo", other) == (0, ["…/other: nothing is missing"], [])
    assert say("recover-fringe-repo", repo) == (0, ["…/repo: the registry is in order"], [])


SAID = {
    "instrument": "LSST-TS8",
    "exposure_id": 201807241028453,
    "visit_id": 201807241028453,
    "exposure_group": "201807241028453",
    "observing_day": 20180724,
    "observation_id": "LSST-TS8_201807241028453",
    "observation_counter": 17,
    "group_counter_start": 17,
    "group_counter_end": 17,
    "observation_type": "flat",
    "observation_reason": "lambda",
    "object": "0960.030 nm",
    "science_program": "6006D",
    "physical_filter": "monochromator",
    "can_see_sky": False,
    "boresight_airmass": None,
    "detector_num": 145,
    "detector_name": "S01",
    "detector_group": "RTM-020",
    "detector_unique_name": "RTM-020_S01",
    "detector_serial": "E2V-CCD250-321",
    "detector_exposure_id": 201807241028453145,
    "ext_wavelength_nm": 960.03,
    "has_simulated_content": False,
}


def test_a_header_as_the_middleware_has_it(tmp_path: Path) -> None:
    header = read_raw_header(str(write_raw(tmp_path / "raw.fits")))
    info = ObservationInfo(header, translator_class=TRANSLATORS["ts8"], pedantic=True)
    assert {name: getattr(info, name) for name in SAID} == SAID
    assert info.exposure_time.to_value("s") == info.dark_time.to_value("s") == 21.9
    assert info.exposure_time_requested.to_value("s") == 21.9
    assert info.ext_temperature_k == pytest.approx(182.65)
    assert info.datetime_begin.isot == "2018-07-24T10:28:45.342"
    assert info.datetime_end.isot == "2018-07-24T10:29:07.242"
    assert info.observing_day_offset.to_value("s") == 8 * 3600
    about = {"IMGTYPE": "OBJECT", "AMSTART": 2.0}
    header = read_raw_header(str(write_raw(tmp_path / "sky.fits", about, base=LSSTCAM_HEADER)))
    info = ObservationInfo(header, translator_class=TRANSLATORS["lsstCam"], pedantic=True)
    assert (info.observation_id, info.object, info.physical_filter) == (
        "MC_C_20211212_000310",
        "none",
        "y_10",
    )
    assert (info.dark_time.to_value("s"), info.can_see_sky, info.boresight_airmass) == (15.2, True, 2.0)


@pytest.mark.parametrize("place", [0.02, 0.5, 1.0])
def test_a_frame_that_differs_in_one_part_is_another(place: float, butler: Butler, tmp_path: Path) -> None:
    """Wherever that part is, from the first bytes of the pixels to the last of the file."""
    path = write_raw(tmp_path / "raw.fits")
    assert len(ingest_raws(butler, [str(path)], transfer="copy").ingested) == 1
    content = bytearray(path.read_bytes())
    first = int(place * (len(content) - 8192))
    content[first + 5760 : first + 8192] = bytes(255 - byte for byte in content[first + 5760 : first + 8192])
    copied = ingest_raws(butler, [str(path)], transfer="copy")
    assert (len(copied.present), copied.refused) == (1, ())
    raw = tmp_path / "other.fits"
    raw.write_bytes(content)
    report = ingest_raws(butler, [str(raw)], transfer="copy")
    assert (len(report.ingested), len(report.present)) == (0, 0)
    assert len(report.refused) == 1
    raw.write_bytes(path.read_bytes() + bytes(2880))
    assert len(ingest_raws(butler, [str(raw)], transfer="copy").refused) == 1


def test_blocks_that_are_compared_lie_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first byte to the last; what lies between two blocks is not looked at."""
    monkeypatch.setattr(raw_ingest, "COMPARED_BLOCKS", 5)
    monkeypatch.setattr(raw_ingest, "COMPARED_BYTES", 10)
    stored, other = tmp_path / "stored", tmp_path / "other"
    stored.write_bytes(bytes(1010))
    for begin in (0, 250, 500, 750, 1000):
        for place, same in ((begin, False), (begin + 9, False), (begin + 10, True)):
            if place < 1010:
                other.write_bytes(bytes(place) + b"x" + bytes(1009 - place))
                assert raw_ingest._same_content(str(other), ResourcePath(str(stored))) is same
    other.write_bytes(bytes(1011))
    assert not raw_ingest._same_content(str(other), ResourcePath(str(stored)))


def test_the_repository_that_lacks_something_is_named(tmp_path: Path, caplog) -> None:
    """Where an instrument is registered; by its folder, if it is known."""
    Butler.makeRepo(str(tmp_path / "bare"))
    config = ButlerConfig(str(tmp_path / "bare"))
    registry = SimpleNamespace(_butler=SimpleNamespace(_config=config))
    _warn_unprepared(registry)
    said = caplog.records[-1].getMessage()
    assert f"prepare-fringe-repo {tmp_path / 'bare'}" in said.replace("//", "/")
    assert "without" in said
    assert " formatters," not in said.partition("without")[2]
    config.configFile = None
    _warn_unprepared(registry)
    assert "prepare-fringe-repo REPO" in caplog.records[-1].getMessage()
    _warn_unprepared(SimpleNamespace())
    assert len(caplog.records) == 2


def test_headers_that_are_of_no_instrument() -> None:
    for translator in TRANSLATORS.values():
        for known in ({"INSTRUME": "other"}, {}):
            assert not translator.can_translate(known)
    for name, source in (("a.fits", "a.fits"), (None, "header")):
        with pytest.raises(InputError, match=f"{source}: INSTRUME is"):
            TRANSLATORS["ts8"]({"INSTRUME": "other"}, filename=name).to_exposure_id()


def test_where_an_instrument_is_not_registered(tmp_path: Path) -> None:
    path = str(write_raw(tmp_path / "raw.fits"))
    known = {cls.getName(): cls for cls in INSTRUMENTS.values()}
    assert examine(path, known).data_id == {
        "instrument": "LSST-TS8",
        "exposure": 201807241028453,
        "detector": 145,
    }
    del known["LSST-TS8"]
    for names, said in ((known, "HSC, LSSTCam, MonoCam"), ({}, "there is none")):
        with pytest.raises(
            Exception, match=rf"knows \({said}\); butler register-instrument REPO .*Ts8Fringe"
        ):
            examine(path, names)
