"""Observed frames and templates as they should not be: each is refused by its name, and the others are used."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from made_once import made_once
from observed_night import observed_night

from lsst.fringe_sim.cli.main import run

NAME = "visit_1.fits"  # The frame that is spoiled


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A night, its templates, and one corrected frame."""

    def make(folder: Path) -> None:
        (folder / "night").mkdir()
        frames = observed_night(np.random.default_rng(44), 4, side=72, stars=4)
        for number, image in enumerate(frames.images):
            header = fits.Header({"DETNAME": "S11", "FILTER": "y", "BUNIT": "electron"})
            fits.PrimaryHDU(image, header).writeto(folder / "night" / f"visit_{number}.fits")
        assert templates(folder / "night", folder / "templates") == 0
        assert correct(folder / "templates", folder / "corrected", folder / "night" / NAME) == 0

    return made_once(tmp_path_factory, "observed_faults", make)


@pytest.fixture
def night(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made / "night", tmp_path / "night"))


def templates(night: Path, out: Path, *more: str) -> int:
    return run(["templates", str(night), "--components", "1", "--out", str(out), *more])


def correct(made: Path, out: Path, *frames: Path, more: tuple[str, ...] = ()) -> int:
    words = ["correct", *map(str, frames), "--templates", str(made), "--out", str(out), *more]
    return run(words)


def rewrite(path: Path, change: Callable[[np.ndarray], np.ndarray] = np.copy, **cards: Any) -> None:
    """The frame with other pixels and cards; a card that is `None` is taken away."""
    image, header = fits.getdata(path), fits.getheader(path)
    for keyword, value in cards.items():
        header.remove(keyword, ignore_missing=True)
        if value is not None:
            header[keyword] = value
    fits.PrimaryHDU(change(image), header).writeto(path, overwrite=True)


def cut_short(night: Path) -> None:
    path = night / NAME
    path.write_bytes(path.read_bytes()[:9000])


def cannot_be_unpacked(night: Path) -> None:
    path = night / NAME
    packed = fits.CompImageHDU(fits.getdata(path), fits.getheader(path), compression_type="GZIP_1")
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(path, overwrite=True)
    content = path.read_bytes()
    place = content.index(b"\x1f\x8b") + 10
    path.write_bytes(content[:place] + b"\xff" * 40 + content[place + 40 :])


def one_value(night: Path) -> None:
    rewrite(night / NAME, np.zeros_like)


def no_number(night: Path) -> None:
    rewrite(night / NAME, lambda image: image * np.nan)


def beyond_all_measure(night: Path) -> None:
    rewrite(night / NAME, lambda image: image * np.float32(1e34))


def other_filter(night: Path) -> None:
    rewrite(night / NAME, FILTER="z")


def other_sensor(night: Path) -> None:
    rewrite(night / NAME, DETNAME="S12")


def corrected_before(night: Path) -> None:
    rewrite(night / NAME, FRINGCOR=1)


def mask_of_no_plane(night: Path) -> None:
    image, header = fits.getdata(night / NAME), fits.getheader(night / NAME)
    mask = fits.ImageHDU(np.zeros(image.shape, np.int32), fits.Header({"MP_BAD": 99}), "MASK")
    fits.HDUList([fits.PrimaryHDU(image, header), mask]).writeto(night / NAME, overwrite=True)


def block_beyond_all_numbers(night: Path) -> None:
    def change(image: np.ndarray) -> np.ndarray:
        image[10:30, 10:30] = 3e38
        return image

    rewrite(night / NAME, change)


