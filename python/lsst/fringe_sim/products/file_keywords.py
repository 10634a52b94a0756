"""Keywords of maps, cubes and frames from outside beyond the cards of each product, and who does what with them.

The table of the documentation is made from this one and from the cards of the products.
"""

from __future__ import annotations

from dataclasses import dataclass

from .sky_frame import CORRECTED_BY

USED, CHECKED, REFUSED = "used", "checked", "refused"
"""It decides something of the result; another value than the one allowed is refused; its presence is refused."""


@dataclass(frozen=True)
class FileKeyword:
    """A keyword of a kind of file, who reads it, and what becomes of it."""

    file: str
    name: str
    readers: str
    treatment: str
    what: str


SENSOR_NAMES = ("DETNAME", "DETECTOR", "CCDNAME", "DETPOS", "CCDNUM", "RCID", "CCDID", "DET-ID")
"""Keywords by which cameras name a sensor, or the quadrant of one that is a file; the first that is stated counts."""

PLACE_NAMES = ("RAFTBAY", "CCDSLOT")  # Raft and slot, which name a sensor of LSST together

FILTER_NAMES = ("FILTER", "FILTNAM", "FILTER01", "FILTERID")  # Of the filter; the first that is stated counts

_MAP, _CUBE, _SKY, _ANY = "thickness map", "fringe cube", "sky frame", "any product"
_PLAIN, _AMPLIFIERS, _OBSERVED = "plain flat", "flat of amplifiers", "observed frame"
_SEARCH, _SKY_READERS = "fit, discover, Tasks", "sky, discover, Tasks"
_FITS, _CORRECTION = "fit, discover", "templates, correct"

