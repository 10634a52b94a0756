"""Every keyword that is read of a header from outside, and what each reader does with it.

`header_value` reads no keyword that is not declared here; the table of the documentation is made from this one.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping

USED, CHECKED, REFUSED = "used", "checked", "refused"
"""It decides something of the result; another value than the one allowed is refused; its presence is refused."""

READERS = ("fit, discover", "ingest", "Tasks")
"""Readers of raw frames: commands, `butler ingest-fringe-raws`, `isrFlatPrep` and `fringeBias`."""


@dataclasses.dataclass(frozen=True)
class HeaderKeyword:
    """A keyword, and what becomes of it."""

    name: str  # The keyword, without HIERARCH; ``n`` stands for a number
    place: str  # HDU of a raw frame
    # By reader: used, checked or refused. A reader that is not named does not depend on it
    treatment: Mapping[str, str]
    what: str  # What it decides, or what is allowed


_LETTERS = {"u": USED, "c": CHECKED, "r": REFUSED}


def _of_raw(place: str, name: str, letters: str, what: str) -> HeaderKeyword:
    treatment = {
        reader: _LETTERS[letter] for reader, letter in zip(READERS, letters, strict=True) if letter != "-"
    }
    return HeaderKeyword(name, place, treatment, what)


_PRIMARY = (
    ("INSTRUME", "uuu", "camera; one that is not known is refused"),
    (
        "TSTAND",
        "uuu",
        "camera where INSTRUME is absent; without both, what is assumed is said, or refused where two would do",
    ),
    ("OBSID", "cuc", "begins with MC for the LSST Camera and with TS for TS8; numbers exposures of TS8"),
    ("CAMCODE", "ccc", "the letters with which OBSID begins"),
    ("CREATOR", "ccc", "not another simulator"),
    ("CONTRLLR", "uuu", "number of the exposure; H, which PhoSim writes, is refused"),
    ("IMGTYPE", "uuu", "bias, flat or another type; one that is not known is refused"),
    (
        "TESTTYPE",
        "uuu",
        "type where IMGTYPE is absent; reason of the exposure; of a monochromatic flat a test that has some",
    ),
    ("MONOWL", "uuu", "wavelength in nm, 200 to 1300; two values are refused"),
    ("MONOCH-BANDPASS", "u-u", "width of the line in nm, in place of the set-up's where it is not 0"),
    (
        "EXPTIME",
        "uuu",
        "exposure time in s, more than 0 of a monochromatic flat, 0 of a bias; dark time where DARKTIME is absent",
    ),
    (
        "SHUTTIME",
        "uuu",
        "exposure time in s in place of EXPTIME where it is more than 0, as it is not of a bias",
    ),
    ("DARKTIME", "uuu", "time of the dark current in s, not less than the exposure time"),
    ("CCDTEMP", "uuu", "temperature in °C, -200 to 60"),
    ("SENSTEMP", "uuu", "temperature where CCDTEMP is absent"),
    ("TEMP_SET", "uuu", "temperature where neither is there; else within 5 °C of them"),
    ("RAFTBAY", "uuu", "place of the raft in the LSST Camera"),
    ("RAFTNAME", "uuu", "place or module of the raft"),
    ("SLOTNAME", "uuu", "slot of the sensor"),
    ("CCDSLOT", "uuu", "slot of the sensor where SLOTNAME is absent"),
    ("LSST_NUM", "uuu", "serial number of the sensor; in the LSST Camera none that is at another place"),
    ("CCD_MANU", "ccc", "the vendor that the table of the camera has there"),
    ("CCD_TYPE", "ccc", "the model of that vendor"),
    (
        "FILTER",
        "cuc",
        "physical filter of the LSST Camera; of a monochromatic flat one that passes its light",
    ),
    ("FILTER1", "-u-", "second part of the physical filter"),
    ("FILTER2", "-u-", "third part of the physical filter"),
    ("RUNNUM", "uuu", "run, in the header of products; science program"),
    ("TIMESYS", "cuc", "UTC or TAI; TAI for Rubin's cameras where it is absent"),
    ("DATE-BEG", "uuu", "begin of the exposure"),
    ("MJD-BEG", "uuu", "begin where DATE-BEG is absent; else the same within 1 s"),
    ("DATE-OBS", "uuu", "begin where DATE-BEG is absent; number of older exposures of TS8"),
    ("MJD-OBS", "uuu", "begin where DATE-OBS is absent; else the same within 1 s"),
    ("MJD", "uuu", "begin where nothing else states one"),
    ("DATE-TRG", "uuu", "where it equals DATE-OBS, TS8 wrote the end of the exposure there"),
    ("DAYOBS", "uuu", "observing day; within a day of the begin"),
    ("SEQNUM", "uuu", "number of the exposure"),
    ("AMSTART", "cuc", "airmass of an exposure of the sky, 1 to 40"),
    ("DETSIZE", "ucu", "size of the sensor; one for all HDUs"),
    ("BINX", "ccc", "1: pixels that are not binned"),
    ("BINY", "ccc", "1: pixels that are not binned"),
    ("BUNIT", "ccc", "adu"),
    ("STUTTER ROWS", "ccc", "0, but in a stuttered frame"),
)
_AMPLIFIER = (
    ("NAXIS", "ucu", "2 for an amplifier, of which there are 16"),
    ("NAXIS1", "ucu", "columns, overscan included"),
    ("NAXIS2", "ucu", "rows, overscan included"),
    ("BITPIX", "ccc", "integers"),
    ("BSCALE", "ccc", "1: numbers of the converter"),
    ("BLANK", "rrr", "no such card: every pixel has its number"),
    ("EXTNAME", "ucu", "SegmentNN is the amplifier CNN"),
    ("CHANNEL", "ucu", "amplifier where EXTNAME tells none"),
    ("DATASEC", "ucu", "imaging section; overscan is what lies right of it"),
    ("DETSEC", "ucu", "place in the assembled sensor"),
    ("DETSIZE", "ucu", "size of the sensor; one for all HDUs"),
    ("BIASSEC", "ccc", "no pixel of DATASEC"),
    ("CCDSUM", "ccc", "1 1: pixels that are not binned"),
    ("BUNIT", "ccc", "adu"),
)
_CONDITIONS = (
    ("MONOWL", "uuu", "wavelength where the primary header has none; else the same within 1 nm"),
    ("CCDTEMP", "uuu", "temperature where the primary header has none"),
    ("SENSTEMP", "uuu", "temperature where the primary header has none"),
    ("TEMP_SET", "uuu", "temperature where the primary header has none"),
)

RAW_KEYWORDS: tuple[HeaderKeyword, ...] = tuple(
    _of_raw(place, *row)
    for place, rows in (
        ("primary", _PRIMARY),
        ("amplifier", _AMPLIFIER),
        ("TEST_COND, REB_COND", _CONDITIONS),
    )
    for row in rows
)
"""Keywords of raw frames."""

NOT_READ: tuple[tuple[str, str], ...] = (
    (
        r"SIMPLE|EXTEND|XTENSION|[PG]COUNT|TFIELDS|T(FORM|TYPE)\d+|EXTVER|INHERIT|HEADVER",
        "layout of the file",
    ),
    (r"BZERO", "offset of unsigned integers: part of the number, applied when the file is read"),
    (
        r"Z(IMAGE|TILE\d|CMPTYPE|NAME\d|VAL\d|TENSION|BITPIX|NAXIS\d?|[PG]COUNT|HECKSUM|DATASUM)",
        "compression",
    ),
    (r"CHECKSUM|DATASUM", "of the acquisition; a frame whose pixels were cut down keeps the former ones"),
    (r"DATE|DATE-END|MJD-END|MJD-TRG|(DATE|MJD)P(BEG|END)|SHUT_DEL|TSTART", "other moments than the begin"),
    (
        r"IMAGETAG|FILENAME|GROUPID|PROGRAM|REASON|(CUR|MAX)INDEX|OBJECT|TELESCOP|OBSANNOT|COMMENT|HISTORY|CONTINUE|ORIGIN"
        r"|DAQANNOT|",
        "names",
    ),
    (r"CONTNUM|REBNAME|SEQ(FILE|NAME|CKSUM)|CCD_SERN", "parts of the instrument; LSST_NUM names the sensor"),
    (r"(FP|IH)VERS|FIRMWARE|PLATFORM|DAQ(VERS|PART|FOLD)", "software of the instrument"),
    (r"CCDGAIN|CCDNOISE", "rough guesses of the acquisition; gain and noise are measured or tabulated"),
    (r"AVERAGE|AVGBIAS|STDVBIAS|STDEV", "statistics of the acquisition; they are computed here"),
    (r"MONDIODE", "light at one moment; each flat is divided by its mean"),
    (r"FILTPOS|FILTSLOT|FILTBAND", "place of the filter; the one that sorts orders passes the line"),
    (
        r"MONOCH-(WAVELENG|SLIT_[ABC]|FILT_1|MSTEPS|GRATING)|MONO(POS|GRAT)",
        "setting of the monochromator; MONOWL states the wavelength, the set-up the width of the line",
    ),
    (
        r"CCDBSS|AMP\d-\w+|R\d\w+|CRYOTEMP|COLDTMP[AB]",
        "voltages, currents and temperatures of the electronics",
    ),
    (r"STUTTER (DELAY|NSHIFTS)", "of a stuttered frame, which STUTTER ROWS tells"),
    (
        r"(WCSNAME|C(TYPE|RPIX|RVAL|DELT)\d|PC\d_\d)[A-Z]|DTV\d|DTM\d_\d",
        "coordinates of pixels; DETSEC states the place",
    ),
    (
        r"OBS-(LONG|LAT|ELEV)|OBSGEO-[XYZ]|(RA|DEC|HA|EL|AZ)(START|END)?|AMEND|ROT(PA|COORD)|TRACKSYS|RADESYS|FOCUSZ"
        r"|BOT[XY](CAM)?|TELCODE|TSEQNUM",
        "pointing; AMSTART states the airmass",
    ),
    (
        r"VIGNETTE|VIGN_MIN|AIRTEMP|PRESSURE|HUMIDITY|WIND(SPD|DIR)|SEEING|TEMP(LED\d|SPH|BRD)",
        "dome and weather",
    ),
)
"""Keywords of real headers that nothing depends on, as regular expressions, and why."""


def reason_not_read(keyword: str) -> str | None:
    """Why nothing depends on a keyword; `None` of one that should be declared."""
    return next((reason for pattern, reason in NOT_READ if re.fullmatch(pattern, keyword)), None)


@functools.cache
def is_unknown(keyword: str) -> bool:
    """Whether a keyword is neither declared nor known to be of no use: a reader says that it does not use it."""
    return keyword not in _NAMES and reason_not_read(keyword) is None


_NAMES = frozenset(item.name for item in RAW_KEYWORDS)
