"""``fringe-sim fit-sky``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from ..array_types import Float32Array, FloatArray
from ..errors import InputError
from .bad_files import refuse_bad
from .command import DRY_RUN, EXISTING, argument, command, flag, option
from .observed import Background, background_options, images_of, other_light
from .output import OutputFolder, origin_of, output_folder
from .parameters import SKY, THICKNESS_RANGE, ChosenEffects, model_effects
from .progress import progress

if TYPE_CHECKING:
    from ..algorithms.fringe_correction import CorrectionOptions
    from ..algorithms.map_from_range import RangeMap
    from ..algorithms.map_on_sky import MapOnSky
    from ..algorithms.range_forecast import RangeForecast
    from ..algorithms.sky_response import Response
    from ..instrument.detector import Detector
    from ..instrument.setup import Setup
    from ..model import FringeModel
    from ..products import ObservedFrame, SensorSection, ThicknessMap
    from ..products.observed_files import ObservedImage
    from ..report.page import Origin

NM = 1000.0
WORTH_ORDERS = 0.02
"""Uncertainty to which a map is wanted, for what the command says of more frames [orders]: 0.13 rad of phase leave a
hundredth of the power of the fringes."""

MOST_FRAMES = 1_000_000  # More than these are not counted

LEAST_PROBABILITY = 0.5
"""Of the order of a map from a range that is written: it is likelier than all others together."""

LARGE_ERROR = 0.3
"""Errors of the fringes, over the fringes, with which neighbouring orders were mistaken for each other in trials
with bright frames of another simulator."""


class _MapOrRange(click.ParamType):
    """A file that exists, or a range of thickness."""

    name = "FILE|LOW:HIGH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> str | tuple[float, float]:
        if isinstance(value, str) and (":" not in value or Path(value).exists()):
            file = click.Path(exists=True, dir_okay=False)
            return str(file.convert(value, param, ctx))
        return THICKNESS_RANGE.convert(value, param, ctx)


@command()
def fit_sky(
    frames: tuple[Path, ...] = argument(kind=EXISTING),
    thickness: str | tuple[float, float] = option(
        "Map of the sensor; or its range alone, as 13um:17um, for how many frames would tell a map.",
        kind=_MapOrRange(),
        required=True,
    ),
    setup: Setup = SKY.option("lsst_e2v", "Set-up with a telescope: name or file."),
    detector: str | None = option("Place in the focal plane; by default as the frames say."),
    map_sigma: float | None = option(
        "What all of the map may be off by, one σ [µm]; by default 0.15 fringe orders.",
        kind=click.FloatRange(0.0, 10.0, min_open=True),
    ),
    order_error: float | None = option(
        "Part of the fringes by which the model may be wrong along the difference between orders, for the order of "
        "a map from a range; by default as another simulator differs (0.17); 0 for a model without error.",
        kind=click.FloatRange(0.0, 1.0, max_open=True),
        metavar="PART",
    ),
    former_order_error: float | None = option(
        "The former name of --order-error.",
        kind=click.FloatRange(0.0, 1.0, max_open=True),
        names="--model-accuracy",
        deprecated="since 1.1, will be removed in 1.2: --order-error takes its place",
    ),
    background: Background = background_options(),
    effects: ChosenEffects = model_effects("Effect on the sky; may be repeated."),
    out: OutputFolder = output_folder(
        "Folder for the moved map and the report.",
        "thickness.fits",
        "thickness.png",
        "forecast.ecsv",
        "report.html",
    ),
    skip_bad: bool = flag("Go on without frames that cannot be read."),
    dry_run: bool = DRY_RUN,
) -> None:
    """Hold a thickness map against frames of the night sky, and move it where they disagree.

    FRAMES are those of one sensor in one filter, after the removal of the instrument's signature and before the
    subtraction of background and fringes. The strength of every OH band is free in every frame, so that nights in
    which the bands vary tell more. The map that is written holds the shift, and its uncertainty. From a range of the
    thickness alone it is stated how many frames like these a map would take; where there are as many, one is searched
    for.

    \b
    Examples:
      fringe-sim fit-sky night --thickness fit/thickness.fits --detector R22_S11 --out on_sky
      fringe-sim fit-sky night --thickness 13um:17um --detector R22_S11 --out how_many
    """
    from ..algorithms.map_on_sky import map_on_sky, reach_um
    from .inputs import placed_model, read_map, read_section, sky_settings

    images, unusable = images_of(frames, _refuse_unfit)
    refuse_bad(unusable, skip_bad=skip_bad)
    sensor = _sensor_of(images, setup, detector)
    options, loaders = background.options, background.loaders(images)
    if not isinstance(thickness, str):
        model = placed_model(setup, sky_settings(effects.settings), sensor)
        _check_frames(loaders, images, None, setup)
        if dry_run:
            click.echo(f"would say how many frames like {len(images)} of {sensor.name} a map takes")
        else:
            wrong = former_order_error if order_error is None else order_error
            _forecast(thickness, model, loaders, options, wrong, out)
        return
    layer = read_map(thickness, setup, sensor)
    section = read_section(thickness, sensor, layer.shape)
    model = placed_model(setup, sky_settings(effects.settings), sensor)
    order_um = float(model.fringe_order_um(960.0))
    _check_frames(loaders, images, layer, setup)
    if dry_run:
        click.echo(f"would hold the map of {sensor.name} against {len(images)} frames")
        return
    folder = out.prepare()
    response = _response(layer, model, sensor, section, reach_um(order_um, map_sigma))
    with progress("finding fringes", len(images)) as advance:
        found = map_on_sky(
            loaders, layer, response, order_um, options, map_sigma_um=map_sigma, advance=advance
        )
    given: list[str | Path] = [thickness, *dict.fromkeys(image.path for image in images)]
    origin = origin_of(folder, [*given, *effects.files])
    _write(found, folder, layer, given, said(found, len(images), order_um), len(images), section, origin)


def _write(
    found: MapOnSky,
    folder: Path,
    layer: ThicknessMap,
    given: Sequence[str | Path],
    lines: list[str],
    frames: int,
    section: SensorSection | None,
    origin: Origin,
) -> None:
    """Map, page and what is said."""
    from ..model.provenance import input_cards, software_cards
    from ..report.map_on_sky_page import write_map_on_sky_report

    found.moved.write_fits(folder / "thickness.fits", {**software_cards(), **input_cards(list(given))})
    page = write_map_on_sky_report(
        folder / "report.html", found, layer, lines, frames=frames, section=section, origin=origin
    )
    for line in [*lines, str(folder / "thickness.fits"), str(page)]:
        click.echo(line)


def _forecast(
    range_um: tuple[float, float],
    model: FringeModel,
    loaders: Sequence[Callable[[], ObservedFrame]],
    options: CorrectionOptions,
    order_error: float | None,
    out: OutputFolder,
) -> None:
    """How many frames would tell a map of which a range is known."""
    from dataclasses import asdict

    from astropy.table import Table

    from ..algorithms.map_from_range import map_from_range
    from ..algorithms.range_forecast import forecast_of_range, frame_noise
    from ..algorithms.sky_response import sky_response
    from ..files import table_text, write_whole
    from ..instrument.sky import SkySpectrum

    model.checked_thickness_um(range_um)
    folder, frame = out.prepare(), loaders[0]()
    noise, pixels = frame_noise(frame, options)
    order_um = float(model.fringe_order_um(960.0))
    dark = SkySpectrum.dark(airmass=model.setup.airmass)
    span = max(range_um[0] - 2.0 * order_um, 0.5 * range_um[0]), range_um[1] + 2.0 * order_um
    table = sky_response(model, dark, thickness_range_um=span).sky()
    shape = (frame.shape[0], frame.shape[1])

    def predict(grid: FloatArray) -> Float32Array:
        return table.frame(grid[None, :])[0]

    found = forecast_of_range(predict, range_um, order_um, shape, pixels, noise)
    write_whole(folder / "forecast.ecsv", table_text(Table([{**asdict(found), "frames": found.frames}])))
    for line in forecast_lines(found, len(loaders)):
        click.echo(line)
    click.echo(str(folder / "forecast.ecsv"))
    if len(loaders) >= found.frames:
        search = partial(map_from_range, range_um=range_um, predict=predict, order_um=order_um)
        if order_error is not None:
            search = partial(search, order_error=order_error)
        _search(search, loaders, options, model.setup.varying, folder)


def _search(
    search: Callable[..., RangeMap],
    loaders: Sequence[Callable[[], ObservedFrame]],
    options: CorrectionOptions,
    layer: str,
    folder: Path,
) -> None:
    """Write the map that the frames tell, or say that they tell none."""
    from ..algorithms.map_on_sky import fringes_alone
    from ..errors import UndeterminedError
    from ..model.provenance import software_cards

    first = loaders[0]()
    with progress("finding fringes", len(loaders)) as advance:
        values, weights = [], []
        for loader in loaders:
            value, weight = fringes_alone(loader(), [], options, first.shape)
            values.append(value)
            weights.append(weight)
            advance()
    try:
        found = search(values, weights)
    except UndeterminedError as error:
        click.echo(f"no map was found: {error}")
        return
    if found.order_probability < LEAST_PROBABILITY:
        click.echo(
            f"no map was found: the likeliest one has a probability of {found.order_probability:.2g} among other "
            f"orders and directions, and {LEAST_PROBABILITY:g} is asked for; the next leaves {found.apart:.2g} of "
            "its fringes, and the model may be wrong by more (--order-error)"
        )
        return
    if found.model_error >= LARGE_ERROR:
        click.echo(
            f"no map was found: the likeliest one leaves {found.model_error:.2g} of the fringes "
            "(lines, films, silicon)"
        )
        return
    found.thickness_map(layer, first.detector).write_fits(folder / "thickness.fits", software_cards())
    click.echo(
        f"{100.0 * float(found.known.mean()):.0f} % of the pixels are known, with a median σ of "
        f"{NM * float(np.median(found.sigma_um[found.known])):.3g} nm within their order; the order of all and the "
        f"direction are right with a probability of {found.order_probability:.2g}, if the range is, and the model "
        f"to {0.5 * found.apart:.2g} of its fringes"
    )
    click.echo(str(folder / "thickness.fits"))


def forecast_lines(found: RangeForecast, frames: int) -> list[str]:
    """What a range of the thickness and the noise of a frame say, line by line."""
    verdict = (
        f"there are {frames}: too few for a map from the range alone"
        if frames < found.frames
        else f"there are {frames}: the signal may suffice, and a map is searched for"
    )
    return [
        f"fringes of the dark sky: {100.0 * found.fringe_rms:.2g} % rms; noise of a pixel of the first frame: "
        f"{100.0 * found.noise:.2g} %",
        f"{found.orders:.1f} fringe orders lie within the range; the layer is a plane over {found.part_px} px",
        f"such a part shows its fringes in {_counted(found.to_see)} frames like the first, at the least; "
        f"one tells the thickness within the order to {found.sigma_um:.3f} µm",
        f"all pixels tell the order in {_counted(found.to_tell_order)} frames, at the least, if the model is "
        "right",
        f"{verdict}; a map from the laboratory takes fewer",
    ]


def _counted(frames: int) -> str:
    return str(frames) if frames <= MOST_FRAMES else f"more than {MOST_FRAMES:,}"


def said(found: MapOnSky, frames: int, order_um: float) -> list[str]:
    """What the frames say of the map, line by line."""
    shift = found.shift
    mean, rms, median = (
        NM * float(each) for each in (shift.shift_um.mean(), shift.shift_um.std(), np.median(shift.sigma_um))
    )
    strength = f"{shift.strength:.3g}"
    if shift.strength_sigma == shift.strength_sigma:
        strength += f" ± {shift.strength_sigma:.1g}"
    lines = [
        f"the map is right as it is with a probability of {shift.chance_unmoved:.2g}",
        f"shift: mean {mean:+.3g} nm, rms about it {rms:.3g} nm, median σ {median:.3g} nm",
        f"whole orders away with a probability of {shift.chance_other_order:.2g}",
        f"fringes of the frames over those of the dark sky: {strength}",
    ]
    if shift.model_error >= LARGE_ERROR:
        lines.append(
            f"the model misses about {shift.model_error:g} of its fringes in all frames alike (lines, films, "
            "silicon): its order may be wrong whatever these probabilities say; a correction gains by the moved map"
        )
    wanted = WORTH_ORDERS * order_um
    needed = shift.frames_for(wanted, frames)
    known = f"parts of an eighth of the sensor are known to {NM * shift.alone_um:.3g} nm by the frames alone"
    more = (
        f"; {needed} such frames would tell {NM * wanted:.3g} nm ({WORTH_ORDERS:g} orders)"
        if needed > frames
        else ""
    )
    return [*lines, known + more]


def _refuse_unfit(header: Mapping[str, Any], source: str) -> None:
    from ..products import refuse_corrected, refuse_noiseless

    refuse_corrected(header, source)
    refuse_noiseless(header, source)


def _sensor_of(images: list[ObservedImage], setup: Setup, chosen: str | None) -> Detector:
    """Sensor that is chosen, or that all frames name; the set-up's own where neither tells."""
    from ..instrument.camera import Camera
    from ..products.observed_files import detector_of

    names = sorted({detector_of(image.header()) for image in images} - {""})
    if len(names) > 1:
        raise InputError("sensors of the frames", names, "one")
    sensor = setup.sensor(chosen or next(iter(names), None))
    if names and Camera.from_name(setup.camera).are_two_sensors(names[0], sensor.name):
        raise InputError("--detector", chosen, f"{names[0]}, which the frames name")
    return sensor


