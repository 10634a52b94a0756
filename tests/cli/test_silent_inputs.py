"""What would be taken for something else without a word: keys twice, folders that are read and written, odd maps."""

from pathlib import Path
from typing import Any

import numpy as np
import product_makers as make
import pytest
from astropy.io import fits

from lsst.fringe_sim import products as p
from lsst.fringe_sim.cli.inputs import read_settings
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.cli.output import refuse_among_inputs
from lsst.fringe_sim.cli.parameters import effect_settings
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.resources import parse_user_yaml

# Settings ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("e.yaml", "bandwidth.fwhm: 2.0\nbandwidth.fwhm: 3.0\n"),
        ("e.yaml", "bandwidth: {fwhm: 2.0}\nbandwidth: {fwhm: 3.0}\n"),
        ("e.yaml", "bandwidth: {fwhm: 2.0, fwhm: 3.0}\n"),
        ("e.yaml", "bandwidth: {fwhm: 2.0}\nbandwidth.fwhm: 3.0\n"),
        ("e.py", 'config.effects["bandwidth.fwhm"] = 2.0\nconfig.effects["bandwidth.fwhm"] = 3.0\n'),
    ],
)
def test_an_effect_that_is_stated_twice_is_refused(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"{name}.*fwhm|{name}.*bandwidth"):
        read_settings(tmp_path / name)


def test_nested_effects_are_those_with_a_point(tmp_path: Path) -> None:
    (tmp_path / "e.yaml").write_text("bandwidth: {fwhm: 2.0}\nroughness.sigma: 3.0\n")
    assert read_settings(tmp_path / "e.yaml") == {"bandwidth.fwhm": 2.0, "roughness.sigma": 3.0}


def test_an_option_with_two_values_is_refused() -> None:
    assert effect_settings((("bandwidth.fwhm", 2.0), ("bandwidth.fwhm", 2.0))) == {"bandwidth.fwhm": 2.0}
    with pytest.raises(InputError, match="fwhm = 2 and 3"):
        effect_settings((("bandwidth.fwhm", 2.0), ("bandwidth.fwhm", 3.0)))


@pytest.mark.parametrize("content", ["a: 1\na: 1\n", "b: {c: [{d: 1, d: 2}]}\n", "1: x\n1: y\n"])
def test_a_key_of_a_description_stands_once(content: str) -> None:
    with pytest.raises(InputError, match=r"f\.yaml: key is"):
        parse_user_yaml(content, "set-up", source="f.yaml")


# Folders ----------------------------------------------------------------------------------------------------


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    (tmp_path / "r" / "below").mkdir(parents=True)
    (tmp_path / "r" / "a.fits").write_bytes(b"a")
    (tmp_path / "link").symlink_to(tmp_path / "r")
    return tmp_path / "r"


@pytest.mark.parametrize(
    ("given", "out"),
    [
        ("r", "r"),
        ("r", "r/below"),
        ("r", "r/new/deeper"),
        ("r", "link"),
        ("link", "r/new"),
        ("r/*.fits", "r"),
        ("r/**/*.fits", "r"),
        ("*", "r/new"),
        (".", "new"),
    ],
)
def test_products_do_not_go_among_the_frames(
    frames: Path, monkeypatch: pytest.MonkeyPatch, given: str, out: str
) -> None:
    monkeypatch.chdir(frames.parent)
    with pytest.raises(InputError, match="next run"):
        refuse_among_inputs(Path(out), ["r/a.fits", given])


@pytest.mark.parametrize(("given", "out"), [("r", "out"), ("r", "r2"), ("r/below", "r"), ("r/a.fits", "r")])
def test_products_may_go_elsewhere(
    frames: Path, monkeypatch: pytest.MonkeyPatch, given: str, out: str
) -> None:
    monkeypatch.chdir(frames.parent)
    refuse_among_inputs(Path(out), [given])


@pytest.mark.parametrize(
    "command",
    [
        ("fit", "r"),
        ("discover", "r"),
        ("templates", "r"),
        ("correct", "r", "--templates", "r/a.fits"),
        ("correct", "r/a.fits", "--templates", "r"),
    ],
)
@pytest.mark.parametrize("out", ["r", "r/new"])
def test_every_command_that_reads_folders_refuses_to_write_there(
    frames: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: tuple[str, ...],
    out: str,
) -> None:
    monkeypatch.chdir(frames.parent)
    assert run([*command, "--out", out]) == 1
    assert "which is read" in capsys.readouterr().err
    assert not (frames / "new").exists()


