"""The tasks that make templates of observed frames and correct them: alone, and by the real programs."""

import dataclasses
import datetime
import shutil
import types
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lsst.daf.butler import Butler
from lsst.pipe.base import Pipeline
from observed_night import ObservedNight, observed_night
from task_commands import Command

from lsst.fringe_sim.algorithms.correction import AMPLIFIERS_UNKNOWN, AmplifierGrid
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.middleware import MonoCamFringe
from lsst.fringe_sim.middleware.afw import observed_from_exposure
from lsst.fringe_sim.middleware.night import NightPlan, define_night
from lsst.fringe_sim.products import MASK_PLANES, FringeTemplates, ObservedFrame
from lsst.fringe_sim.tasks import (
    FringeCorrectionConfig,
    FringeCorrectionTask,
    ObservedFringeConfig,
    ObservedFringeTask,
)

NOW = "2026-11-21T03:43:40"
PIPELINES = "resource://lsst.fringe_sim/pipelines"


@pytest.mark.parametrize("camera", ["lsstCam", "hsc", "monocam"])
def test_pipelines_leave_the_amplifiers_to_the_frame(camera: str) -> None:
    """Names of amplifiers would free their levels, which then take of the fringes what the default leaves to them."""
    graph = Pipeline.from_uri(f"{PIPELINES}/{camera}/fringeCorrection.yaml").to_graph()
    assert {each.config.grid for each in graph.tasks.values()} == {AMPLIFIERS_UNKNOWN}


def test_amplifiers_of_one_row_or_column_need_one_number() -> None:
    for given, grid in (
        ({}, AMPLIFIERS_UNKNOWN),
        ({"amplifier_columns": 8}, AmplifierGrid(1, 8)),
        ({"amplifier_rows": 2}, AmplifierGrid(2, 1)),
        ({"amplifier_rows": 2, "amplifier_columns": 8}, AmplifierGrid(2, 8)),
    ):
        assert ObservedFringeConfig(**given).grid == grid


def frame_of(image: np.ndarray) -> ObservedFrame:
    return ObservedFrame(image, np.zeros(image.shape, dtype=np.int32), unit="electron", detector="S11")


@pytest.fixture(scope="module")
def night() -> ObservedNight:
    return observed_night(np.random.default_rng(8), 5, side=72, stars=4)


@pytest.fixture(scope="module")
def templates(night: ObservedNight) -> FringeTemplates:
    task = ObservedFringeTask(config=ObservedFringeConfig(components=1, amplifier_columns=2))
    made = task.run([partial(frame_of, image) for image in night.images[:4]], NOW)
    product: FringeTemplates = made.templates
    return product


def test_templates_say_what_they_are_made_of(templates: FringeTemplates) -> None:
    assert templates.detector == "S11"
    assert templates.creation_datetime == NOW
    assert templates.metadata["NFRAMES"] == 4
    assert "CFGHASH" in templates.metadata


def test_a_frame_is_corrected_once(
    night: ObservedNight, templates: FringeTemplates, caplog: pytest.LogCaptureFixture
) -> None:
    task = FringeCorrectionTask(config=FringeCorrectionConfig(amplifier_columns=2))
    made = task.run(frame_of(night.images[4]), templates, "frame 4")
    assert list(made.summary["name"]) == ["frame 4"]
    assert made.summary["structure_after"][0] < 0.6 * made.summary["structure_before"][0]
    assert made.corrected.metadata["FRINGCOR"] == 1
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    with pytest.raises(InputError, match="FRINGCOR"):
        task.run(made.corrected, templates)


class Mask:
    """A mask of afw, with planes in places of its own."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def getMaskPlaneDict(self) -> dict[str, int]:
        return {"SAT": 1, "SUSPECT": 20, "SPIKE": 25}

    def getPlaneBitMask(self, name: str) -> int:
        return 1 << self.getMaskPlaneDict()[name]


def exposure_of(image: np.ndarray) -> Any:
    """As much of afw's exposure as the task touches; its last pixel is in a plane that only afw knows."""
    mask = np.zeros(image.shape, dtype=np.int32)
    mask[-1, -1] = 1 << 25
    header = {"OBSID": "MC_O_20260115_000001", "LSST ISR UNITS": "electron"}
    return types.SimpleNamespace(
        image=types.SimpleNamespace(array=image.copy()),
        mask=Mask(mask),
        variance=types.SimpleNamespace(array=np.maximum(image, 1)),
        getMetadata=lambda: header,
        getDetector=lambda: types.SimpleNamespace(getName=lambda: "S11"),
        getFilter=lambda: None,
    )


