"""What the page of the paper says first, and its panels."""

import math
from pathlib import Path
from typing import Any

import pytest

from lsst.fringe_sim.paper.published import Finding, PublishedNumber
from lsst.fringe_sim.paper.reproduce import Reproduction
from lsst.fringe_sim.paper.section import PaperSection
from lsst.fringe_sim.report.paper_page import write_paper_page

LARGEST = r"largest relative difference of these</dt><dd>"


def finding(value: float, published: Any, **changes: Any) -> Finding:
    content = {
        "item": "x", "place": "Eq. 1", "quantity": "q", "unit": "", "tolerance": 0.1, "published": published
    }  # fmt: skip
    return PublishedNumber.from_mapping({**content, **changes}).compare(value)


@pytest.mark.parametrize(
    ("findings", "stated"),
    [
        ([finding(3.0, 1.0)], "200 %"),
        ([finding(0.0, 1.0)], "100 %"),
        ([finding(8.0, [1.0, 3.0]), finding(6.0, 5.0)], "300 %"),
        ([finding(6.0, 5.0), finding(2.0, [3.0, math.inf]), finding(4.0, 0.0)], "20 %"),
        ([finding(6.0, 5.0), finding(9.0, None, corrected=2.0, note="why")], "20 %"),
        ([finding(2.0, [3.0, math.inf]), finding(4.0, 0.0), finding(math.nan, 1.0)], None),
        ([finding(1.05, 1.0), finding(2.05, 1.0, corrected=2.0, note="why")], None),
    ],
)
def test_the_largest_relative_difference(findings: list[Finding], stated: str | None, tmp_path: Path) -> None:
    """Of the numbers that differ, where there is something that they are to be compared with."""
    made = Reproduction((PaperSection("One", "", {}),), (tuple(findings),))
    page = write_paper_page(made, tmp_path / "paper.html").read_text(encoding="utf-8")
    assert (LARGEST in page) is (stated is not None)
    if stated is not None:
        assert f"{LARGEST}{stated}</dd>" in page
    open_points = sum(one.status == "differs" for one in findings)
    assert ("Where they differ" in page) is (open_points > 0)
    assert page.count('<tr class="bad">') == 2 * open_points
