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


SENSOR_NAMES = ("DETNAME", "DETECTOR", "CCDNAME", "DETPOS", "CCDNUM", "CCDID")
"""Keywords by which cameras name a sensor; the first that is stated counts."""

FILTER_NAMES = ("FILTER", "FILTNAM", "FILTERID")  # Keywords of the filter; the first that is stated counts

_MAP, _CUBE, _SKY, _ANY = "thickness map", "fringe cube", "sky frame", "any product"
_PLAIN, _AMPLIFIERS, _OBSERVED = "plain flat", "flat of amplifiers", "observed frame"
_SEARCH, _SKY_READERS = "fit, discover, Tasks", "sky, discover, Tasks"
_FITS, _CORRECTION = "fit, discover", "templates, correct"

FILE_KEYWORDS: tuple[FileKeyword, ...] = (
    FileKeyword(
        _MAP,
        "BUNIT",
        _SKY_READERS,
        USED,
        "unit of length, converted to µm; a unit of another kind is refused",
    ),
    FileKeyword(_MAP, "LAYER", _SKY_READERS, CHECKED, "the layer that varies in the set-up"),
    FileKeyword(_MAP, "DETSEC", _SKY_READERS, USED, "part of the sensor; pixels that it has not are refused"),
    FileKeyword(_MAP, "CCDSEC", _SKY_READERS, USED, "the same where DETSEC is absent"),
    FileKeyword(_MAP, "CONTRAST", "sky", USED, "contrast of the laboratory, for the second forecast"),
    FileKeyword(_MAP, "CONTRSIG", "sky", USED, "its uncertainty"),
    FileKeyword(
        _CUBE, "BUNIT", _SEARCH, USED, "electron or relative, else refused; that of VARIANCE is its square"
    ),
    FileKeyword(_CUBE, "LAYER", _SEARCH, USED, "layer of THICKNESS"),
    FileKeyword(_CUBE, "SMOOTHPX", _SEARCH, USED, "correlation length of the noise, px"),
    FileKeyword(_CUBE, "NOISE", _SEARCH, REFUSED, "false: there is no noise by which pixels are weighed"),
    FileKeyword(_SKY, "BUNIT", "discover, templates, Tasks", USED, "electron or fraction, else refused"),
    FileKeyword(_SKY, "NOISE", "discover", REFUSED, "false: there is no noise by which pixels are weighed"),
    FileKeyword(_SKY, "FRINGCOR", "templates, Tasks", REFUSED, "fringes were subtracted before"),
    FileKeyword(_SKY, "SETUP", "discover, templates, Tasks", CHECKED, "the same in all frames"),
    FileKeyword(_SKY, "BEAMS", "discover, templates, Tasks", CHECKED, "the same in all frames"),
    FileKeyword(_SKY, "EFFECTn", "discover, templates, Tasks", CHECKED, "the same in all frames"),
    FileKeyword(_SKY, "EFFVALn", "discover, templates, Tasks", CHECKED, "the same in all frames"),
    FileKeyword(_SKY, "TABLEn", "discover, templates, Tasks", CHECKED, "the same in all frames"),
    FileKeyword(
        _SKY, "RDNOISE", "discover, templates", USED, "read noise in electrons; none where it is absent"
    ),
    FileKeyword(
        _PLAIN, "IMGTYPE", _FITS, USED, "flat, as where it is absent, or bias or zero; others are left out"
    ),
    *(
        FileKeyword(
            _PLAIN,
            name,
            _FITS,
            USED,
            "wavelength in nm, 200 to 1300; two that differ by more than 1 nm are refused",
        )
        for name in ("MONOWL", "WAVELEN", "WAVELNTH")
    ),
    FileKeyword(_PLAIN, "TEMPK", _FITS, USED, "temperature in K, in place of that of the set-up"),
    FileKeyword(
        _PLAIN, "CCDTEMP", _FITS, USED, "temperature in °C where TEMPK is absent; else the same within 5 °C"
    ),
    FileKeyword(
        _PLAIN, "EXPTIME", _FITS, USED, "seconds of dark current; more than 0 of a flat, 0 of a bias"
    ),
    FileKeyword(_PLAIN, "FILTER", _FITS, CHECKED, "of a flat a filter that passes its light"),
    FileKeyword(_PLAIN, "BUNIT", _FITS, USED, "electron, or adu, else refused"),
    FileKeyword(_PLAIN, "GAIN", _FITS, USED, "electrons for each adu"),
    FileKeyword(_PLAIN, "NOISE", _FITS, REFUSED, "false: there is no noise by which pixels are weighed"),
    FileKeyword(_PLAIN, "RDNOISE", _FITS, USED, "read noise in electrons; none where it is absent"),
    FileKeyword(_PLAIN, "SATURATE", _FITS, USED, "counts from which on a pixel is masked SAT"),
    *(FileKeyword(_PLAIN, name, _FITS, CHECKED, "the same sensor in all images") for name in SENSOR_NAMES),
    FileKeyword(_PLAIN, "DATASEC", _FITS, CHECKED, "as large as the image: no overscan in it"),
    FileKeyword(_PLAIN, "TRIMSEC", _FITS, CHECKED, "as large as the image: no overscan in it"),
    FileKeyword(_AMPLIFIERS, "INSTRUME", _FITS, CHECKED, "a camera that is not one of LSST"),
    FileKeyword(
        _AMPLIFIERS, "DATASEC", _FITS, USED, "pixels of the sensor; what lies right of them is overscan"
    ),
    FileKeyword(_AMPLIFIERS, "DETSEC", _FITS, USED, "where they belong"),
    FileKeyword(_AMPLIFIERS, "DETSIZE", _FITS, CHECKED, "the size that all amplifiers cover once"),
    FileKeyword(_AMPLIFIERS, "BUNIT", _FITS, CHECKED, "adu"),
    FileKeyword(_AMPLIFIERS, "GAIN", _FITS, USED, "electrons for each adu, of each amplifier its own"),
    FileKeyword(_AMPLIFIERS, "RDNOISE", _FITS, USED, "read noise in electrons; none where it is absent"),
    FileKeyword(_AMPLIFIERS, "SATURATE", _FITS, USED, "counts from which on a pixel is masked SAT"),
    FileKeyword(
        _OBSERVED, "BUNIT", "templates", USED, "one unit in all frames; a correction is in that of its frame"
    ),
    *(
        FileKeyword(
            _OBSERVED,
            name,
            _CORRECTION,
            USED,
            "the sensor, of which the templates are; each image of a file has its own",
        )
        for name in (*SENSOR_NAMES, "EXTNAME")
    ),
    *(
        FileKeyword(
            _OBSERVED, name, _CORRECTION, USED, "the filter: one in all frames, and that of the templates"
        )
        for name in FILTER_NAMES
    ),
    *(
        FileKeyword(_OBSERVED, name, _CORRECTION, REFUSED, "fringes were subtracted before")
        for name in CORRECTED_BY
    ),
    FileKeyword(_OBSERVED, "DATE-OBS", "templates", USED, "the last one dates the templates"),
    FileKeyword(_OBSERVED, "OBSDATE", "templates", USED, "the same where DATE-OBS is absent"),
    FileKeyword(
        _OBSERVED, "PLVER", _CORRECTION, USED, "version of the DECam pipeline: bits or codes in its masks"
    ),
    FileKeyword(
        _OBSERVED, "UTYPE", _CORRECTION, USED, "of UNCERT: standard deviation, variance or its inverse"
    ),
    FileKeyword(_OBSERVED, "MP_<plane>", _CORRECTION, USED, "bit of a plane of the mask, 0 to 62"),
    FileKeyword(_ANY, "PRODUCT", "all", CHECKED, "the kind of file that the reader wants"),
    FileKeyword(_ANY, "PRODVER", "all", CHECKED, "the version of the layout"),
    FileKeyword(_ANY, "NEXTEND", "all", CHECKED, "the number of extensions"),
    FileKeyword(_ANY, "CHECKSUM", "all", CHECKED, "right, and there in a file of this package"),
    FileKeyword(_ANY, "DATASUM", "all", CHECKED, "right, and there in a file of this package"),
    FileKeyword(
        _ANY, "MP_<plane>", "all", USED, "bit of a plane of the mask; a plane that is not known is refused"
    ),
)
"""All of them."""


def declared_names(file: str) -> frozenset[str]:
    """Keywords that are declared of a kind of file."""
    return frozenset(item.name for item in FILE_KEYWORDS if item.file == file)
