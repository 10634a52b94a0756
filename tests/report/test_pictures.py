"""What the pictures of pages show, and do not."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table
from matplotlib.figure import Figure
from product_makers import templates
from small_pages import verdict

from lsst.fringe_sim.algorithms.discovery.verdict import MOST_CANDIDATES
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.products.fringe_templates import PER_SKY
from lsst.fringe_sim.report.correction_page import frame_figure, write_templates_report
from lsst.fringe_sim.report.discovery_figures import candidates_figure, where_figure
from lsst.fringe_sim.report.discovery_page import discovery_page
from lsst.fringe_sim.report.focal_plane_page import focal_plane_figure
from lsst.fringe_sim.report.page import Report
from lsst.fringe_sim.style import figure, panels, show_image, to_png


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


@pytest.mark.parametrize(("largest", "scale"), [(30.0, "linear"), (31.0, "symlog"), (3000.0, "symlog")])
def test_wavelengths_of_any_misfit_have_visible_bars(largest: float, scale: str) -> None:
    """Where one wavelength is a thousand times worse than noise, the others are still to be seen."""
    rows = [
        {"wavelength_nm": 900.0 + 10.0 * number, "chi2": 50.0 * value, "degrees": 50.0}
        for number, value in enumerate((1.0, 2.0, largest))
    ]
    where = SimpleNamespace(amplifier=[], wavelength=rows, thickness_phase=[], channels=[])
    made = where_figure(SimpleNamespace(where=where))  # type: ignore[arg-type]
    axes = made.axes[0]
    assert axes.get_yscale() == scale
    np.testing.assert_allclose([bar.get_height() for bar in axes.patches], [1.0, 2.0, largest])
    bottom, top = axes.get_ylim()
    assert (bottom, top > largest) == (0.0, True)
    heights = [axes.transData.transform((900.0, value))[1] for value in (0.0, 1.0, top)]
    assert heights[1] - heights[0] > 0.02 * (heights[2] - heights[0])
    if scale == "symlog":
        assert axes.yaxis.get_transform().linthresh == 1.0  # up to the noise it is linear


@pytest.mark.parametrize(("tenths", "scale"), [(300, "linear"), (310, "symlog"), (3200, "symlog")])
def test_chances_of_any_size_are_drawn(tenths: int, scale: str) -> None:
    """Those below a thousandth stand out; what is not known is no disagreement."""
    chances = [0.5, 2e-3, 0.5e-3, None, math.nan, 10.0 ** (-0.1 * tenths)]
    rows = [{"name": f"test {number}", "probability": chance} for number, chance in enumerate(chances)]
    where = SimpleNamespace(amplifier=[], wavelength=[], thickness_phase=[], channels=rows)
    axes = where_figure(SimpleNamespace(where=where)).axes[0]  # type: ignore[arg-type]
    widths = [0.30103, 2.69897, 3.30103, 0.0, 0.0, min(0.1 * tenths, 300.0)]
    np.testing.assert_allclose([bar.get_width() for bar in axes.patches], widths, atol=1e-5)
    colours = [bar.get_facecolor() for bar in axes.patches]
    assert [colour == colours[-1] for colour in colours] == [False, False, True, False, False, True]
    assert axes.get_xscale() == scale
    assert axes.get_xlim()[0] == 0.0
    assert axes.yaxis_inverted()
    if scale == "symlog":
        assert axes.xaxis.get_transform().linthresh == 3.0  # up to the limit it is linear


@pytest.mark.parametrize(("count", "bars"), [(0, 3), (2, 3), (3, 3), (7, 7), (40, MOST_CANDIDATES)])
def test_the_figure_of_candidates_has_room_for_those_that_promise_something(count: int, bars: int) -> None:
    candidates = [{"name": f"effect {k}", "score": 0.4 / (1 + k), "degrees": 1} for k in range(count)]
    told = replace(verdict(), candidates=(*candidates, {"name": "none", "score": 0.0, "degrees": 1}))
    assert candidates_figure(told).get_size_inches() == pytest.approx((6.4, 1.2 + 0.27 * bars))
    if count > 2:
        return
    page = discovery_page(told).to_html()
    assert ("None promises anything" in page) is (count == 0)
    assert ("The most promising effects" in page) is (count > 0)


def test_a_focal_plane_without_cells_is_refused() -> None:
    names = ("detector", "x", "y", "rms", "rms_brightness", "over_noise", "residual_over_noise")
    cells = Table({name: np.zeros(0, "U7" if name == "detector" else float) for name in names})
    with pytest.raises(InputError, match=r"focal plane.*one sensor or more"):
        focal_plane_figure(cells, Table({"detector": np.zeros(0, "U7"), "field_radius": np.zeros(0)}))


@pytest.mark.parametrize("layout", ["constrained", None])
def test_a_color_bar_is_as_high_as_its_map(layout) -> None:
    with figure(6.0, 3.0, layout) as made:
        places = panels(made, 2, 2, None if layout else (0.6, 0.5, 0.5, 0.3))
        for axes, shape in zip(places, ((20, 160), (160, 20)), strict=True):
            show_image(axes, np.zeros(shape), label="nothing")
        to_png(made)  # only then the axes have their place
        for part in made.subfigs:
            ((axes,), (beside,)) = part.axes, part.axes[0].child_axes
            image, bar = axes.get_window_extent(), beside.get_window_extent()
            assert (bar.y0, bar.y1) == pytest.approx((image.y0, image.y1), abs=1.0)
            assert bar.width > 5.0


def test_what_a_color_bar_says_stays_in_its_panel() -> None:
    with figure(9.0, 4.0) as made:
        for axes in panels(made, 2, 2):
            show_image(axes, np.arange(100.0).reshape(10, 10), label="thickness [µm]")
        to_png(made)
        for part in made.subfigs:
            (beside,) = part.axes[0].child_axes
            assert beside.yaxis.label.get_window_extent().x1 <= part.bbox.x1 + 2.0  # pixels


@pytest.mark.parametrize(
    ("per_sky", "factor", "unit"), [(True, 100.0, "% of the sky"), (False, 1.0, "unit of the frames")]
)
def test_templates_are_drawn_in_their_unit(
    per_sky: bool, factor: float, unit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parts of the sky in per cent, and counts as they are."""
    product = templates((6, 8), mask=np.zeros((6, 8), np.int32), metadata={PER_SKY: per_sky})
    made: list[Figure] = []
    monkeypatch.setattr(Report, "figure", lambda self, one, caption: made.append(one))
    write_templates_report(tmp_path / "page.html", [("S1", product)])
    shown = [axes for axes in made[0].axes if axes.images and axes.get_title().startswith("template")]
    for axes, pattern in zip(shown, product.patterns, strict=True):
        np.testing.assert_allclose(axes.images[0].get_array(), factor * pattern, rtol=1e-6)
        assert axes.child_axes[0].get_ylabel() == f"template [{unit}]"
