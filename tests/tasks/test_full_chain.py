"""From raw flats to certified templates in one graph of one camera."""

import datetime
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from lsst.daf.butler import Butler
from task_commands import Command

from lsst.fringe_sim.middleware.night import NightPlan, define_night
from lsst.fringe_sim.middleware.raw_ingest import ingest_raws
from lsst.fringe_sim.mock.raw_frames import MockRun
from lsst.fringe_sim.products import FringeFrame

pytestmark = [pytest.mark.middleware, pytest.mark.slow]

STAND_NAME, CAMERA_NAME = "RTM-020_S01", "R11_S01"
IN_CAMERA = 37
PIPELINES = "resource://lsst.fringe_sim/pipelines"


@pytest.fixture(scope="module")
def repo(empty_repo: Path, raws: dict[str, MockRun], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Repository with the flats of one sensor as if taken in the camera, and a night of three hours."""
    root = tmp_path_factory.mktemp("full")
    repo = Path(shutil.copytree(empty_repo, root / "repo"))
    frames = [*raws[STAND_NAME].bias[:2], *raws[STAND_NAME].flats]
    for number, frame in enumerate(frames):
        taken = root / "camera" / f"frame_{number}.fits"
        taken.parent.mkdir(exist_ok=True)
        shutil.copyfile(frame.path, taken)
        with fits.open(taken, mode="update") as hdus:
            hdus[0].header.update(INSTRUME="lsstCam", RAFTBAY="R11", CCDSLOT="S01", SEQNUM=number + 1)
            hdus[0].header.update(DAYOBS="20180724")
    with Butler.from_config(str(repo), writeable=True) as butler:
        assert not ingest_raws(butler, [str(root / "camera")], transfer="direct").refused
        define_night(butler, "LSSTCam", [NightPlan(datetime.date(2026, 1, 15), (19.0, 21.0, 23.0))])
    return repo


@pytest.fixture(scope="module")
def effects_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a search for effects leaves behind: one of the sensor, one of the lamp."""
    path = tmp_path_factory.mktemp("effects") / "effects.py"
    path.write_text("config.effects['roughness.sigma'] = 4.0\nconfig.effects['bandwidth.fwhm'] = 2.005\n")
    return path


def test_one_graph_from_raw_flats_to_certified_templates(
    command: Command, repo: Path, effects_file: Path
) -> None:
    overrides = [item for label in ("epoxyFit", "skyFringeSim") for item in ("-C", f"{label}:{effects_file}")]
    done = command(
        *("pipetask", "run", "-b", repo, "-i", "LSSTCam/raw/all", "-o", "u/one"),
        *("-p", f"{PIPELINES}/lsstCam/fringe.yaml", *overrides, "-c", "isrFlatPrep:edge_px=2"),
        *("-d", "instrument = 'LSSTCam' AND detector = 37", "-j", "1", "--register-dataset-types"),
    )
    assert done.code == 0, done.text
    begin_end = ("--begin-date", "2025-01-01", "--end-date", "2035-01-01")
    done = command("butler", "certify-calibrations", repo, "u/one", "u/calib", "fringe", *begin_end)
    assert done.code == 0, done.text
    with Butler.from_config(str(repo), collections=["u/calib", "u/one"], instrument="LSSTCam") as butler:
        exposures = sorted(ref.dataId["exposure"] for ref in butler.query_datasets("skyFringe"))
        assert len(exposures) == 3
        template = butler.get("fringe", detector=IN_CAMERA, physical_filter="y_10", exposure=exposures[0])
        components = butler.get("fringeComponents", detector=IN_CAMERA, physical_filter="y_10")
        thickness = butler.get("epoxyThickness", detector=IN_CAMERA)
        sky = butler.get("skyFringe", detector=IN_CAMERA, exposure=exposures[0])
    assert isinstance(template, FringeFrame)
    assert template.detector == CAMERA_NAME
    assert template.creation_datetime[:4] >= "2026"
    # The effect of the sensor is in fit, sky and template; that of the lamp in the fit alone.
    assert _effects(thickness.metadata) == {"roughness.sigma": 4.0, "bandwidth.fwhm": 2.005}
    for product in (sky, components, template):
        assert _effects(product.metadata) == {"roughness.sigma": 4.0}
    good = template.mask == 0
    pattern = sky.fraction()[good]
    assert np.corrcoef(template.image[good], pattern)[0, 1] > 0.99
    assert components.explained_variance_ratio[0] > 0.9
    assert components.metadata["NFRAMES"] == 3
    assert 0 < sky.quadrature_error < 1e-4


def test_fit_and_sky_must_be_told_the_same(command: Command, repo: Path, effects_file: Path) -> None:
    done = command(
        *("pipetask", "build", "-p", f"{PIPELINES}/lsstCam/fringe.yaml", "-C", f"epoxyFit:{effects_file}"),
        *("--show", "config"),
    )
    assert done.code != 0
    assert "give the same effects to epoxyFit and skyFringeSim" in done.text


def _effects(header: Any) -> dict[str, float]:
    numbers = [key.removeprefix("EFFECT") for key in header if key.startswith("EFFECT")]
    return {header[f"EFFECT{number}"]: header[f"EFFVAL{number}"] for number in numbers}
