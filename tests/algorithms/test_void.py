"""A void in the adhesive, in every stage: flats, search, thickness, sky; against the mock's own optics."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_sky import foreign_map
from recorded_numbers import Record

from lsst.fringe_sim.algorithms import fit_thickness, simulate_sky_frame
from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.flat_residual import flat_residual
from lsst.fringe_sim.algorithms.thickness_fit.islands import fit_islands
from lsst.fringe_sim.challenge.sealed_cases import SealedCase, draw_case, expose
from lsst.fringe_sim.effects import EFFECTS, ImageGeometry
from lsst.fringe_sim.errors import UnknownNameError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import ThicknessMap
from lsst.fringe_sim.products.mask import mask_bits

(VOID,) = (effect for effect in EFFECTS if effect.name == "void")
PLACE = {"void.centre_x": 21.3, "void.centre_y": 13.8, "void.radius": 7.4}


def geometry(shape: tuple[int, int]) -> ImageGeometry:
    return ImageGeometry.of_pixels(shape, np.array([900.0, 960.0]))


def values(radius: float, x: float = 21.3, y: float = 13.8) -> dict[str, float]:
    return {"thickness": 100.0, "radius": radius, "centre_x": x, "centre_y": y}


@pytest.mark.parametrize("radius", [1.3, 4.6, 11.0])
def test_pixels_of_the_rim_have_the_part_of_their_area_that_is_inside(radius: float) -> None:
    fine = (np.arange(40 * 50) + 0.5) / 50.0 - 0.5
    inside = np.hypot(fine[:, np.newaxis] - 13.8, fine[np.newaxis, :] - 21.3) < radius
    true = inside.reshape(40, 50, 40, 50).mean(axis=(1, 3))
    part = VOID.coverage(values(radius), geometry((40, 40)))
    assert np.abs(part - true).max() < (0.06 if radius < 2.0 else 0.01)
    assert part.sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    assert part.min() == 0.0
    assert part.max() == 1.0


@pytest.mark.parametrize("radius", [4.6, 11.0])
def test_moments_are_those_of_what_is_covered(radius: float) -> None:
    point = (np.arange(50) + 0.5) / 50.0 - 0.5
    fine = np.add.outer(np.arange(40), point).ravel()
    inside = np.hypot(fine[:, np.newaxis] - 13.8, fine[np.newaxis, :] - 21.3) < radius
    parts, one, square = inside.reshape(40, 50, 40, 50) / 2500.0, np.ones(50), point**2
    weights = [(point, one), (one, point), (square, one), (point, point), (one, square)]
    true = np.stack([np.einsum("yaxb,a,b->yx", parts, *pair) for pair in weights])
    moments = VOID.coverage_moments(values(radius), geometry((40, 40)))
    assert np.all(np.abs(true).max(axis=(1, 2)) > 0.01)
    np.testing.assert_allclose(moments, true, atol=3e-3)


def test_the_rim_moves_smoothly() -> None:
    shape = geometry((40, 40))
    for step, key in ((1e-4, "radius"), (1e-4, "centre_x"), (1e-4, "centre_y")):
        one, two, three = (
            VOID.coverage({**values(7.4), key: values(7.4)[key] + step * k}, shape) for k in (0, 1, 2)
        )
        assert np.abs(two - one).max() > 0.0
        np.testing.assert_allclose(three - two, two - one, atol=1e-3 * step * 10.0)


def test_a_flat_has_the_gap_on_the_island_and_nowhere_else() -> None:
    thickness = np.linspace(14.0, 15.0, 30 * 40).reshape(30, 40)
    plain, gap, void = (
        FringeModel.from_setup("ts8_e2v", effects)
        for effects in (
            {}, {"air_gap.thickness": 130.0}, {"void.thickness": 130.0, **PLACE},
        )
    )  # fmt: skip
    wavelength = np.array([900.0, 960.0])
    where = geometry(thickness.shape)
    part = VOID.coverage(values(7.4), where)
    one, other = (model.response(thickness, wavelength) for model in (plain, gap))
    mixed = one + part * (other - one)
    np.testing.assert_allclose(
        void.flat_image(thickness, where), mixed / mixed.mean(axis=(1, 2), keepdims=True), rtol=1e-12
    )
    assert np.abs(other - one)[:, part == 1.0].max() > 0.01


def test_a_gap_everywhere_is_wider_on_the_island() -> None:
    thickness = np.linspace(14.0, 15.0, 30 * 40).reshape(30, 40)
    wavelength = np.array([900.0, 960.0])
    both = FringeModel.from_setup("ts8_e2v", {"air_gap.thickness": 50.0, "void.thickness": 80.0, **PLACE})
    ((_, inside),) = both.islands
    wider = FringeModel.from_setup("ts8_e2v", {"air_gap.thickness": 130.0})
    np.testing.assert_allclose(
        inside.response(thickness, wavelength), wider.response(thickness, wavelength), rtol=1e-9
    )


def test_pixels_on_a_void_are_fitted_with_the_optics_that_they_have(recorded: Record) -> None:
    """Also where the first fit is wrong by orders, by a phase and by noise; the rest of the map stays as it is."""
    rng, shape = np.random.default_rng(12), (26, 30)
    void = {"void.centre_x": 12.3, "void.centre_y": 11.8, "void.radius": 6.5, "void.thickness": 190.0}
    truth = foreign_map(rng, shape, 14.0, 14.6)
    cube, _ = expose(truth, void, rng)
    mask = np.array(cube.mask)
    mask[:3, 10:12, 12], mask[:, 13, 9] = mask_bits("BAD"), mask_bits("BAD")
    cube = replace(cube, mask=mask)
    model = FringeModel.from_setup("ts8_e2v", void)
    part = VOID.coverage({key.partition(".")[2]: x for key, x in void.items()}, geometry(shape))
    order = float(np.mean(model.fringe_order_um(cube.wavelength_nm)))
    wrong = truth + 0.004 * rng.standard_normal(shape) + (part > 0.5) * (2.0 * order + 0.06)
    wrong[3, 25] = np.nan
    flagged = np.where((part > 0.3) & (truth > 14.3), mask_bits("SUSPECT"), 0).astype(np.int32)
    flagged[3, 25] = mask_bits("NO_DATA")
    ones = np.ones(shape, np.float32)
    first = ThicknessMap(
        wrong.astype(np.float32), 0.01 * ones, ones, 0.0 * ones, flagged, "adhesive", {"MISFIT": 1.5}
    )
    found = fit_islands(first, cube, model)
    on = (part > 0.0) & (cube.mask == 0).any(axis=0)
    for name in ("value", "sigma", "chi2", "mask"):
        np.testing.assert_array_equal(getattr(found, name)[~on], getattr(first, name)[~on])
    assert np.median(np.abs(found.value - truth)[on]) < 0.004
    assert np.median(np.abs(found.value - truth)[on] / found.sigma[on]) < 1.2
    recorded({name: getattr(found, name) for name in ("value", "sigma", "chi2", "mask")})


def sealed(gap_nm: float, seed: int) -> SealedCase:
    """A case of the challenge with a void of about the wanted gap."""
    rng = np.random.default_rng(seed)
    while True:
        case = draw_case("one", rng, only=["void"])
        if 0.6 < case.values["void.thickness"] / gap_nm < 1.6:
            return case


@pytest.mark.slow
def test_its_thickness_is_that_of_the_sensor_once_it_is_known() -> None:
    """Without it the fit bends the thickness; with it pixels on the island are as good as others."""
    case = sealed(150.0, 5)
    plain = FringeModel.from_setup("ts8_e2v")
    known = plain.with_effects(case.values)
    part = VOID.coverage(
        {key.partition(".")[2]: value for key, value in case.values.items()},
        geometry(case.thickness_um.shape),
    )
    errors, misfits = [], []
    for model in (plain, known):
        fitted = fit_thickness(case.cube, model)
        error = np.abs(fitted.value - case.thickness_um)
        errors.append([float(np.nanmedian(error[where])) for where in (part == 1.0, part == 0.0)])
        residual = flat_residual(case.cube, model, fitted.value)
        misfits.append(float(np.nanstd(residual[:, part > 0.5])) / float(np.nanstd(residual[:, part == 0.0])))
    assert errors[0][0] > 5.0 * errors[0][1]
    assert errors[1][0] < 2.0 * errors[1][1]
    assert misfits[0] > 1.3
    assert misfits[1] < 1.25  # fringes of the gap are stronger, and the fit takes pixels as points


@pytest.mark.slow
def test_it_goes_along_to_the_sky() -> None:
    thickness = 15.0 + 0.3 * np.linspace(-1.0, 1.0, 30)[:, np.newaxis] * np.ones(40)
    plain, gap, void = (
        simulate_sky_frame(
            thickness, FringeModel.from_setup("lsst_e2v", effects), mean_electrons=1000.0
        ).image
        for effects in ({}, {"air_gap.thickness": 130.0}, {"void.thickness": 130.0, **PLACE})
    )
    part = VOID.coverage(values(7.4), geometry(thickness.shape))
    outside = void[part == 0.0] / plain[part == 0.0]
    inside = void[part == 1.0] / gap[part == 1.0]
    assert np.ptp(outside) < 1e-6
    assert np.ptp(inside) < 1e-6
    assert np.abs(void / plain - outside.mean())[part == 1.0].max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "gap_nm"), [(2, 205.0), (4, 22.5), (3, 13.0), (14, 11.8)])
def test_it_is_found_where_it_is(seed: int, gap_nm: float) -> None:
    """Strong ones and faint ones, in the right one of many sizes that look nearly alike.

    Beside a thickness of every cell a rim is known to 0.1 px at 22 nm; it goes on smoothly, and tells ten times more.
    The thickness takes the faintest one up, and no test sees a disagreement.
    """
    parts = np.random.default_rng([seed, 77]).spawn(2)
    case = draw_case("one", parts[0], only=["void"])
    assert case.values["void.thickness"] == pytest.approx(gap_nm, abs=1.0)
    verdict = discover(case.cube, case.setup, rng=parts[1])
    assert [effect.name for effect in verdict.effects] == ["void"], verdict.summary()
    for name, found in verdict.effects[0].parameters.items():
        assert abs(found.value - case.values[f"void.{name}"]) < 4.0 * found.sigma, name
        assert found.sigma < (1.0 if name == "thickness" else 0.05), name


def test_two_islands_of_one_effect_are_two_effects() -> None:
    """A catalogue may hold another local effect; each is where it is."""

    class Second(type(VOID)):  # type: ignore[misc]
        name = "second_void"

    catalogue = (VOID, Second())
    settings = {
        "void.thickness": 130.0, **PLACE,
        "second_void.thickness": 60.0, "second_void.centre_x": 8.0, "second_void.centre_y": 22.0,
        "second_void.radius": 4.0,
    }  # fmt: skip
    model = FringeModel.from_setup("ts8_e2v", settings, catalogue=catalogue)
    assert [item.effect.name for item, _ in model.islands] == ["void", "second_void"]
    thickness = np.full((30, 40), 15.0)
    image = model.flat_image(thickness, geometry(thickness.shape))
    assert len(np.unique(np.round(image[0][[13, 22, 0], [21, 8, 39]], 6))) == 3
    alone = replace(model, effects=model.effects[:1])
    assert len(alone.islands) == 1


def test_a_sensor_may_have_several_voids() -> None:
    """The second is called by its name and a number; effects of which there is one have no second."""
    settings = {"void.thickness": 130.0, **PLACE, "void_2.thickness": 60.0, "void_2.centre_x": 8.0,
                "void_2.centre_y": 22.0, "void_2.radius": 4.0}  # fmt: skip
    model = FringeModel.from_setup("ts8_e2v", settings)
    assert [item.effect.name for item, _ in model.islands] == ["void", "void_2"]
    assert model.effect_settings == settings
    image = model.flat_image(np.full((30, 40), 15.0), geometry((30, 40)))
    assert len(np.unique(np.round(image[0][[13, 22, 0], [21, 8, 39]], 6))) == 3
    for name in ("void_1.thickness", "void_x.thickness", "bandwidth_2.fwhm"):
        with pytest.raises(UnknownNameError, match=name.partition(".")[0]):
            FringeModel.from_setup("ts8_e2v", {name: 2.0})
