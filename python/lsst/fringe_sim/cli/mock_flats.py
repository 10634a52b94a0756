"""``fringe-sim mock-flats``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from ..array_types import FloatArray
from ..errors import InputError
from .command import DRY_RUN, command, option
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

    from ..instrument.setup import Setup

STEEPEST_UM = 0.03
"""Range of a random map over the pixels of its shorter side: slopes of 0.05 µm per pixel, a sixth of a fringe."""

BLEMISHES: dict[str, Any] = {"bad_columns": 6, "hot_pixels": 200, "prnu_rms": 0.003}
"""What ``--blemishes`` puts on the sensor: about what a science-grade sensor shows."""


@command("mock-flats")
def mock_flats(
    out: OutputFolder = output_folder(
        "Folder for the frames.", "*_bias_bias_*.fits", "*_lambda_flat_*.fits", argument=True
    ),
    setup: str = laboratory_of_the_mock,
    detector: str | None = option("Sensor; that of the set-up if not given."),
    thickness: str = option(
        "Map of the varying layer: a FITS file [µm], 'random', or 'e2v_321' (model of a measured sensor).",
        BUILT_IN,
    ),
    wavelengths: tuple[float, ...] | None = option("first:last:step or a list [nm].", kind=WAVELENGTHS),
    effects: ChosenEffects = model_effects(
        "Hidden effect; may be repeated.", "YAML with hidden effects.", own=False
    ),
    size: tuple[int, int] | None = option(
        "Cut-down sensor, columns x rows; full size if not given.", kind=SIZE
    ),
    bias_frames: int = option("How many of them.", 5, click.IntRange(1, 200)),
    level: float = option("Electrons.", 20_000.0, click.FloatRange(10.0, 100000.0)),
    temperature: float | None = option("Sensor temperature, as 183.15 or -90degC.", kind=Quantity("K")),
    silicon: str | None = option("Table of silicon, as Si_franta2017; that of the set-up if not given."),
    blemishes: bool = option("Bad columns and hot pixels.", False, names="--blemishes/--no-blemishes"),
    seed: int = option("Seed of all randomness.", kind=click.IntRange(0), required=True),
    dry_run: bool = DRY_RUN,
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


def thickness_map(text: str, setup: Setup, shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
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
