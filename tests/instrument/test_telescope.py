"""Beams against the law of the cone, batoid itself, and symmetry."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import batoid
import numpy as np
import pytest
from astropy.table import Table
from hypothesis import given, settings
from hypothesis import strategies as st

from lsst.fringe_sim.errors import InputError, OutOfRangeError, ResourceError, UnknownNameError
from lsst.fringe_sim.instrument.beam_field import BeamField, _clear_radii
from lsst.fringe_sim.instrument.telescope import (
    ConeOptics,
    Telescope,
    TracedOptics,
    gauss_rule,
    reduce_beam,
    telescope_beam,
)
from lsst.fringe_sim.optics import Beam

COARSE = TracedOptics("LSST_y.yaml", 1000.0, axisymmetric=True, rings=60, spokes=180)


@pytest.fixture(scope="module")
def lsst() -> Telescope:
    return Telescope.from_name("lsst")


@pytest.mark.parametrize(
    ("name", "field_deg", "smallest", "largest", "mean"),
    [
        ("lsst", 0.0, 14.36, 23.91, 19.46),
        ("lsst", 1.44, 10.04, 29.26, 20.05),
        ("hsc", 0.0, 3.02, 12.92, 9.08),
    ],
)
def test_angles_of_the_published_ray_traces(name, field_deg, smallest, largest, mean):
    angle = np.degrees(Telescope.from_name(name).trace(field_deg).theta)
    assert angle.min() == pytest.approx(smallest, abs=0.05)
    assert angle.max() == pytest.approx(largest, abs=0.05)
    assert angle.mean() == pytest.approx(mean, abs=0.05)


@pytest.mark.shared
def test_every_traced_radius_of_the_summary(shared_dir):
    summary = Table.read(shared_dir / "data" / "beam_angles_summary.ecsv")
    for row in summary[(summary["beam"] == "LSST") & np.isin(summary["field_r"], [0.6, 1.2, 1.7])]:
        bundle = Telescope.from_name("lsst").trace(float(row["field_r"]))
        angle = np.degrees(bundle.theta)
        assert angle.min() == pytest.approx(row["theta_min"], abs=0.05)
        assert angle.max() == pytest.approx(row["theta_max"], abs=0.05)
        assert angle.mean() == pytest.approx(row["theta_mean"], abs=0.03)
        assert angle.std() == pytest.approx(row["theta_std"], abs=0.03)
        # the summary launches rays on the rims of the pupil, which are vignetted
        assert bundle.kept_fraction == pytest.approx(row["kept_fraction"], abs=0.006)


def test_angle_is_that_of_batoid():
    optic = batoid.Optic.fromYaml("LSST_y.yaml")
    rays = batoid.RayVector.fromStop(
        np.array([3.0, 0.0, -2.0]),
        np.array([0.0, 3.5, 3.0]),
        optic=optic,
        wavelength=1e-6,
        theta_x=math.radians(0.7),
        theta_y=math.radians(-0.4),
    )
    optic.trace(rays)
    expected = np.arccos(np.abs(rays.v[:, 2]) / np.linalg.norm(rays.v, axis=1))
    bundle = Telescope.from_name("lsst").trace(0.7, -0.4)
    # the three rays lie among those of the bundle: nearest neighbour in slope
    for ray, angle in zip(rays.v, expected, strict=True):
        slope = ray[:2] / abs(ray[2])
        near = np.argmin((bundle.slope_x - slope[0]) ** 2 + (bundle.slope_y - slope[1]) ** 2)
        assert math.hypot(bundle.slope_x[near] - slope[0], bundle.slope_y[near] - slope[1]) < 2e-3
        assert bundle.theta[near] == pytest.approx(angle, abs=2e-3)


def test_mirror_and_rotation_stand_for_a_full_trace():
    fold = COARSE.trace(0.5, 0.9)
    full = TracedOptics("LSST_y.yaml", 1000.0, axisymmetric=False, rings=60, spokes=180).trace(0.5, 0.9)
    assert fold.slope_x.mean() == pytest.approx(full.slope_x.mean(), abs=2e-4)
    assert fold.slope_y.mean() == pytest.approx(full.slope_y.mean(), abs=2e-4)
    assert np.cov(fold.slope_x, fold.slope_y) == pytest.approx(np.cov(full.slope_x, full.slope_y), abs=3e-4)
    assert fold.kept_fraction == pytest.approx(full.kept_fraction, abs=2e-3)


@pytest.mark.parametrize("field_deg", [0.0, 0.9, 1.44, 1.75])
@pytest.mark.parametrize(("index", "thickness_um"), [(1.6, 14.0), (1.6, 30.0), (3.6, 100.0), (3.6, 265.0)])
def test_few_angles_stand_for_all_rays(lsst, field_deg, index, thickness_um):
    """The coherence of a layer, to which the contrast of its fringes is proportional."""
    rays, beam = lsst.trace(field_deg), lsst.trace(field_deg).beam()

    def phase_factor(sin_squared):
        return np.exp(1j * 4.0 * np.pi * thickness_um * np.sqrt(index**2 - sin_squared))

    all_rays = phase_factor(np.asarray(rays.sin_squared)).mean()
    assert abs(beam.weight @ phase_factor(np.sin(beam.theta) ** 2) - all_rays) < 2e-5


def test_reduced_beam_keeps_the_moments(lsst):
    full = lsst.beam(0.9)
    small = reduce_beam(full, 12)
    assert small.theta.size == 12
    for power in range(24):
        moments = [(beam.weight @ np.sin(beam.theta) ** (2 * power)) for beam in (small, full)]
        assert moments[0] == pytest.approx(moments[1], rel=1e-9)
    assert reduce_beam(small, 12) is small
    assert reduce_beam(Beam.collimated(0.1), 4).theta.size == 1


def test_beam_is_a_distribution(lsst):
    beam = lsst.beam(1.0, 0.3)
    rays = lsst.trace(1.0, 0.3)
    assert beam.weight.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.all(np.diff(beam.theta) > 0)
    assert beam.theta.min() >= rays.theta.min()
    assert beam.theta.max() <= rays.theta.max()
    assert beam.mean_angle == pytest.approx(rays.theta.mean(), abs=1e-5)


def test_cone_of_rays_obeys_the_sine_condition():
    cone = ConeOptics(1.2, obscuration=0.6, rings=800, spokes=32)
    analytic = Beam.cone(1.2, 0.6, nodes=64)
    rays = cone.trace(0.0, 0.0)
    sine = rays.sin_squared
    # The same light from all sides.
    spread = np.mean(rays.slope_x**2)
    assert np.mean([rays.slope_x, rays.slope_y], axis=1) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert np.mean(rays.slope_y**2) == pytest.approx(spread)
    assert np.mean(rays.slope_x * rays.slope_y) == pytest.approx(0.0, abs=1e-12)
    assert rays.kept_fraction == 1.0
    for power in (1, 2, 3):
        assert np.mean(sine**power) == pytest.approx(
            analytic.weight @ np.sin(analytic.theta) ** (2 * power), rel=1e-6
        )
    monocam = telescope_beam("monocam", 0.2, 0.1)
    assert monocam.theta.max() < math.asin(1 / 8) < monocam.theta.max() + 1e-3


@settings(max_examples=40, deadline=None)
@given(
    st.integers(2, 12),
    st.integers(30, 300),
    st.integers(0, 2**32 - 1),
)
def test_gauss_rule_integrates_polynomials(nodes, points, seed):
    rng = np.random.default_rng(seed)
    value, weight = rng.uniform(0.05, 0.25, points), rng.uniform(0.1, 1.0, points)
    node, mass = gauss_rule(value, weight, nodes)
    scaled, expected = (node - 0.15) / 0.1, (value - 0.15) / 0.1
    assert mass.min() > 0
    assert value.min() < node.min() < node.max() < value.max()
    for degree in range(2 * nodes):
        assert mass @ scaled**degree == pytest.approx(weight @ expected**degree, abs=1e-9 * weight.sum())


def test_gauss_rule_is_gauss_legendre_for_a_uniform_measure():
    value = (np.arange(400_000) + 0.5) / 200_000 - 1.0
    node, mass = gauss_rule(value, np.full(value.size, 1 / 200_000), 8)
    expected_node, expected_mass = np.polynomial.legendre.leggauss(8)
    np.testing.assert_allclose(node, expected_node, atol=1e-9)
    np.testing.assert_allclose(mass, expected_mass, atol=1e-9)


def test_gauss_rule_of_few_points_is_those_points():
    node, mass = gauss_rule([0.3, 0.1], [1.0, 2.0], 64)
    np.testing.assert_array_equal(node, [0.1, 0.3])
    np.testing.assert_array_equal(mass, [2.0, 1.0])
    node, mass = gauss_rule(np.full(9, 0.2), np.full(9, 1 / 9), 4)
    assert node.size == 1
    assert mass.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("apart", [0.0, 1e-17, 1e-15, 1e-12])
def test_gauss_rule_has_nodes_only_where_places_are(apart):
    """Eight points, each as a group of eight in nearly the same place, and more nodes wanted than eight."""
    place, rng = np.linspace(0.1, 0.4, 8), np.random.default_rng(1)
    value = (place[:, np.newaxis] + apart * rng.standard_normal(8)).ravel()
    node, mass = gauss_rule(value, np.full(64, 1 / 64), 14)
    assert node.min() >= value.min()
    assert node.max() <= value.max()
    np.testing.assert_allclose(node[mass > 1e-9], place, atol=1e-9)
    np.testing.assert_allclose(mass[mass > 1e-9], 1 / 8, atol=1e-9)


def test_quantiles_keep_the_mean_whatever_the_number_of_groups():
    bundle = COARSE.trace(1.0, 0.0)
    for groups in (7, 64, 1000):
        quantile = bundle.quantiles(groups)
        assert np.all(np.diff(quantile) >= 0)
        assert quantile.mean() == pytest.approx(bundle.sin_squared.mean(), rel=1e-12)


@pytest.fixture(scope="module")
def coarse() -> Telescope:
    return Telescope("coarse", COARSE, 32.4, 10.0, 0.2, 2.03)


@pytest.fixture(scope="module")
def coarse_field(coarse) -> BeamField:
    return BeamField.trace(coarse)


# Field radii of sensors: the axis, near it, at both onsets of vignetting, and in a corner of the field.
@pytest.mark.parametrize("radius", [0.0, 0.05, 0.2348, 0.666, 1.0, 1.3714, 1.44, 1.711, 1.7896, 1.8942, 2.02])
def test_interpolated_rays_are_the_traced_ones(coarse, coarse_field, radius):
    traced = coarse.trace(radius)
    sine, kept = coarse_field.sin_squared_at(0.6 * radius, 0.8 * radius)
    assert kept == pytest.approx(traced.kept_fraction, abs=1e-12)
    np.testing.assert_allclose(np.sort(np.tile(sine, 2)), np.sort(traced.sin_squared), atol=1e-8)


@pytest.fixture(scope="module")
def field(lsst) -> BeamField:
    return BeamField.trace(lsst, 7)


@pytest.mark.parametrize("radius", [0.9, 1.75])
def test_interpolated_beam_is_the_traced_one(lsst, field, radius):
    for index, thickness_um in ((1.6, 14.0), (1.6, 22.0), (3.6, 100.0), (3.6, 265.0)):
        difference = coherence(field.beam(radius), index, thickness_um) - coherence(
            lsst.beam(radius), index, thickness_um
        )
        assert abs(difference) < 1e-6


def coherence(beam: Beam, index: float, thickness_um: float) -> complex:
    phase = 4 * np.pi * thickness_um * (np.sqrt(index**2 - np.sin(beam.theta) ** 2) - index)
    return complex(beam.weight @ np.exp(1j * phase))


def test_a_ray_is_stored_only_for_the_apertures_that_can_cut_it_off(coarse, coarse_field):
    """Most rays miss all edges by far; those that are stored really pass close to them."""
    assert coarse_field.edge_ray.size < 6 * coarse_field.sin_squared.shape[1]
    with pytest.raises(OutOfRangeError, match="number of traced radii"):
        BeamField.trace(coarse, 4)


def test_beam_field_needs_symmetry_and_stays_inside(coarse_field):
    for name in ("hsc", "monocam"):
        with pytest.raises(InputError, match="axisymmetric"):
            BeamField.trace(Telescope.from_name(name))
    for radius in (2.1, math.nan):
        with pytest.raises(OutOfRangeError, match="field angle"):
            coarse_field.beam(radius)


def test_bad_input_is_named(lsst):
    assert Telescope.from_name("LSST") == lsst
    with pytest.raises(UnknownNameError, match="did you mean lsst"):
        telescope_beam("lsst2")
    with pytest.raises(OutOfRangeError, match="field angle"):
        lsst.beam(2.0, 1.0)
    with pytest.raises(OutOfRangeError, match="field angle"):
        lsst.beam(math.nan)
    with pytest.raises(OutOfRangeError, match="number of beam angles"):
        lsst.beam(0.0, nodes=0)
    with pytest.raises(ResourceError, match="wrong or missing entry"):
        Telescope.from_mapping("mine", {"optics": {"kind": "cone", "f_number": 4.0}})
    with pytest.raises(ResourceError, match="no prescription"):
        TracedOptics("NoSuch.yaml", 1000.0, axisymmetric=True).trace(0.0, 0.0)
    with pytest.raises(OutOfRangeError, match="a place that light reaches"):
        COARSE.trace(2.5, 0.0)


@pytest.mark.parametrize(
    ("stop", "radii"),
    [
        (None, (0.0, math.inf)),
        (batoid.ObscNegation(batoid.ObscCircle(3.0)), (0.0, 3.0)),
        (batoid.ObscNegation(batoid.ObscAnnulus(1.0, 3.0)), (1.0, 3.0)),
        (batoid.ObscNegation(batoid.ObscCircle(3.0, 0.1)), None),
        (batoid.ObscNegation(batoid.ObscAnnulus(1.0, 3.0, 0.0, 0.1)), None),
        (batoid.ObscNegation(batoid.ObscCircle(3.0, 0.1, 0.1)), None),
        (batoid.ObscCircle(3.0), None),
        (batoid.ObscNegation(batoid.ObscRectangle(3.0, 2.0)), None),
    ],
)
def test_what_a_surface_lets_through(stop: Any, radii: tuple[float, float] | None) -> None:
    """Circles and annuli about the axis; other apertures are refused."""
    surface: Any = SimpleNamespace(name="L1", obscuration=stop)
    if radii is None:
        with pytest.raises(ResourceError, match="aperture of L1"):
            _clear_radii(surface)
    else:
        assert _clear_radii(surface) == radii
