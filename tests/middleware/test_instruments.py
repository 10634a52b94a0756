import re
from pathlib import Path

import lsst.pex.config as pex_config
import pytest
from lsst.daf.butler import Butler
from lsst.pipe.base import Instrument
from lsst.resources import ResourcePath
from lsst.utils import doImport
from toy_repository import Invoke

import lsst.fringe_sim
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.middleware import HscFringe, LsstCamFringe, MonoCamFringe, Ts8Fringe
from lsst.fringe_sim.middleware.formatters import RawFrameFormatter
from lsst.fringe_sim.middleware.instruments import INSTRUMENTS

pytestmark = pytest.mark.middleware

ALL = (LsstCamFringe, Ts8Fringe, MonoCamFringe, HscFringe)


@pytest.mark.parametrize("cls", ALL)
def test_the_public_name_leads_to_the_instrument(butler: Butler, cls: type[Instrument]) -> None:
    assert getattr(lsst.fringe_sim, cls.__name__) is cls
    found = Instrument.fromName(cls.getName(), butler.registry)
    assert type(found) is cls
    assert Instrument.from_string(f"lsst.fringe_sim.{cls.__name__}").getName() == cls.getName()
    assert found.getRawFormatter({}) is RawFrameFormatter


def test_names_are_those_of_the_observatories() -> None:
    assert {cls.getName() for cls in ALL} == {"LSSTCam", "LSST-TS8", "MonoCam", "HSC"}
    assert set(INSTRUMENTS) == {"lsstCam", "ts8", "monocam", "hsc"}


@pytest.mark.parametrize("cls", ALL)
def test_detectors_are_registered_with_their_places(butler: Butler, cls: type[Instrument]) -> None:
    camera = Camera.from_name(cls.camera_name)  # type: ignore[attr-defined]
    records = {r.id: r for r in butler.query_dimension_records("detector", instrument=cls.getName())}
    assert set(records) == {d.id for d in camera.detectors}
    for detector in camera.detectors:
        record = records[detector.id]
        assert (record.full_name, record.raft, record.name_in_raft) == (
            detector.name,
            detector.raft,
            detector.slot,
        )
        assert (record.purpose == "SCIENCE") == (detector.kind == "science")


@pytest.mark.parametrize(
    ("cls", "detectors", "exposures"),
    [
        (LsstCamFringe, 205, 8_000_000_000_000),
        (MonoCamFringe, 1, 8_000_000_000_000),
        (HscFringe, 1, 8_000_000_000_000),
        (Ts8Fringe, 225, 10**15),
    ],
)
def test_data_ids_are_packed_with_room_for_all(
    butler: Butler, cls: type[Instrument], detectors: int, exposures: int
) -> None:
    """Numbers of detectors and exposures lie below those that the record of the instrument states."""
    (record,) = butler.query_dimension_records("instrument", instrument=cls.getName())
    assert (record.detector_max, record.exposure_max, record.visit_max) == (detectors, exposures, exposures)


def test_a_raft_is_selected_by_name(butler: Butler) -> None:
    records = butler.query_dimension_records("detector", where="instrument='LSSTCam' AND detector.raft='R11'")
    assert sorted(r.id for r in records) == list(range(36, 45))


@pytest.mark.parametrize(("name", "y_filter"), [("LSSTCam", "y_10"), ("MonoCam", "y"), ("HSC", "HSC-Y")])
def test_filters_of_sky_and_laboratory(butler: Butler, name: str, y_filter: str) -> None:
    records = butler.query_dimension_records("physical_filter", instrument=name)
    assert {r.name: r.band for r in records} == {y_filter: "y", "none": "white", "monochromator": "white"}


@pytest.mark.parametrize(("name", "band"), [("y_04", "y"), ("i_39", "i"), ("HSC-Y", "y"), ("none", "white")])
def test_band_of_a_filter(name: str, band: str) -> None:
    assert LsstCamFringe.band_of(name) == band


