import os
import re
import subprocess
import sys
import types
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from lsst.ctrl.bps import BPS_DEFAULTS, BpsConfig, initialize
from lsst.ctrl.bps.parsl import ParslService
from lsst.ctrl.bps.parsl.site import SiteConfig
from lsst.daf.butler import Butler
from lsst.pipe.base import Pipeline
from lsst.resources import ResourcePath
from toy_repository import PIPELINE, SENSORS, fill

from lsst.fringe_sim.middleware import bps_environment
from lsst.fringe_sim.middleware.bps_service import FringeParslService, failed_jobs

pytestmark = pytest.mark.middleware

SITES = "resource://lsst.fringe_sim/bps"


def site_config(name: str) -> BpsConfig:
    config = BpsConfig(f"{SITES}/{name}.yaml", defaults=BPS_DEFAULTS)
    config[".bps_defined.operator"] = "someone"
    config[".bps_defined.timestamp"] = "20261121T000000Z"
    config[".bps_defined.uniqProcName"] = "run"
    return config


@pytest.fixture
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Changes of the environment, and of bps, end with the test."""
    for name in ("CTRL_MPEXEC_DIR", "DAF_BUTLER_DIR"):
        monkeypatch.setenv(name, "set for the test")
        monkeypatch.delenv(name)
    monkeypatch.setenv("PATH", os.environ["PATH"])
    monkeypatch.setattr(initialize, "shutil", initialize.shutil)


@pytest.fixture
def htcondor(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for the plug-in, which is not installed here."""
    from lsst.ctrl.bps import BaseWmsService

    module = types.ModuleType("lsst.ctrl.bps.htcondor")
    module.HTCondorService = type("HTCondorService", (BaseWmsService,), {})  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lsst.ctrl.bps.htcondor", module)
    # Both, so that what is imported with the stand-in ends with the test.
    monkeypatch.setitem(sys.modules, "lsst.fringe_sim.middleware.bps_htcondor", module)
    monkeypatch.delitem(sys.modules, "lsst.fringe_sim.middleware.bps_htcondor")


# Site files


@pytest.mark.parametrize("name", ["parsl_local", "parsl_slurm", "htcondor"])
def test_sites_share_what_they_have_in_common(name: str, clean_environment: None, htcondor: None) -> None:
    config = site_config(name)
    assert config["clusterAlgorithm"].endswith("dimension_clustering")
    assert config[".cluster.labOfOneSensor.dimensions"] == "detector"
    assert config[".finalJob.requestCpus"] == 1
    assert config["computeSite"] in config["site"]


def test_every_task_belongs_to_the_job_of_one_sensor(clean_environment: None) -> None:
    """Also of a pipeline that is added later: its labels must be put into a cluster."""
    cluster = site_config("parsl_local")["cluster"]
    clustered = {label.strip() for name in cluster for label in cluster[name]["pipetasks"].split(",")}
    root = ResourcePath("resource://lsst.fringe_sim/pipelines/", forceDirectory=True)
    files = list(ResourcePath.findFileResources([root], r"\.yaml$"))
    assert files
    for file in files:
        labels = set(yaml.safe_load(file.read()).get("tasks", {}))
        assert labels <= clustered, f"{file} has tasks that no cluster of bps/_common.yaml names"


@pytest.fixture
def executor_calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What Parsl's executors are made with; a real one would start to listen."""
    calls: list[dict[str, Any]] = []

    def executor(label: str, **kwargs: Any) -> Any:
        calls.append({"label": label, **kwargs})
        return types.SimpleNamespace(label=label)

    for site in ("local", "slurm"):
        monkeypatch.setattr(f"lsst.ctrl.bps.parsl.sites.{site}.HighThroughputExecutor", executor)
    monkeypatch.setattr("lsst.ctrl.bps.parsl.site.address_by_hostname", lambda: "127.0.0.1")
    return calls


@pytest.mark.usefixtures("clean_environment")
def test_parsl_takes_the_configuration_of_one_machine(executor_calls: list[dict[str, Any]]) -> None:
    site = SiteConfig.from_config(site_config("parsl_local"))
    assert [executor.label for executor in site.get_executors()] == ["local"]
    assert executor_calls[0]["max_workers_per_node"] == 2


@pytest.mark.usefixtures("clean_environment")
def test_parsl_takes_the_configuration_of_a_cluster(executor_calls: list[dict[str, Any]]) -> None:
    SiteConfig.from_config(site_config("parsl_slurm")).get_executors()
    provider = executor_calls[0]["provider"]
    assert (provider.nodes_per_block, provider.cores_per_node, provider.walltime) == (1, 32, "04:00:00")
    assert provider.mem_per_node == 128


