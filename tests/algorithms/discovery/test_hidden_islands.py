"""Islands that a thickness has taken up, and thicknesses that step like islands."""

from types import SimpleNamespace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.basis import SplineBasis
from lsst.fringe_sim.algorithms.discovery.thickness_steps import best_thickness_step

from lsst.fringe_sim.algorithms.discovery import Verdict, discover
from lsst.fringe_sim.challenge.sealed_cases import expose
from lsst.fringe_sim.mock.thickness import random_field

SHAPE = (48, 60)


def smooth_fit(step_um: float, radius: float, *, seen: np.ndarray | None = None) -> SimpleNamespace:
    """State of a fit with a smooth field to data without noise of which the thickness steps on a disc."""
    rng = np.random.default_rng(11)
    slope = rng.uniform(50.0, 150.0, (5, *SHAPE)) * rng.choice([-1.0, 1.0], (5, *SHAPE))
    if seen is not None:
        slope = slope * seen
    y, x = np.indices(SHAPE)
    field = step_um * (np.hypot(y - 20.0, x - 33.0) <= radius)
    curvature = (slope**2).sum(axis=0)
    basis = SplineBasis.of_grid(SHAPE, 8.0)
    normal = basis.normal_matrix(curvature)
    taken = basis.expand(normal.solve(basis.gather((curvature * field)[np.newaxis]))[:, 0])
    design = SimpleNamespace(slope=slope, basis=basis, normal=normal)
    return SimpleNamespace(design=design, residual=slope * (field - taken))


@pytest.mark.parametrize("step_um", [0.007, -0.002])
def test_a_step_is_found_with_what_it_explains(step_um: float) -> None:
    radius = 2.0 * 1.2**9
    state = smooth_fit(step_um, radius)
    disc, step = best_thickness_step(state)  # type: ignore[arg-type]
    assert disc[1:] == pytest.approx((20.0, 33.0, radius))
    assert step == pytest.approx(step_um, rel=0.1)
    assert disc[0] == pytest.approx((state.residual**2).sum(), rel=0.1)


def test_cells_without_data_do_not_count() -> None:
    radius, seen = 2.0 * 1.2**9, np.ones(SHAPE)
    seen[:, 30] = 0.0
    state = smooth_fit(0.005, radius, seen=seen)
    disc, step = best_thickness_step(state)  # type: ignore[arg-type]
    assert disc[1:] == pytest.approx((20.0, 33.0, radius))
    assert step == pytest.approx(0.005, rel=0.1)


def searched(thickness: np.ndarray, rng: np.random.Generator) -> Verdict:
    cube, _ = expose(thickness, {}, rng)
    return discover(cube, "ts8_e2v", rng=np.random.default_rng(1))


@pytest.mark.slow
@pytest.mark.parametrize(("height_um", "width_px", "told"), [(0.012, 0.3, True), (0.02, 5.0, False)])
def test_a_thickness_that_steps_is_no_effect(height_um: float, width_px: float, told: bool) -> None:
    """An island of 12 nm more adhesive looks like a void, and the verdict says so; a hill does not."""
    rng = np.random.default_rng(5)
    y, x = np.indices((96, 96))
    away = np.hypot(y - 40.3, x - 55.2) - 12.0
    thickness = random_field((96, 96), rng, mean=15.0, span=2.0)
    verdict = searched(thickness + height_um / (1.0 + np.exp(away / width_px)), rng)
    assert verdict.verdict == "no_discrepancy", verdict.summary()
    assert any("steps on an island as void" in note for note in verdict.notes) == told, verdict.notes
