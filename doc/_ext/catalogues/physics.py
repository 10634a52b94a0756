"""Catalogues of what the package knows: effects, set-ups, stacks, media, telescopes, bandpasses, cameras, masks."""

from __future__ import annotations

import math
from typing import Any

from lsst.fringe_sim.effects import EFFECTS, Parameter
from lsst.fringe_sim.instrument.bandpass import bandpass_names
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model import Setup, setup_names
from lsst.fringe_sim.optics import LayerStack, get_medium, medium_names
from lsst.fringe_sim.products import MASK_PLANES
from lsst.fringe_sim.resources import list_resources, read_yaml

from .markdown import code, number, sections, table

PLACES = {
    "stack": "On the layers of the sensor",
    "illumination": "On the light of a flat field",
    "response": "On the response, after the optics",
    "image": "On the image, from the light to the file",
    "spectrum": "Night sky",
}

PLANE_MEANINGS = {
    "BAD": "defect of the sensor, or an amplifier without signal",
    "SAT": "saturated",
    "INTRP": "interpolated; not set here",
    "CR": "cosmic ray; not set here",
    "EDGE": "border of the sensor, or rows next to its midline",
    "DETECTED": "part of an object; not set here",
    "DETECTED_NEGATIVE": "part of a negative object; not set here",
    "SUSPECT": "chi-square of the thickness fit is improbable",
    "NO_DATA": "no measurement",
    "SLIP": "the fringe order may be wrong",
    "LOW_SIGNAL": "too few wavelengths or photons",
}


def effects() -> str:
    """Every effect with its parameters, by the place where it acts."""
    unknown = {effect.acts_on for effect in EFFECTS} - PLACES.keys()
    if unknown:
        raise ValueError(f"effects act on something that has no heading: {sorted(unknown)}")
    parts = []
    for place, heading in PLACES.items():
        parts.append(f"## {heading}")
        for effect in EFFECTS:
            if effect.acts_on != place:
                continue
            parts.append(f"### `{effect.name}`")
            first, *conventions = _paragraphs(type(effect).__doc__)
            parts += [f"{_sentence(effect.title)} {first}", *conventions]
            head = ("parameter", "meaning", "unit", "absent at", "bounds", "typical")
            parts.append(table(head, [_parameter_row(effect.name, each) for each in effect.parameters]))
            parts.append(f"Source: {effect.reference}.")
    return sections(parts)


def _parameter_row(effect: str, parameter: Parameter) -> tuple[str, ...]:
    low, high = parameter.bounds
    null = "as the set-up says" if math.isnan(parameter.null) else number(parameter.null)
    return (
        code(f"{effect}.{parameter.name}"),
        parameter.description,
        parameter.unit or "1",
        null,
        f"{number(low)} … {number(high)}",
        number(parameter.prior_scale),
    )


def setups() -> str:
    """Every set-up."""
    parts = []
    for name in setup_names():
        setup = Setup.from_name(name)
        low, high = setup.thickness_range_um
        rows: list[tuple[str, Any]] = [
            ("camera, default detector", f"`{setup.camera}`, `{setup.detector}`"),
            ("stack", f"[`{setup.stack.name}`](#{setup.stack.name})"),
            ("layer that varies", f"`{setup.varying}`, {number(low)} to {number(high)} µm"),
            ("temperature", f"{number(setup.temperature_k)} K"),
            ("light", _light(setup)),
            ("beam", _beam(setup)),
            ("source", setup.source),
        ]
        parts += [f"### `{name}`", f"{_sentence(setup.title)}", table(("", ""), rows)]
    return sections(parts)


def _light(setup: Setup) -> str:
    if setup.kind == "sky":
        return (
            f"night sky through `{setup.bandpass}`, {number(setup.exposure_s)} s at airmass "
            f"{number(setup.airmass)}; {number(setup.effective_area_m2)} m² and "
            f"{number(setup.pixel_scale_arcsec)}″ per pixel"
        )
    flats = ", ".join(number(each) for each in setup.wavelengths_nm)
    return (
        f"{setup.profile_name} line of {number(setup.bandwidth_fwhm_nm)} nm FWHM; usual flats at {flats} nm"
    )


def _beam(setup: Setup) -> str:
    if setup.beam_kind == "telescope":
        return f"ray trace of the telescope `{setup.telescope}`"
    if setup.beam_kind == "cone":
        return f"cone of f/{number(setup.f_number)}, central obscuration {number(setup.obscuration)}"
    return "collimated"


def stacks() -> str:
    """Every stack, layer by layer from the light inwards."""
    parts = []
    for entry in list_resources("stacks"):
        name = entry.removesuffix(".yaml")
        stack, content = LayerStack.from_resource(name), read_yaml("stacks", entry)
        rows = [
            (
                code(layer.name),
                code(layer.medium.name),
                "∞" if math.isinf(layer.thickness_um) else number(layer.thickness_um),
            )
            for layer in stack.layers
        ]
        parts += [
            f"### `{name}`",
            _sentence(content["title"]),
            table(("layer", "medium", "thickness [µm]"), rows),
        ]
        parts.append(f"Source: {content['source']}.")
    return sections(parts)


def media() -> str:
    """Every medium, with its index at 960 nm and 300 K and the range in which it is known."""
    rows = []
    for name in medium_names():
        medium = get_medium(name)
        index = complex(medium.index(960.0))
        low, high = medium.wavelength_range_nm
        rows.append(
            (code(name), f"{index.real:.4f}", f"{index.imag:.2e}", f"{low:g} – {high:g}", medium.source)
        )
    return table(("medium", "n at 960 nm", "k at 960 nm", "known at [nm]", "source"), rows)


def telescopes() -> str:
    """Every telescope."""
    rows = []
    for entry in list_resources("telescopes"):
        content = read_yaml("telescopes", entry)
        optics = content["optics"]
        light = (
            f"f/{optics['f_number']:g}" if optics["kind"] == "cone" else f"batoid `{optics['prescription']}`"
        )
        rows.append(
            (
                code(entry.removesuffix(".yaml")),
                content["title"],
                light,
                number(content["collecting_area_m2"]),
                number(content["pixel_scale_arcsec"]),
                number(content["field_radius_deg"]),
            )
        )
    return table(("telescope", "", "beam", "area [m²]", "pixel [″]", "field radius [°]"), rows)


def bandpasses() -> str:
    """Every bandpass."""
    rows = []
    for name in bandpass_names():
        content = read_yaml("bandpasses", f"{name}.yaml")
        rows.append((code(name), content["title"], " · ".join(content["factors"]), content["source"]))
    return table(("bandpass", "", "factors", "source"), rows)


def cameras() -> str:
    """Every camera."""
    rows = []
    described = [entry.removesuffix(".yaml") for entry in list_resources("instrument")]
    for name in ("lsstCam", "ts8", *described):
        camera = Camera.from_name(name)
        vendors = sorted({detector.vendor for detector in camera.detectors})
        rows.append((code(name), camera.title, len(camera.detectors), len(camera.rafts), ", ".join(vendors)))
    return table(("camera", "", "detectors", "rafts", "vendors"), rows)


def mask_planes() -> str:
    """Every mask plane; one without a meaning here stops the build."""
    rows = [(bit, code(name), PLANE_MEANINGS[name]) for name, bit in MASK_PLANES.items()]
    return table(("bit", "plane", "meaning"), rows)


def _paragraphs(docstring: str | None) -> list[str]:
    return [" ".join(part.split()) for part in (docstring or "").strip().split("\n\n")]


def _sentence(text: str) -> str:
    text = text.strip().rstrip(".")
    return f"{text[0].upper()}{text[1:]}."
