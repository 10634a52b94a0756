"""Every keyword is used, checked or refused by each reader as `RAW_KEYWORDS` declares, or depended on by none.

Headers are those of real frames; each keyword is given another value, and what the readers make of the frame is
compared.
"""

import dataclasses
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from raw_frame_maker import raw_hdus, small_detector

from lsst.fringe_sim.algorithms.flat_prep_options import FlatPrepOptions
from lsst.fringe_sim.cli.lab_frames import find_series
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.header_keywords import NOT_READ, RAW_KEYWORDS, READERS, reason_not_read
from lsst.fringe_sim.instrument.raw_frame import RawFrame
from lsst.fringe_sim.instrument.raw_header import header_value
from lsst.fringe_sim.middleware.instruments import INSTRUMENTS
from lsst.fringe_sim.middleware.raw_ingest import examine
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.tasks import FringeBiasConfig, FringeBiasTask, IsrFlatPrepConfig, IsrFlatPrepTask

REAL_FRAME = "measured/ts8_raw_201807241028453-RTM-010-S11-det067.fits"

TS8: dict[str, Any] = {
    "DATE": "2018-07-24T10:28:49.767",
    "DATE-OBS": "2018-07-24T10:28:45.342",
    "MJD": 58323.43668711791,
    "MJD-OBS": 58323.43663590262,
    "RUNNUM": "6006D",
    "TSTAND": "TS8",
    "CCD_MANU": "E2V",
    "CCD_TYPE": "CCD250",
    "LSST_NUM": "E2V-CCD250-179",
    "RAFTNAME": "LCA-11021_RTM-010-Dev",
    "TESTTYPE": "LAMBDA",
    "IMGTYPE": "FLAT",
    "SEQNUM": 17,
    "TEMP_SET": -100.0,
    "CCDTEMP": -100.52526152,
    "MONOWL": 900.03,
    "EXPTIME": 21.913,
    "BINX": 1,
    "BINY": 1,
    "MONOCH-BANDPASS": 0.0,
}
"""Cards of a real flat of TS8 (obs_lsst, 6006D) that something depends on, at a wavelength of fringes."""

CAMERA: dict[str, Any] = {
    "INSTRUME": "lsstCam",
    "TSTAND": "TMAMCv1_SUM",
    "OBSID": "MC_O_20250609_000578",
    "CAMCODE": "MC",
    "CONTRLLR": "O",
    "DAYOBS": "20250609",
    "SEQNUM": 578,
    "DATE-OBS": "2025-06-10T07:31:55.280",
    "MJD-OBS": 60836.313834257424,
    "DATE-BEG": "2025-06-10T07:31:55.280",
    "MJD-BEG": 60836.313834257424,
    "DATE-TRG": "2025-06-10T07:32:26.220",
    "TIMESYS": "TAI",
    "BUNIT": "adu",
    "IMGTYPE": "FLAT",
    "TESTTYPE": "OBJECT",
    "RAFTBAY": "R11",
    "CCDSLOT": "S01",
    "LSST_NUM": "E2V-CCD250-321",
    "RAFTNAME": "LCA-11021_RTM-020",
    "FILTER": "y_10",
    "EXPTIME": 30.0,
    "SHUTTIME": 30.000904321670532,
    "DARKTIME": 30.9487,
    "AMSTART": 1.0550553788866515,
    "CCDTEMP": -100.168,
    "MONOWL": 960.03,
}
"""Cards of real exposures of the LSST Camera (obs_lsst), as a flat of one wavelength."""

