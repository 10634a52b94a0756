"""``fringe-sim sky``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, to_number
from ..instrument.setup import LONGEST_EXPOSURE_S
from .command import DRY_RUN, command, option
from .output import OutputFolder, origin_of, output_folder
from .parameters import BUILT_IN, SKY, ChosenEffects, Quantity, model_effects
from .progress import progress

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    from ..algorithms.coadds import VisitPlaces
    from ..algorithms.sky_response import Response
    from ..instrument.detector import Detector
    from ..instrument.flat_spectrum import FlatSpectrum
    from ..instrument.night import NightHistory
    from ..instrument.setup import Setup
    from ..model import FringeModel
    from ..products import SensorSection, SkyFringe

    FloatArray = FloatArray

PERCENT = 100.0
MARGIN_UM = 1e-6  # of the tabulated thickness beyond that of the layer
NO_DATE = "1970-01-01T00:00:00"  # of templates of a model: two runs agree to the byte


@command()
def sky(
    setup: Setup = SKY.option("lsst_e2v", "Sensor and telescope: name or file."),
    thickness: str = option(
        "Map of the varying layer: a FITS file [µm], or 'e2v_321' (built in).", required=True
    ),
    silicon_thickness: str | None = option(
        "Map of the silicon on the same pixels, as 'fringe-sim fit --silicon' writes it; even without.",
        metavar="FILE",
    ),
    phase_sigma: float = option(
        "Uncertainty of the phase of the adhesive between laboratory and sky [rad per 10 K]; its value, 0, is "
        "the effect epoxy_temperature.phase_per_10k.",
        0.3,
        click.FloatRange(0.0, 2.0),
    ),
    detector: str | None = option("Place in the focal plane; decides the beam."),
    exptime: float | None = option("Exposure time; by default the set-up's.", kind=Quantity("s")),
    airmass: float | None = option("By default the set-up's.", kind=click.FloatRange(1.0, 5.0)),
    flat_spectrum: str | None = option(
        "Light of the flat field: white, gaussian:MEAN:FWHM in nm (an LED or a laser), or a table; by default "
        "white where every pixel has its own beam, and none otherwise."
    ),
    night: bool = option("Eleven hourly frames of the published night.", False, names="--night/--one-frame"),
    level: str = option(
        "Mean level: that of the measured quantum efficiency, or what the stack itself detects.",
        "measured",
        click.Choice(["measured", "model"]),
    ),
    templates: bool = option(
        "Also write templates for 'fringe-sim correct': the sky, and how that phase changes it.",
        False,
        names="--templates/--no-templates",
    ),
    noiseless: bool = option(
        "Without photon and read noise, as for templates.", False, names="--noiseless/--noise"
    ),
    seed: int = option("Seed of the noise.", 1, click.IntRange(0)),
    visits: str | None = option(
        "Table (ECSV) of visits for the coadd in the report of noiseless frames: x, y [px] and rotation [deg] "
        "of a region of the sky on the sensor, perhaps the number of its frame; by default at random.",
        metavar="FILE",
    ),
    effects: ChosenEffects = model_effects(),
    out: OutputFolder = output_folder(
        "Folder for frames, figure and report.",
        "sky_*_[0-9][0-9].fits",
        "fringe_*.fits",
        "sky.png",
        "coadd_sources.ecsv",
        "report.html",
    ),
    dry_run: bool = DRY_RUN,
) -> None:
    """Simulate the fringes of the night sky for one sensor behind a telescope.

    Effects may be those that a search has found (effects.py); those of the laboratory stay there.

    \b
    Examples:
      fringe-sim sky --thickness fit/thickness.fits --detector R22_S11 --out sky
      fringe-sim sky --thickness fit/thickness.fits --silicon-thickness fit/silicon.fits --out sky_of_both
      fringe-sim sky --setup monocam --thickness e2v_321 --noiseless --exptime 60s --out sky
      fringe-sim sky --thickness fit/thickness.fits --effects-file verdict/effects.py --out sky_with_effects
    """
    from ..algorithms.coadd_sources import NightResults
    from ..instrument.flat_spectrum import FlatSpectrum
    from ..instrument.night import NightHistory
    from ..report.sky_page import write_sky_report
    from .inputs import placed_model, sky_settings

    _check_exposure(exptime, night)
    sensor = setup.sensor(detector)
    header = map_header(thickness)
    contrast = laboratory_contrast(header, thickness)
    layer, section = _layer(thickness, sensor, setup)
    silicon = _silicon(silicon_thickness, layer, setup, str(header.get("DETNAME", "")))
    settings = sky_settings(effects.settings)
    history = NightHistory.guo2022() if night else None
    flat = None if flat_spectrum is None else FlatSpectrum.from_name(flat_spectrum)
    count = 1 if history is None else len(history)
    places = None if visits is None else _places(visits, noiseless, count, layer.shape)
    if dry_run:
        pixels = f"{layer.shape[1]} x {layer.shape[0]} pixels"
        click.echo(f"would simulate {count} frames of {sensor.name}, {pixels}")
        return
    model = placed_model(setup, settings, sensor).at_laboratory_temperature(header)
    maps = [name for name in (thickness, silicon_thickness) if name not in (BUILT_IN, None)]
    given: list[str | Path] = [*maps, *effects.files]
    cards = _cards(model, given, contrast, section) | ({} if flat is None else {"FLATSPEC": flat.name})
    folder = out.prepare()
    common: dict[str, Any] = {"detector": sensor.name, "physical_filter": setup.filter_name}
    common |= (
        {"read_noise_e": 0.0, "seed": None}
        if noiseless
        else {"read_noise_e": sensor.read_noise, "seed": seed}
    )
    exposure = Exposure(exptime, airmass or setup.airmass, history, level == "measured", flat)
    layers = Layers(layer, silicon, section, phase_sigma)
    response = _response(layers, model, sensor, exposure)
    series, scales = _frames(layers, model, response, exposure, common)
    made = _written(series, scales, folder / f"sky_{sensor.name}", cards, section)
    if templates:
        _write_templates(layers, model, response, folder / f"fringe_{sensor.name}", cards, sensor)
    shown: dict[str, Any] = {"section": section, "origin": origin_of(folder, given)}
    results = NightResults.of(made, seed, places, setup.pixel_scale_arcsec)
    page = write_sky_report(
        folder / "report.html", made, setup.name, results, picture=folder / "sky.png", **shown
    )
    for line in (*_said(made, model, contrast), folder, page):
        click.echo(str(line))


def _said(made: list[SkyFringe], model: FringeModel, contrast: tuple[float, float] | None) -> Iterator[str]:
    """What the command says of the frames, line by line."""
    yield from map(_describe, made)
    if "PHASERMS" in made[0].metadata:
        yield _open_phase(made[0], model)
    if contrast is not None:
        yield _both_forecasts(made[0], *contrast)


@dataclass(frozen=True, eq=False)
class Layers:
    """What is known of the layers of a sensor."""

    thickness_um: FloatArray  # NaN where one of the two layers is not known
    silicon_um: FloatArray | None  # as the stack has it if not given
    section: SensorSection | None
    phase_sigma: float  # of the adhesive between laboratory and sky [rad per 10 K]


@dataclass(frozen=True)
class Exposure:
    """How the sky is exposed."""

    exptime_s: float | None  # by default that of the set-up
    airmass: float
    night: NightHistory | None  # a frame for each of its times; one frame of the dark sky without
    measured: bool  # whether the level is that of the measured quantum efficiency
    flat: FlatSpectrum | None  # light of the flat field


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


def _response(layers: Layers, model: FringeModel, sensor: Detector, exposure: Exposure) -> Response:
    """Response of the sensor to the dark sky."""
    from ..algorithms.sensor_placement import SensorPlacement
    from ..algorithms.sky_of_maps import silicon_nodes_um, sky_of_maps
    from ..instrument.sky import SkySpectrum
    from ..products.thickness_map import thickness_span_um

    dark = replace(SkySpectrum.dark(airmass=exposure.airmass), flat=exposure.flat)
    nodes = None if layers.silicon_um is None else silicon_nodes_um(model, layers.silicon_um)
    many = 1 if nodes is None else len(nodes)
    of_silicon = f" for {many} thicknesses of the silicon" if many > 1 else ""
    click.echo(f"tabulating the response to the sky{of_silicon}", err=True)
    with progress("tabulating", many) if many > 1 else nullcontext() as advance:
        made = sky_of_maps(
            model,
            dark,
            SensorPlacement.of(sensor, model.setup.pixel_scale_arcsec, layers.section),
            thickness_span_um(layers.thickness_um, MARGIN_UM),
            nodes,
            phase_sigma=layers.phase_sigma,
            advance=advance,
        )
    return made.on(layers.silicon_um)


def _frames(
    layers: Layers, model: FringeModel, response: Response, exposure: Exposure, common: Mapping[str, Any]
) -> tuple[Iterable[SkyFringe], list[dict[str, float]]]:
    """Frames, made one after the other as they are asked for, and the bands of each relative to the dark sky."""
    from ..algorithms.sky_frame import simulate_night, simulate_sky_frame, throughput_electrons
    from ..instrument.bandpass import Bandpass
    from ..instrument.sky import SkySpectrum

    dark = SkySpectrum.dark(airmass=exposure.airmass)
    night, seconds, layer = exposure.night, exposure.exptime_s, layers.thickness_um
    common = {**common, "phase_sigma": layers.phase_sigma}
    scales = [dict.fromkeys(response.bands, 1.0)]
    if night is not None:
        scales = [night.band_scale(time, response.bands) for time in range(len(night))]
    levels = None
    band = Bandpass.from_name(model.setup.bandpass)
    if exposure.measured and not band.detector.size:
        click.echo("no quantum efficiency was measured: the level is what the stack itself detects", err=True)
    elif exposure.measured:
        levels = [throughput_electrons(dark.with_band_scale(scale), band, model, seconds) for scale in scales]
    if night is not None:
        return simulate_night(layer, model, response, night, mean_electrons=levels, **common), scales
    mean = levels[0] if levels else None
    frame = simulate_sky_frame(
        layer, model, response=response, exposure_s=seconds, mean_electrons=mean, **common
    )
    return [frame], scales


def _write_templates(
    layers: Layers,
    model: FringeModel,
    response: Response,
    stem: Path,
    cards: Mapping[str, str | float],
    sensor: Detector,
) -> None:
    """The template of the sky, and that of the phase of the adhesive where it is open."""
    from ..algorithms.laboratory_shift import template_pair

    made = template_pair(
        layers.thickness_um, model, response, layers.phase_sigma, NO_DATE, detector=sensor.name
    )
    for number, template in enumerate(made):
        template.write_fits(f"{stem}_{number}.fits", cards, section=layers.section)


def _open_phase(frame: SkyFringe, model: FringeModel) -> str:
    """What the phase of the adhesive leaves open."""
    setup, rms = model.setup, PERCENT * float(frame.metadata["PHASERMS"])
    colder = (setup.laboratory_temperature_k or setup.temperature_k) - setup.temperature_k
    return (
        f"the map was measured {colder:.0f} K warmer: an unknown phase of the adhesive of "
        f"± {float(frame.metadata['PHASESIG']):.2g} rad per 10 K changes the pattern by {rms:.4f} % rms"
    )


def _places(visits: str, noiseless: bool, frames: int, shape: tuple[int, ...]) -> VisitPlaces:
    """Read the visits, and check that a region lies on the sensor in all of them."""
    from ..algorithms.coadds import VisitPlaces

    if not noiseless:
        raise InputError("--visits", visits, "a table for frames that are --noiseless")
    places = VisitPlaces.read(visits, frames)
    places.region_px(shape)
    return places


def _check_exposure(exptime: float | None, night: bool) -> None:
    if night and exptime is not None:
        raise InputError(
            "--exptime", exptime, "nothing beside --night, whose frames have the set-up's exposure"
        )
    if exptime is not None and not 0.0 < exptime <= LONGEST_EXPOSURE_S:
        raise OutOfRangeError("exposure time [s]", exptime, f"above 0, up to {LONGEST_EXPOSURE_S:g}")


def map_header(thickness: str) -> Mapping[str, Any]:
    """First header of the file of a map; empty for the built-in one."""
    from ..products.fits_product import check_noted
    from ..resources import complete_fits

    if thickness == BUILT_IN:
        return {}
    with complete_fits(thickness) as hdus:
        header = dict(hdus[0].header)
        check_noted(header)
    return header


def laboratory_contrast(header: Mapping[str, Any], source: str) -> tuple[float, float] | None:
    """Contrast of the laboratory flats over that of the model, and its uncertainty, if the header of a map tells.

    None of a map whose fit held it at that of the model.
    """
    if "CONTRAST" not in header or "CONTRSIG" not in header:
        return None
    contrast, sigma = (to_number(name, header[name]) for name in ("CONTRAST", "CONTRSIG"))
    if not (0.0 <= contrast < math.inf and 0.0 <= sigma < math.inf):
        found = (contrast, sigma)
        raise InputError("CONTRAST, CONTRSIG", found, "finite and not negative", source=source)
    return None if (contrast, sigma) == (1.0, 0.0) else (contrast, sigma)  # it was held


def _both_forecasts(frame: SkyFringe, contrast: float, sigma: float) -> str:
    """The fringes of a sky frame, the contrast that the laboratory misses being lost there only, or here as well."""
    rms = PERCENT * float(frame.metadata["FRINGRMS"])
    return (
        f"the laboratory flats have {contrast:.3g} ± {sigma:.1g} of the model's contrast: fringes of rms {rms:.4f} % "
        f"if it is lost in the laboratory only, {contrast * rms:.4f} % if it is lost on the sky as well; the frames "
        "hold the first. A frame of the sky of this sensor decides, or a cause that 'fringe-sim discover' names"
    )


def _silicon(path: str | None, layer: FloatArray, setup: Setup, sensor: str) -> FloatArray | None:
    """Thickness of the silicon [µm] on the pixels of another layer, which loses those where it is not known."""
    from ..algorithms.sky_of_maps import DETECTION, known_silicon_um
    from ..products import ThicknessMap

    if path is None:
        return None
    silicon = known_silicon_um(ThicknessMap.read_any(path, DETECTION), layer.shape, setup, path, sensor)
    layer[silicon != silicon] = math.nan  # not known
    return silicon


def _layer(thickness: str, sensor: Detector, setup: Setup) -> tuple[FloatArray, SensorSection | None]:
    """Thickness of the varying layer [µm], and the part of the sensor that it is of."""
    from ..instrument.measured_thickness import e2v_321
    from ..products import SensorSection
    from .inputs import read_section, read_thickness

    if thickness == BUILT_IN:
        layer = e2v_321()
        return layer, SensorSection.of_image(sensor, (layer.shape[0], layer.shape[1]), {})
    layer = read_thickness(thickness, setup, sensor)
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
