"""Pages of made-up results in which nothing is left out: words, tables and figures are as recorded."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from matplotlib.backends.backend_agg import FigureCanvasAgg
from product_makers import components, sky, templates
from recorded_numbers import Record, Words
from seen_pages import drawn
from small_pages import WAVELENGTHS_NM, frame, smooth_map, verdict

from lsst.fringe_sim.algorithms.coadd_sources import NightResults
from lsst.fringe_sim.algorithms.coadds import Coadds
from lsst.fringe_sim.algorithms.correction.injection import Measured, injection_table
from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.algorithms.discovery.verdict import Gap, NamedEffect, ParameterValue, Step, Where
from lsst.fringe_sim.algorithms.flat_residual import FlatResidual, ResidualPair
from lsst.fringe_sim.algorithms.map_on_sky import MapOnSky
from lsst.fringe_sim.algorithms.public_evidence.verdict import KindRow
from lsst.fringe_sim.algorithms.sky_shift import SkyShift
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.paper.published import published_numbers
from lsst.fringe_sim.paper.reproduce import Reproduction
from lsst.fringe_sim.paper.section import Curve, Graph, PaperSection, Picture
from lsst.fringe_sim.products import FlatFit, FringeCube, FringeFrame, SensorSection, SkyFringe, ThicknessMap
from lsst.fringe_sim.report import figures
from lsst.fringe_sim.report.correction_page import write_correction_report, write_templates_report
from lsst.fringe_sim.report.discovery_page import discovery_page
from lsst.fringe_sim.report.evidence_text import evidence_text
from lsst.fringe_sim.report.focal_plane_page import write_focal_plane_page
from lsst.fringe_sim.report.map_on_sky_page import write_map_on_sky_report
from lsst.fringe_sim.report.paper_page import write_paper_page
from lsst.fringe_sim.report.sky_page import write_sky_report
from lsst.fringe_sim.report.source_figure import bias_figure
from lsst.fringe_sim.report.thickness_page import write_thickness_report
from lsst.fringe_sim.report.words import (
    amplitude_text,
    masked_text,
    measured_text,
    number_text,
    of_sensor,
    sigma_text,
    span_text,
)

Seen = Callable[[Path], dict[str, Any]]
SIDE, ROWS = 24, 20
SENSOR = Camera.from_name("lsstCam").detector("R22_S11")
SECTION = SensorSection(SENSOR, (100, 100 + SIDE - 1), (2, 2 + SIDE - 1))


def waves(*shape: int) -> np.ndarray:
    """Numbers without a symmetry, between -1 and 1."""
    return np.sin(0.7 * np.arange(math.prod(shape)) ** 1.1).reshape(shape)


def slipped_map() -> ThicknessMap:
    """A wedge of which some pixels may be a fringe order off, with what the fit says of each flat."""
    whole, count = smooth_map(), len(WAVELENGTHS_NM)
    images = ("value", "sigma", "chi2", "slip_probability", "mask")
    one = replace(whole, **{name: getattr(whole, name)[:ROWS] for name in images})
    flats = FlatFit(
        np.array(WAVELENGTHS_NM), *(10.0**-k * (1.5 + waves(count)) for k in (0, 2, 0, 1)), 2.0 + waves(count)
    )
    metadata = {
        "CONTRAST": 0.93, "CONTRSIG": 0.02, "SCALESIG": 1e-4, "CELLMISF": 3.0, "WORSTFLT": 920.0, "WORSTOFF": 0.4,
        "WORSTSIG": 8.0, "ORDMARG": 2.0, "METHOD": "global",
    }  # fmt: skip
    chance = np.clip(0.05 * waves(ROWS, SIDE), 1e-14, 1.0)
    contrast = 1.0 + 0.1 * waves(5, 6)
    return replace(one, slip_probability=chance, flats=flats, contrast_map=contrast, metadata=metadata)


def thickness_page(folder: Path) -> Path:
    fitted, model = slipped_map(), FringeModel.from_setup("ts8_e2v")
    counts = 1e4 * (1.0 + 0.02 * waves(len(WAVELENGTHS_NM), ROWS, SIDE))
    mask = np.zeros(counts.shape, np.int32)
    mask[2, 10:] = 1
    cube = FringeCube.from_arrays(counts, WAVELENGTHS_NM, variance=2.0 * counts, mask=mask)
    section = replace(SECTION, y=(2, 2 + ROWS - 1))
    return write_thickness_report(folder, cube, fitted, model, "guo2022", section=section)


def sky_page(folder: Path) -> Path:
    y, x = np.indices((192, 200), dtype=float)
    mask = np.zeros(y.shape, np.int32)
    mask[:5] = 1
    frames = []
    for hour in (20.0, 23.5, 26.0):
        fringes = 2e-3 * np.sin(0.3 * x + 0.1 * y) + 1e-4 * hour * np.cos(0.21 * y)
        image = (2700.0 + hour) * (1.0 + fringes)
        level = float(image[5:].mean())
        frames.append(
            SkyFringe(image.astype(np.float32), mask, "electron", level, 30.0, 1.2, hour, None, 1e-8)
        )
    results = NightResults.of(frames, 1, pixel_arcsec=0.5)
    return write_sky_report(folder / "sky.html", frames, "lsst_e2v", results, picture=folder / "sky.png")


def correction_page(folder: Path) -> Path:
    def injected(name: str) -> Table:
        return injection_table(
            name,
            [
                Measured(kind, flux, *(k * waves(4, 7) + 0.01 for k in (0.1, 0.05)))
                for kind in ("point", "extended")
                for flux in (300.0, 900.0, 4e4)
            ],
        )

    records = [
        replace(frame(f"visit_{k}", evidence, chance), injected=injected(f"visit_{k}"), unit="", scale=np.ones(1))
        for k, (evidence, chance) in enumerate([(20.0, 0.6), (-1.0, 0.5), (56.8, 1e-6), (30.0, 0.01), (9.0, 1e-9)])
    ]  # fmt: skip
    worse = replace(records[3].proof, part_left=math.nan, part_left_sigma=math.nan, fringe_rms=0.7)
    records[3] = replace(records[3], proof=worse, correlation=np.full((3, 2), np.nan))
    return write_correction_report(folder / "night.html", records, ["a: not read", "b: not corrected: dark"])


def templates_page(folder: Path) -> Path:
    seen = np.zeros((SIDE, SIDE), np.int32)
    seen[:, :3] = 1
    even = templates((SIDE, SIDE), 2, mask=seen)
    even = replace(even, coverage=np.full((SIDE, SIDE), 4, np.float32), physical_filter="")
    seen_often = np.tile(np.arange(SIDE, dtype=np.float32), (SIDE, 1))
    made = [("S1", templates((SIDE, SIDE), coverage=seen_often)), ("", even)]
    return write_templates_report(folder / "templates.html", made)


def focal_plane_page(folder: Path) -> Path:
    rows, summary = [], []
    for number, (name, vendor) in enumerate([("R22_S11", "e2v"), ("R01_S00", "itl"), ("R22_S12", "e2v")]):
        x, y = (axis.ravel() for axis in np.meshgrid(*[number * 30.0 + np.array([0.0, 10.0, 20.0])] * 2))
        for k, (at, up) in enumerate(zip(x, y, strict=True)):
            rms = 0.05 + 0.01 * ((k + number) % 4)
            rows.append((name, at, -up, rms, 1.3 * rms, 5.0 * rms, 0.5 * rms))
        summary.append((name, vendor, 0.2 + number, 0.08 - 0.01 * number, 0.4, 0.12 - 0.03 * number, 0.05))
    cells = Table(
        rows=rows, names=("detector", "x", "y", "rms", "rms_brightness", "over_noise", "residual_over_noise")
    )
    names = ("detector", "vendor", "field_radius", "rms", "over_noise", "residual_1", "residual_2")
    said = write_focal_plane_page(folder, cells, Table(rows=summary, names=names), 1.3, 5, 1)
    (folder / "said.txt").write_text("\n".join(said))
    return folder / "report.html"


def map_page(folder: Path) -> Path:
    shift = 0.01 + 0.02 * waves(SIDE, SIDE)
    found = MapOnSky(
        SkyShift(shift, 0.3 + 0.1 * shift, 0.7, 1e-6, 1, 0.97, 0.05, 1.2, math.inf), 2, smooth_map()
    )
    return write_map_on_sky_report(
        folder / "map.html", found, smooth_map(), ["it is right", "so it is"], frames=3, section=SECTION
    )  # fmt: skip


def paper_page(folder: Path) -> Path:
    numbers = list(published_numbers().values())[:6]
    values = [numbers[0].low, 3.0 * numbers[1].high, math.nan, 7.0, 7.0, 7.0]
    findings = [
        replace(number.compare(value, "no curve"), cold=cold)
        for number, value, cold in zip(numbers, values, [math.nan, 1.0, math.nan, 8.0, 8.0, 8.0], strict=True)
    ]
    x = np.linspace(1.0, 4.0, 9)
    curves = tuple(
        Curve(x[:some], x[:some] ** k - 3.0, "measured" if k == 1 else f"curve {k}", "o-.:"[k % 4])
        for k, some in enumerate((9, 9, 9, 2, 9))
    )  # fmt: skip
    graphs = (
        Graph("a", "x", "y", curves[:1]),
        Graph("b", "x", "y", tuple(replace(c, style="o") for c in curves[:4])),
        Graph("c", "x", "y", curves, True, 2.0),
    )
    picture = Picture("p", "q", waves(9, 7), True, 3.0)
    sections = (
        PaperSection("First: one", "Text.", {}, (*graphs, picture), "Caption."),
        PaperSection("Second", "Text.", {}, (picture,) * 9, "Many."),
        PaperSection("Third", "Text.", {}),
    )
    made = Reproduction(sections, (tuple(findings[:2]), tuple(findings[2:]), ()))
    return write_paper_page(made, folder / "paper.html", ["a notice"])


PAGES: dict[str, Callable[[Path], Path]] = {
    "thickness": thickness_page,
    "sky": sky_page,
    "correction": correction_page,
    "templates": templates_page,
    "focal plane": focal_plane_page,
    "map": map_page,
    "paper": paper_page,
}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_as_recorded(name: str, tmp_path: Path, seen: Seen, recorded: Record) -> None:
    page = PAGES[name](tmp_path)
    recorded({"page": tmp_path, **seen(page)})


def residual(scale: float, unknown: bool = False) -> FlatResidual:
    left = (scale * waves(len(WAVELENGTHS_NM), 200, 210)).astype(np.float32)
    left[1, :, 80:] = np.nan
    return FlatResidual(np.array(WAVELENGTHS_NM), left, slipped_map())


def many() -> Verdict:
    """Two effects, one of which has many parameters, and amplifiers that disagree."""
    gains = {f"C{number:02}": ParameterValue(2e-6 * (-1) ** number, 4e-4, "") for number in range(7)}
    effects = (
        NamedEffect("amplifier_gain", gains, 0.9, ("tilt", "void"), "12 flats", 0.3),
        NamedEffect("roughness", {"sigma": ParameterValue(2.0, 0.0, "nm")}, 0.99),
    )
    amplifiers = tuple(
        {"amplifier": f"C{k:02}", "offset": 1e-4 * k, "sigma": 1e-4 * (k != 7)} for k in (0, 5, 7, 17)
    )
    base = verdict()
    colour = tuple({**row, "chi2": 10.0 + 3.0 * k} for k, row in enumerate(base.where.wavelength))
    tests = tuple(
        {"name": f"test {k}", "statistic": 9.0, "degrees": 3, "probability": 10.0**-k} for k in (0, 2, 5)
    )
    steps = tuple(
        Step(added, 50.0, 20.0, 0.01, 0.008, k == 1) for k, added in enumerate([("a",), ("b", "c")])
    )
    ways = tuple(
        {"effect": "roughness", "title": f"way {k}", "separation_sigma": at, "decides": k == 0}
        for k, at in enumerate((5.7, None, math.nan))
    )
    return replace(
        base, effects=effects, where=Where(colour, amplifiers, 0.0, base.where.thickness_phase, tests),
        gap=Gap("rms", 0.01, 0.008, 0.012, 0.007, 0.0075), steps=steps, next_measurements=ways, complete=False,
        candidates=tuple({"name": f"effect {k}", "score": 9.0 - k, "degrees": 1 + k} for k in range(14)),
        data={**base.data, "cell_px": 12, "shape": [8, 2, 2]}, notes=("one note", "another"),
        size={"of_counts": 0.003, "of_fringes": 0.05, "of_fringes_at_most": 0.06},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "pair"),
    [
        pytest.param(many, ResidualPair(residual(0.01), residual(0.005), 0.3), id="two of them"),
        pytest.param(
            verdict, ResidualPair(residual(0.01), None, 0.3), id="one of them", marks=pytest.mark.slow
        ),
    ],
)
def test_a_search_with_images_is_as_recorded(
    found: Callable[[], Verdict], pair: ResidualPair, tmp_path: Path, seen: Seen, recorded: Record
) -> None:
    page = discovery_page(found(), pair, section=SECTION)
    recorded(seen(page.write(tmp_path / "report.html")))


@dataclass(frozen=True)
class Fit:
    """What is told of a set of effects."""

    name: str
    log_evidence: float
    values: dict[str, tuple[float, float]]

    def shift_um(self) -> tuple[float, float]:
        return 0.123, 0.045


@pytest.mark.parametrize("members", [1, 2])
def test_the_text_on_all_evidence_is_as_recorded(members: int, recorded: Record) -> None:
    fits = (
        Fit("one + two", 12.34, {"one.a": (0.5, 0.01), "two.b": (2.0, 0.3)}),
        Fit("plane layers", 9.0, {}),
    )
    rows = [
        KindRow(name, 0.3, 0.2, 0.1, 4.5, name == "the map") for name in ("contrast of the flats", "the map")
    ]
    told = SimpleNamespace(
        fits=fits, best=fits[0], members=fits[:members], probabilities=np.array([0.9, 0.1]), rows=rows,
        wavelengths={"paper, as published": 0.02, "one": 0.005},
        goes_to_the_sky=lambda fit: {name: name == "one.a" for name in fit.values},
        forecast={"one + two": (0.12, 0.14), "plane layers": (0.14, 0.14)},
        decisions=[(SimpleNamespace(name="R", unit="%", accuracy=0.02), {"one + two": 1.5, "plane": 2.5}, 7.25)],
    )  # fmt: skip
    lines = evidence_text(told).splitlines()  # type: ignore[arg-type]
    assert rows[0].factor == pytest.approx(3.0)
    recorded({"lines": Words(lines)})


@pytest.mark.parametrize(
    ("text", "stated"),
    [
        (number_text(0.0), "0"), (number_text(99.5), "99.5"), (number_text(100.4), "100"),
        (number_text(999_999.0), "999999"), (number_text(1e6), "1.00e+06"), (number_text(math.inf), "inf"),
        (number_text(math.nan), "–"), (number_text(0.1234, 2), "0.12"), (number_text(250.0), "250"),
        (amplitude_text(0.00123), "0.123 %"), (masked_text(np.array([0, 1, 2, 0])), "50 % of the pixels"),
        (sigma_text(np.array([0.001, 0.0024, 0.9])), "2.4 nm"), (sigma_text(np.zeros(0)), ""),
        (" ".join(measured_text(3.14159, 0.0123)), "3.142 0.012"), (" ".join(measured_text(1234.5, 99.0)), "1234 99"),
        (" ".join(measured_text(1234.5, 9.0)), "1234.5 9.0"), (" ".join(measured_text(0.5, 0.0)), "0.5 0"),
        (" ".join(measured_text(-1e-9, 0.1)), "0.00 0.10"), (span_text([3.0, 1.0]), "1 to 3"), (span_text(2.0), "2"),
        (of_sensor((20, 30), None), "30 × 20 px"),
        (of_sensor(SENSOR.shape, SensorSection.whole(SENSOR)), "4096 × 4004 px, the whole sensor"),
        (
            of_sensor((400, 4096), SensorSection(SENSOR, (4095, 0), (10, 409))),
            "4096 × 400 px, 10 % of the sensor: columns 0 to 4095, rows 10 to 409",
        ),
    ],
)  # fmt: skip
def test_quantities_are_stated_with_their_digits(text: str, stated: str) -> None:
    assert text == stated


def test_figures_of_no_page_are_as_recorded(recorded: Record) -> None:
    """Those of the demonstration, of notebooks, and unusual cases of others."""
    many_waves = np.linspace(850.0, 1000.0, 13)
    flats = waves(13, 20, 30)
    pattern = 0.01 * waves(20, 30)
    fits = [
        (f"fit {k}", SimpleNamespace(predicted=0.01 * waves(13), thickness_um=14.0 + k, rms=0.002 * (k + 1),
                                     searched_um=np.linspace(10, 20, 30), searched_rms=1.0 + waves(30) ** 2))
        for k in range(2)
    ]  # fmt: skip
    coadds = Coadds(
        np.array([1, 4, 16]), np.array([1, 5, 25]), 1.0 + 0.1 * waves(3, 3), None, 2.0 + waves(3, 3)
    )
    alone = replace(components((8, 9)), components=waves(1, 8, 9), explained_variance=np.ones(1),
                    explained_variance_ratio=np.ones(1), scores=np.ones((5, 1)))  # fmt: skip
    constant = replace(smooth_map(), value=np.full((SIDE, SIDE), 14.0, np.float32))
    thick = replace(smooth_map(), value=np.tile(np.linspace(1.0, 99.0, SIDE, dtype=np.float32), (SIDE, 1)))
    made = {
        "template": figures.template_figure(FringeFrame(
            pattern - pattern.mean(), np.zeros((20, 30), np.int32), pattern**2, "y_10", "2022-03-04T05:06:07"
        )),
        "pixel": figures.single_pixel_figure(many_waves, 0.02 * waves(13), fits),
        "flats": figures.flats_figure(flats, flats > 0.9, many_waves),
        "galleries": figures.flats_figure(flats[:6], flats[:6] > 0.9, many_waves[:6], title="six", most_px=10),
        "phase": figures.phase_figure(np.linspace(0, 1, 16), waves(13, 16), 0.9 * waves(13, 16), many_waves),
        "components": figures.components_figure(components((8, 9))),
        "component": figures.components_figure(alone),
        "coadds": figures.coadds_figure(coadds),
        "one frame": figures.sky_figure(
            [sky((8, 9), 3, unit="fraction", image=0.01 * waves(8, 9), mask=np.zeros((8, 9), np.int32))]
        ),
        "constant": figures.thickness_figure(constant, 0.3),
        "thick": figures.thickness_figure(thick, 0.3),
        "residuals": figures.residuals_figure(0.01 * waves(2, 31, 33), [900.0, 910.0]),
        "bias": bias_figure({"a": "A", "b": "B"}, {
            "group": Table({"magnitude": [1.0, 2.0], **{
                f"{q}bias_{i}{e}": 0.1 * waves(2) + k + n for n, q in enumerate(("", "e1_", "e2_", "size_"))
                for i in "ab" for k, e in enumerate(("", "_sigma"))
            }})
        }),
    }  # fmt: skip
    for one in made.values():
        FigureCanvasAgg(one).draw()
    recorded({name: drawn(one) for name, one in made.items()})
