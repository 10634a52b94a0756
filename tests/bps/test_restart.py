"""A workflow of which one job is killed, and restarted: by the real commands of bps, with Parsl."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from lsst.daf.butler import Butler, Config, DatasetRef
from toy_repository import PIPELINE, SENSORS, fill

from lsst.fringe_sim.middleware import Ts8Fringe

pytestmark = [pytest.mark.middleware, pytest.mark.slow]

OUT = "u/someone/bps"


@pytest.fixture
def repo(tmp_path: Path) -> Path:
    root = tmp_path / "repo"
    Butler.makeRepo(str(root), config=Config("resource://lsst.fringe_sim/configs/butler.yaml"))
    with Butler.from_config(str(root), writeable=True) as butler:
        Ts8Fringe().register(butler.registry)
    fill(root, tmp_path / "raw")
    return root


def bps(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k not in {"CTRL_MPEXEC_DIR", "DAF_BUTLER_DIR"}}
    environment["PYTHONPATH"] = str(Path(__file__).parents[1] / "helpers")
    environment["PWD"] = str(folder)  # there bps makes its submit directory
    environment["BPS_WMS_SERVICE_CLASS"] = "lsst.fringe_sim.middleware.bps_service.FringeParslService"
    return subprocess.run(
        [str(Path(sys.executable).with_name("bps")), *map(str, arguments)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def stored(repo: Path) -> dict[str, DatasetRef]:
    """What is there, by the serial number of the sensor; what was stored twice would be there twice."""
    with Butler.from_config(str(repo)) as butler:
        refs = butler.query_datasets("toyHeader", collections="*", find_first=False, explain=False)
        found = {butler.get(ref)["serial"]: ref for ref in refs}
        assert len(found) == len(refs)
        return found


def test_only_the_killed_job_runs_again(repo: Path, tmp_path: Path) -> None:
    trouble = tmp_path / "trouble"
    trouble.touch()
    pipeline = tmp_path / "pipeline.yaml"
    killed = f"    config: {{killed: {SENSORS[0]}, killed_while: '{trouble}'}}\n"
    pipeline.write_text(PIPELINE.read_text() + killed)
    site = "resource://lsst.fringe_sim/bps/parsl_local.yaml"
    submitted = bps(tmp_path, "submit", site, "-b", repo, "-i", "LSST-TS8/raw/all", "-o", OUT, "-p", pipeline)
    assert submitted.returncode == 1, submitted.stderr
    assert re.search("Error: 1 of 2 jobs failed: .*toyHeader", submitted.stderr), submitted.stderr
    before = stored(repo)
    assert set(before) == {SENSORS[1]}
    (folder,) = (tmp_path / "submit" / OUT).iterdir()

    again = bps(tmp_path, "restart", "--id", folder)
    assert again.returncode == 1, again.stderr
    assert "1 of 2 jobs failed" in again.stderr
    assert stored(repo) == before

    trouble.unlink()
    done = bps(tmp_path, "restart", "--id", folder)
    assert done.returncode == 0, done.stderr
    after = stored(repo)
    assert set(after) == set(SENSORS)
    assert after[SENSORS[1]] == before[SENSORS[1]]
    # All of it in the run that was submitted, and nothing was begun a second time for the sensor that was done.
    assert {ref.run for ref in after.values()} == {before[SENSORS[1]].run}
