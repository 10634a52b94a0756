"""Reading what a command is pointed at: thickness maps, settings."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from ..array_types import FloatArray
from ..effects import activate_effects, known_effects
from ..effects.active import flat_settings
from ..errors import InputError
from ..instrument.camera import Camera
from ..instrument.detector import Detector
from ..model import FringeModel, Setup
from ..model.effects_override import read_effects_override
from ..model.provenance import model_cards, software_cards
from ..products import SensorSection, ThicknessMap
from ..products.sensor_section import SECTION_KEYWORDS
from ..resources import LONGEST_USER_FILE, complete_fits, read_user_text, read_user_yaml


def placed_model(setup: Setup, settings: Mapping[str, Any], sensor: Detector) -> FringeModel:
    """A sensor of a camera behind its telescope, with effects, in the beam of its centre."""
    from ..algorithms.sensor_placement import SensorPlacement

    centre = SensorPlacement.of(sensor, setup.pixel_scale_arcsec)
    return FringeModel.from_setup(
        setup, settings, field_x_deg=centre.field_x_deg, field_y_deg=centre.field_y_deg
    )


def read_map(path: str | os.PathLike[str], setup: Setup, sensor: Detector | None = None) -> ThicknessMap:
    """Map of the varying layer, as `ThicknessMap.read_any` reads it; it is said if it is not of ``sensor``.

    `InputError`: the map is of another layer, or of a sensor of another vendor.
    """
    found = ThicknessMap.read_any(path, setup.varying).of_setup(setup, str(path))
    if sensor is not None and Camera.from_name(setup.camera).are_two_sensors(found.detector, sensor.name):
        click.echo(f"{path}: a map of {found.detector}, taken for {sensor.name}", err=True)
    return found


def read_thickness(path: str | os.PathLike[str], setup: Setup, sensor: Detector | None = None) -> FloatArray:
    """Thickness [µm] of the map that `read_map` reads; NaN where there is none."""
    return read_map(path, setup, sensor).known_um().astype(float)


def read_section(
    path: str | os.PathLike[str], detector: Detector, shape: tuple[int, int]
) -> SensorSection | None:
    """Pixels of a sensor that a map shows, by what its headers say or by its size; `None` if neither tells.

    `FrameFormatError`, `OutOfRangeError`: a header with a malformed section, or with pixels that the sensor
        does not have.
    """
    with complete_fits(path) as hdus:
        headers = [hdus[0].header, *(hdu.header for hdu in hdus[1:2])]
    known = {key: header[key] for header in headers for key in SECTION_KEYWORDS if key in header}
    try:
        return SensorSection.of_image(detector, shape, known)
    except InputError as error:
        raise error.in_source(str(path)) from None


def read_settings(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Mapping from a YAML file, read with the safe loader, or effects from an override that a search has left.

    `InputError`: the file is empty, not YAML, not a mapping, states an effect twice, or is an override that is
        not whole or has anything in it but effects and their numbers.
    """
    if Path(path).suffix == ".py":
        text = read_user_text(path, "override file", LONGEST_USER_FILE)
        return dict(read_effects_override(text, str(path)))
    content = read_user_yaml(path, "settings file")
    if not isinstance(content, dict):
        found = "empty" if content is None else type(content).__name__
        raise InputError("settings file", found, "a mapping, {} for no effects", source=str(path))
    return flat_settings(content, str(path))


def sky_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Effects that a sensor takes along to the telescope; those of the laboratory are named and left out.

    `UnknownNameError`, `OutOfRangeError`, `InputError`: an effect that there is not, or a value that it cannot
        have.
    """
    active = activate_effects(settings, known_effects())
    applied = {
        f"{item.effect.name}.{name}": value
        for item in active
        if not item.effect.laboratory_only
        for name, value in item.values.items()
    }
    left = sorted({item.effect.name for item in active if item.effect.laboratory_only})
    if left:
        click.echo(f"effects of the laboratory, not taken to the sky: {', '.join(left)}", err=True)
    return applied


def effect_cards(model: FringeModel) -> dict[str, str | float]:
    """Header keywords of a product: software, set-up, effects, revisions of tables."""
    return {**software_cards(), **model_cards(model.setup, model.effect_settings)}
