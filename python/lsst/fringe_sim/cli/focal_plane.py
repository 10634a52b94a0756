"""``fringe-sim focal-plane``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from astropy.table import Column, Table, vstack

from ..algorithms.cost_model import FocalPlaneCost
from ..algorithms.field_response import (
    FieldResponse,
    SensorPlacement,
    angular_response,
    beam_field,
    beam_limits,
    field_response,
)
from ..algorithms.focal_plane import SkyLevel, forecast_sensor, summary_table
from ..algorithms.thickness_stand_in import ThicknessField, stand_in_thickness
from ..array_types import FloatArray
from ..errors import InputError
from ..files import table_text, write_together
from ..instrument.camera import Camera
from ..instrument.detector import Detector
from ..instrument.flat_spectrum import FlatSpectrum
from ..instrument.night import NightHistory, random_nights
from ..instrument.sky import SkySpectrum
from ..model import FringeModel, Setup
from ..products.sensor_section import SensorSection
from ..products.thickness_map import thickness_span_um
from ..report.focal_plane_page import write_focal_plane_page
from .command import command, flag, option
from .inputs import read_section, read_settings, read_thickness, sky_settings
from .output import OutputFolder, origin_of, output_folder
from .parameters import effects_file_option, with_effects_from
from .progress import progress

SETUPS = {"e2v": "lsst_e2v", "ITL": "lsst_itl"}  # Set-up of the sensors of each vendor
SAMPLE_PX = 5  # Pixels between the sampled ones: one per arcsecond, a tenth of the width of a fringe or less


@dataclass(frozen=True)
class SensorMap:
    """File with the thickness of one sensor."""

    name: str
    path: Path


class _SensorMapType(click.ParamType):
    name = "SENSOR=FILE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> SensorMap:
        if isinstance(value, SensorMap):
            return value
        name, equals, path = str(value).partition("=")
        if not equals or not name or not path:
            self.fail(f"{value!r} is not SENSOR=FILE, such as R11_S01=thickness.fits", param, ctx)
        return SensorMap(name, Path(path))


@command()
def focal_plane(
    sensors: tuple[str, ...] = option(
        "A sensor or a raft; may be repeated. By default all 189.", names="--sensor", multiple=True
    ),
    maps: tuple[SensorMap, ...] = option(
        "Measured map [µm] of a sensor; may be repeated. Other sensors get a random field like the measured ones.",
        kind=_SensorMapType(),
        names="--thickness",
        multiple=True,
    ),
    airmass: float = option("Airmass.", 1.2, click.FloatRange(1.0, 5.0)),
    flat_spectrum: str = option(
        "Light of the flat field: white, gaussian:MEAN:FWHM in nm, or a table.", "white"
    ),
    nights: int = option("Random nights to correct.", 5, click.IntRange(1, 1000)),
    seed: int = option("Of stand-ins and nights.", 0, click.IntRange(0)),
    effects_file: Path | None = with_effects_from(effects_file_option()),
    out: OutputFolder = output_folder(
        "Folder for tables, figure and report.",
        "cells.ecsv",
        "focal_plane.ecsv",
        "focal_plane.png",
        "report.html",
    ),
    dry_run: bool = flag("Check everything, state the cost, write nothing."),
) -> None:
    """Forecast the fringes of every sensor of the LSST Camera.

    Templates are made from the published night, and correct random nights. The same forecast in a Butler, with the
    frames of every exposure if they are wanted, is pipelines/lsstCam/focalPlane.yaml.

    \b
    Examples:
      fringe-sim focal-plane --out focal_plane
      fringe-sim focal-plane --sensor R22 --thickness R22_S11=fit/thickness.fits --out centre
    """
    chosen = _chosen(sensors)
    measured = _measured(maps, chosen)
    settings = sky_settings(read_settings(effects_file) if effects_file else {})
    flat = None if flat_spectrum == "white" else FlatSpectrum.from_name(flat_spectrum)
    thickness = {
        sensor.name: _SensorLayer.read(measured[sensor.name], sensor)
        for sensor in chosen
        if sensor.name in measured
    }
    if dry_run:
        click.echo(FocalPlaneCost(len(chosen), len(NightHistory.guo2022())).describe())
        return
    folder = out.prepare()
    observed = random_nights(nights, seed)
    sky = replace(SkySpectrum.dark(airmass=airmass), flat=flat)
    tables = []
    with progress("forecasting sensors", len(chosen)) as advance:
        for setup_name in SETUPS.values():
            detectors = [detector for detector in chosen if SETUPS[detector.vendor] == setup_name]
            if not detectors:
                continue
            model = FringeModel.from_setup(setup_name, _of_stack(settings, setup_name))
            field = _field(model, sky, [thickness[d.name].value_um for d in detectors if d.name in thickness])
            for detector in detectors:
                tables.append(
                    _forecast(detector, model, sky, field, thickness.get(detector.name), observed, seed)
                )
                advance()
    cells, summary = _gather(tables)
    write_together(folder, {"cells.ecsv": table_text(cells), "focal_plane.ecsv": table_text(summary)})
    given = [*measured.values(), *([effects_file] if effects_file else [])]
    origin = origin_of(folder, given)
    lines = write_focal_plane_page(folder, cells, summary, airmass, nights, len(measured), origin)
    for line in lines:
        click.echo(line)
    click.echo(str(folder))
    click.echo(str(folder / "report.html"))


@dataclass(frozen=True)
class _SensorLayer:
    """Thickness of the varying layer of a sensor, and the part of the sensor that it shows; `None` for all of it."""

    value_um: FloatArray
    section: SensorSection | None

    @classmethod
    def read(cls, path: Path, sensor: Detector) -> _SensorLayer:
        value_um = read_thickness(path, Setup.from_name(SETUPS[sensor.vendor]), sensor)
        return cls(value_um, read_section(path, sensor, (value_um.shape[0], value_um.shape[1])))


def _chosen(names: Iterable[str]) -> list[Detector]:
    camera = Camera.from_name("lsstCam")
    if not names:
        return list(camera.science)
    found: dict[str, Detector] = {}
    for name in names:
        members = camera.raft(name) if name in camera.rafts else (camera.detector(name),)
        for detector in members:
            if detector.kind != "science":
                raise InputError("--sensor", name, "a science sensor or a raft of them")
            found[detector.name] = detector
    return list(found.values())


def _measured(maps: Iterable[SensorMap], chosen: Iterable[Detector]) -> dict[str, Path]:
    """Files with the maps of sensors; each is of one that is forecast, and the only one of it."""
    camera, forecast = Camera.from_name("lsstCam"), {sensor.name for sensor in chosen}
    found: dict[str, Path] = {}
    for item in maps:
        name = camera.detector(item.name).name
        if name not in forecast:
            raise InputError("--thickness", item.name, "a science sensor that --sensor chooses")
        if name in found:
            raise InputError("--thickness", item.name, "one map of a sensor")
        if not item.path.is_file():
            raise InputError("--thickness", str(item.path), "an existing FITS file")
        found[name] = item.path
    return found


def _of_stack(settings: dict[str, Any], setup_name: str) -> dict[str, Any]:
    """Effects that a set-up can have: those of a layer that its stack lacks concern the other vendor."""
    kept: dict[str, Any] = {}
    for key, value in settings.items():
        try:
            FringeModel.from_setup(setup_name, {key: value})
        except InputError as error:
            click.echo(f"{setup_name}: without {key} ({error})", err=True)
            continue
        kept[key] = value
    return kept


def _field(model: FringeModel, sky: SkySpectrum, maps: list[FloatArray]) -> FieldResponse:
    """Response at every field radius, for the thickness of all stand-ins and of the given maps."""
    beams = beam_field(model.setup.telescope)
    if beams is None:
        raise InputError(
            "telescope", model.setup.telescope, "one whose beams depend on the field radius alone"
        )
    statistics = ThicknessField.of(model.setup)
    half = 0.53 * statistics.span_um[1]
    spans = [(statistics.mean_um - half, statistics.mean_um + half), *map(thickness_span_um, maps)]
    span = min(low for low, _ in spans), max(high for _, high in spans)
    angular = angular_response(model, sky, beam_limits(beams), thickness_range_um=span)
    return field_response(angular, beams, (0.0, beams.largest_deg))


def _forecast(
    detector: Detector,
    model: FringeModel,
    sky: SkySpectrum,
    field: FieldResponse,
    measured: _SensorLayer | None,
    observed: NightHistory,
    seed: int,
) -> Table:
    shape = (detector.shape[0] // SAMPLE_PX, detector.shape[1] // SAMPLE_PX)
    thickness = (
        stand_in_thickness(model.setup, detector, seed, shape).value
        if measured is None
        else measured.value_um.astype(np.float32)
    )
    section = None if measured is None else measured.section
    response = field.on(SensorPlacement.of(detector, model.setup.pixel_scale_arcsec, section))
    light = float(field.relative_illumination(detector.field_radius_deg))
    level = SkyLevel.of(sky, model, detector.read_noise, light)
    forecast = forecast_sensor(
        thickness, response, detector, level, NightHistory.guo2022(), observed, stand_in=measured is None
    )
    return forecast.to_table()


def _gather(tables: list[Table]) -> tuple[Table, Table]:
    """Cells of all sensors in one table, and one row per sensor."""
    summary = summary_table([table.meta for table in tables])
    for table in tables:
        table.add_column(Column([table.meta["detector"]] * len(table), name="detector"), index=0)
    return vstack(tables, metadata_conflicts="silent"), summary
