import datetime
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st
from raw_frame_maker import (
    LSSTCAM_HEADER,
    TS8_HEADER,
    header_with,
    random_image,
    raw_hdus,
    result_or_refusal,
    small_detector,
)

from lsst.fringe_sim.errors import FrameFormatError, InputError
from lsst.fringe_sim.instrument.raw_frame import OBSERVATION_TYPES, RawMetadata, read_raw_metadata


def interpret(changes: dict[str, Any] | None = None, base: dict[str, Any] = TS8_HEADER) -> RawMetadata:
    return RawMetadata.from_header(header_with(changes, base), source="raw.fits")


def test_flat_of_the_test_stand() -> None:
    metadata = interpret()
    assert metadata.camera == "ts8"
    assert metadata.observation_type == "flat"
    assert metadata.test_type == "lambda"
    assert metadata.wavelength_nm == 960.03
    assert metadata.bandpass_nm is None
    assert metadata.temperature_k == pytest.approx(182.65)
    assert (metadata.raft, metadata.slot, metadata.detector) == ("RTM-020", "S01", 145)
    assert metadata.exposure_id == 201807241028453
    assert metadata.day_obs == 20180724
    assert metadata.require_wavelength_nm() == 960.03


def test_flat_of_the_camera() -> None:
    metadata = interpret(base=LSSTCAM_HEADER)
    assert metadata.camera == "lsstCam"
    assert (metadata.raft, metadata.slot, metadata.detector) == ("R11", "S01", 37)
    assert metadata.exposure_id == 3021121200310  # as obs_lsst numbers MC_C_20211212_000310
    assert metadata.filter_name == "y_10"
    assert metadata.wavelength_nm is None
    assert metadata.dark_time_s == 15.2


@pytest.mark.parametrize(
    ("header", "camera"),
    [
        ({"INSTRUME": "lsstCam", "RAFTBAY": "R11", "CCDSLOT": "S01"}, "lsstCam"),
        ({"INSTRUME": "LSSTCam", "RAFTBAY": "R11", "SLOTNAME": "S01"}, "lsstCam"),
        ({"RAFTNAME": "R11", "SLOTNAME": "S01"}, "lsstCam"),
        ({"RAFTBAY": "R11", "CCDSLOT": "S01"}, "lsstCam"),
        ({"TSTAND": "TS8", "LSST_NUM": "E2V-CCD250-321"}, "ts8"),
        ({"TSTAND": "TS8", "RAFTNAME": "LCA-11021_RTM-020-Dev", "SLOTNAME": "S01"}, "ts8"),
        ({"TSTAND": "TS8", "RAFTBAY": "R11", "CCDSLOT": "S01"}, "ts8"),
        ({"RAFTNAME": "LCA-11021_RTM-020", "LSST_NUM": "E2V-CCD250-321-Dev"}, "ts8"),
        ({"LSST_NUM": "E2V-CCD250-321"}, "ts8"),
        ({"INSTRUME": "MonoCam"}, "monocam"),
    ],
)
def test_the_place_of_the_sensor_is_found(header: dict[str, Any], camera: str) -> None:
    base = {"IMGTYPE": "BIAS", "DATE-OBS": "2018-07-24T10:28:45.3"}
    metadata = RawMetadata.from_header({**base, **header}, source="raw.fits")
    assert metadata.camera == camera
    expected = {"lsstCam": ("R11", "S01"), "ts8": ("RTM-020", "S01"), "monocam": ("R00", "S00")}
    assert (metadata.raft, metadata.slot) == expected[camera]


@pytest.mark.parametrize("image_type", sorted(OBSERVATION_TYPES))
def test_kinds_of_frames(image_type: str) -> None:
    kind = OBSERVATION_TYPES[image_type]
    exposed = {"EXPTIME": 0.0} if kind == "bias" else {}
    for spelled in (image_type, image_type.lower()):
        assert interpret({"IMGTYPE": spelled, **exposed}).observation_type == kind


@pytest.mark.parametrize(
    ("test_type", "kind"), [("LAMBDA", "flat"), ("SFLAT_500", "flat"), ("DARK", "dark"), ("FE55", "fe55")]
)
def test_kind_is_derived_from_the_kind_of_test(test_type: str, kind: str) -> None:
    assert interpret({"IMGTYPE": None, "TESTTYPE": test_type}).observation_type == kind


