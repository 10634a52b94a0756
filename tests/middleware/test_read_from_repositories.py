"""What commands read from a repository: flats to be searched, products of the demo, provenance."""

import datetime
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lsst.daf.butler import Butler, DatasetProvenance, DatasetType
from product_makers import components, flat, frame, sky, thickness

from lsst.fringe_sim.cli.demo_report import DemoDatasets, dataset_path
from lsst.fringe_sim.cli.discover import _from_repository
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.middleware.night import NightPlan, define_night
from lsst.fringe_sim.model.provenance import input_cards

pytestmark = pytest.mark.middleware

DIMENSIONS = {
    "fringeFlat": ("FringeFlat", ("instrument", "exposure", "detector")),
    "skyFringe": ("SkyFringe", ("instrument", "exposure", "detector")),
    "epoxyThickness": ("ThicknessMap", ("instrument", "detector")),
    "fringe": ("FringeFrame", ("instrument", "detector", "physical_filter")),
    "fringeComponents": ("FringeComponents", ("instrument", "detector", "physical_filter")),
}


@pytest.fixture
def exposures(butler: Butler) -> list[int]:
    """Kinds of data, and three exposures."""
    for name, (product, dimensions) in DIMENSIONS.items():
        butler.registry.registerDatasetType(
            DatasetType(name, dimensions, product, universe=butler.dimensions)
        )
    for collection in ("u/a", "u/b"):
        butler.collections.register(collection)
    plan = NightPlan(datetime.date(2026, 11, 21), (20.0, 21.0, 22.0))
    return [record["id"] for record in define_night(butler, "LSSTCam", [plan])]


def put(butler: Butler, product: Any, name: str, collection: str, **place: Any) -> Any:
    return butler.put(product, name, instrument="LSSTCam", run=collection, **{"detector": 94, **place})


def test_flats_of_one_sensor(butler: Butler, exposures: list[int], repo: Path) -> None:
    """The latest run of an exposure counts; a sensor is chosen by its number or by its name."""
    for number, exposure in enumerate(exposures):
        made = flat(number=10 + number, wavelength_nm=900.0 + number, mask=np.zeros((3, 4), np.int32))
        put(butler, made, "fringeFlat", "u/a", exposure=exposure)
    later = flat(number=30, wavelength_nm=950.0, mask=np.zeros((3, 4), np.int32))
    put(butler, later, "fringeFlat", "u/b", exposure=exposures[0])
    cube = _from_repository(str(repo), "u/a,u/b", None)
    assert cube.wavelength_nm.tolist() == [901.0, 902.0, 950.0]
    assert _from_repository(str(repo), "u/a", "94").wavelength_nm.tolist() == [900.0, 901.0, 902.0]
    put(butler, flat(), "fringeFlat", "u/a", exposure=exposures[0], detector=37)
    with pytest.raises(InputError, match="LSSTCam 37 R11_S01, LSSTCam 94 R22_S11'; allowed: one"):
        _from_repository(str(repo), "u/a", None)
    assert _from_repository(str(repo), "u/a", "R11_S01").wavelength_nm.tolist() == [960.0]
    with pytest.raises(InputError, match="number or name of one of: LSSTCam 37 R11_S01, LSSTCam 94 R22_S11"):
        _from_repository(str(repo), "u/a", "R22_S12")
    with pytest.raises(InputError, match="one with fringeFlat datasets"):
        _from_repository(str(repo), "nowhere", None)


def test_products_of_a_demo(butler: Butler, exposures: list[int], repo: Path) -> None:
    for number, exposure in enumerate(reversed(exposures)):
        put(
            butler,
            flat(number=number + 1, wavelength_nm=900.0 + number),
            "fringeFlat",
            "u/a",
            exposure=exposure,
        )
        put(butler, sky(number=number + 1, hour=22.0 - number), "skyFringe", "u/b", exposure=exposure)
    put(butler, thickness(number=1), "epoxyThickness", "u/a")
    put(butler, thickness(number=2), "epoxyThickness", "u/b")
    put(butler, frame(), "fringe", "u/b", physical_filter="y_10")
    put(butler, components(), "fringeComponents", "u/b", physical_filter="y_10")
    found = DemoDatasets.read(repo, "u/a", "u/b", "u/b")
    assert found.cube.wavelength_nm.tolist() == [900.0, 901.0, 902.0]
    assert [each.hour for each in found.sky] == [20.0, 21.0, 22.0]
    np.testing.assert_array_equal(found.first_thickness.value, thickness(number=1).value)
    np.testing.assert_array_equal(found.thickness.value, thickness(number=2).value)
    assert found.thickness_path == dataset_path(repo, "epoxyThickness", "u/b")
    assert found.thickness_path != dataset_path(repo, "epoxyThickness", "u/a")
    assert found.template_path == dataset_path(repo, "fringe", "u/b")
    assert found.template_path.is_file()
    assert found.sky_folder in dataset_path(repo, "fringe", "u/b").parents[4].rglob("*")


def test_provenance_of_what_is_stored(
    butler: Butler, exposures: list[int], repo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "source.txt"
    source.write_text("a")
    flats = put(butler, flat(), "fringeFlat", "u/a", exposure=exposures[0])
    made = DatasetProvenance()
    made.add_input(flats)
    files = input_cards([source])
    put(butler, thickness(metadata=files), "epoxyThickness", "u/a", provenance=made)
    asked = ["provenance", str(repo), "--dataset-type", "epoxyThickness"]
    assert run([*asked, "--collections", "u/a", "--json"]) == 0
    (record,) = json.loads(capsys.readouterr().out)
    assert record["file"].startswith("epoxyThickness {instrument: 'LSSTCam', detector: 94} in u/a")
    place = {"instrument": "LSSTCam", "detector": 94, "exposure": exposures[0]}
    assert [item.get("data id") for item in record["inputs"]] == [str(place), None]
    assert [item.get("file") for item in record["inputs"]] == [None, "source.txt"]
    assert run([*asked, "--collections", "u/b"]) == 1
    assert "at least one epoxyThickness in u/b where all" in capsys.readouterr().err
