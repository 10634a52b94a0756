"""What the demo leaves in its repository, and the page that shows it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lsst.daf.butler import Butler

from ..algorithms.coadds import coadds_of_frames
from ..algorithms.flat_residual import relative_flats
from ..algorithms.single_pixel import fit_single_pixel, published_pixel
from ..challenge.demo_case import of_the_layers
from ..model import FringeModel
from ..products import FringeComponents, FringeCube, FringeFrame, SkyFringe, ThicknessMap
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
from .demo_outcome import Outcome

PERCENT = 100.0
COADD_SEED = 16  # Of places and angles of the coadds; the number of the paper's figure


@dataclass(frozen=True, eq=False)
class DemoDatasets:
    """Products of the demo with the places of their files."""

    cube: FringeCube
    first_thickness: ThicknessMap  # with the unchanged model
    thickness: ThicknessMap  # with what was found
    sky: tuple[SkyFringe, ...]
    template: FringeFrame
    components: FringeComponents
    thickness_path: Path
    sky_folder: Path
    template_path: Path

    @classmethod
    def read(cls, repo: Path, lab: str, found: str, sky: str) -> DemoDatasets:
        """Read everything from the repository; its runs are named."""
        with Butler.from_config(str(repo), collections=[sky, found, lab]) as butler:
            flats = _refs(butler, "fringeFlat", lab)
            frames = sorted(_refs(butler, "skyFringe", sky), key=lambda ref: int(ref.dataId["exposure"]))
            (first,) = _refs(butler, "epoxyThickness", lab)
            (thickness,) = _refs(butler, "epoxyThickness", found)
            (template,) = _refs(butler, "fringe", sky)
            (components,) = _refs(butler, "fringeComponents", sky)
            return cls(
                cube=FringeCube.from_flats((butler.get(ref) for ref in flats), number=len(flats)),
                first_thickness=butler.get(first),
                thickness=butler.get(thickness),
                sky=tuple(butler.get(ref) for ref in frames),
                template=butler.get(template),
                components=butler.get(components),
                thickness_path=_path(butler, thickness),
                sky_folder=_path(butler, frames[0]).parents[2],
                template_path=_path(butler, template),
            )


def dataset_path(repo: Path, name: str, collection: str) -> Path:
    """File of the one dataset of a type in a collection."""
    with Butler.from_config(str(repo), collections=[collection]) as butler:
        (ref,) = _refs(butler, name, collection)
        return _path(butler, ref)


def write_demo_report(folder: Path, datasets: DemoDatasets, outcome: Outcome) -> None:
    """Write ``report.html`` and the figures beside it."""
    report = Report(
        "What was hidden in the flats of E2V-CCD250-321, and what was found",
        "Raw laboratory flats with a secret, a search for it, the sky and its templates with what was found.",
    )
    figures = folder / "figures"
    figures.mkdir(exist_ok=True)

    def add(name: str, made: Any, caption: str) -> None:
        report.figure(made, caption, figures / f"{name}.png")

    outcome.tell(report, add)
    model = FringeModel.from_setup("ts8_e2v", of_the_layers(outcome.verdict.settings))
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
    add("thickness", thickness_figure(datasets.thickness, order), "Thickness, and its uncertainty.")
    phase, data, modelled = phase_folded(datasets.cube, datasets.thickness, model)
    add("phase", phase_figure(phase, data, modelled, wavelength), "Flats and model folded on fringe phase.")
    left = residual_of_fit(datasets.cube, model, datasets.thickness)
    residuals = residual_table(left, datasets.cube)
    noise = np.asarray(residuals["noise"], dtype=float) / PERCENT
    add(
        "residuals",
        residuals_figure(left, wavelength, noise),
        "What the model leaves of the flats, over its noise.",
    )
    report.table(residuals, "flat_residuals")
    _sky_section(report, add, datasets)
    _pixel_section(report, add, FringeModel.from_setup("ts8_e2v"))
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


def _refs(butler: Butler, name: str, collection: str) -> list[Any]:
    return list(butler.query_datasets(name, collections=collection, find_first=True, limit=None))


def _path(butler: Butler, ref: Any) -> Path:
    return Path(butler.getURI(ref).ospath)
