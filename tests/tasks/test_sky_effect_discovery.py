"""An effect hidden in frames of the sky, found by the real programs and put back by the override that is stored."""

import datetime
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from lsst.daf.butler import Butler, DatasetType
from task_commands import Command

from lsst.fringe_sim.algorithms.discovery import Verdict
from lsst.fringe_sim.middleware import MonoCamFringe
from lsst.fringe_sim.middleware.night import NightPlan, define_night
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.products import ThicknessMap
from lsst.fringe_sim.tasks import SkyEffectDiscoveryConfig, SkyFringeSimConfig

pytestmark = [pytest.mark.middleware, pytest.mark.slow]

PIPELINES = "resource://lsst.fringe_sim/pipelines/monocam"
SHAPE = (320, 384)
HIDDEN = 0.5


@pytest.fixture(scope="module")
def repo(empty_repo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Repository with a night of MonoCam and the map of its sensor."""
    repo = Path(shutil.copytree(empty_repo, tmp_path_factory.mktemp("sky_search") / "repo"))
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    print("seed of the map", seed)
    value = random_field(SHAPE, np.random.default_rng(seed), mean=14.0, span=2.5).astype(np.float32)
    nothing = np.zeros(SHAPE, np.float32)
    layer = ThicknessMap(
        value, np.full(SHAPE, 0.002, np.float32), nothing, nothing, np.zeros(SHAPE, np.int32), "adhesive"
    )
    with Butler.from_config(str(repo), writeable=True) as butler:
        MonoCamFringe().register(butler.registry)
        define_night(butler, "MonoCam", [NightPlan(datetime.date(2026, 1, 15), (19.0, 20.0, 21.0))])
    with Butler.from_config(str(repo), writeable=True, run="u/map", instrument="MonoCam") as butler:
        kind = DatasetType(
            "epoxyThickness", ("instrument", "detector"), "ThicknessMap", universe=butler.dimensions
        )
        butler.registry.registerDatasetType(kind)
        butler.put(layer, kind, detector=0)
    return repo


def pipetask(command: Command, repo: Path, inputs: str, out: str, pipeline: str, *extra: object) -> None:
    done = command(
        *("pipetask", "run", "-b", repo, "-i", inputs, "-o", out, "--register-dataset-types", "-j", "1"),
        *("-p", f"{PIPELINES}/{pipeline}", "-d", "instrument = 'MonoCam'", *extra),
    )
    assert done.code == 0, done.text


@pytest.fixture(scope="module")
def searched(command: Command, repo: Path) -> Path:
    """The repository with frames in which fringes are weaker than the set-up says, and a search in them."""
    pipetask(
        *(command, repo, "MonoCam/raw/all,u/map", "u/sky", "skyFringe.yaml#skyFringeSim"),
        *("-c", "skyFringeSim:stand_in=False", "-c", "skyFringeSim:noise=True"),
        *("-c", f"skyFringeSim:effects={{'contrast_loss.factor': {HIDDEN}}}"),
    )
    pipetask(command, repo, "u/sky", "u/found", "skyDiscovery.yaml")
    return repo


def test_the_hidden_effect_is_named(searched: Path, tmp_path: Path) -> None:
    with Butler.from_config(str(searched), collections="u/found", instrument="MonoCam") as butler:
        content = butler.get("skyEffectDiscovery", detector=0)
        override = butler.get("skyEffectOverride", detector=0)
    verdict = Verdict.from_json(json.dumps(content))
    assert verdict.verdict == "named", json.dumps(content)[:2000]
    (found,) = verdict.effects
    assert "contrast_loss" in (found.name, *found.ambiguous_with)
    assert content["provenance"]["SETUP"] == "monocam"
    (tmp_path / "found.py").write_text(override, encoding="utf-8")
    config = SkyFringeSimConfig()
    config.load(str(tmp_path / "found.py"))
    assert dict(config.effects) == verdict.settings
    if found.name == "contrast_loss":
        value = found.parameters["factor"]
        assert abs(value.value - HIDDEN) < 5.0 * value.sigma


def test_a_search_needs_a_map() -> None:
    config = SkyEffectDiscoveryConfig()
    config.validate()
    config.stand_in = True
    with pytest.raises(ValueError, match="needs the map"):
        config.validate()