_TABLE = (  # kind of file, keywords, readers, treatment, what
    (_MAP, "BUNIT", _SKY_READERS, USED, "unit of length, converted to µm; a unit of another kind is refused"),
    (_MAP, "LAYER", _SKY_READERS, CHECKED, "the layer that varies in the set-up"),
    (_MAP, "DETSEC", _SKY_READERS, USED, "part of the sensor; pixels that it has not are refused"),
    (_MAP, "CCDSEC", _SKY_READERS, USED, "the same where DETSEC is absent"),
    (_MAP, "CONTRAST", "sky", USED, "contrast of the laboratory, for the second forecast"),
    (_MAP, "CONTRSIG", "sky", USED, "its uncertainty"),
    (_CUBE, "BUNIT", _SEARCH, USED, "electron or relative, else refused; that of VARIANCE is its square"),
    (_CUBE, "LAYER", _SEARCH, USED, "layer of THICKNESS"),
    (_CUBE, "SMOOTHPX", _SEARCH, USED, "correlation length of the noise, px"),
    (_CUBE, "NOISE", _SEARCH, REFUSED, "false: there is no noise by which pixels are weighed"),
    (_SKY, "BUNIT", "discover, templates, Tasks", USED, "electron or fraction, else refused"),
    (_SKY, "NOISE", "discover", REFUSED, "false: there is no noise by which pixels are weighed"),
    (_SKY, "FRINGCOR", "templates, Tasks", REFUSED, "fringes were subtracted before"),
    (
        _SKY,
        "SETUP BEAMS EFFECTn EFFVALn TABLEn",
        "discover, templates, Tasks",
        CHECKED,
        "the same in all frames",
    ),
    (_SKY, "RDNOISE", "discover, templates", USED, "read noise in electrons; none where it is absent"),
    (_PLAIN, "IMGTYPE", _FITS, USED, "flat, as where it is absent, or bias or zero; others are left out"),
    (
        _PLAIN,
        "MONOWL WAVELEN WAVELNTH",
        _FITS,
        USED,
        "wavelength in nm, 200 to 1300; two that differ by more than 1 nm are refused",
    ),
    (_PLAIN, "TEMPK", _FITS, USED, "temperature in K, in place of that of the set-up"),
    (_PLAIN, "CCDTEMP", _FITS, USED, "temperature in °C where TEMPK is absent; else the same within 5 °C"),
    (_PLAIN, "EXPTIME", _FITS, USED, "seconds of dark current; more than 0 of a flat, 0 of a bias"),
    (_PLAIN, "FILTER", _FITS, CHECKED, "of a flat a filter that passes its light"),
    (_PLAIN, "BUNIT", _FITS, USED, "electron, or adu, else refused"),
    (_PLAIN, "GAIN", _FITS, USED, "electrons for each adu"),
    (_PLAIN, "NOISE", _FITS, REFUSED, "false: there is no noise by which pixels are weighed"),
    (_PLAIN, "RDNOISE", _FITS, USED, "read noise in electrons; none where it is absent"),
    (_PLAIN, "SATURATE", _FITS, USED, "counts from which on a pixel is masked SAT"),
    (_PLAIN, " ".join(SENSOR_NAMES), _FITS, CHECKED, "the same sensor in all images"),
    (_PLAIN, "DATASEC TRIMSEC", _FITS, CHECKED, "as large as the image: no overscan in it"),
    (_AMPLIFIERS, "INSTRUME", _FITS, CHECKED, "a camera that is not one of LSST"),
    (_AMPLIFIERS, "DATASEC", _FITS, USED, "pixels of the sensor; what lies right of them is overscan"),
    (_AMPLIFIERS, "DETSEC", _FITS, USED, "where they belong"),
    (_AMPLIFIERS, "DETSIZE", _FITS, CHECKED, "the size that all amplifiers cover once"),
    (_AMPLIFIERS, "BUNIT", _FITS, CHECKED, "adu"),
    (_AMPLIFIERS, "GAIN", _FITS, USED, "electrons for each adu, of each amplifier its own"),
    (_AMPLIFIERS, "RDNOISE", _FITS, USED, "read noise in electrons; none where it is absent"),
    (_AMPLIFIERS, "SATURATE", _FITS, USED, "counts from which on a pixel is masked SAT"),
    (_OBSERVED, "BUNIT", "templates", USED, "one unit in all frames; a correction is in that of its frame"),
    (
        _OBSERVED,
        " ".join((*SENSOR_NAMES, "EXTNAME", *PLACE_NAMES)),
        _CORRECTION,
        USED,
        "the sensor, of which the templates are; each image of a file has its own",
    ),
    (
        _OBSERVED,
        " ".join(FILTER_NAMES),
        _CORRECTION,
        USED,
        "the filter: one in all frames, and that of the templates",
    ),
    (_OBSERVED, " ".join(CORRECTED_BY), _CORRECTION, REFUSED, "fringes were subtracted before"),
    (_OBSERVED, "DATE-OBS", "templates", USED, "the last one dates the templates"),
    (_OBSERVED, "OBSDATE", "templates", USED, "the same where DATE-OBS is absent"),
    (_OBSERVED, "PLVER", _CORRECTION, USED, "version of the DECam pipeline: bits or codes in its masks"),
    (_OBSERVED, "UTYPE", _CORRECTION, USED, "of UNCERT: standard deviation, variance or its inverse"),
    (_OBSERVED, "MP_<plane>", _CORRECTION, USED, "bit of a plane of the mask, 0 to 62"),
    (_OBSERVED, "DATAMODL", _CORRECTION, USED, "a file of lsst.images, with sensor and filter in a table"),
    (_OBSERVED, "MSKNn", _CORRECTION, USED, "name of a plane of its mask"),
    (_OBSERVED, "MSKMn", _CORRECTION, USED, "bit of that plane"),
    (_ANY, "PRODUCT", "all", CHECKED, "the kind of file that the reader wants"),
    (_ANY, "PRODVER", "all", CHECKED, "the version of the layout"),
    (_ANY, "NEXTEND", "all", CHECKED, "the number of extensions"),
    (_ANY, "CHECKSUM DATASUM", "all", CHECKED, "right, and there in a file of this package"),
    (_ANY, "MP_<plane>", "all", USED, "bit of a plane of the mask; a plane that is not known is refused"),
)

FILE_KEYWORDS: tuple[FileKeyword, ...] = tuple(
    FileKeyword(file, name, *others) for file, names, *others in _TABLE for name in names.split()
)
"""All of them."""


def declared_names(file: str) -> frozenset[str]:
    """Keywords that are declared of a kind of file."""
    return frozenset(item.name for item in FILE_KEYWORDS if item.file == file)
