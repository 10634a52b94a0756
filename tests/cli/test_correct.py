"""``fringe-sim templates`` and ``fringe-sim correct`` on files of a small night."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from observed_night import observed_night
from recorded_numbers import Record

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.cli.observed import other_light
from lsst.fringe_sim.products import FringeFrame


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("night")
    frames = observed_night(np.random.default_rng(44), 4, side=72, stars=4)
    for number, image in enumerate(frames.images):
        hdu = fits.PrimaryHDU(image)
        hdu.header.update({"DETNAME": "S11", "FILTER": "y", "CRVAL1": 3.5, "DATE-OBS": "2026-01-02T03:04:05"})
        hdu.writeto(folder / f"visit_{number}.fits")
    return folder


@pytest.fixture(scope="module")
def made(night: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "templates"
    assert run(["templates", str(night), "--amplifiers", "2x1", "--components", "1", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def corrected(night: Path, made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "corrected"
    words = ["correct", str(night), "--templates", str(made), "--amplifiers", "2x1", "--out", str(out)]
    assert run(words) == 0
    return out


def test_sources_are_drawn_into_copies(night: Path, made: Path, corrected: Path, tmp_path: Path) -> None:
    """The table tells their fluxes; the products are those of a run without them."""
    words = [
        "correct",
        str(night),
        "--templates",
        str(made),
        "--amplifiers",
        "2x1",
        "--out",
        str(tmp_path / "o"),
    ]
    assert run([*words, "--inject", "--pixel-scale", "0.8"]) == 0
    table = Table.read(tmp_path / "o" / "injected.ecsv")
    assert set(table["kind"]) == {"point", "extended"}
    assert set(table["name"]) == {f"visit_{number}" for number in range(4)}
    bright = table[table["magnitude"] == np.min(table["magnitude"])]
    assert np.abs(bright["bias_after"]).max() < 0.2
    for number in range(4):
        name = f"visit_{number}_corrected.fits"
        np.testing.assert_array_equal(fits.getdata(tmp_path / "o" / name), fits.getdata(corrected / name))


def test_templates_and_report_are_written(made: Path) -> None:
    assert {file.name for file in made.iterdir()} == {"templates_S11.fits", "report.html"}
    header = fits.getheader(made / "templates_S11.fits")
    assert header["CALIB_CREATION_DATETIME"] == "2026-01-02T03:04:05"
    assert header["NFRAMES"] == 4


def test_one_row_per_frame_and_one_page(corrected: Path) -> None:
    table = Table.read(corrected / "frames.ecsv")
    assert len(table) == 4
    assert all(table["passed"])
    assert (table["structure_after"] < 0.5 * table["structure_before"]).all()
    assert "visit_3" in (corrected / "report.html").read_text(encoding="utf-8")


def test_the_header_says_what_was_done_and_keeps_what_it_said(corrected: Path) -> None:
    header = fits.getheader(corrected / "visit_2_corrected.fits")
    assert header["FRINGCOR"] == 1
    assert header["FRINGSC0"] == pytest.approx(2000.0, rel=0.6)
    assert header["FRINGSE0"] > 0.0
    assert (header["CRVAL1"], header["DATE-OBS"]) == (3.5, "2026-01-02T03:04:05")


def test_a_second_correction_is_refused(
    corrected: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["correct", str(corrected), "--templates", str(made), "--out", str(tmp_path / "again")]) == 1
    assert "FRINGCOR is 1" in capsys.readouterr().err
    assert run(["templates", str(corrected), "--out", str(tmp_path / "more")]) == 1


def test_undo_restores_the_frames(night: Path, corrected: Path, made: Path, tmp_path: Path) -> None:
    words = ["correct", str(corrected), "--templates", str(made), "--undo", "--out", str(tmp_path)]
    assert run(words) == 0
    before, (after, header) = (
        fits.getdata(night / "visit_1.fits"),
        fits.getdata(tmp_path / "visit_1_restored.fits", header=True),
    )
    np.testing.assert_allclose(after, before, rtol=3e-7)
    assert not [card for card in header if card.startswith("FRINGS") or card == "FRINGCOR"]
    assert header["CRVAL1"] == 3.5
    assert (
        run(["correct", str(night), "--templates", str(made), "--undo", "--out", str(tmp_path / "no")]) == 1
    )


def test_a_template_of_another_sensor_is_refused(
    night: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = fits.getdata(night / "visit_0.fits")
    fits.PrimaryHDU(image, fits.Header({"DETNAME": "S12"})).writeto(tmp_path / "other.fits")
    words = [
        "correct",
        str(tmp_path / "other.fits"),
        "--templates",
        str(made),
        "--out",
        str(tmp_path / "out"),
    ]
    assert run(words) == 1
    assert "did you mean S11" in capsys.readouterr().out


def template_file(folder: Path, pattern: np.ndarray) -> Path:
    """A folder with one template of sensor S11."""
    flat = np.zeros(pattern.shape)
    image = pattern - pattern.mean()
    frame = FringeFrame(image, flat.astype(int), flat, "y", "2026-01-01T00:00:00", detector="S11")
    folder.mkdir()
    frame.write_fits(folder / "fringe_0.fits")
    return folder


def correct(templates: Path, out: Path, *frames: Path) -> int:
    return run(["correct", *map(str, frames), "--templates", str(templates), "--out", str(out)])


def test_a_frame_without_the_fringes_of_the_templates_is_left_as_it_is(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    y, x = np.mgrid[:72, :72]
    other = template_file(tmp_path / "other", 0.01 * np.sin(y / 2.2 + x / 7.0))
    path, out = night / "visit_0.fits", tmp_path / "out"
    assert correct(other, out, path) == 0
    assert "not seen" in capsys.readouterr().out
    after = out / "visit_0_corrected.fits"
    np.testing.assert_array_equal(fits.getdata(after), fits.getdata(path))
    assert fits.getheader(after)["FRINGCOR"] == 0
    row = Table.read(out / "frames.ecsv")[0]
    assert not row["seen"]
    assert row["structure_after"] == row["structure_before"]
    words = ["correct", str(after), "--templates", str(other), "--undo", "--out", str(tmp_path / "restored")]
    assert run(words) == 0
    np.testing.assert_array_equal(
        fits.getdata(tmp_path / "restored" / "visit_0_restored.fits"), fits.getdata(path)
    )


def test_two_runs_write_the_same_bytes_and_digits_of_the_file_are_kept(
    night: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pixels of 64 bits stay so, and the unit of the frame is that of the scales."""
    image, header = fits.getdata(night / "visit_0.fits"), fits.getheader(night / "visit_0.fits")
    header["BUNIT"] = "adu"
    source = tmp_path / "long.fits"
    finer = image + np.random.default_rng(5).uniform(0.0, 1e-6, image.shape)
    fits.PrimaryHDU(finer, header).writeto(source)
    for name in ("first", "second"):
        assert correct(made, tmp_path / name, source) == 0
    assert " adu (" in capsys.readouterr().out
    first, second = (tmp_path / name / "long_corrected.fits" for name in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()
    pixels, cards = fits.getdata(first, header=True)
    assert pixels.dtype.itemsize == 8
    assert cards.comments["FRINGSC0"].startswith("[adu]")
    subtracted = (finer - pixels) / cards["FRINGSC0"]
    with fits.open(made / "templates_S11.fits") as hdus:
        pattern = hdus["PATTERNS"].data[0]
    # Where few frames see the sky nothing is subtracted.
    assert np.ptp((subtracted - pattern)[subtracted != 0.0]) < 1e-5 * np.ptp(pattern)
    with fits.open(first, checksum=True) as hdus:
        assert all(hdu.verify_checksum() == 1 for hdu in hdus)


def test_a_frame_that_names_no_sensor_is_refused(
    night: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Templates of a sensor are not those of any."""
    fits.PrimaryHDU(fits.getdata(night / "visit_0.fits")).writeto(tmp_path / "plain.fits")
    assert correct(made, tmp_path / "out", tmp_path / "plain.fits") == 1
    assert "S11" in capsys.readouterr().out


def test_a_frame_that_was_negated_is_refused(
    night: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image, header = fits.getdata(night / "visit_0.fits"), fits.getheader(night / "visit_0.fits")
    fits.PrimaryHDU(-image, header).writeto(tmp_path / "negative.fits")
    assert correct(made, tmp_path / "out", tmp_path / "negative.fits") == 1
    assert "sky of the frame" in capsys.readouterr().out


def test_a_frame_to_which_templates_add_structure_is_not_written(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(7)
    image = fits.getdata(night / "visit_0.fits").astype(float)
    pattern = (image - image.mean()) / image.mean() + 0.02 * rng.standard_normal(image.shape)
    pattern = np.clip(pattern, -0.05, 0.05)
    rolled = np.roll(pattern, 1, axis=0) * (rng.random(image.shape) < 0.5)
    out = tmp_path / "out"
    assert correct(template_file(tmp_path / "model", rolled), out, night / "visit_0.fits") == 1
    assert "add structure" in capsys.readouterr().out
    assert not list(out.glob("*.fits"))
    assert "refused" in (out / "report.html").read_text(encoding="utf-8")


def test_dry_run_writes_nothing(night: Path, made: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(["templates", str(night), "--out", str(out), "--dry-run"]) == 0
    assert run(["correct", str(night), "--templates", str(made), "--out", str(out), "--dry-run"]) == 0
    assert not out.exists()


@pytest.mark.parametrize(
    ("template", "frame", "refused"),
    [
        ("lsst_y", "g", True),
        ("lsst_y", "y_10", False),
        ("hsc_y", "HSC-Y", False),
        ("lsst_y", "Y DECam c0005", False),
    ],
)
def test_bands_of_a_model_and_of_a_frame_must_agree(template, frame, refused) -> None:
    assert other_light(template, frame, True) is refused
    assert other_light(template, frame, False)


@pytest.mark.parametrize(
    "cards",
    [
        {"FRINGE": "c4d_fringe_y.fits", "FRGSCALE": 0.8},
        {"FRGFLAG": "Y", "SKYFSUB": "sky.fits"},
        {"FRNGMDL": "c01"},
    ],
    ids=["DECam", "Mosaic-3", "ZTF"],
)
def test_a_primary_header_that_tells_of_a_correction_is_believed(
    night: Path, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], cards: dict[str, str | float]
) -> None:
    """The image is in an extension of its own, as those pipelines write it, and its header says nothing."""
    image, header = fits.getdata(night / "visit_0.fits"), fits.getheader(night / "visit_0.fits")
    path = tmp_path / "c4d_ooi_y_v1.fits"
    parts = [fits.PrimaryHDU(header=fits.Header(cards)), fits.ImageHDU(image, header, name="S11")]
    fits.HDUList(parts).writeto(path)
    assert correct(made, tmp_path / "out", path) == 1
    assert f"{next(iter(cards))} is" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_templates_and_corrected_frames_are_as_recorded(
    made: Path, corrected: Path, recorded: Record
) -> None:
    """A record of what is written today, for edits that are not meant to change it."""
    recorded({"templates": made, "corrected": corrected})
