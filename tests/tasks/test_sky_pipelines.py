"""The sky pipelines of every camera, run by the real programs on small sensors."""

import datetime
import shutil
from pathlib import Path

import numpy as np
import pytest
from lsst.daf.butler import Butler
from task_commands import Command

from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.middleware import HscFringe, LsstCamFringe, MonoCamFringe
from lsst.fringe_sim.middleware.night import NightPlan, define_night

pytestmark = [pytest.mark.middleware, pytest.mark.slow]

PIPELINES = "resource://lsst.fringe_sim/pipelines"
NIGHT = [NightPlan(datetime.date(2026, 1, 15), (19.0, 24.0))]


@pytest.fixture(scope="module")
def repo(empty_repo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Repository with a night of each telescope."""
    repo = Path(shutil.copytree(empty_repo, tmp_path_factory.mktemp("sky") / "repo"))
    with Butler.from_config(str(repo), writeable=True) as butler:
        for instrument in (MonoCamFringe, HscFringe):
            instrument().register(butler.registry)
        for instrument in (LsstCamFringe, MonoCamFringe, HscFringe):
            define_night(butler, instrument.getName(), NIGHT)
    return repo


@pytest.mark.parametrize(
    ("camera", "least", "most"), [("monocam", 0.005, 0.02), ("hsc", 0.002, 0.006)], ids=["monocam", "hsc"]
)
def test_sky_of_the_smaller_cameras(
    command: Command, repo: Path, camera: str, least: float, most: float
) -> None:
    """Half peak-to-peak as in Table 2 of the paper: about 1.5 % with MonoCam, 0.2 to 0.6 % with HSC."""
    instrument = {"monocam": "MonoCam", "hsc": "HSC"}[camera]
    done = command(
        *("pipetask", "run", "-b", repo, "-i", f"{instrument}/raw/all", "-o", f"u/{camera}"),
        *("--register-dataset-types", "-j", "1"),
        *("-p", f"{PIPELINES}/{camera}/skyFringe.yaml", "-d", f"instrument = '{instrument}'"),
        *("-c", "skyFringeSim:stand_in_shape=[160, 120]"),
    )
    assert done.code == 0, done.text
    with Butler.from_config(str(repo), collections=[f"u/{camera}"], instrument=instrument) as butler:
        refs = sorted(butler.query_datasets("skyFringe"), key=lambda ref: ref.dataId["exposure"])
        frames = [butler.get(ref) for ref in refs]
        (template,) = (butler.get(ref) for ref in butler.query_datasets("fringe", find_first=False))
    assert len(frames) == 2
    assert all(frame.metadata["STANDIN"] and frame.shape == (160, 120) for frame in frames)
    assert least < frames[0].metadata["FRINGPTP"] < most
    assert np.corrcoef(template.image.ravel(), frames[0].fraction().ravel())[0, 1] > 0.99


def test_focal_plane_of_the_lsst_camera(command: Command, repo: Path) -> None:
    """Forecast and frames of an e2v sensor, which has no map, from one graph; guide sensors are left out."""
    guider = next(d for d in Camera.from_name("lsstCam").detectors if d.kind == "guider")
    done = command(
        *("pipetask", "run", "-b", repo, "-i", "LSSTCam/raw/all", "-o", "u/plane"),
        *("--register-dataset-types", "-j", "1"),
        *("-p", f"{PIPELINES}/lsstCam/focalPlane.yaml"),
        *("-d", f"instrument = 'LSSTCam' AND detector IN (94, {guider.id})"),
        *("-c", "skyFringeSim:stand_in_shape=[200, 204]", "-c", "fringeForecast:stand_in_shape=[801, 819]"),
        *("-c", "fringeForecast:nights=1"),
    )
    assert done.code == 0, done.text
    with Butler.from_config(str(repo), collections=["u/plane"], instrument="LSSTCam") as butler:
        assert {ref.dataId["detector"] for ref in butler.query_datasets("fringeForecast")} == {94}
        cells = butler.get("fringeForecast", detector=94)
        summary = butler.get("focalPlaneForecast")
        frames = [butler.get(ref) for ref in butler.query_datasets("skyFringe")]
    assert len(cells) == 64
    assert cells["rms"].unit == "%"
    assert list(summary["detector"]) == ["R22_S11"]
    assert bool(summary["stand_in"][0])
    assert len(frames) == 2
    assert all(frame.metadata["BEAMS"] == "pixel" for frame in frames)
    # The same stand-in and the same beams: the strength of the frames is that of the forecast.
    strength = 100.0 * float(np.mean([frame.metadata["FRINGRMS"] for frame in frames]))
    assert strength == pytest.approx(float(summary["rms"][0]), rel=0.25)
