"""Lists of backgrounds as afw writes them are drawn as afw draws them: means of bins, splines, parabolas beyond."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from scipy.interpolate import Akima1DInterpolator, CubicSpline, interp1d

from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.products.observed_files import observed_images

SHAPE = (70, 95)
AKIMA, NATURAL, LINEAR, CONSTANT = 5, 2, 1, 0


def write(path: Path, *backgrounds: np.ndarray, variance: Any = 1.0, **cards: Any) -> Path:
    """The layout of ``BackgroundList.writeFits``: three images each, keywords in all of them."""
    hdus: list[Any] = []
    for bins in backgrounds:
        header = fits.Header()
        stated = {"INTERPSTYLE": AKIMA, "UNDERSAMPLESTYLE": 1, "APPROXSTYLE": -1, "APPROXORDERX": 1}
        stated |= {"APPROXORDERY": 1, "APPROXWEIGHTING": True, "BKGD_X0": 0, "BKGD_Y0": 0}
        for keyword, value in (stated | {"BKGD_WIDTH": SHAPE[1], "BKGD_HEIGHT": SHAPE[0]} | cards).items():
            header[keyword if len(keyword) < 9 else f"HIERARCH {keyword}"] = value
        for data in (bins, np.zeros(bins.shape, dtype=np.int32), np.full(bins.shape, variance)):
            data = data if data.dtype.kind == "i" else data.astype(np.float32)
            kind = fits.ImageHDU if hdus else fits.PrimaryHDU
            hdus.append(kind(data, header))
    fits.HDUList(hdus).writeto(path)
    return path


def drawn(
    tmp_path: Path, *backgrounds: np.ndarray, shape: tuple[int, int] = SHAPE, **cards: Any
) -> np.ndarray:
    """What is added to a frame of zeros."""
    fits.PrimaryHDU(np.zeros(shape, dtype=np.float64)).writeto(tmp_path / "frame.fits")
    path = write(tmp_path / "background.fits", *backgrounds, **cards)
    (image,) = observed_images(tmp_path / "frame.fits")
    return np.asarray(image.pixels(path))


def centres(side: int, bins: int) -> np.ndarray:
    """Bin by bin, as in ``Background::_setCenOrigSize``."""
    found, begin = [], 0
    for number in range(bins):
        end = min(((number + 1) * side + bins // 2) // bins, side)
        found.append(begin + 0.5 * (end - begin) - 0.5)
        begin = end
    return np.array(found)


def line(x: np.ndarray, y: np.ndarray, places: np.ndarray, kind: Any) -> np.ndarray:
    """One line by scipy, and beyond its points the parabola with the slope and curvature of the end."""
    x, y = x[np.isfinite(y)], y[np.isfinite(y)]
    curve = kind(x, y)
    inside = np.clip(places, x[0], x[-1])
    value = curve(inside)
    for end, beyond in ((x[0], places < x[0]), (x[-1], places > x[-1])):
        away = places[beyond] - end
        value[beyond] += away * curve(end, 1) + 0.5 * away**2 * curve(end, 2)
    return np.asarray(value)


def surface(bins: np.ndarray, kind: Any) -> np.ndarray:
    """Columns first, then rows."""
    down, across = centres(SHAPE[0], bins.shape[0]), centres(SHAPE[1], bins.shape[1])
    known = np.isfinite(bins).any(axis=0)
    columns = [line(down, column, np.arange(SHAPE[0]), kind) for column in bins.T[known]]
    return np.array([line(across[known], row, np.arange(SHAPE[1]), kind) for row in np.transpose(columns)])


def bins(shape: tuple[int, int] = (7, 9)) -> np.ndarray:
    made = np.random.default_rng(5).normal(1000, 30, shape)
    return made.astype(np.float32).astype(float)


@pytest.mark.parametrize(
    ("style", "kind"),
    [(AKIMA, Akima1DInterpolator), (NATURAL, lambda x, y: CubicSpline(x, y, bc_type="natural"))],
    ids=["Akima", "natural"],
)
def test_splines(tmp_path: Path, style: int, kind: Any) -> None:
    """Bins without a value are left out, a column of them too."""
    values = bins()
    values[2, 3] = np.nan
    values[:, 5] = np.nan
    found = drawn(tmp_path, values, INTERPSTYLE=style)
    np.testing.assert_allclose(found, surface(values, kind), rtol=1e-9)


def test_equal_slopes(tmp_path: Path) -> None:
    """Where Akima's weights are 0 over 0 the line is straight, as GSL has it."""
    values = np.add.outer(np.abs(np.arange(7.0) - 3.0), 2.0 * np.arange(9.0))
    found = drawn(tmp_path, values)
    rows = np.interp(np.arange(SHAPE[0]), centres(SHAPE[0], 7), np.abs(np.arange(7.0) - 3.0))
    inside = slice(int(centres(SHAPE[0], 7)[0]) + 1, int(centres(SHAPE[0], 7)[-1]))
    middle = int(centres(SHAPE[1], 9)[4])
    np.testing.assert_allclose(
        found[inside, middle] - found[35, middle], (rows - rows[35])[inside], atol=0.02
    )


