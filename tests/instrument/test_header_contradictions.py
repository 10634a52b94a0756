"""Headers that contradict themselves or the instrument are refused; times and numbers are those of obs_lsst."""

from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from astropy.time import Time
from raw_frame_maker import LSSTCAM_HEADER, TS8_HEADER, header_with, write_raw

from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.instrument.raw_frame import RawFrame, RawMetadata, read_raw_metadata
from lsst.fringe_sim.middleware.translators import FringeLsstCamTranslator, FringeTs8Translator


def interpret(base: dict[str, Any], **changes: Any) -> RawMetadata:
    cards = {key.replace("_", "-") if key == "DATE_OBS" else key: value for key, value in changes.items()}
    return RawMetadata.from_header(header_with(cards, base), source="raw.fits")


def camera(day: str, controller: str | None, sequence: int, prefix: str = "MC") -> dict[str, Any]:
    date = f"{day[:4]}-{day[4:6]}-{day[6:]}T20:00:00.000"
    about = {"DAYOBS": day, "SEQNUM": sequence, "CONTRLLR": controller, "DATE-OBS": date}
    return {**about, "OBSID": f"{prefix}_{controller or 'C'}_{day}_{sequence:06d}"}


@pytest.mark.parametrize(
    ("base", "changes", "number"),
    [
        (LSSTCAM_HEADER, camera("20211212", "C", 310), 3021121200310),
        (LSSTCAM_HEADER, camera("20231004", "C", 7), 3023100400007),
        (LSSTCAM_HEADER, camera("20231005", "C", 7), 2023100500007),
        (LSSTCAM_HEADER, camera("20231107", "C", 78), 2023110700078),
        (LSSTCAM_HEADER, camera("20231107", "O", 78), 2023110700078),
        (LSSTCAM_HEADER, camera("20231107", None, 78), 2023110700078),
        (LSSTCAM_HEADER, camera("20250417", "P", 5), 5025041700005),
        (LSSTCAM_HEADER, camera("20250418", "P", 5), 2025041800005),
        (LSSTCAM_HEADER, camera("20250417", "Q", 5), 6025041700005),
        (LSSTCAM_HEADER, camera("20250417", "S", 5), 7025041700005),
        (LSSTCAM_HEADER, camera("20260101", "S", 5), 2026010100005),
        (TS8_HEADER, {}, 201807241028453),
        (
            TS8_HEADER,
            {**camera("20230524", "C", 906, "TS"), "DATE-OBS": "2023-05-24T22:59:59.000"},
            202305242259590,
        ),
        (
            TS8_HEADER,
            {**camera("20230524", "C", 906, "TS"), "DATE-OBS": "2023-05-24T23:30:00.000"},
            3023052400906,
        ),
        (TS8_HEADER, camera("20231107", "C", 78, "TS"), 2023110700078),
        (TS8_HEADER, {**camera("20231107", "C", 78, "TS"), "OBSID": None}, 202311072000000),
    ],
)
def test_exposures_are_numbered_as_by_obs_lsst(
    base: dict[str, Any], changes: dict[str, Any], number: int
) -> None:
    assert RawMetadata.from_header(header_with(changes, base), source="raw.fits").exposure_id == number


@pytest.mark.parametrize(("stated", "scale"), [(None, "tai"), ("TAI", "tai"), ("tai", "tai"), ("UTC", "utc")])
def test_exposures_begin_when_obs_lsst_says(stated: str | None, scale: str) -> None:
    """A header of Rubin states TAI unless it says otherwise: 37 s apart."""
    header = header_with({"TIMESYS": stated}, LSSTCAM_HEADER)
    begin = FringeLsstCamTranslator(header, filename="raw.fits").to_datetime_begin()
    assert abs((begin - Time("2021-12-13T04:58:56.398", scale=scale)).to_value("s")) < 1e-3


OF_2023 = {**camera("20230512", "C", 21, "TS"), "EXPTIME": 15.0, "TIMESYS": None}


