"""The files that a command was given stand in what it writes."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.model.provenance import input_cards, inputs_of_header
from lsst.fringe_sim.products import FlatExposures, FringeCube

WAVELENGTHS_NM = np.arange(880.0, 1000.0, 10.0)


def inputs_of(product: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    capsys.readouterr()
    assert run(["provenance", "--json", str(product)]) == 0
    (record,) = json.loads(capsys.readouterr().out)
    return record["inputs"]


def stated(*paths: Path) -> list[dict[str, str]]:
    return [
        {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()[:12]} for path in paths
    ]


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flats of a corner of a sensor, without noise to speak of."""
    thickness = e2v_321((64, 96))
    response = FringeModel.from_setup("ts8_e2v").response(thickness.ravel(), WAVELENGTHS_NM)
    image = (20000.0 * response / response.mean(axis=1, keepdims=True)).reshape(-1, *thickness.shape)
    path = tmp_path_factory.mktemp("cube") / "cube.fits"
    FringeCube(
        image=image.astype(np.float32),
        variance=image.astype(np.float32),
        mask=np.zeros(image.shape, np.int32),
        exposures=FlatExposures(WAVELENGTHS_NM, np.array(2.0), np.array(173.15)),
    ).write_fits(path)
    return path


@pytest.mark.slow
def test_map_and_frame_name_what_they_are_made_of(
    cube: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    effects = tmp_path / "effects.yaml"
    effects.write_text("roughness: {sigma: 2.0}\n")
    given = ("--effects-file", str(effects))
    assert run(["fit", str(cube), "--out", str(tmp_path / "fit"), *given]) == 0
    thickness = tmp_path / "fit" / "thickness.fits"
    assert inputs_of(thickness, capsys) == stated(cube, effects)
    assert run(["sky", "--thickness", str(thickness), "--out", str(tmp_path / "sky"), *given]) == 0
    (frame,) = (tmp_path / "sky").glob("*.fits")
    assert inputs_of(frame, capsys) == stated(thickness, effects)
    capsys.readouterr()
    assert run(["provenance", str(frame)]) == 0
    assert f"    thickness.fits {stated(thickness)[0]['sha256']}\n" in capsys.readouterr().out


@pytest.mark.slow
def test_a_map_names_every_raw_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raws = tmp_path / "raws"
    size = ("--size", "256x200", "--wavelengths", "880:990:10", "--bias-frames", "2")
    assert run(["mock-flats", str(raws), *size, "--seed", "3"]) == 0
    assert run(["fit", str(raws), "--out", str(tmp_path / "fit")]) == 0
    found = inputs_of(tmp_path / "fit" / "thickness.fits", capsys)
    frames = [path for path in raws.iterdir() if path.suffix == ".fits"]
    assert len(frames) == 14
    assert sorted(found, key=lambda item: item["file"]) == sorted(
        stated(*frames), key=lambda item: item["file"]
    )


@pytest.mark.parametrize("name", ["plain.fits", "two words.fits", "Flächentreue µ.fits", "x" * 200, "it's"])
def test_any_file_name_comes_back_from_a_header(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(b"content")
    product = tmp_path / "product.fits"
    header = fits.Header()
    header.update(input_cards([path, str(path)]))
    fits.PrimaryHDU(header=header).writeto(product)
    ((found, content),) = inputs_of_header(fits.getheader(product))
    assert found == "".join(letter if letter.isascii() else ascii(letter)[1:-1] for letter in name)
    assert content == hashlib.sha256(b"content").hexdigest()[:12]


def test_another_content_is_another_input(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"one")
    first = input_cards([path])
    path.write_bytes(b"two")
    assert input_cards([path]) != first
