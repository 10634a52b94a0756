"""What the demo leaves in its repository, and the page that shows it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from lsst.daf.butler import Butler

from ..algorithms.coadds import coadds_of_frames
from ..algorithms.discovery import Verdict
from ..algorithms.flat_residual import relative_flats
from ..algorithms.single_pixel import fit_single_pixel, published_pixel
from ..model import FringeModel
from ..products import FringeComponents, FringeCube, FringeFrame, SkyFringe, ThicknessMap
from ..report.discovery_figures import candidates_figure, where_figure
from ..report.discovery_page import headline
from ..report.figures import (
    coadds_figure,
    components_figure,
    flats_figure,
    phase_figure,
    residuals_figure,
    single_pixel_figure,
    sky_figure,
    template_figure,
    thickness_figure,
)
from ..report.page import Report
from ..report.sky_page import COADDS_CAPTION, COADDS_TEXT, sky_amplitudes
from ..report.thickness_page import phase_folded, residual_of_fit, residual_table

__all__ = ["DemoDatasets", "write_demo_report"]

PERCENT = 100.0
COADD_SEED = 16
"""Of places and angles of the coadds; the number of the paper's figure."""


@dataclass(frozen=True, eq=False)
class DemoDatasets:
    """Products of the demo with the places of their files."""

    cube: FringeCube
    thickness: ThicknessMap
    sky: tuple[SkyFringe, ...]
    template: FringeFrame
    components: FringeComponents
    thickness_path: Path
    sky_folder: Path
    template_path: Path

    @classmethod
    def read(cls, repo: Path, lab: str, sky: str, calib: str) -> DemoDatasets:
        """Read everything from the repository."""
        with Butler.from_config(str(repo), collections=[sky, lab, calib]) as butler:
            flats = _refs(butler, "fringeFlat", lab)
            frames = sorted(_refs(butler, "skyFringe", sky), key=lambda ref: int(ref.dataId["exposure"]))
            (thickness,) = _refs(butler, "epoxyThickness", lab)
            (template,) = _refs(butler, "fringe", sky)
            (components,) = _refs(butler, "fringeComponents", sky)
            return cls(
                cube=FringeCube.from_flats((butler.get(ref) for ref in flats), number=len(flats)),
                thickness=butler.get(thickness),
                sky=tuple(butler.get(ref) for ref in frames),
                template=butler.get(template),
                components=butler.get(components),
                thickness_path=_path(butler, thickness),
                sky_folder=_path(butler, frames[0]).parents[2],
                template_path=_path(butler, template),
            )


def write_demo_report(folder: Path, datasets: DemoDatasets) -> None:
    """Write ``report.html`` and the figures beside it."""
    report = Report(
        "Fringing of E2V-CCD250-321",
        "Raw laboratory flats, thickness of the adhesive, fringes of a night through the LSST optics, templates.",
    )
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)

    def add(name: str, made: Any, caption: str) -> None:
        report.figure(made, caption, figures / f"{name}.png")

    model = FringeModel.from_setup("ts8_e2v")
    wavelength = [float(w) for w in datasets.cube.wavelength_nm]
    report.section(
        "Laboratory flats",
        "Twelve monochromatic flats after overscan, bias and gain, divided by their mean. Contrast grows with "
        "wavelength as the silicon turns transparent and more light reaches the adhesive behind it.",
    )
    gallery = flats_figure(
        relative_flats(datasets.cube), datasets.cube.mask, wavelength, title="prepared flats"
    )
    add("flats", gallery, "Fringe amplitude of all flats on one scale.")
    report.section("Thickness of the adhesive", "One contour is one fringe order at 960 nm, 0.3 µm.")
    order = float(model.fringe_order_um(960.0))
    add("thickness", thickness_figure(datasets.thickness, order), "Thickness, uncertainty, chance of a slip.")
    phase, data, modelled = phase_folded(datasets.cube, datasets.thickness, model)
    add("phase", phase_figure(phase, data, modelled, wavelength), "Flats and model folded on fringe phase.")
    left = residual_of_fit(datasets.cube, model, datasets.thickness)
    add("residuals", residuals_figure(left, wavelength), "What the model leaves of the flats.")
    report.table(residual_table(left, datasets.cube), "flat_residuals")
    _sky_section(report, add, datasets)
    _pixel_section(report, add, model)
    _discovery_section(report, add, folder)
    report.write(folder / "report.html")


