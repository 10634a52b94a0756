"""Where the shipped numbers come from, and what has changed: read from the files themselves."""

from __future__ import annotations

from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import yaml

from .markdown import code, sections, table

REQUIRED = ("source", "doi", "licence")
CHANGES = Path(__file__).parents[2] / "changes"
CHANGELOG = Path(__file__).parents[3] / "CHANGELOG.md"
KINDS = {
    "feature": "New",
    "api": "Changes of interfaces",
    "bugfix": "Corrections",
    "perf": "Speed",
    "doc": "Documentation",
}


def tables() -> str:
    """Every shipped file with its source, DOI and licence; one that does not state them stops the build."""
    base = resources.files("lsst.fringe_sim") / "data"
    parts = []
    for folder in sorted((entry for entry in base.iterdir() if entry.is_dir()), key=lambda each: each.name):
        rows = []
        for file in sorted(folder.iterdir(), key=lambda each: each.name):
            for name, meta in _entries(file):
                what = meta.get("description") or meta.get("title") or ""
                rows.append((code(name), what, meta["source"], meta["doi"], meta["licence"]))
        if rows:
            parts += [
                f"## `data/{folder.name}`",
                table(("file", "content", "source", "DOI", "licence"), rows),
            ]
    return sections(parts)


def _entries(file: Traversable) -> list[tuple[str, dict[str, Any]]]:
    if file.name.endswith(".ecsv"):
        entries = [(file.name, _ecsv_meta(file))]
    elif file.name.endswith(".yaml"):
        entries = _yaml_entries(file.name, yaml.safe_load(file.read_text(encoding="utf-8")))
    else:
        entries = []
    for name, meta in entries:
        missing = [key for key in REQUIRED if not meta.get(key)]
        if missing:
            raise ValueError(f"{name} does not state its {', '.join(missing)}")
    return entries


def _ecsv_meta(file: Traversable) -> dict[str, Any]:
    header = []
    with file.open("r", encoding="utf-8") as lines:
        for line in lines:
            if not line.startswith("#"):
                break
            header.append(line[2:])
    content = yaml.load("".join(header[1:]), Loader=_HeaderLoader)  # noqa: S506 - a safe loader
    return {key: value for item in content["meta"] for key, value in item.items()}


class _HeaderLoader(yaml.SafeLoader):
    """Reads the ordered mapping of an ECSV header as the list of pairs that it is written as."""


_HeaderLoader.add_constructor("!!omap", lambda loader, node: loader.construct_sequence(node, deep=True))
_HeaderLoader.add_constructor(
    "tag:yaml.org,2002:omap", lambda loader, node: loader.construct_sequence(node, deep=True)
)


def _yaml_entries(name: str, content: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    if name != "media.yaml":
        # A set-up combines files that state their licence; its own numbers are facts from its source.
        return [(name, {"doi": "see source", "licence": "facts", **content})]
    return [
        (f"{name}: {medium}", {"doi": "none", "licence": "facts", "description": _constant(entry), **entry})
        for medium, entry in content.items()
        if "constant" in entry
    ]


def _constant(entry: dict[str, Any]) -> str:
    n, k = entry["constant"]
    return f"constant index {n:g} + {k:g} i"


def _note(text: str) -> str:
    """One item; what is a list already, perhaps below a line that names a group, stays as it is."""
    return text.strip() if text.startswith("- ") or "\n\n- " in text else f"- {' '.join(text.split())}"


def changes() -> str:
    """The changelog, below notes that no version has yet."""
    parts = []
    notes = [path for path in sorted(CHANGES.glob("*.md")) if path.name != "README.md"]
    for kind, heading in KINDS.items():
        of_kind = [path.read_text(encoding="utf-8") for path in notes if path.name.endswith(f".{kind}.md")]
        if of_kind:
            parts += [f"### {heading}", *map(_note, of_kind)]
    if any(not path.name.endswith(tuple(f".{kind}.md" for kind in KINDS)) for path in notes):
        raise ValueError(f"a note in {CHANGES} is not named <name>.<{'|'.join(KINDS)}>.md")
    _, _, released = CHANGELOG.read_text(encoding="utf-8").partition("<!-- towncrier release notes start -->")
    return sections([*(["## Next version", *parts] if parts else []), released.strip()])
