"""Numbers of whole stages as they were recorded: a change of any of them is to be seen, and agreed to.

They are no truth. They stand where no independent calculation covers everything that a stage gives, so that an edit
that was not meant to change a result is noticed. ``pytest --record-numbers TESTS`` records those of the named tests
anew, in `tests/records`.
"""

import base64
import dataclasses
import io
import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
from astropy.io import fits
from astropy.table import Table
from PIL import Image

RELATIVE, RELATIVE_ELSEWHERE = 1e-6, 1e-3
"""Part of a number by which it may differ. Other processors sum in another order, so that a pixel at a limit may fall
on its other side."""

GREY, GREY_ELSEWHERE = 2.0, 8.0  # Of 255: letters are drawn otherwise by other versions of the fonts
PROCESSOR = llvmlite.binding.get_host_cpu_name()
MADE_ON = "made on"  # Row of a record that was made on another processor than `records/processor.txt` states

Leaf = float | str | list[float] | list[str]


class Words(list[str]):
    """Words that are compared one by one, whatever they are made of."""


_NUMBER = re.compile(r"(?<![\w.])[-−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_OF_A_RUN = re.compile(
    r"date|time|version|command|host|path|file|checksum|datasum|platform|python|elapsed|seconds", re.I
)
_MADE = re.compile(
    r'<div class="(?:all )?made">.*?</div>|<div class="all"><dt>see also.*?</div>|<style>.*?</style>'
)
_PICTURE = re.compile(r'"data:image/png;base64,([^"]*)"')