OTHERS_OF_CAMERA = [
    word.replace("~", " ")
    for word in re.findall(
        r"\S+",
        """
SIMPLE EXTEND BINX BINY CCDGAIN CCDNOISE COMMENT DATE MJD DATE-TRG MJD-TRG DATE-END MJD-END GROUPID TELESCOP
OBS-LONG OBS-LAT OBS-ELEV OBSGEO-X OBSGEO-Y OBSGEO-Z RA DEC RASTART DECSTART RAEND DECEND ROTPA ROTCOORD
HASTART ELSTART AZSTART HAEND ELEND AZEND AMEND TRACKSYS RADESYS FOCUSZ OBJECT VIGNETTE VIGN_MIN PROGRAM
REASON CURINDEX MAXINDEX TSTAND IMAGETAG OBSANNOT CCD_MANU CCD_TYPE FIRMWARE PLATFORM CONTNUM DAQVERS DAQPART
DAQFOLD SEQFILE SEQNAME SEQCKSUM CCD_SERN REBNAME FPVERS IHVERS FILTBAND FILTPOS FILTSLOT AIRTEMP PRESSURE
HUMIDITY WINDSPD WINDDIR SEEING HEADVER FILENAME XTENSION BITPIX NAXIS NAXIS1 NAXIS2 PCOUNT GCOUNT TFIELDS
TTYPE1 TFORM1 ZIMAGE ZTILE1 ZTILE2 ZCMPTYPE ZNAME1 ZVAL1 ZNAME2 ZVAL2 ZTENSION ZBITPIX ZNAXIS ZNAXIS1 ZNAXIS2
ZPCOUNT ZGCOUNT ZHECKSUM CHANNEL EXTNAME CCDSUM DATASEC DETSEC DETSIZE DTV1 DTM1_1 WCSNAMEE CTYPE1E PC1_1E
CDELT1E CRPIX1E CRVAL1E BSCALE BZERO INHERIT ZDATASUM CHECKSUM DATASUM DATEPBEG MJDPBEG DATEPEND MJDPEND
STUTTER~ROWS STUTTER~DELAY STUTTER~NSHIFTS
""",
    )
]
"""Further keywords of real exposures of the LSST Camera (obs_lsst, MC_O_20250609_000578 and MC_C_20231125_000600)."""

BASES = {"ts8": TS8, "lsstCam": CAMERA}