@pytest.mark.parametrize(
    ("changes", "begin"),
    [
        # TS_C_20230512_000021 and TS_C_20220711_000174, whose DATE-OBS is their DATE-TRG, and TS_C_20230523_000127.
        (
            {"DATE-OBS": "2023-05-12T19:17:59.150", "DATE-TRG": "2023-05-12T19:17:59.150"},
            "2023-05-12T19:17:44.150",
        ),
        (
            {
                **camera("20220711", "C", 174, "TS"),
                "DATE-OBS": "2022-07-11T17:14:45.995",
                "DATE-TRG": "2022-07-11T17:14:45.995",
                "EXPTIME": 210.0,
            },
            "2022-07-11T17:11:15.995",
        ),
        (
            {
                **camera("20230523", "C", 127, "TS"),
                "DATE-OBS": "2023-05-23T19:36:19.477",
                "DATE-TRG": "2023-05-23T19:36:34.638",
                "DATE-BEG": "2023-05-23T19:36:19.477",
                "TIMESYS": "TAI",
            },
            "2023-05-23T19:36:19.477",
        ),
    ],
)
def test_the_end_of_an_exposure_of_ts8_is_not_its_begin(changes: dict[str, Any], begin: str) -> None:
    header = header_with({**OF_2023, **changes}, TS8_HEADER)
    found = FringeTs8Translator(header, filename="raw.fits").to_datetime_begin()
    assert abs((found - Time(begin, scale="tai")).to_value("s")) < 1e-3
    # The number of the exposure has the digits of DATE-OBS as it stands.
    digits = "".join(letter for letter in changes["DATE-OBS"][:21] if letter.isdigit())
    assert FringeTs8Translator(header, filename="raw.fits").to_exposure_id() == int(digits)


def test_the_begin_is_preferred_and_the_shutter_measures() -> None:
    about = RawMetadata.from_header(
        header_with({"DATE-BEG": "2021-12-13T04:58:40.000", "SHUTTIME": 14.98}, LSSTCAM_HEADER),
        source="raw.fits",
    )
    assert about.date_obs.second == 40
    assert about.exposure_time_s == 14.98
    assert interpret(LSSTCAM_HEADER, SHUTTIME=0.0).exposure_time_s == 15.0


@pytest.mark.parametrize(
    ("changes", "keyword"),
    [
        ({"DAYOBS": "20201212"}, "DAYOBS"),
        ({"DAYOBS": "20211215"}, "DAYOBS"),
        ({"TIMESYS": "GPS"}, "TIMESYS"),
        ({"INSTRUME": "LSST_CAMERA", "OBSID": "CC_C_20211212_000310"}, "OBSID"),
        ({"OBSID": "TS_C_20211212_000310"}, "OBSID"),
        ({"TESTTYPE": "PHOSIM"}, "TESTTYPE"),
        ({"CREATOR": "PHOSIM"}, "CREATOR"),
        ({"CONTRLLR": "H"}, "CONTRLLR"),
        ({"SHUTTIME": -1.0}, "SHUTTIME"),
        ({"MJD-OBS": 59561.0}, "MJD-OBS"),
        ({"DATE-BEG": "2021-12-13T04:58:40", "MJD-BEG": 59561.21}, "MJD-BEG"),
        ({"AMSTART": 0.7}, "AMSTART"),
    ],
)
def test_contradictions_are_refused(changes: dict[str, Any], keyword: str) -> None:
    with pytest.raises(FrameFormatError, match=f"^raw.fits: {keyword} is"):
        interpret(LSSTCAM_HEADER, **changes)


FLAT_OF_CAMERA = {**LSSTCAM_HEADER, "MONOWL": 960.03}


