"""Fringes too dense for pixels are named as such: nobody is sent to look for a hidden effect."""

from pathlib import Path

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.thickness_fit import remarks
from lsst.fringe_sim.algorithms.thickness_fit.conclusion import slope_cards
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.instrument.measured_thickness import e2v_321
from lsst.fringe_sim.products import FlatFit, ThicknessMap

ORDER_UM = 0.3


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.1, 0.0), (0.2, 0.3), (0.35, 0.1)])
def test_the_contrast_within_a_pixel_is_that_of_its_mean(dx: float, dy: float) -> None:
    y, x = np.mgrid[:40, :50]
    found = slope_cards((14.0 + ORDER_UM * (dx * x + dy * y)).astype(np.float32), ORDER_UM)
    fine = (np.arange(200) + 0.5) / 200 - 0.5
    phase = 2 * np.pi * (dx * fine[None, :] + dy * fine[:, None])
    assert found["SLOPECON"] == pytest.approx(np.cos(phase).mean(), abs=2e-3)
    assert found["SLOPEORD"] == pytest.approx(np.hypot(dx, dy), abs=1e-3)


def said(slope: float, left: float, contrast: float, misfit: float = 3.0) -> str:
    metadata = {"CONTRAST": contrast, "CONTRSIG": 0.01, "CELLMISF": misfit, "ORDMARG": 1e6, "SCALESIG": 0.0}
    metadata |= {"SLOPEORD": slope, "SLOPECON": left}
    ones = np.ones(2)
    flats = FlatFit(np.array([900.0, 960.0]), contrast * ones, 0.01 * ones, 0 * ones, 0 * ones, 3 * ones)
    return " ".join(remarks(metadata, flats))


def test_slopes_that_explain_the_contrast_are_the_reason() -> None:
    assert "too dense" in said(0.35, 0.65, 0.62)
    assert "discover" not in said(0.35, 0.65, 0.62)
    for other in (said(1e-3, 1.0, 0.62), said(0.08, 0.97, 0.62), said(0.35, 0.65, 0.1)):
        assert "discover" in other
        assert "too dense" not in other


def test_less_scatter_than_noise_is_said() -> None:
    """Flats without noise whose headers do not say so are fitted, and look better than any flats can."""
    assert "without noise" in said(1e-3, 1.0, 1.0, 1e-6)
    assert "scatter" not in said(1e-3, 1.0, 1.0, 0.95)


@pytest.mark.slow
def test_a_small_sensor_of_the_mock_is_told_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raws, out = str(tmp_path / "raws"), tmp_path / "fit"
    assert run(["mock-flats", raws, "--seed", "1", "--size", "64x64"]) == 0
    assert run(["fit", raws, "--out", str(out)]) == 0
    words = capsys.readouterr().out
    assert "too dense" in words
    assert "discover" not in words
    # A part of the map is in wrong orders, and what is learned with it has too little contrast.
    fitted, true = ThicknessMap.read_fits(out / "thickness.fits"), e2v_321((64, 64)).astype(np.float32)
    left = slope_cards(true, float(fitted.metadata["ORDERUM"]))["SLOPECON"]
    assert float(fitted.metadata["SLOPECON"]) == pytest.approx(left, abs=0.03)
    assert float(fitted.metadata["CONTRAST"]) < left + 0.03
