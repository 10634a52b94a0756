"""A map against a night of frames, by the command: noisy frames of a sensor whose map is off, and is not."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from lsst.fringe_sim.cli.main import run
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


def write_frame(path: Path, seed: int, side: int = SIDE, **cards: object) -> str:
    hdu = fits.PrimaryHDU(np.random.default_rng(seed).normal(3e3, 50.0, (side, side)).astype(np.float32))
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
    first = write_frame(tmp_path / "a.fits", 1, side, **changed)
    second = write_frame(tmp_path / "b.fits", 1 if "seed" in cards else 2, side, **changed)
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
