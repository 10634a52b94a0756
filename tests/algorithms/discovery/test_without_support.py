"""A search on a sensor that lacks the layer of the local effect."""

import shutil
from pathlib import Path

import numpy as np

from lsst.fringe_sim.algorithms.discovery import discover
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube

FOLDER = Path(__file__).resolve().parents[3] / "doc" / "tutorials" / "own_sensor" / "ccd290"


def test_a_step_of_the_thickness_is_no_failure_where_there_can_be_no_void(tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "ccd290")
    setup = Setup.from_file(tmp_path / "ccd290" / "flats.yaml")
    rng = np.random.default_rng(1)
    y, x = np.indices((64, 64))
    thickness_um = 40.0 + 0.1 * np.sin(x / 20.0) * np.cos(y / 15.0)
    thickness_um[20:32, 20:32] += 0.02
    response = FringeModel.from_setup(setup).response(thickness_um.ravel(), setup.wavelengths_nm)
    electrons = 5e4 * response.reshape(-1, 64, 64) / response.mean(axis=1)[:, np.newaxis, np.newaxis]
    cube = FringeCube.from_arrays(
        rng.poisson(electrons).astype(float),
        setup.wavelengths_nm,
        variance=electrons,
        temperature_k=173.15,
        bandwidth_fwhm_nm=1.0,
    )
    verdict = discover(cube, setup, rng=np.random.default_rng(1))
    assert verdict.verdict == "no_discrepancy"
    assert any("void" in note and "left out" in note for note in verdict.notes)
