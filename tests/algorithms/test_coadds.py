"""Fringes left in coadds of visits: laws that hold whatever the pattern, and tables of visits from outside."""

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from numpy.lib.stride_tricks import sliding_window_view

from lsst.fringe_sim.algorithms.coadds import VisitPlaces, coadd_visits, coadds_of_frames
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.products import SkyFringe

Y, X = np.mgrid[:150, :160]
PATTERNS = [1e-3 * np.sin(X / 4.0 + 0.02 * Y), 4e-4 * np.cos(Y / 5.0 - X / 9.0)]


def mixtures(*shares: float) -> list[np.ndarray]:
    return [(PATTERNS[0] + share * PATTERNS[1]).astype(np.float32) for share in shares]


def places(number: int, rotation_deg: float = 0.0, frame: int = 0, y_px: float = 70.5) -> VisitPlaces:
    same = np.ones(number)
    return VisitPlaces(60.5 * same, y_px * same, rotation_deg * same, frame * np.ones(number, dtype=int))


def test_visits_that_are_alike_keep_their_fringes() -> None:
    """Means over squares of the region itself, in a coadd of any number; the noise falls with the root."""
    found = coadd_visits(mixtures(1.0), places(20), 0.02, 40)
    region = mixtures(1.0)[0][51:91, 41:81]
    assert list(found.counts) == [1, 10, 20]
    assert found.square_px[-1] == 10
    for column, side in enumerate(found.square_px):
        means = sliding_window_view(region, (side, side)).mean(axis=(2, 3))
        np.testing.assert_allclose(found.fringes[:, column], means.std(), rtol=1e-5)
    np.testing.assert_allclose(found.noise, 0.02 / np.sqrt([[1], [10], [20]]) / found.square_px)
    assert found.corrected is None


def test_a_half_turn_shows_the_same_squares() -> None:
    one, two = (coadd_visits(mixtures(1.0), places(2, angle), 0.0, 40) for angle in (0.0, 180.0))
    np.testing.assert_allclose(one.fringes, two.fringes, rtol=1e-6)


@pytest.mark.rng("visits that lie differently")
def test_visits_that_lie_differently_average_as_noise_does(rng: np.random.Generator) -> None:
    made = VisitPlaces.random(X.shape, 60, 200, 2, rng)
    assert made.region_px(X.shape) >= 60
    found = coadd_visits(mixtures(1.0, -1.0), made, 0.0, 60, templates=1)
    assert found.corrected is not None
    fall = found.fringes[0, 0] / found.fringes[:, 0] / np.sqrt(found.counts)
    np.testing.assert_allclose(fall, 1.0, atol=0.25)
    # One template takes what both frames share, and leaves the weaker pattern.
    assert found.corrected[0, 0] == pytest.approx(np.std(PATTERNS[1]), rel=0.1)


def test_as_many_templates_as_patterns_leave_nothing() -> None:
    found = coadd_visits(mixtures(1.0, 0.3, -0.5), places(3, frame=2), 0.0, 40, templates=2)
    assert found.corrected is not None
    assert found.corrected.max() < 1e-5 * found.fringes.min()


def test_frames_too_small_to_be_rotated_have_no_coadd() -> None:
    def frame(side: int) -> SkyFringe:
        image = np.zeros((side, side), dtype=np.float32)
        return SkyFringe(image, image.astype(np.int32), "fraction", 2700.0, 30.0, 1.2, 20.0, None, 0.0)

    assert coadds_of_frames([frame(20)], np.random.default_rng(1)) is None
    found = coadds_of_frames([frame(64)], np.random.default_rng(1))
    assert found is not None
    assert found.fringes.max() == 0.0
    assert found.noise[0, 0] == pytest.approx(1 / np.sqrt(2700))


def written(folder: Path, **columns: object) -> Path:
    path = folder / "visits.ecsv"
    Table(columns).write(path, format="ascii.ecsv", overwrite=True)
    return path


def test_visits_are_read_from_a_table(tmp_path: Path) -> None:
    path = written(tmp_path, x=[70.0, 75.0, 80.0], y=[60.0, 70.0, 90.0], rotation=[0.0, 45.0, 90.0])
    read = VisitPlaces.read(path, 2)
    assert list(read.frame) == [0, 1, 0]
    # The second visit is 70 px from the first row, its corners farther out: 1 + 2 × 69 / √2.
    assert read.region_px((150, 160)) == 98
    off = written(tmp_path, x=[70.0, 2.0], y=[60.0, 70.0], rotation=[0.0, 45.0], frame=[0, 1])
    with pytest.raises(OutOfRangeError, match=r"place of visit 1 .*\(2\.0, 70\.0\)"):
        VisitPlaces.read(off, 2).region_px((150, 160))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": [1.0], "y": [1.0]}, "x, y, rotation"),
        ({"x": [70.0], "y": [60.0], "rotation": [0.0]}, "two or more"),
        ({"x": [70.0, np.nan], "y": [60.0, 60.0], "rotation": [0.0, 0.0]}, "x is 'not finite'"),
        ({"x": [70.0, 70.0], "y": [60.0, 60.0], "rotation": ["a", "b"]}, "rotation is 'not numbers'"),
        ({"x": [70.0, 70.0], "y": [60.0, 60.0], "rotation": [0, 0], "frame": [0, 2]}, "0 to 1"),
    ],
)
def test_tables_that_name_no_visits_are_refused(
    tmp_path: Path, columns: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        VisitPlaces.read(written(tmp_path, **columns), 2)