MUTATIONS: list[tuple[str, str, str, dict[str, Any], tuple[Any, ...]]] = [
    ("primary", "INSTRUME", "lsstCam", {}, ("HSC",)),
    ("primary", "TSTAND", "ts8", {"RAFTBAY": "R11", "SLOTNAME": "S01", "LSST_NUM": None}, ("BOT",)),
    ("primary", "OBSID", "lsstCam", {}, ("CC_O_20250609_000578", "MC_O_20250609_000579")),
    ("primary", "CAMCODE", "lsstCam", {}, ("CC",)),
    ("primary", "CREATOR", "lsstCam", {}, ("PHOSIM",)),
    ("primary", "CONTRLLR", "lsstCam", {"DAYOBS": None, "DATE-BEG": "2023-06-10T07:31:55.280",
     "MJD-BEG": None}, ("C",)),
    ("primary", "IMGTYPE", "ts8", {}, ("DARK",)),
    ("primary", "TESTTYPE", "ts8", {"IMGTYPE": None}, ("DARK",)),
    ("primary", "MONOWL", "ts8", {}, (910.02,)),
    ("primary", "MONOCH-BANDPASS", "ts8", {}, (3.0,)),
    ("primary", "EXPTIME", "ts8", {}, (22.4,)),
    ("primary", "SHUTTIME", "lsstCam", {"DARKTIME": None}, (29.0,)),
    ("primary", "DARKTIME", "lsstCam", {}, (40.0,)),
    ("primary", "CCDTEMP", "ts8", {}, (-90.0,)),
    ("primary", "SENSTEMP", "ts8", {"CCDTEMP": None}, (-90.0,)),
    ("primary", "TEMP_SET", "ts8", {"CCDTEMP": None}, (-90.0,)),
    ("primary", "RAFTBAY", "lsstCam", {}, ("R12",)),
    ("primary", "RAFTNAME", "ts8", {"LSST_NUM": None, "SLOTNAME": "S11"}, ("LCA-11021_RTM-005",)),
    ("primary", "SLOTNAME", "lsstCam", {"SLOTNAME": "S01", "CCDSLOT": None}, ("S02",)),
    ("primary", "CCDSLOT", "lsstCam", {}, ("S02",)),
    ("primary", "LSST_NUM", "ts8", {}, ("E2V-CCD250-200",)),
    ("primary", "CCD_MANU", "ts8", {}, ("ITL",)),
    ("primary", "CCD_TYPE", "ts8", {}, ("3800C",)),
    ("primary", "FILTER", "lsstCam", {}, ("y_04", "z_20")),
    ("primary", "FILTER1", "lsstCam", {}, ("ND",)),
    ("primary", "FILTER2", "lsstCam", {}, ("ND",)),
    ("primary", "RUNNUM", "ts8", {}, ("6007D",)),
    ("primary", "TIMESYS", "lsstCam", {}, ("UTC", "GPS")),
    ("primary", "DATE-BEG", "lsstCam", {"MJD-BEG": None}, ("2025-06-10T07:31:45.280",)),
    ("primary", "MJD-BEG", "lsstCam", {"DATE-BEG": None}, (60836.3137,)),
    ("primary", "DATE-OBS", "ts8", {"MJD-OBS": None}, ("2018-07-24T10:29:45.342",)),
    ("primary", "MJD-OBS", "ts8", {"DATE-OBS": None}, (58323.43673,)),
    ("primary", "MJD", "ts8", {"DATE-OBS": None, "MJD-OBS": None}, (58323.43675,)),
    ("primary", "DATE-TRG", "ts8", {}, ("2018-07-24T10:28:45.342",)),
    ("primary", "DAYOBS", "lsstCam", {}, ("20250610",)),
    ("primary", "SEQNUM", "lsstCam", {}, (579,)),
    ("primary", "AMSTART", "lsstCam", {}, (1.2, 0.5)),
    ("primary", "DETSIZE", "ts8", {}, ("[1:40,1:26]",)),
    ("primary", "BINX", "ts8", {}, (2,)),
    ("primary", "BINY", "ts8", {}, (2,)),
    ("primary", "BUNIT", "lsstCam", {}, ("electron",)),
    ("primary", "STUTTER ROWS", "lsstCam", {}, (10,)),
    ("amplifier", "NAXIS", "ts8", {}, (1,)),
    ("amplifier", "NAXIS1", "ts8", {}, (50,)),
    ("amplifier", "NAXIS2", "ts8", {}, (50,)),
    ("amplifier", "BITPIX", "ts8", {}, (-32,)),
    ("amplifier", "BSCALE", "ts8", {}, (2.0,)),
    ("amplifier", "BLANK", "ts8", {}, (-1,)),
    ("amplifier", "EXTNAME", "ts8", {}, ("Segment11",)),
    ("amplifier", "CHANNEL", "ts8", {"EXTNAME": "AMP1"}, (2,)),
    ("amplifier", "DATASEC", "ts8", {}, ("[12:16,1:12]", "[12:17,1:12]")),
    ("amplifier", "DETSEC", "ts8", {}, ("[6:10,1:12]",)),
    ("amplifier", "DETSIZE", "ts8", {}, ("[1:40,1:26]",)),
    ("amplifier", "BIASSEC", "ts8", {}, ("[14:20,1:12]",)),
    ("amplifier", "CCDSUM", "ts8", {}, ("2 2",)),
    ("amplifier", "BUNIT", "ts8", {}, ("electron",)),
    ("TEST_COND, REB_COND", "MONOWL", "ts8", {"MONOWL": None}, (910.02,)),
    ("TEST_COND, REB_COND", "CCDTEMP", "ts8", {"CCDTEMP": None}, (-90.0,)),
    ("TEST_COND, REB_COND", "SENSTEMP", "ts8", {"CCDTEMP": None}, (-90.0,)),
    ("TEST_COND, REB_COND", "TEMP_SET", "ts8", {"CCDTEMP": None, "TEMP_SET": None}, (-90.0,)),
]  # fmt: skip
"""HDU, keyword, base, what else the header has (nothing where a value is `None`), and other values of the keyword."""


