"""What the commands say of the results of a fit, of any kind, with the fit itself made by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from product_makers import observed
from small_pages import SIDE, WAVELENGTHS_NM, smooth_map, verdict

from lsst.fringe_sim.algorithms import map_on_sky
from lsst.fringe_sim.cli import discover, fit, fit_sky
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError, UndeterminedError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube
from lsst.fringe_sim.products.thickness_map import ThicknessMap


def searched(folder: Path, monkeypatch: pytest.MonkeyPatch, **changes: Any) -> None:
    """What is said of a map from the sky alone."""
    values: dict[str, Any] = {
        "order_probability": 0.99, "apart": 0.2, "model_error": 0.03,
        "known": np.arange(SIDE * SIDE).reshape(SIDE, SIDE) % 4 > 0,
        "sigma_um": np.full((SIDE, SIDE), 0.0123),
        "thickness_map": lambda layer, detector: smooth_map(),
    }  # fmt: skip
    found = SimpleNamespace(**(values | changes))

    def search(images: Any, weights: Any) -> Any:
        assert [value.shape for value in images] == [weight.shape for weight in weights] == [(SIDE, SIDE)] * 2
        if changes.get("none"):
            raise UndeterminedError("frames", 2, "more")
        return found

    alone = np.zeros((SIDE, SIDE))
    monkeypatch.setattr(map_on_sky, "fringes_alone", lambda frame, nothing, options, shape: (alone, alone))
    loaders = [lambda: observed((SIDE, SIDE))] * 2
    fit_sky._search(search, loaders, SimpleNamespace(), "adhesive", folder)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {},
            "75 % of the pixels are known, with a median σ of 12.3 nm within their order; the order of all and the "
            "direction are right with a probability of 0.99, if the range is, and the model to 0.1 of its fringes",
        ),
        ({"none": True}, "no map was found: frames is 2; allowed: more"),
        (
            {"model_error": 10.0},
            "no map was found: the likeliest one leaves 10 of the fringes (lines, films, silicon)",
        ),
        (
            {"order_probability": 0.4},
            "no map was found: the likeliest one has a probability of 0.4 among other orders and directions, and "
            "0.5 is asked for; the next leaves 0.2 of its fringes, and the model may be wrong by more "
            "(--order-error)",
        ),
        ({"order_probability": fit_sky.LEAST_PROBABILITY}, "75 % of the pixels are known"),
        ({"model_error": fit_sky.LARGE_ERROR}, "no map was found: the likeliest one leaves "),
        ({"model_error": 0.999 * fit_sky.LARGE_ERROR}, "75 % of the pixels are known"),
    ],
)
def test_a_map_from_the_sky_alone(
    changes: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    searched(tmp_path, monkeypatch, **changes)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(said)
    found = not lines[0].startswith("no map")
    assert (tmp_path / "thickness.fits").exists() is found
    assert lines[1:] == ([str(tmp_path / "thickness.fits")] if found else [])
    if found:
        assert ThicknessMap.read_fits(tmp_path / "thickness.fits").shape == (SIDE, SIDE)


def test_what_is_free_in_a_fit() -> None:
    assert fit._free(None, None, None, 0.5, usual=True) is None
    curved = fit._free(None, 3, None, 0.5, usual=True)
    zoned = fit._free("halves", None, "common", 0.5, usual=True)
    assert (zoned.zones, zoned.gain_accuracy, zoned.contrast) == ("halves", math.inf, "common")
    assert zoned.illumination_degree != 3
    assert (curved.illumination_degree, curved.contrast) == (3, "wavelength")
    assert curved.gain_accuracy != math.inf
    assert curved.wavelength_accuracy_nm == 0.5
    with pytest.raises(InputError, match="guo2022"):
        fit._free(None, 3, None, 0.5, usual=False)


def test_silicon_in_words() -> None:
    none = SimpleNamespace(metadata={"SIFIT": False, "SIWHY": "too few pixels"})
    assert fit._silicon_line(none) == "silicon not fitted, its fringes counted as noise: too few pixels"
    terms = {
        f"SI{what}{k}": 1e-3 * (k + 1) * scale
        for k in range(6)
        for what, scale in (("COEF", -1.0), ("SIGM", 0.1))
    }
    for number in (1, 6):
        kept = {key: value for key, value in terms.items() if int(key[-1]) < number}
        more = dict.fromkeys(("SIPROB", "SIAPART", "SIORDER", "SICHI2", "SINOISE", "SIRATIO"), 0.5)
        line = fit._silicon_line(SimpleNamespace(metadata={"SIFIT": True, **kept, **more}))
        assert "-1.00 ± 0.10" in line
        assert ("-6.00 ± 0.60" in line) is (number == 6)
        assert ("x², xy, y²" in line) is (number == 6)


def cube_file(folder: Path, wavelengths: list[float]) -> Path:
    model = FringeModel.from_setup("ts8_e2v")
    response = model.response(smooth_map().value.ravel().astype(float), wavelengths).reshape(-1, SIDE, SIDE)
    counts = 1e5 * response / response.mean(axis=(1, 2), keepdims=True)
    FringeCube.from_arrays(counts, wavelengths, variance=counts).write_fits(folder / "cube.fits")
    return folder / "cube.fits"


def test_a_fit_of_a_cube(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line of its range, in nm and per cent; a misfit is status 1 where that is asked for."""
    value = np.linspace(14.0, 15.0, 100 * 100).reshape(100, 100)
    mask = np.zeros(value.shape, np.int32)
    mask[:1] = 1
    zero = np.zeros(value.shape)
    made = ThicknessMap(value, zero + 3.21e-3, zero + 1.0, zero, mask, "adhesive", detector="S1")
    monkeypatch.setattr("lsst.fringe_sim.algorithms.thickness_fit.fit_thickness", lambda *parts, **more: made)
    monkeypatch.setattr(
        "lsst.fringe_sim.report.thickness_page.write_thickness_report", lambda *parts, **more: None
    )
    path = cube_file(tmp_path, WAVELENGTHS_NM)
    for name, words in (("a", []), ("dry", ["--dry-run"])):
        assert run(["fit", str(path), "--out", str(tmp_path / name), *words]) == 0
    lines = capsys.readouterr().out.replace(str(tmp_path), "…").splitlines()
    assert lines == [
        "adhesive: 14.020 to 14.990 µm (1–99 %), median σ 3.21 nm, 1.00 % of the pixels masked",
        "…/a/thickness.fits",
        "…/a/report.html",
        "would fit the layer adhesive to 8 flats",
    ]
    assert fits.getheader(tmp_path / "a" / "thickness.fits")["NFLATS"] == 8
    silicon = ThicknessMap(value, zero, zero, zero, mask, "detection", detector="S1")
    monkeypatch.setattr("lsst.fringe_sim.algorithms.thickness_fit.silicon_map", lambda *parts: silicon)
    assert run(["fit", str(path), "--out", str(tmp_path / "both")]) == 0
    assert capsys.readouterr().out.replace(str(tmp_path), "…").splitlines()[1:] == [
        "…/both/thickness.fits",
        "…/both/silicon.fits",
        "…/both/report.html",
    ]
    assert ThicknessMap.read_fits(tmp_path / "both" / "silicon.fits").layer == "detection"
    masked = ThicknessMap(value, zero + 3.21e-3, zero + 1.0, zero, mask + 1, "adhesive", detector="S1")
    monkeypatch.setattr(
        "lsst.fringe_sim.algorithms.thickness_fit.fit_thickness", lambda *parts, **more: masked
    )
    assert run(["fit", str(path), "--out", str(tmp_path / "b")]) == 1
    assert "good pixels of the thickness map is 0" in capsys.readouterr().err
    for words, said in (
        (["--method", "guo2022", "--zones", "halves"], "--zones"),
        (["--silicon", "plane", "--contrast", "common"], "--contrast"),
        (["--silicon", "plane", "--method", "guo2022"], "--silicon is 'plane'; allowed: fixed"),
    ):
        assert run(["fit", str(path), "--out", str(tmp_path / "c"), *words]) == 1
        assert said in capsys.readouterr().err
    for cards, words, status in (
        ({}, ["--strict"], 0), ({"WORSTFLT": 900.0}, [], 0), ({"WORSTFLT": 900.0}, ["--strict"], 1),
    ):  # fmt: skip
        monkeypatch.setattr(
            "lsst.fringe_sim.algorithms.thickness_fit.fit_thickness",
            lambda *parts, cards=cards, **more: replace(made, metadata=cards),
        )
        assert run(["fit", str(path), "--out", str(tmp_path / "d"), "--overwrite", *words]) == status
        assert ("--strict is 'a misfit'" in capsys.readouterr().err) == bool(status)
    few = cube_file(tmp_path, WAVELENGTHS_NM[:3])
    assert run(["fit", str(few), "--out", str(tmp_path / "c")]) == 1
    assert "number of wavelengths is 3; allowed: 4 or more" in capsys.readouterr().err


def test_a_search_says_what_it_found(tmp_path: Path, capsys) -> None:
    """The summary, its notes, and the paths of all that was written."""
    found = replace(verdict(), notes=("one frame was left out",))
    discover._write(found, tmp_path, None, None, [])
    out, err = (text.replace(str(tmp_path), "…").splitlines() for text in capsys.readouterr())
    assert err == ["  note: one frame was left out"]
    assert "\n".join(out).startswith(found.summary())
    paths = [line for line in out if line.startswith("…/")]
    assert paths == [f"…/{name}" for name in discover.PRODUCTS]
    assert all((tmp_path / line[2:]).exists() for line in paths)


def test_a_cube_to_be_searched(tmp_path: Path, capsys) -> None:
    path = cube_file(tmp_path, WAVELENGTHS_NM)
    assert run(["discover", str(path), "--out", str(tmp_path / "out"), "--dry-run"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"would search 8 flats of {SIDE} x {SIDE} pixels"
