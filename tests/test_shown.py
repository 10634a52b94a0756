"""What objects say of themselves at the prompt and in ``help()``: short lines, without addresses of the memory."""

import importlib
import inspect
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.algorithms.discovery.verdict import Gap, NamedEffect, ParameterValue, Where
from lsst.fringe_sim.algorithms.flat_prep_options import FlatPrepOptions
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.model import FringeModel

API = Path(__file__).parents[1] / "doc" / "reference" / "api"
DOCUMENTED = sorted(
    name
    for page in API.glob("*.md")
    for name in re.findall(r"generated: api ([\w.]+)", page.read_text(encoding="utf-8"))
)
LONGEST_LINE, LONGEST_DEFAULT = 400, 60


def of_a_model() -> dict[str, object]:
    model = FringeModel.from_setup("ts8_e2v", {"bandwidth.fwhm": 2.6})
    stack = model.system.stack
    return {
        "set-up": model.setup,
        "model": model,
        "system": model.system,
        "stack": stack,
        "layer": stack.layers[3],
        "medium": stack.layers[3].medium,
        "active effect": model.effects[0],
        "table": model.table((14.0, 14.5), [950.0]),
        "camera": Camera.from_name("lsstCam"),
        "detector": Camera.from_name("lsstCam").detector("R22_S11"),
        "band": Bandpass.from_name("lsst_y"),
        "sky": SkySpectrum.dark(),
        "night": NightHistory.guo2022(),
        "options": FlatPrepOptions(),
    }


def test_objects_say_what_they_are_in_a_line() -> None:
    for name, shown in of_a_model().items():
        line = repr(shown)
        assert line.startswith(f"{type(shown).__name__}("), name
        assert "\n" not in line, name
        assert " at 0x" not in line, name
        assert len(line) < LONGEST_LINE, name


def test_a_line_has_what_is_not_the_default() -> None:
    assert repr(FlatPrepOptions()) == "FlatPrepOptions()"
    assert repr(replace(FlatPrepOptions(), edge_px=3)) == "FlatPrepOptions(edge_px=3)"
    assert repr(FringeModel.from_setup("ts8_e2v", {"bandwidth.fwhm": 2.6})) == (
        "FringeModel('ts8_e2v', effects={'bandwidth.fwhm': 2.6})"
    )
    assert "'ts8_e2v'" in repr(Setup.from_name("ts8_e2v"))
    assert repr(Bandpass.from_name("lsst_y")).count("<601 float64>") == 3


def test_a_verdict_is_a_line_and_a_table() -> None:
    found = NamedEffect("bandwidth", {"fwhm": ParameterValue(2.6, 0.01, "nm")}, 0.98)
    gap = Gap("rms", 2.0, 1.0, 2.0, 1.0, 1.0)
    verdict = Verdict("named", (found,), Where(), gap, (), {}, "ts8_e2v", 1e-9)
    assert repr(verdict) == "Verdict('named', {'bandwidth.fwhm': 2.6}, setup='ts8_e2v')"
    assert "<td>fwhm = 2.6 ± 0.01 nm; probability 0.980</td>" in verdict._repr_html_()


@pytest.mark.parametrize("name", DOCUMENTED)
def test_defaults_can_be_read_in_help(name: str) -> None:
    module = importlib.import_module(f"lsst.fringe_sim.{name}")
    for member in module.__all__:
        found = getattr(module, member)
        for told, function in _functions(member, getattr(found, member, found)):
            for parameter in inspect.signature(function).parameters.values():
                shown = repr(parameter.default)
                if parameter.default is not inspect.Parameter.empty and shown != "<factory>":
                    assert len(shown) <= LONGEST_DEFAULT, f"{told}: {parameter}"
                    assert " at 0x" not in shown, f"{told}: {parameter}"


def _functions(name: str, found: Any) -> list[tuple[str, Any]]:
    if not inspect.isclass(found):
        return [(name, found)] if callable(found) else []
    methods = [(f"{name}.{key}", getattr(found, key)) for key in vars(found) if not key.startswith("_")]
    with_arguments = [(told, method) for told, method in methods if callable(method)]
    return [*with_arguments, (name, found)] if "__init__" in vars(found) else with_arguments
