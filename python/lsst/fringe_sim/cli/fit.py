"""``fringe-sim fit``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from ..algorithms.thickness_fit_options import CONTRASTS, FIT_METHODS, SILICON_FIELDS, ZONES
from ..errors import InputError, UnknownNameError
from .command import argument, command, flag, option
from .output import OutputFolder, origin_of, output_folder
from .parameters import LABORATORY, ChosenEffects, model_effects
from .progress import progress

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    from ..algorithms.thickness_fit import Nuisances
    from ..instrument.setup import Setup
    from ..products import FringeCube, SensorSection, ThicknessMap

LEAST_WAVELENGTHS = 4  # Below this the order of the fringe cannot be told

SMOOTHING_PX = {"global": 0.0, "guo2022": 3.0}
"""Smoothing of the flats [px]. It lowers the contrast where fringes are dense, so `global` does without."""


@command()
def fit(
    paths: tuple[str, ...] = argument("PATH..."),
    setup: Setup = LABORATORY.option("ts8_e2v", "Laboratory set-up: name or file."),
    out: OutputFolder = output_folder(
        "Folder for maps, figures, report.", "thickness.fits", "silicon.fits", "thickness.png", "report.html"
    ),
    method: str = option(
        "All pixels at once, or the walk of the paper.", "global", click.Choice(FIT_METHODS)
    ),
    smoothing: float | None = option(
        "Gaussian smoothing of the flats, σ [px]; 0 for 'global', which needs none, and 3 for 'guo2022'.",
        kind=click.FloatRange(0.0, 100.0),
    ),
    silicon: str = option(
        "Thickness of the silicon: as in the model, or fitted too where flats with a narrow line tell it.",
        "fixed",
        click.Choice(["fixed", *SILICON_FIELDS]),
    ),
    zones: str | None = option(
        "Parts of the sensor with a level of their own at each wavelength, however large; by default those of "
        "amplifiers, as well as gains are known.",
        kind=click.Choice(ZONES),
    ),
    illumination_degree: int | None = option(
        "Degree of a slow illumination, free at each wavelength; 0 for even light.",
        kind=click.IntRange(0, 8),
        show_default="2",
    ),
    contrast: str | None = option(
        "Contrast of the fringes: a free factor at each wavelength, or one for all, or that of the model.",
        kind=click.Choice(CONTRASTS),
        show_default="wavelength",
    ),
    effects: ChosenEffects = model_effects(),
    skip_bad: bool = flag("Go on without files that cannot be read."),
    strict: bool = flag("Exit with 1 where model and flats do not go together."),
    dry_run: bool = flag("Look at every header, say what would be done, write nothing."),
) -> None:
    """Fit the layer thickness of one sensor to raw flats (files, folders, patterns) or to a fringe cube.

    \b
    Examples:
      fringe-sim fit raws --setup ts8_e2v --out fit
      fringe-sim fit 'raws/*flat*.fits' 'raws/*bias*.fits' --method guo2022 --out fit_guo
      fringe-sim fit broad_and_narrow.fits --silicon plane --out fit_both
    """
    from ..algorithms.flat_conditions import model_of_flats
    from ..algorithms.thickness_fit import SiliconSearch, fit_thickness, remarks, says_misfit, silicon_map
    from ..model import LABORATORY_TEMPERATURE, FringeModel
    from ..model.provenance import input_cards
    from ..report.thickness_page import write_thickness_report
    from .inputs import effect_cards

    model = FringeModel.from_setup(setup, effects.settings)
    search = None if silicon == "fixed" else SiliconSearch(SILICON_FIELDS[silicon])
    if search is not None and method != "global":
        raise InputError("--silicon", silicon, "fixed with method guo2022")
    usual = search is None and method == "global"
    free = _free(zones, illumination_degree, contrast, setup.wavelength_accuracy_nm, usual=usual)
    kernel_px = SMOOTHING_PX[method] if smoothing is None else smoothing
    cube, used = _read(paths, setup, kernel_px, skip_bad, dry_run)
    if cube is None:
        return
    _refuse_few(len(set(cube.wavelength_nm.tolist())))
    section = section_of_cube(cube, setup)
    model = model_of_flats(model, cube.exposures)
    if dry_run:
        click.echo(f"would fit the layer {setup.varying} to {len(cube.wavelength_nm)} flats")
        return
    folder = out.prepare()
    about = {"SETUP": setup.name, "NFLATS": cube.shape[0], **effect_cards(model)}
    about |= {**input_cards([*used, *effects.files]), LABORATORY_TEMPERATURE: model.system.temperature_k}
    click.echo("fitting the thickness", err=True)
    fitted = fit_thickness(cube, model, method, nuisances=free, silicon=search)
    said = remarks(fitted.metadata, fitted.flats)
    if not (fitted.mask == 0).any():
        raise InputError("good pixels of the thickness map", 0, f"one or more. {'; '.join(said)}".strip())
    fitted.write_fits(folder / "thickness.fits", about, section=section)
    of_silicon = silicon_map(fitted, model)
    if of_silicon is not None:
        of_silicon.write_fits(folder / "silicon.fits", about, section=section)
    origin = origin_of(folder, [*paths, *effects.files])
    write_thickness_report(folder, cube, fitted, model, method, section=section, origin=origin)
    names = ["thickness.fits", *(["silicon.fits"] if of_silicon is not None else []), "report.html"]
    more = [] if search is None else [_silicon_line(fitted)]
    for line in (_thickness_line(fitted), *said, *more, *(folder / name for name in names)):
        click.echo(str(line))
    if strict and says_misfit(fitted.metadata):
        raise InputError("--strict", "a misfit", f"flats that the model describes. {'; '.join(said)}")


def _free(
    zones: str | None, degree: int | None, contrast: str | None, wavelength_accuracy_nm: float, *, usual: bool
) -> Nuisances | None:
    """What is free: as by default, `None`, but for what was asked for of the ``usual`` fit, of one layer at once."""
    from dataclasses import replace
    from math import inf

    from ..algorithms.thickness_fit import Nuisances

    if zones is None and degree is None and contrast is None:
        return None
    if not usual:
        options = "--zones, --illumination-degree, --contrast"
        raise InputError(options, "given", "nothing with method guo2022 or --silicon")
    free = Nuisances.automatic(contrast or "wavelength", wavelength_accuracy_nm)
    if zones is not None:
        free = replace(free, zones=zones, gain_accuracy=inf)
    return free if degree is None else replace(free, illumination_degree=degree)


def _thickness_line(fitted: ThicknessMap) -> str:
    import numpy as np

    good = fitted.mask == 0
    low, high = np.percentile(fitted.value[good], [1.0, 99.0])
    return (
        f"{fitted.layer}: {low:.3f} to {high:.3f} µm (1–99 %), median σ "
        f"{1e3 * np.median(fitted.sigma[good]):.2f} nm, {100 * (1 - good.mean()):.2f} % of the pixels masked"
    )


def _silicon_line(fitted: ThicknessMap) -> str:
    """What a joint fit says of the silicon."""
    found = fitted.metadata
    if not found["SIFIT"]:
        return f"silicon not fitted, its fringes counted as noise: {found['SIWHY']}"
    parts = [
        f"{1e3 * found[f'SICOEF{k}']:+.2f} ± {1e3 * found[f'SISIGM{k}']:.2f}"
        for k in range(sum(key.startswith("SICOEF") for key in found))
    ]
    terms = (
        ""
        if len(parts) == 1
        else ", terms 1, x, y, x², xy, y² (places from −1 in the first to 1 in the last pixel)"
    )
    return (
        f"silicon minus that of the model{terms}: {', '.join(parts)} nm, if wavelengths and index are exact"
    )


def _refuse_few(wavelengths: int) -> None:
    if wavelengths < LEAST_WAVELENGTHS:
        raise InputError("number of wavelengths", wavelengths, f"{LEAST_WAVELENGTHS} or more")


def _read(
    paths: tuple[str, ...], setup: Setup, smoothing: float, skip_bad: bool, dry_run: bool
) -> tuple[FringeCube | None, tuple[str, ...]]:
    """The cube, `None` in a dry run, and the files that it is made of."""
    from ..algorithms.flat_prep_options import FlatPrepOptions
    from .lab_frames import announced_series, read_cube

    cube = read_cube(paths[0], setup) if len(paths) == 1 else None
    if cube is not None:
        return cube, paths
    series = announced_series(paths, setup, skip_bad=skip_bad)
    missing = series.missing_nm(setup)
    if missing:
        listed = ", ".join(f"{w:g}" for w in missing)
        click.echo(f"no flats at {listed} nm; the fit is less certain without them", err=True)
    _refuse_few(len(series.wavelengths_nm))
    if dry_run:
        click.echo(f"would prepare {series.steps} frames and fit the layer {setup.varying}")
        return None, series.paths
    with progress("preparing frames", series.steps) as advance:
        return series.read(setup, FlatPrepOptions(smoothing_sigma_px=smoothing), advance), series.paths


def section_of_cube(cube: FringeCube, setup: Setup) -> SensorSection | None:
    """Pixels of a sensor of the set-up's camera that a cube shows; `None` if sensor or place are not known."""
    from ..instrument.camera import Camera
    from ..products import SensorSection

    camera = Camera.from_name(setup.camera)
    name = str(cube.metadata.get("SERIAL") or cube.detector)
    try:
        detector = camera.detector(name)
    except UnknownNameError:
        return None
    return SensorSection.of_image(detector, cube.shape[1:], cube.metadata)
