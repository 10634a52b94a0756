"""One version, wherever it is stated."""

import re
from pathlib import Path

import yaml

from lsst.fringe_sim import __version__

CHECKOUT = Path(__file__).resolve().parents[1]


def numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def test_citation_and_changelog_state_the_version() -> None:
    """The changelog may be behind while notes wait for it."""
    assert yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == __version__
    released = re.findall(
        r"^## ([\d.]+) ", (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    notes = list((CHECKOUT / "doc" / "changes").glob("*.*.md"))
    assert released[0] == __version__ or (notes and numbers(released[0]) < numbers(__version__))