# Maps -------------------------------------------------------------------------------------------------------


def a_map(path: Path, **cards: Any) -> Path:
    make.thickness(mask=np.zeros((3, 4), np.int32)).write_fits(path)
    with fits.open(path, mode="update", checksum=True) as hdus:
        hdus[0].header.update(cards)
    return path


@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("LABTEMP", 1e9),
        ("LABTEMP", "cold"),
        ("LABTEMP", True),
        ("SCALESIG", "abc"),
        ("SCALESIG", -0.1),
        ("CONTRAST", "high"),
        ("CONTRSIG", -1.0),
        ("ORDMARG", "none"),
        ("CELLMISF", "bad"),
        ("RDNOISE", -3.0),
        ("SMOOTHPX", "wide"),
    ],
)
def test_numbers_among_the_metadata_are_what_they_can_be(tmp_path: Path, keyword: str, value: Any) -> None:
    path = a_map(tmp_path / "map.fits", **{keyword: value})
    with pytest.raises(InputError, match=f"map.fits: {keyword}"):
        p.ThicknessMap.read_any(path)
    for maker in (make.thickness, make.cube, make.sky, make.flat):
        with pytest.raises(InputError, match=keyword):
            maker(metadata={keyword: value})
    with pytest.raises(InputError, match=keyword):
        make.sky().write_fits(tmp_path / "other.fits", {keyword: value})


def test_a_map_whose_header_cannot_be_is_refused_before_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = a_map(tmp_path / "map.fits", LABTEMP=1e9)
    assert run(["sky", "--thickness", str(path), "--out", str(tmp_path / "sky"), "--dry-run"]) == 1
    assert "LABTEMP" in capsys.readouterr().err


def test_a_map_without_a_good_pixel_is_refused(tmp_path: Path) -> None:
    make.thickness(mask=np.full((3, 4), p.mask_bits("SLIP"), np.int32)).write_fits(tmp_path / "map.fits")
    with pytest.raises(InputError, match="good pixels"):
        p.ThicknessMap.read_any(tmp_path / "map.fits")


@pytest.mark.parametrize("ours", [True, False])
def test_an_uncertainty_in_another_unit_is_converted_or_refused(tmp_path: Path, ours: bool) -> None:
    """In nm it is what it was; in mm it would be larger than an order of the fringes."""
    path, known = tmp_path / "map.fits", make.thickness(mask=np.zeros((3, 4), np.int32))
    for factor, unit in ((1000.0, "nm"), (1.0, "mm"), (1.0, "K")):
        known.write_fits(path)
        with fits.open(path, mode="update", checksum=True) as hdus:
            hdus["SIGMA"].data *= np.float32(factor)
            hdus["SIGMA"].header["BUNIT"] = unit
            if not ours:
                del hdus[0].header["PRODUCT"]
        if unit == "nm":
            np.testing.assert_allclose(p.ThicknessMap.read_any(path).sigma, known.sigma, rtol=1e-5)
        else:
            with pytest.raises(InputError, match="SIGMA"):
                p.ThicknessMap.read_any(path)


@pytest.mark.parametrize("name", ["SIGMA", "MASK"])
def test_an_image_of_another_size_beside_a_foreign_map_is_refused(tmp_path: Path, name: str) -> None:
    images = [fits.PrimaryHDU(np.full((3, 4), 14.0)), fits.ImageHDU(np.zeros((2, 2), np.int16), name=name)]
    fits.HDUList(images).writeto(tmp_path / "map.fits")
    with pytest.raises(InputError, match=f"shape of {name}"):
        p.ThicknessMap.read_any(tmp_path / "map.fits")


def test_a_pattern_that_the_shell_has_spelled_out_is_one(
    frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(frames.parent)
    (frames / "b.fits").write_bytes((frames / "a.fits").read_bytes())
    assert run(["fit", "r/a.fits", "r/b.fits", "--out", "r"]) == 1
    assert "not in r/*.fits, which is read" in capsys.readouterr().err
