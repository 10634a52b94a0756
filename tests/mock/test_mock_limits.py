"""Limits of what the mock can be asked for: both ends are in, and what lies beyond either is refused."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stated_limits import check_ends

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.mock import (
    Defects,
    Film,
    FlatFieldOptics,
    SignalTable,
    material_index,
    parse_size,
    random_field,
    setup_optics,
    write_mock_flats,
)
from lsst.fringe_sim.mock.line_shapes import LINE_SHAPES
from lsst.fringe_sim.mock.raw_frames import checked_thickness
from lsst.fringe_sim.mock.thickness import PixelArea
from lsst.fringe_sim.mock.visit_sources import Pointing, Scene, VisitConditions, VisitImage, expected_sources
from lsst.fringe_sim.mock.visits import check_visits

E2V = setup_optics("ts8_e2v")[0]
LIGHT = {"pixel_scale_arcsec": 0.2, "bandpass": "lsst_y", "effective_area_m2": 32.4}
RNG = np.random.default_rng(31)


def optics(**changes: Any) -> FlatFieldOptics:
    return dataclasses.replace(E2V, **changes)


def film_of(thickness_um: float) -> FlatFieldOptics:
    return E2V.with_film("gate_oxide", thickness_um=thickness_um)


def films(number: int) -> FlatFieldOptics:
    middle = [Film(f"film {i}", "Si", 1.0) for i in range(number - 2)]
    ends = Film("a", "vacuum", math.inf), Film("z", "Si", math.inf)
    named = {"varying": "a", "detection": "z", "rough_face": "z"}
    return optics(films=(ends[0], *middle, ends[1]), **named)


def number_of_sources(scale: float, **changes: Any) -> float:
    conditions = VisitConditions(seeing_arcsec=(0.5, 0.9), dither_arcsec=1.0, **changes)
    return expected_sources({**LIGHT, "pixel_scale_arcsec": scale}, conditions, (40, 30))


@pytest.mark.parametrize(
    ("made", "inside", "outside"),
    [
        (lambda value: optics(bandwidth_fwhm_nm=value), (1e-9,), (0.0, math.nan)),
        (lambda value: optics(line_step_nm=value), (1e-9,), (0.0, math.nan)),
        (lambda value: optics(height_step_nm=value), (1e-9,), (0.0, math.nan)),
        (lambda value: optics(roughness_nm=value), (0.0,), (-1e-9, math.nan)),
        (lambda value: optics(spread_nm=value), (0.0,), (-1e-9, math.nan)),
        (lambda value: optics(support_spread_um=value), (0.0,), (-1e-9, math.nan)),
        (lambda value: optics(other_lines=(("lorentzian", value),)), (0.0, 1.0), (-1e-9, 1.0 + 1e-9)),
        (lambda value: optics(theta=(0.0, 0.1), theta_weight=(0.4, value)), (0.6,), (0.6 + 1e-6, 0.5)),
        (lambda value: optics(varying=value), ("adhesive", "support"), ("glue",)),
        (film_of, (0.0, 1e6), (-1e-9, math.inf, math.nan)),
        (films, (3, 4), (2,)),
        (lambda low: E2V.table((low, 0.01), [960.0]), (1e-9, 0.01), (0.0, 0.0101, math.nan)),
        (lambda high: E2V.table((14.0, high), [960.0]), (14.0,), (13.9999, math.inf, math.nan)),
        (lambda scale: random_field((4, 4), RNG, scale=scale), (1e-3,), (0.0, -1.0, math.nan)),
        (lambda span: random_field((4, 4), RNG, mean=3.0, span=span), (1e-3, 6.0), (0.0, 6.0001, math.nan)),
        (lambda value: Defects(bad_columns=value), (0, 1), (-1,)),
        (lambda value: Defects(hot_pixels=value), (0, 1), (-1,)),
        (lambda value: Defects(prnu_rms=value), (0.0, 1e-9), (-1e-9, math.nan)),
        (lambda um: checked_thickness(np.array([[1.0, um]]), (1, 2)), (1e-9, 1e9), (0.0, math.inf, math.nan)),
        (parse_size, ("1x1", "8X4"), ("1x0", "0x1", "1x", "x1", "1x1x1", "1.0x1")),
        (lambda nm: material_index("Si_franta2017", np.array([nm]), 200.0), (300.0, 1200.0), (299.9, 1200.1)),
        (number_of_sources, (0.1, 0.9), (0.9001,)),
        (
            lambda effect: check_visits("lsst_e2v", (64, 64), effect),
            ({"contrast_loss.factor": 0.5}, {}),
            ({"void.thickness": 10.0}, {"tilt.angle": 1.0}, {"ghost_pedestal.fraction": 0.01}),
        ),
    ],
)
def test_ends_are_in(made: Callable[[Any], Any], inside: tuple[Any, ...], outside: tuple[Any, ...]) -> None:
    check_ends(made, inside, outside)


@pytest.mark.parametrize(("argument", "least"), [("n_bias", 0), ("repeats", 1), ("level_e", 1.0)])
def test_the_least_that_frames_may_be(argument: str, least: float, tmp_path: Path) -> None:
    asked: dict[str, Any] = {"n_bias": 1, "repeats": 1, "level_e": 50.0, argument: least}

    def write(folder: Path) -> Any:
        return write_mock_flats(
            folder,
            setup="ts8_e2v",
            detector="R11_S01",
            thickness_um=np.full((2, 8), 14.0),
            wavelengths_nm=[960.0],
            rng=np.random.default_rng(5),
            size="8x2",
            **asked,
        )

    made = write(tmp_path / "least")
    assert (len(made.bias), len(made.flats)) == (asked["n_bias"], asked["repeats"])
    assert made.flats[0].level_e == pytest.approx(asked["level_e"], rel=0.05)
    for wrong in (least - 0.01, math.inf, math.nan):
        asked[argument] = wrong
        with pytest.raises(OutOfRangeError, match=argument):
            write(tmp_path / "less")
    assert not (tmp_path / "less").exists()


def test_a_table_is_a_spline_up_to_its_ends() -> None:
    """A cubic is its own spline."""
    grid = 14.0 + 0.25 * np.arange(9)

    def cubic(x: np.ndarray) -> np.ndarray:
        return 0.3 + 0.2 * (x - 15.0) - 0.4 * (x - 15.0) ** 2 + 0.7 * (x - 15.0) ** 3

    table = SignalTable(grid, np.stack([cubic(grid), 2.0 * cubic(grid)]), (900.0, 950.0))
    where = np.array([[14.0, 14.1], [15.999, 16.0]])
    np.testing.assert_allclose(table.evaluate(1, where), 2.0 * cubic(where), rtol=1e-12)
    for beyond in (14.0 - 1e-9, 16.0 + 1e-9):
        with pytest.raises(OutOfRangeError, match="14 to 16"):
            table.evaluate(0, np.array([15.0, beyond]))


def test_sources_that_a_night_draws() -> None:
    """Counts rise by a power of ten per magnitude over the slope; the patch holds all pointings."""
    side = 0.2 * math.hypot(40, 30) + 2.0 * (4.0 * 1.0 + 10.0)
    stars, galaxies = ((10.0 ** (2.0 * slope) - 10.0 ** (-9.0 * slope)) for slope in (0.2, 0.4))
    expected = (3.0 * stars + 5.0 * galaxies) * (side / 60.0) ** 2
    assert number_of_sources(0.2) == pytest.approx(expected, rel=1e-12)
    many = 3.0 * 100_000 / expected
    crowded = {"stars_per_arcmin2": many, "galaxies_per_arcmin2": many * 5.0 / 3.0}
    assert number_of_sources(0.2, **{name: 0.999999 * value for name, value in crowded.items()}) < 100_000
    with pytest.raises(InputError, match="sources in a visit is 100000; allowed: at most 100000"):
        number_of_sources(0.2, **{name: 1.000001 * value for name, value in crowded.items()})


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_places_on_the_sky_are_those_of_the_projection(angle: float) -> None:
    """East and north from the centre of the field, near which the projection is flat."""
    shape = (21, 41)
    looks = Pointing(3.0, -2.0, angle, 0.2)
    wcs = looks.wcs(shape)
    x, y = np.array([0.0, 40.0, 12.5]), np.array([3.0, 20.0, 0.0])
    right, declination = wcs.wcs_pix2world(x, y, 0)
    north = 3600.0 * (declination - 2.2)
    east = 3600.0 * (right - 150.1) * math.cos(math.radians(2.2))
    found = looks.pixels(east, north, shape)
    np.testing.assert_allclose(found, [x, y], atol=1e-3)
    middle = looks.pixels(np.array([3.0]), np.array([-2.0]), shape)
    np.testing.assert_allclose(np.ravel(middle), [20.0, 10.0])


@pytest.mark.parametrize("setup", ["lsst_e2v", "hsc"])
def test_a_sky_needs_a_telescope_and_flats_a_monochromator(setup: str) -> None:
    check_visits(setup, (64, 64))
    with pytest.raises(InputError, match="monochromator"):
        setup_optics(setup)
    with pytest.raises(InputError, match="behind a telescope"):
        check_visits("ts8_e2v", (64, 64))


def scene_of(x: np.ndarray, y: np.ndarray, electrons: float, scale: float = 0.2, **night: float) -> Scene:
    """Stars at places on a sensor of 8 x 64 pixels, in a night that disturbs nothing."""
    still = dict.fromkeys(
        ("dither_arcsec", "rotation_deg", "moon", "slope", "amplifier_rms", "read_noise_e"), 0.0
    )
    conditions = VisitConditions(cosmic_rays_per_s_cm2=0.0, seeing_arcsec=(0.6, 0.6), **{**still, **night})
    stars = np.full(x.size, 5.0), np.zeros(x.size), np.zeros(x.size, complex)
    return Scene(conditions, scale, 10.0 * electrons, scale * (x - 31.5), scale * (y - 3.5), *stars)


def image_of(
    x: np.ndarray, y: np.ndarray, electrons: float, scale: float = 0.2, sky: float = 1.0
) -> VisitImage:
    sensor = Camera.from_name("lsstCam").detector(94).cut_down((8, 64))
    scene, dark = scene_of(x, y, electrons, scale), np.full((8, 64), sky, np.float32)
    return VisitImage.expose(scene, dark, sensor, 10.0, np.random.default_rng(3))


def test_sources_whose_centre_lies_on_the_image_are_listed() -> None:
    x = np.array([-0.51, -0.49, 63.49, 63.51, 20.0, 20.0, 20.0, 20.0])
    y = np.array([4.0, 4.0, 4.0, 4.0, -0.51, -0.49, 7.49, 7.51])
    image = image_of(x, y, 1000.0)
    np.testing.assert_allclose(image.sources["x"], [-0.49, 63.49, 20.0, 20.0], atol=1e-9)
    np.testing.assert_allclose(image.sources["y"], [4.0, 4.0, -0.49, 7.49], atol=1e-9)
    np.testing.assert_allclose(image.sources["electrons"], 1000.0)
    assert not image.sources["galaxy"].any()
    assert not image.mask.any()


@pytest.mark.parametrize(
    ("electrons", "scale", "away_px", "lit"),
    [
        (1e11, 0.2, 200.0, True),
        (1e11, 0.2, 258.0, False),
        (1e11, 0.4, 100.0, True),
        (1e11, 0.4, 130.0, False),
    ],
)
def test_wings_of_bright_stars_reach_over_a_hundred_arcseconds(
    electrons: float, scale: float, away_px: float, lit: bool
) -> None:
    """Of a star beside the image, of which no more than its wings are on it: 51.3 arcsec to either side."""
    image = image_of(np.array([-away_px]), np.array([4.0]), electrons, scale, sky=1e4)
    assert (image.electrons.mean() > 1.001e4) == lit
    assert image.sources.size == 0


def test_a_star_has_its_electrons_at_its_place() -> None:
    image = image_of(np.array([31.0]), np.array([4.0]), 5e4)
    row, column = np.unravel_index(np.argmax(image.electrons), image.electrons.shape)
    assert (row, column) == (4, 31)
    assert 0.7 * 5e4 < image.electrons.sum() < 5.2e4


def test_pointings_stay_on_the_patch() -> None:
    """Three times their rms from its centre, and turned by no more than asked."""
    scene = scene_of(np.zeros(1), np.zeros(1), 1.0, dither_arcsec=2.0, rotation_deg=30.0)
    rng = np.random.default_rng(8)
    looks = [scene.pointing(rng) for _ in range(4000)]
    for offsets in ([one.east_arcsec for one in looks], [one.north_arcsec for one in looks]):
        assert (min(offsets), max(offsets)) == (-6.0, 6.0)
        assert np.std(offsets) == pytest.approx(2.0, rel=0.05)
    turns = np.degrees([one.angle_rad for one in looks])
    assert -30.0 <= turns.min() < -29.8
    assert 29.8 < turns.max() <= 30.0


@pytest.mark.parametrize(("fwhm", "numbers"), [(0.1, (81, 40)), (0.6, (103, 40)), (3.0, (511, 200))])
def test_lines_have_the_width_that_is_asked(fwhm: float, numbers: tuple[int, int]) -> None:
    """Variance of a Gaussian and of a triangle; half of a Lorentzian lies within half its width."""
    for name, variance, number in (
        ("gaussian", fwhm**2 / (8.0 * math.log(2.0)), numbers[0]),
        ("triangular", fwhm**2 / 6.0, numbers[1]),
    ):
        offset, weight = LINE_SHAPES[name](fwhm, 0.03)
        assert weight.sum() == pytest.approx(1.0)
        assert weight @ offset == pytest.approx(0.0, abs=1e-12)
        assert weight @ offset**2 == pytest.approx(variance, rel=1e-6)
        assert offset.size == number
    offset, weight = LINE_SHAPES["lorentzian"](fwhm, 0.3 * fwhm)
    assert np.abs(offset).max() == pytest.approx(10.0 * fwhm, rel=1e-2)
    assert weight[np.abs(offset) < 0.5 * fwhm].sum() == pytest.approx(
        math.atan(1.0) / math.atan(20.0), abs=0.02
    )


def test_maps_of_few_pixels() -> None:
    assert random_field((1, 1), RNG, mean=5.0, span=2.0).tolist() == [[5.0]]
    area = PixelArea.of(np.array([[1.0, 2.0, 4.0]]))
    assert not area.slope_y.any()
    np.testing.assert_allclose(area.slope_x, [[1.0, 4.0 / 3.0, 2.0]])
    two = PixelArea.of(np.array([[1.0, 2.0], [4.0, 3.0]]))
    np.testing.assert_allclose(two.slope_y, [[3.0, 1.0], [3.0, 1.0]])
    np.testing.assert_allclose(two.slope_x, [[1.0, 1.0], [-1.0, -1.0]])
    assert two.range_um == (-1.0, 6.0)
    summit = PixelArea.of(np.array([[1.0], [3.0], [2.0]]))
    np.testing.assert_allclose(summit.slope_y, [[2.0], [0.0], [-1.0]])
    mean = area.average(lambda t: t**3)
    exact = [[((t + 0.5 * s) ** 4 - (t - 0.5 * s) ** 4) / (4.0 * s) for t, s in ((1, 1), (2, 4 / 3), (4, 2))]]
    np.testing.assert_allclose(mean, exact, rtol=1e-12)


@pytest.mark.parametrize(("thickness", "first"), [(0.001, 0.0), (0.03, 0.018)])
def test_tables_begin_below_the_thinnest_layer(thickness: float, first: float) -> None:
    """By four steps, but not with less than no thickness."""
    table = E2V.table((thickness, thickness), [960.0])
    assert table.grid_um[0] == pytest.approx(first)
    direct = E2V.flat_field(thickness, 960.0)
    assert table.evaluate(0, np.array([thickness])) == pytest.approx(direct, rel=1e-5)
