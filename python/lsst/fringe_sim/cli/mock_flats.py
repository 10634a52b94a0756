"""``fringe-sim mock-flats``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from ..errors import InputError
from .output import OutputFolder, output_folder
from .parameters import (
    BUILT_IN,
    LABORATORY,
    SIZE,
    WAVELENGTHS,
    ChosenEffects,
    Quantity,
    laboratory_of_the_mock,
    model_effects,
    shape_of,
)
from .progress import progress

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    import numpy as np
    from numpy.typing import NDArray

    from ..instrument.setup import Setup

__all__ = ["mock_flats"]

STEEPEST_UM = 0.03
"""Range of a random map over the pixels of its shorter side: slopes of 0.05 µm per pixel, a sixth of a fringe."""

BLEMISHES: dict[str, Any] = {"bad_columns": 6, "hot_pixels": 200, "prnu_rms": 0.003}
"""What ``--blemishes`` puts on the sensor: about what a science-grade sensor shows."""


@click.command("mock-flats")
@output_folder("Folder for the frames.", "*_bias_bias_*.fits", "*_lambda_flat_*.fits", argument=True)
@laboratory_of_the_mock
@click.option("--detector", default=None, help="Sensor; that of the set-up if not given.")
@click.option(
    "--thickness",
    default=BUILT_IN,
    show_default=True,
    help="Map of the varying layer: a FITS file [µm], 'random', or 'e2v_321' (model of a measured sensor).",
)
@click.option("--wavelengths", type=WAVELENGTHS, default=None, help="first:last:step or a list [nm].")
@model_effects("Hidden effect; may be repeated.", "YAML with hidden effects.", own=False)
@click.option(
    "--size", type=SIZE, default=None, help="Cut-down sensor, columns x rows; full size if not given."
)
@click.option(
    "--bias-frames", type=click.IntRange(1, 200), default=5, show_default=True, help="How many of them."
)
@click.option(
    "--level", type=click.FloatRange(10.0, 1e5), default=20000.0, show_default=True, help="Electrons."
)
@click.option(
    "--temperature", type=Quantity("K"), default=None, help="Sensor temperature, as 183.15 or -90degC."
)
@click.option(
    "--silicon", default=None, help="Table of silicon, as Si_franta2017; that of the set-up if not given."
)
@click.option("--blemishes/--no-blemishes", default=False, help="Bad columns and hot pixels.")
@click.option("--seed", type=click.IntRange(0), required=True, help="Seed of all randomness.")
@click.option("--dry-run", is_flag=True, help="Check everything, write nothing.")
def mock_flats(
    out: OutputFolder,
    setup: str,
    detector: str | None,
    thickness: str,
    wavelengths: tuple[float, ...] | None,
    effects: ChosenEffects,
    size: tuple[int, int] | None,
    bias_frames: int,
    level: float,
    temperature: float | None,
    silicon: str | None,
    blemishes: bool,
    seed: int,
    dry_run: bool,
) -> None:
    """Write raw bias frames and flats of a simulated sensor in the LSST raw layout.

    Nothing in the files tells the thickness, the effects or the seed.

    \b
    Examples:
      fringe-sim mock-flats raws --setup ts8_e2v --detector R11_S01 --seed 1 --size 512x500
      fringe-sim mock-flats raws --thickness random --effect bandwidth.fwhm=2.6 --seed 2 --size 512x500
    """
    import numpy as np

    from ..mock.hidden_effects import validate_effects
    from ..mock.raw_frames import Defects, write_mock_flats

    chosen = LABORATORY.convert(setup, None, None)
    sensor = chosen.sensor(detector)
    if silicon is not None:
        chosen.with_silicon(silicon)
    shape = shape_of(size, sensor.shape)
    rng = np.random.default_rng(seed)
    settings = dict(effects.settings)
    if temperature is not None:
        settings["temperature.kelvin"] = temperature
    validate_effects(settings)
    nominal = wavelengths or chosen.wavelengths_nm
    layer = thickness_map(thickness, chosen, shape, rng)
    frames = bias_frames + len(nominal)
    if dry_run:
        click.echo(f"would write {frames} frames of {sensor.name}, {shape[1]} x {shape[0]} pixels, to {out}")
        return
    folder = out.prepare()
    with progress("writing raw frames", frames) as advance:
        run = write_mock_flats(
            folder,
            setup=setup,
            detector=detector or chosen.detector,
            thickness_um=layer,
            wavelengths_nm=nominal,
            rng=rng,
            effects=settings,
            size=f"{shape[1]}x{shape[0]}" if size else None,
            n_bias=bias_frames,
            level_e=level,
            defects=Defects(**BLEMISHES) if blemishes else None,
            silicon=silicon,
            progress=lambda path: advance(),
        )
    click.echo(f"{len(run.paths)} raw frames in {folder}")


def thickness_map(
    text: str, setup: Setup, shape: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Thickness map of a sensor from the argument of ``--thickness``."""
    from ..instrument.measured_thickness import e2v_321, fit_to_sensor
    from ..mock.thickness import random_field
    from .inputs import read_thickness

    if text == "random":
        low, high = setup.thickness_range_um
        if setup.varying == "adhesive":
            # What the nine sensors of RTM-020 show: 7 to 14 um of range on a mean between 13 and 22 um.
            # A small part of a sensor does not have the range of the whole: neighbours stay well within a fringe.
            span = min(float(rng.uniform(6.0, 10.0)), STEEPEST_UM * min(shape))
            mean = float(rng.uniform(max(low, 10.0) + span / 2, min(high, 26.0) - span / 2))
        else:
            span = 0.2 * (high - low)
            mean = 0.5 * (low + high)
        return random_field(shape, rng, mean=mean, span=span, scale=0.35 * min(shape))
    if text == BUILT_IN:
        if setup.varying != "adhesive":
            raise InputError("--thickness", text, f"'random' or a file for the layer {setup.varying}")
        return e2v_321(shape)
    layer = read_thickness(text, setup)
    return layer if layer.shape == shape else fit_to_sensor(layer, shape)