@pytest.mark.parametrize("kind", ["BIAS", "DARK"])
def test_left_over_wavelength_of_frames_without_light_does_not_count(kind: str) -> None:
    metadata = interpret({"IMGTYPE": kind, "EXPTIME": 0.0})
    assert metadata.wavelength_nm is None
    with pytest.raises(FrameFormatError, match=rf"raw\.fits: MONOWL is None.*this is a {kind.lower()} frame"):
        metadata.require_wavelength_nm()


def test_stale_reading_of_the_monochromator_does_not_count() -> None:
    with pytest.raises(FrameFormatError, match="MONOWL is None"):
        interpret({"MONOWL": None, "MONOCH-WAVELENG": 960.0})


def test_white_flats_have_no_wavelength() -> None:
    for value in (None, 0.0, -1):
        assert interpret({"TESTTYPE": "SFLAT_500", "MONOWL": value}).wavelength_nm is None


def test_width_of_the_slits_is_kept_when_set() -> None:
    assert interpret({"MONOCH-BANDPASS": 0.5}).bandpass_nm == 0.5


@pytest.mark.parametrize(
    ("changes", "kelvin", "keyword"),
    [
        ({}, 182.65, "CCDTEMP"),
        ({"CCDTEMP": None, "TEMP_SET": -95.0}, 178.15, "TEMP_SET"),
        ({"CCDTEMP": "  ", "TEMP_SET": -95.0}, 178.15, "TEMP_SET"),
        ({"CCDTEMP": None, "SENSTEMP": -91.0, "TEMP_SET": -95.0}, 182.15, "SENSTEMP"),
        ({"CCDTEMP": None}, None, ""),
    ],
)
def test_temperature_and_where_it_came_from(
    changes: dict[str, Any], kelvin: float | None, keyword: str
) -> None:
    metadata = interpret(changes)
    assert metadata.temperature_k == (None if kelvin is None else pytest.approx(kelvin))
    assert metadata.temperature_source == keyword
    if kelvin is None:
        with pytest.raises(FrameFormatError, match=r"raw\.fits: CCDTEMP is None"):
            metadata.require_temperature_k()


def test_conditions_come_from_their_own_hdus_where_the_primary_lacks_them(tmp_path: Path) -> None:
    detector = small_detector()
    hdus = raw_hdus(random_image(detector), detector, {"CCDTEMP": None, "MONOWL": None})
    conditions = fits.BinTableHDU(name="TEST_COND")
    conditions.header["SENSTEMP"], conditions.header["MONOWL"] = -88.0, 910.0
    hdus.append(conditions)
    hdus.writeto(tmp_path / "raw.fits")
    metadata = read_raw_metadata(tmp_path / "raw.fits")
    assert metadata.temperature_k == pytest.approx(185.15)
    assert metadata.temperature_source == "SENSTEMP"
    assert metadata.wavelength_nm == 910.0


def test_day_and_number_are_derived_from_the_start() -> None:
    metadata = interpret({"SEQNUM": None, "DAYOBS": None, "DATE-OBS": "2018-07-24T10:28:45.342"})
    assert metadata.day_obs == 20180724
    assert metadata.seq_num == (10 - 8) * 3600 + 28 * 60 + 45
    early = interpret({"DATE-OBS": "2018-07-24T07:59:59.9"})
    assert early.day_obs == 20180723
    camera = interpret({"DAYOBS": None, "DATE-OBS": "2021-12-13T11:59:00"}, LSSTCAM_HEADER)
    assert camera.day_obs == 20211212


