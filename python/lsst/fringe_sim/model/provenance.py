"""What a product was made with, as header keywords: software, set-up, effects, tables.

The keywords are the same in every product, so that one reader understands all (``fringe-sim provenance``):

========================  ==============================================================================
``ORIGIN``, ``FSIMVER``   this package and its version
``VERSION <package>``     versions of the packages that compute
``SETUP``                 name of the set-up
``EFFECTn``, ``EFFVALn``  effects by ``name.parameter``, and their values
``TABLEn``                a table or description, shipped or of one's own, and the beginning of its SHA-256
``INPUTn``                a file that a command was given, and the beginning of its SHA-256
========================  ==============================================================================
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

from .. import __version__
from ..descriptions import is_file_name
from ..effects import activate_effects, apply_to_system, known_effects
from ..errors import FrameFormatError, InputError, UnknownNameError, to_number
from ..instrument.setup import Setup
from ..optics.stack import LayerStack
from ..optics.system import OpticalSystem
from ..resources import REVISION_LENGTH, read_user_yaml, read_yaml, revision

PACKAGES = {
    "NUMPY": "numpy",
    "SCIPY": "scipy",
    "ASTROPY": "astropy",
    "NUMBA": "numba",
    "SKLEARN": "scikit-learn",
    "BATOID": "batoid",
    "GALSIM": "galsim",
    "DAF_BUTLER": "lsst-daf-butler",
}
"""Distributions whose versions can change a result, by the word in their keyword."""

SKY_TABLES = (
    ("sky", "oh_lines_palace_yband.ecsv"),
    ("sky", "oh_levels_palace.ecsv"),
    ("sky", "oh_temporal_guo2022_noll2015.ecsv"),
    ("sky", "sky_airglow_continuum_eso_sm01.ecsv"),
    ("sky", "sky_zodiacal_leinert1998.ecsv"),
)
"""Line list, populations, their history and the continuum: what every simulated sky is made of."""


SILICON_LAWS = {"franta2017": "nk_Si_franta2017_T.ecsv", "green2008": "nk_Si_green2008.ecsv"}
"""Tables from which silicon's dependence on temperature comes, by the name of the law in ``media.yaml``."""


@functools.cache
def _software() -> dict[str, str]:
    cards = {"ORIGIN": "lsst.fringe_sim", "FSIMVER": __version__, "VERSION PYTHON": platform.python_version()}
    for word, package in PACKAGES.items():
        try:
            cards[f"VERSION {word}"] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return cards


def software_cards() -> dict[str, str]:
    """Keywords of package, Python and the packages that compute."""
    return dict(_software())


def effect_cards(effects: Mapping[str, float]) -> dict[str, str | float]:
    """Keywords ``EFFECTn`` and ``EFFVALn`` of effects by ``name.parameter``."""
    cards: dict[str, str | float] = {}
    for number, (name, value) in enumerate(sorted(effects.items())):
        cards[f"EFFECT{number}"], cards[f"EFFVAL{number}"] = name, value
    return cards


def effects_of_header(header: Mapping[str, Any]) -> dict[str, float]:
    """Effects by ``name.parameter`` that a header states; the inverse of `effect_cards`."""
    found: dict[str, float] = {}
    number = 0
    while f"EFFECT{number}" in header:
        name, value = str(header[f"EFFECT{number}"]), header.get(f"EFFVAL{number}")
        allowed = f"a finite number, the value of {name}"
        try:
            found[name] = to_number(f"EFFVAL{number}", value, allowed)
        except InputError as error:
            raise FrameFormatError(error.field, error.value, error.allowed) from None
        if not math.isfinite(found[name]):
            raise FrameFormatError(f"EFFVAL{number}", value, allowed)
        number += 1
    return found


def input_cards(paths: Iterable[str | os.PathLike[str]]) -> dict[str, str]:
    """Keywords ``INPUTn`` of files that a product is made from: name, without its folders, and content.

    A file that is named twice is stated once.
    """
    stated = dict.fromkeys(f"{_printable(Path(path).name)} {_content(path)}" for path in paths)
    return {f"INPUT{number}": text for number, text in enumerate(stated)}