@pytest.mark.parametrize(
    ("base", "changes", "words"),
    [
        (
            TS8_HEADER,
            {"CCDTEMP": 20.0, "TEMP_SET": -90.0},
            ("CCDTEMP and TEMP_SET", "20.0 and -90.0", "5 °C"),
        ),
        (TS8_HEADER, {"TEMP_SET": -80.0}, ("CCDTEMP and TEMP_SET",)),
        (TS8_HEADER, {"TEMP_SET": "cold"}, ("TEMP_SET is 'cold'",)),
        (TS8_HEADER, {"SENSTEMP": -70.0}, ("CCDTEMP and SENSTEMP",)),
        (TS8_HEADER, {"SLOTNAME": "S01", "CCDSLOT": "S22"}, ("SLOTNAME and CCDSLOT", "S01 and S22")),
        (LSSTCAM_HEADER, {"RAFTBAY": "R11", "RAFTNAME": "R12"}, ("RAFTBAY and RAFTNAME",)),
        (LSSTCAM_HEADER, {"CCDSLOT": "S02"}, ("LSST_NUM", "R11_S02", "R11_S01")),
        (LSSTCAM_HEADER, {"RAFTBAY": "R12"}, ("LSST_NUM", "R11_S01")),
        (TS8_HEADER, {"TESTTYPE": "DARK"}, ("TESTTYPE", "takes none")),
        (TS8_HEADER, {"TESTTYPE": "FE55"}, ("TESTTYPE", "takes none")),
        (TS8_HEADER, {"EXPTIME": 0.0}, ("EXPTIME is 0.0", "more than 0")),
        (TS8_HEADER, {"DARKTIME": 2.0}, ("DARKTIME is 2.0", "21.9")),
        (TS8_HEADER, {"IMGTYPE": "BIAS", "EXPTIME": 30.0}, ("EXPTIME is 30.0", "sees no light")),
        (LSSTCAM_HEADER, {"IMGTYPE": "BIAS", "EXPTIME": 0.0, "SHUTTIME": 15.0}, ("SHUTTIME is 15.0",)),
        (FLAT_OF_CAMERA, {"FILTER": "r_57"}, ("FILTER is 'r_57'", "960.03 nm of MONOWL", "526 to 710")),
        (FLAT_OF_CAMERA, {"FILTER": "SDSSi"}, ("FILTER",)),
        (FLAT_OF_CAMERA, {"FILTER": "750nm"}, ("FILTER",)),
        (TS8_HEADER, {"FILTER": "1000CutOn"}, ("FILTER",)),
    ],
)
def test_two_statements_of_one_fact_do_not_differ(
    base: dict[str, Any], changes: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(FrameFormatError, match=r"^raw\.fits: ") as caught:
        interpret(base, **changes)
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
    ("base", "changes"),
    [
        # TEMP_SET and CCDTEMP of real flats of TS3 and TS8; sensors of one series lie up to 5 °C apart.
        (TS8_HEADER, {"TEMP_SET": -95.0, "CCDTEMP": -95.12656}),
        (TS8_HEADER, {"TEMP_SET": -100.0, "CCDTEMP": -100.52526152, "SENSTEMP": -100.52526152}),
        (TS8_HEADER, {"FILTER": "550CutOn"}),
        (TS8_HEADER, {"FILTER": "unspecified", "FILTER2": "unspecified"}),
        (TS8_HEADER, {"IMGTYPE": "BIAS", "EXPTIME": 0.0, "TESTTYPE": "LAMBDA"}),
        (LSSTCAM_HEADER, {"IMGTYPE": "BIAS", "TESTTYPE": "BIAS", "EXPTIME": 0.0, "DARKTIME": 0.398}),
        (TS8_HEADER, {"IMGTYPE": "FE55", "TESTTYPE": "FE55", "MONOWL": 549.997, "FILTPOS": 4}),
        (TS8_HEADER, {"TESTTYPE": "SFLAT_HI", "MONOWL": None}),
        (FLAT_OF_CAMERA, {"FILTER": "950nm"}),
        (FLAT_OF_CAMERA, {"FILTER": "NONE"}),
        (FLAT_OF_CAMERA, {"FILTER": "ph_05"}),
        (FLAT_OF_CAMERA, {"FILTER": "r_57", "MONOWL": None}),
        (FLAT_OF_CAMERA, {"EXPTIME": 15.0, "SHUTTIME": 15.000065088272095, "DARKTIME": 15.0}),
        (
            LSSTCAM_HEADER,
            {"IMGTYPE": "DARK", "TESTTYPE": "DARK", "EXPTIME": 5.0, "SHUTTIME": 0.0, "DARKTIME": 5.01371},
        ),
        # The first sensors in the camera were not those of its table.
        (
            LSSTCAM_HEADER,
            {
                "RAFTBAY": "R10",
                "CCDSLOT": "S02",
                "LSST_NUM": "ITL-3800C-041",
                "RAFTNAME": "LCA-11021_RTM-003_ETU2",
            },
        ),
    ],
)
def test_what_real_headers_state_is_no_contradiction(base: dict[str, Any], changes: dict[str, Any]) -> None:
    assert interpret(base, **changes).notes == ()


