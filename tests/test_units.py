"""Quantities of astropy are converted or refused wherever a documented function takes a number with a unit."""

import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy import units as u

from lsst.fringe_sim.algorithms import simulate_sky_frame
from lsst.fringe_sim.algorithms.sky_frame import sky_response
from lsst.fringe_sim.errors import InputError, named_units
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.instrument.telescope import telescope_beam
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.optics import Beam, layer_absorption

REFERENCE = Path(__file__).resolve().parents[1] / "doc" / "reference" / "api"
NUMBER = re.compile(r".*(?<!_per)_(um|nm|k|deg|arcsec|s|h)|theta|wavelength|hours?")
"""Names of lengths, temperatures, angles and times."""
ELSEWHERE = ("tasks", "report", "middleware", "mock", "challenge", "errors", "resources")
"""Rooms that take settings and files, not numbers."""


def edge() -> Iterator[tuple[str, Callable[..., Any], bool, str]]:
    """Name, callable, whether it wants an instance, and parameter, of all that the reference documents."""
    seen = set()
    for page in sorted(REFERENCE.glob("*.md")):
        for module in re.findall(r"<!-- generated: api ([\w.]+) -->", page.read_text(encoding="utf-8")):
            if module.partition(".")[0] in ELSEWHERE:
                continue
            content = importlib.import_module(f"lsst.fringe_sim.{module}")
            for name in content.__all__:
                item = getattr(content, name)
                if callable(item) and str(getattr(item, "__module__", "")).startswith("lsst.fringe_sim"):
                    for callee in callables(name, item):
                        if callee[0] not in seen:
                            yield from parameters(*callee)
                        seen.add(callee[0])


def callables(name: str, item: Any) -> Iterator[tuple[str, Any, bool]]:
    yield name, item, False
    if inspect.isclass(item):
        for attribute, value in vars(item).items():
            public = not attribute.startswith("_") and not getattr(value, "__isabstractmethod__", False)
            if public and isinstance(value, classmethod | staticmethod):
                yield f"{name}.{attribute}", getattr(item, attribute), False
            elif public and inspect.isfunction(value):
                yield f"{name}.{attribute}", value, True


def parameters(name: str, callee: Any, bound: bool) -> Iterator[tuple[str, Any, bool, str]]:
    try:
        signature = inspect.signature(callee)
    except (TypeError, ValueError):
        return
    for parameter in signature.parameters:
        if NUMBER.fullmatch(parameter):
            yield f"{name} {parameter}", callee, bound, parameter


EDGE = list(edge())


def test_the_edge_is_found() -> None:
    names = {name for name, *_ in EDGE}
    assert len(names) > 190
    wanted = {"fit_thickness range_um", "Beam theta", "FringeModel.response thickness_um"}
    assert wanted | {"sky_response thickness_range_um", "Setup temperature_k"} <= names


@pytest.mark.parametrize(
    ("callee", "bound", "parameter"), [item[1:] for item in EDGE], ids=[i[0] for i in EDGE]
)
def test_a_quantity_of_another_kind_is_refused(callee: Any, bound: bool, parameter: str) -> None:
    """Before anything else is asked about: a number without its unit would be taken for one in another."""
    with pytest.raises(InputError, match=f"{parameter}|unit is"):
        callee(*([object()] if bound else []), **{parameter: 3.0 * u.kg})


@pytest.mark.parametrize(
    ("callee", "bound", "parameter"), [item[1:] for item in EDGE], ids=[i[0] for i in EDGE]
)
def test_what_is_no_number_is_refused(callee: Any, bound: bool, parameter: str) -> None:
    """Truth values would be 0 and 1, masked entries good numbers, and numpy's own errors name no parameter."""
    masked = np.ma.MaskedArray([3.0, 4.0], mask=[False, True])
    if "dict" in str(inspect.signature(callee).parameters[parameter].annotation):
        return  # records, with a number for each wavelength among others
    wrong = (
        True,
        np.True_,
        "a",
        ["a"],
        3j,
        np.array([3 + 0j]),
        masked,
        [[1.0, 2.0], [3.0]],
        {},
        object(),
        10**400,
    )
    for value in wrong:
        with pytest.raises(InputError, match=parameter):
            callee(*([object()] if bound else []), **{parameter: value})


def test_an_array_without_masked_entries_is_one_of_numbers() -> None:
    model = FringeModel.from_setup("ts8_e2v")
    found = model.response(np.ma.MaskedArray([14.0, 14.1], mask=[False, False]), [950.0])
    np.testing.assert_array_equal(found, model.response([14.0, 14.1], [950.0]))


def test_layers_and_wavelength_have_one_unit() -> None:
    index, depth = [1.0, 1.5, 1.0], [np.inf, 1.0, np.inf]
    wanted = layer_absorption(index, depth, 0.9, theta=0.1)
    same = layer_absorption(index, [np.inf, 1000 * u.nm, np.inf], 0.9 * u.um, theta=np.degrees(0.1) * u.deg)
    np.testing.assert_allclose(same, wanted, rtol=1e-12, atol=1e-15)
    for d, wavelength in (
        (depth, 900 * u.nm),
        ([np.inf, 1 * u.um, np.inf], 0.9),
        ([2.0, 1 * u.um, 0], 1 * u.um),
    ):
        with pytest.raises(InputError):
            layer_absorption(index, d, wavelength)


def test_beams_of_angles_with_units() -> None:
    assert Beam.collimated(6.0 * u.deg).theta[0] == pytest.approx(np.radians(6.0))
    wanted = telescope_beam("lsst", field_x_deg=1.0, field_y_deg=0.5)
    found = telescope_beam("lsst", field_x_deg=60 * u.arcmin, field_y_deg=1800 * u.arcsec)
    np.testing.assert_allclose(found.theta, wanted.theta, rtol=1e-12)


@pytest.mark.slow
def test_a_sky_frame_from_quantities() -> None:
    model = FringeModel.from_setup("lsst_e2v")
    thickness = np.linspace(13.9, 14.1, 12).reshape(3, 4)
    plain = simulate_sky_frame(
        thickness,
        model,
        response=sky_response(model, SkySpectrum.dark(), thickness_range_um=(13.8, 14.2)),
        exposure_s=30.0,
    )
    response = sky_response(model, SkySpectrum.dark(), thickness_range_um=(13_800 * u.nm, 0.0142 * u.mm))
    found = simulate_sky_frame(1e-6 * thickness * u.m, model, response=response, exposure_s=0.5 * u.min)
    np.testing.assert_allclose(found.image, plain.image, rtol=1e-6)


def test_what_counts_per_length_is_no_length() -> None:
    @named_units
    def three(per_um: Any, slope_per_nm: Any, gap_um: Any) -> tuple[Any, ...]:
        return per_um, slope_per_nm, gap_um

    assert three(2.0 / u.um, 3.0 / u.nm, 1500.0 * u.nm) == (2.0 / u.um, 3.0 / u.nm, 1.5)
    with pytest.raises(InputError, match="gap_um"):
        three(2.0, 3.0, 1.0 / u.um)
