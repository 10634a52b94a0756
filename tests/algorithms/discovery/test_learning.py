"""What no effect explains is learned, judged by other cells, and noise teaches nothing."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.learning import Prior
from lsst.fringe_sim.algorithms.discovery.skeleton import effect_skeleton
from lsst.fringe_sim.effects import (
    EFFECTS,
    LEARNED,
    ImageGeometry,
    activate_effects,
    apply_to_image,
    effects_from,
)
from lsst.fringe_sim.model import FringeModel

LEAST = 6.0


@pytest.mark.rng("marginal likelihood")
def test_evidence_is_that_of_gaussians(rng: np.random.Generator) -> None:
    """Against the density of the data with the correction in their covariance, at the size that was chosen."""
    columns, data = rng.standard_normal((12, 4)), rng.standard_normal(12) * 3.0
    root = rng.standard_normal((4, 3))
    prior = Prior.of("any", root, columns.T @ columns)
    (evidence,), size = prior.best((columns.T @ data)[np.newaxis])
    covariance = np.eye(12) + size[0] ** 2 * columns @ root @ root.T @ columns.T
    known = -0.5 * data @ np.linalg.solve(covariance, data) - 0.5 * np.linalg.slogdet(covariance)[1]
    assert evidence == pytest.approx(known + 0.5 * data @ data)
    expected = size[0] ** 2 * root @ root.T @ columns.T @ np.linalg.solve(covariance, data)
    assert prior.parameters((columns.T @ data)[np.newaxis], size)[0] == pytest.approx(expected)


@pytest.mark.parametrize("name", ["learned_response", "learned_map"])
def test_the_beginning_of_an_effect_does_what_was_learned(name: str, tmp_path: Path) -> None:
    key = "map.y1x2" if name == "learned_map" else "response.cos1_960"
    own = {f"learned_{key}": 0.01}
    if name == "learned_response":
        own = {f"{name}.{wave}{h}_960": 0.01 / h for wave in ("cos", "sin") for h in (1, 2, 3)}
    path = tmp_path / "learned_effect.py"
    verdict = SimpleNamespace(setup="ts8_e2v", learned={"name": name, "own": own})
    path.write_text(effect_skeleton(verdict))
    thickness = np.linspace(14.0, 14.5, 9)
    geometry = ImageGeometry.of_pixels((8, 8), np.array([960.0]))
    with effects_from(path) as (unnamed,):
        catalogue = (*EFFECTS, *LEARNED, unnamed)
        found, wanted, none = (
            FringeModel.from_setup("ts8_e2v", settings, catalogue=catalogue)
            for settings in ({"unnamed.size": 1.0}, own, {"unnamed.size": 0.0})
        )
        told = [model.response(thickness, [960.0]) for model in (found, wanted, none)]
        images = [
            apply_to_image(activate_effects(each, catalogue), found.base_system, np.ones((1, 8, 8)), geometry)
            for each in ({"unnamed.size": 1.0}, own)
        ]
    assert np.array_equal(told[0], told[1])
    assert np.array_equal(images[0], images[1])
    changed = np.ptp(images[0]) if name == "learned_map" else np.abs(told[0] - told[2]).max()
    assert changed > 1e-3
