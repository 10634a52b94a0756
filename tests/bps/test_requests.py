"""What the shipped site files ask a cluster for, beside what was measured, and the plan of a whole focal plane."""

import datetime
import os
from pathlib import Path
from typing import Any

import pytest
import yaml
from lsst.ctrl.bps import BPS_DEFAULTS, BpsConfig, initialize
from lsst.ctrl.bps.drivers import transform_driver
from lsst.daf.butler import Butler, Config
from lsst.resources import ResourcePath

from lsst.fringe_sim.algorithms.cost_model import QUANTUM_COSTS, FocalPlaneCost
from lsst.fringe_sim.middleware import LsstCamFringe
from lsst.fringe_sim.middleware.night import NightPlan, define_night, parse_hours

COMMON = "resource://lsst.fringe_sim/bps/_common.yaml"
MIB = 2**20
OWN = """\
includeConfigs: [resource://lsst.fringe_sim/bps/parsl_local.yaml]
pipelineYaml: resource://lsst.fringe_sim/pipelines/lsstCam/focalPlane.yaml
payload:
  butlerConfig: {repo}
  inCollection: LSSTCam/raw/all
  output: u/plan
  dataQuery: instrument='LSSTCam'
"""

SCIENCE_SENSORS, HOURS = 189, 11


def requests() -> dict[str, dict[str, int]]:
    return dict(yaml.safe_load(ResourcePath(COMMON).read())["pipetask"])


def labels() -> set[str]:
    """Tasks of all shipped pipelines."""
    root = ResourcePath("resource://lsst.fringe_sim/pipelines/", forceDirectory=True)
    return {
        label
        for file in ResourcePath.findFileResources([root], r"\.yaml$")
        for label in yaml.safe_load(file.read()).get("tasks", {})
    }


def test_every_task_declares_memory_and_time() -> None:
    assert set(requests()) == labels() == set(QUANTUM_COSTS)
    for asked in requests().values():
        assert set(asked) == {"requestMemory", "requestWalltime"}


@pytest.mark.parametrize("label", sorted(QUANTUM_COSTS))
def test_requests_leave_room_and_waste_little(label: str) -> None:
    cost, asked = QUANTUM_COSTS[label], requests()[label]
    assert 1.15 * cost.peak_bytes <= asked["requestMemory"] * MIB <= max(3.0 * cost.peak_bytes, 2048 * MIB)
    # A slow node, a busy file system, the start of a process; no quantum can ask for less than a minute.
    assert asked["requestWalltime"] * 60 >= max(4.0 * cost.processor_s, 60)
    assert asked["requestWalltime"] * 60 <= max(20.0 * cost.processor_s, 120)


@pytest.mark.slow
@pytest.mark.middleware
def test_the_whole_focal_plane_is_planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """189 sensors and 11 hours, up to the jobs as they would be submitted; nothing runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PWD", str(tmp_path))
    repo = str(tmp_path / "repo")
    Butler.makeRepo(repo, config=Config("resource://lsst.fringe_sim/configs/butler.yaml"))
    with Butler.from_config(repo, writeable=True) as butler:
        LsstCamFringe().register(butler.registry)
        plan = NightPlan(datetime.date(2026, 1, 15), parse_hours("19:29"))
        assert len(define_night(butler, "LSSTCam", [plan])) == HOURS
    for name in ("CTRL_MPEXEC_DIR", "DAF_BUTLER_DIR"):
        monkeypatch.setenv(name, "set for the test")
        monkeypatch.delenv(name)
    monkeypatch.setenv("PATH", os.environ["PATH"])
    monkeypatch.setattr(initialize, "shutil", initialize.shutil)
    from lsst.fringe_sim.middleware.bps_environment import accept_resources, point_to_this_environment

    point_to_this_environment()
    accept_resources()
    own = tmp_path / "own.yaml"
    own.write_text(OWN.format(repo=repo))
    _, workflow = transform_driver(str(own), runWmsSubmissionChecks=False)
    jobs = [workflow.get_job(name) for name in workflow if name != "pipetaskInit"]
    by_label: dict[str, list[Any]] = {}
    for job in jobs:
        by_label.setdefault(job.label, []).append(job)
    cost = FocalPlaneCost(SCIENCE_SENSORS, HOURS)
    assert {label: len(found) for label, found in by_label.items()} == {
        "skyOfOneSensor": SCIENCE_SENSORS,
        "forecastOfOneSensor": SCIENCE_SENSORS,
        "focalPlane": 1,
    }
    assert len(jobs) == cost.jobs
    asked = requests()
    sky, pca = asked["skyFringeSim"], asked["fringePca"]
    for job in by_label["skyOfOneSensor"]:
        assert job.request_memory == max(sky["requestMemory"], pca["requestMemory"])
        assert job.request_walltime == HOURS * sky["requestWalltime"] + pca["requestWalltime"]
    assert sum(sum(job.quanta_counts.values()) for job in jobs) == cost.quanta


def test_the_site_files_see_the_requests() -> None:
    config = BpsConfig("resource://lsst.fringe_sim/bps/parsl_local.yaml", defaults=BPS_DEFAULTS)
    for label, asked in requests().items():
        for name, value in asked.items():
            assert config.search(name, opt={"curvals": {"curr_pipetask": label}}) == (True, value)
