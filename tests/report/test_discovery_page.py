"""The page of a search: every kind of verdict is told, with its evidence, and nothing is fetched."""

import base64
import math
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from recorded_numbers import Record
from seen_pages import drawn

from lsst.fringe_sim.algorithms.discovery import Verdict, discover
from lsst.fringe_sim.algorithms.discovery.verdict import Gap, NamedEffect, ParameterValue, Step, Where
from lsst.fringe_sim.algorithms.flat_residual import FlatResidual, ResidualPair, residual_pair
from lsst.fringe_sim.challenge.sealed_cases import draw_case
from lsst.fringe_sim.effects.learned import LEARNED_NODES_NM
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.model.effects_override import is_as_written, read_effects_override
from lsst.fringe_sim.products import FlatExposures, ThicknessMap
from lsst.fringe_sim.report.discovery_figures import candidates_figure, gap_figure, where_figure
from lsst.fringe_sim.report.discovery_page import discovery_page
from lsst.fringe_sim.report.learned_part import learned_figure

WAVELENGTHS = [880.0 + 10.0 * k for k in range(12)]

PHASE = tuple({"phase": (k + 0.5) / 16, "residual": 1e-3 * math.sin(k), "sigma": 1e-4} for k in range(16))

WHERE = Where(
    tuple(
        {"wavelength_nm": w, "chi2": 7.0 * k, "degrees": 7.0, "rms": 6e-3} for k, w in enumerate(WAVELENGTHS)
    ),
    tuple({"amplifier": f"C{k:02d}", "offset": 1e-4 * k, "sigma": 1e-4} for k in (0, 1, 7, 10, 17)),
    28.1,
    PHASE,
    (
        {"name": "thickness phase", "statistic": 14872.2, "degrees": 120, "probability": 0.0},
        {"name": "amplifiers", "statistic": 51.0, "degrees": 30, "probability": 0.0098},
    ),
)

NAMED = Verdict(
    "named",
    (
        NamedEffect(
            "dark_pedestal",
            {"electrons": ParameterValue(64.0, 8.0, "electron")},
            0.993,
            ("ghost_pedestal", "contrast_loss"),
            "12 flats of 80000 electrons",
            0.4,
        ),
    ),
    WHERE,
    Gap("rms of data minus model", 0.0078, 0.00707, 0.00778, 0.00703, 0.0070),
    (Step(("dark_pedestal",), 5005.2, 10021.3, 0.0078, 0.00708, True),),
    {},
    "ts8_e2v",
    0.0,
    (
        {"name": "dark_pedestal", "score": 63.8, "degrees": 1},
        {"name": "ghost_pedestal", "score": 63.7, "degrees": 1},
        {"name": "tilt", "score": 2.0, "degrees": 1},
        {"name": "air_gap", "score": 0.0, "degrees": 1},
    ),
    (
        {
            "effect": "dark_pedestal",
            "measurement": "level",
            "title": "12 flats of 80000 electrons",
            "separation_sigma": 5.7,
            "decides": True,
            "pairs": [],
        },
    ),
    ("held out: chi2 of blocks falls by 4707.6",),
    {
        "shape": [12, 96, 96],
        "cell_px": 1,
        "wavelength_nm": WAVELENGTHS,
        "noise_factor": [1.0] * 12,
        "response_scatter": 0.0,
        "thickness_um": [14.8, 17.2],
    },
)

UNEXPLAINED = replace(
    NAMED,
    verdict="unexplained",
    effects=(),
    steps=(),
    next_measurements=(),
    unexplained={
        "reason": "no effect <of the catalogue> predicts held-out data better",
        "too_poor": False,
        "partial": [{"name": "roughness", "probability": 0.4, "parameters": {"sigma": [20.0, 1.0]}}],
        "channels": ["texture"],
        "wavelength": [{"wavelength_nm": w, "variance_beyond_noise": 0.1} for w in WAVELENGTHS],
        "thickness_phase_waveform": list(PHASE),
        "harmonics": [{"harmonic": 1, "cos": 1e-3, "sin": 2e-3, "sigma": 1e-4}],
        "spatial_power": [{"scale_px": 10.0, "power": 1.2, "probability": 0.1}],
        "amplifiers": [],
        "principal_modes": [3.0, 1.1, 1.0],
        "places": [
            {"y_px": 401.6, "x_px": 233.2, "diameter_px": 41.3, "excess_share": 0.76, "sigma": 31.0},
        ],
    },
)

