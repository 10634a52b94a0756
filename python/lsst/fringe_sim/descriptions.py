"""Descriptions in YAML from outside: set-ups and what they name, with the tables beside them."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import InputError, UnknownNameError, to_number
from .resources import REQUIRED_PROVENANCE, first_line, read_table, read_user_table, read_user_yaml

if TYPE_CHECKING:
    from astropy.table import Table

_NAMES = (
    ("camera",),
    ("stack",),
    ("media",),
    ("illumination", "bandpass"),
    ("illumination", "beam", "telescope"),
)
"""Entries of a set-up in which a file may stand for the name of something that is shipped."""


def is_file_name(text: str) -> bool:
    """Whether a text is the name of a file in YAML, and not that of something that is shipped."""
    return text.lower().endswith((".yaml", ".yml"))


def read_description(path: str | Path, what: str) -> Mapping[str, Any]:
    """Mapping of a YAML file from outside, which states where its numbers come from."""
    content = read_user_yaml(path, f"{what} file")
    reader = Description(content, str(path))
    for key in REQUIRED_PROVENANCE:
        reader.text(key)
    return dict(content)


def read_table_of(description: str | Path, name: str, section: str) -> Table:
    """Table that a description names: the file beside it, or else that which is shipped in a folder of the data."""
    path = Path(description).parent / name
    if not path.is_file():
        return read_table(section, name)
    table = read_user_table(path, "table")
    for key in REQUIRED_PROVENANCE:
        if not table.meta.get(key):
            raise InputError(key, None, "text in the header of the table", source=str(path))
    return table


@contextmanager
def described(what: str, allowed: str, source: str) -> Iterator[None]:
    """Report whatever is wrong in a description as an error of the file in which it stands."""
    try:
        yield
    except InputError as error:
        raise (error if error.source else error.in_source(source)) from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(what, first_line(error), allowed, source=source) from None


def with_files_beside(content: Any, path: str | Path) -> Any:
    """Content of the file of a set-up in which the names of other files are paths; they count from its folder."""
    if not isinstance(content, Mapping):
        return content
    found = copy.deepcopy(dict(content))
    for *sections, key in _NAMES:
        place: Any = found
        for section in sections:
            place = place.get(section) if isinstance(place, Mapping) else None
        if isinstance(place, dict) and isinstance(place.get(key), str) and is_file_name(place[key]):
            place[key] = str((Path(path).parent / place[key]).resolve())
    return found


def files_of(description: str | Path) -> tuple[str, ...]:
    """A description, and the tables beside it that it names."""
    folder = Path(description).parent
    tables = _tables(read_user_yaml(description, "description"))
    beside = [str(folder / name) for name in tables if (folder / name).is_file()]
    return tuple(dict.fromkeys([str(description), *beside]))


def _tables(content: Any) -> Iterator[str]:
    """Values of all keys ``table``."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            if key == "table" and isinstance(value, str):
                yield value
            yield from _tables(value)
    elif isinstance(content, list):
        for item in content:
            yield from _tables(item)


class Description:
    """Typed values from the mapping of a YAML file; every complaint names the key."""

    def __init__(self, content: Any, source: str, prefix: str = "") -> None:
        if not isinstance(content, Mapping):
            raise InputError(prefix or "content", content, "a mapping", source=source)
        self._content = content
        self._prefix = f"{prefix}." if prefix else ""
        self.source = source

    def _get(self, key: str) -> Any:
        if key not in self._content:
            raise InputError(f"{self._prefix}{key}", None, "a value (the key is missing)", source=self.source)
        return self._content[key]

    def section(self, key: str) -> Description:
        """The mapping under a key."""
        return Description(self._get(key), self.source, f"{self._prefix}{key}")

    def sections(self, key: str) -> list[Description]:
        """The mappings of a list under a key."""
        value = self._get(key)
        if not isinstance(value, list) or not value:
            raise InputError(f"{self._prefix}{key}", value, "a list of mappings", source=self.source)
        return [
            Description(item, self.source, f"{self._prefix}{key}[{number}]")
            for number, item in enumerate(value)
        ]

    def text(self, key: str) -> str:
        """Text in one line."""
        value = self._get(key)
        if not isinstance(value, str) or not value.strip():
            raise InputError(f"{self._prefix}{key}", value, "text", source=self.source)
        if not value.isprintable():
            allowed = "text in one line, without control characters"
            raise InputError(f"{self._prefix}{key}", value, allowed, source=self.source)
        return value

    def optional(self, key: str, default: str) -> str:
        """Text, or what is taken where there is none."""
        return self.text(key) if key in self._content else default

    def choice(self, key: str, allowed: tuple[str, ...]) -> str:
        """One of several words."""
        value = self._get(key)
        if value not in allowed:
            raise UnknownNameError(f"{self._prefix}{key}", value, allowed, source=self.source)
        return str(value)

    def number(self, key: str, *, low: float, high: float, default: float | None = None) -> float:
        """Number within bounds."""
        if default is not None and key not in self._content:
            return default
        value = self._get(key)
        good = isinstance(value, int | float) and not isinstance(value, bool)
        if not good or not low <= value <= high:
            raise InputError(f"{self._prefix}{key}", value, f"{low:g} to {high:g}", source=self.source)
        return float(value)

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """List of numbers."""
        value = self._get(key)
        good = isinstance(value, list) and all(isinstance(item, int | float) for item in value)
        if not good or not value or (count is not None and len(value) != count):
            wanted = f"a list of {count} numbers" if count else "a list of numbers"
            raise InputError(f"{self._prefix}{key}", value, wanted, source=self.source)
        return [to_number(f"{self._prefix}{key}", item, source=self.source) for item in value]