def _check_frames(
    loaders: Sequence[Callable[[], ObservedFrame]],
    images: Sequence[ObservedImage],
    layer: ThicknessMap | None,
    setup: Setup,
) -> None:
    """Refuse frames that do not belong together, or not to the map or the band of the set-up."""
    from ..algorithms.observed_frames import first_of_alike

    names = [f"{image.path}[{image.name}]" for image in images]
    first, _ = first_of_alike(loaders, names, "frames of the sky")
    if layer is not None and first.shape != layer.shape:
        raise InputError("shape of the frames", first.shape, f"{layer.shape}, that of the thickness map")
    if other_light(setup.filter_name, first.physical_filter, is_model=True):
        raise InputError(
            "filter of the frames", first.physical_filter, f"{setup.filter_name}, that of the set-up"
        )


def _response(
    layer: ThicknessMap, model: FringeModel, sensor: Detector, section: SensorSection | None, reach_um: float
) -> Response:
    """Response of the sensor to the dark sky, as far beyond the map as it may be off."""
    from ..algorithms.sensor_placement import SensorPlacement
    from ..algorithms.sky_of_maps import sky_of_maps
    from ..instrument.sky import SkySpectrum
    from ..products.thickness_map import thickness_span_um

    place = SensorPlacement.of(sensor, model.setup.pixel_scale_arcsec, section)
    click.echo("tabulating the response to the sky", err=True)
    span = thickness_span_um(layer.known_um(), reach_um)
    return sky_of_maps(model, SkySpectrum.dark(airmass=model.setup.airmass), place, span, None).on(None)