LEARNED = replace(
    UNEXPLAINED,
    size={"of_counts": 2e-3, "of_fringes": 0.03, "of_fringes_at_most": 0.04},
    unexplained={**UNEXPLAINED.unexplained, "like": ["roughness"]},
    accuracy={"assumed": 0.014, "source": "a table", "chance": 1e-5},
    learned={
        "name": "learned_response",
        "words": "alike over 30 nm",
        "beside": {"roughness.sigma": 20.0},
        "own": {
            f"learned_response.{wave}{harmonic}_{node}": 0.01 / harmonic
            for wave in ("cos", "sin")
            for harmonic in (1, 2, 3)
            for node in (950, 960, 970)
        },
        "heldout_gain": 812.0,
        "unseen_gain": 95.0,
        "chance": 0.005,
        "false_alarms": 0.01,
        "before_rms": 0.0078,
        "after_rms": 0.0071,
        "noise_floor": 0.0070,
        "believed": True,
    },
)

AGREES = replace(
    NAMED, verdict="no_discrepancy", effects=(), steps=(), next_measurements=(), global_probability=0.43
)

TOO_POOR = Verdict(
    "unexplained",
    (),
    Where(),
    Gap("rms of data minus model", *([math.nan] * 5)),
    (),
    {"reason": "one flat and no thickness", "too_poor": True},
    "ts8_e2v",
    math.nan,
)


def downloads(text: str) -> dict[str, Table]:
    found = re.findall(r'download="(\w+)\.ecsv" href="data:text/plain;base64,([^"]+)"', text)
    return {name: Table.read(base64.b64decode(data).decode(), format="ascii.ecsv") for name, data in found}


def words(text: str) -> str:
    """What a reader sees."""
    return re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>|base64,[^\"]+", "", text, flags=re.DOTALL))


@pytest.mark.parametrize("verdict", [NAMED, UNEXPLAINED, LEARNED, AGREES, TOO_POOR], ids=lambda v: v.verdict)
def test_every_page_is_whole_and_fetches_nothing(
    verdict: Verdict, tmp_path: Path, seen: Callable[[Path], dict[str, Any]], recorded: Record
) -> None:
    """What it shows is as recorded."""
    page = discovery_page(verdict).write(tmp_path / "report.html")
    recorded(seen(page))
    text = page.read_text(encoding="utf-8")
    assert "<script" not in text
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    titles = re.findall(r'<h2 id="\w+">([^<]+)</h2>', text)
    assert titles[0] == "Verdict"
    assert {"What stays unexplained", "Next measurement", "Data and notes"} <= set(titles)


def test_a_named_effect_has_its_value_its_rivals_and_what_would_decide() -> None:
    text = discovery_page(NAMED).to_html()
    seen = words(text)
    assert "Missing from the model: dark_pedestal or one of 2 like it" in seen
    assert "64" in seen
    assert "ghost_pedestal, contrast_loss" in seen
    assert "12 flats of 80000 electrons" in seen
    assert "--effects-file effects.py --out fit" in seen
    share = (0.00778**2 - 0.00703**2) / (0.00778**2 - 0.0070**2)
    assert f"{100 * share:.0f} % of the variance above the noise is gone" in seen


def test_numbers_come_back_from_the_page() -> None:
    tables = downloads(discovery_page(NAMED).to_html())
    assert tables["discovery_effects"]["value"][0] == 64.0
    assert str(tables["discovery_wavelengths"]["wavelength"].unit) == "nm"
    assert list(tables["discovery_wavelengths"]["wavelength"]) == WAVELENGTHS
    assert list(tables["discovery_gap"]["after"]) == [0.00707, 0.00703]
    assert tables["discovery_candidates"]["effect"][0] == "dark_pedestal"


def test_what_is_unexplained_is_described() -> None:
    text = discovery_page(UNEXPLAINED).to_html()
    assert "&lt;of the catalogue&gt;" in text
    seen = words(text)
    assert "Tests that still fail: texture" in seen
    assert "roughness explains a part (probability 0.400)" in seen
    assert "Write the missing effect" in seen
    assert re.search(r"402\s+233\s+41.3\s+76\s+31", seen)
    assert "To use it" not in seen


def test_agreement_asks_for_nothing() -> None:
    seen = words(discovery_page(AGREES).to_html())
    assert "Model and data agree within the noise" in seen
    assert "0.43" in seen
    assert "Nothing beyond noise in any test" in seen


def test_data_that_are_too_poor_are_said_to_be() -> None:
    seen = words(discovery_page(TOO_POOR).to_html())
    assert "one flat and no thickness" in seen
    assert "nan" not in seen


