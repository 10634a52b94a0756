"""What pages show, for records of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from seen_pages import drawn, seen_of_page

from lsst.fringe_sim.report import Report


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], dict[str, Any]]:
    """Words and tables of a page that the test has written, and all that was drawn in its figures."""
    figures: list[dict[str, Any]] = []
    add = Report.figure

    def figure(self: Report, made: Figure, *args: Any, **named: Any) -> None:
        add(self, made, *args, **named)
        figures.append(drawn(made))

    monkeypatch.setattr(Report, "figure", figure)

    def of(page: Path) -> dict[str, Any]:
        shown = {**seen_of_page(page), "figures": list(figures)}
        figures.clear()
        return shown

    return of
