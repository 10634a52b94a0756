from __future__ import annotations

import dataclasses
import json
import sys
import types
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from lsst.daf.butler import Butler, DatasetProvenance, DatasetRef, DatasetType, StorageClassFactory
from product_makers import MAKERS
from raw_frame_maker import write_raw

import lsst.fringe_sim.products as products
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.raw_frame import RawFrame, read_raw_metadata
from lsst.fringe_sim.middleware import formatters, register_storage_classes
from lsst.fringe_sim.middleware.afw import frame_from_exposure
from lsst.fringe_sim.middleware.raw_ingest import ingest_raws

pytestmark = pytest.mark.middleware

PRODUCTS = sorted(name for name in products.__all__ if hasattr(getattr(products, name), "write_fits"))
RUN = "u/someone/run"


def put(butler: Butler, product: Any, name: str, storage_class: str, **kwargs: Any) -> DatasetRef:
    dataset_type = DatasetType(
        name, ("instrument", "detector"), storage_class, universe=butler.dimensions, **kwargs
    )
    butler.registry.registerDatasetType(dataset_type)
    butler.collections.register(RUN)
    return butler.put(product, dataset_type, instrument="LSSTCam", detector=37, run=RUN)


def assert_same(left: Any, right: Any) -> None:
    for field in dataclasses.fields(left):
        a, b = getattr(left, field.name), getattr(right, field.name)
        if dataclasses.is_dataclass(a):
            assert_same(a, b)
        elif isinstance(a, np.ndarray):
            assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        elif field.name != "metadata":
            assert a == b


def test_every_product_has_a_maker_and_a_storage_class() -> None:
    assert set(PRODUCTS) == set(MAKERS)
    assert set(PRODUCTS) <= set(register_storage_classes())


@pytest.mark.parametrize("name", PRODUCTS)
def test_products_come_back_as_they_were(butler: Butler, name: str) -> None:
    product = MAKERS[name]()
    ref = put(butler, product, "thing", name)
    stored = butler.get(ref)
    assert type(stored) is type(product)
    assert_same(product, stored)
    assert butler.getURI(ref).getExtension() == ".fits"


def test_storage_classes_are_known_without_a_repository() -> None:
    for name in register_storage_classes():
        assert StorageClassFactory().getStorageClass(name).pytype is not None


def provenance_of(butler: Butler, product: Any, inputs: list[DatasetRef]) -> Any:
    """Header of a product that was stored with the given inputs."""
    provenance = DatasetProvenance(quantum_id=uuid.uuid4())
    for ref in inputs:
        provenance.add_input(ref)
    dataset_type = DatasetType("made", ("instrument",), type(product).__name__, universe=butler.dimensions)
    butler.registry.registerDatasetType(dataset_type)
    ref = butler.put(product, dataset_type, instrument="LSSTCam", run=RUN, provenance=provenance)
    return fits.getheader(butler.getURI(ref).ospath)


def test_inputs_are_named_in_the_header(butler: Butler) -> None:
    first = put(butler, MAKERS["FringeFlat"](), "first", "FringeFlat")
    product = dataclasses.replace(MAKERS["ThicknessMap"](), metadata={"SETUP": "ts8_e2v"})
    header = provenance_of(butler, product, [first])
    assert header["SETUP"] == "ts8_e2v"
    assert header["LSST BUTLER N_INPUTS"] == 1
    assert header["LSST BUTLER INPUT 0 ID"] == str(first.id)
    assert header["LSST BUTLER INPUT 0 DATASETTYPE"] == "first"
    assert header["LSST BUTLER RUN"] == RUN
    assert header["LSST BUTLER DATAID INSTRUMENT"] == "LSSTCam"


def test_provenance_of_a_copy_is_its_own(butler: Butler) -> None:
    """What a product was read with does not pass for what the next one was made from."""
    inputs = [put(butler, MAKERS["FringeFlat"](), f"input{i}", "FringeFlat") for i in range(3)]
    provenance = DatasetProvenance()
    for ref in inputs:
        provenance.add_input(ref)
    dataset_type = DatasetType("first", ("instrument",), "ThicknessMap", universe=butler.dimensions)
    butler.registry.registerDatasetType(dataset_type)
    ref = butler.put(
        MAKERS["ThicknessMap"](), dataset_type, instrument="LSSTCam", run=RUN, provenance=provenance
    )
    header = provenance_of(butler, butler.get(ref), [ref])
    assert header["LSST BUTLER N_INPUTS"] == 1
    assert header["LSST BUTLER INPUT 0 ID"] == str(ref.id)
    assert not [keyword for keyword in header if keyword.startswith("LSST BUTLER INPUT 1")]