def test_an_exposure_stays_one(night: ObservedNight, templates: FringeTemplates) -> None:
    """Pixels, mask and header change as those of a frame would; a second correction is refused."""
    image = night.images[4]
    unseen = templates.mask.copy()
    unseen[10, 20] = 1 << MASK_PLANES["NO_DATA"]
    known = dataclasses.replace(templates, mask=unseen)
    task = FringeCorrectionTask(
        config=FringeCorrectionConfig(amplifier_columns=2, frame_storage_class="Exposure")
    )
    given = exposure_of(image)
    assert observed_from_exposure(given).detector == "S11"
    made = task.run(given, known)
    assert made.corrected is given
    assert list(made.summary["unit"]) == ["electron"]
    fringes = night.fringes[4] - night.fringes[4].mean()
    assert np.corrcoef((image - given.image.array).ravel(), fringes.ravel())[0, 1] > 0.8
    assert given.image.array[10, 20] == image[10, 20]
    assert given.mask.array[10, 20] == 1 << 20
    assert given.mask.array[-1, -1] == 1 << 25
    assert given.getMetadata()["OBSID"] == "MC_O_20260115_000001"
    assert given.getMetadata()["FRINGCOR"] == 1
    assert {type(value) for value in given.getMetadata().values()} <= {bool, int, float, str}
    with pytest.raises(InputError, match="FRINGCOR"):
        task.run(given, known)


@pytest.mark.middleware
@pytest.mark.slow
def test_a_simulated_night_through_the_pipelines(command: Command, empty_repo: Path, tmp_path: Path) -> None:
    """Frames with noise from one pipeline, templates and corrected frames from the other."""
    repo = Path(shutil.copytree(empty_repo, tmp_path / "repo"))
    with Butler.from_config(str(repo), writeable=True) as butler:
        MonoCamFringe().register(butler.registry)
        hours = (19.0, 20.0, 21.0, 22.0, 23.0)
        define_night(butler, "MonoCam", [NightPlan(datetime.date(2026, 1, 15), hours)])
    common = (
        "pipetask",
        "run",
        "-b",
        repo,
        "--register-dataset-types",
        "-j",
        "1",
        "-d",
        "instrument = 'MonoCam'",
    )
    pipeline = f"{PIPELINES}/monocam/skyFringe.yaml#skyFringeSim"
    done = command(
        *(*common, "-i", "MonoCam/raw/all", "-o", "u/sky", "-p", pipeline),
        *("-c", "skyFringeSim:stand_in_shape=[160, 120]", "-c", "skyFringeSim:noise=True"),
    )
    assert done.code == 0, done.text
    done = command(
        *(*common, "-i", "u/sky", "-o", "u/clean", "-p", f"{PIPELINES}/monocam/fringeCorrection.yaml"),
        *("-c", "observedFringe:connections.frames=skyFringe", "-c", "observedFringe:components=1"),
        *("-c", "fringeCorrection:connections.frame=skyFringe"),
    )
    assert done.code == 0, done.text
    # Templates of the thickness that made the frames, in place of those of the frames themselves.
    done = command(
        *(*common, "-i", "MonoCam/raw/all", "-o", "u/map", "-p", f"{PIPELINES}/monocam/mapTemplates.yaml"),
        *("-c", "mapTemplates:stand_in_shape=[160, 120]"),
    )
    assert done.code == 0, done.text
    done = command(
        *(*common, "-i", "u/map,u/sky", "-o", "u/of_map"),
        *("-p", f"{PIPELINES}/monocam/fringeCorrection.yaml#correction"),
        *("-c", "fringeCorrection:connections.frame=skyFringe"),
    )
    assert done.code == 0, done.text
    for collection, count in (("u/clean", 1), ("u/of_map", 2)):
        with Butler.from_config(str(repo), collections=[collection], instrument="MonoCam") as butler:
            rows = [butler.get(ref) for ref in butler.query_datasets("fringeCorrectionSummary")]
            frames = [butler.get(ref) for ref in butler.query_datasets("fringeCorrected")]
        assert len(rows) == len(frames) == 5
        before, after = (
            np.array([row[f"structure_{when}"][0] for row in rows]) for when in ("before", "after")
        )
        # So few pixels of so smooth a stand-in hold little of a fringe that no background takes.
        assert after.mean() < before.mean()
        assert (after < before + 0.05).all()
        assert all(frame.metadata["FRINGCOR"] == count for frame in frames)
