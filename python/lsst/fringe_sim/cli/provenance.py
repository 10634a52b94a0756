"""``fringe-sim provenance``."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from uuid import UUID

import click

from ..errors import LONGEST_VALUE, FrameFormatError, InputError, UnknownNameError, printable_name, shown
from ..files import json_text
from .command import argument, command, flag, option

BUTLER = "LSST BUTLER "

_ERRORS = {"QUADERR": "quadrature", "INTERR": "interpolation"}
_SEEDS = {"SEED": "noise or search", "NIGHTSD": "random nights", "STANDSD": "stand-in thickness"}
_DIGESTS = {"CFGHASH": "this task", "SKYCFG": "the sky frames"}
_FORMAT = re.compile(
    r"SIMPLE|BITPIX|NAXIS\d*|EXTEND|CHECKSUM|DATASUM|NEXTEND|COMMENT|HISTORY|INHERIT|EXPINFO_V|__.*"
)
_INPUT = re.compile(BUTLER + r"INPUT (\d{1,9}) (\w+)")


@command()
def provenance(
    targets: tuple[str, ...] = argument("FILE|REPO..."),
    dataset_type: str | None = option("Of a repository: which datasets, as epoxyThickness.", metavar="NAME"),
    collections: str = option("Of a repository: where they are.", "*"),
    where: str = option('Of a repository: a condition on the data ids, as "detector=37".', ""),
    as_json: bool = flag("One JSON document, for programs.", "--json"),
) -> None:
    """Say what products were made with and from.

    FILE is a FITS, ECSV or JSON file of this package. REPO is a Butler repository; the inputs of its datasets are
    looked up there. Tables whose numbers differ from those installed here are marked.

    \b
    Examples:
      fringe-sim provenance fit/thickness.fits
      fringe-sim provenance REPO --dataset-type fringe --collections u/me/sky --where "instrument='LSSTCam'"
    """
    records: list[dict[str, Any]] = []
    for target in targets:
        if Path(target).is_dir() or dataset_type:
            if not dataset_type:
                raise InputError("--dataset-type", None, "a dataset type, as epoxyThickness", source=target)
            records += _in_repository(target, dataset_type, collections, where)
        else:
            records.append({"file": target, **describe(read_header(target))})
    if as_json:
        click.echo(json_text(records))
        return
    click.echo("\n\n".join(_as_text(record) for record in records))


def read_header(path: str) -> dict[str, Any]:
    """Keywords of a product and their values.

    ``path``: FITS file, ECSV table, or JSON document with an entry ``provenance``.
    """
    from ..resources import DAMAGE, first_line

    if not Path(path).is_file():
        raise InputError("file", path, "an existing file, or a repository with --dataset-type")
    suffix = Path(path).suffix
    damage: tuple[type[Exception], ...] = (*DAMAGE, RecursionError)
    readers = {".ecsv": _table_header, ".json": _document_header}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            header = readers.get(suffix, _fits_header)(path)
            _check_text(header, path)
            return header
    except InputError as error:
        raise (error if error.source else error.in_source(path)) from None
    except damage as error:
        raise FrameFormatError(
            "file", first_line(error), "an undamaged FITS, ECSV or JSON product", source=path
        ) from None


def _check_text(value: Any, path: str) -> None:
    """Refuse keywords and texts that would do something to a terminal, or that no header holds."""
    if isinstance(value, Mapping):
        for key in value:
            printable_name("keyword", str(key), source=path)
    items = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    for item in items:
        _check_text(item, path)
    if isinstance(value, str) and not value.replace("\n", "").replace("\t", "").isprintable():
        raise FrameFormatError("text", value, "printable characters", source=path)


def _fits_header(path: str) -> dict[str, Any]:
    from astropy.io.fits.card import Undefined

    from ..resources import open_user_fits

    with open_user_fits(path) as hdus:
        header = hdus[0].header
        return {key: header[key] for key in header if key and not isinstance(header[key], Undefined)}


def _table_header(path: str) -> dict[str, Any]:
    from ..resources import read_user_table

    return {str(key): value for key, value in read_user_table(path, "table").meta.items()}


def _document_header(path: str) -> dict[str, Any]:
    from ..resources import read_user_text

    content = json.loads(read_user_text(path, "document"), object_pairs_hook=_each_key_once)
    if not isinstance(content, dict) or not isinstance(content.get("provenance"), dict):
        raise FrameFormatError(
            "JSON document", "no provenance", "one with an entry 'provenance'", source=path
        )
    return dict(content["provenance"])


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        raise FrameFormatError("key", next(key for key in keys if keys.count(key) > 1), "a key once")
    return made


def describe(header: Mapping[str, Any]) -> dict[str, Any]:
    """Sort the keywords of a product by what they say.

    ``header``: keywords and values.
    ``product``, ``software``, ``configuration``, ``setup``, ``effects``, ``tables``, ``seeds``, ``errors``,
        ``dataset``, ``inputs``, and under ``other`` what is left. Plain values, ready for JSON.
    """
    from ..model.provenance import effects_of_header

    software = {
        key.removeprefix("VERSION ").lower(): value
        for key, value in header.items()
        if key.startswith("VERSION ")
    }
    effects = effects_of_header(header)
    tables = _tables(header)
    inputs = _inputs(header)
    dataset = {
        key.removeprefix(BUTLER).lower(): value
        for key, value in header.items()
        if key.startswith(BUTLER) and not _INPUT.fullmatch(key) and not key.startswith(f"{BUTLER}INPUT ")
    }
    known = {"PRODUCT", "ORIGIN", "FSIMVER", "SETUP", *_ERRORS, *_SEEDS, *_DIGESTS}
    numbered = re.compile(r"(EFFECT|EFFVAL|TABLE|INPUT)\d+|VERSION .*|LSST BUTLER .*")
    return {
        "product": header.get("PRODUCT"),
        "software": {str(header.get("ORIGIN", "unknown")): header.get("FSIMVER"), **software},
        "configuration": {text: header[key] for key, text in _DIGESTS.items() if key in header},
        "setup": header.get("SETUP"),
        "effects": effects,
        "tables": tables,
        "seeds": {text: header[key] for key, text in _SEEDS.items() if key in header},
        "errors": {text: header[key] for key, text in _ERRORS.items() if key in header},
        "dataset": dataset,
        "inputs": inputs,
        "other": {
            key: _plain(value)
            for key, value in header.items()
            if key not in known and not numbered.fullmatch(key) and not _FORMAT.fullmatch(key)
        },
    }


def _plain(value: Any) -> Any:
    return value if isinstance(value, bool | int | float | str | None) else str(value)


def _tables(header: Mapping[str, Any]) -> list[dict[str, str]]:
    found = []
    number = 0
    while f"TABLE{number}" in header:
        name, _, stated = str(header[f"TABLE{number}"]).rpartition(" ")
        found.append({"table": name, "revision": stated, "here": _compared(name, stated)})
        number += 1
    return found


def _compared(name: str, stated: str) -> str:
    from ..resources import revision

    folder, _, file = name.rpartition("/")
    if folder == "own":
        return "not shipped"
    try:
        return "same" if revision(folder, file) == stated else "differs"
    except (UnknownNameError, OSError):
        return "absent"


def _inputs(header: Mapping[str, Any]) -> list[dict[str, str]]:
    from ..model.provenance import inputs_of_header

    found: dict[int, dict[str, str]] = {}
    for key, value in header.items():
        match = _INPUT.fullmatch(key)
        if match:
            found.setdefault(int(match[1]), {})[match[2].lower()] = str(value)
    files = [{"file": name, "sha256": content} for name, content in inputs_of_header(header)]
    return [found[number] for number in sorted(found)] + files


def _in_repository(repo: str, dataset_type: str, collections: str, where: str) -> Iterator[dict[str, Any]]:
    from lsst.daf.butler import ButlerUserError
    from lsst.daf.butler.registry import RegistryError

    from ..middleware.repository import open_repository

    with open_repository(repo) as butler:
        try:
            refs = sorted(
                set(
                    butler.registry.queryDatasets(
                        dataset_type, collections=collections.split(","), where=where
                    )
                )
            )
        except (ButlerUserError, RegistryError, LookupError) as error:
            asked = " ".join((dataset_type, collections, where))
            raise InputError("datasets", asked, f"what {repo} knows ({error})") from error
        if not refs:
            raise InputError(
                "datasets", 0, f"at least one {dataset_type} in {collections} where {where or 'all'}"
            )
        for ref in refs:
            record = describe(read_header(butler.getURI(ref).ospath))
            for item in record["inputs"]:
                if "file" in item:
                    continue
                item["data id"] = _data_id(butler, item.get("id", ""))
            yield {"file": f"{dataset_type} {ref.dataId.required} in {ref.run}", **record}


def _data_id(butler: Any, text: str) -> str:
    """Data id of an input, as long as the repository has it."""
    try:
        ref = butler.get_dataset(UUID(text))
    except ValueError:
        ref = None
    return "not in this repository" if ref is None else str(dict(ref.dataId.required))


def _as_text(record: Mapping[str, Any]) -> str:
    lines = [str(record["file"])]
    for name in ("product", "setup"):
        if record[name] is not None:
            lines.append(f"  {name}: {_short(record[name])}")
    for name in ("software", "configuration", "effects", "seeds", "errors", "dataset", "other"):
        content = record[name]
        if content:
            lines.append(f"  {name}:")
            lines += [f"    {_short(key)}: {_short(value)}" for key, value in content.items()]
    if record["tables"]:
        lines.append("  tables:")
        lines += [
            f"    {_short(item['table'])} {_short(item['revision'])}"
            + ("" if item["here"] in ("same", "not shipped") else f" ({item['here']} here)")
            for item in record["tables"]
        ]
    if record["inputs"]:
        lines.append(f"  inputs: {len(record['inputs'])}")
        lines += [f"    {' '.join(map(_short, item.values()))}" for item in record["inputs"]]
    return "\n".join(lines)


def _short(value: Any) -> str:
    """What people see of a value; JSON has all of it."""
    return shown(str(value), LONGEST_VALUE)