def inputs_of_header(header: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and contents of the files that a header states; the inverse of `input_cards`."""
    found: list[tuple[str, str]] = []
    while f"INPUT{len(found)}" in header:
        name, _, content = str(header[f"INPUT{len(found)}"]).rpartition(" ")
        found.append((name, content))
    return found


def _content(path: str | os.PathLike[str]) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:REVISION_LENGTH]


def _printable(name: str) -> str:
    """A file name as a FITS header can hold it."""
    return "".join(letter if " " <= letter <= "~" else ascii(letter)[1:-1] for letter in name)


def tables_of(setup: Setup, stack: LayerStack | None = None) -> tuple[tuple[str, str], ...]:
    """Shipped files, as (folder, name), that a set-up takes its numbers from; `Setup.files` has the others.

    ``stack``: layers with the effects in them, which may bring media of their own; by default those of the
    set-up.
    """
    own = {Path(file).name for file in setup.files}
    described = [("setups", f"{setup.name}.yaml"), ("stacks", f"{setup.stack.name}.yaml")]
    shipped = [item for item in described if item[1] not in own]
    shipped.append(("media", "media.yaml"))
    shipped += _media(layer.medium.name for layer in (stack or setup.stack).layers)
    if setup.telescope:
        shipped.append(("telescopes", f"{setup.telescope.lower()}.yaml"))
    if setup.bandpass:
        shipped += [*_of_bandpass(setup.bandpass), *SKY_TABLES]
    return tuple(item for item in shipped if _exists(*item))


def _of_bandpass(name: str) -> list[tuple[str, str]]:
    """Description of a bandpass and its tables."""
    if is_file_name(name):
        content, found = read_user_yaml(name, "bandpass file"), []
    else:
        content, found = read_yaml("bandpasses", f"{name}.yaml"), [("bandpasses", f"{name}.yaml")]
    tables = [content["table"], *_table_of(content.get("detector"))]
    return [*found, *(("sky", str(table)) for table in tables)]


def _table_of(detector: Any) -> list[Any]:
    return [detector["table"]] if isinstance(detector, Mapping) else []


def _media(names: Iterable[str]) -> list[tuple[str, str]]:
    entries = read_yaml("media", "media.yaml")
    known = [entries[name] for name in sorted(set(names)) if "table" in entries.get(name, ())]
    files = [str(entry["table"]) for entry in known]
    files += [SILICON_LAWS[entry["temperature"]] for entry in known if "temperature" in entry]
    return [("media", file) for file in dict.fromkeys(files)]


def _exists(folder: str, name: str) -> bool:
    """Whether a file is shipped: a set-up of the user may name a stack or a telescope of the user."""
    try:
        revision(folder, name)
    except UnknownNameError:
        return False
    return True


def table_cards(tables: Iterable[tuple[str, str]], own: Iterable[str] = ()) -> dict[str, str]:
    """Keywords ``TABLEn``: ``folder/name revision``; the folder of files from outside is ``own``."""
    stated = [f"{folder}/{name} {revision(folder, name)}" for folder, name in tables]
    stated += [f"own/{_printable(Path(file).name)} {_content(file)}" for file in own]
    return {f"TABLE{number}": text for number, text in enumerate(stated)}


def model_cards(setup: str | Setup, effects: Mapping[str, float]) -> dict[str, str | float]:
    """Keywords of a fringe model: set-up, effects, tables."""
    chosen = Setup.from_name(setup) if isinstance(setup, str) else setup
    stack = apply_to_system(activate_effects(effects, known_effects()), _plain_light(chosen)).stack
    return {
        "SETUP": _printable(chosen.name),
        **effect_cards(effects),
        **table_cards(tables_of(chosen, stack), chosen.files),
    }


def _plain_light(setup: Setup) -> OpticalSystem:
    """The layers of a set-up under a parallel beam: no telescope is traced to learn of what the layers are."""
    return replace(setup, beam_kind="collimated").optical_system()
