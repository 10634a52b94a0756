"""One version, wherever it is stated."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from lsst.fringe_sim import __version__

CHECKOUT = Path(__file__).resolve().parents[1]


def test_citation_and_changelog_state_the_version() -> None:
    assert yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == __version__
    released = re.findall(
        r"^## ([\d.]+) ", (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert released[0] == __version__
