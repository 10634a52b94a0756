"""A map against a night of frames, by the command: noisy frames of a sensor whose map is off, and is not."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import click
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from lsst.fringe_sim.algorithms import range_forecast, sky_response
from lsst.fringe_sim.cli import fit_sky
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import ThicknessMap

SIDE = 160
Y, X = np.mgrid[:SIDE, :SIDE] / SIDE
TRUE_UM = 15.0 + 2.2 * X + 1.2 * np.sin(2.5 * Y + 1.3 * X)
ERROR_UM = 0.03 + 0.04 * np.sin(3.0 * Y) * np.cos(2.0 * X)


def write_map(path: Path, value: np.ndarray, detector: str = "R22_S11") -> str:
    zero = np.zeros((SIDE, SIDE))
    made = ThicknessMap(value, zero + 1e-3, zero, zero, zero.astype(int), "adhesive", detector=detector)
    made.write_fits(path)
    return str(path)


@pytest.mark.slow
@pytest.mark.rng("a night for a map")
def test_a_map_is_moved_to_where_the_sky_is(tmp_path: Path, rng: np.random.Generator) -> None:
    night, seed = str(tmp_path / "night"), str(rng.integers(1 << 20))
    truth = write_map(tmp_path / "true.fits", TRUE_UM)
    assert run(["sky", "--thickness", truth, "--night", "--seed", seed, "--out", night]) == 0
    for name, error in (("wrong", ERROR_UM), ("right", 0.0)):
        path, out = write_map(tmp_path / f"{name}.fits", TRUE_UM - error), tmp_path / f"on_{name}"
        assert run(["fit-sky", night, "--thickness", path, "--out", str(out)]) == 0
        assert run(["fit-sky", night, "--thickness", path, "--out", str(out)]) == 1  # the folder is used
        moved = ThicknessMap.read_fits(out / "thickness.fits")
        left = moved.value - TRUE_UM
        pull = float(np.sqrt(np.mean((left / moved.sigma) ** 2)))
        assert (out / "report.html").is_file()
        if name == "wrong":
            assert moved.metadata["SKYKEPT"] < 1e-3
            assert np.sqrt(np.mean(left**2)) < 0.4 * np.sqrt(np.mean(ERROR_UM**2))
            assert pull < 2.5
        else:
            assert moved.metadata["SKYKEPT"] > 0.05
            assert np.abs(left).max() < 4.0 * moved.sigma.max()


def write_frame(path: Path, seed: int, rows: int = SIDE, columns: int = SIDE, **cards: object) -> str:
    hdu = fits.PrimaryHDU(np.random.default_rng(seed).normal(3e3, 50.0, (rows, columns)).astype(np.float32))
    hdu.header.update(cards)
    hdu.writeto(path)
    return str(path)


@pytest.mark.parametrize(
    ("cards", "options", "reason"),
    [
        ({}, ("--detector", "R01_S00"), "lsst_itl"),
        ({}, ("--setup", "ts8_e2v"), "telescope"),
        ({"NOISE": False}, (), "NOISE"),
        ({"FRINGCOR": 1}, (), "FRINGCOR"),
        ({"DETNAME": "R10_S01"}, ("--detector", "R22_S11"), "R10_S01"),
        ({"FILTER": "z_10"}, (), "filter of the frames"),
        ({"side": 64}, (), "shape of the frames"),
        ({"seed": 1}, (), "pixels"),  # one frame twice
        ({}, ("--effect", "void.depth=1"), "void"),
    ],
)
def test_what_is_refused_before_any_work(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    cards: dict[str, object],
    options: tuple[str, ...],
    reason: str,
) -> None:
    path = write_map(tmp_path / "map.fits", TRUE_UM)
    changed = {name: value for name, value in cards.items() if name not in ("seed", "side")}
    side = SIDE if cards.get("side") is None else 64
    first = write_frame(tmp_path / "a.fits", 1, side, side, **changed)
    second = write_frame(tmp_path / "b.fits", 1 if "seed" in cards else 2, side, side, **changed)
    command = ["fit-sky", first, second, "--thickness", path, *options, "--out", str(tmp_path / "out")]
    assert run(command) != 0
    assert reason in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_range_alone_gets_the_number_of_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = [write_frame(tmp_path / f"{seed}.fits", seed) for seed in (1, 2)]
    out = tmp_path / "out"
    assert (
        run(["fit-sky", *frames, "--thickness", "13um:17um", "--detector", "R22_S11", "--out", str(out)]) == 0
    )
    said = capsys.readouterr().out
    assert "fringe orders lie within the range" in said
    row = Table.read(out / "forecast.ecsv")[0]
    assert row["noise"] == pytest.approx(50.0 / 3e3, rel=0.05)
    assert ("too few" in said) == (row["frames"] > 2)
    assert not (out / "thickness.fits").exists()
    assert run(["fit-sky", *frames, "--thickness", "17:13", "--out", str(tmp_path / "no")]) == 2
    assert run(["fit-sky", *frames, "--thickness", "1:900", "--out", str(tmp_path / "no")]) == 1
    assert not (tmp_path / "no").exists()


def test_what_is_there_is_a_file_and_what_is_not_a_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if its name has the sign of a range in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "13:17").write_text("")
    (tmp_path / "map.fits").write_text("")
    (tmp_path / "folder").mkdir()
    (kind,) = (item.type for item in fit_sky.fit_sky.params if item.name == "thickness")
    for text in ("13:17", "map.fits"):
        assert kind.convert(text, None, None) == text
    for given in ("13um:18000nm", (13.0, 18.0)):
        assert kind.convert(given, None, None) == (13.0, 18.0)
    for text in ("folder", "none.fits", "18:13", "a:b"):
        with pytest.raises(click.BadParameter):
            kind.convert(text, None, None)


@pytest.mark.parametrize(
    ("options", "error"),
    [([], None), (["--order-error", "0.1"], 0.1), (["--model-accuracy", "0.2"], 0.2),
     (["--order-error", "0.1", "--model-accuracy", "0.2"], 0.1)],
)  # fmt: skip
@pytest.mark.parametrize("enough", [True, False])
def test_a_map_is_searched_for_where_there_are_frames_enough(
    options: list[str], error: float | None, enough: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the error of the model that is stated; the table of the sky reaches two orders beyond the range."""
    asked: list[object] = []
    spans: list[tuple[float, float]] = []
    table = SimpleNamespace(frame=lambda grid: grid)

    def response(model: FringeModel, sky: object, *, thickness_range_um: tuple[float, float]) -> object:
        spans.append(thickness_range_um)
        return SimpleNamespace(sky=lambda: table)

    found = range_forecast.RangeForecast(0.01, 0.02, 12.0, 40, 1, 2 if enough else 3, 0.01)

    def forecast(predict: Callable[[np.ndarray], np.ndarray], *rest: object) -> object:
        np.testing.assert_array_equal(predict(np.arange(13.0, 14.0, 0.1)), np.arange(13.0, 14.0, 0.1))
        assert rest[2:] == ((48, 64), 1000, 0.02)
        return found

    monkeypatch.setattr(sky_response, "sky_response", response)
    monkeypatch.setattr(range_forecast, "frame_noise", lambda frame, options: (0.02, 1000))
    monkeypatch.setattr(range_forecast, "forecast_of_range", forecast)
    monkeypatch.setattr(
        fit_sky, "_search", lambda search, *rest: asked.append(search.keywords.get("order_error"))
    )
    frames = [write_frame(tmp_path / f"{seed}.fits", seed, 48, 64) for seed in (1, 2)]
    for number, (text, low, high) in enumerate((("13:17", 13.0, 17.0), ("6.5:7", 6.5, 7.0))):
        command = ["fit-sky", *frames, "--setup", "monocam", "--thickness", text, *options]
        assert run([*command, "--out", str(tmp_path / str(number))]) == 0
        order = float(FringeModel.from_setup("monocam").fringe_order_um(960.0))
        np.testing.assert_allclose(spans[-1], (low - 2.0 * order, high + 2.0 * order))
    assert asked == ([error, error] if enough else [])


def test_a_map_of_a_part_of_a_sensor_is_held_against_frames_of_that_part(tmp_path: Path, capsys) -> None:
    part = fits.PrimaryHDU(np.linspace(13.0, 14.0, 48 * 64).reshape(48, 64))
    part.header["DETSEC"] = "[101:164,201:248]"
    part.writeto(tmp_path / "map.fits")
    frames = [write_frame(tmp_path / f"{seed}.fits", seed, 48, 64) for seed in (1, 2)]
    command = [
        "fit-sky",
        *frames,
        "--setup",
        "monocam",
        "--thickness",
        str(tmp_path / "map.fits"),
        "--dry-run",
    ]
    assert run([*command, "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.endswith("against 2 frames\n")
