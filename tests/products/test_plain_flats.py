"""Flats of a sensor without a layout of its own: one image in one file."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import ThicknessMap, read_plain_flats

WAVELENGTHS_NM = np.arange(880.0, 1000.0, 10.0)
THICKNESS_UM = e2v_321((64, 96))
LIGHT: dict[str, Any] = {"temperature_k": 183.15, "bandwidth_fwhm_nm": 2.0}


def write(path: Path, counts: np.ndarray, **cards: Any) -> Path:
    header = fits.Header()
    header.update({key: value for key, value in cards.items() if value is not None})
    fits.PrimaryHDU(counts.astype(np.float32), header).writeto(path)
    return path


@pytest.fixture(scope="module")
def electrons() -> np.ndarray:
    rng = np.random.default_rng(20261127)
    response = FringeModel.from_setup("ts8_e2v").response(THICKNESS_UM.ravel(), WAVELENGTHS_NM)
    mean = 20_000.0 * response / response.mean(axis=1, keepdims=True)
    return rng.poisson(mean).reshape(-1, *THICKNESS_UM.shape).astype(float)


@pytest.fixture
def flats(electrons: np.ndarray, tmp_path: Path) -> Path:
    """The flats in ADU above a bias level, with bias images, in a second HDU like that of many cameras."""
    folder = tmp_path / "flats"
    folder.mkdir()
    for number, (wavelength, image) in enumerate(zip(WAVELENGTHS_NM, electrons, strict=True)):
        cards = {"MONOWL": wavelength, "BUNIT": "ADU", "GAIN": 0.7, "IMGTYPE": "FLAT", "RDNOISE": 5.0}
        header = fits.Header(cards)
        counts = (image / 0.7 + 1000.0).astype(np.float32)
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(counts, header)]).writeto(folder / f"{number}.fits")
    for number in range(2):
        level = np.full(THICKNESS_UM.shape, 1000.0)
        write(folder / f"bias{number}.fits", level, BUNIT="adu", GAIN=0.7, IMGTYPE="BIAS")
    return folder


def test_counts_become_electrons_without_the_bias(flats: Path, electrons: np.ndarray) -> None:
    cube = read_plain_flats(flats.iterdir(), **LIGHT)
    assert cube.metadata["NBIAS"] == 2
    np.testing.assert_array_equal(cube.wavelength_nm, WAVELENGTHS_NM)
    np.testing.assert_allclose(cube.image, electrons, rtol=1e-5)
    np.testing.assert_allclose(cube.variance, electrons + 1.5 * 25.0, rtol=1e-5)
    np.testing.assert_array_equal(cube.exposures.dark_time_s, 0.0)  # no EXPTIME: not known


def test_pixels_without_a_number_and_full_ones_are_masked(tmp_path: Path) -> None:
    counts = np.full((20, 30), 1000.0)
    counts[3, 4], counts[5, 6] = np.nan, 70_000.0
    path = write(tmp_path / "flat.fits", counts, WAVELEN=950.0, BUNIT="electron", SATURATE=65_000)
    cube = read_plain_flats([path], **LIGHT)
    assert set(zip(*(axis.tolist() for axis in np.nonzero(cube.mask[0])), strict=True)) == {(3, 4), (5, 6)}


def test_the_command_fits_a_folder_of_them(flats: Path, tmp_path: Path, capsys) -> None:
    assert run(["fit", str(flats), "--setup", "ts8_e2v", "--out", str(tmp_path / "fit")]) == 0
    assert "12 flats at 880, 890" in capsys.readouterr().err
    found = ThicknessMap.read_fits(tmp_path / "fit" / "thickness.fits")
    good = found.mask == 0
    assert good.mean() > 0.95
    # The map of a whole sensor on few pixels: more than half an order from pixel to pixel where it is steep.
    assert np.mean(np.abs(found.value - THICKNESS_UM)[good] > 0.02) < 1e-3


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"MONOWL": None}, "MONOWL is 'missing'"),
        ({"MONOWL": 9500.0}, "200 to 1300"),
        ({"MONOWL": "blue"}, "a number"),
        ({"BUNIT": None}, "BUNIT is 'missing'"),
        ({"BUNIT": "adu"}, "GAIN is 'missing'"),
        ({"BUNIT": "adu", "GAIN": -1.0}, "positive"),
        ({"BUNIT": "jansky"}, "electron, or adu"),
        ({"IMGTYPE": "DARK"}, "one flat or more"),
        ({"WAVELEN": 957.0}, "one wavelength"),
        ({"RDNOISE": -3.0}, "0 or more"),
        ({"SATURATE": "NaN"}, "positive"),
        ({"TEMPK": -90.0}, "K from 73"),
        ({"CCDTEMP": 183.0}, "°C from -200"),
        ({"DATASEC": "[11:20,1:20]"}, "overscan"),
    ],
)
def test_what_is_missing_is_said(tmp_path: Path, cards: dict[str, Any], words: str) -> None:
    path = write(tmp_path / "one.fits", np.ones((20, 30)), **{"MONOWL": 950.0, "BUNIT": "electron", **cards})
    with pytest.raises(InputError, match=words):
        read_plain_flats([path], **LIGHT)


def test_images_of_other_shapes_are_refused(tmp_path: Path) -> None:
    paths = [
        write(tmp_path / f"{rows}.fits", np.ones((rows, 30)), MONOWL=950.0 + rows, BUNIT="electron")
        for rows in (20, 21)
    ]
    with pytest.raises(InputError, match=r"shape is \(21, 30\)"):
        read_plain_flats(paths, **LIGHT)


def test_what_two_headers_say_differently_is_refused(tmp_path: Path) -> None:
    image = fits.ImageHDU(np.ones((20, 30), np.float32), fits.Header({"BUNIT": "electron", "MONOWL": 950.0}))
    fits.HDUList([fits.PrimaryHDU(header=fits.Header({"MONOWL": 957.0})), image]).writeto(tmp_path / "f.fits")
    with pytest.raises(InputError, match=r"950\.0 and 957\.0"):
        read_plain_flats([tmp_path / "f.fits"], **LIGHT)


def test_flats_of_two_sensors_are_refused(tmp_path: Path) -> None:
    paths = [
        write(tmp_path / f"{k}.fits", np.ones((20, 30)), MONOWL=950.0 + k, BUNIT="e", DETNAME=f"S{k}")
        for k in range(2)
    ]
    with pytest.raises(InputError, match="flats of one sensor"):
        read_plain_flats(paths, **LIGHT)


def test_a_copy_counts_once_and_is_named(flats: Path, tmp_path: Path, capsys) -> None:
    shutil.copy(flats / "3.fits", flats / "renamed.fits")
    assert read_plain_flats(flats.iterdir(), **LIGHT).shape[0] == 12
    assert (
        run(["discover", str(flats), "--cells", "100", "--time-budget", "1e-9", "--out", str(tmp_path)]) == 0
    )
    assert "renamed.fits" in capsys.readouterr().err


def test_equal_pixels_at_another_wavelength_are_refused(flats: Path) -> None:
    shutil.copy(flats / "3.fits", flats / "renamed.fits")
    fits.setval(flats / "renamed.fits", "MONOWL", value=915.0, ext=1)
    with pytest.raises(InputError, match="light of its own"):
        read_plain_flats(flats.iterdir(), **LIGHT)


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"TEMPK": 173.0, "CCDTEMP": 20.0}, "TEMPK and CCDTEMP"),
        ({"MONOWL": 950.0, "WAVELEN": 960.0}, "MONOWL and WAVELEN"),
        ({"EXPTIME": 0.0}, "EXPTIME"),
        ({"IMGTYPE": "BIAS", "EXPTIME": 3.0}, "EXPTIME"),
        ({"FILTER": "r_57"}, "FILTER"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path: Path, cards: dict[str, Any], words: str) -> None:
    path = write(tmp_path / "a.fits", np.ones((20, 30)), **{"MONOWL": 950.0, "BUNIT": "e", **cards})
    with pytest.raises(InputError, match=rf"a\.fits: {words}"):
        read_plain_flats([path], **LIGHT)


def test_two_temperatures_that_agree_are_one(tmp_path: Path) -> None:
    cards = {"TEMPK": 173.0, "CCDTEMP": -100.5, "EXPTIME": 3.0, "FILTER": "y_10"}
    path = write(tmp_path / "a.fits", np.ones((20, 30)), MONOWL=950.0, BUNIT="e", **cards)
    assert read_plain_flats([path], **LIGHT).exposures.temperature_k[0] == 173.0


@pytest.mark.parametrize("damage", [b"", b"no FITS file", None])
def test_a_damaged_one_is_named_and_can_be_skipped(flats: Path, damage: bytes | None, capsys) -> None:
    content = (flats / "4.fits").read_bytes()
    (flats / "4.fits").write_bytes(content[: len(content) // 2] if damage is None else damage)
    words = ["fit", str(flats), "--setup", "ts8_e2v", "--out", str(flats.parent / "out"), "--dry-run"]
    assert run(words) == 1
    said = capsys.readouterr().err
    assert "4.fits" in said
    assert "0.fits" not in said
    assert run([*words, "--skip-bad"]) == 0
    assert "11 flats" in capsys.readouterr().err


def test_one_without_its_wavelength_is_named_and_can_be_skipped(flats: Path, capsys) -> None:
    fits.delval(flats / "4.fits", "MONOWL", ext=1)
    words = ["fit", str(flats), "--setup", "ts8_e2v", "--out", str(flats.parent / "out"), "--dry-run"]
    assert run(words) == 1
    assert "4.fits: MONOWL" in capsys.readouterr().err
    assert run([*words, "--skip-bad"]) == 0


def test_what_is_wrong_with_all_of_them_is_said_of_plain_flats(flats: Path, capsys) -> None:
    for path in flats.iterdir():
        with fits.open(path, mode="update") as hdus:
            hdus[-1].header["NOISE"] = False
    assert (
        run(["fit", str(flats), "--setup", "ts8_e2v", "--out", str(flats.parent / "fit"), "--dry-run"]) == 1
    )
    said = capsys.readouterr().err
    assert said.count("NOISE is False") == len(WAVELENGTHS_NM)
    assert "amplifier" not in said


def test_a_dry_run_reads_no_pixels(flats: Path, tmp_path: Path, capsys) -> None:
    """Compressed pixels that cannot be unpacked, behind headers that are sound."""
    for path in list(flats.iterdir()):
        with fits.open(path) as hdus:
            made = fits.CompImageHDU(hdus[-1].data, hdus[-1].header, compression_type="GZIP_1")
            fits.HDUList([fits.PrimaryHDU(), made]).writeto(path, overwrite=True)
        content = path.read_bytes()
        place = content.index(b"\x1f\x8b")
        path.write_bytes(content[: place + 10] + b"\xff" * 40 + content[place + 50 :])
    words = ["fit", str(flats), "--setup", "ts8_e2v", "--out", str(tmp_path / "out")]
    assert run([*words, "--dry-run"]) == 0
    assert "would prepare 14 frames" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert run(words) == 1
    assert ".fits: file is" in capsys.readouterr().err


def amplifiers(path: Path, electrons: np.ndarray, **cards: Any) -> Path:
    """A frame of three amplifiers over each other, read to the left, to the right and downwards, with overscan."""
    header = fits.Header({"INSTRUME": "MyCam", "DETNAME": "one", "IMGTYPE": "FLAT", "CCDTEMP": -90.0} | cards)
    hdus = [fits.PrimaryHDU(header=header)]
    ny, nx = electrons.shape
    senses = (
        (slice(None), slice(None)),
        (slice(None), slice(None, None, -1)),
        (slice(None, None, -1), slice(None)),
    )
    for number, (gain, sense) in enumerate(zip((0.5, 1.0, 2.0), senses, strict=True)):
        rows = slice(ny // 3 * number, ny // 3 * (number + 1))
        counts = np.full((ny // 3 + 2, nx + 9), 1000 + 100 * number, np.int32)
        counts[1:-1, 4:-5] += np.rint(electrons[rows][sense] / gain).astype(np.int32)
        x, y = (1, nx), (rows.start + 1, rows.stop)
        x, y = (x[::-1] if number == 1 else x), (y[::-1] if number == 2 else y)
        own = {
            "EXTNAME": f"AMP{number}",
            "DATASEC": f"[5:{nx + 4},2:{ny // 3 + 1}]",
            "DETSEC": f"[{x[0]}:{x[1]},{y[0]}:{y[1]}]",
            "BUNIT": "ADU",
            "GAIN": gain,
            "RDNOISE": 3.0 + number,
            "SATURATE": 5000.0,
        }
        hdus.append(fits.ImageHDU(counts, fits.Header(own)))
    fits.HDUList(hdus).writeto(path)
    return path


def test_any_number_of_amplifiers(tmp_path: Path) -> None:
    truth = 2.0 * np.arange(9 * 7, dtype=float).reshape(9, 7) + 400.0
    truth[1, 2] = 4000.0  # 8000 counts of the first amplifier, and 4000 of the second
    truth[4, 2] = 4000.0
    path = amplifiers(tmp_path / "flat.fits", truth, MONOWL=950.0)
    cube = read_plain_flats([path], temperature_k=170.0, bandwidth_fwhm_nm=2.0)
    np.testing.assert_array_equal(cube.image[0], truth)
    noise = np.repeat([3.0, 4.0, 5.0], 3)[:, np.newaxis]
    np.testing.assert_allclose(cube.variance[0], truth + noise**2)
    assert set(zip(*(axis.tolist() for axis in np.nonzero(cube.mask[0])), strict=True)) == {(1, 2), (4, 2)}
    assert cube.detector == "one"
    np.testing.assert_allclose(cube.exposures.temperature_k, 183.15)


def test_bias_frames_of_amplifiers_are_subtracted(tmp_path: Path) -> None:
    pattern = np.tile([0.0, 2.0, 4.0, 2.0, 0.0, 4.0, 2.0], (9, 1))
    truth = np.full((9, 7), 1000.0) + pattern
    flat = amplifiers(tmp_path / "flat.fits", truth, MONOWL=950.0)
    bias = amplifiers(tmp_path / "bias.fits", pattern, IMGTYPE="BIAS")
    cube = read_plain_flats([flat, bias], temperature_k=170.0, bandwidth_fwhm_nm=2.0)
    np.testing.assert_array_equal(cube.image[0], 1000.0)
    assert cube.metadata["NBIAS"] == 1


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"INSTRUME": None}, "INSTRUME, which names the camera"),
        ({"INSTRUME": "LSSTCam"}, "INSTRUME, which names the camera"),
        ({"LSST_NUM": "E2V-CCD250-321"}, "INSTRUME, which names the camera"),
        ({"MONOWL": None}, "MONOWL"),
        ({"GAIN": 0.7}, "GAIN"),
    ],
)
def test_frames_of_amplifiers_that_are_none(tmp_path: Path, cards: dict[str, Any], words: str) -> None:
    path = amplifiers(tmp_path / "flat.fits", np.full((9, 7), 500.0), MONOWL=950.0)
    with fits.open(path, mode="update") as hdus:
        for keyword, value in cards.items():
            if value is None:
                del hdus[0].header[keyword]
            else:
                hdus[0].header[keyword] = value
    with pytest.raises(InputError, match=words):
        read_plain_flats([path], temperature_k=170.0, bandwidth_fwhm_nm=2.0)


def test_amplifiers_that_leave_a_gap(tmp_path: Path) -> None:
    path = amplifiers(tmp_path / "flat.fits", np.full((9, 7), 500.0), MONOWL=950.0)
    fits.setval(path, "DETSIZE", value="[1:7,1:12]", ext=0)
    with pytest.raises(InputError, match="DETSEC"):
        read_plain_flats([path], temperature_k=170.0, bandwidth_fwhm_nm=2.0)