def variance_of_another_unit(night: Path) -> None:
    image, header = fits.getdata(night / NAME), fits.getheader(night / NAME)
    variance = fits.ImageHDU((1e20 * image).astype(np.float32), name="VARIANCE")
    fits.HDUList([fits.PrimaryHDU(image, header), variance]).writeto(night / NAME, overwrite=True)


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [block_beyond_all_numbers, variance_of_another_unit])
def test_numbers_that_single_precision_cannot_square_do_not_matter(
    made: Path, night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], None]
) -> None:
    """Such pixels are left out, without a warning, and a variance counts up to a factor."""
    spoil(night)
    assert correct(made / "templates", tmp_path / "out", night / NAME) == 0
    assert "fringes at" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "spoil",
    [
        cut_short,
        cannot_be_unpacked,
        one_value,
        no_number,
        beyond_all_measure,
        other_filter,
        other_sensor,
        corrected_before,
        mask_of_no_plane,
    ],
)
def test_one_bad_frame_is_named_and_the_others_are_corrected(
    made: Path, night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], None]
) -> None:
    spoil(night)
    assert correct(made / "templates", tmp_path / "out", night) == 1
    names = {f"visit_{number}_corrected.fits" for number in (0, 2, 3)}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*names, "frames.ecsv", "report.html"}
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "visit_1" in line]
    assert "allowed:" in line
    assert "visit_1" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("spoil", [cut_short, corrected_before])
def test_templates_are_made_without_a_bad_frame_only_if_that_is_asked_for(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], None]
) -> None:
    spoil(night)
    assert templates(night, tmp_path / "out", "--dry-run") == 1
    assert NAME in capsys.readouterr().err
    assert templates(night, tmp_path / "out", "--dry-run", "--skip-bad") == 0
    assert "from 3 frames" in capsys.readouterr().out


@pytest.mark.parametrize("spoil", [other_filter, one_value])
def test_a_dry_run_refuses_frames_that_the_run_refuses(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], None]
) -> None:
    spoil(night)
    assert templates(night, tmp_path / "out", "--dry-run") == 1
    said = capsys.readouterr().err
    assert templates(night, tmp_path / "out") == 1
    assert capsys.readouterr().err == said


def test_templates_of_an_image_without_light_are_refused(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one_value(night)
    assert templates(night, tmp_path / "out") == 1
    assert f"{NAME}: pixels is 'all equal'" in capsys.readouterr().err


def test_a_copy_among_the_frames_is_named(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(night / NAME, night / "again.fits")
    assert templates(night, tmp_path / "out") == 1
    said = capsys.readouterr().err
    assert "again.fits" in said
    assert NAME in said


def test_a_frame_that_is_given_twice_counts_once(
    made: Path, night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = (night / NAME, night, night / ".." / "night" / NAME)
    assert correct(made / "templates", tmp_path / "out", *frames, more=("--dry-run",)) == 0
    assert "would correct 4 images" in capsys.readouterr().out


@pytest.mark.parametrize("same", [str, str.upper])
def test_frames_that_would_become_one_file_are_refused(
    made: Path, night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], same: Callable[[str], str]
) -> None:
    (night / "other").mkdir()
    (night / "visit_0.fits").rename(night / "other" / NAME.replace("visit", same("visit")))
    assert correct(made / "templates", tmp_path / "out", night, night / "other") == 1
    assert f"both would become {same('visit')}_1_corrected.fits" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_sensors_that_would_become_one_file_are_refused(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, path in enumerate(sorted(night.iterdir())):
        shutil.copy(path, night / f"other_{number}.fits")
        rewrite(path, DETNAME="S_1")
        rewrite(night / f"other_{number}.fits", np.flipud, DETNAME="S 1")
    assert templates(night, tmp_path / "out") == 1
    assert "both become S_1" in capsys.readouterr().err


def test_images_of_one_file_are_of_different_sensors(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = fits.getdata(night / NAME)
    parts = [fits.PrimaryHDU(), fits.ImageHDU(image), fits.ImageHDU(image[::-1].copy())]
    fits.HDUList(parts).writeto(night / NAME, overwrite=True)
    assert templates(night, tmp_path / "out", "--dry-run") == 1
    assert "a name for each sensor of a file" in capsys.readouterr().err


def test_control_characters_in_a_name(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (night / NAME).rename(night / "vi\n\x1b[31msit.fits")
    assert templates(night, tmp_path / "out", "--dry-run") == 1
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err
    assert "printable characters" in said.err


@pytest.mark.parametrize("spoil", ["copy", "cut", "bit"])
def test_bad_templates_are_named_before_any_frame_is_read(
    made: Path, night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: str
) -> None:
    own = Path(shutil.copytree(made / "templates", tmp_path / "templates"))
    path = own / "templates_S11.fits"
    content = bytearray(path.read_bytes())
    if spoil == "copy":
        shutil.copy(path, own / "templates_again.fits")
    elif spoil == "cut":
        path.write_bytes(content[:20_000])
    else:
        content[20_000] ^= 1
        path.write_bytes(content)
    assert correct(own, tmp_path / "out", night, more=("--dry-run",)) == 1
    assert str(own) in capsys.readouterr().err


@pytest.mark.slow
def test_links_in_the_output_folder_are_replaced_and_not_followed(night: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "precious").write_text("precious")
    (out / "report.html").symlink_to(tmp_path / "precious")
    (out / "templates_S11.fits").symlink_to(tmp_path / "nowhere.fits")
    assert templates(night, out) == 1
    assert templates(night, out, "--overwrite") == 0
    assert not (out / "templates_S11.fits").is_symlink()
    assert (tmp_path / "precious").read_text() == "precious"
    assert not (tmp_path / "nowhere.fits").exists()


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"FRINGSC0": None}, "FRINGSC0 is None"),
        ({"FRINGSC0": "nan"}, "a finite number"),
        ({"FRINGSC0": 1e300}, "a finite number"),
        ({"FRINGCOR": 3}, "the number of the templates"),
        ({"FRINGTID": "deadbeef"}, "which the templates given have"),
    ],
)
def test_an_undoing_that_cannot_be_right_is_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], cards: dict[str, Any], words: str
) -> None:
    path = Path(shutil.copy(made / "corrected" / "visit_1_corrected.fits", tmp_path))
    rewrite(path, **cards)
    assert correct(made / "templates", tmp_path / "again", path, more=("--undo",)) == 1
    assert words in capsys.readouterr().out
    assert not list((tmp_path / "again").glob("*.fits"))