def test_long_names_of_runs_fit_into_a_header(butler: Butler) -> None:
    run = "u/someone/" + "a_rather_long_name_of_a_run/" * 6 + "20261121T000000Z"
    butler.collections.register(run)
    dataset_type = DatasetType("thing", ("instrument",), "ThicknessMap", universe=butler.dimensions)
    butler.registry.registerDatasetType(dataset_type)
    ref = butler.put(MAKERS["ThicknessMap"](), dataset_type, instrument="LSSTCam", run=run)
    assert run.startswith(fits.getheader(butler.getURI(ref).ospath)["LSST BUTLER RUN"])
    assert butler.get(ref).layer == "epoxy"


def test_a_thousand_inputs_are_counted_and_more_are_not_listed(butler: Butler) -> None:
    dataset_type = DatasetType("many", ("instrument",), "FringeFlat", universe=butler.dimensions)
    ref = DatasetRef(dataset_type, butler.registry.expandDataId(instrument="LSSTCam"), run=RUN)
    butler.collections.register(RUN)
    refs = [ref.replace(id=uuid.uuid4()) for _ in range(1001)]
    header = provenance_of(butler, MAKERS["FringeComponents"](), refs)
    assert header["LSST BUTLER N_INPUTS"] == 1001
    assert "LSST BUTLER INPUT 0 ID" not in header


# Raw frames


def test_raw_frames_and_their_metadata_alone(butler: Butler, tmp_path: Path) -> None:
    path = write_raw(tmp_path / "raw.fits")
    (ingested,) = ingest_raws(butler, [str(path)]).ingested
    with butler.query() as query:
        (ref,) = query.datasets("raw", collections="LSST-TS8/raw/all")
    frame = butler.get(ref)
    assert isinstance(frame, RawFrame)
    assert frame.metadata.detector == ingested.info.detector_num
    metadata = butler.get(ref.makeComponentRef("metadata"))
    assert dataclasses.replace(metadata, source="") == dataclasses.replace(read_raw_metadata(path), source="")


# JSON


def test_overrides_are_files_that_tasks_read(butler: Butler) -> None:
    text = 'config.effects["bandwidth.fwhm"] = 2.4  # ± 0.1\n'
    ref = put(butler, text, "effectOverride", "ConfigOverride")
    assert butler.get(ref) == text
    uri = butler.getURI(ref)
    assert uri.getExtension() == ".py"
    assert uri.read().decode() == text


def test_verdicts_are_json(butler: Butler) -> None:
    verdict = {
        "verdict": "named",
        "effects": [{"name": "µ", "probability": 0.1 + 0.2}],
        "gap": {"after": 1e-300},
    }
    ref = put(butler, verdict, "effectDiscovery", "FringeJson")
    assert butler.get(ref) == verdict
    assert json.loads(butler.getURI(ref).read()) == verdict
    assert "µ".encode() in butler.getURI(ref).read()
    assert butler.getURI(ref).getExtension() == ".json"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1, 2}, object()])
def test_what_json_cannot_hold_is_refused(butler: Butler, repo: Path, value: Any) -> None:
    with pytest.raises(RuntimeError) as caught:  # the datastore's own, with ours as its cause
        put(butler, {"value": value}, "effectDiscovery", "FringeJson")
    assert isinstance(caught.value.__cause__, InputError)
    assert "finite numbers" in str(caught.value.__cause__)
    assert not list(repo.rglob("*.json"))


# afw


class FakeImage:
    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def getMaskPlaneDict(self) -> dict[str, int]:
        return {**products.MASK_PLANES, "CLIPPED": 30}


class ExposureF:
    """As much of afw's class as this package touches."""

    def __init__(self, path: str) -> None:
        self.path = path
        with fits.open(path) as hdus:
            self.metadata = dict(hdus[0].header)
            self.image, self.mask, self.variance = (FakeImage(np.array(hdus[n].data)) for n in (1, 2, 3))

    @classmethod
    def readFits(cls, path: str) -> ExposureF:
        return cls(path)

    def getMetadata(self) -> dict[str, Any]:
        return self.metadata

    def getXY0(self) -> tuple[int, int]:
        return 3, 5

    def getDetector(self) -> None:
        return None

    def getFilter(self) -> Any:
        return types.SimpleNamespace(physicalLabel=self.metadata["FILTER"])