def test_lines_and_steps(tmp_path: Path) -> None:
    values = bins()
    (tmp_path / "steps").mkdir()
    down, across = centres(SHAPE[0], 7), centres(SHAPE[1], 9)

    def straight(x: np.ndarray, y: np.ndarray) -> Any:
        return interp1d(x, y, axis=0, fill_value="extrapolate")

    lines = straight(across, straight(down, values)(np.arange(SHAPE[0])).T)(np.arange(SHAPE[1])).T
    np.testing.assert_allclose(drawn(tmp_path, values, INTERPSTYLE=LINEAR), lines, rtol=1e-9)
    found = drawn(tmp_path / "steps", values, INTERPSTYLE=CONSTANT)
    assert found[0, 0] == values[0, 0]
    between = int(np.ceil(0.5 * (down[2] + down[3])))  # afw has a step there, and one between the next two
    assert found[between, 0] == pytest.approx(0.5 * (values[2, 0] + values[3, 0]))


def test_few_bins_take_a_simpler_spline_or_are_refused(tmp_path: Path) -> None:
    values = bins((4, 9))
    natural = surface(values, lambda x, y: CubicSpline(x, y, bc_type="natural"))
    np.testing.assert_allclose(drawn(tmp_path, values), natural, rtol=1e-9)
    (tmp_path / "strict").mkdir()
    with pytest.raises(FrameFormatError, match=r"bins is \(4, 9\); allowed: 5 or more"):
        drawn(tmp_path / "strict", values, UNDERSAMPLESTYLE=0)


def test_a_column_of_few_bins_with_a_value(tmp_path: Path) -> None:
    """It takes the spline that they allow, or is refused; one value is a constant."""
    values = bins()
    values[:4, 2] = np.nan
    values[1:, 5] = np.nan
    values[:, 7] = np.nan
    down, across = centres(SHAPE[0], 7), centres(SHAPE[1], 9)
    along = np.empty((SHAPE[0], 8))
    kept = [0, 1, 2, 3, 4, 5, 6, 8]
    for place, column in enumerate(kept):
        few = {2: lambda x, y: CubicSpline(x, y, bc_type="natural"), 5: None}.get(column, Akima1DInterpolator)
        along[:, place] = values[0, 5] if few is None else line(down, values[:, column], np.arange(70.0), few)
    found = drawn(tmp_path, values)
    for row in (0, 33, 69):
        np.testing.assert_allclose(
            found[row], line(across[kept], along[row], np.arange(95.0), Akima1DInterpolator), rtol=1e-9
        )
    (tmp_path / "strict").mkdir()
    with pytest.raises(FrameFormatError, match="bins with a value is 3; allowed: 5 or more"):
        drawn(tmp_path / "strict", values, UNDERSAMPLESTYLE=0)


@pytest.mark.parametrize("style", [CONSTANT, LINEAR, AKIMA])
def test_one_bin_is_a_constant(style: int, tmp_path: Path) -> None:
    np.testing.assert_array_equal(
        drawn(tmp_path, np.full((1, 1), 7.5), INTERPSTYLE=style), np.full(SHAPE, 7.5)
    )


