"""The middleware under a real pipeline, in this process."""

from pathlib import Path

import pytest
from lsst.pipe.base import Pipeline
from lsst.pipe.base.simple_pipeline_executor import SimplePipelineExecutor
from toy_repository import PIPELINE, SENSORS, fill
from toy_task import HeaderTask

pytestmark = pytest.mark.middleware


def test_pipelines_build_without_a_repository() -> None:
    graph = Pipeline.from_uri(str(PIPELINE)).to_graph()
    assert list(graph.tasks) == ["toyHeader"]


def test_raw_frames_feed_a_pipeline(repo: Path, tmp_path: Path) -> None:
    fill(repo, tmp_path / "raw")
    butler = SimplePipelineExecutor.prep_butler(
        str(repo), inputs=["LSST-TS8/raw/all"], output="u/someone/run"
    )
    executor = SimplePipelineExecutor.from_task_class(
        HeaderTask, butler=butler, where="instrument='LSST-TS8' AND detector.raft='RTM-020'"
    )
    quanta = executor.run(register_dataset_types=True)
    assert len(quanta) == 2
    refs = butler.query_datasets("toyHeader", collections="u/someone/run")
    assert sorted(butler.get(ref)["serial"] for ref in refs) == list(SENSORS)
    assert {butler.get(ref)["wavelength_nm"] for ref in refs} == {960.03}