@pytest.fixture
def with_afw(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process in which afw can be imported; its classes are those that a storage class names."""
    module = types.ModuleType("lsst.afw.image")
    module.ExposureF = ExposureF  # type: ignore[attr-defined]
    monkeypatch.setattr(ExposureF, "__module__", "lsst.afw.image")
    monkeypatch.setitem(sys.modules, "lsst.afw", types.ModuleType("lsst.afw"))
    monkeypatch.setitem(sys.modules, "lsst.afw.image", module)
    # What storage classes have looked up so far must not outlive the module.
    factory = StorageClassFactory()
    for name in ("ExposureF", "FringeFrame"):
        storage_class = factory.getStorageClass(name)
        monkeypatch.setattr(storage_class, "_pytype", None)
        monkeypatch.setattr(storage_class, "_converters_by_type", None)
        monkeypatch.setattr(storage_class, "_converters", dict(storage_class._converters))
    monkeypatch.setattr(factory.getStorageClass("ExposureF"), "_converters", {})


def fringe_ref(butler: Butler, storage_class: str) -> DatasetRef:
    return put(butler, MAKERS["FringeFrame"](), "fringe", storage_class, isCalibration=True)


def test_fringe_frame_is_read_as_an_exposure_where_asked(butler: Butler, with_afw: None) -> None:
    ref = fringe_ref(butler, "FringeFrame")
    exposure = butler.get(ref, storageClass="ExposureF")
    assert isinstance(exposure, ExposureF)
    assert exposure.metadata["OBSTYPE"] == "fringe"
    assert isinstance(butler.get(ref), products.FringeFrame)


def test_fringe_frame_is_stored_as_an_exposure_where_the_repository_says_so(
    butler: Butler, with_afw: None
) -> None:
    ref = fringe_ref(butler, "ExposureF")
    assert isinstance(butler.get(ref), ExposureF)
    assert isinstance(butler.get(ref, storageClass="FringeFrame"), products.FringeFrame)


def frame_mean_without(frame: products.FringeFrame, y: int, x: int) -> float:
    good = frame.mask == 0
    good[y, x] = False
    return float(frame.image[good].astype(float).mean())


def test_exposure_becomes_the_same_fringe_frame(butler: Butler, with_afw: None) -> None:
    frame = MAKERS["FringeFrame"]()
    ref = put(butler, frame, "fringe", "FringeFrame", isCalibration=True)
    exposure = butler.get(ref, storageClass="ExposureF")
    back = frame_from_exposure(exposure)
    assert np.array_equal(back.image, frame.image)
    assert np.array_equal(back.mask, frame.mask)
    assert back.xy0 == (3, 5)
    assert (back.physical_filter, back.creation_datetime) == (frame.physical_filter, frame.creation_datetime)
    y, x = np.argwhere(frame.mask == 0)[0]
    exposure.image.array -= frame_mean_without(frame, y, x)
    exposure.mask.array[y, x] = 1 << 30  # a plane that only the other side knows
    assert frame_from_exposure(exposure).mask[y, x] == 1
    del exposure.metadata["CALIB_CREATION_DATETIME"]
    with pytest.raises(InputError, match="CALIB_CREATION_DATETIME"):
        frame_from_exposure(exposure)


def test_repository_of_exposures_can_be_written_without_afw(butler: Butler) -> None:
    ref = fringe_ref(butler, "ExposureF")
    path = butler.getURI(ref).ospath
    assert fits.getheader(path)["OBSTYPE"] == "fringe"
    with pytest.raises(ValueError, match=r"storage class is 'ExposureF'; allowed: FringeFrame; .*lsst\.afw"):
        butler.get(ref)


def test_images_of_a_whole_sensor_have_world_coordinates(butler: Butler) -> None:
    """Of the sensor of the data id; an image of another size does not say where it is."""
    sensor = Camera.from_name("lsstCam").detector(37)
    flat = MAKERS["FringeFlat"](shape=sensor.shape)
    header = fits.getheader(butler.getURI(put(butler, flat, "whole", "FringeFlat")).ospath, "IMAGE")
    ny, nx = sensor.shape
    centre = WCS(header, key="F").pixel_to_world_values((nx - 1) / 2, (ny - 1) / 2)
    assert centre == pytest.approx((sensor.x_mm, sensor.y_mm))
    small = put(butler, MAKERS["FringeFlat"](), "small", "FringeFlat")
    assert "WCSNAMEF" not in fits.getheader(butler.getURI(small).ospath, "IMAGE")


def test_rows_and_columns_say_whether_an_image_is_of_the_whole_sensor(
    butler: Butler, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it is one of several planes; of a sensor so small that it is soon written."""
    small = Camera.from_name("lsstCam").detector(37).cut_down((32, 64))
    monkeypatch.setattr(formatters, "sensor_of", lambda data_id: small)
    for product, columns, known in (
        ("FringeFlat", 64, True),
        ("FringeCube", 64, True),
        ("FringeCube", 63, False),
    ):
        ref = put(butler, MAKERS[product]((32, columns)), f"{product}{columns}", product)
        assert ("WCSNAMEF" in fits.getheader(butler.getURI(ref).ospath, "IMAGE")) is known
