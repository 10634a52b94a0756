"""The page of simulated sky frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import check_page

from lsst.fringe_sim.algorithms.coadd_sources import NightResults
from lsst.fringe_sim.algorithms.fringe_amplitudes import fringe_amplitudes
from lsst.fringe_sim.blocks import means_of_known
from lsst.fringe_sim.products import SkyFringe
from lsst.fringe_sim.report.figures import residuals_figure
from lsst.fringe_sim.report.sky_page import sky_amplitudes, write_sky_report


def night(shape: tuple[int, int] = (150, 160), hours: int = 3) -> list[SkyFringe]:
    """Frames whose fringes are two patterns in changing proportion."""
    y, x = np.indices(shape, dtype=float)
    patterns = np.sin(2 * np.pi * (x + 0.3 * y) / 22.0), np.cos(2 * np.pi * (y - 0.2 * x) / 31.0)
    mask = np.zeros(shape, np.int32)
    mask[:4] = 1
    made = []
    for hour in range(hours):
        image = 2700.0 * (1.0 + 2e-3 * patterns[0] + 1e-3 * (1 + hour) * patterns[1])
        image[0, 0] = np.nan
        mean = float(image[4:].mean())
        made.append(
            SkyFringe(image.astype(np.float32), mask, "electron", mean, 30.0, 1.2, 20.0 + hour, None, 1e-8)
        )
    return made


def sky_page(path: Path, frames: list[SkyFringe]) -> Path:
    return write_sky_report(path, frames, "lsst_e2v", NightResults.of(frames, 1))


def test_amplitudes_are_those_of_the_frames() -> None:
    frames = night()
    table = sky_amplitudes(frames)
    assert list(table["local time"]) == [20.0, 21.0, 22.0]
    for row, frame in zip(table, frames, strict=True):
        expected = fringe_amplitudes(np.asarray(frame.image[4:], dtype=float))
        assert row["rms"] == pytest.approx(100 * expected.rms, abs=1e-4)
        assert row["half peak to peak"] == pytest.approx(100 * expected.half_peak_to_peak, abs=1e-4)


def test_page_of_a_night_in_a_browser(tmp_path) -> None:
    """With components and coadds; a single frame with noise has neither."""
    path = sky_page(tmp_path / "night.html", night())
    text = path.read_text(encoding="utf-8")
    for words in ("Components", "Coadds", "coadds.ecsv", "sky_fringe_amplitudes.ecsv"):
        assert words in text
    alone = sky_page(tmp_path / "one.html", night(hours=1)).read_text(encoding="utf-8")
    assert "Components" not in alone
    assert "Coadds" in alone
    check_page(path, tmp_path, 390, "sky_390")


def test_residuals_are_averaged_without_the_masked(tmp_path) -> None:
    plane = np.full((4, 6), 2.0)
    plane[0, 0], plane[2:, 4:] = np.nan, np.nan
    assert np.array_equal(means_of_known(plane, 2), [[2, 2, 2], [2, 2, np.nan]], equal_nan=True)
    left = np.random.default_rng(0).normal(0, 0.01, (3, 220, 240)).astype(np.float32)
    left[:, :, 100:120] = np.nan
    made = residuals_figure(left, [880.0, 930.0, 980.0])
    panels = [axes for axes in made.axes if axes.images]
    assert [axes.get_title() for axes in panels] == ["880 nm", "930 nm", "980 nm"]
    assert panels[0].images[0].get_extent() == [-0.5, 239.5, -0.5, 219.5]


@pytest.mark.rng("residuals on the scale of their noise")
def test_residuals_are_on_the_scale_of_the_noise_of_their_means(rng) -> None:
    """Whether the noise is told or measured; a pattern does not count as noise."""
    noise = np.array([0.01, 0.03])
    left = rng.normal(0.0, 1.0, (2, 400, 400)) * noise[:, None, None]
    left += 0.004 * np.sin(np.arange(400) / 30.0)
    for told in (noise, None):
        made = residuals_figure(left, [880.0, 930.0], told)
        shown = [np.asarray(axes.images[0].get_array(), dtype=float) for axes in made.axes if axes.images]
        assert all(axes.images[0].get_clim() == (-5.0, 5.0) for axes in made.axes if axes.images)
        for image, sigma in zip(shown, noise, strict=True):
            assert image.shape == (100, 100)
            difference = (image[:, 1:] - image[:, :-1])[::2, ::2] / np.sqrt(2.0)
            assert difference.std() == pytest.approx(1.0, abs=0.1)
            assert np.abs(image.mean(axis=0)).max() == pytest.approx(0.004 / (sigma / 4.0), abs=0.35)


def test_what_a_table_with_noise_shows_is_said(tmp_path) -> None:
    """The summary has the fringes alone."""
    quiet, said = night(hours=1), "noise included"
    assert said not in sky_page(tmp_path / "a.html", quiet).read_text("utf-8")
    noisy = [replace(frame, seed=1, metadata={"FRINGRMS": 0.002, "FRING198": 0.003}) for frame in quiet]
    assert said in sky_page(tmp_path / "b.html", noisy).read_text("utf-8")
