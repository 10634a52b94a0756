"""One gate for every file from outside: what it is, how large it is, what it would write; refused in one sentence."""

import ast
import bz2
import gzip
import json
import lzma
import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import lsst.fringe_sim
from lsst.fringe_sim.cli.amplitudes import read_line_list
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import FrameFormatError, InputError, UnknownNameError
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.model.effects_override import effects_override
from lsst.fringe_sim.model.provenance import model_cards
from lsst.fringe_sim.resources import open_user_fits, parse_user_yaml, read_user_table, revision

SHIPPED = Path(lsst.fringe_sim.__file__).parent / "data" / "setups" / "ts8_e2v.yaml"
INJECTED = "x\nconfig.effects['bandwidth.fwhm'] = 9.0\nopen('executed', 'w')#"


def one_sentence(capsys: pytest.CaptureFixture[str]) -> str:
    """What the command complained of; nothing in it acts on a terminal."""
    message = capsys.readouterr().err.removesuffix("\n")
    assert message.isprintable()
    assert len(message) < 3000
    return message


@pytest.mark.parametrize("name", [INJECTED, "x\x1b[31m", "x\r", "\u2028", "a" * 201])
def test_a_name_that_is_no_name_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.yaml"
    if len(name) < 200:
        path.write_text(SHIPPED.read_text(encoding="utf-8"), encoding="utf-8")
        with pytest.raises(InputError, match="name of the set-up"):
            Setup.from_file(path)
    with pytest.raises(InputError, match="name of the set-up"):
        Setup.from_mapping(name, {})


@pytest.mark.parametrize("name", [INJECTED, "ts8_e2v", "süd"])
def test_nothing_but_effects_is_written_into_an_override(name: str) -> None:
    text = effects_override(
        {"bandwidth.fwhm": 2.5}, name, name, known={"roughness.sigma": 1.0}, detector=name
    )
    statements = ast.parse(text).body
    first, *rest = [ast.unparse(line) for line in statements]
    assert re.fullmatch(r"config\.written_effects = 'bandwidth\.fwhm roughness\.sigma [0-9a-f]{16}'", first)
    assert rest == ["config.effects['roughness.sigma'] = 1.0", "config.effects['bandwidth.fwhm'] = 2.5"]


def test_a_name_with_an_umlaut_is_a_name(tmp_path: Path) -> None:
    path = tmp_path / "süd.yaml"
    path.write_text(SHIPPED.read_text(encoding="utf-8"), encoding="utf-8")
    setup = Setup.from_file(path)
    FringeModel.from_setup(setup)
    header = fits.Header()
    header.update(model_cards(setup, {}))
    assert header["SETUP"] == "s\\xfcd"


@pytest.mark.parametrize(
    "name", ["disc2_60d2e3fc.json", "prov_nul.json", "prov_int.json", "prov_surrogate.json"]
)
def test_documents_that_broke_provenance(name: str, trials: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["provenance", str(trials / name)]) == 1
    assert name in one_sentence(capsys)


