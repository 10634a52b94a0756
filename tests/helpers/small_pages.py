"""Every page of the package, of small made-up results."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.table import Table
from product_makers import sky, templates

from lsst.fringe_sim.algorithms.coadd_sources import NightResults
from lsst.fringe_sim.algorithms.correction.quality import FrameProof
from lsst.fringe_sim.algorithms.discovery.verdict import (
    Gap,
    NamedEffect,
    ParameterValue,
    Step,
    Verdict,
    Where,
)
from lsst.fringe_sim.algorithms.map_on_sky import MapOnSky
from lsst.fringe_sim.algorithms.observed_frames import FrameRecord
from lsst.fringe_sim.algorithms.sky_shift import SkyShift
from lsst.fringe_sim.challenge.page import write_challenge_report
from lsst.fringe_sim.challenge.result import CaseResult, ChallengeResult
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.paper.published import published_numbers
from lsst.fringe_sim.paper.reproduce import Reproduction
from lsst.fringe_sim.paper.section import PaperSection
from lsst.fringe_sim.products import FringeCube, ThicknessMap
from lsst.fringe_sim.report.correction_page import write_correction_report, write_templates_report
from lsst.fringe_sim.report.discovery_page import discovery_page
from lsst.fringe_sim.report.focal_plane_page import write_focal_plane_page
from lsst.fringe_sim.report.map_on_sky_page import write_map_on_sky_report
from lsst.fringe_sim.report.page import Origin
from lsst.fringe_sim.report.paper_page import write_paper_page
from lsst.fringe_sim.report.sky_page import write_sky_report
from lsst.fringe_sim.report.thickness_page import write_thickness_report

SIDE = 24
WAVELENGTHS_NM = [900.0 + 10.0 * number for number in range(8)]


def smooth_map() -> ThicknessMap:
    """Map of a wedge, with a masked edge."""
    value = np.tile(np.linspace(14.0, 14.9, SIDE), (SIDE, 1))
    zero, mask = np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE), np.int32)
    mask[:2] = 1
    return ThicknessMap(value, zero + 2e-3, zero + 1.0, zero + 1e-9, mask, "adhesive", detector="S1")


def thickness_page(folder: Path, origin: Origin) -> Path:
    fitted, model = smooth_map(), FringeModel.from_setup("ts8_e2v")
    response = model.response(fitted.value.ravel().astype(float), WAVELENGTHS_NM).reshape(-1, SIDE, SIDE)
    counts = 1e5 * response / response.mean(axis=(1, 2), keepdims=True)
    cube = FringeCube.from_arrays(counts, WAVELENGTHS_NM, variance=counts)
    return write_thickness_report(folder, cube, fitted, model, "global", origin=origin)


def verdict() -> Verdict:
    """A named effect, with everything that a page can tell of it."""
    phase = tuple({"phase": (k + 0.5) / 8, "residual": 1e-3 * (-1) ** k, "sigma": 1e-4} for k in range(8))
    colour = tuple({"wavelength_nm": w, "chi2": 70.0, "degrees": 7.0, "rms": 6e-3} for w in WAVELENGTHS_NM)
    tests = ({"name": "thickness phase", "statistic": 14872.2, "degrees": 120, "probability": 0.0},)
    value = ParameterValue(64.0, 8.0, "electron")
    return Verdict(
        "named",
        (NamedEffect("dark_pedestal", {"electrons": value}, 0.993, ("ghost_pedestal",), "dimmer flats"),),
        Where(colour, (), 28.1, phase, tests),
        Gap("rms of data minus model", 0.0078, 0.0071, 0.0079, 0.0070, 0.0070),
        (Step(("dark_pedestal",), 5005.2, 10021.3, 0.0078, 0.0071, True),),
        {},
        "ts8_e2v",
        0.0,
        ({"name": "dark_pedestal", "score": 63.8, "degrees": 1},),
        data={
            "shape": [len(WAVELENGTHS_NM), 96, 96],
            "cell_px": 1,
            "wavelength_nm": WAVELENGTHS_NM,
            "noise_factor": [1.0] * len(WAVELENGTHS_NM),
            "response_scatter": 0.0,
            "thickness_um": [14.8, 17.2],
        },
    )


def frame(name: str, evidence: float, probability: float) -> FrameRecord:
    proof = FrameProof(
        evidence, 5.7, 0.44, 0.32, 0.1, 0.05, 0.18, 0.06, 0.9, 0.98, probability, "structure of 16 px"
    )
    picture = np.linspace(-1.0, 1.0, SIDE**2, dtype=np.float32).reshape(SIDE, SIDE)
    separation = np.array([[2.0, 5.0, 10.0], [0.02, 0.01, 0.005], [0.001, -0.001, 0.0]])
    one = np.array([3726.0])
    return FrameRecord(
        name, "S1", one, 0.1 * one, proof, (picture, picture, picture), 4, separation, None, "adu"
    )


def focal_plane(folder: Path, origin: Origin) -> Path:
    x, y = (axis.ravel() for axis in np.meshgrid([0.0, 10.0], [0.0, 10.0]))
    numbers = {"rms": 0.08, "rms_brightness": 0.1, "over_noise": 0.4, "residual_over_noise": 0.05}
    cells = Table(
        {"detector": ["S1"] * 4, "x": x, "y": y, **{name: [value] * 4 for name, value in numbers.items()}}
    )
    row = {"detector": ["S1"], "vendor": ["e2v"], "field_radius": [0.2], "rms": [0.08], "over_noise": [0.4]}
    write_focal_plane_page(folder, cells, Table({**row, "residual_1": [0.05]}), 1.2, 2, 0, origin)
    return folder / "report.html"


def map_on_sky(folder: Path, origin: Origin) -> Path:
    shift = np.full((SIDE, SIDE), 0.02) + np.linspace(0.0, 0.01, SIDE)
    found = MapOnSky(SkyShift(shift, 0.1 * shift, 0.01, 1e-6, 1, 0.97, 0.05, 1.2, 0.03), 1, smooth_map())
    said = ["the map is wrong"]
    return write_map_on_sky_report(
        folder / "report.html", found, smooth_map(), said, frames=11, origin=origin
    )


def paper(folder: Path, origin: Origin) -> Path:
    number = next(iter(published_numbers().values()))
    finding = number.compare(2.0 * number.high, "")
    made = Reproduction((PaperSection("Section 1", "Text.", {}),), ((finding,),))
    return write_paper_page(made, folder / "paper.html", (), origin)


def challenge(folder: Path, origin: Origin) -> Path:
    case = CaseResult(
        0, "one", ("roughness",), {}, "named", ("bandwidth",), (("roughness",),), True, False, 50.0, 50.0, 0.99, 0.7,
        {"roughness.sigma": 1.5}, 0.97, 12.0,
    )  # fmt: skip
    return write_challenge_report(folder / "challenge.html", ChallengeResult(7, (case,)), origin)


NIGHT = [sky((64, 64), number, mask=np.zeros((64, 64), np.int32)) for number in (1, 2)]

SMALL_PAGES: dict[str, Callable[[Path, Origin], Path]] = {
    "thickness": thickness_page,
    "discovery": lambda folder, origin: discovery_page(verdict(), origin=origin).write(
        folder / "report.html"
    ),
    "sky": lambda folder, origin: write_sky_report(
        folder / "report.html",
        NIGHT,
        "lsst_e2v",
        NightResults.of(NIGHT, 1),
        picture=folder / "sky.png",
        origin=origin,
    ),
    "templates": lambda folder, origin: write_templates_report(
        folder / "report.html", [("S1", templates((SIDE, SIDE)))], origin
    ),
    "correction": lambda folder, origin: write_correction_report(
        folder / "report.html",
        [frame("visit_1", 20.4, 0.6), frame("visit_2", -1.0, 0.5), frame("visit_3", 56.8, 1e-6)],
        ["visit_4: not corrected: no templates"],
        origin,
    ),
    "map on sky": map_on_sky,
    "focal plane": focal_plane,
    "paper": paper,
    "challenge": challenge,
}
