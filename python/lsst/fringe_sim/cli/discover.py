"""``fringe-sim discover``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import InputError
from .command import argument, command, flag, option
from .output import OutputFolder, origin_of, output_folder
from .parameters import ANY_LIGHT, ChosenEffects, model_effects
from .progress import progress

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    from ..algorithms.discovery import SearchOptions, Verdict
    from ..algorithms.field_response import SensorPlacement
    from ..algorithms.flat_residual import ResidualPair
    from ..instrument.setup import Setup
    from ..model import FringeModel
    from ..products import FringeCube, SensorSection
    from .sky_frames import SkyData

PRODUCTS = ("discovery.json", "discovery.ecsv", "effects.py", "report.html")
OF_WHAT_WAS_LEARNED = ("learned.py", "learned_effect.py")
"""Files that are there where a correction was learned from what no effect explains."""


@command()
def discover(
    paths: tuple[str, ...] = argument("PATH..."),
    setup: Setup = ANY_LIGHT.option("ts8_e2v", "Set-up of flats, or of frames of the sky: name or file."),
    out: OutputFolder = output_folder("Folder for the verdict.", *PRODUCTS, *OF_WHAT_WAS_LEARNED),
    seed: int = option("Which parts of the sensor are held out.", 1, int),
    effects: ChosenEffects = model_effects("Effect known already; may be repeated."),
    thickness: str | None = option("Map of the varying layer, for frames of the sky: a FITS file [µm]."),
    collections: str = option("Of a Butler repository, comma-separated.", "*"),
    detector: str | None = option("Sensor of a Butler repository, by number or name."),
    cells: int = option("Cells to average to.", 20_000, click.IntRange(100)),
    time_budget: float | None = option(
        "Stop after so long with the best answer so far, which says that it is not complete.",
        kind=click.FloatRange(0.0, min_open=True),
        metavar="SECONDS",
    ),
    model_accuracy: float | None = option(
        "Part of the fringes by which the model may be wrong, by default as the tables of silicon (0.014); 0 "
        "for a model without error.",
        kind=click.FloatRange(0.0, 1.0, max_open=True),
        metavar="PART",
    ),
    skip_bad: bool = flag("Go on without files that cannot be read."),
    dry_run: bool = flag("Look at every header, say what would be done, write nothing."),
) -> None:
    """Find the effect that the model of a sensor lacks.

    From raw flats, a fringe cube, or a Butler repository; or, with the set-up of a telescope, from frames of the
    night sky and a thickness map.

    \b
    Examples:
      fringe-sim discover raws --setup ts8_e2v --out verdict
      fringe-sim discover cube.fits --setup ts8_e2v --effect bandwidth.fwhm=2.3 --out verdict
      fringe-sim discover REPO --collections u/me/flats --detector 37 --out verdict
      fringe-sim discover sky --setup lsst_e2v --thickness fit/thickness.fits --out verdict_sky
    """
    import numpy as np

    from ..algorithms.discovery import SKY_SEARCH, SearchOptions, placement_in_frames
    from ..algorithms.discovery import discover as search
    from ..algorithms.flat_residual import residual_pair
    from ..model import FringeModel
    from .fit import section_of_cube
    from .inputs import sky_settings
    from .sky_frames import read_sky_frames

    most_s = math.inf if time_budget is None else time_budget
    limits: dict[str, Any] = {"most_cells": cells, "time_budget_s": most_s}
    if model_accuracy is not None:
        limits["model_accuracy"] = model_accuracy
    given: list[str | Path] = [*paths, *([thickness] if thickness else []), *effects.files]
    if setup.kind == "sky":
        data = read_sky_frames(paths, setup, thickness)
        placement = placement_in_frames(data.sky.frames, data.detector, setup.pixel_scale_arcsec)
        if dry_run:
            rows, columns = data.sky.shape
            click.echo(f"would search {len(data.sky.frames)} frames of {columns} x {rows} pixels")
            return
        model = data.model(sky_settings(effects.settings))
        _search_sky(data, model, placement, out, seed, replace(SKY_SEARCH, **limits), given)
        return
    if thickness is not None:
        raise InputError("--thickness", thickness, "only with the set-up of a telescope, as lsst_e2v")
    model = FringeModel.from_setup(setup, effects.settings)
    cube = _read(paths, setup, collections, detector, skip_bad, dry_run)
    if cube is None:
        return
    folder = out.prepare()
    verdict = search(
        cube,
        model,
        rng=np.random.default_rng(seed),
        options=SearchOptions(**limits),
        report=lambda line: click.echo(line, err=True),
    )
    _write(verdict, folder, residual_pair(cube, model, verdict), section_of_cube(cube, setup), given)


def _search_sky(
    data: SkyData,
    model: FringeModel,
    placement: SensorPlacement | None,
    out: OutputFolder,
    seed: int,
    options: SearchOptions,
    given: Sequence[str | Path],
) -> None:
    import numpy as np

    from ..algorithms.discovery import discover_sky

    folder = out.prepare()
    verdict = discover_sky(
        data.sky.frames,
        data.sky.thickness_um,
        data.sky.thickness_sigma_um,
        model,
        placement=placement,
        rng=np.random.default_rng(seed),
        options=options,
        report=lambda line: click.echo(line, err=True),
    )
    _write(verdict, folder, None, None, given)


def _write(
    verdict: Verdict,
    folder: Path,
    residuals: ResidualPair | None,
    section: SensorSection | None,
    given: Sequence[str | Path],
) -> None:
    from ..report.discovery_page import discovery_page

    verdict.write(folder)
    page = discovery_page(verdict, residuals, section=section, origin=origin_of(folder, given))
    page.write(folder / "report.html")
    _say(verdict)
    for name in (*PRODUCTS, *(OF_WHAT_WAS_LEARNED if verdict.has_learned else ())):
        click.echo(str(folder / name))


def _say(verdict: Verdict) -> None:
    click.echo(verdict.summary())
    for note in verdict.notes:
        click.echo(f"  note: {note}", err=True)


def _read(
    paths: tuple[str, ...],
    setup: Setup,
    collections: str,
    detector: str | None,
    skip_bad: bool,
    dry_run: bool,
) -> FringeCube | None:
    """Cube of one sensor, or `None` after a dry run."""
    from ..algorithms.flat_prep_options import FlatPrepOptions
    from .lab_frames import announced_series, of_vendor, read_cube

    if len(paths) == 1 and (Path(paths[0]) / "butler.yaml").is_file():
        stored = _from_repository(paths[0], collections, detector)
        cube: FringeCube | None = of_vendor(stored, setup, paths[0])
    else:
        cube = read_cube(paths[0], setup) if len(paths) == 1 else None
    if cube is not None:
        if dry_run:
            click.echo(f"would search {cube.shape[0]} flats of {cube.shape[1]} x {cube.shape[2]} pixels")
        return None if dry_run else cube
    series = announced_series(paths, setup, skip_bad=skip_bad)
    if dry_run:
        click.echo(f"would prepare {series.steps} frames and search them")
        return None
    with progress("preparing frames", series.steps) as advance:
        # Not smoothed: the noise is measured from neighbouring pixels.
        return series.read(setup, FlatPrepOptions(smoothing_sigma_px=0.0), advance)


def _from_repository(path: str, collections: str, detector: str | None) -> FringeCube:
    """Cube from the prepared flats of one sensor of a repository."""
    from lsst.daf.butler import ButlerUserError

    from ..middleware.repository import open_repository
    from ..products import FringeCube

    with open_repository(path) as butler:
        try:
            refs: list[Any] = butler.query_datasets(
                "fringeFlat",
                collections=collections.split(","),
                find_first=False,
                with_dimension_records=True,
            )
        except ButlerUserError as error:
            message = str(error).split("\n")[0]
            raise InputError(
                "repository", message, "one with fringeFlat datasets (task isrFlatPrep)", source=path
            ) from None
        # A number alone is no sensor to the registry: each instrument has its own.
        known = {
            ref: (ref.dataId["instrument"], ref.dataId["detector"], ref.dataId.records["detector"].full_name)
            for ref in refs
        }
        listed = ", ".join(" ".join(map(str, sensor)) for sensor in sorted(set(known.values())))
        if detector is not None:
            known = {ref: sensor for ref, sensor in known.items() if detector in map(str, sensor[1:])}
            if not known:
                raise InputError("detector", detector, f"number or name of one of: {listed}", source=path)
        if len(set(known.values())) != 1:
            raise InputError("sensors", listed, "one; choose with --detector", source=path)
        latest = {ref.dataId["exposure"]: ref for ref in sorted(known, key=lambda ref: str(ref.run))}
        return FringeCube.from_flats((butler.get(ref) for ref in latest.values()), number=len(latest))
