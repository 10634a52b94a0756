"""``fringe-sim provenance``: what a product says of its making."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from product_makers import thickness

from lsst.fringe_sim import __version__
from lsst.fringe_sim.algorithms.template_errors import template_errors
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.model.provenance import (
    effect_cards,
    effects_of_header,
    model_cards,
    software_cards,
    table_cards,
    tables_of,
)
from lsst.fringe_sim.resources import read_table, revision

EFFECTS = {"bandwidth.fwhm": 2.4, "roughness.sigma": 0.1 + 0.2, "black_coating.thickness": 1.0}
HEADER = {
    **software_cards(),
    **model_cards("ts8_e2v", EFFECTS),
    "QUADERR": 1e-9,
    "NIGHTSD": 7,
    "CFGHASH": "ab12",
}
INPUT = {
    "LSST BUTLER INPUT 0 ID": "not a number",
    "LSST BUTLER INPUT 0 DATASETTYPE": "fringeFlat",
    "LSST BUTLER RUN": "u/run",
}


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    assert run(["provenance", "--json", *map(str, arguments)]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def product(tmp_path: Path) -> Path:
    path = tmp_path / "thickness.fits"
    thickness(metadata=HEADER).write_fits(path, INPUT)
    return path


def test_a_file_tells_what_was_put_in(product: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (record,) = said(capsys, product)
    assert record["product"] == "ThicknessMap"
    assert record["software"]["lsst.fringe_sim"] == __version__
    assert record["software"]["numpy"] == np.__version__
    assert (record["setup"], record["effects"]) == ("ts8_e2v", EFFECTS)
    assert record["errors"] == {"quadrature": 1e-9}
    assert record["seeds"] == {"random nights": 7}
    assert record["configuration"] == {"this task": "ab12"}
    assert record["dataset"] == {"run": "u/run"}
    assert record["inputs"] == [{"id": "not a number", "datasettype": "fringeFlat"}]
    assert {item["here"] for item in record["tables"]} == {"same"}
    assert "media/nk_Si_green2008.ecsv" in {item["table"] for item in record["tables"]}


def test_numbers_that_differ_from_those_installed_are_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "old.fits"
    cards = {
        "TABLE0": "media/nk_Si_green2008.ecsv 000000000000",
        "TABLE1": "media/nk_Unobtainium.ecsv 123456789abc",
    }
    cards["TABLE2"] = "../../etc/passwd 123456789abc"
    thickness(metadata=cards).write_fits(path)
    (record,) = said(capsys, path)
    assert [item["here"] for item in record["tables"]] == ["differs", "absent", "absent"]
    assert run(["provenance", str(path)]) == 0
    assert "media/nk_Si_green2008.ecsv 000000000000 (differs here)" in capsys.readouterr().out


def test_tables_and_documents_tell_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = read_table("media", "nk_Si_green2008.ecsv")
    table.meta.update(HEADER)
    table.write(tmp_path / "forecast.ecsv", format="ascii.ecsv")
    (tmp_path / "verdict.json").write_text(json.dumps({"verdict": "named", "provenance": HEADER}))
    for record in said(capsys, tmp_path / "forecast.ecsv", tmp_path / "verdict.json"):
        assert (record["setup"], record["effects"]) == ("ts8_e2v", EFFECTS)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.fits", None, "existing file"),
        ("text.fits", b"not FITS", "undamaged"),
        ("empty.fits", b"", "undamaged"),
        ("cut.json", b"{", "undamaged"),
        ("bare.json", b"[]", "provenance"),
        ("bad.ecsv", b"# %ECSV 1.0\n# ---\n# {", "undamaged"),
    ],
)
def test_what_is_no_product_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes | None, message: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    assert run(["provenance", str(path)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert name in error


def test_a_folder_needs_a_dataset_type_and_a_repository(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["provenance", str(tmp_path)]) == 1
    assert "--dataset-type" in capsys.readouterr().err
    assert run(["provenance", str(tmp_path), "--dataset-type", "fringe"]) == 1
    assert "butler repository" in capsys.readouterr().err


def test_effects_come_back_exactly() -> None:
    assert effects_of_header(effect_cards(EFFECTS)) == EFFECTS
    assert effects_of_header({"EFFECTIV": 3.0}) == {}


@pytest.mark.parametrize("value", [{}, {"EFFVAL0": "much"}, {"EFFVAL0": None}, {"EFFVAL0": [1]}])
def test_an_effect_without_a_number_is_refused(
    value: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "verdict.json"
    path.write_text(json.dumps({"provenance": {"EFFECT0": "bandwidth.fwhm", **value}}))
    assert run(["provenance", str(path)]) == 1
    assert "EFFVAL0 is" in capsys.readouterr().err


def test_a_document_nested_too_deeply_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "deep.json"
    path.write_text("[" * 100_000)
    assert run(["provenance", str(path)]) == 1
    assert "an undamaged FITS, ECSV or JSON product" in capsys.readouterr().err


def test_tables_are_those_of_stack_effects_and_sky() -> None:
    lab, sky = (set(tables_of(Setup.from_name(name))) for name in ("ts8_e2v", "lsst_e2v"))
    assert ("sky", "oh_lines_palace_yband.ecsv") in sky - lab
    assert ("telescopes", "lsst.yaml") in sky - lab
    assert ("stacks", "e2v_ccd250.yaml") in sky & lab
    stated = table_cards([("media", "nk_Si_green2008.ecsv")])["TABLE0"]
    assert stated == f"media/nk_Si_green2008.ecsv {revision('media', 'nk_Si_green2008.ecsv')}"


def test_errors_of_templates_are_measured() -> None:
    model = FringeModel.from_setup("ts8_e2v", {"bandwidth.fwhm": 2.4})
    quadrature, interpolation = template_errors(model, [880.0, 990.0])
    assert 0.0 < quadrature < 1e-6
    # A straight line between points of a sine: amplitude * (phase step / 2)^2 / 2.
    assert 1e-6 < interpolation < 1e-4
    assert template_errors(model, [880.0, 990.0], (13.0, 14.0))[1] <= interpolation * 1.01


def test_a_key_stated_twice_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"provenance": {"SETUP": "ts8_e2v", "SETUP": "ts8_itl"}}', encoding="utf-8")
    assert run(["provenance", str(path)]) == 1
    assert "a.json: key is 'SETUP'" in capsys.readouterr().err


@pytest.mark.parametrize("key", ["SETUP", "EFFECT0", "TABLE0", "INPUT0", "VERSION X", "OTHER"])
def test_a_long_value_is_not_printed_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    path = tmp_path / "a.json"
    content = {"EFFVAL0": 1.0, key: "x" * 600_000}
    path.write_text(json.dumps({"provenance": content}), encoding="utf-8")
    assert run(["provenance", str(path)]) == 0
    assert len(capsys.readouterr().out) < 2000