def write(folder: Path, place: str, base: str, others: dict[str, Any], keyword: str, value: Any) -> Path:
    """A small flat with the headers of a real one; the keyword stands in one HDU of the place if not `None`."""
    detector = small_detector()
    rng = np.random.default_rng(7)
    primary = {"DATE-OBS": None, **BASES[base], **({} if place == "amplifier" else others)}
    hdus = raw_hdus(rng.normal(30_000, 150, detector.shape).astype(np.int32), detector, primary, base={})
    for hdu in hdus[1:]:
        hdu.data[:, -8:] = rng.normal(1000, 5, hdu.data[:, -8:].shape)
    hdus.append(fits.BinTableHDU.from_columns([fits.Column("A", "J", array=[1])], name="TEST_COND"))
    hdu = hdus[{"primary": 0, "amplifier": 1}.get(place, -1)]
    if place == "amplifier":
        hdu.header.update(others)
    elif value is not None:
        hdu.header[keyword if len(keyword) <= 8 else f"HIERARCH {keyword}"] = value
    folder.mkdir()
    hdus.writeto(folder / "raw.fits")
    if place == "amplifier" and value is not None:
        set_card(folder / "raw.fits", keyword, value)
    return folder / "raw.fits"


def set_card(path: Path, keyword: str, value: Any) -> None:
    """One card of the first amplifier as it stands in the file, which astropy would otherwise mend."""
    content, card = path.read_bytes(), fits.Card(keyword, value).image.encode()
    start = content.index(b"XTENSION")
    place = content.find(keyword.ljust(8).encode() + b"=", start, content.index(b"END ", start))
    if place < 0:
        place = content.index(b"END ", start)
        card += b"END".ljust(80)
    path.write_bytes(content[:place] + card + content[place + len(card) :])


# Readers ---------------------------------------------------------------------------------------------------


def by_fit(path: Path) -> Any:
    series = find_series([str(path)])
    cube = series.read(Setup.from_name("ts8_e2v"), FlatPrepOptions(edge_px=0), lambda: None)
    (flat,) = series.flats
    return (flat.camera, flat.raft, flat.slot, flat.exposure_id, flat.notes, flat.run), plain(cube)


def by_ingest(path: Path) -> Any:
    exposure = examine(str(path), REGISTERED)
    info = {name: str(getattr(exposure.info, name)) for name in exposure.info.all_properties}
    return {**info, "datetime_begin": exposure.info.datetime_begin.isot}, exposure.data_id, exposure.notes


def by_task(path: Path) -> Any:
    frame = RawFrame.read(path)
    sensor = Camera.from_name(frame.metadata.camera).detector(frame.metadata.detector)
    sensor = sensor.cut_down(frame.detector_shape)
    if frame.metadata.observation_type == "bias":
        return plain(FringeBiasTask(config=FringeBiasConfig()).run([frame], sensor.name).bias)
    return plain(IsrFlatPrepTask(config=IsrFlatPrepConfig(edge_px=0)).run(frame, None, sensor).flat)


def plain(product: Any) -> dict[str, Any]:
    """All that a product holds, to be compared; what it shows of itself is less."""
    return {
        name: value.tobytes() if isinstance(value, np.ndarray)
        else plain(value) if dataclasses.is_dataclass(value)
        else repr(value)
        for name, value in vars(product).items()
    }  # fmt: skip


BY: dict[str, Callable[[Path], Any]] = dict(zip(READERS, (by_fit, by_ingest, by_task), strict=True))
REGISTERED = {cls.getName(): cls for cls in INSTRUMENTS.values()}


def outcome(reader: str, path: Path) -> Any:
    try:
        return BY[reader](path)
    except InputError:
        return "refused"


def compared(reader: str, former: Path, other: Path) -> str:
    before, after = outcome(reader, former), outcome(reader, other)
    if isinstance(after, str):
        return after
    return "same" if before == after else "changed"


# Tests -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("case", MUTATIONS, ids=[f"{case[0]} {case[1]}" for case in MUTATIONS])
def test_another_value_has_the_declared_consequence(case: Any, tmp_path: Path) -> None:
    place, keyword, base, others, values = case
    (declared,) = [item for item in RAW_KEYWORDS if (item.place, item.name) == (place, keyword)]
    usual = BASES[base].get(keyword, others.get(keyword)) if place == "primary" else None
    former = write(tmp_path / "former", place, base, others, keyword, usual)
    changed = [
        write(tmp_path / str(number), place, base, others, keyword, value)
        for number, value in enumerate(values)
    ]
    for reader in READERS:
        found = {compared(reader, former, path) for path in changed}
        treatment = declared.treatment.get(reader, "nothing depends on it")
        if treatment == "used":
            assert found != {"same"}, reader
        elif treatment in ("checked", "refused"):
            assert "refused" in found, reader
            assert "changed" not in found, reader
        else:
            assert found == {"same"}, reader