def _sky_section(report: Report, add: Any, datasets: DemoDatasets) -> None:
    report.section(
        "Night sky",
        "The y band through the LSST optics at the place of this sensor in the focal plane: OH lines and "
        "continuum, averaged over the converging beam. Eleven exposures of one night.",
    )
    add("sky", sky_figure(datasets.sky), "A sky frame, the distribution over its pixels, and the night.")
    report.table(sky_amplitudes(datasets.sky), "sky_fringe_amplitudes")
    report.section(
        "Templates",
        "Principal components of the night. The template is what the fringe correction of the science pipelines "
        "reads: the fractional departure from the mean sky.",
    )
    add("components", components_figure(datasets.components), "Mean, first components, explained variance.")
    add("template", template_figure(datasets.template), "The certified fringe frame.")
    coadds = coadds_of_frames(datasets.sky, np.random.default_rng(COADD_SEED))
    if coadds is not None:
        report.section("Coadds", COADDS_TEXT)
        add("coadds", coadds_figure(coadds), COADDS_CAPTION)


def _pixel_section(report: Report, add: Any, model: FringeModel) -> None:
    wavelength, amplitude = published_pixel()
    total = FringeModel.from_setup("ts8_e2v", observable="total")
    fits = [
        ("detection layer, one offset", fit_single_pixel(wavelength, amplitude, model, free_offset=True)),
        ("1 − R − T, as published", fit_single_pixel(wavelength, amplitude, total)),
        (
            "detection layer, contrast and offset free",
            fit_single_pixel(wavelength, amplitude, model, free_contrast=True, free_offset=True),
        ),
    ]
    damped = fits[-1][1]
    order_um = float(model.fringe_order_um(960.0))
    report.section(
        "One measured pixel",
        "The only public laboratory numbers of such a sensor: twelve flats at one pixel of E2V-CCD250-321 (Guo, "
        "Walter, Lage & Lupton 2022, Fig. 4). With the observable that the paper's text names, the light absorbed "
        f"in the detection layer, the model has {1.0 / damped.contrast:.1f} times the measured contrast; with "
        f"one contrast factor ({damped.contrast:.2f}) and one offset it follows the data to "
        f"{PERCENT * damped.rms:.2f} %. What lowers the contrast in the laboratory is not known. "
        f"The two observables are out of step by half an order, {0.5 * order_um:.2f} µm: the best thickness of one, "
        f"{fits[0][1].thickness_um:.2f} µm, lies {fits[0][1].thickness_um - fits[1][1].thickness_um:+.2f} µm from "
        f"that of the other.",
    )
    add(
        "pixel",
        single_pixel_figure(wavelength, amplitude, fits),
        "Measured points, three fits, all thicknesses.",
    )


def _discovery_section(report: Report, add: Any, folder: Path) -> None:
    path = folder / "discovery" / "discovery.json"
    if not path.is_file():
        return
    verdict = Verdict.from_json(path.read_text(encoding="utf-8"))
    report.section(
        "Search for a missing effect",
        f"{headline(verdict)}. The whole evidence is in discovery/report.html.",
    )
    if verdict.where.channels:
        add("discovery_where", where_figure(verdict), "Where the flats and the unchanged model disagree.")
    if verdict.candidates:
        add("discovery_candidates", candidates_figure(verdict), "What could explain it.")
    gap = verdict.gap
    rows = [
        ("all data", gap.before, gap.after, gap.noise_floor),
        ("held out", gap.heldout_before, gap.heldout_after, gap.noise_floor),
    ]
    table = Table(rows=rows, names=("rms of data minus model", "before", "after", "noise floor"))
    for name in ("before", "after", "noise floor"):
        table[name].info.format = ".6f"
    report.table(table, "discovery_gap")


def _refs(butler: Butler, name: str, collection: str) -> list[Any]:
    return list(butler.query_datasets(name, collections=collection, find_first=True, limit=None))


def _path(butler: Butler, ref: Any) -> Path:
    return Path(butler.getURI(ref).ospath)
