"""Pipelines build without a repository, and refuse tasks that do not fit together."""

from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from lsst.pipe.base import Pipeline, PipelineGraph
from lsst.pipe.base.pipelineIR import ContractError
from lsst.utils import doImportType

from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.middleware import LsstCamFringe, Ts8Fringe
from lsst.fringe_sim.tasks import (
    EffectDiscoveryConfig,
    EpoxyFitConfig,
    FringeForecastConfig,
    IsrFlatPrepConfig,
    SkyFringeSimConfig,
)

PIPELINES = resources.files("lsst.fringe_sim") / "pipelines"
FILES = sorted(str(path.relative_to(Path(str(PIPELINES)))) for path in Path(str(PIPELINES)).rglob("*.yaml"))
TASKS: dict[str, Any] = {
    config.task_name: config
    for config in (
        *(EffectDiscoveryConfig, EpoxyFitConfig, FringeForecastConfig),
        *(IsrFlatPrepConfig, SkyFringeSimConfig),
    )
}
CONFIG = Path(str(resources.files("lsst.fringe_sim") / "config"))


def load(name: str) -> Pipeline:
    return Pipeline.from_uri(f"resource://lsst.fringe_sim/pipelines/{name}")


def configs(pipeline: Pipeline) -> dict[str, Any]:
    graph: PipelineGraph = pipeline.to_graph()
    return {label: task.config for label, task in graph.tasks.items()}


@pytest.mark.parametrize("name", FILES)
def test_every_pipeline_builds_and_validates(name: str) -> None:
    pipeline = load(name)
    for config in configs(pipeline).values():
        config.validate()
    for label in pipeline.task_labels:
        task = doImportType(str(pipeline.to_graph().tasks[label].task_class_name))
        assert task._DefaultName == label


@pytest.mark.parametrize("name", [name for name in FILES if not name.startswith("_ingredients")])
def test_pipelines_of_a_camera_name_its_instrument(name: str) -> None:
    instrument = doImportType(str(load(name).getInstrument()))
    assert instrument.camera_name == name.split("/")[0]


def test_dataset_types_and_dimensions_are_those_agreed() -> None:
    graphs = [load(f"lsstCam/{name}.yaml").to_graph() for name in ("fringe", "discovery", "skyDiscovery")]
    agreed = {
        "effectDiscovery": ("FringeJson", {"instrument", "detector"}),
        "effectOverride": ("ConfigOverride", {"instrument", "detector"}),
        "learnedOverride": ("ConfigOverride", {"instrument", "detector"}),
        "learnedEffect": ("ConfigOverride", {"instrument", "detector"}),
        "skyEffectDiscovery": ("FringeJson", {"instrument", "detector"}),
        "skyEffectOverride": ("ConfigOverride", {"instrument", "detector"}),
        "raw": ("RawFrame", {"instrument", "exposure", "detector"}),
        "fringeFlat": ("FringeFlat", {"instrument", "exposure", "detector"}),
        "epoxyThickness": ("ThicknessMap", {"instrument", "detector"}),
        "skyFringe": ("SkyFringe", {"instrument", "exposure", "detector"}),
        "fringe": ("FringeFrame", {"instrument", "physical_filter", "detector"}),
        "fringeComponents": ("FringeComponents", {"instrument", "physical_filter", "detector"}),
    }
    for task in (task for graph in graphs for task in graph.tasks.values()):
        for edge in (*task.inputs.values(), *task.outputs.values()):
            name = edge.parent_dataset_type_name
            if name in agreed:
                storage_class, dimensions = agreed.pop(name)
                assert edge.storage_class_name == storage_class
                assert set(edge.raw_dimensions) == dimensions
                assert edge.is_calibration == (name == "fringe")
    assert not agreed


