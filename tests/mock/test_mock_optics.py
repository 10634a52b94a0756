"""The mock's own thin-film optics against tmm, and against brute force (against the model: tests/effects)."""

import dataclasses
import math

import numpy as np
import pytest
import tmm

from lsst.fringe_sim.errors import ConvergenceError, OutOfRangeError, StackError, UnknownNameError
from lsst.fringe_sim.mock import Film, FlatFieldOptics, material_index, setup_optics
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.optics import get_medium, medium_names
from lsst.fringe_sim.resources import list_resources, read_yaml


def films(stack: str) -> tuple[Film, ...]:
    return tuple(
        Film(layer["name"], layer["medium"], float(layer["thickness_um"]))
        for layer in read_yaml("stacks", stack)["layers"]
    )


@pytest.fixture(scope="module")
def e2v() -> FlatFieldOptics:
    return setup_optics("ts8_e2v")[0]


def tmm_absorption(
    optics: FlatFieldOptics, thickness_um: float, wavelength_nm: float, theta: float, polarization: str
) -> float:
    """Absorbed fraction of the detection layer by the published program."""
    at = np.array([wavelength_nm])
    index = [film.index(at, optics.temperature_k)[0] for film in optics.films]
    thickness = [1e3 * film.thickness_um for film in optics.films]
    thickness[optics.position(optics.varying)] = 1e3 * thickness_um
    solved = tmm.coh_tmm(polarization, index, thickness, theta, wavelength_nm)
    return float(tmm.absorp_in_each_layer(solved)[optics.position(optics.detection)])


@pytest.mark.parametrize("stack", list_resources("stacks"))
@pytest.mark.parametrize("varying", ["adhesive", "detection", "ar_outer", "support"])
@pytest.mark.rng("absorption agrees with tmm")
def test_absorption_agrees_with_tmm(stack: str, varying: str, rng: np.random.Generator) -> None:
    worst = 0.0
    for _ in range(60):
        optics = FlatFieldOptics(films(stack), rng.uniform(150.0, 320.0), 2.0, varying=varying)
        thickness, wavelength = rng.uniform(0.0, 200.0), rng.uniform(700.0, 1090.0)
        theta = 0.0 if rng.random() < 0.2 else rng.uniform(0.0, 1.5)
        polarization = str(rng.choice(["s", "p"]))
        ours = optics.absorbed_fraction(thickness, wavelength, theta, polarization)[0]
        worst = max(worst, abs(ours - tmm_absorption(optics, thickness, wavelength, theta, polarization)))
    assert worst < 1e-10


def test_opaque_silicon_absorbs_all_that_enters(e2v: FlatFieldOptics) -> None:
    """At 400 nm the amplitude at the bottom of the silicon is below 1e-300 of that at its top."""
    absorbed = e2v.absorbed_fraction([5.0, 14.0, 30.0], 400.0)
    assert np.all(np.isfinite(absorbed))
    np.testing.assert_allclose(absorbed, absorbed[0], rtol=1e-14)
    index = [film.index(np.array([400.0]), e2v.temperature_k)[0] for film in e2v.films[:4]]
    on_thick_silicon = [math.inf, *(1e3 * film.thickness_um for film in e2v.films[1:3]), math.inf]
    entered = tmm.coh_tmm("s", index, on_thick_silicon, 0.0, 400.0)["T"]
    assert absorbed[0] == pytest.approx(entered, abs=1e-12)


def test_mixed_polarization_is_the_mean(e2v: FlatFieldOptics) -> None:
    s, p, mixed = (e2v.absorbed_fraction([14.0, 15.0], 960.0, 0.4, mode) for mode in ("s", "p", "mixed"))
    np.testing.assert_allclose(mixed, 0.5 * (s + p), rtol=1e-14)
    assert np.max(np.abs(s - p)) > 1e-3


@pytest.mark.parametrize("medium", medium_names())
def test_materials_follow_the_curve_of_the_fitting_side(medium: str) -> None:
    low, high = get_medium(medium).wavelength_range_nm
    wavelength = np.linspace(max(low, 400.0), min(high, 1150.0), 3001)
    for temperature in (173.0, 300.0):
        ours = material_index(medium, wavelength, temperature)
        np.testing.assert_allclose(ours, get_medium(medium).index(wavelength, temperature), rtol=1e-12)


@pytest.mark.slow
def test_flat_field_is_the_average_over_the_line(e2v: FlatFieldOptics) -> None:
    """Against a plain sum over two thousand wavelengths of tmm."""
    sigma = e2v.bandwidth_fwhm_nm / math.sqrt(8.0 * math.log(2.0))
    offset = np.linspace(-5.5, 5.5, 1501) * sigma
    weight = np.exp(-0.5 * (offset / sigma) ** 2)
    direct = sum(
        w * tmm_absorption(e2v, 17.3, 960.0 + x, 0.0, "s") for x, w in zip(offset, weight, strict=True)
    )
    assert e2v.flat_field(17.3, 960.0)[0] == pytest.approx(direct / weight.sum(), rel=3e-7)


