"""What the pictures of pages show, and do not."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.report.correction_page import frame_figure
from lsst.fringe_sim.report.discovery_figures import where_figure


@pytest.mark.parametrize(
    ("seen", "titles"), [(True, ["before", "subtracted", "after"]), (False, ["as it was, and is"])]
)
def test_a_frame_of_which_nothing_was_subtracted_is_one_picture(seen: bool, titles: list[str]) -> None:
    noise = np.random.default_rng(1).normal(size=(3, 20, 30))
    record = SimpleNamespace(proof=SimpleNamespace(seen=seen), pictures=noise, unit="electron", step_px=1.0)
    made = frame_figure(record)  # type: ignore[arg-type]
    assert [axes.get_title() for axes in made.axes if axes.get_title()] == titles


def test_large_offsets_of_amplifiers_stay_inside_their_boxes() -> None:
    amplifiers = [
        {"amplifier": f"C0{number}", "offset": pull, "sigma": 1.0}
        for number, pull in enumerate((0.34, -34.5, 601.2))
    ]
    where = SimpleNamespace(amplifier=amplifiers, wavelength=[], thickness_phase=[], channels=[])
    (axes, *_) = where_figure(SimpleNamespace(where=where)).axes  # type: ignore[arg-type]
    said = [text.get_text().partition("\n")[2] for text in axes.texts]
    assert "sixteenth" in axes.get_title()  # a sensor may have other amplifiers than these
    assert said == ["+0.3", "-34.5", "+601"]
