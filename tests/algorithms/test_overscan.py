"""The level of an amplifier from overscans that are made up, of amplifiers of any size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.algorithms.flat_prep_options import FlatPrepOptions
from lsst.fringe_sim.algorithms.overscan import NEARBY_ROWS, correct_overscan
from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.instrument.raw_frame import RawAmplifier

SKIP = FlatPrepOptions().overscan_skip


def amplifier(
    rows: int = 120,
    columns: int = 30,
    prescan: int = 3,
    serial: int = 20,
    parallel: int = 12,
    noise: float = 4.0,
    drift: float = 0.5,
) -> RawAmplifier:
    """A level that drifts along a line, noise, light of 500 ADU, and columns that differ from each other."""
    rng = np.random.default_rng(7)
    height, width = rows + parallel, prescan + columns + serial
    data = 1000.0 + drift * np.arange(height)[:, np.newaxis] + noise * rng.standard_normal((height, width))
    imaging = slice(0, rows), slice(prescan, prescan + columns)
    data[:, imaging[1]] += 3.0 * rng.standard_normal(columns)
    data[imaging] += 500.0
    return RawAmplifier(
        name="C00", channel=1, hdu=1, datasec=None, detsec=None, imaging=imaging,
        serial_prescan=(imaging[0], slice(0, prescan)),
        serial_overscan=(imaging[0], slice(prescan + columns, width)),
        parallel_overscan=(slice(rows, height), imaging[1]),
        destination=imaging, flip_y=False, flip_x=False, data=np.rint(data).astype(np.int32),
    )  # fmt: skip


def charged(amp: RawAmplifier, rows: slice, adu: float, *, everywhere: bool = False) -> RawAmplifier:
    """With charge in the overscan of some rows, or with their whole level moved."""
    data = amp.data.copy()
    data[rows, slice(None) if everywhere else amp.serial_overscan[1]] += int(adu)
    return replace(amp, data=data)


def level_of(amp: RawAmplifier) -> np.ndarray:
    """Level that was taken off each row of the imaging section."""
    found = correct_overscan(amp, FlatPrepOptions(parallel_overscan=False))
    assert found is not None
    return (amp.data[amp.imaging] - found.image)[:, 0]


@pytest.mark.parametrize("row", [4, 30, 60, 117])
@pytest.mark.parametrize("prescan", [0, 2])
def test_a_row_with_charge_gets_the_median_of_the_rows_around_where_nothing_is_read_before_the_light(
    prescan: int, row: int
) -> None:
    """At the ends the drift goes on as it was; there the median is that of the line."""
    amp = amplifier(prescan=prescan)
    plain = level_of(amp)
    spoilt = level_of(charged(amp, slice(row, row + 1), 400))
    others = np.arange(len(plain)) != row
    np.testing.assert_array_equal(spoilt[others], plain[others])
    if NEARBY_ROWS <= row < len(plain) - NEARBY_ROWS:
        around = np.concatenate([plain[row - NEARBY_ROWS : row], plain[row + 1 : row + NEARBY_ROWS + 1]])
        assert spoilt[row] == pytest.approx(np.median(np.append(around, np.inf)), abs=1e-6)
    assert spoilt[row] == pytest.approx(1000.0 + 0.5 * row, abs=3.0)


@pytest.mark.parametrize("drift", [-2.0, 2.0])
@pytest.mark.parametrize("row", [2, 117])
def test_a_row_with_charge_near_an_end_lies_on_a_drift_that_rises_or_falls(row: int, drift: float) -> None:
    """Without a prescan the level is a median of the rows around, two of which charge or the last five may move."""
    amp = amplifier(prescan=0, noise=1.0, drift=drift)
    spoilt = level_of(charged(amp, slice(row, row + 1), 400))
    assert spoilt[row] == pytest.approx(1000.0 + drift * row, abs=3.0 * abs(drift))


def test_a_row_with_charge_lies_between_its_neighbours_and_one_that_was_moved_keeps_its_level() -> None:
    amp = amplifier(noise=1.0)
    plain, rows = level_of(amp), slice(50, 53)
    spoilt, moved = (level_of(charged(amp, rows, 400, everywhere=everywhere)) for everywhere in (False, True))
    line = np.interp(np.arange(50, 53), [49, 53], plain[[49, 53]])
    np.testing.assert_allclose(spoilt[rows], line, atol=1e-3)
    np.testing.assert_allclose(moved[rows], plain[rows] + 400.0, atol=1e-3)


def test_how_many_overscan_columns_and_rows_are_enough() -> None:
    """Three beside those that are left out; without as many rows the columns are left as they are."""
    assert correct_overscan(amplifier(serial=SKIP + 3)) is not None
    with pytest.raises(FrameFormatError, match=f"C00 serial overscan.*{SKIP + 2}.*{SKIP + 3} columns"):
        correct_overscan(amplifier(serial=SKIP + 2))
    for rows in (SKIP + 2, SKIP + 3):
        amp = amplifier(parallel=rows)
        with_columns, without = (
            correct_overscan(amp, FlatPrepOptions(parallel_overscan=parallel)) for parallel in (True, False)
        )
        assert (np.ptp(with_columns.image - without.image) > 1.0) == (rows == SKIP + 3)


def test_an_amplifier_that_is_switched_off_has_no_level() -> None:
    amp = amplifier()
    assert correct_overscan(replace(amp, data=np.full_like(amp.data, 7))) is None


def test_an_integer_is_never_known_better_than_its_rounding() -> None:
    amp = amplifier()
    data = np.full_like(amp.data, 1000)
    data[amp.imaging] = 1500
    found = correct_overscan(replace(amp, data=data))
    assert found.noise_adu == pytest.approx(1.0 / np.sqrt(12.0))
    assert (found.level_adu, found.image.min(), found.image.max()) == (1000.0, 500.0, 500.0)


@pytest.mark.parametrize("method", ["median", "spline"])
@pytest.mark.parametrize("rows", [10, 14, 120])
def test_levels_are_as_recorded(method: str, rows: int, recorded: Record) -> None:
    amp, found = amplifier(rows), {}
    options = FlatPrepOptions(overscan_method=method, overscan_knots=6)
    spoilt = charged(charged(amp, slice(5, 7), 60), slice(rows + 7, rows + 9), 25, everywhere=True)
    bled = amp.data.copy()
    bled[rows:, 10:12] += 90
    for name, one in {
        "plain": amp, "spoilt": spoilt, "bled": replace(amp, data=bled), "no prescan": amplifier(rows, prescan=0),
        "many": charged(amp, slice(0, rows // 2), 300),
    }.items():  # fmt: skip
        for skip in (0, 5):
            level = correct_overscan(one, replace(options, overscan_skip=skip))
            found[f"{name} {skip}"] = [level.level_adu, level.noise_adu, level.image]
    recorded(found)
