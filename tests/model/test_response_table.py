"""Tables: the stated error bounds the true one, frames do not depend on threads, bad input is refused."""

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.compiled import limit_threads
from lsst.fringe_sim.errors import ConvergenceError, InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel, ResponseTable, response_table, tabulate
from lsst.fringe_sim.optics import Beam, Illumination, LayerStack
from lsst.fringe_sim.optics.illumination import GaussianProfile
from lsst.fringe_sim.optics.system import OpticalSystem

WAVELENGTHS = np.array([880.0, 960.0, 990.0])


def system(stack: str = "e2v_ccd250", varying: str = "adhesive") -> OpticalSystem:
    return OpticalSystem(
        LayerStack.from_resource(stack), 183.0, GaussianProfile(2.0), Beam.collimated(), varying
    )


@pytest.fixture(scope="module")
def table() -> ResponseTable:
    optics = system()
    return response_table(optics, optics.flat_fields(WAVELENGTHS), (14.0, 16.0), wavelength_nm=WAVELENGTHS)


@pytest.mark.parametrize("tolerance", [1e-5, 1e-8])
@pytest.mark.parametrize(
    ("stack", "varying", "span"),
    [("e2v_ccd250", "adhesive", (5.0, 7.0)), ("hsc_hamamatsu", "detection", (199.8, 200.4))],
)
@pytest.mark.rng("stated error bounds the true one")
def test_stated_error_bounds_the_true_one(
    stack: str, varying: str, span: tuple[float, float], tolerance: float, rng: np.random.Generator
) -> None:
    optics = system(stack, varying)
    light = optics.flat_fields(WAVELENGTHS, 0.2)
    table = response_table(optics, light, span, tolerance=tolerance)
    thickness = rng.uniform(*span, 20_000)
    exact = optics.reduce(light).averaged(light.weight, thickness)
    true_error = np.abs(table.lookup(thickness) - exact).max()
    assert true_error <= table.interpolation_error <= tolerance
    # Not merely a large number: within two orders of what it bounds.
    assert table.interpolation_error < 100.0 * true_error


@pytest.mark.rng("bound of the fourth derivative holds")
def test_bound_of_the_fourth_derivative_holds(rng: np.random.Generator) -> None:
    # In absorbing silicon, terms of equal phase and opposite sign are bounded one by one: a looser bound.
    cases = (("e2v_ccd250", "adhesive", 5.0, 0.3), ("hsc_hamamatsu", "detection", 30.0, 0.01))
    for stack, varying, start, sharpness in cases:
        optics = system(stack, varying)
        # A single wavelength: over a band the silicon fringes cancel, which a bound cannot know.
        light = Illumination.spectrum([990.0], [1.0], Beam.collimated())
        reduced = optics.reduce(light)
        step = 1e-3
        samples = reduced.averaged_on_grid(light.weight, start, step, 500)
        seen = np.abs(np.diff(samples, 4)).max() / step**4
        bound = reduced.derivative_bound(light.weight, 4, start).max()
        assert sharpness * bound < seen < bound


@pytest.mark.rng("frame is lookup in single precision")
def test_frame_is_lookup_in_single_precision(table: ResponseTable, rng: np.random.Generator) -> None:
    thickness = rng.uniform(14.0, 16.0, (37, 53))
    thickness[3, 4] = np.nan
    for kind in (np.float32, np.float64):
        image = table.frame(thickness.astype(kind), 1)
        expected = table.lookup(thickness.astype(kind))[1]
        assert image.dtype == np.float32
        assert np.isnan(image[3, 4])
        np.testing.assert_allclose(image, expected, rtol=0.0, atol=2e-7)


@pytest.mark.rng("frame has the same bits whatever the number of threads")
def test_frame_has_the_same_bits_whatever_the_number_of_threads(
    table: ResponseTable, rng: np.random.Generator
) -> None:
    thickness = rng.uniform(14.0, 16.0, (301, 117)).astype(np.float32)
    images = []
    for threads in (1, 2, 5):
        limit_threads(threads)
        images.append(table.frame(thickness, 0).tobytes())
    limit_threads(None)
    assert len(set(images)) == 1