def test_start_is_derived_from_the_julian_date() -> None:
    metadata = interpret({"DATE-OBS": None})
    assert metadata.date_obs == pytest.approx(
        datetime.datetime(2018, 7, 24, 10, 28, 45, 342000), abs=datetime.timedelta(milliseconds=1)
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"IMGTYPE": "BAIS"}, "IMGTYPE is 'BAIS'; allowed: BIAS"),
        ({"IMGTYPE": None, "TESTTYPE": None}, "IMGTYPE is None; allowed: BIAS"),
        ({"IMGTYPE": 3}, "IMGTYPE is 3"),
        ({"MONOWL": "blue"}, "MONOWL is 'blue'; allowed: a wavelength from 200 to 1300 nm"),
        ({"MONOWL": 9600.3}, "MONOWL is 9600.3"),
        ({"MONOWL": float("nan")}, "MONOWL is nan"),
        ({"MONOWL": 0}, "MONOWL is 0"),
        ({"EXPTIME": None}, "EXPTIME is None; allowed: seconds"),
        ({"EXPTIME": -1}, "EXPTIME is -1"),
        ({"EXPTIME": True}, "EXPTIME is True"),
        ({"DARKTIME": "long"}, "DARKTIME is 'long'"),
        ({"CCDTEMP": 183.0}, "CCDTEMP is 183.0; allowed: °C from -200 to 60"),
        ({"CCDTEMP": "cold"}, "CCDTEMP is 'cold'"),
        ({"MONOCH-BANDPASS": -2.0}, "MONOCH-BANDPASS is -2.0"),
        ({"DATE-OBS": "yesterday"}, "DATE-OBS is 'yesterday'; allowed: YYYY-MM-DD"),
        ({"DATE-OBS": None, "MJD-OBS": "x"}, "MJD-OBS is 'x'"),
        ({"DATE-OBS": None, "MJD-OBS": None}, "DATE-OBS is None"),
        ({"SEQNUM": -1}, "SEQNUM is -1"),
        ({"SEQNUM": 1.5}, "SEQNUM is 1.5"),
        ({"SEQNUM": 100000}, "SEQNUM is 100000"),
        ({"DAYOBS": "20181301"}, "DAYOBS is '20181301'; allowed: a date YYYYMMDD"),
        ({"INSTRUME": "DECam"}, "INSTRUME is 'DECam'; allowed: LSSTCAM"),
        ({"LSST_NUM": "E2V-CCD250-999"}, "detector is 'E2V-CCD250-999'; allowed: did you mean E2V-CCD250-"),
        ({"LSST_NUM": None, "RAFTNAME": None}, "LSST_NUM is None; allowed: the serial number"),
        ({"TSTAND": None, "LSST_NUM": None, "RAFTNAME": None}, "INSTRUME is None; allowed: lsstCam"),
    ],
)
def test_values_that_cannot_be_used_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        interpret(changes)
    assert str(caught.value).startswith("raw.fits: ")
    assert message in str(caught.value)


def test_values_of_the_camera_that_cannot_be_used_are_refused() -> None:
    with pytest.raises(InputError, match="CONTRLLR is 'Z'; allowed: one of O, C"):
        interpret({"CONTRLLR": "Z"}, LSSTCAM_HEADER)
    with pytest.raises(InputError, match=r"raw\.fits: detector is 'E2V-CCD250-0'"):
        interpret({"CCDSLOT": "S99", "LSST_NUM": "E2V-CCD250-0"}, LSSTCAM_HEADER)


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=12), st.just(fits.card.Undefined())
)
KEYWORDS = sorted({*TS8_HEADER, *LSSTCAM_HEADER, "TEMP_SET", "SENSTEMP", "SLOTNAME", "MJD"})


@given(
    base=st.sampled_from([TS8_HEADER, LSSTCAM_HEADER]),
    changes=st.dictionaries(st.sampled_from(KEYWORDS), VALUES, max_size=5),
)
def test_any_header_is_understood_or_refused(base: dict[str, Any], changes: dict[str, Any]) -> None:
    metadata, refusal = result_or_refusal(lambda: interpret(changes, base))
    if metadata is None:
        assert "raw.fits" in refusal
        return
    assert metadata.camera in {"ts8", "lsstCam", "monocam"}
    assert metadata.observation_type in OBSERVATION_TYPES.values()
    assert metadata.exposure_time_s >= 0
    assert metadata.wavelength_nm is None or 200 <= metadata.wavelength_nm <= 1300
    assert metadata.temperature_k is None or 73 < metadata.temperature_k < 334
    assert 0 <= metadata.seq_num < 100_000
    assert 0 < metadata.exposure_id < 10**18
    assert datetime.datetime.strptime(str(metadata.day_obs), "%Y%m%d")
