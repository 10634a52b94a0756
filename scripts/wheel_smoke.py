"""A piece of the chain, run from an installed wheel outside the checkout; or what one of its extras is for.

usage: wheel_smoke.py [--extras | --extra NAME]
"""

from __future__ import annotations

import importlib
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import metadata
from pathlib import Path

import numpy as np

import lsst.fringe_sim
from lsst.fringe_sim.model import FringeModel, setup_names

BIN = Path(sys.executable).parent
CHECKOUT = Path(__file__).resolve().parents[1] / "python/lsst/fringe_sim"


def files_of(package: Path) -> set[str]:
    """Files of a package, relative to it."""
    found = (path.relative_to(package) for path in package.rglob("*") if path.is_file())
    return {path.as_posix() for path in found if "__pycache__" not in path.parts}


def run(*command: str) -> str:
    """Run a program of this environment and return what it prints."""
    done = subprocess.run([str(BIN / command[0]), *command[1:]], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} failed with {done.returncode}:\n{done.stdout}\n{done.stderr}")
    return done.stdout


def speclite() -> None:
    """A filter of speclite."""
    from lsst.fringe_sim.instrument.bandpass import Bandpass

    ours = Bandpass.from_name("lsst_y")
    theirs = Bandpass.from_speclite("lsst2023-y", (ours.wavelength_nm, ours.detector), ours.air)
    assert abs(theirs.transmission(1000.0) / ours.transmission(1000.0) - 1.0) < 0.1


def xarray() -> None:
    """A map as netCDF, which xarray reads."""
    from xarray import load_dataset

    from lsst.fringe_sim.products import ThicknessMap
    from lsst.fringe_sim.products.xarray_export import to_xarray, write_netcdf

    value = np.full((3, 4), 14.0, np.float32)
    thickness = ThicknessMap(value, value, value, 0.0 * value, np.zeros((3, 4), np.int32), layer="adhesive")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.nc"
        write_netcdf(to_xarray(thickness), path)
        assert np.array_equal(load_dataset(path)["thickness"], value)


def htcondor() -> None:
    """The service for bps, with the bindings of HTCondor."""
    importlib.import_module("lsst.fringe_sim.middleware.bps_htcondor")


def postgres() -> None:
    """The driver of the registry."""
    from sqlalchemy import create_engine

    create_engine("postgresql+psycopg2://nobody@localhost/nothing")  # imports the driver, connects to nothing


def lsst_images() -> None:
    """The reader of files of ``lsst.images``, which no release for Python 3.11 has."""
    if sys.version_info >= (3, 12):
        from lsst.images.serialization import open_archive

        assert callable(open_archive)


EXTRAS: dict[str, Callable[[], None]] = {
    each.__name__.replace("_", "-"): each for each in (speclite, xarray, htcondor, postgres, lsst_images)
}
FOR_DEVELOPERS = {"test", "docs", "bench"}
"""Extras that `make` installs into its own environment, where all tests run with them."""


def main() -> None:
    """Raise or exit with a message if anything that the wheel must carry is missing."""
    assert "site-packages" in lsst.fringe_sim.__file__, lsst.fringe_sim.__file__
    missing = files_of(CHECKOUT) - files_of(Path(lsst.fringe_sim.__file__).parent)
    assert not missing, f"the wheel lacks {sorted(missing)}"
    for name in setup_names():
        FringeModel.from_setup(name)
    response = FringeModel.from_setup("ts8_e2v").response(np.linspace(14.0, 15.0, 50), [960.0])
    assert response.shape == (1, 50)
    assert "ts8_e2v" in run("fringe-sim", "setups")
    run("fringe-sim", "mock-flats", "raws", "--size", "256x200", "--seed", "1")
    run("butler", "create", "repo", "--seed-config", "resource://lsst.fringe_sim/configs/butler.yaml")
    run("butler", "register-instrument", "repo", "lsst.fringe_sim.Ts8Fringe")
    run("butler", "ingest-fringe-raws", "repo", "raws")
    found = run("butler", "query-datasets", "repo", "raw")
    assert found.count("raw") > 12, found
    pipeline = "resource://lsst.fringe_sim/pipelines/lsstCam/fringe.yaml"
    run("pipetask", "build", "-p", pipeline, "--show", "tasks")
    print("The wheel runs.")


if __name__ == "__main__":
    if sys.argv[1:] == ["--extras"]:
        stated = set(metadata("lsst-fringe-sim").get_all("Provides-Extra") or ())
        assert stated == EXTRAS.keys() | FOR_DEVELOPERS, stated
        print("\n".join(EXTRAS))
    elif sys.argv[1:2] == ["--extra"]:
        EXTRAS[sys.argv[2]]()
    else:
        main()
