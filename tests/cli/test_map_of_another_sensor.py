"""A map of another sensor of the same vendor is said, or refused where two maps have to be of one sensor."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.model.provenance import effects_of_header

PLACE, SERIAL = "R22_S11", Camera.from_name("lsstCam").detector("R22_S11").serial
ELSEWHERE = next(
    item for item in Camera.from_name("lsstCam").science if item.vendor == "e2v" and item.raft != "R22"
)


def map_file(path: Path, detector: str, layer: str | None = None) -> str:
    hdu = fits.PrimaryHDU(np.full((16, 64), 100.0 if layer else 16.0))
    hdu.header["DETNAME"] = detector
    if layer:
        hdu.header["LAYER"] = layer
    hdu.writeto(path)
    return str(path)


@pytest.mark.parametrize("name", [ELSEWHERE.name, ELSEWHERE.serial, PLACE, SERIAL, "unheard of", ""])
def test_the_sensor_of_a_map_is_told_from_that_of_the_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = map_file(tmp_path / "map.fits", name)
    out = ("--out", str(tmp_path / "out"), "--dry-run")
    other = name in (ELSEWHERE.name, ELSEWHERE.serial)
    for command in (
        ("sky", "--detector", PLACE, "--thickness", path),
        ("focal-plane", "--sensor", PLACE, "--thickness", f"{PLACE}={path}"),
    ):
        assert run([*command, *out]) == 0
        assert (f"a map of {name}, taken for {PLACE}" in capsys.readouterr().err) == other


@pytest.mark.parametrize("beside", [ELSEWHERE.name, ELSEWHERE.serial, PLACE, SERIAL, "unheard of"])
def test_both_layers_are_of_one_sensor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], beside: str
) -> None:
    path, silicon = (
        map_file(tmp_path / "map.fits", PLACE),
        map_file(tmp_path / "si.fits", beside, "detection"),
    )
    command = ["sky", "--thickness", path, "--silicon-thickness", silicon, "--out", str(tmp_path / "out")]
    refused = beside in (ELSEWHERE.name, ELSEWHERE.serial)
    assert run([*command, "--dry-run"]) == refused
    assert (f"allowed: {PLACE}" in capsys.readouterr().err) == refused


def test_maps_for_the_focal_plane_are_of_sensors_that_are_forecast(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = map_file(tmp_path / "map.fits", "")
    for sensor, given in (
        (PLACE, ("R00_SG0",)),  # a guider
        (PLACE, (ELSEWHERE.name,)),
        (PLACE, (PLACE, SERIAL)),
    ):
        maps = [text for name in given for text in ("--thickness", f"{name}={path}")]
        command = ["focal-plane", "--sensor", sensor, *maps, "--out", str(tmp_path / "out"), "--dry-run"]
        assert run(command) == 1
        assert given[-1] in capsys.readouterr().err


@pytest.mark.parametrize("value", ["nan", float("nan"), "inf", True, None, "0.1.2"])
def test_effects_of_a_header_have_finite_values(value: object) -> None:
    with pytest.raises(FrameFormatError, match="EFFVAL0"):
        effects_of_header({"EFFECT0": "contrast_loss.fraction", "EFFVAL0": value})