def test_the_place_of_a_rebuilt_raft_is_said() -> None:
    (note,) = interpret(TS8_HEADER, SLOTNAME="S22").notes
    assert "RTM-020_S22" in note
    assert "RTM-020_S01" in note


def test_a_raft_other_than_that_of_the_sensor_is_said_where_the_header_names_the_raft() -> None:
    (note,) = interpret(TS8_HEADER, SLOTNAME="S01", RAFTNAME="LCA-11021_RTM-004").notes
    assert "RTM-004_S01" in note
    assert "RTM-020_S01" in note
    assert interpret(TS8_HEADER, SLOTNAME="S01", RAFTNAME="R11").notes == ()  # a bay, which is no raft module


def test_what_is_taken_for_granted_is_said() -> None:
    assert interpret(TS8_HEADER).notes == ()
    assert interpret(LSSTCAM_HEADER).notes == ()
    (note,) = interpret(TS8_HEADER, TSTAND=None).notes
    assert "ts8" in note
    assert "TSTAND" in note


@pytest.mark.parametrize("stand", [None, "BOT"])
def test_a_sensor_of_both_cameras_needs_one_of_them_named(stand: str | None) -> None:
    """Its detector and exposure numbers are those of the camera."""
    place = {"TSTAND": stand, "RAFTBAY": "R11", "SLOTNAME": "S01"}
    with pytest.raises(FrameFormatError, match=r"TSTAND is .*INSTRUME"):
        interpret(TS8_HEADER, **place)
    assert interpret(TS8_HEADER, **place, INSTRUME="LSST-TS8").camera == "ts8"
    assert interpret(TS8_HEADER, **place, INSTRUME="LSSTCam").camera == "lsstCam"


# Files ----------------------------------------------------------------------------------------------------


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    write_raw(tmp_path / "raw.fits", {})
    return tmp_path / "raw.fits"


def both_refuse(path: Path, words: str) -> None:
    for reader in (read_raw_metadata, RawFrame.read):
        with pytest.raises(FrameFormatError, match=words):
            reader(path)


def test_two_wavelengths_are_refused(raw: Path) -> None:
    with fits.open(raw, mode="update") as hdus:
        hdus[0].header.append(("MONOWL", 967.0), end=True)
    both_refuse(raw, "MONOWL is '960.03 and 967.0'")


@pytest.mark.parametrize(("second", "refused"), [(967.0, True), (959.8, False), (-1.0, False)])
def test_another_wavelength_in_the_test_conditions(raw: Path, second: float, refused: bool) -> None:
    with fits.open(raw, mode="append") as hdus:
        hdus.append(fits.BinTableHDU.from_columns([fits.Column("A", "J", array=[1])], name="TEST_COND"))
        hdus[-1].header["MONOWL"] = second
    if refused:
        both_refuse(raw, "TEST_COND")
    else:
        assert RawFrame.read(raw).metadata.wavelength_nm == 960.03


