"""``fringe-sim sky``."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from recorded_numbers import Record

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.cli.observed import TemplateFolder
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.products import SkyFringe, ThicknessMap, mask_bits
from lsst.fringe_sim.tasks import SkyFringeSimTask
from lsst.fringe_sim.tasks.sky_fringe_sim import SkyExposure

AIRMASS = 1.3
LAYERS = (("thickness", "adhesive"), ("silicon", "detection"))


@pytest.fixture(scope="module")
def thickness(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("map") / "thickness.fits"
    layer = e2v_321((200, 208)).astype(np.float32)
    layer[:5, :5] = np.nan
    fits.PrimaryHDU(layer).writeto(path)
    return str(path)


@pytest.fixture(scope="module")
def usual(thickness, tmp_path_factory) -> Path:
    """What the command writes for the middle of the field."""
    out = tmp_path_factory.mktemp("sky")
    given = ["--thickness", thickness, "--detector", "R22_S11", "--noiseless"]
    assert run(["sky", *given, "--out", str(out)]) == 0
    return out


def test_one_frame_is_written_with_its_errors(usual) -> None:
    frame = SkyFringe.read_fits(usual / "sky_R22_S11_00.fits")
    assert frame.image.shape == (200, 208)
    assert np.all(frame.mask[:5, :5] != 0)
    assert 0.0 < frame.quadrature_error < 1e-4
    assert (usual / "sky.png").read_bytes().startswith(b"\x89PNG")
    page = (usual / "report.html").read_text(encoding="utf-8")
    assert "Coadds" in page
    assert "fringe-sim sky --thickness" in page, "the page says which command made it"


@pytest.mark.slow
def test_visits_of_a_table_are_coadded(thickness, tmp_path, capsys) -> None:
    visits = tmp_path / "visits.ecsv"
    Table({"x": [90.0, 110.0], "y": [95.0, 104.0], "rotation": [0.0, 60.0]}).write(visits)
    given = ["sky", "--thickness", thickness, "--noiseless", "--visits", str(visits)]
    assert run([*given, "--out", str(tmp_path / "sky")]) == 0
    assert "coadds of the given visits" in (tmp_path / "sky" / "report.html").read_text(encoding="utf-8")
    Table({"x": [90.0, 2.0], "y": [95.0, 104.0], "rotation": [0.0, 60.0]}).write(visits, overwrite=True)
    assert run([*given, "--out", str(tmp_path / "off")]) == 1
    assert "place of visit 1" in capsys.readouterr().err
    assert not (tmp_path / "off").exists()


@pytest.mark.slow
def test_the_sky_of_the_command_is_that_of_the_task(thickness, tmp_path) -> None:
    """One map has one sky: the beam of every pixel in both."""
    arguments = ["--detector", "R30_S00", "--airmass", str(AIRMASS), "--noiseless", "--out", str(tmp_path)]
    assert run(["sky", "--thickness", thickness, *arguments]) == 0
    frame = SkyFringe.read_fits(tmp_path / "sky_R30_S00_00.fits")
    layer = np.asarray(fits.getdata(thickness), np.float32)
    known = np.isfinite(layer)
    sigma, mask = np.where(known, 0.001, np.nan), np.where(known, 0, mask_bits("NO_DATA"))
    one = np.ones(layer.shape)
    mapped = ThicknessMap(layer, sigma, one, 0.0 * one, mask, "adhesive", {}, 12 * known, "R30_S00")
    task = SkyFringeSimTask(config=SkyFringeSimTask.ConfigClass(noise=False, night="steady"))
    exposure = SkyExposure(1, 20260115, 23.0, 30.0, AIRMASS, "y_10")
    theirs = task.run(mapped, exposure, Camera.from_name("lsstCam").detector("R30_S00")).sky
    np.testing.assert_allclose(frame.image[known], theirs.image[known], rtol=2e-6)


@pytest.mark.slow
def test_maps_of_both_layers_have_one_sky(tmp_path) -> None:
    """The same in command and task; templates beside it that a correction takes."""
    layer = np.linspace(14.0, 14.6, 40 * 41, dtype=np.float32).reshape(40, 41)
    silicon = np.broadcast_to(np.linspace(100.02, 100.04, 41), layer.shape).astype(np.float32)
    silicon = np.where(np.arange(40)[:, None] < 2, np.nan, silicon)
    for name, image in (("thickness", layer), ("silicon", silicon)):
        fits.PrimaryHDU(image).writeto(tmp_path / f"{name}.fits")
    maps = [
        "--thickness",
        str(tmp_path / "thickness.fits"),
        "--silicon-thickness",
        str(tmp_path / "silicon.fits"),
    ]
    given = ["--detector", "R30_S00", "--airmass", str(AIRMASS), "--noiseless", "--templates"]
    assert run(["sky", *maps, *given, "--out", str(tmp_path / "out")]) == 0
    frame = SkyFringe.read_fits(tmp_path / "out" / "sky_R30_S00_00.fits")
    assert np.all(frame.mask[:2] != 0)
    assert np.all(frame.mask[2:] == 0)
    task = SkyFringeSimTask(config=SkyFringeSimTask.ConfigClass(noise=False, night="steady", silicon="map"))
    exposure = SkyExposure(1, 20260115, 23.0, 30.0, AIRMASS, "y_10")
    read = [ThicknessMap.read_any(tmp_path / f"{name}.fits", of) for name, of in LAYERS]
    theirs = task.run(read[0], exposure, Camera.from_name("lsstCam").detector("R30_S00"), read[1]).sky
    np.testing.assert_array_equal(theirs.mask, frame.mask)
    np.testing.assert_allclose(frame.image[2:], theirs.image[2:], rtol=2e-6)
    assert theirs.metadata["PHASERMS"] == pytest.approx(frame.metadata["PHASERMS"], rel=1e-4)
    templates = TemplateFolder(tmp_path / "out").of("R30_S00")
    assert [each.metadata["TEMPKIND"] for each in templates] == ["sky", "phase"]
    np.testing.assert_allclose(
        templates[0].image[2:], frame.fraction()[2:] - frame.fraction()[2:].mean(), atol=2e-6
    )
    assert templates[1].image[2:].std(dtype=float) == pytest.approx(frame.metadata["PHASERMS"], rel=1e-3)


def test_a_map_of_the_silicon_has_the_pixels_of_the_other(thickness, tmp_path, capsys) -> None:
    other = tmp_path / "silicon.fits"
    fits.PrimaryHDU(np.full((7, 8), 100.0, np.float32)).writeto(other)
    arguments = ["--silicon-thickness", str(other), "--out", str(tmp_path / "out")]
    assert run(["sky", "--thickness", thickness, *arguments]) == 1
    assert "shape of the map of the silicon" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_level_is_that_of_the_measured_quantum_efficiency(thickness, usual, tmp_path) -> None:
    """2717 electrons in 30 s at the zenith within 10 %, unless the level of the stack is asked for."""
    assert run(["sky", "--thickness", thickness, "--level", "model", "--out", str(tmp_path)]) == 0
    measured, model = (SkyFringe.read_fits(out / "sky_R22_S11_00.fits") for out in (usual, tmp_path))
    assert measured.mean_electrons == pytest.approx(2717, rel=0.1)
    assert model.mean_electrons == pytest.approx(2057, rel=0.02)
    rms = [float(frame.metadata["FRINGRMS"]) for frame in (measured, model)]
    assert rms[0] == pytest.approx(rms[1], rel=1e-5)


@pytest.mark.slow
def test_fringes_fade_towards_the_edge_of_the_field(thickness, usual, tmp_path) -> None:
    assert run(["sky", "--thickness", thickness, "--detector", "R11_S01", "--out", str(tmp_path)]) == 0
    files = (tmp_path / "sky_R11_S01_00.fits", usual / "sky_R22_S11_00.fits")
    edge, middle = (float(SkyFringe.read_fits(file).metadata["FRINGRMS"]) for file in files)
    assert edge < 0.5 * middle


def test_frames_have_noise_unless_they_say_otherwise(thickness, usual, tmp_path, capsys) -> None:
    assert run(["sky", "--thickness", thickness, "--detector", "R22_S11", "--out", str(tmp_path / "a")]) == 0
    noisy, clean = (SkyFringe.read_fits(out / "sky_R22_S11_00.fits") for out in (tmp_path / "a", usual))
    left = (noisy.image - clean.image)[noisy.mask == 0]
    variance = clean.mean_electrons + float(noisy.metadata["RDNOISE"]) ** 2
    assert np.var(left, dtype=float) == pytest.approx(variance, rel=5 * np.sqrt(2.0 / left.size))
    capsys.readouterr()
    search = ["discover", str(usual), "--setup", "lsst_e2v", "--thickness", thickness]
    assert run([*search, "--out", str(tmp_path / "b")]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "noise" in message


@pytest.mark.slow
def test_noise_is_seeded(thickness, tmp_path) -> None:
    images = []
    for name, seed in (("a", "3"), ("b", "3"), ("c", "4")):
        out = tmp_path / name
        assert run(["sky", "--thickness", thickness, "--seed", seed, "--out", str(out)]) == 0
        images.append(SkyFringe.read_fits(out / "sky_R22_S11_00.fits").image)
    np.testing.assert_array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--setup", "ts8_e2v"], "behind a telescope"),
        (["--detector", "R22_S19"], "R22_S1"),
        (["--exptime", "-3"], "above 0"),
        (["--exptime", "1e30"], "1e+06"),
        (["--night", "--exptime", "30"], "--night"),
        (["--effect", "epoxy_absorbtion.k=0.1"], "did you mean epoxy_absorption"),
        (["--visits", "none.ecsv"], "--noiseless"),
        (["--visits", "none.ecsv", "--noiseless"], "an existing file"),
    ],
)
def test_bad_requests(thickness, tmp_path, capsys, arguments, words) -> None:
    assert run(["sky", "--thickness", thickness, "--out", str(tmp_path / "a"), *arguments]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_a_map_that_is_no_map_is_refused(tmp_path, capsys) -> None:
    fits.PrimaryHDU(np.zeros((2, 3, 4))).writeto(tmp_path / "cube.fits")
    arguments = ["sky", "--thickness", str(tmp_path / "cube.fits"), "--out", str(tmp_path / "a")]
    assert run(arguments) == 1
    assert "two-dimensional" in capsys.readouterr().err


@pytest.mark.slow
def test_world_coordinates_where_the_place_is_known(thickness, usual, tmp_path) -> None:
    """A map that does not say what it shows has none; a window says so, and its frame is where it was."""
    assert "WCSNAMEF" not in fits.getheader(usual / "sky_R22_S11_00.fits", "IMAGE")
    arguments = ["sky", "--detector", "R22_S11", "--out", str(tmp_path / "a")]
    window = fits.PrimaryHDU(fits.getdata(thickness))
    window.header["DETSEC"] = "[1001:1208,2001:2200]"
    window.writeto(tmp_path / "window.fits")
    assert run([*arguments, "--thickness", str(tmp_path / "window.fits")]) == 0
    with fits.open(tmp_path / "a" / "sky_R22_S11_00.fits") as hdus:
        assert WCS(hdus["IMAGE"].header, key="D").pixel_to_world_values(0, 0) == pytest.approx((1000, 2000))
        sensor = Camera.from_name("lsstCam").detector("R22_S11")
        x_mm, _ = WCS(hdus["MASK"].header, key="F").pixel_to_world_values((sensor.shape[1] - 1) / 2 - 1000, 0)
        assert x_mm == pytest.approx(sensor.x_mm, abs=1e-9)


def test_a_section_outside_the_sensor_is_refused_before_the_work(thickness, tmp_path, capsys) -> None:
    window = fits.PrimaryHDU(fits.getdata(thickness))
    window.header["DETSEC"] = "[4001:4208,1:200]"
    window.writeto(tmp_path / "window.fits")
    out = tmp_path / "a"
    assert run(["sky", "--thickness", str(tmp_path / "window.fits"), "--out", str(out)]) == 1
    message = capsys.readouterr().err
    assert "window.fits" in message
    assert "of the section" in message
    assert not out.exists()


@pytest.mark.parametrize(
    ("cards", "factor", "words"),
    [
        ({"CONTRAST": "x", "CONTRSIG": 0.1}, 1.0, "CONTRAST"),
        ({"CONTRAST": -3.0, "CONTRSIG": 0.1}, 1.0, "CONTRAST is -3.0"),
        ({}, 60.0, "thickness"),
    ],
)
def test_a_map_that_no_fit_has_written_is_refused(cards, factor, words, tmp_path, capsys) -> None:
    hdu = fits.PrimaryHDU((factor * e2v_321((20, 24))).astype(np.float32))
    hdu.header.update(cards)
    hdu.writeto(tmp_path / "map.fits")
    given = ["sky", "--thickness", str(tmp_path / "map.fits"), "--detector", "R22_S11"]
    assert run([*given, "--out", str(tmp_path / "sky")]) == 1
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("command", ["sky", "discover"])
def test_a_map_with_a_card_that_cannot_be_read_is_refused(tmp_path, capsys, command) -> None:
    path = tmp_path / "map.fits"
    hdu = fits.PrimaryHDU(np.full((16, 64), 16.0))
    hdu.header["NOTE"] = "plain"
    hdu.writeto(path)
    path.write_bytes(path.read_bytes().replace(b"'plain", b"'\x1b[31m"))
    given = [str(path)] if command == "discover" else []
    setup = ["--setup", "lsst_e2v", "--thickness", str(path), "--out", str(tmp_path / "o"), "--dry-run"]
    assert run([command, *given, *setup]) == 1
    assert "map.fits" in capsys.readouterr().err


def test_files_of_one_frame_are_as_recorded(usual: Path, recorded: Record) -> None:
    """A record of what is written today, for edits that are not meant to change it."""
    recorded(usual)
