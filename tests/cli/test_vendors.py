"""Whatever names a sensor of the other vendor is refused before work: its films are not those of the set-up."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.products import FringeCube

WAVELENGTHS_NM = (900.0, 910.0, 920.0, 930.0)
OTHER = {"ts8_e2v": ("ITL-3800C-023", "R01_S00"), "ts8_itl": ("E2V-CCD250-321", "R22_S11")}


def cube_file(path: Path, detector: str) -> Path:
    pixels = np.random.default_rng(1).normal(1e4, 100.0, (len(WAVELENGTHS_NM), 16, 64)).astype(np.float32)
    made = FringeCube.from_arrays(
        pixels, WAVELENGTHS_NM, bandwidth_fwhm_nm=2.0, temperature_k=183.0, detector=detector
    )
    made.write_fits(path)
    return path


def plain_files(folder: Path, detector: str) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(1)
    for wavelength in WAVELENGTHS_NM:
        hdu = fits.PrimaryHDU(rng.normal(1e4, 100.0, (16, 64)).astype(np.float32))
        hdu.header.update({"MONOWL": wavelength, "BUNIT": "electron", "IMGTYPE": "FLAT", "DETNAME": detector})
        hdu.writeto(folder / f"{wavelength:.0f}.fits")
    return folder


@pytest.mark.parametrize("command", ["fit", "discover"])
@pytest.mark.parametrize("setup", sorted(OTHER))
@pytest.mark.parametrize("make", [cube_file, plain_files])
def test_flats_that_name_a_sensor_of_the_other_vendor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, setup: str, make: object
) -> None:
    assert callable(make)
    out = ("--out", str(tmp_path / "out"), "--dry-run")
    for number, name in enumerate((*OTHER[setup], "unheard of")):
        given = make(tmp_path / f"in{number}.fits", name)
        refused = name != "unheard of"
        assert run([command, str(given), "--setup", setup, *out]) == refused
        assert (f"{name} of" in capsys.readouterr().err) == refused
    assert not (tmp_path / "out").exists()


def map_file(path: Path, detector: str, thickness_um: float = 16.0) -> Path:
    """A map from elsewhere, which does not name its layer."""
    hdu = fits.PrimaryHDU(np.full((16, 64), thickness_um))
    hdu.header["DETNAME"] = detector
    hdu.writeto(path)
    return path


@pytest.mark.parametrize(
    "arguments",
    [
        ("sky", "--thickness", "{}"),
        ("focal-plane", "--sensor", "R22_S11", "--thickness", "R22_S11={}"),
        ("mock-visits", "--seed", "1", "--size", "64x64", "--thickness", "{}"),
        ("mock-flats", "--seed", "1", "--size", "64x64", "--thickness", "{}"),
        ("amplitudes", "--thickness", "{}"),
    ],
)
def test_maps_that_name_a_sensor_of_the_other_vendor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]
) -> None:
    command, *options = arguments
    out = [str(tmp_path / "out")] if command.startswith("mock") else ["--out", str(tmp_path / "out")]
    for name, refused in (("ITL-3800C-023", True), ("R22_S12", False), ("", False)):
        path = map_file(tmp_path / f"map{name}.fits", name)
        given = [option.format(path) for option in options]
        assert run([command, *out, *given, "--dry-run"]) == refused
        assert (f"{path}: sensor is 'ITL" in capsys.readouterr().err) == refused


@pytest.mark.parametrize(
    ("setup", "place"), [("lsst_e2v", "R01_S00"), ("lsst_itl", "R22_S11"), ("ts8_itl", "RTM-020_S01")]
)
def test_a_place_with_a_sensor_of_the_other_vendor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], setup: str, place: str
) -> None:
    with pytest.raises(InputError, match="which set-up"):
        Setup.from_name(setup).sensor(place)
    if setup == "lsst_e2v":
        for arguments in (
            ("sky", "--thickness", "e2v_321", "--out", str(tmp_path / "a")),
            ("mock-visits", str(tmp_path / "a"), "--seed", "1"),
        ):
            assert run([*arguments, "--detector", place, "--dry-run"]) == 1
            assert "lsst_itl" in capsys.readouterr().err


def test_the_name_of_a_sensor_tells_its_vendor_in_every_camera() -> None:
    camera = Camera.from_name("lsstCam")
    known = {"R01_S00": "ITL", "RTM-020_S01": "e2v", "ITL-3800C-999": "ITL", "E2V-CCD250-321-Dev": "e2v"}
    assert {name: camera.vendor_of(name) for name in known} == known
    # A number is one in each camera; MonoCam and Hyper Suprime-Cam have a sensor of this name.
    assert [camera.vendor_of(name) for name in ("", "37", "R00_S00", "unheard of")] == [None] * 4
    assert Camera.from_name("hsc").vendor_of("R00_S00") == "Hamamatsu"


def test_two_names_are_of_two_sensors_if_a_table_says_so() -> None:
    """A number tells nothing, as each camera has one; nor does a name that no table has."""
    camera = Camera.from_name("lsstCam")
    serial = camera.detector("R22_S11").serial
    assert camera.are_two_sensors("R22_S11", "R22_S12")
    assert camera.are_two_sensors(f"{serial}-Dev", "R22_S12")
    assert camera.are_two_sensors("RTM-020_S01", "RTM-020_S02")
    for one in (serial, " R22_S11", "95", "unheard of"):
        assert not camera.are_two_sensors("R22_S11", one)
        assert not camera.are_two_sensors(one, "R22_S11")


def test_a_map_of_the_silicon_that_names_a_sensor_of_the_other_vendor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layer, out = map_file(tmp_path / "layer.fits", "R22_S12"), tmp_path / "out"
    for name, refused in (("ITL-3800C-023", True), ("R22_S12", False)):
        silicon = map_file(tmp_path / f"silicon{name}.fits", name, 100.0)
        maps = ["--thickness", str(layer), "--silicon-thickness", str(silicon)]
        assert run(["sky", *maps, "--out", str(out), "--dry-run"]) == refused
        assert (f"{name} of" in capsys.readouterr().err) == refused
    assert not out.exists()