@pytest.mark.parametrize(
    ("name", "label", "override", "message"),
    [
        (
            "ts8/discovery.yaml",
            "effectDiscovery",
            "config.connections.flats = 'other'",
            "flats that isrFlatPrep prepares",
        ),
        (
            "ts8/discovery.yaml",
            "effectDiscovery",
            "config.setup = 'bnl_ts8_e2v'",
            "in which they were prepared",
        ),
        ("ts8/discovery.yaml", "isrFlatPrep", "config.smoothing_sigma_px = 3.0", "neighbouring pixels"),
        (
            "ts8/discovery.yaml",
            "fringeBias",
            "config.connections.bias = 'other'",
            "the bias that fringeBias makes",
        ),
        ("ts8/labFlats.yaml", "isrFlatPrep", "config.overscan_method = 'spline'", "corrected alike"),
        (
            "ts8/labFlats.yaml",
            "fringeBias",
            "config.connections.bias = 'other'",
            "the bias that fringeBias makes",
        ),
        (
            "ts8/labFlats.yaml",
            "epoxyFit",
            "config.connections.flats = 'other'",
            "flats that isrFlatPrep prepares",
        ),
        ("ts8/labFlats.yaml", "epoxyFit", "config.setup = 'bnl_ts8_e2v'", "in which they were prepared"),
        ("lsstCam/fringe.yaml", "epoxyFit", "config.effects['bandwidth.fwhm'] = 2.4", "same effects"),
        (
            "lsstCam/fringe.yaml",
            "skyFringeSim",
            "config.rafts['R11'].effects['roughness.sigma'] = 9",
            "same effects",
        ),
        ("lsstCam/fringe.yaml", "skyFringeSim", "config.setup = 'lsst_itl'", "same stack"),
        (
            "lsstCam/fringe.yaml",
            "skyFringeSim",
            "config.connections.thickness = 'other'",
            "that epoxyFit fits",
        ),
        (
            "lsstCam/skyFringe.yaml",
            "fringePca",
            "config.connections.frames = 'other'",
            "that skyFringeSim makes",
        ),
    ],
)
def test_contracts_refuse_tasks_that_do_not_fit_together(
    name: str, label: str, override: str, message: str
) -> None:
    pipeline = load(name)
    if "rafts['R11']" in override:
        override = (
            f"from lsst.fringe_sim.tasks import RaftConfig\nconfig.rafts['R11'] = RaftConfig()\n{override}"
        )
    pipeline.addConfigPython(label, override)
    with pytest.raises(ContractError, match=message):
        configs(pipeline)


@pytest.mark.parametrize(
    "name", [name for name in FILES if not name.endswith(("Flats.yaml", "iscovery.yaml"))]
)
def test_templates_are_made_of_frames_without_noise(name: str) -> None:
    tasks = configs(load(name))
    if {"skyFringeSim", "fringePca"} <= set(tasks):
        assert not tasks["skyFringeSim"].noise
    assert SkyFringeSimConfig().noise


def test_one_override_file_reaches_fit_and_sky(tmp_path: Path) -> None:
    path = tmp_path / "effects.py"
    path.write_text("config.effects['roughness.sigma'] = 25.0\nconfig.effects['bandwidth.fwhm'] = 2.4\n")
    pipeline = load("lsstCam/fringe.yaml")
    for label in ("epoxyFit", "skyFringeSim"):
        pipeline.addConfigFile(label, str(path))
    made = configs(pipeline)
    assert made["epoxyFit"].choice("R11").applied_effects == {"roughness.sigma": 25.0, "bandwidth.fwhm": 2.4}
    assert made["skyFringeSim"].choice("R11").applied_effects == {"roughness.sigma": 25.0}


@pytest.mark.parametrize("camera", ["lsstCam", "ts8"])
def test_each_raft_is_fitted_with_the_stack_of_its_vendor(camera: str) -> None:
    made = configs(load(f"{camera}/labFlats.yaml")) | configs(load(f"{camera}/discovery.yaml"))
    for detector in Camera.from_name(camera).science:
        setup = {"e2v": "ts8_e2v", "ITL": "ts8_itl"}[detector.vendor]
        assert made["effectDiscovery"].choice(detector.raft).setup == setup
        assert made["epoxyFit"].choice(detector.raft).setup == setup
        assert made["isrFlatPrep"].setup_of(detector.raft).name == setup


@pytest.mark.parametrize(
    ("path", "instrument"), [("lsstCam/rafts/R11.py", LsstCamFringe), ("ts8/rafts/RTM-020.py", Ts8Fringe)]
)
def test_a_rafts_own_file_starts_from_that_of_its_camera(path: str, instrument: type) -> None:
    for config in (EpoxyFitConfig(), IsrFlatPrepConfig()):
        of_camera = type(config)()
        instrument().applyConfigOverrides(config.task_name, of_camera)
        config.load(str(CONFIG / path))
        assert not config.compare(of_camera, shortcut=False, output=lambda text: None)
        for field in ("setup", "raft_setups", "rafts"):
            own, cameras = (getattr(item, field, {}) for item in (config, of_camera))
            assert (own if field == "setup" else set(own)) == (cameras if field == "setup" else set(cameras))


@pytest.mark.parametrize(
    "label", ["isrFlatPrep", "epoxyFit", "skyFringeSim", "effectDiscovery", "fringeForecast"]
)
def test_the_instrument_tells_every_task_with_rafts_its_camera(label: str) -> None:
    for instrument in (LsstCamFringe, Ts8Fringe):
        config = TASKS[label]()
        instrument().applyConfigOverrides(label, config)
        assert config.camera == instrument.camera_name
        config.validate()
