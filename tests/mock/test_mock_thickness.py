"""Thickness maps: the measured one and random ones."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.mock import E2V_SHAPE, e2v_321, fit_to_sensor, random_field
from lsst.fringe_sim.mock.thickness import PixelArea
from lsst.fringe_sim.resources import read_table

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "fit_e2v_321_thickness.py"


@pytest.fixture(scope="module")
def whole() -> np.ndarray:
    return e2v_321()


def test_measured_sensor_has_the_published_range(whole: np.ndarray) -> None:
    assert whole.shape == E2V_SHAPE
    assert whole.min() == pytest.approx(14.022, abs=0.02)
    assert whole.max() == pytest.approx(22.005, abs=0.02)


def test_measured_sensor_at_the_pixel_of_figure_4(whole: np.ndarray) -> None:
    """The paper's map has 17.50 µm at (2100, 2100) of the trimmed frame, which begins at row 15, column 48.

    One colour level of that map is 0.031 µm, and its nearest cell lies 5 rows off, in a gradient of 1.2 nm per row.
    """
    assert whole[2100 + 15, 2100 + 48] == pytest.approx(17.50, abs=0.031 + 0.006)


@pytest.mark.shared
def test_model_differs_from_the_measured_map_by_its_quantisation(whole: np.ndarray, shared_dir: Path) -> None:
    with fits.open(shared_dir / "measured" / "RTM-020_S01_E2V-321_epoxy_map.fits") as hdus:
        measured = hdus["FINE"].data.astype(float) + hdus[0].header["ABSMIN"]
        rows, columns = hdus["YSRC"].data, hdus["XSRC"].data
        quantisation = hdus[0].header["QRMS"]
    difference = whole[np.ix_(rows, columns)] - measured
    assert difference.std() < 1.1 * quantisation
    assert difference.std() == pytest.approx(
        read_table("laboratory", "thickness_e2v_321.ecsv").meta["residual_rms_um"], abs=2e-5
    )
    assert abs(difference.mean()) < 1e-3


@pytest.mark.shared
def test_script_reproduces_the_shipped_coefficients(
    shared_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = importlib.util.spec_from_file_location("fit_e2v_321_thickness", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "OUTPUT", tmp_path / "made.ecsv")
    script.main(shared_dir)
    shipped = read_table("laboratory", "thickness_e2v_321.ecsv")
    made = type(shipped).read(tmp_path / "made.ecsv")
    np.testing.assert_allclose(made["coefficient"], shipped["coefficient"], atol=2e-5)


def test_script_puts_slipped_rows_back() -> None:
    spec = importlib.util.spec_from_file_location("fit_e2v_321_thickness", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    smooth = 15.0 + 0.03 * np.arange(60.0)[:, np.newaxis] + np.zeros((60, 50))
    slipped = smooth.copy()
    slipped[20:] += 0.3
    slipped[41:] -= 0.6
    repaired, jumps = script.repair_row_orders(slipped)
    assert jumps == 2
    np.testing.assert_allclose(repaired, smooth, atol=1e-12)


def test_window_is_a_part_of_the_whole(whole: np.ndarray) -> None:
    window = e2v_321((64, 80), sampling="window", corner=(1500, 3000))
    np.testing.assert_allclose(window, whole[1500:1564, 3000:3080], atol=1e-12)


def test_resampled_map_spans_the_whole(whole: np.ndarray) -> None:
    small = e2v_321((182, 256))  # 22 × 16 px of the sensor each
    blocks = whole.reshape(182, 22, 256, 16).mean(axis=(1, 3))
    np.testing.assert_allclose(small, blocks, atol=5e-3)


@pytest.mark.parametrize("end", [0, -1])
def test_the_measured_map_is_smooth_up_to_its_rims(end: int) -> None:
    """The last pixels go on as those before them; of finer maps what lies beyond the last centre is as there."""
    rows, columns = E2V_SHAPE
    corner = (rows - 4, columns - 4) if end else (0, 0)
    window = e2v_321((4, 4), sampling="window", corner=corner)
    for axis in (0, 1):
        steps = np.diff(window, axis=axis).swapaxes(0, axis)
        np.testing.assert_allclose(steps[end], steps[1], rtol=0.05, atol=1e-6)
    for fine in (e2v_321((2 * rows, 1))[:, 0], e2v_321((1, 2 * columns))[0]):
        last, *before = (fine[:4] if end == 0 else fine[:-5:-1]).tolist()
        assert last - before[0] == pytest.approx(0.5 * (before[0] - before[1]), rel=0.02, abs=1e-6)


def test_any_map_can_be_brought_to_a_sensor(whole: np.ndarray) -> None:
    np.testing.assert_array_equal(fit_to_sensor(whole, E2V_SHAPE), whole)
    cut = fit_to_sensor(whole, (40, 50), sampling="window", corner=(7, 9))
    np.testing.assert_array_equal(cut, whole[7:47, 9:59])
    np.testing.assert_allclose(fit_to_sensor(whole, (100, 128)), e2v_321((100, 128)), atol=2e-3)


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda: e2v_321((10, 10), sampling="window", corner=(4000, 0)), "window of rows"),
        (lambda: e2v_321((10, 10), sampling="window", corner=(0, -1)), "window of columns"),
        (lambda: e2v_321((0, 10)), "number of rows"),
        (lambda: e2v_321((10, 10), sampling="crop"), "sampling"),  # type: ignore[arg-type]
        (lambda: fit_to_sensor(np.zeros((3, 3, 3)), (2, 2)), "dimensions"),
    ],
)
def test_impossible_cut_outs_are_refused(call: object, names: str) -> None:
    with pytest.raises(InputError, match=names):
        call()  # type: ignore[operator]


@pytest.mark.rng("random field has the range and scale asked for")
def test_random_field_has_the_range_and_scale_asked_for(rng: np.random.Generator) -> None:
    scale = 12.0
    correlation = []
    for _ in range(12):
        field = random_field((200, 220), rng, mean=16.0, span=5.0, scale=scale)
        assert field.min() == pytest.approx(13.5)
        assert field.max() == pytest.approx(18.5)
        residual = field - field.mean()
        lag = round(scale)
        correlation.append(np.mean(residual[:, lag:] * residual[:, :-lag]) / residual.var())
    # exp(-lag² / (2 scale²)) at lag = scale
    assert np.mean(correlation) == pytest.approx(np.exp(-0.5), abs=0.08)


def test_random_field_depends_on_the_generator_only() -> None:
    first = random_field((30, 40), np.random.default_rng(5))
    np.testing.assert_array_equal(first, random_field((30, 40), np.random.default_rng(5)))
    assert not np.allclose(first, random_field((30, 40), np.random.default_rng(6)))


@pytest.mark.rng("impossible random fields are refused")
def test_impossible_random_fields_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(OutOfRangeError, match="scale"):
        random_field((8, 8), rng, scale=0.0)
    with pytest.raises(OutOfRangeError, match="span"):
        random_field((8, 8), rng, mean=2.0, span=5.0)


def test_light_is_averaged_over_the_area_of_a_pixel() -> None:
    """Of a plane: a fifth power exactly; the variance within a square of one pixel is a twelfth along either side."""
    y, x = np.indices((9, 7))
    plane = 15.0 + 0.03 * x - 0.05 * y
    area = PixelArea.of(plane)
    np.testing.assert_allclose(area.average(lambda t: (t - plane) ** 2), (0.03**2 + 0.05**2) / 12.0)
    np.testing.assert_allclose(area.average(lambda t: (t - plane) ** 5), 0.0, atol=1e-18)
    wave = area.average(lambda t: np.cos(20.0 * (t - 15.0)))
    exact = np.cos(20.0 * (plane - 15.0)) * np.sinc(0.3 / np.pi) * np.sinc(0.5 / np.pi)
    np.testing.assert_allclose(wave, exact, rtol=0.0, atol=6e-7)  # 1 / 448 - 0.15^3 * 5 / 9, over 6!, is 5e-7
    assert area.range_um == pytest.approx((plane.min() - 0.04, plane.max() + 0.04))


def test_a_pixel_does_not_reach_over_a_step() -> None:
    step = np.where(np.arange(10) < 5, 15.0, 16.0)[:, np.newaxis] * np.ones(4)
    area = PixelArea.of(step)
    np.testing.assert_allclose(area.average(np.asarray), step, rtol=1e-14)
    assert area.range_um == (15.0, 16.0)
