"""The cases of the panel: read from the frozen list, and made."""

from __future__ import annotations

import sys
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lsst.fringe_sim.challenge.sealed_cases import STATED_FWHM_NM, STATED_KELVIN, draw_case, expose
from lsst.fringe_sim.mock.hidden_effects import HIDDEN_EFFECTS
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

from field_matrices import ForeignSensor, Stain, Window
from foreign_flats import ForeignCharge, exposed, smooth_map

LIST = Path(__file__).with_name("panel_cases.yaml")
KINDS = ("null", "single", "pair", "outsider", "neighbour")

FRESH_SPREAD = 0.3
"""Rms of the logarithm of the factor by which sizes of fresh cases differ from those of the list."""

JITTER_NODES = range(880, 991, 10)


@dataclass(frozen=True)
class PanelCase:
    """One line of the list; see there."""

    case: str
    kind: str
    source: str
    seed: int
    truth: tuple[str, ...] = ()
    like: tuple[str, ...] = ()
    px: int = 64
    setup: str = "ts8_e2v"
    hide: Mapping[str, float] = field(default_factory=dict)
    outsider: str = ""
    least: float = 0.0
    noise: float = 1.0
    span: float = 1.2
    sensor: Mapping[str, Any] = field(default_factory=dict)
    charge: Mapping[str, float] = field(default_factory=dict)
    gain_rms: float = 0.0
    jitter_rms: float = 0.0
    contrast_known: float = 1.0

    def streams(self, fresh: int | None) -> tuple[np.random.Generator, np.random.Generator, float]:
        """Generators of data and of the search, and what sizes are scaled by; another draw for every fresh seed."""
        seeds = [self.seed] if fresh is None else [self.seed, fresh]
        data, search, size = np.random.default_rng(seeds).spawn(3)
        return data, search, 1.0 if fresh is None else float(np.exp(FRESH_SPREAD * size.standard_normal()))

    def model(self) -> FringeModel:
        """What the search is told."""
        known = {} if self.contrast_known == 1.0 else {"contrast_loss.factor": self.contrast_known}
        return FringeModel.from_setup(self.setup, known)

    def cube(self, rng: np.random.Generator, factor: float) -> FringeCube:
        """The flats."""
        return (_of_mock if self.source == "mock" else _of_foreign)(self, rng, factor)


def read_cases(path: Path = LIST) -> list[PanelCase]:
    """All cases of a list."""
    rows = yaml.safe_load(path.read_text())
    for row in rows:
        row["truth"], row["like"] = tuple(row.get("truth", ())), tuple(row.get("like", ()))
    return [PanelCase(**row) for row in rows]


def checksum(cube: FringeCube) -> str:
    """Tells whether two versions draw the same data."""
    return f"{zlib.crc32(cube.image.tobytes()):08x}"


def _scaled(value: float, null: float, factor: float) -> float:
    """A size that is farther from its null, or nearer to it."""
    return float(value**factor) if null == 1.0 else float(null + (value - null) * factor)


def _of_mock(case: PanelCase, rng: np.random.Generator, factor: float) -> FringeCube:
    if case.outsider:
        size = 0.0
        while size < case.least:
            drawn = draw_case("outsider", rng.spawn(1)[0], size=(case.px, case.px), only=[case.outsider])
            size = drawn.values[f"{case.outsider}.size"]
        return drawn.cube
    if case.setup != "ts8_e2v":
        return draw_case("none", rng, size=(case.px, case.px), setup=case.setup).cube
    mean, span = float(rng.uniform(13.0, 19.0)), float(rng.uniform(1.0, 2.5)) * case.px / 64.0
    thickness = random_field((case.px, case.px), rng, mean=mean, span=span)
    return expose(thickness, _hidden(case, rng, factor), rng, noise_factor=case.noise)[0]


def _hidden(case: PanelCase, rng: np.random.Generator, factor: float) -> dict[str, float]:
    """Parameters of the mock's effects."""
    if "wavelength_jitter.rms" in case.hide:
        rms = case.hide["wavelength_jitter.rms"] * factor
        return {f"wavelength_jitter.at_{node}": float(rms * rng.standard_normal()) for node in JITTER_NODES}
    stated = {"bandwidth.fwhm": STATED_FWHM_NM, "temperature.kelvin": STATED_KELVIN}
    found = {}
    for key, value in case.hide.items():
        name, _, parameter = key.partition(".")
        own = next(effect for effect in HIDDEN_EFFECTS if effect.name == name).parameter(parameter)
        place = own.unit == "px" and name != "charge_diffusion"
        null = stated.get(key, own.null)
        found[key] = value if place else float(np.clip(_scaled(value, null, factor), *own.bounds))
    return found


def _of_foreign(case: PanelCase, rng: np.random.Generator, factor: float) -> FringeCube:
    mean, side = float(rng.uniform(12.0, 18.0)), (case.px, case.px)
    thickness = smooth_map(rng, side, mean, case.span * case.px / 64.0)
    sensor = {name: _sensor_field(name, value, factor) for name, value in case.sensor.items()}
    if case.gain_rms:
        sensor["gains"] = tuple(factor * case.gain_rms * rng.standard_normal(16))
    if case.jitter_rms:
        sensor["jitter_nm"] = tuple(factor * case.jitter_rms * rng.standard_normal(12))
    if case.contrast_known != 1.0:
        sensor["contrast"] = case.contrast_known
    charge = {name: value * factor if name == "trailing" else value for name, value in case.charge.items()}
    return exposed(ForeignSensor(**sensor), thickness, rng, ForeignCharge(**charge))


def _sensor_field(name: str, value: Any, factor: float) -> Any:
    """A field of `ForeignSensor` from its text, scaled about its null."""
    if name in ("line", "contrast"):
        return _scaled(value, 1.0, factor)
    if name == "thicker_um":
        return {layer: factor * added for layer, added in value.items()}
    if name == "film":
        return _film(value, factor)
    if name == "satellite":
        return factor * value[0], value[1]
    if name == "gradient":
        return tuple(factor * rise for rise in value)
    if name == "window":
        return Window(**{**value, "amplitude": factor * value["amplitude"]})
    if name == "stain":
        film = _film(value["film"], factor) if "film" in value else None
        centre, half = tuple(value["centre"]), tuple(value["half"])
        return Stain(centre, half, film, factor * value.get("absorbed", 0.0))
    return factor * value


def _film(value: tuple[float, float, float], factor: float) -> tuple[complex, float]:
    index, absorption, thickness_um = value
    return complex(index, absorption), factor * thickness_um