def test_a_file_of_ones_own_includes_a_site_and_changes_it(tmp_path: Path, clean_environment: None) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(f"includeConfigs:\n  - {SITES}/parsl_local.yaml\nsite:\n  local:\n    cores: 7\n")
    config = BpsConfig(str(own), defaults=BPS_DEFAULTS)
    assert config[".site.local.cores"] == 7
    assert config[".site.local.class"].endswith("Local")
    assert config["wmsServiceClass"].endswith("FringeParslService")


# Where the programs are


@pytest.mark.usefixtures("clean_environment")
def test_programs_beside_this_python_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/usr/bin")
    monkeypatch.setenv("DAF_BUTLER_DIR", "/somewhere/else")
    bps_environment.point_to_this_environment()
    bps_environment.point_to_this_environment()
    assert os.environ["PATH"] == f"{Path(sys.executable).parent}{os.pathsep}/usr/bin"
    assert (Path(os.environ["CTRL_MPEXEC_DIR"]) / "bin" / "pipetask").exists()
    assert os.environ["DAF_BUTLER_DIR"] == "/somewhere/else"


@pytest.mark.usefixtures("clean_environment")
def test_configuration_inside_a_package_is_copied(tmp_path: Path) -> None:
    bps_environment.accept_resources()
    bps_environment.accept_resources()
    initialize.shutil.copy2(f"{SITES}/parsl_local.yaml", tmp_path)  # type: ignore[attr-defined]
    copied = (tmp_path / "parsl_local.yaml").read_bytes()
    assert copied == ResourcePath(f"{SITES}/parsl_local.yaml").read()
    initialize.shutil.copy2(tmp_path / "parsl_local.yaml", tmp_path / "again.yaml")  # type: ignore[attr-defined]
    assert (tmp_path / "again.yaml").read_bytes() == copied


@pytest.mark.usefixtures("clean_environment", "htcondor")
def test_htcondor_finds_the_programs_too() -> None:
    from lsst.fringe_sim.middleware.bps_htcondor import FringeHTCondorService

    FringeHTCondorService({})
    assert os.environ["CTRL_MPEXEC_DIR"] == sys.prefix


# Failed jobs


def workflow_of(*outcomes: Exception | None) -> Any:
    jobs: dict[str, Any] = {"pipetaskInit": types.SimpleNamespace(future=None)}
    for number, outcome in enumerate(outcomes):
        future: Future[int] = Future()
        if outcome is None:
            future.set_result(0)
        else:
            future.set_exception(outcome)
        jobs[f"job{number}"] = types.SimpleNamespace(future=future)
    return types.SimpleNamespace(jobs=jobs, path="submit/run")


@pytest.mark.usefixtures("clean_environment")
def test_failed_jobs_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ParslService, "submit", lambda self, workflow, **kwargs: None)
    service = FringeParslService({})
    service.submit(workflow_of(None, None))
    assert failed_jobs(workflow_of(None, RuntimeError())) == ["job1"]
    with pytest.raises(
        click.ClickException, match=r"2 of 3 jobs failed: job0, job2; their logs are in submit"
    ):
        service.submit(workflow_of(RuntimeError(), None, ValueError()))
    with pytest.raises(click.ClickException, match="job7 …"):
        service.submit(workflow_of(*[RuntimeError()] * 9))


def submit(folder: Path, repo: Path, *options: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k not in {"CTRL_MPEXEC_DIR", "DAF_BUTLER_DIR"}}
    environment["PYTHONPATH"] = str(Path(__file__).parents[1] / "helpers")
    bps = Path(sys.executable).with_name("bps")
    command = [bps, "submit", f"{SITES}/parsl_local.yaml", "-b", repo, "-i", "LSST-TS8/raw/all"]
    return subprocess.run(
        [*map(str, command), "-o", "u/someone/bps", *options],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_workflow_of_which_one_part_fails(repo: Path, tmp_path: Path) -> None:
    """One machine, two sensors, one of which fails: the other goes on, its results are kept, the shell is told."""
    fill(repo, tmp_path / "raw")
    assert Pipeline.from_uri(str(PIPELINE)).task_labels == {"toyHeader"}
    pipeline = tmp_path / "pipeline.yaml"
    pipeline.write_text(PIPELINE.read_text() + f"    config: {{refused: {SENSORS[0]}}}\n")
    result = submit(tmp_path, repo, "-p", str(pipeline))
    assert result.returncode == 1
    assert re.search("Error: 1 of 2 jobs failed: .*toyHeader.*201807241028453", result.stderr), result.stderr
    with Butler.from_config(str(repo)) as butler:
        refs = butler.query_datasets("toyHeader", collections="u/someone/bps", explain=False)
        assert [butler.get(ref)["serial"] for ref in refs] == [SENSORS[1]]
