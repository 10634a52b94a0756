"""Fringe maps for imSim: its calls, our physics."""

import inspect

import galsim
import numpy as np
import pytest

from lsst.fringe_sim.algorithms import simulate_sky_frame
from lsst.fringe_sim.algorithms.fringe_amplitudes import fringe_amplitudes
from lsst.fringe_sim.algorithms.imsim_fringing import CCDFringing
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.night import AirglowField
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.mock import e2v_321
from lsst.fringe_sim.model import FringeModel

BORESIGHT = galsim.CelestialCoord(54.93 * galsim.degrees, -35.84 * galsim.degrees)
SHAPE = (120, 130)


def at(dx_deg: float, dy_deg: float) -> galsim.CelestialCoord:
    return BORESIGHT.deproject(dx_deg * galsim.degrees, dy_deg * galsim.degrees)


@pytest.fixture(scope="module")
def thickness_um() -> np.ndarray:
    return e2v_321(SHAPE)


@pytest.fixture(scope="module")
def centre(thickness_um) -> CCDFringing:
    return CCDFringing(
        true_center=at(0.0, 0.0), boresight=BORESIGHT, seed=5, spatial_vary=False, thickness_um=thickness_um
    )


def test_it_is_called_like_the_class_of_imsim() -> None:
    """Names and order of arguments of imSim's class, all that its callers pass."""
    made = [p.name for p in inspect.signature(CCDFringing).parameters.values() if p.kind != p.KEYWORD_ONLY]
    assert made == ["true_center", "boresight", "seed", "spatial_vary"]
    asked = list(inspect.signature(CCDFringing.calculate_fringe_amplitude).parameters)
    assert asked == ["self", "x", "y", "amplitude"]


@pytest.mark.slow
def test_the_map_is_the_sky_frame_of_the_package(centre, thickness_um) -> None:
    x, y = np.meshgrid(range(SHAPE[1]), range(SHAPE[0]))
    found = centre.calculate_fringe_amplitude(x, y)
    sky = SkySpectrum.dark(airmass=centre.setup.airmass)
    frame = simulate_sky_frame(thickness_um, FringeModel.from_setup("lsst_e2v"), sky)
    assert np.abs(found - 1.0 - frame.fraction()).max() < 1e-6
    assert found.mean() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.slow
def test_fringes_are_weaker_at_the_edge_of_the_field(centre, thickness_um) -> None:
    edge = CCDFringing(at(1.0, 1.0), BORESIGHT, 5, False, thickness_um=thickness_um)
    assert edge.field_x_deg == pytest.approx(1.0, abs=1e-9)
    rms = [fringe_amplitudes(1.0 + one.simulate_fringes()).rms for one in (centre, edge)]
    assert rms[1] < 0.75 * rms[0]


def test_the_level_of_the_lines_is_that_of_the_place_in_the_field(thickness_um) -> None:
    field = AirglowField.imsim()
    for dx, dy in ((-1.0, 0.4), (0.3, -0.9)):
        one, still = (
            CCDFringing(at(dx, dy), BORESIGHT, 5, vary, thickness_um=thickness_um) for vary in (True, False)
        )
        expected = float(field.at(dx, dy) / field.at(0.0, 0.0))
        assert one.fringe_variation_level() == pytest.approx(expected, rel=1e-3)
        assert abs(expected - 1.0) > 0.01
        assert still.fringe_variation_level() == 1.0


@pytest.mark.slow
def test_brighter_lines_have_stronger_fringes(centre, thickness_um) -> None:
    """More than the continuum allows they cannot gain: less than the lines themselves."""
    made = CCDFringing(at(-1.0, 0.4), BORESIGHT, 5, True, thickness_um=thickness_um)
    still = CCDFringing(at(-1.0, 0.4), BORESIGHT, 5, False, thickness_um=thickness_um)
    field = AirglowField.imsim()
    level = made.fringe_variation_level()
    assert level == pytest.approx(float(field.at(made.field_x_deg, made.field_y_deg) / field.at(0.0, 0.0)))
    assert still.fringe_variation_level() == 1.0
    gain = np.std(made.simulate_fringes()) / np.std(still.simulate_fringes())
    assert min(1.0, level) < gain < max(1.0, level)
    assert abs(level - 1.0) > 0.01


def test_a_strength_of_ones_own_is_half_the_range(centre) -> None:
    x, y = np.meshgrid(range(SHAPE[1]), range(SHAPE[0]))
    found = centre.calculate_fringe_amplitude(x, y, amplitude=0.002)
    assert fringe_amplitudes(found).half_range_1_99 == pytest.approx(0.002, rel=1e-3)


def test_positions_between_pixels_are_interpolated(centre) -> None:
    pattern = 1.0 + centre.simulate_fringes()
    assert centre.calculate_fringe_amplitude(10, 20) == pattern[20, 10]
    between = centre.calculate_fringe_amplitude([10.5], [20.25])
    corners = pattern[20:22, 10:12]
    assert between[0] == pytest.approx(0.75 * corners[0].mean() + 0.25 * corners[1].mean(), rel=1e-12)
    for x, y in ((SHAPE[1], 0), (0, -1)):
        with pytest.raises(OutOfRangeError, match="position"):
            centre.calculate_fringe_amplitude(x, y)


def test_a_galsim_image_takes_the_factor(centre) -> None:
    sky = galsim.ImageF(SHAPE[1], SHAPE[0], init_value=2700.0)
    x, y = np.meshgrid(range(SHAPE[1]), range(SHAPE[0]))
    sky.array[:] *= centre.calculate_fringe_amplitude(x, y)
    assert np.std(sky.array) / 2700.0 == pytest.approx(np.std(centre.simulate_fringes()), rel=1e-4)


def test_the_seed_is_the_sensor(monkeypatch) -> None:
    first, again, other = (CCDFringing(at(0.1, 0.0), BORESIGHT, seed, True) for seed in (7, 7, 8))
    assert first.thickness_um.shape == (4004, 4096)
    assert np.array_equal(first.thickness_um, again.thickness_um)
    assert not np.array_equal(first.thickness_um, other.thickness_um)


@pytest.mark.parametrize("bad", [np.ones(5), np.full((4, 4), np.nan)])
def test_maps_that_are_none_are_refused(bad) -> None:
    with pytest.raises(InputError, match="thickness map"):
        CCDFringing(at(0.0, 0.0), BORESIGHT, 1, False, thickness_um=bad)
