"""The fringe correction inside a data release pipeline, and templates that are found by the time of an exposure.

Rubin's own tasks do not install from a package index. Stand-ins have the names, dimensions and storage classes of
their connections, as read in lsst/ip_isr d2a69bf, lsst/pipe_tasks 5b638a4, lsst/drp_tasks dc28b94 and lsst/drp_pipe
a5ef3ba.
"""

import sys
import types
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from lsst.pipe.base import Pipeline, PipelineGraph, PipelineTask, PipelineTaskConfig, PipelineTaskConnections
from lsst.pipe.base.connectionTypes import Input, Output

SNIPPET = Path(__file__).parents[2] / "doc" / "guide" / "drp_fringes.yaml"
EXPOSURE, VISIT = (("instrument", name, "detector") for name in ("exposure", "visit"))

DRP = """
description: Stand-in
instrument: lsst.fringe_sim.LsstCamFringe
tasks:
  isr:
    class: lsst.ip.isr.IsrTaskLSST
    config: {connections.outputExposure: post_isr_image}
  calibrateImage:
    class: lsst.pipe.tasks.calibrateImage.CalibrateImageTask
    config:
      connections.exposures: post_isr_image
      connections.background: preliminary_visit_image_background
  reprocessVisitImage:
    class: lsst.drp.tasks.reprocess_visit_image.ReprocessVisitImageTask
    config:
      connections.exposures: post_isr_image
      connections.background_1: preliminary_visit_image_background
  standardizeSingleVisitStar: &other {class: lsst.pipe.tasks.calibrateImage.OtherTask}
  analyzeAmpOffsetMetadata: *other
  analyzeAmpInterfaceOffsetMetadata: *other
  analyzeCalibrateImageMetadata: *other
  analyzeInitialSummaryStats: *other
subsets:
  step1a-single-visit-detectors:
    subset:
    - isr
    - calibrateImage
    - standardizeSingleVisitStar
    - analyzeAmpOffsetMetadata
    - analyzeAmpInterfaceOffsetMetadata
    - analyzeCalibrateImageMetadata
    - analyzeInitialSummaryStats
  step4a-measure-variability-visits:
    subset: [reprocessVisitImage]
steps:
  - {label: step1a-single-visit-detectors, dimensions: [visit, detector]}
  - {label: step4a-measure-variability-visits, dimensions: [visit]}
"""


def stand_in(name: str, dimensions: tuple[str, ...], **connections: Any) -> type[PipelineTask]:
    """A task with these connections that does nothing."""
    base: Any = types.new_class(
        f"{name}Connections",
        (PipelineTaskConnections,),
        {"dimensions": dimensions},
        lambda space: space.update(connections),
    )
    config = types.new_class(f"{name}Config", (PipelineTaskConfig,), {"pipelineConnections": base})
    return type(name, (PipelineTask,), {"ConfigClass": config, "_DefaultName": name})


@pytest.fixture
def drp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process in which Rubin's pipeline and its tasks can be found."""
    exposure = partial(dict, storageClass="Exposure", dimensions=EXPOSURE, doc="frame")
    background = partial(dict, storageClass="Background", dimensions=VISIT, doc="background")
    tasks = {
        "lsst.ip.isr": stand_in(
            "IsrTaskLSST", EXPOSURE, outputExposure=Output(**exposure(name="postISRCCD"))
        ),
        "lsst.pipe.tasks.calibrateImage": stand_in(
            "CalibrateImageTask",
            VISIT,
            exposures=Input(**exposure(name="postISRCCD", multiple=True)),
            background=Output(**background(name="initial_pvi_background")),
        ),
        "lsst.drp.tasks.reprocess_visit_image": stand_in(
            "ReprocessVisitImageTask",
            VISIT,
            exposures=Input(**exposure(name="postISRCCD", multiple=True)),
            background_1=Input(**background(name="initial_pvi_background")),
            exposure=Output(name="pvi", storageClass="ExposureF", dimensions=VISIT, doc="image"),
        ),
    }
    for name, task in tasks.items():
        parts = name.split(".")
        for depth in range(2, len(parts) + 1):
            package = ".".join(parts[:depth])
            if package not in ("lsst.pipe", name):
                monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        module = types.ModuleType(name)
        setattr(module, task.__name__, task)
        monkeypatch.setattr(task, "__module__", name)
        monkeypatch.setitem(sys.modules, name, module)
    other = stand_in("OtherTask", VISIT)
    monkeypatch.setattr(other, "__module__", "lsst.pipe.tasks.calibrateImage")
    monkeypatch.setattr(sys.modules["lsst.pipe.tasks.calibrateImage"], "OtherTask", other, raising=False)
    folder = tmp_path / "drp" / "pipelines" / "LSSTCam"
    folder.mkdir(parents=True)
    (folder / "DRP.yaml").write_text(DRP)
    monkeypatch.setenv("DRP_PIPE_DIR", str(tmp_path / "drp"))


def edges(graph: PipelineGraph) -> dict[str, set[tuple[str, str, bool]]]:
    """Tasks that write or read a dataset type, with the storage class that they name."""
    found: dict[str, set[tuple[str, str, bool]]] = {}
    for label, task in graph.tasks.items():
        for written, side in ((True, task.outputs), (False, task.inputs)):
            for edge in side.values():
                where = found.setdefault(edge.parent_dataset_type_name, set())
                where.add((label, edge.storage_class_name, written))
    return found


def test_the_correction_stands_between_isr_and_calibration(drp: None) -> None:
    graph = Pipeline.from_uri(str(SNIPPET)).to_graph()
    graph.resolve(dimensions=None, dataset_types={})
    found = edges(graph)
    assert found["post_isr_image"] == {("isr", "Exposure", True), ("fringeCorrection", "Exposure", False)}
    assert found["fringe_corrected_image"] == {
        ("fringeCorrection", "Exposure", True),
        ("calibrateImage", "Exposure", False),
        ("reprocessVisitImage", "Exposure", False),
    }
    (templates,) = graph.tasks["fringeCorrection"].prerequisite_inputs.values()
    assert (templates.parent_dataset_type_name, templates.is_calibration) == ("fringeTemplates", True)


def test_the_correction_joins_the_first_step(drp: None) -> None:
    first = "step1a-single-visit-detectors"
    ours = set(Pipeline.from_uri(f"{SNIPPET}#{first}").task_labels)
    theirs = set(Pipeline.from_uri(f"$DRP_PIPE_DIR/pipelines/LSSTCam/DRP.yaml#{first}").task_labels)
    assert ours == theirs | {"fringeCorrection"}
