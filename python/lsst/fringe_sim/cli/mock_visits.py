"""``fringe-sim mock-visits``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..array_types import Float32Array
from ..errors import InputError
from .command import DRY_RUN, command, option
from .mock_flats import thickness_map
from .output import OutputFolder, output_folder
from .parameters import BUILT_IN, SIZE, SKY, ChosenEffects, model_effects, shape_of
from .progress import progress

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    pass

VISITS = "visit_*.fits"  # in both folders


@command("mock-visits")
def mock_visits(
    out: OutputFolder = output_folder("Folder for the visits.", VISITS, argument=True),
    setup: str = SKY.name_option("lsst_e2v", "Set-up behind a telescope: name or file."),
    detector: str | None = option("Sensor; that of the set-up if not given."),
    thickness: str = option(
        "Map of the varying layer: a FITS file [µm], 'random', or 'e2v_321' (model of a measured sensor).",
        BUILT_IN,
    ),
    visits: int = option("How many.", 12, click.IntRange(1, 1000)),
    stars: float = option("Per square arcminute.", 3.0, click.FloatRange(0.0)),
    moon: float = option("Largest, in dark skies.", 0.5, click.FloatRange(0.0)),
    effects: ChosenEffects = model_effects(
        "Hidden effect; may be repeated.", "YAML with hidden effects.", own=False
    ),
    size: tuple[int, int] | None = option(
        "Cut-down sensor, columns x rows; full size if not given.", kind=SIZE
    ),
    silicon: str | None = option("Table of silicon, as Si_franta2017; that of the set-up if not given."),
    seed: int = option("Seed of all randomness.", kind=click.IntRange(0), required=True),
    truth: Path | None = option(
        "Another folder, for the fringes of each visit as FITS [e⁻].",
        kind=click.Path(path_type=Path, writable=True),
    ),
    dry_run: bool = DRY_RUN,
) -> None:
    """Write y-band visits of a simulated sensor: fringes, stars, galaxies, moonlight, cosmic rays, noise.

    They are as after the removal of the instrument's signature, in the layout of Rubin's exposures, for `templates`
    and `correct`. Nothing in the files tells the thickness, the effects or the seed.

    \b
    Examples:
      fringe-sim mock-visits night --seed 1 --size 512x504
      fringe-sim mock-visits night --seed 1 --visits 30 --effect epoxy_absorption.k=0.001 --truth truth
    """
    import numpy as np

    from ..mock.visits import VisitConditions, check_visits, write_mock_visits

    chosen = SKY.convert(setup, None, None)
    if silicon is not None:
        chosen.with_silicon(silicon)
    sensor = chosen.sensor(detector)
    shape = shape_of(size, sensor.shape)
    rng = np.random.default_rng(seed)
    conditions = VisitConditions(visits, stars_per_arcmin2=stars, moon=moon)
    sources = check_visits(setup, shape, effects.settings, conditions)
    layer = thickness_map(thickness, chosen, shape, rng)
    aside = None if truth is None else _truth_folder(truth, out)
    if dry_run:
        click.echo(f"would write {visits} visits of {sensor.name}, {shape[1]} x {shape[0]} pixels, to {out}")
        return
    folder = out.prepare()
    if aside is not None:
        aside.prepare()
    click.echo(f"summing the light of the sky; then {visits} visits of about {sources:.0f} sources", err=True)
    with progress("writing visits", visits) as advance:
        written = write_mock_visits(
            folder,
            setup=setup,
            detector=sensor.name,
            thickness_um=layer,
            rng=rng,
            effects=effects.settings,
            conditions=conditions,
            silicon=silicon,
        )
        for visit in written:
            if aside is not None:
                _write_truth(aside.path / visit.path.name, visit.fringes)
            advance()
    click.echo(f"{visits} visits in {folder}")


def _truth_folder(path: Path, out: OutputFolder) -> OutputFolder:
    """Folder for the fringes of each visit, in files named as the visits are.

    `InputError`: it is that of the visits, or used.
    """
    if path.resolve() == out.path.resolve():
        raise InputError("--truth", str(path), "another folder than that of the visits")
    folder = replace(out, path=path)
    folder.refuse_used()
    return folder


def _write_truth(path: Path, fringes: Float32Array) -> None:
    from astropy.io import fits

    from ..files import all_or_nothing

    hdu = fits.PrimaryHDU(fringes)
    hdu.header["ORIGIN"] = "lsst.fringe_sim"  # which a run with --overwrite may clear
    hdu.header["BUNIT"] = ("electron", "light of the sky less its mean")
    with all_or_nothing(path) as temporary:
        hdu.writeto(temporary)