def test_filter_without_band_is_refused() -> None:
    with pytest.raises(InputError, match="physical filter is 'pinhole'; allowed: y_10"):
        LsstCamFringe.band_of("pinhole")


def test_registering_again_changes_nothing(butler: Butler) -> None:
    before = sorted(map(str, butler.query_dimension_records("detector", instrument="LSSTCam")))
    LsstCamFringe().register(butler.registry)
    assert sorted(map(str, butler.query_dimension_records("detector", instrument="LSSTCam"))) == before


def test_an_instrument_that_is_defined_otherwise_is_left_alone(repo: Path, invoke: Invoke) -> None:
    with Butler.from_config(str(repo), writeable=True) as butler:
        record = {"name": "LSSTCam", "class_name": "lsst.obs.lsst.LsstCam"}
        butler.registry.syncDimensionData("instrument", record, update=True)
        with pytest.raises(InputError, match=r"instrument is 'LSSTCam'; allowed: .*--update"):
            LsstCamFringe().register(butler.registry)
    assert invoke("register-instrument", repo, "lsst.fringe_sim.LsstCamFringe").exit_code != 0
    assert invoke("register-instrument", repo, "lsst.fringe_sim.LsstCamFringe", "--update").exit_code == 0


class ToyConfig(pex_config.Config):
    shared = pex_config.Field[int](doc="set for all cameras", default=0)
    own = pex_config.Field[int](doc="set for one camera", default=0)


def test_choices_for_all_cameras_come_before_those_of_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = "resource://lsst.fringe_sim/config"
    assert tuple(Ts8Fringe.configPaths) == (root, f"{root}/ts8")
    assert tuple(LsstCamFringe.configPaths) == (root, f"{root}/lsstCam")
    (tmp_path / "ts8").mkdir()
    (tmp_path / "toy.py").write_text("config.shared = 1\nconfig.own = 1\n")
    (tmp_path / "ts8" / "toy.py").write_text("config.own = 2\n")
    monkeypatch.setattr(Ts8Fringe, "configPaths", (str(tmp_path), str(tmp_path / "ts8")))
    config = ToyConfig()
    Ts8Fringe().applyConfigOverrides("toy", config)
    assert (config.shared, config.own) == (1, 2)


def test_repository_from_the_seed_configuration(tmp_path: Path, invoke: Invoke) -> None:
    """The seed is written expanded: formatters and storage classes need nothing from outside."""
    repo = tmp_path / "repo"
    seed = "resource://lsst.fringe_sim/configs/butler.yaml"
    result = invoke("create", repo, "--seed-config", seed)
    assert result.exit_code == 0, result.output
    text = (repo / "butler.yaml").read_text()
    assert "!include" not in text
    assert "$" not in text
    assert "lsst.fringe_sim.middleware.formatters.FringeFrameFormatter" in text
    assert invoke("register-instrument", repo, "lsst.fringe_sim.Ts8Fringe").exit_code == 0
    with Butler.from_config(str(repo)) as butler:
        assert len(list(butler.query_dimension_records("detector", instrument="LSST-TS8"))) == 225


def test_no_pickle_anywhere_in_the_configuration() -> None:
    for name in ("butler.yaml", "storageClasses.yaml", "datastores/formatters.yaml"):
        assert b"pickle" not in ResourcePath(f"resource://lsst.fringe_sim/configs/{name}").read().lower()


@pytest.mark.parametrize("name", ["storageClasses.yaml", "datastores/formatters.yaml"])
def test_every_name_of_the_package_in_the_configuration_leads_somewhere(name: str) -> None:
    text = ResourcePath(f"resource://lsst.fringe_sim/configs/{name}").read().decode()
    names = re.findall(r"lsst\.fringe_sim(?:\.\w+)+", text)
    assert names
    for each in names:
        assert callable(doImport(each)), each
