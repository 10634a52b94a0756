"""The order of a whole sensor whose light and contrast are free, from a few hundred cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.thickness_fit import make_templates
from lsst.fringe_sim.algorithms.thickness_fit.common_order import rank_orders
from lsst.fringe_sim.algorithms.thickness_fit.learning import learn
from lsst.fringe_sim.algorithms.thickness_fit.learning_cells import LearningCells
from lsst.fringe_sim.algorithms.thickness_fit.nuisances import NuisanceFit, Nuisances, light_patterns
from lsst.fringe_sim.algorithms.thickness_fit.templates import FlatTemplates, pad_wavelengths
from lsst.fringe_sim.model import FringeModel

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
SHAPE, CELLS, CONTRAST = (64, 256), 150, 0.7
LIGHT = np.linspace(-0.02, 0.03, WAVELENGTHS.size)
OFF_NM = np.where(np.arange(WAVELENGTHS.size) == 4, 0.8, 0.0)
FREE = {
    "light": Nuisances(level=True, illumination_degree=1, contrast="common"),
    "contrast": Nuisances(contrast="common"),
    "contrasts": Nuisances(level=True, contrast="wavelength"),
    "halves": Nuisances(zones="halves", contrast="fixed"),
    "wavelengths": Nuisances(level=True, contrast="common", wavelength_accuracy_nm=0.5),
    "all": Nuisances.automatic(wavelength_accuracy_nm=0.5),
}


@pytest.fixture(scope="module")
def templates() -> FlatTemplates:
    made = make_templates(FringeModel.from_setup("ts8_e2v"), WAVELENGTHS, (11.5, 17.5))
    return made.normalised_to(np.linspace(14.0, 14.9, 1001))


def cells_of(
    templates: FlatTemplates, free: Nuisances, noise: float, moved: float = 0.0, off_nm: float = 0.0
) -> tuple[LearningCells, np.ndarray]:
    """Cells on light that rises along the columns, some orders away from their thickness, and that thickness."""
    rng = np.random.default_rng(4)
    truth = rng.uniform(14.0, 14.9, CELLS)
    y, x = rng.uniform(0, SHAPE[0] - 1, CELLS), rng.uniform(0, SHAPE[1] - 1, CELLS)
    seen = np.stack([
        templates.amplitude_at(truth + templates.turn_um(truth[:, None])[:, k] * off_nm * OFF_NM[k])[k]
        for k in range(WAVELENGTHS.size)
    ], axis=1)  # fmt: skip
    light = np.exp(LIGHT * (2.0 * x[:, None] / (SHAPE[1] - 1) - 1.0)) if free.illumination_degree else 1.0
    value = light * (1.0 + CONTRAST * seen) - 1.0 + noise * rng.standard_normal(seen.shape)
    pattern, zones = light_patterns(free, SHAPE, y, x)
    order = templates.order_um()
    parts = (pad_wavelengths(part) for part in (value, np.full(value.shape, noise**-2.0)))
    start = (truth + moved * order).astype(np.float32)
    return LearningCells(*parts, start, pattern, zones, 1.0, order), truth


def beginning(cells: LearningCells) -> NuisanceFit:
    return NuisanceFit.none(WAVELENGTHS.size, cells.pattern.shape[1])


@pytest.mark.parametrize("moved", [-1, 0, 3])
def test_the_order_is_found_from_orders_away(templates: FlatTemplates, moved: int) -> None:
    """Noise is so large that orders beside the right one are not excluded by far."""
    free = FREE["light"]
    cells, truth = cells_of(templates, free, 0.05, moved)
    found = rank_orders(cells, templates, free, beginning(cells), cells.order_um, (11.6, 17.4))
    assert found.shift == -moved
    there = replace(cells, thickness_um=truth.astype(np.float32))
    thickness, right = learn(there, templates, free, beginning(there))
    assert found.fit.chi2 == pytest.approx(right.chi2, rel=3e-3)
    assert np.abs(thickness - truth).mean() < 0.3 * cells.order_um
    assert found.fit.contrast == pytest.approx(CONTRAST, abs=5.0 * found.fit.contrast_sigma.max())
    beside = [
        learn(
            replace(there, thickness_um=there.thickness_um + np.float32(side * cells.order_um)),
            templates,
            free,
            right,
        )[1]
        for side in (-1.0, 1.0)
    ]
    assert found.margin == pytest.approx(min(one.cost() for one in beside) - right.cost(), rel=0.1)
    assert 0.0 < found.slip < 0.5


def test_the_chance_of_another_order_is_that_of_its_margin(templates: FlatTemplates) -> None:
    """Noise is so large that hardly more than the next best order could be the right one."""
    free = FREE["light"]
    cells, _ = cells_of(templates, free, 0.12)
    found = rank_orders(cells, templates, free, beginning(cells), cells.order_um, (11.6, 17.4))
    odds = np.exp(-0.5 * found.margin)
    assert odds > 0.2
    assert odds / (1.0 + odds) <= found.slip < 2.0 * odds / (1.0 + 2.0 * odds)


def test_an_order_beyond_the_thicknesses_that_are_possible_is_not_taken(templates: FlatTemplates) -> None:
    free = FREE["light"]
    cells, truth = cells_of(templates, free, 0.05, 1)
    order = cells.order_um
    for lowest, shift in ((truth.min() - 0.5 * order, -1.0), (truth.min() + 0.5 * order, 0.0)):
        found = rank_orders(cells, templates, free, beginning(cells), order, (lowest, 17.4))
        assert found.shift == shift


@pytest.mark.parametrize("free", FREE.values(), ids=FREE)
def test_what_cells_teach_is_as_recorded(templates: FlatTemplates, free: Nuisances, recorded: Record) -> None:
    off = float(free.wavelength_accuracy_nm > 0.0)
    cells, truth = cells_of(templates, free, 0.01, off_nm=off)
    thickness, fit = learn(cells, templates, free, beginning(cells), final=True)
    if free.contrast != "fixed":
        assert np.abs(thickness - truth).max() < 0.05 * cells.order_um
        assert np.all(np.abs(fit.contrast - CONTRAST) < 5.0 * fit.contrast_sigma + 0.01)
    if off:
        assert fit.shift_nm == pytest.approx(OFF_NM, abs=0.2)
    recorded({"thickness": thickness, "fit": fit})