@pytest.mark.rng("table states an error that holds")
def test_table_states_an_error_that_holds(e2v: FlatFieldOptics, rng: np.random.Generator) -> None:
    table = e2v.table((15.0, 16.5), [880.0, 990.0])
    assert table.relative_error < 1e-6
    thickness = rng.uniform(15.0, 16.5, 40)
    fine = dataclasses.replace(e2v, line_step_nm=0.007)
    for row, wavelength in enumerate(table.wavelengths_nm):
        direct = fine.flat_field(thickness, wavelength)
        error = np.max(np.abs(table.evaluate(row, thickness) / direct - 1.0))
        assert error < max(2.0 * table.relative_error, 1e-9)


def test_a_table_that_is_too_coarse_is_refused(e2v: FlatFieldOptics) -> None:
    coarse = dataclasses.replace(e2v, bandwidth_fwhm_nm=20.0, line_step_nm=1.4)
    with pytest.raises(ConvergenceError, match="signal table"):
        coarse.table((15.0, 15.5), [980.0])


def test_spread_averages_over_thickness(e2v: FlatFieldOptics) -> None:
    """Gauss–Hermite over the thickness, by hand, gives the same."""
    node, weight = np.polynomial.hermite_e.hermegauss(21)
    thickness = np.linspace(15.0, 15.3, 7)
    direct = np.zeros(7)
    for height, share in zip(0.040 * node, weight / weight.sum(), strict=True):
        direct += share * e2v.flat_field(thickness + height, 950.0)
    spread = dataclasses.replace(e2v, spread_nm=40.0)
    np.testing.assert_allclose(spread.flat_field(thickness, 950.0), direct, rtol=1e-6)


@pytest.mark.parametrize("face", ["ar_outer", "detection", "gate_oxide", "adhesive", "support", "substrate"])
def test_any_face_may_be_rough(e2v: FlatFieldOptics, face: str) -> None:
    """The model's roughness, in waves and a closed form, is that of the mock, in fields and matrices."""
    rough = dataclasses.replace(e2v, rough_face=face, roughness_nm=15.0)
    system = Setup.from_name("ts8_e2v").optical_system().with_layer(face, roughness_nm=15.0)
    thickness = np.linspace(15.0, 15.6, 11)
    illumination = system.flat_fields(np.array([880.0, 970.0]))
    theirs = system.reduce(illumination).averaged(illumination.weight, thickness)
    ours = np.stack([rough.flat_field(thickness, wavelength) for wavelength in (880.0, 970.0)])
    np.testing.assert_allclose(ours, theirs, rtol=2e-6)
    assert np.max(np.abs(ours[1] / e2v.flat_field(thickness, 970.0) - 1.0)) > 1e-5


@pytest.mark.parametrize(
    ("changes", "error", "names"),
    [
        ({"bandwidth_fwhm_nm": 0.0}, OutOfRangeError, "bandwidth"),
        ({"line_step_nm": -1.0}, OutOfRangeError, "line_step_nm"),
        ({"roughness_nm": -1.0}, OutOfRangeError, "roughness"),
        ({"spread_nm": np.nan}, OutOfRangeError, "spread"),
        ({"rough_face": "ambient"}, UnknownNameError, "rough face"),
        ({"line_shape": "gausian"}, UnknownNameError, "gaussian"),
        ({"varying": "glue"}, UnknownNameError, "glue"),
        ({"theta": (0.0, 0.1)}, OutOfRangeError, "angle weights"),
        (
            {"films": (Film("a", "vacuum", 1.0), Film("b", "Si", 1.0), Film("c", "Si", math.inf))},
            StackError,
            "end",
        ),
    ],
)
def test_unusable_optics_are_refused(
    e2v: FlatFieldOptics, changes: dict[str, object], error: type[Exception], names: str
) -> None:
    with pytest.raises(error, match=names):
        dataclasses.replace(e2v, **changes)  # type: ignore[arg-type]


def test_numbers_outside_tables_are_refused(e2v: FlatFieldOptics) -> None:
    with pytest.raises(OutOfRangeError, match="wavelength"):
        e2v.flat_field(15.0, 1250.0)
    table = e2v.table((15.0, 15.1), [960.0])
    for thickness in (14.5, math.nan):
        with pytest.raises(OutOfRangeError, match="thickness"):
            table.evaluate(0, np.array([15.05, thickness]))
