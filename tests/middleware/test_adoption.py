"""One sensor, two data ids: what was measured on the stand is found in the camera by the serial number."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lsst.daf.butler import Butler, DatasetType
from product_makers import thickness

from lsst.fringe_sim.errors import InputError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.middleware.adoption import adopt_datasets

pytestmark = pytest.mark.middleware

ON_STAND, IN_CAMERA = 145, 37  # E2V-CCD250-321: RTM-020_S01, today R11_S01
NOT_IN_CAMERA = next(
    detector.id
    for detector in Camera.from_name("ts8").detectors
    if detector.serial not in {other.serial for other in Camera.from_name("lsstCam").detectors}
)


@pytest.fixture
def measured(butler: Butler) -> Butler:
    """Repository with the map of a sensor that the camera has, and of one that it has not."""
    kind = DatasetType(
        "epoxyThickness", ("instrument", "detector"), "ThicknessMap", universe=butler.dimensions
    )
    butler.registry.registerDatasetType(kind)
    butler.collections.register("lab")
    for number, detector in enumerate((ON_STAND, NOT_IN_CAMERA)):
        product = thickness(number=number)
        butler.put(product, kind, instrument="LSST-TS8", detector=detector, run="lab")
    return butler


def adopt(butler: Butler, **changes: Any) -> Any:
    arguments: dict[str, Any] = {
        "dataset_type": "epoxyThickness",
        "collections": ["lab"],
        "instrument": "LSSTCam",
        "run": "camera",
    }
    return adopt_datasets(butler, **(arguments | changes))


@pytest.mark.parametrize("transfer", ["hardlink", "copy", "direct"])
def test_the_map_is_the_same_under_both_data_ids(measured: Butler, transfer: str) -> None:
    report = adopt(measured, transfer=transfer)
    assert [ref.dataId["detector"] for ref in report.adopted] == [IN_CAMERA]
    own = measured.get("epoxyThickness", instrument="LSST-TS8", detector=ON_STAND, collections="lab")
    other = measured.get("epoxyThickness", instrument="LSSTCam", detector=IN_CAMERA, collections="camera")
    assert own.value.tobytes() == other.value.tobytes()
    assert own.metadata == other.metadata


def test_sensors_without_a_place_are_named(measured: Butler) -> None:
    name = Camera.from_name("ts8").detector(NOT_IN_CAMERA).name
    assert adopt(measured).homeless == (name,)


def test_again_changes_nothing_and_a_dry_run_stores_nothing(measured: Butler) -> None:
    assert len(adopt(measured, dry_run=True).adopted) == 1
    assert "camera" not in measured.collections.query("*")
    first = adopt(measured).adopted
    again = adopt(measured)
    assert (again.adopted, again.present) == ((), first)


def test_the_first_collection_wins_and_those_of_the_camera_stay(measured: Butler) -> None:
    """Datasets of the instrument itself, and of one that is not known here, are left alone."""
    measured.collections.register("newer")
    measured.registry.syncDimensionData("instrument", {"name": "Other", "class_name": "a.b"})
    stand = {"instrument": "Other", "id": ON_STAND, "full_name": "S01", "purpose": "SCIENCE"}
    measured.registry.syncDimensionData("detector", stand)
    newer = thickness(number=9)
    for instrument, detector in (("LSST-TS8", ON_STAND), ("LSSTCam", 94), ("Other", ON_STAND)):
        measured.put(newer, "epoxyThickness", instrument=instrument, detector=detector, run="newer")
    report = adopt(measured, collections=["newer", "lab"])
    assert [ref.dataId["detector"] for ref in report.adopted] == [IN_CAMERA]
    assert len(report.homeless) == 1
    other = measured.get("epoxyThickness", instrument="LSSTCam", detector=IN_CAMERA, collections="camera")
    assert other.value.tobytes() == newer.value.tobytes()


def test_a_condition_limits_what_is_adopted(measured: Butler) -> None:
    with pytest.raises(InputError, match="none of a sensor of LSSTCam"):
        adopt(measured, where=f"instrument = 'LSST-TS8' AND detector = {NOT_IN_CAMERA}")
    with pytest.raises(InputError, match="collections and condition"):
        adopt(measured, where="nonsense = 'x'")


def test_what_cannot_be_adopted_is_refused(measured: Butler) -> None:
    with pytest.raises(UnknownNameError, match="instrument"):
        adopt(measured, instrument="LSSTCamera")
    with pytest.raises(UnknownNameError, match="did you mean epoxyThickness"):
        adopt(measured, dataset_type="epoxyThicknes")
    kind = DatasetType(
        "fringeFlat", ("instrument", "exposure", "detector"), "FringeFlat", universe=measured.dimensions
    )
    measured.registry.registerDatasetType(kind)
    with pytest.raises(InputError, match="instrument and detector"):
        adopt(measured, dataset_type="fringeFlat")
    with pytest.raises(InputError):
        adopt(measured, collections=["nowhere"])


def test_the_command_says_what_it_did(measured: Butler, repo: Path, invoke: Callable[..., Any]) -> None:
    arguments = ("adopt-sensor-datasets", repo, "epoxyThickness", "lab", "LSSTCam", "camera")
    dry = invoke(*arguments, "--dry-run")
    assert (dry.exit_code, "1 datasets would be adopted into camera" in dry.output) == (0, True)
    done = invoke(*arguments)
    assert done.exit_code == 0, done.output
    assert "epoxyThickness LSSTCam 37" in done.output
    assert "1 datasets adopted into camera; 0 were there already" in done.output
    refused = invoke("adopt-sensor-datasets", repo, "epoxyThickness", "lab", "LSSTCamera", "camera")
    assert refused.exit_code == 1
    assert "did you mean LSSTCam" in refused.output
