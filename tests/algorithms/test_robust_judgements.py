"""A defect is masked itself: it does not move what the rest of the sensor is judged by."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.flat_prep import (
    FlatPrepOptions,
    assemble_charge,
    correct_overscan,
    prepare_flat,
)
from lsst.fringe_sim.instrument.raw_frame import RawAmplifier, RawFrame
from lsst.fringe_sim.mock import MockRun, e2v_321, write_mock_flats
from lsst.fringe_sim.products import mask_bits

SHAPE = (160, 512)
NO_EDGE = FlatPrepOptions(edge_px=0)
AMPLIFIER = "C13"

Edit = Callable[[np.ndarray, RawAmplifier], None]


def make(folder: Path, thickness: np.ndarray, **effects: float) -> MockRun:
    return write_mock_flats(
        folder,
        setup="ts8_e2v",
        detector="R11_S01",
        thickness_um=thickness,
        wavelengths_nm=[960.0],
        rng=np.random.default_rng(42),
        size=f"{SHAPE[1]}x{SHAPE[0]}",
        n_bias=1,
        effects={name.replace("__", "."): value for name, value in effects.items()},
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> MockRun:
    return make(tmp_path_factory.mktemp("flat"), e2v_321(SHAPE, sampling="window", corner=(2900, 600)))


@pytest.fixture(scope="module")
def flat(run: MockRun) -> RawFrame:
    return RawFrame.read(run.flats[0].path)


def edited(frame: RawFrame, change: Edit, *names: str) -> RawFrame:
    amplifiers = []
    for amp in frame.amplifiers:
        if amp.name in (names or (AMPLIFIER,)):
            amp = dataclasses.replace(amp, data=amp.data.copy())
            change(amp.data, amp)
        amplifiers.append(amp)
    return dataclasses.replace(frame, amplifiers=tuple(amplifiers))


# Amplifiers -----------------------------------------------------------------------------------------------


def hot(data: np.ndarray, amp: RawAmplifier) -> None:
    data[amp.imaging] += 95_000


def hot_everywhere(data: np.ndarray, amp: RawAmplifier) -> None:
    data += 68_000 + np.random.default_rng(3).integers(0, 3000, data.shape)
    data[amp.imaging] += 95_000


def saturated(data: np.ndarray, amp: RawAmplifier) -> None:
    data[amp.imaging] = 2**18 - 1


def nearly_saturated(data: np.ndarray, amp: RawAmplifier) -> None:
    saturated(data, amp)
    data[amp.imaging][::2, ::4] = 120_000


@pytest.mark.parametrize("change", [hot, hot_everywhere, saturated, nearly_saturated])
def test_one_amplifier_is_masked_and_not_the_fifteen_others(
    run: MockRun, flat: RawFrame, change: Edit
) -> None:
    prepared = prepare_flat(edited(flat, change), None, run.detector, bandwidth_fwhm_nm=2.0, options=NO_EDGE)
    whole = prepare_flat(flat, None, run.detector, bandwidth_fwhm_nm=2.0, options=NO_EDGE)
    assert prepared.metadata["BADAMPS"] == AMPLIFIER
    assert whole.metadata["BADAMPS"] == "none"
    assert prepared.metadata["RDNOISE"] == pytest.approx(whole.metadata["RDNOISE"], rel=0.1)
    for amp in flat.amplifiers:
        masked = np.mean(prepared.mask[amp.destination] != 0)
        if amp.name == AMPLIFIER:
            assert masked == 1.0
        else:
            # Two columns beside saturated ones.
            assert masked < 0.04


def test_most_amplifiers_may_be_blind(run: MockRun, flat: RawFrame) -> None:
    def blind(data: np.ndarray, amp: RawAmplifier) -> None:
        data[:] = np.random.default_rng(1).normal(27_000, 4, data.shape).astype(np.int32)

    names = [amp.name for amp in flat.amplifiers][:10]
    charge = assemble_charge(edited(flat, blind, *names), None, run.detector, NO_EDGE)
    assert charge.unused == tuple(sorted(names))


# Blooming -------------------------------------------------------------------------------------------------


def test_shoulders_of_blooming_are_masked(run: MockRun, flat: RawFrame) -> None:
    def bloom(data: np.ndarray, amp: RawAmplifier) -> None:
        image = data[amp.imaging]
        image[10:60, 20] = 2**18 - 1
        image[10:60, 19] = image[10:60, 21] = 90_000
        image[60:75, 20] = 95_000
        image[5:10, 20] = 70_000

    charge = assemble_charge(edited(flat, bloom), None, run.detector, NO_EDGE)
    (amp,) = (amp for amp in flat.amplifiers if amp.name == AMPLIFIER)
    full = amp.oriented(charge.mask[amp.destination]) & mask_bits("SAT") != 0
    assert full[5:75, 20].all()
    assert full[10:60, 18:23].all()
    assert np.count_nonzero(full) < 90 * 7
    others = [other for other in flat.amplifiers if other.name != AMPLIFIER]
    assert not any(np.any(charge.mask[other.destination] & mask_bits("SAT")) for other in others)


# Overscan -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["median", "spline"])
@pytest.mark.parametrize("rows", [slice(50, 53), slice(0, 2), slice(30, 40)])
@pytest.mark.parametrize("charge", [20, 500, 30_000])
def test_charge_in_the_overscan_does_not_pull_rows_down(
    flat: RawFrame, method: str, rows: slice, charge: int
) -> None:
    def spill(data: np.ndarray, amp: RawAmplifier) -> None:
        data[rows, amp.serial_overscan[1]] += charge

    (amp,) = (amp for amp in flat.amplifiers if amp.name == AMPLIFIER)
    options = FlatPrepOptions(overscan_method=method)
    plain = correct_overscan(amp, options)
    spilled = correct_overscan(edited(flat, spill).amplifier(AMPLIFIER), options)
    assert plain is not None
    assert spilled is not None
    difference = spilled.image - plain.image
    # The level of a row is that of the rows around: the noise of a few row levels.
    assert np.abs(difference).max() < plain.noise_adu
    assert spilled.noise_adu == pytest.approx(plain.noise_adu, rel=0.02)


def test_a_row_that_the_electronics_have_moved_is_followed(flat: RawFrame) -> None:
    def shift(data: np.ndarray, amp: RawAmplifier) -> None:
        data[40:42] += 300

    (amp,) = (amp for amp in flat.amplifiers if amp.name == AMPLIFIER)
    plain, moved = correct_overscan(amp), correct_overscan(edited(flat, shift).amplifier(AMPLIFIER))
    assert plain is not None
    assert moved is not None
    assert np.abs(moved.image - plain.image).max() < 0.1


# Columns --------------------------------------------------------------------------------------------------


def bad(charge_mask: np.ndarray, frame: RawFrame) -> dict[str, np.ndarray]:
    """Columns that are bad over the whole height, by amplifier, in read-out order."""
    return {
        amp.name: np.flatnonzero(np.all(amp.oriented(charge_mask[amp.destination]) & 1, axis=0))
        for amp in frame.amplifiers
    }


@pytest.mark.parametrize("contrast", [1.0, 0.13])
@pytest.mark.parametrize("width", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("factor", [1.1, 0.7, 4.0])
def test_adjacent_bad_columns_are_found(tmp_path: Path, width: int, factor: float, contrast: float) -> None:
    thickness = e2v_321(SHAPE, sampling="window", corner=(2900, 600))
    made = (
        make(tmp_path, thickness, contrast_loss__factor=contrast)
        if contrast < 1
        else make(tmp_path, thickness)
    )
    frame = RawFrame.read(made.flats[0].path)

    def spoil(data: np.ndarray, amp: RawAmplifier) -> None:
        columns = data[amp.imaging][:, 30 : 30 + width]
        columns[:] = 27_000 + np.rint(factor * (columns - 27_000.0)).astype(data.dtype)

    charge = assemble_charge(edited(frame, spoil), None, made.detector, NO_EDGE)
    found = bad(charge.mask, frame)
    assert set(range(30, 30 + width)) <= set(found[AMPLIFIER])
    assert sum(map(len, found.values())) <= width + 1


@pytest.mark.parametrize("contrast", [1.0, 0.13])
@pytest.mark.parametrize("period_px", [6.0, 9.0, 14.0, 25.0, 60.0, 200.0])
@pytest.mark.parametrize("curved", [0.0, 1.0])
def test_fringes_along_the_columns_are_not_bad_columns(
    tmp_path: Path, contrast: float, period_px: float, curved: float
) -> None:
    """Fringes parallel to the columns are the worst that there is: no row tells them from a column."""
    order_um = 0.96 / (2 * 1.5)
    x = np.arange(SHAPE[1]) / period_px
    slope = 14.0 + order_um * (x + curved * np.sin(x / 3.0))
    thickness = np.broadcast_to(slope, SHAPE).copy()
    if thickness.max() > 32.0:
        thickness = 14.0 + np.abs((thickness - 14.0 + 12.0) % 24.0 - 12.0)
    made = (
        make(tmp_path, thickness, contrast_loss__factor=contrast)
        if contrast < 1
        else make(tmp_path, thickness)
    )
    frame = RawFrame.read(made.flats[0].path)
    charge = assemble_charge(frame, None, made.detector, NO_EDGE)
    assert sum(map(len, bad(charge.mask, frame).values())) == 0
