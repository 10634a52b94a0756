"""Certified fringe frames, and their way into a repository that does not know this package."""

import re
import sys
import types
from pathlib import Path

import pytest
import yaml
from astropy.io import fits
from astropy.time import Time
from lsst.daf.butler import Butler, CollectionType, DatasetRef, FormatterV2, Timespan
from toy_repository import Invoke, put_fringe

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.middleware import LsstCamFringe
from lsst.fringe_sim.middleware.handoff import EXPOSURE_FORMATTER, isr_override, write_handoff

pytestmark = pytest.mark.middleware

RUN = "u/someone/fringe"
CALIB = "LSSTCam/calib/fringe"


@pytest.fixture
def certified(repo: Path, invoke: Invoke) -> Path:
    """A repository with two certified fringe frames."""
    with Butler.from_config(str(repo), writeable=True) as butler:
        put_fringe(butler, RUN, (37, 94))
    result = invoke(
        "certify-calibrations",
        repo,
        RUN,
        CALIB,
        "fringe",
        "--begin-date",
        "2026-01-01T00:00:00",
        "--end-date",
        "2027-01-01T00:00:00",
    )
    assert result.exit_code == 0, result.output
    return repo


def valid_frame(butler: Butler, date: str, detector: int = 37) -> DatasetRef | None:
    time = Time(date, scale="tai")
    return butler.find_dataset(
        "fringe",
        instrument="LSSTCam",
        physical_filter="y_10",
        detector=detector,
        collections=CALIB,
        timespan=Timespan(time, time),
    )


def test_certified_frames_are_found_by_time(certified: Path) -> None:
    with Butler.from_config(str(certified)) as butler:
        assert butler.collections.get_info(CALIB).type is CollectionType.CALIBRATION
        found = valid_frame(butler, "2026-11-21")
        assert found is not None
        assert butler.get(found).detector == "det37"
        assert valid_frame(butler, "2027-11-21") is None


class OtherFormatter(FormatterV2):
    """Stands for the formatter of a package that is not installed here; it only gives the path."""

    can_read_from_local_file = True
    default_extension = ".fits"

    def read_from_local_file(self, path: str, component: str | None = None, expected_size: int = -1) -> str:
        return path


@pytest.fixture
def other_repo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository of real images: plain configuration, LSSTCam registered by another package."""
    root = tmp_path / "other"
    Butler.makeRepo(str(root))
    with Butler.from_config(str(root), writeable=True) as butler:
        LsstCamFringe().register(butler.registry)
        record = {"name": "LSSTCam", "class_name": "lsst.obs.lsst.LsstCam"}
        butler.registry.syncDimensionData("instrument", record, update=True)
    module_name, _, class_name = EXPOSURE_FORMATTER.rpartition(".")
    parts = module_name.split(".")
    for depth in range(3, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:depth]), types.ModuleType(".".join(parts[:depth])))
    monkeypatch.setitem(sys.modules, "lsst.obs", types.ModuleType("lsst.obs"))
    setattr(sys.modules[module_name], class_name, OtherFormatter)
    return root


def test_handoff_is_imported_elsewhere(
    certified: Path, other_repo: Path, tmp_path: Path, invoke: Invoke
) -> None:
    rehearsal = invoke("write-fringe-handoff", certified, CALIB, tmp_path / "out", "--dry-run")
    assert "2 fringe frames would be written" in rehearsal.output
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    result = invoke("write-fringe-handoff", certified, CALIB, tmp_path / "out")
    assert result.exit_code == 0, result.output
    exported = invoke("import", other_repo, tmp_path / "out", "--transfer", "copy")
    assert exported.exit_code == 0, exported.output
    with Butler.from_config(str(other_repo)) as butler:
        assert butler.registry.getDatasetType("fringe").storageClass_name == "ExposureF"
        found = valid_frame(butler, "2026-11-21", 94)
        assert found is not None
        header = fits.getheader(butler.getURI(found).ospath)
        assert header["OBSTYPE"] == "fringe"
        assert header["DETNAME"] == "det94"
        assert valid_frame(butler, "2025-11-21", 94) is None
        (record,) = butler.query_dimension_records("instrument")
        assert record.class_name == "lsst.obs.lsst.LsstCam"


def test_export_names_nothing_of_this_package(certified: Path, tmp_path: Path) -> None:
    with Butler.from_config(str(certified)) as butler:
        refs = write_handoff(butler, RUN, tmp_path / "to" / "out", where="detector.raft = 'R11'")
    assert [ref.dataId["detector"] for ref in refs] == [37]
    text = (tmp_path / "to" / "out" / "export.yaml").read_text()
    assert "fringe_sim" not in text
    assert "FringeFrame" not in text
    kinds = [entry["type"] for entry in yaml.safe_load(text)["data"]]
    assert "dimension" not in kinds


def test_what_cannot_be_handed_off_is_refused(certified: Path, tmp_path: Path, invoke: Invoke) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with Butler.from_config(str(certified)) as butler:
        for target in (tmp_path / "full", tmp_path / "full" / "file"):
            with pytest.raises(InputError, match=r"directory is .*; allowed: a new or an empty directory"):
                write_handoff(butler, CALIB, target)
        with pytest.raises(InputError, match=r"collection is 'nothing'; allowed: .*LSSTCam/calib/fringe"):
            write_handoff(butler, "nothing", tmp_path / "out")
        with pytest.raises(InputError, match="fringe frames is 0; allowed: at least one"):
            write_handoff(butler, CALIB, tmp_path / "out", where="instrument='LSSTCam' AND detector=3")
        for where in ("detector = 3", "instrument =", "colour = 'red'"):
            with pytest.raises(InputError, match="where is"):
                write_handoff(butler, CALIB, tmp_path / "out", where=where)
    result = invoke("write-fringe-handoff", certified, "nothing", tmp_path / "out")
    assert result.exit_code == 1
    assert not (tmp_path / "out").exists()


def test_repository_without_fringe_frames(butler: Butler, tmp_path: Path) -> None:
    butler.collections.register("empty")
    with pytest.raises(InputError, match="fringe frames is 0"):
        write_handoff(butler, "empty", tmp_path / "out")


def test_the_guide_shows_the_configuration_that_is_written() -> None:
    page = Path(__file__).parents[2] / "doc" / "guide" / "pipelines.md"
    (shown,) = re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    written = [line for line in isr_override(["y_10"]).splitlines() if not line.startswith("#")]
    assert shown.split() == " ".join(written).replace("'", '"').split()
