"""``fringe-sim sky``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import InputError, OutOfRangeError
from .output import OutputFolder, output_folder
from .parameters import BUILT_IN, SKY, ChosenEffects, Quantity, model_effects
from .progress import progress

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    import numpy as np
    from numpy.typing import NDArray

    from ..instrument.detector import Detector
    from ..instrument.night import NightHistory
    from ..instrument.setup import Setup
    from ..model import FringeModel
    from ..products import SensorSection, SkyFringe

    FloatArray = NDArray[np.float64]

__all__ = ["sky"]

PERCENT = 100.0
MARGIN_UM = 1e-6  # of the tabulated thickness beyond that of the layer


@click.command()
@SKY.option("lsst_e2v", "Sensor and telescope: name or file.")
@click.option(
    "--thickness", required=True, help="Map of the varying layer: a FITS file [µm], or 'e2v_321' (built in)."
)
@click.option("--detector", default=None, help="Place in the focal plane; decides the beam.")
@click.option("--exptime", type=Quantity("s"), default=None, help="Exposure time; by default the set-up's.")
@click.option("--airmass", type=click.FloatRange(1.0, 5.0), default=None, help="By default the set-up's.")
@click.option("--night/--one-frame", default=False, help="Eleven hourly frames of the published night.")
@click.option(
    "--level",
    type=click.Choice(["measured", "model"]),
    default="measured",
    show_default=True,
    help="Mean level: that of the measured quantum efficiency, or what the stack itself detects.",
)
@click.option("--noiseless/--noise", default=False, help="Without photon and read noise, as for templates.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of the noise.")
@model_effects()
@output_folder("Folder for frames, figure and report.", "sky_*_[0-9][0-9].fits", "sky.png", "report.html")
@click.option("--dry-run", is_flag=True, help="Check everything, write nothing.")
def sky(
    setup: Setup,
    thickness: str,
    detector: str | None,
    exptime: float | None,
    airmass: float | None,
    night: bool,
    level: str,
    noiseless: bool,
    seed: int,
    effects: ChosenEffects,
    out: OutputFolder,
    dry_run: bool,
) -> None:
    """Simulate the fringes of the night sky for one sensor behind a telescope.

    Effects may be those that a search has found (effects.py); those of the laboratory stay there.

    \b
    Examples:
      fringe-sim sky --thickness fit/thickness.fits --detector R22_S11 --out sky
      fringe-sim sky --setup monocam --thickness e2v_321 --noiseless --exptime 60s --out sky
      fringe-sim sky --thickness fit/thickness.fits --effects-file verdict/effects.py --out sky_with_effects
    """
    from ..instrument.camera import Camera
    from ..instrument.night import NightHistory
    from ..report.figures import sky_figure
    from ..report.sky_page import write_sky_report
    from ..report.style import save_figure
    from .inputs import sky_settings

    _check_exposure(exptime, night)
    sensor = Camera.from_name(setup.camera).detector(detector or setup.detector)
    layer, section = _layer(thickness, sensor, setup.varying)
    settings = sky_settings(effects.settings)
    history = NightHistory.guo2022() if night else None
    count = 1 if history is None else len(history)
    if dry_run:
        click.echo(
            f"would simulate {count} frames of {sensor.name}, {layer.shape[1]} x {layer.shape[0]} pixels"
        )
        return
    model = _model(setup, settings, sensor)
    contrast = laboratory_contrast(thickness)
    given: list[str | Path] = [*([] if thickness == BUILT_IN else [thickness]), *effects.files]
    cards = _cards(model, given, contrast, section)
    folder = out.prepare()
    common: dict[str, Any] = {
        "read_noise_e": 0.0 if noiseless else sensor.read_noise,
        "seed": None if noiseless else seed,
        "detector": sensor.name,
        "physical_filter": setup.bandpass,
    }
    exposure = Exposure(exptime, airmass or setup.airmass, history, level == "measured")
    series, scales = _frames(layer, model, sensor, section, exposure, common)
    made = _written(series, scales, folder / f"sky_{sensor.name}", cards, section)
    save_figure(sky_figure(made), folder / "sky.png")
    page = write_sky_report(folder / "report.html", made, setup.name, seed)
    for frame in made:
        click.echo(_describe(frame))
    if contrast is not None:
        click.echo(_both_forecasts(made[0], *contrast))
    click.echo(str(folder))
    click.echo(str(page))


@dataclass(frozen=True)
class Exposure:
    """How the sky is exposed."""

    exptime_s: float | None  # by default that of the set-up
    airmass: float
    night: NightHistory | None  # a frame for each of its times; one frame of the dark sky without
    measured: bool  # whether the level is that of the measured quantum efficiency


def _model(setup: Setup, settings: Mapping[str, Any], sensor: Detector) -> FringeModel:
    from ..algorithms.field_response import SensorPlacement
    from ..model import FringeModel

    centre = SensorPlacement.of(sensor, setup.pixel_scale_arcsec)
    return FringeModel.from_setup(
        setup, settings, field_x_deg=centre.field_x_deg, field_y_deg=centre.field_y_deg
    )


def _cards(
    model: FringeModel,
    given: Sequence[str | Path],
    contrast: tuple[float, float] | None,
    section: SensorSection | None,
) -> dict[str, str | float]:
    """Header keywords that all frames have."""
    from ..model.provenance import input_cards
    from .inputs import effect_cards

    cards: dict[str, str | float] = {
        "SETUP": model.setup.name,
        "BEAMS": "pixel",
        **effect_cards(model),
        **input_cards(given),
    }
    if contrast is not None:
        cards |= {"LABCONTR": contrast[0], "LABCONSG": contrast[1]}
    if section is not None:
        cards["DETSEC"] = section.keyword
    return cards


def _frames(
    layer: FloatArray,
    model: FringeModel,
    sensor: Detector,
    section: SensorSection | None,
    exposure: Exposure,
    common: Mapping[str, Any],
) -> tuple[Iterable[SkyFringe], list[dict[str, float]]]:
    """Frames, made one after the other as they are asked for, and the bands of each relative to the dark sky."""
    from ..algorithms.field_response import SensorPlacement, sensor_response
    from ..algorithms.sky_frame import simulate_night, simulate_sky_frame, throughput_electrons
    from ..instrument.bandpass import Bandpass
    from ..instrument.sky import SkySpectrum
    from ..products.thickness_map import thickness_span_um

    dark = SkySpectrum.dark(airmass=exposure.airmass)
    click.echo("tabulating the response to the sky", err=True)
    place = SensorPlacement.of(sensor, model.setup.pixel_scale_arcsec, section)
    response = sensor_response(model, dark, place, thickness_span_um(layer, MARGIN_UM))
    night, seconds = exposure.night, exposure.exptime_s
    scales = [dict.fromkeys(response.bands, 1.0)]
    if night is not None:
        scales = [night.band_scale(time, response.bands) for time in range(len(night))]
    levels = None
    if exposure.measured:
        band = Bandpass.from_name(model.setup.bandpass)
        levels = [throughput_electrons(dark.with_band_scale(scale), band, model, seconds) for scale in scales]
    if night is not None:
        return simulate_night(layer, model, response, night, mean_electrons=levels, **common), scales
    mean = levels[0] if levels else None
    frame = simulate_sky_frame(
        layer, model, response=response, exposure_s=seconds, mean_electrons=mean, **common
    )
    return [frame], scales


def _check_exposure(exptime: float | None, night: bool) -> None:
    if night and exptime is not None:
        raise InputError(
            "--exptime", exptime, "nothing beside --night, whose frames have the set-up's exposure"
        )
    if exptime is not None and not exptime > 0.0:
        raise OutOfRangeError("exposure time [s]", exptime, "positive")


def laboratory_contrast(thickness: str) -> tuple[float, float] | None:
    """Contrast of the laboratory flats over that of the model, and its uncertainty, if the map states them."""
    from ..resources import open_user_fits

    if thickness == BUILT_IN:
        return None
    with open_user_fits(thickness) as hdus:
        header = hdus[0].header
        if "CONTRAST" not in header or "CONTRSIG" not in header:
            return None
        return float(header["CONTRAST"]), float(header["CONTRSIG"])


def _both_forecasts(frame: SkyFringe, contrast: float, sigma: float) -> str:
    """The fringes of a sky frame, the contrast that the laboratory misses being lost there only, or here as well."""
    rms = PERCENT * float(frame.metadata["FRINGRMS"])
    return (
        f"the laboratory flats have {contrast:.3g} ± {sigma:.1g} of the model's contrast: fringes of rms {rms:.4f} % "
        f"if it is lost in the laboratory only, {contrast * rms:.4f} % if it is lost on the sky as well; the frames "
        "hold the first. A frame of the sky of this sensor decides, or a cause that 'fringe-sim discover' names"
    )


def _layer(thickness: str, sensor: Detector, name: str) -> tuple[FloatArray, SensorSection | None]:
    """Thickness of the varying layer [µm], and the part of the sensor that it is of."""
    from ..instrument.measured_thickness import e2v_321
    from ..products import SensorSection
    from .inputs import read_section, read_thickness

    if thickness == BUILT_IN:
        layer = e2v_321()
        return layer, SensorSection.of_image(sensor, (layer.shape[0], layer.shape[1]), {})
    layer = read_thickness(thickness, name)
    return layer, read_section(thickness, sensor, (layer.shape[0], layer.shape[1]))


def _written(
    series: Iterable[SkyFringe],
    scales: Sequence[Mapping[str, float]],
    stem: Path,
    cards: Mapping[str, str | float],
    section: SensorSection | None,
) -> list[SkyFringe]:
    """Frames, each written while the next one is simulated; headers tell what its bands are."""
    from ..products import band_cards

    made: list[SkyFringe] = []
    write: Future[None] | None = None
    with progress("simulating frames", len(scales)) as advance, ThreadPoolExecutor(1) as thread:
        for number, (frame, scale) in enumerate(zip(series, scales, strict=True)):
            if write is not None:
                write.result()  # an error of the disk ends the command here
            of_frame = {**cards, **band_cards(scale)}
            write = thread.submit(frame.write_fits, f"{stem}_{number:02d}.fits", of_frame, section=section)
            made.append(frame)
            advance()
        if write is not None:
            write.result()
    return made


def _describe(frame: SkyFringe) -> str:
    rms, half, trimmed = (
        PERCENT * float(frame.metadata[key]) for key in ("FRINGRMS", "FRINGPTP", "FRING198")
    )
    return (
        f"{frame.hour % 24.0:4.1f} h: {frame.mean_electrons:.0f} e-/pixel; fringes rms {rms:.4f} %, "
        f"half peak to peak {half:.4f} %, half 1-99 % range {trimmed:.4f} %; "
        f"quadrature error {PERCENT * frame.quadrature_error:.1e} %"
    )
