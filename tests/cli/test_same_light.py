"""The same light twice counts once, or is refused; so are frames of two models together."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from product_makers import MAKERS

from lsst.fringe_sim.algorithms.flat_prep_options import DEFAULT_OPTIONS
from lsst.fringe_sim.cli.lab_frames import find_series
from lsst.fringe_sim.cli.sky_frames import read_sky_frames
from lsst.fringe_sim.errors import FrameFormatError, InputError
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.products import FringeCube, SkyFrames, SkyFringe


def flat_of(folder: Path) -> Path:
    return min(folder.glob("*_lambda_flat_*"))


def rename(folder: Path) -> None:
    shutil.copy(flat_of(folder), folder / "renamed.fits")


def compress(folder: Path) -> None:
    with fits.open(flat_of(folder)) as hdus:
        packed = [
            hdus[0].copy(),
            *(fits.CompImageHDU(hdu.data, hdu.header, tile_shape=None) for hdu in hdus[1:]),
        ]
        fits.HDUList(packed).writeto(folder / f"{flat_of(folder).name}.fz")


def copy_all(folder: Path) -> None:
    shutil.copytree(folder, folder / "copy")


@pytest.mark.parametrize("copied", [rename, compress, copy_all])
def test_a_copy_counts_once(raws: Path, copied, capsys: pytest.CaptureFixture[str]) -> None:
    copied(raws)
    series = find_series([str(raws)])
    assert (len(series.biases), len(series.flats)) == (2, 2)
    assert capsys.readouterr().err.count("not counted again") == 1


def test_one_exposure_with_two_contents_is_refused(raws: Path) -> None:
    rename(raws)
    with fits.open(raws / "renamed.fits", mode="update") as hdus:
        hdus[3].data[10, 10] += 1
    with pytest.raises(FrameFormatError, match="other pixels"):
        find_series([str(raws)])


@pytest.mark.parametrize("card", [("DATE-OBS", "2026-01-01T00:00:00.000"), ("MONOWL", 951.0)])
def test_equal_pixels_under_another_header_are_refused(raws: Path, card: tuple[str, object]) -> None:
    rename(raws)
    with fits.open(raws / "renamed.fits", mode="update") as hdus:
        del hdus[0].header["DAYOBS"]
        hdus[0].header["DATE-OBS"] = "2026-01-02T00:00:00.000"
        hdus[0].header[card[0]] = card[1]
    series = find_series([str(raws)])
    assert len(series.flats) == 3
    with pytest.raises(FrameFormatError, match="light of its own"):
        series.read(Setup.from_name("ts8_e2v"), DEFAULT_OPTIONS, lambda: None)


@pytest.mark.rng("planes")
def test_a_cube_with_one_flat_twice_is_refused(rng: np.random.Generator) -> None:
    image = rng.normal(1e4, 1e2, (1, 8, 8)).astype(np.float32)
    with pytest.raises(InputError, match="equal pixels in 0 and 1"):
        FringeCube.from_arrays(np.concatenate([image, image]), [900.0, 900.0])
    FringeCube.from_arrays(np.concatenate([image, image + 1.0]), [900.0, 900.0])


def sky(**cards: object) -> SkyFringe:
    frame = MAKERS["SkyFringe"]()
    return dataclasses.replace(frame, image=frame.image.copy(), metadata={**frame.metadata, **cards})


def brighter(frame: SkyFringe) -> SkyFringe:
    return dataclasses.replace(frame, image=frame.image * np.float32(1.01))


def thickness_of(frame: SkyFringe) -> np.ndarray:
    return np.full(frame.shape, 14.0, np.float32)


def test_a_sky_frame_counts_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame = dataclasses.replace(sky(), detector="")
    frame.write_fits(tmp_path / "a.fits")
    frame.write_fits(tmp_path / "b.fits")
    brighter(frame).write_fits(tmp_path / "c.fits")
    fits.PrimaryHDU(thickness_of(frame)).writeto(tmp_path / "thickness")
    data = read_sky_frames([str(tmp_path)], Setup.from_name("monocam"), str(tmp_path / "thickness"))
    assert len(data.sky.frames) == 2
    assert "b.fits" in capsys.readouterr().err


def sky_frames(*frames: SkyFringe) -> SkyFrames:
    template = SkyFrames.from_arrays(frames[0].image[np.newaxis], thickness_of(frames[0]))
    return SkyFrames(frames, template.thickness)


def test_sky_frames_in_python(tmp_path: Path) -> None:
    one = sky()
    assert len(sky_frames(one, brighter(one)).frames) == 2
    with pytest.raises(InputError, match="equal pixels"):
        sky_frames(one, one)
    with pytest.raises(InputError, match="one model"):
        sky_frames(sky(EFFVAL1=2.0), brighter(sky(EFFVAL1=3.0)))
    with pytest.raises(InputError, match="SETUP"):
        sky_frames(one, brighter(sky(SETUP="hsc")))