@pytest.mark.parametrize("text", ["\x1b]0;owned\x07", "a\x00b", "\ud800", "\x9b31m"])
@pytest.mark.parametrize("place", ["SETUP", "EFFECT0", "INPUT0", "LSST BUTLER ID", "X"])
def test_texts_that_act_on_a_terminal_are_refused(
    text: str, place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "verdict.json"
    path.write_text(json.dumps({"provenance": {place: text}}))
    assert run(["provenance", str(path)]) == 1
    one_sentence(capsys)
    path.write_text(json.dumps({"provenance": {place + text: 1}}))
    assert run(["provenance", str(path)]) == 1
    one_sentence(capsys)


@pytest.mark.parametrize(
    "name",
    ["../../../../../../../../etc/passwd", "media/../media/media.yaml", "/etc/passwd", "media//x", "./media.yaml",
     "..", "", "nowhere/media.yaml", "media/.", "media"],
)  # fmt: skip
def test_only_what_is_shipped_is_looked_up(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _, file = name.rpartition("/")
    with pytest.raises(UnknownNameError):
        revision(folder, file)
    path = tmp_path / "verdict.json"
    path.write_text(json.dumps({"provenance": {"TABLE0": f"{name} 12"}}))
    assert run(["provenance", "--json", str(path)]) == 0
    (record,) = json.loads(capsys.readouterr().out)
    assert record["tables"] == [{"table": name, "revision": "12", "here": "absent"}]


def test_tables_that_stand_for_more_than_they_are(trials: Path) -> None:
    for reader in (read_line_list, lambda path: read_user_table(path, "table")):
        with pytest.raises(InputError, match="reference"):
            reader(trials / "ecsv_bomb.ecsv")


@pytest.mark.parametrize(
    "text", ["a: !!int ''", "a: !!float ''", "a: !!binary 'é'", "a: !!timestamp x", "? {a: 1}\n: 2"]
)
def test_yaml_that_no_constructor_takes(text: str) -> None:
    with pytest.raises(InputError, match="settings"):
        parse_user_yaml(text, "settings")


@pytest.mark.parametrize("option", ["--setup", "--effects-file"])
def test_settings_that_broke_a_command(
    option: str, trials: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["none.fits", option, str(trials / "yaml_int_empty.yaml"), "--out", str(tmp_path / "out")]
    assert run(["fit", *given]) == 1
    assert "yaml_int_empty.yaml" in one_sentence(capsys)


def zipped(content: bytes) -> bytes:
    from io import BytesIO

    stream = BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frame.fits", content)
    return stream.getvalue()


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "gz": gzip.compress,
    "bz2": bz2.compress,
    "xz": lzma.compress,
    "zip": zipped,
}


@pytest.mark.parametrize("kind", sorted(PACKERS))
def test_what_is_small_only_on_the_disk_is_refused(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"frame.fits.{kind}"
    plain = tmp_path / "frame.fits"
    fits.PrimaryHDU(np.zeros((2000, 2000), np.float32)).writeto(plain)
    path.write_bytes(PACKERS[kind](plain.read_bytes()))
    with open_user_fits(path) as hdus:
        assert hdus[0].data.shape == (2000, 2000)
    # Of a gigabyte it is refused; here a megabyte stands for it.
    monkeypatch.setattr("lsst.fringe_sim.fits_gate._SMALL", 1 << 20)
    monkeypatch.setattr("lsst.fringe_sim.fits_gate._EXPANSION", 10)
    with pytest.raises(FrameFormatError, match="bytes in the file"), open_user_fits(path):
        pass
    with open_user_fits(plain):
        pass


def test_a_file_with_a_hole_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frame.fits"
    fits.PrimaryHDU().writeto(path)
    os.truncate(path, 1 << 40)
    with pytest.raises(FrameFormatError, match="bytes in the file"), open_user_fits(path):
        pass


@pytest.mark.parametrize("first", [b"", b"\0" * 5])
def test_a_compressed_image_that_claims_too_much_is_refused(tmp_path: Path, first: bytes) -> None:
    """Also behind what is not FITS, where astropy may look for the next header."""
    image = fits.CompImageHDU(np.zeros((40, 50), np.int32), compression_type="RICE_1")
    path = tmp_path / "claims.fits"
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(path)
    content = path.read_bytes()
    with open_user_fits(path) as hdus:
        assert hdus[1].data.shape == (40, 50)
    for axis in (b"ZNAXIS1", b"ZNAXIS2"):
        place = content.index(axis)
        content = content[:place] + (axis + b" = %20d" % 60_000).ljust(80) + content[place + 80 :]
    if first:  # a card that the standard does not know, so that sizes are open to interpretation
        content = content.replace(b"SIMPLE  =                    T", b"SIMPLE  =                    F", 1)
    path.write_bytes(content)
    with pytest.raises(FrameFormatError, match="bytes in the file"), open_user_fits(path):
        pass


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.fits")
    (tmp_path / "device.fits").symlink_to("/dev/zero")
    for name in ("fifo.fits", "device.fits"):
        with pytest.raises(FrameFormatError, match="regular file"), open_user_fits(tmp_path / name):
            pass


@pytest.mark.parametrize("command", ["fit", "discover"])
def test_a_path_that_leads_to_no_file(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A pipe, a device, a link to nothing: alone, and among what a pattern matches."""
    os.mkfifo(tmp_path / "pipe.fits")
    (tmp_path / "device.fits").symlink_to("/dev/zero")
    (tmp_path / "nothing.fits").symlink_to(tmp_path / "nowhere")
    for name in ("pipe.fits", "device.fits", "nothing.fits", "*.fits"):
        path = str(tmp_path / name)
        assert run([command, path, "--setup", "ts8_e2v", "--out", str(tmp_path / "out"), "--dry-run"]) == 1
        assert f"path is '{path}'" in capsys.readouterr().err


def test_a_long_value_is_not_repeated_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "effects.yaml"
    path.write_text("bandwidth: {fwhm: " + "x" * 600_000 + "}\n")
    assert run(["fit", "none.fits", "--effects-file", str(path), "--out", str(tmp_path / "out")]) == 1
    assert "600002 characters" in one_sentence(capsys)
    path.write_text("x" * 600_000 + ": {fwhm: 2.0}\n")
    assert run(["fit", "none.fits", "--effects-file", str(path), "--out", str(tmp_path / "out")]) == 1
    one_sentence(capsys)
