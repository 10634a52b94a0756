"""``fringe-sim evidence``: what it would compare, what it refuses, and the whole of it on two effects."""

import json

import pytest

from lsst.fringe_sim.cli.main import run


def test_dry_run_names_the_sets_and_writes_nothing(tmp_path, capsys) -> None:
    out = tmp_path / "out"
    arguments = ["--effect", "bandwidth", "--effect", "diffuse_gate_side", "--out", str(out), "--dry-run"]
    assert run(["evidence", *arguments]) == 0
    told = capsys.readouterr().out
    assert "bandwidth + diffuse_gate_side" in told
    assert "no effect at all" in told
    assert not out.exists()


@pytest.mark.parametrize("name", ["no_such_effect", "bandwidth.width", "wavelength_jitter"])
def test_bad_effects_are_refused_before_work(name, tmp_path, capsys) -> None:
    assert run(["evidence", "--effect", name, "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert name.split(".")[0] in told or "3 at most" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_effect_of_the_bench_and_one_of_the_sensor(tmp_path, capsys) -> None:
    """The same twice; together far better than either; each kind foretold; the sky takes only one of them along."""
    contents = []
    for name in ("one", "two"):
        arguments = ["--effect", "bandwidth", "--effect", "contrast_loss", "--out", str(tmp_path / name)]
        assert run(["evidence", *arguments]) == 0
        contents.append((tmp_path / name / "evidence.json").read_bytes())
    assert contents[0] == contents[1]
    found = json.loads(contents[0])
    sets = {item["effects"]: item for item in found["sets"]}
    assert set(sets) == {"none", "bandwidth", "contrast_loss", "bandwidth + contrast_loss"}
    both = sets["bandwidth + contrast_loss"]
    assert both["log_evidence"] > max(sets[name]["log_evidence"] for name in sets if name != both["effects"])
    assert both["goes_to_the_sky"] == {"bandwidth": False, "contrast_loss": True}
    assert len(found["kinds"]) == 9
    left_out = found["wavelengths_left_out"]
    assert left_out["none"] > 5.0 * left_out["bandwidth + contrast_loss"]
    assert left_out["paper, as published"] > 1.5 * left_out["bandwidth + contrast_loss"]
    assert "verdict:" in capsys.readouterr().out