def test_polynomial(tmp_path: Path) -> None:
    """A plane and its products of degree 2 come back as they are, whatever the number of bins."""
    down, across = centres(SHAPE[0], 7), centres(SHAPE[1], 9)

    def plane(y: Any, x: Any) -> Any:
        return 1000.0 + 2.0 * y - x + 0.03 * x * y + 0.01 * y**2

    values = plane(down[:, None], across)
    values[1, 1] = np.nan
    found = drawn(tmp_path, values, APPROXSTYLE=0, APPROXORDERX=2, APPROXORDERY=2)
    true = plane(np.arange(SHAPE[0])[:, None], np.arange(SHAPE[1]))
    np.testing.assert_allclose(found, true, atol=2e-3)


def test_steps_are_means_of_neighbours(tmp_path: Path) -> None:
    """Until half a bin beyond the last value on either side; from there on it is that value."""
    row = np.array([np.nan, 3.0, 8.0, 4.0, np.nan, 7.0, 1.0, np.nan, np.nan])
    found = drawn(tmp_path, np.tile(row, (7, 1)), INTERPSTYLE=CONSTANT)
    good = np.isfinite(row)
    x, y = centres(SHAPE[1], 9)[good], row[good]
    expected = np.empty(SHAPE[1])
    for place in range(SHAPE[1]):
        right = int(np.sum(0.5 * (x[:-1] + x[1:]) <= place))
        expected[place] = y[0] if right == 0 else 0.5 * (y[right - 1] + y[right])
        if place >= x[-1] + 0.5 * (x[-1] - x[-2]):
            expected[place] = y[-1]
    np.testing.assert_array_equal(found, np.tile(expected, (SHAPE[0], 1)))


@pytest.mark.parametrize("weighted", [True, False])
def test_a_polynomial_of_noisy_bins_is_that_of_least_squares(weighted: bool, tmp_path: Path) -> None:
    """Of the total degree, with weights that are inverse variances if they count, in powers of the pixels."""
    rng = np.random.default_rng(77)
    values, variance = rng.normal(1000.0, 30.0, (7, 9)), rng.uniform(1.0, 50.0, (7, 9))
    values[2, 3] = np.nan
    fits.PrimaryHDU(np.zeros(SHAPE)).writeto(tmp_path / "frame.fits")
    cards = {"APPROXSTYLE": 0, "APPROXORDERX": 4, "APPROXORDERY": 4, "APPROXWEIGHTING": weighted}
    path = write(tmp_path / "background.fits", values, variance=variance, **cards)
    (image,) = observed_images(tmp_path / "frame.fits")
    powers = [(i, j) for i in range(5) for j in range(5 - i)]

    def terms(y: Any, x: Any) -> np.ndarray:
        return np.stack([(y / 70.0) ** i * (x / 95.0) ** j for i, j in powers], axis=-1)

    down, across = np.meshgrid(centres(SHAPE[0], 7), centres(SHAPE[1], 9), indexing="ij")
    good = np.isfinite(values)
    root = 1.0 / np.sqrt(variance.astype(np.float32)[good].astype(float)) if weighted else np.ones(good.sum())
    known = values.astype(np.float32)[good].astype(float)
    found = np.linalg.lstsq(terms(down, across)[good] * root[:, None], known * root, rcond=None)[0]
    y, x = np.indices(SHAPE, dtype=float)
    np.testing.assert_allclose(image.pixels(path), terms(y, x) @ found, atol=1e-5)


def test_backgrounds_add_up(tmp_path: Path) -> None:
    one, other = bins(), bins((5, 6))
    total = surface(one, Akima1DInterpolator) + surface(other, Akima1DInterpolator)
    np.testing.assert_allclose(drawn(tmp_path, one, other), total, rtol=1e-9)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FrameFormatError, match=r"background is \(70, 95\); allowed: one of shape \(70, 90\)"):
        drawn(tmp_path, bins(), shape=(70, 90))
    (tmp_path / "periodic").mkdir()
    with pytest.raises(FrameFormatError, match="INTERPSTYLE is 6"):
        drawn(tmp_path / "periodic", bins(), INTERPSTYLE=6)