def numbers_of(value: Any, name: str = "") -> Iterator[tuple[str, Leaf]]:
    """Names and values of all numbers and words in a result, a file or a folder, without times, versions, paths."""
    if isinstance(value, Path):
        yield from _of_path(value, name)
    elif isinstance(value, Words):
        yield f"{name}=", list(value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield from numbers_of({one.name: getattr(value, one.name) for one in dataclasses.fields(value)}, name)
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            if not _OF_A_RUN.search(str(key)):
                yield from numbers_of(inner, f"{name}/{key}")
    elif isinstance(value, Table):
        yield from numbers_of({column: value[column] for column in value.colnames}, name)
    elif isinstance(value, bool | str | None.__class__):
        if not isinstance(value, str) or re.fullmatch(r"[A-Za-z_ +.-]{1,60}", value):
            yield name, str(value)
    elif isinstance(value, complex | np.complexfloating):
        yield f"{name}#", [float(value.real), float(value.imag), abs(value)]
    elif isinstance(value, int | float | np.number):
        yield name, float(value)
    elif isinstance(value, list | tuple | np.ndarray):
        yield from _of_values(value, name)


def _of_values(values: Any, name: str) -> Iterator[tuple[str, Leaf]]:
    try:
        array = np.asarray(np.ma.filled(values, np.nan) if np.ma.isMaskedArray(values) else values)
        if array.dtype.kind == "c":
            array = np.stack([array.real, array.imag], axis=-1)
        plain = array.dtype.kind in "biuf"
    except ValueError:  # parts of unequal lengths
        plain = False
    if plain and array.size:
        finite = np.where(np.isfinite(array), array, 0.0).astype(float).ravel()
        weights = np.cos(1.0 + 1.7 * np.arange(finite.size))
        sums = [finite.mean(), float(weights @ finite) / math.sqrt(finite.size)]
        rms = math.sqrt(float(finite @ finite) / finite.size)
        yield f"{name}#", [float(array.size), float(np.isfinite(array).sum()), rms, *map(float, sums)]
    elif not plain:
        for number, inner in enumerate(values):
            yield from numbers_of(
                inner.item() if isinstance(inner, np.generic) else inner, f"{name}/{number}"
            )


def _of_path(path: Path, name: str) -> Iterator[tuple[str, Leaf]]:
    if path.is_dir():
        for inner in sorted(path.rglob("*")):
            if inner.is_file():
                yield from _of_path(inner, f"{name}/{inner.relative_to(path).as_posix()}")
        return
    yield name, path.suffix
    if path.suffix in (".fits", ".fz"):
        with fits.open(path) as units:
            for number, unit in enumerate(units):
                yield from numbers_of(dict(unit.header), f"{name}/{number}")
                data = unit.data
                yield from numbers_of(
                    Table(data) if data is not None and data.dtype.names else data, f"{name}/{number}/data"
                )
    elif path.suffix == ".ecsv":
        yield from numbers_of(Table.read(path), name)
    elif path.suffix == ".json":
        yield from numbers_of(json.loads(path.read_text()), name)
    elif path.suffix == ".png":
        yield f"{name}~", _greys(path.read_bytes())
    elif path.suffix == ".html":
        page = _MADE.sub("", path.read_text(encoding="utf-8"))
        yield f"{name}=", _shown(page)
        for number, picture in enumerate(_PICTURE.findall(page)):
            yield f"{name}/{number}~", _greys(base64.b64decode(picture))
    elif path.suffix in (".txt", ".csv", ".md", ".yaml"):
        yield f"{name}=", _shown(path.read_text(encoding="utf-8"))


def _shown(text: str) -> list[str]:
    """Numbers in a text, as they are written; the rows of its tables count with their colours."""
    marks = [
        f"{tag} {text.count(tag)}" for tag in ("<tr", "<figure", "<img", 'class="good"', 'class="bad"', "<li")
    ]
    plain = re.sub(r"\S*/\S*", " ", re.sub(r"<[^>]*>", " ", text))
    return [*marks, *_NUMBER.findall(plain)]


def _greys(picture: bytes) -> list[float]:
    """Size of a picture, and its mean brightness in 8 x 8 parts."""
    image = Image.open(io.BytesIO(picture)).convert("L")
    return [*map(float, image.size), *np.asarray(image.resize((8, 8), Image.Resampling.BOX), float).ravel()]


def differences(found: Mapping[str, Leaf], known: Mapping[str, Leaf], *, here: bool = True) -> list[str]:
    """What is there now and was not, what is missing, and what is another number than was recorded.

    ``here``: whether the record was made on a processor of this kind; written numbers are not compared otherwise.
    """
    said = [f"{name}: not recorded" for name in found.keys() - known.keys()]
    said += [f"{name}: missing" for name in known.keys() - found.keys()]
    for name in found.keys() & known.keys():
        if not _same(name, found[name], known[name], here):
            said.append(f"{name}: {found[name]!r}, recorded {known[name]!r}")
    return sorted(said)


def _same(name: str, found: Any, known: Any, here: bool) -> bool:
    relative, grey = (RELATIVE, GREY) if here else (RELATIVE_ELSEWHERE, GREY_ELSEWHERE)
    if isinstance(found, str) or isinstance(known, str):
        return bool(found == known)
    if name.endswith("="):
        return len(found) == len(known) and (not here or all(map(_same_text, found, known)))
    if np.shape(found) != np.shape(known):
        return False
    if name.endswith("~"):
        return found[:2] == known[:2] and bool(np.all(np.abs(np.subtract(found, known)) <= grey))
    scale = abs(np.nan_to_num(known[2] if name.endswith("#") else known, posinf=0.0, neginf=0.0))
    return np.allclose(found, known, rtol=relative, atol=relative * scale + 1e-12, equal_nan=True)


def _same_text(found: str, known: str) -> bool:
    """Whether two written numbers are as near as rounding to their last digit leaves them."""
    if found == known or not _NUMBER.fullmatch(known):
        return found == known
    digits, _, power = known.replace("−", "-").partition("e")
    last = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    try:
        return abs(float(found.replace("−", "-")) - float(known.replace("−", "-"))) <= 1.01 * last * (
            "." in digits or bool(power)
        )
    except ValueError:
        return False


@dataclasses.dataclass(frozen=True)
class Record:
    """The file that holds the numbers of one test."""

    file: Path
    anew: bool

    def __call__(self, value: Any) -> None:
        """Fail if a number is another than was recorded; write all if they are recorded anew."""
        found = dict(numbers_of(value))
        usual = (self.file.parents[1] / "processor.txt").read_text().strip()
        if self.anew:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            made = {} if usual == PROCESSOR else {MADE_ON: PROCESSOR}
            named = sorted({**found, **made}.items())
            rows = (f"{json.dumps(name)}: {json.dumps(_short(leaf))}" for name, leaf in named)
            self.file.write_text("{\n" + ",\n".join(rows) + "\n}\n")
            return
        assert self.file.exists(), f"nothing is recorded in {self.file}: pytest --record-numbers"
        known = json.loads(self.file.read_text())
        wrong = differences(found, known, here=known.pop(MADE_ON, usual) == PROCESSOR)
        assert not wrong, (
            "other numbers than recorded (pytest --record-numbers if they are meant):\n"
            + "\n".join(wrong[:20])
        )


def _short(leaf: Leaf) -> Leaf:
    if isinstance(leaf, list):
        return [one if isinstance(one, str) else float(f"{one:.10g}") for one in leaf]
    return leaf if isinstance(leaf, str) else float(f"{leaf:.10g}")
