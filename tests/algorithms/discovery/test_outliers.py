"""Cells that something spoiled in one exposure."""

from dataclasses import replace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.algorithms.discovery.outliers import spoiled_cells
from lsst.fringe_sim.challenge.sealed_cases import SealedCase, draw_case

SHAPE = (12, 60, 70)


@pytest.fixture
def residual(rng: np.random.Generator) -> np.ndarray:
    """Noise, and a response of every cell that all exposures share."""
    return rng.normal(0.0, 0.01, SHAPE) + rng.normal(0.0, 0.02, SHAPE[1:])


@pytest.fixture
def used() -> np.ndarray:
    return np.ones(SHAPE, dtype=bool)


@pytest.mark.rng("a track is found as far as it goes")
def test_a_track_is_found_as_far_as_it_goes(residual, used) -> None:
    residual[4, 20, 30:40] += 0.15
    residual[4, 20, 40] += 0.045  # by itself within the noise of many cells
    expected = np.zeros(SHAPE, dtype=bool)
    expected[4, 20, 30:41] = True
    found = spoiled_cells(residual, used)
    assert (found & expected).sum() >= 10
    assert (found & ~expected).sum() <= 2


@pytest.mark.rng("noise and response are left alone")
def test_noise_and_response_are_left_alone(residual, used) -> None:
    residual[:, 10, 10] -= 0.5  # a dead cell is dead in every exposure
    assert not spoiled_cells(residual, used).any()


@pytest.mark.rng("a misfit is no accident")
def test_a_misfit_is_no_accident(residual, used) -> None:
    """Not where it is everywhere in one exposure, nor where it is in all exposures of a few cells."""
    y, x = np.indices(SHAPE[1:])
    residual[2] += 0.3 * np.cos(0.7 * x + 0.2 * y)
    residual[:, 40:43, 5:9] += 0.4 * np.cos(np.arange(12))[:, np.newaxis, np.newaxis]
    assert not spoiled_cells(residual, used).any()


@pytest.mark.rng("cells without data say nothing")
def test_cells_without_data_say_nothing(residual, used) -> None:
    used[:, :, :20] = False
    used[7] = False
    residual[~used] = np.nan
    residual[4, 30, 50] += 0.2
    found = spoiled_cells(residual, used)
    assert found[4, 30, 50]
    assert found.sum() <= 2


@pytest.mark.parametrize("waves", [3, 4, 5, 6, 12])
@pytest.mark.rng("however few exposures there are")
def test_however_few_exposures_there_are(waves: int, rng: np.random.Generator) -> None:
    """The median of three is one of them, and the spread about it says little: noise was taken for spoiled."""
    residual = rng.normal(0.0, 0.01, (waves, 160, 160)) + rng.normal(0.0, 0.02, (160, 160))
    residual[1, 80, 80:84] += 0.12
    found = spoiled_cells(residual, np.ones(residual.shape, dtype=bool))
    assert found[1, 80, 80:84].any()
    found[1, 77:88, 77:88] = False
    assert found.sum() <= 1


@pytest.mark.rng("two exposures cannot tell")
def test_two_exposures_cannot_tell(residual, used) -> None:
    residual[1, 5, 5] += 1.0
    assert not spoiled_cells(residual[:2], used[:2]).any()


def with_cosmic_rays(case: SealedCase, rng: np.random.Generator) -> SealedCase:
    """The case with two tracks or so in every exposure, as of an exposure of an hour."""
    image, variance = np.array(case.cube.image), np.array(case.cube.variance)
    for plane, noise in zip(image, variance, strict=True):
        for _ in range(rng.poisson(2.0)):
            y, x, angle = rng.uniform(0, 95), rng.uniform(0, 95), rng.uniform(0.0, 2.0 * np.pi)
            for step in range(rng.integers(1, 15)):
                row, column = int(y + step * np.sin(angle)), int(x + step * np.cos(angle))
                if 0 <= row < 96 and 0 <= column < 96:
                    charge = rng.uniform(500.0, 6000.0)
                    plane[row, column] += charge
                    noise[row, column] += charge
    return replace(case, cube=replace(case.cube, image=image, variance=variance))


@pytest.mark.slow
def test_cosmic_rays_are_no_discrepancy() -> None:
    rng = np.random.default_rng(41)
    case = with_cosmic_rays(draw_case("none", rng), rng)
    assert discover(case.cube, case.setup, rng=rng).verdict == "no_discrepancy"


@pytest.mark.slow
def test_cosmic_rays_are_no_discrepancy_with_a_known_thickness() -> None:
    rng = np.random.default_rng(43)
    case = with_cosmic_rays(draw_case("none", rng), rng)
    thickness = (case.thickness_um + 0.003 * rng.standard_normal((96, 96))).astype(np.float32)
    cube = replace(
        case.cube, thickness=thickness, thickness_sigma=np.full_like(thickness, 0.003), layer="epoxy"
    )
    assert discover(cube, case.setup, rng=rng).verdict == "no_discrepancy"


@pytest.mark.slow
def test_an_effect_is_named_behind_cosmic_rays() -> None:
    rng = np.random.default_rng(42)
    case = draw_case("one", rng, only=["tree_rings"])
    verdict = discover(with_cosmic_rays(case, rng).cube, case.setup, rng=rng)
    assert [effect.name for effect in verdict.effects] == ["tree_rings"]