def test_a_search_that_could_not_begin_has_a_page() -> None:
    """As the search itself answers two flats without a map of the thickness."""
    case = draw_case("none", np.random.default_rng(1), size=(32, 32))
    two = replace(
        case.cube,
        image=case.cube.image[:2],
        variance=case.cube.variance[:2],
        mask=case.cube.mask[:2],
        exposures=FlatExposures(case.cube.wavelength_nm[:2], np.array(2.0), np.array(183.15)),
    )
    verdict = discover(two, case.setup, rng=np.random.default_rng(1))
    assert verdict.unexplained["too_poor"]
    assert residual_pair(two, FringeModel.from_setup(case.setup), verdict) is None
    text = words(discovery_page(verdict).to_html())
    assert "too poor to be searched" in text
    assert "2 wavelength(s) without a thickness map" in text


@pytest.mark.parametrize("draw", [where_figure, candidates_figure, gap_figure])
def test_every_axis_has_a_label_with_a_unit_or_names(draw) -> None:
    for axes in draw(NAMED).axes:
        for axis in (axes.xaxis, axes.yaxis):
            ticks = [label.get_text() for label in axis.get_ticklabels()]
            named = any(re.search("[a-z]{3}", text) for text in ticks)
            assert (
                "[" in axis.get_label_text()
                or named
                or not axis.get_visible()
                or not len(axis.get_ticklocs())
            ), axes.get_title()


def test_bars_are_the_numbers_of_the_verdict() -> None:
    bars = candidates_figure(NAMED).axes[0].patches
    assert sorted(bar.get_width() for bar in bars) == [2.0, 63.7, 63.8], (
        "an effect without promise is left out"
    )
    heights = [bar.get_height() for bar in gap_figure(NAMED).axes[0].patches]
    assert np.allclose(heights, [0.78, 0.707, 0.778, 0.703])


def test_what_is_not_there_is_not_drawn() -> None:
    """No empty bars, no blank maps."""
    assert len(where_figure(replace(NAMED, where=replace(WHERE, amplifier=()))).axes) == 3
    assert len(gap_figure(AGREES).axes) == 1
    assert len(gap_figure(AGREES).axes[0].patches) == 2, (
        "nothing was added: one bar for all data, one for held out"
    )
    silent = tuple({**item, "score": 0.0} for item in NAMED.candidates)
    assert "The most promising" in discovery_page(NAMED).to_html()
    assert "The most promising" not in discovery_page(replace(AGREES, candidates=silent)).to_html()


def test_a_verdict_draws_its_candidates() -> None:
    axes = NAMED.plot(pyplot.figure().add_subplot())
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        "dark_pedestal",
        "ghost_pedestal",
        "tilt",
    ]
    legend = [text.get_text() for text in axes.get_legend().get_texts()]
    assert legend == ["named", "in the same class", "not chosen"]
    assert "data:image/png;base64," in NAMED._repr_html_()
    assert TOO_POOR.plot(pyplot.figure().add_subplot()).get_title() == "no effect promises anything"
    pyplot.close("all")


def test_what_is_written_is_read() -> None:
    """All of it, the upper limit of the disagreement too."""
    sized = replace(NAMED, size={"of_counts": 0.003, "of_fringes": 0.05, "of_fringes_at_most": 0.06})
    assert asdict(Verdict.from_json(sized.to_json())) == asdict(sized)


def test_a_page_says_so_where_no_thickness_is_known() -> None:
    """As a fit leaves it that cannot decide the order of any pixel; residuals are shown all the same."""
    image = np.zeros((8, 8), np.float32)
    unknown = ThicknessMap(image, image, image, image + 1, mask=np.ones((8, 8), np.int32), layer="adhesive")
    left = FlatResidual(np.array(WAVELENGTHS), np.zeros((12, 8, 8), np.float32), unknown)
    text = words(discovery_page(NAMED, ResidualPair(left, left, 0.3)).to_html())
    assert "The thickness is not known in any pixel." in text


def test_many_parameters_are_one_number_in_the_summary_and_all_in_the_table() -> None:
    gains = {f"C{number:02}": ParameterValue(2e-6 * (-1) ** number, 4e-4, "") for number in range(16)}
    effect = replace(NAMED.effects[0], name="amplifier_gain", parameters=gains)
    seen = words(discovery_page(replace(NAMED, effects=(effect,))).to_html())
    assert "amplifier_gain: 16 parameters, rms 2.0e-06; probability" in seen
    assert "0.00000" in seen
    assert "-0.00000" not in seen