@pytest.mark.rng("frame accepts views and writes into out")
def test_frame_accepts_views_and_writes_into_out(table: ResponseTable, rng: np.random.Generator) -> None:
    thickness = rng.uniform(14.0, 16.0, (20, 30))
    out = np.empty((10, 15), dtype=np.float32)
    assert table.frame(thickness[::2, ::2], 2, out) is out
    np.testing.assert_array_equal(out, table.frame(np.ascontiguousarray(thickness[::2, ::2]), 2))


def test_ends_of_the_grid_are_inside(table: ResponseTable) -> None:
    ends = np.array([[14.0, 16.0]])
    assert np.isfinite(table.frame(ends)).all()
    np.testing.assert_allclose(table.lookup(ends)[:, 0], table.values[:, [0, -1]], atol=1e-14)


@pytest.mark.parametrize("value", [13.999, 16.001, -1.0, np.inf])
def test_thickness_outside_is_refused(table: ResponseTable, value: float) -> None:
    with pytest.raises(OutOfRangeError, match="range of the table"):
        table.lookup(value)
    with pytest.raises(OutOfRangeError, match="range of the table"):
        table.frame(np.array([[15.0, value]]))


def test_bad_arguments_are_refused(table: ResponseTable) -> None:
    with pytest.raises(OutOfRangeError, match="row"):
        table.frame(np.full((2, 2), 15.0), 3)
    with pytest.raises(InputError, match="two axes"):
        table.frame(np.full(4, 15.0))
    with pytest.raises(InputError, match="float32"):
        table.frame(np.full((2, 2), 15.0), out=np.empty((2, 2)))
    optics = system()
    light = optics.flat_fields(WAVELENGTHS)
    for span in ((-1.0, 3.0), (3.0, 3.0), (3.0, np.inf), (np.nan, 4.0)):
        with pytest.raises(OutOfRangeError, match="thickness range"):
            response_table(optics, light, span)


def test_unreachable_tolerance_is_said() -> None:
    def kink(start: float, step: float, count: int) -> np.ndarray:
        return np.abs(start + step * np.arange(count) - 1.2345)[None]

    with pytest.raises(ConvergenceError, match="interpolation error"):
        tabulate(kink, (1.0, 2.0), [960.0], tolerance=1e-9, fourth_derivative=1e3)


@pytest.mark.rng("estimated derivative serves any response")
def test_estimated_derivative_serves_any_response(rng: np.random.Generator) -> None:
    def wave(start: float, step: float, count: int) -> np.ndarray:
        return np.sin(20.0 * (start + step * np.arange(count)))[None]

    table = tabulate(wave, (5.0, 9.0), [960.0], tolerance=1e-6)
    thickness = rng.uniform(5.0, 9.0, 5000)
    true_error = np.abs(table.lookup(thickness)[0] - np.sin(20.0 * thickness)).max()
    assert true_error <= table.interpolation_error <= 1e-6


@pytest.mark.parametrize("effects", [{}, {"bandwidth.fwhm": 1.5}, {"contrast_loss.factor": 0.3}])
@pytest.mark.rng("table of a model is its response")
def test_table_of_a_model_is_its_response(effects: dict[str, float], rng: np.random.Generator) -> None:
    model = FringeModel.from_setup("ts8_e2v", effects=effects)
    thickness = rng.uniform(14.0, 15.0, 200)
    table = model.table((14.0, 15.0), WAVELENGTHS)
    difference = np.abs(table.lookup(thickness) - model.response(thickness, WAVELENGTHS)).max()
    assert difference <= table.interpolation_error <= 1e-7
    np.testing.assert_array_equal(table.wavelength_nm, WAVELENGTHS)


def test_tables_are_as_recorded(table: ResponseTable, recorded: Record) -> None:
    """A record of nodes, values and stated errors, for edits that are not meant to change them."""
    optics = system("hsc_hamamatsu", "detection")
    coarse = response_table(optics, optics.flat_fields(WAVELENGTHS, 0.5), (199.8, 200.2), tolerance=1e-3)
    image = np.linspace(14.1, 15.9, 60).reshape(6, 10)
    recorded({"usual": table, "coarse": coarse, "frame": table.frame(image), "rows": table.lookup(image[0])})
