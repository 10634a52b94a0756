"""Parts of the test suite that together are the whole of it, chosen by the names of the tests."""

from __future__ import annotations

import argparse
import zlib
from dataclasses import dataclass

import pytest


@dataclass(frozen=True)
class Share:
    """The ``number``-th of ``out_of`` parts, counted from one."""

    number: int
    out_of: int

    @classmethod
    def parse(cls, text: str) -> Share:
        """Read ``K/N``."""
        number, _, out_of = text.partition("/")
        if not (number.isdigit() and out_of.isdigit() and 1 <= int(number) <= int(out_of)):
            raise argparse.ArgumentTypeError(f"a share is K/N with 1 <= K <= N, not {text!r}")
        return cls(int(number), int(out_of))

    def has(self, group: str) -> bool:
        """Whether a group of tests belongs to this part."""
        return zlib.crc32(group.encode()) % self.out_of == self.number - 1


def group_of(item: pytest.Item) -> str:
    """Tests of one group stay together: those of a file that use what is prepared once for the file."""
    info = getattr(item, "_fixtureinfo", None)
    definitions = info.name2fixturedefs.values() if info else ()
    prepared = any(found[-1].scope in ("class", "module") for found in definitions)
    return item.nodeid.partition("::")[0] if prepared else item.nodeid