@pytest.mark.parametrize("name", ["response", "map", "light", "amplifiers"])
def test_what_was_learned_is_told_and_shown(name: str, recorded: Record) -> None:
    """Size first, then the shape, the gap before and after, and which effect it is like."""
    keys = {"map": "y1x2", "light": "at_960_y1x2", "amplifiers": "C00"}
    own = {f"learned_{name}.{keys[name]}": 0.01} if name in keys else LEARNED.learned["own"]
    verdict = replace(LEARNED, learned={**LEARNED.learned, "name": f"learned_{name}", "own": own})
    made = learned_figure(verdict.learned)
    FigureCanvasAgg(made).draw()
    recorded(drawn(made))
    text = discovery_page(verdict).to_html()
    told = words(text)
    assert "like roughness, and not quite" in told
    assert "no physics" in told
    assert "812" in told
    assert told.index("3 % of the fringes") < told.index("No name")
    assert list(downloads(text)["discovery_learned"]["rms"]) == pytest.approx([0.78, 0.71, 0.70])


@pytest.mark.parametrize(
    ("count", "panels", "inch"), [(3, 3, (9.0, 2.6)), (6, 6, (12.0, 5.2)), (14, 12, (12.0, 7.8))]
)
def test_patterns_of_many_wavelengths_stand_in_rows_of_four(
    count: int, panels: int, inch: tuple[float, float]
) -> None:
    nodes = LEARNED_NODES_NM[:count]
    own = {f"learned_light.at_{node}_y1x2": 1e-3 * (1 + k) for k, node in enumerate(nodes)}
    made = learned_figure({"name": "learned_light", "own": own})
    assert made.get_size_inches() == pytest.approx(inch)
    shown = [axes for part in made.subfigs for axes in part.axes if axes.images]
    assert [axes.get_title() for axes in shown] == [f"{node} nm" for node in nodes[:panels]]
    reach = [axes.images[0].get_clim()[1] for axes in shown]
    np.testing.assert_allclose(np.divide(reach, reach[0]), 1.0 + np.arange(panels), rtol=1e-9)
    for axes, high in zip(shown, reach, strict=True):
        assert np.abs(axes.images[0].get_array()).max() == pytest.approx(high)


def test_a_disagreement_within_the_accuracy_is_said_to_be_so(tmp_path: Path) -> None:
    accuracy = {**LEARNED.accuracy, "chance": 0.3, "within": True}
    verdict = replace(LEARNED, verdict="no_discrepancy", accuracy=accuracy, learned={})
    told = words(discovery_page(verdict).to_html())
    assert "within the accuracy of the model" in told
    assert "chance 0.3 with it" in told
    assert "What was learned" not in told
    verdict.write(tmp_path)
    assert not (tmp_path / "learned.py").exists()


def test_files_of_what_was_learned(tmp_path: Path) -> None:
    again = Verdict.from_json(LEARNED.write(tmp_path).read_text())
    assert again.learned == LEARNED.learned
    assert again.accuracy == LEARNED.accuracy
    text = (tmp_path / "learned.py").read_text()
    assert "not physics" in text
    assert read_effects_override(text) == {**LEARNED.learned["beside"], **LEARNED.learned["own"]}
    assert read_effects_override((tmp_path / "effects.py").read_text()) == {}
    assert "0.375" in (tmp_path / "learned_effect.py").read_text()  # a phase of the wave form


def test_a_correction_stands_behind_what_was_known_before(tmp_path: Path) -> None:
    known = {"temperature.kelvin": 175.0}
    replace(LEARNED, known=known).write(tmp_path)
    read = read_effects_override((tmp_path / "learned.py").read_text())
    assert read == {**known, **LEARNED.learned["beside"], **LEARNED.learned["own"]}


def test_a_finished_effect_can_be_told_from_what_was_written(tmp_path: Path) -> None:
    LEARNED.write(tmp_path)
    written = (tmp_path / "learned_effect.py").read_text()
    assert is_as_written(written)
    assert not is_as_written(written.replace("Unnamed", "Satellite"))


def test_a_pattern_is_said_to_leave_the_thickness_as_it_is() -> None:
    own = {f"learned_map.{key}": 0.001 for key in ("y0x1", "y1x0")}
    pattern = replace(LEARNED, learned={**LEARNED.learned, "name": "learned_map", "own": own})
    assert "the thickness does not change" in words(discovery_page(pattern).to_html())
    assert "the thickness does not change" not in words(discovery_page(LEARNED).to_html())


def test_no_chance_is_zero() -> None:
    verdict = replace(LEARNED, global_probability=0.0, accuracy={**LEARNED.accuracy, "chance": 0.0})
    assert "chance below 1e-300 with it, below 1e-300 of noise alone" in verdict.summary()