def test_a_frame_of_which_the_templates_are_made_is_named(
    made: Path, night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On its line, on the page and in the table; a frame with other noise is none of them."""
    rewrite(night / NAME, lambda image: np.random.default_rng(3).poisson(image).astype(np.float32))
    assert correct(made / "templates", tmp_path / "out", night / NAME, night / "visit_2.fits") == 0
    other, own = [line for line in capsys.readouterr().out.splitlines() if line.startswith("visit_")]
    words = "made of this frame itself"
    assert words in own
    assert words not in other
    assert "templates of this frame itself" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    table = Table.read(tmp_path / "out" / "frames.ecsv")
    assert list(table["of_own_templates"]) == [False, True]


def without_sky(path: Path) -> None:
    rewrite(path, lambda image: image - np.float32(np.median(image)))


def test_templates_of_frames_without_their_sky_are_no_parts_of_it(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their rms is that of the fringes in the unit of the frames, and who subtracted the sky is asked for it."""
    without_sky(night / NAME)
    assert templates(night, tmp_path / "some") == 1
    assert "frames without their sky is 1" in capsys.readouterr().err
    for number in (0, 2, 3):
        without_sky(night / f"visit_{number}.fits")
    assert templates(night, tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "--background puts it back" in said
    assert "%" not in said.partition(";")[0]
    with fits.open(tmp_path / "out" / "templates_S11.fits") as hdus:
        pattern, scores = hdus["PATTERNS"].data[0], hdus["SCORES"].data
        assert not hdus[0].header["PERSKY"]
    assert np.sqrt((scores**2).mean()) == pytest.approx(1.0, rel=0.01)
    # Fringes of 2 % of 2000 electrons.
    assert pattern.std() == pytest.approx(40.0 / np.sqrt(2.0), rel=0.2)
    assert correct(tmp_path / "out", tmp_path / "corrected", night / NAME) == 0
    assert "frames without a sky: 1 of 1" in capsys.readouterr().out