def test_every_declared_keyword_is_tried() -> None:
    tried = {(place, keyword) for place, keyword, *_ in MUTATIONS}
    assert tried == {(item.place, item.name) for item in RAW_KEYWORDS}
    assert all(item.treatment for item in RAW_KEYWORDS)


def test_what_is_not_declared_is_not_read() -> None:
    with pytest.raises(LookupError, match="FILENAME is not declared"):
        header_value(fits.Header(), "FILENAME")


def test_what_is_read_is_what_is_declared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keywords that code of the package asks headers for while all readers read frames of both cameras."""
    asked: set[str] = set()

    def watched(name: str) -> Any:
        former = getattr(fits.Header, name)

        def wrapper(self: Any, key: Any, *rest: Any) -> Any:
            if sys._getframe(1).f_globals["__name__"].startswith("lsst.fringe_sim.instrument"):
                asked.add(key[0] if isinstance(key, tuple) else key)
            return former(self, key, *rest)

        return wrapper

    paths = [write(tmp_path / base, "primary", base, {}, "MONOWL", 900.0) for base in BASES]
    for name in ("get", "__getitem__"):
        monkeypatch.setattr(fits.Header, name, watched(name))
    for path in paths:
        for reader in READERS:
            assert outcome(reader, path) != "refused"
    # astropy itself reads the names of HDUs; BLANK and stale keywords are looked for only where others are absent.
    assert asked | {"EXTNAME"} == {item.name for item in RAW_KEYWORDS}


def real_keywords(shared_dir: Path) -> dict[str, set[str]]:
    """Keywords of the primary header and of the HDUs behind it."""
    found: dict[str, set[str]] = {}
    with fits.open(shared_dir / REAL_FRAME) as hdus:
        for number, hdu in enumerate(hdus):
            place = "primary" if number == 0 else "amplifier" if number <= 16 else "TEST_COND, REB_COND"
            found.setdefault(place, set()).update(hdu.header)
    return found


def test_every_keyword_of_the_camera_has_its_place_in_the_table() -> None:
    names = {item.name for item in RAW_KEYWORDS}
    assert not {key for key in (*OTHERS_OF_CAMERA, *CAMERA) if key not in names and not reason_not_read(key)}


@pytest.mark.shared
def test_every_keyword_of_real_headers_has_its_place_in_the_table(shared_dir: Path) -> None:
    found = real_keywords(shared_dir)
    table = Table.read(shared_dir / "data" / "header_keywords.ecsv")
    for row in table:
        place = "amplifier" if "amp" in row["era"] else "primary"
        names = re.findall(r"[A-Z][A-Z0-9_-]+", row["keyword"].replace("HIERARCH ", ""))
        found[place].update(names)
    assert sum(map(len, found.values())) > 600
    declared = {(item.place, item.name) for item in RAW_KEYWORDS}
    names = {item.name for item in RAW_KEYWORDS}
    unknown = {
        (place, keyword)
        for place, keywords in found.items()
        for keyword in keywords
        if (place, keyword) not in declared
        and reason_not_read(keyword) is None
        # An HDU may repeat what is read elsewhere.
        and keyword not in names
    }
    assert not unknown


def test_a_keyword_is_not_both_declared_and_left_out() -> None:
    assert not {item.name for item in RAW_KEYWORDS if reason_not_read(item.name)}


@pytest.mark.shared
def test_nothing_depends_on_the_other_keywords(shared_dir: Path, tmp_path: Path) -> None:
    """All keywords of a real primary header that are left out, changed at once."""
    former = write(tmp_path / "former", "primary", "ts8", {}, "FILENAME", "a")
    layout = re.compile(NOT_READ[0][0])
    changes = {}
    with fits.open(shared_dir / REAL_FRAME) as hdus:
        for keyword, value in hdus[0].header.items():
            if reason_not_read(keyword) and not layout.fullmatch(keyword):
                changes[keyword] = "other" if isinstance(value, str) else -12.5
    assert len(changes) > 20
    other = write(tmp_path / "other", "primary", "ts8", changes, "FILENAME", "other")
    for reader in READERS:
        assert compared(reader, former, other) == "same"