@pytest.mark.parametrize(
    ("place", "keyword", "value"),
    [
        (1, "MONOWL", 700.0),
        (16, "MONOWL", 700.0),
        (3, "LSST_NUM", "E2V-CCD250-200"),
        (3, "CCDTEMP", 20.0),
        (3, "EXPTIME", 3.0),
        (3, "IMGTYPE", "BIAS"),
        (3, "INSTRUME", "HSC"),
        (3, "CCDSLOT", "S22"),
    ],
)
def test_any_hdu_may_contradict_the_first(tmp_path: Path, place: int, keyword: str, value: Any) -> None:
    write_raw(tmp_path / "raw.fits", {"INSTRUME": "LSST-TS8", "SLOTNAME": "S01"})
    with fits.open(tmp_path / "raw.fits", mode="update") as hdus:
        hdus[place].header[keyword] = value
    both_refuse(tmp_path / "raw.fits", f"{keyword} of SEGMENT")


def test_an_hdu_may_repeat_what_the_first_says(raw: Path) -> None:
    with fits.open(raw, mode="update") as hdus:
        for hdu in hdus[1:]:
            hdu.header.update({"MONOWL": 960.0, "LSST_NUM": "E2V-CCD250-321-Dev", "CCDTEMP": -90.0})
    assert RawFrame.read(raw).metadata.notes == ()


@pytest.mark.parametrize("keyword", ["CCDTEMP", "SENSTEMP"])
def test_a_broken_reading_of_the_temperature_is_not_used_and_said(raw: Path, keyword: str) -> None:
    with fits.open(raw, mode="update") as hdus:
        hdus[3].header[keyword] = -260.0
    for read in (read_raw_metadata, lambda path: RawFrame.read(path).metadata):
        metadata = read(raw)
        assert metadata.temperature_k == pytest.approx(273.15 - 90.5)
        (note,) = metadata.notes
        assert f"{keyword} of SEGMENT" in note


def test_a_broken_reading_alone_is_refused(tmp_path: Path) -> None:
    write_raw(tmp_path / "raw.fits", {"CCDTEMP": -260.0})
    both_refuse(tmp_path / "raw.fits", "CCDTEMP is -260")


def test_keywords_that_nobody_knows_are_named(raw: Path) -> None:
    with fits.open(raw, mode="update") as hdus:
        hdus[0].header["MONOWAVE"] = 700.0
        for hdu in hdus[1:]:
            hdu.header["GAIN"] = 3.0
    for read in (read_raw_metadata, lambda path: RawFrame.read(path).metadata):
        (note,) = read(raw).notes
        assert "MONOWAVE, GAIN" in note


@pytest.mark.parametrize(
    ("keyword", "value"), [("CCDSUM", "2 2"), ("CCDSUM", "1 2"), ("BSCALE", 2.0), ("BLANK", -32768)]
)
def test_pixels_that_are_not_those_of_the_sensor(raw: Path, keyword: str, value: Any) -> None:
    content = raw.read_bytes()
    card = fits.Card(keyword, value).image.encode()
    extname = content.index(b"EXTNAME")
    raw.write_bytes(content[:extname] + card + content[extname + 80 :])
    both_refuse(raw, keyword)


def test_a_sensor_of_the_other_vendor_is_refused(tmp_path: Path) -> None:
    write_raw(tmp_path / "maker.fits", {"CCD_MANU": "ITL"})
    both_refuse(tmp_path / "maker.fits", "CCD_MANU is 'ITL'")


def test_the_size_of_the_other_vendor_is_refused() -> None:
    from lsst.fringe_sim.instrument.camera import Camera
    from lsst.fringe_sim.instrument.raw_checks import refuse_other_vendor

    sensor = Camera.from_name("lsstCam").detector("R22_S21")
    with pytest.raises(FrameFormatError, match="DETSIZE"):
        refuse_other_vendor(None, None, sensor, (4000, 4072), "raw.fits")
    for shape in ((4004, 4096), (160, 192)):
        refuse_other_vendor("E2V", "CCD250", sensor, shape, "raw.fits")
