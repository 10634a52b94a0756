"""Preparation of flats: the mock's truth comes back, masks lie where the trouble is, the noise is what is stated."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from lsst.fringe_sim.algorithms.flat_prep import (
    CombinedBias,
    FlatPrepOptions,
    assemble_charge,
    combine_biases,
    correct_overscan,
    prepare_flat,
)
from lsst.fringe_sim.algorithms.masked_smoothing import smooth_masked
from lsst.fringe_sim.errors import FrameFormatError, InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.raw_frame import RawFrame
from lsst.fringe_sim.mock import Defects, MockRun, e2v_321, write_mock_flats
from lsst.fringe_sim.mock.readout import BIAS_PATTERN_ADU
from lsst.fringe_sim.products import FringeFlat, mask_bits

SHAPE = (160, 192)
WAVELENGTHS = [880.0, 960.0, 990.0]
NO_EDGE = FlatPrepOptions(edge_px=0)

Pixels = np.ndarray
Edit = Callable[[Pixels], None]


def make(folder: Path, **changes: object) -> MockRun:
    arguments: dict[str, object] = {
        "setup": "ts8_e2v",
        "detector": "R11_S01",
        "thickness_um": e2v_321(SHAPE, sampling="window", corner=(2900, 600)),
        "wavelengths_nm": WAVELENGTHS,
        "rng": np.random.default_rng(2022),
        "size": f"{SHAPE[1]}x{SHAPE[0]}",
        "n_bias": 5,
    }
    arguments.update(changes)
    return write_mock_flats(folder, **arguments)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> MockRun:
    return make(tmp_path_factory.mktemp("flats"))


@pytest.fixture(scope="module")
def biases(run: MockRun) -> list[RawFrame]:
    return [RawFrame.read(exposure.path) for exposure in run.bias]


@pytest.fixture(scope="module")
def bias(biases: list[RawFrame]) -> CombinedBias:
    return combine_biases(biases)


@pytest.fixture(scope="module")
def flat(run: MockRun) -> RawFrame:
    return RawFrame.read(run.flats[1].path)


def edited(frame: RawFrame, changes: dict[str, Edit]) -> RawFrame:
    """The frame with other pixels in some amplifiers."""
    amplifiers = []
    for amp in frame.amplifiers:
        if amp.name in changes:
            data = amp.data.copy()
            changes[amp.name](data)
            amp = dataclasses.replace(amp, data=data)
        amplifiers.append(amp)
    return dataclasses.replace(frame, amplifiers=tuple(amplifiers))


# Charge ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["median", "spline"])
@pytest.mark.parametrize("number", range(len(WAVELENGTHS)))
def test_charge_is_the_truth_within_its_noise(
    run: MockRun, bias: CombinedBias, number: int, method: str
) -> None:
    options = FlatPrepOptions(overscan_method=method, edge_px=0)
    exposure = run.flats[number]
    charge = assemble_charge(RawFrame.read(exposure.path), bias, run.detector, options)
    assert np.count_nonzero(charge.mask) < 1e-4 * charge.mask.size
    expected = run.truth.expected_electrons(exposure)
    pull = ((charge.image - expected) / np.sqrt(charge.variance))[charge.mask == 0]
    assert pull.mean() == pytest.approx(0.0, abs=0.03)
    assert pull.std() == pytest.approx(1.0, abs=0.015)
    assert np.abs(pull).max() < 6.0


def test_every_amplifier_has_its_own_level(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    """A wrong gain, bias or place of one amplifier would show as a step of its mean."""
    charge = assemble_charge(flat, bias, run.detector, NO_EDGE)
    ratio = charge.image / run.truth.expected_electrons(run.flats[1])
    for amp in flat.amplifiers:
        section = ratio[amp.destination]
        assert section.mean() == pytest.approx(1.0, abs=5.0 * 0.0072 / np.sqrt(section.size))


def test_a_hidden_gain_error_shows_in_its_amplifier(tmp_path: Path, run: MockRun) -> None:
    hidden = make(tmp_path, effects={"amplifier_gain.C14": 0.05})
    flats = [
        assemble_charge(RawFrame.read(one.flats[1].path), None, run.detector, NO_EDGE).image
        for one in (run, hidden)
    ]
    for amp in RawFrame.read(run.flats[1].path).amplifiers:
        ratio = flats[1][amp.destination].mean() / flats[0][amp.destination].mean()
        assert ratio == pytest.approx(1.0 / 1.05 if amp.name == "C14" else 1.0, abs=1e-3)


def test_read_noise_comes_from_the_overscan(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    charge = assemble_charge(flat, bias, run.detector)
    for state in run.truth.amplifiers:
        # Quantisation to whole ADU adds gain² / 12.
        expected = np.hypot(state.read_noise_e, state.gain / np.sqrt(12.0))
        assert charge.read_noise_e[state.name] == pytest.approx(expected, rel=0.05)


# Overscan and bias ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["median", "spline"])
def test_overscan_follows_the_drift_of_the_rows(biases: list[RawFrame], method: str) -> None:
    """A drift of 200 ADU from row to row, put in by hand, leaves no trace."""
    drift = np.rint(100.0 * np.sin(np.arange(biases[0].amplifiers[0].data.shape[0]) / 40.0)).astype(np.int32)

    def add(data: Pixels) -> None:
        data += drift[:, np.newaxis]

    options = FlatPrepOptions(overscan_method=method)
    plain = correct_overscan(biases[0].amplifiers[3], options)
    name = biases[0].amplifiers[3].name
    moved = correct_overscan(edited(biases[0], {name: add}).amplifiers[3], options)
    assert plain is not None
    assert moved is not None
    difference = moved.image - plain.image
    # The curve through the rows only follows what is smooth over its 16 intervals and half an ADU of rounding.
    np.testing.assert_allclose(difference, 0.0, atol=1e-3 if method == "median" else 1.0)


@pytest.mark.parametrize("method", ["median", "spline"])
@pytest.mark.rng("overscan rejects outliers")
def test_overscan_rejects_outliers(biases: list[RawFrame], method: str, rng: np.random.Generator) -> None:
    def hit(data: Pixels) -> None:
        first = data.shape[1] - 45
        for _ in range(60):
            data[rng.integers(data.shape[0]), first + rng.integers(45)] += 20_000
        data[40, first:] += 3000  # a whole row of the overscan is spoilt

    options = FlatPrepOptions(overscan_method=method, parallel_overscan=False)
    amp = biases[0].amplifiers[7]
    plain = correct_overscan(amp, options)
    spoilt = correct_overscan(edited(biases[0], {amp.name: hit}).amplifiers[7], options)
    assert plain is not None
    assert spoilt is not None
    untouched = np.arange(plain.image.shape[0]) != 40
    assert np.abs(spoilt.image - plain.image)[untouched].max() < 0.25 * plain.noise_adu + 1.0
    assert spoilt.noise_adu == pytest.approx(plain.noise_adu, rel=0.05)
    if method == "spline":
        assert np.abs(spoilt.image - plain.image)[40].max() < 2.0


def test_parallel_overscan_removes_columns_but_not_what_bled_into_it(biases: list[RawFrame]) -> None:
    amp = biases[0].amplifiers[0]

    def columns(data: Pixels) -> None:
        data[:, 20] += 40  # the same in image and overscan: taken off
        data[amp.parallel_overscan[0], 25] += 4000  # charge that bled: not to be taken off the image

    plain = correct_overscan(amp)
    changed = correct_overscan(edited(biases[0], {amp.name: columns}).amplifiers[0])
    assert plain is not None
    assert changed is not None
    difference = changed.image - plain.image
    bled, shifted = 25 - amp.imaging[1].start, 20 - amp.imaging[1].start
    assert np.abs(difference[:, bled]).max() < 3.0 * plain.noise_adu
    other = np.delete(difference, [bled, shifted], axis=1)
    # One column less in the mean of all: the same for the others, and a small part of what columns differ by.
    assert np.ptp(other) < 1e-3
    without = correct_overscan(amp, FlatPrepOptions(parallel_overscan=False))
    assert without is not None
    columns_differ = (without.image - plain.image)[0]
    assert np.abs(other).max() < np.abs(columns_differ).max() / other.shape[1]


def test_parallel_overscan_leaves_the_level_to_the_serial_one(biases: list[RawFrame]) -> None:
    """A few dozen rows know the level of an amplifier to a tenth of an ADU, all rows to a hundredth."""
    for amp in biases[0].amplifiers:
        levels = [
            correct_overscan(amp, FlatPrepOptions(parallel_overscan=parallel)) for parallel in (True, False)
        ]
        means = [one.image.mean(dtype=float) for one in levels if one is not None]
        assert means[0] == pytest.approx(means[1], abs=1e-3)


def test_combined_bias_is_the_pattern(run: MockRun, biases: list[RawFrame]) -> None:
    """Columns of the mean bias scatter as the fixed pattern does, and halve the noise with four times the frames."""
    options = FlatPrepOptions(parallel_overscan=False)
    mean = combine_biases(biases, options)
    assert mean.n_frames == 5
    for amp in biases[0].amplifiers:
        section = mean.image[amp.destination]
        spread = (section - np.median(section, axis=0)).std()
        noise = mean.noise_adu[amp.name]
        # Pixel noise of the mean, and the noise of the median of 49 overscan pixels in each row.
        assert spread == pytest.approx(noise / np.sqrt(5) * np.sqrt(1 + 1.57 / 49), rel=0.08)
        columns = np.median(section, axis=0)
        columns = columns[:-12] if amp.flip_x else columns[12:]  # without the settling at the start of a row
        assert columns.std() == pytest.approx(BIAS_PATTERN_ADU, rel=0.8)


def test_outliers_do_not_enter_the_bias(biases: list[RawFrame], bias: CombinedBias) -> None:
    amp = biases[2].amplifiers[5]

    def cosmic(data: Pixels) -> None:
        data[30:33, 20:24] += 5000
        data[50, 15] -= 4000

    spoilt = combine_biases([*biases[:2], edited(biases[2], {amp.name: cosmic}), *biases[3:]])
    noise = bias.noise_adu[amp.name]
    assert np.abs(spoilt.image - bias.image).max() < 3.0 * noise
    assert np.count_nonzero(spoilt.mask) == np.count_nonzero(bias.mask)


def test_hot_pixels_of_the_bias_are_bad(biases: list[RawFrame]) -> None:
    amp = biases[0].amplifiers[4]
    row, column = amp.imaging[0].start + 11, amp.imaging[1].start + 6

    def hot(data: Pixels) -> None:
        data[row, column] += 3000

    combined = combine_biases([edited(frame, {amp.name: hot}) for frame in biases])
    expected = np.zeros(combined.mask.shape, bool)
    section = np.zeros(amp.data[amp.imaging].shape, bool)
    section[11, 6] = True
    expected[amp.destination] = amp.oriented(section)
    np.testing.assert_array_equal(combined.mask != 0, expected)


def test_bias_subtraction_removes_the_pattern(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    options = FlatPrepOptions(parallel_overscan=False, edge_px=0)
    expected = run.truth.expected_electrons(run.flats[1])
    bias = combine_biases((RawFrame.read(one.path) for one in run.bias), options)
    with_bias, without = (assemble_charge(flat, one, run.detector, options) for one in (bias, None))
    start = [amp.destination for amp in flat.amplifiers if not amp.flip_x]
    residual = [
        np.mean([(one.image - expected)[rows, columns][:, :3].mean() for rows, columns in start])
        for one in (with_bias, without)
    ]
    assert abs(residual[0]) < 2.5  # noise of the mean of 8 × 80 × 3 pixels: 3.2 electrons
    assert residual[1] > 3.0


# Masks ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def blemished(tmp_path_factory: pytest.TempPathFactory) -> MockRun:
    return make(tmp_path_factory.mktemp("blemished"), defects=Defects(bad_columns=6, hot_pixels=40))


@pytest.mark.parametrize("number", range(len(WAVELENGTHS)))
def test_bad_pixels_and_columns_are_found(blemished: MockRun, number: int) -> None:
    bias = combine_biases(RawFrame.read(exposure.path) for exposure in blemished.bias)
    charge = assemble_charge(RawFrame.read(blemished.flats[number].path), bias, blemished.detector, NO_EDGE)
    found = charge.mask & mask_bits("BAD") != 0
    truly = blemished.truth.defective.copy()
    # The outermost ring has too few neighbours to judge by; the border is masked anyway.
    judged = np.zeros_like(found)
    judged[2:-2, 2:-2] = True
    assert np.count_nonzero(found & truly & judged) > 0.97 * np.count_nonzero(truly & judged)
    # A column is masked over its whole amplifier, so good pixels of bad columns may be; others may not.
    half = SHAPE[0] // 2
    spoilt = np.zeros_like(truly)
    for rows in (slice(0, half), slice(half, None)):
        spoilt[rows, truly[rows].sum(axis=0) > 5] = True
    assert np.count_nonzero(found & ~truly & ~spoilt) <= 2


def test_narrow_fringes_are_not_defects(tmp_path: Path) -> None:
    """Twenty-seven fringes over 160 rows at the highest contrast: nothing is thrown away."""
    made = make(tmp_path, thickness_um=e2v_321(SHAPE), wavelengths_nm=[990.0], n_bias=0)
    charge = assemble_charge(RawFrame.read(made.flats[0].path), None, made.detector, NO_EDGE)
    assert np.count_nonzero(charge.mask) < 1e-3 * charge.mask.size


def test_edge_and_midline_are_masked(run: MockRun, flat: RawFrame) -> None:
    options = FlatPrepOptions(edge_px=7, midline_px=3)
    mask = assemble_charge(flat, None, run.detector, options).mask & mask_bits("EDGE") != 0
    expected = np.ones(SHAPE, bool)
    expected[7:-7, 7:-7] = False
    expected[SHAPE[0] // 2 - 3 : SHAPE[0] // 2 + 3] = True
    np.testing.assert_array_equal(mask, expected)


def test_saturated_pixels_are_masked_by_amplifier(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    amp = flat.amplifiers[9]
    level = int(run.detector.amplifier(amp.name).saturation)

    def fill(data: Pixels) -> None:
        data[amp.imaging][10:14, 5:9] = 27_000 + level
        data[amp.imaging][20, 5] = 2**18 - 1

    charge = assemble_charge(edited(flat, {amp.name: fill}), bias, run.detector)
    section = np.zeros(amp.data[amp.imaging].shape, bool)
    section[10:14, 5:9] = True
    section[20, 5] = True
    expected = np.zeros(SHAPE, bool)
    expected[amp.destination] = amp.oriented(section)
    # Two pixels around a saturated one are masked with it.
    expected = binary_dilation(expected, np.ones((5, 5), bool))
    np.testing.assert_array_equal(charge.mask & mask_bits("SAT") != 0, expected)


def test_dead_amplifiers_are_masked(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    """One is switched off (zeros), one reads out but is blind."""

    def blind(data: Pixels) -> None:
        data[:] = np.random.default_rng(1).normal(27_000, 4, data.shape).astype(np.int32)

    frame = edited(flat, {"C03": lambda data: data.fill(0), "C15": blind})
    prepared = prepare_flat(frame, bias, run.detector, bandwidth_fwhm_nm=2.0)
    for amp in frame.amplifiers:
        section = prepared.mask[amp.destination]
        assert np.all(section & mask_bits("NO_DATA")) == (amp.name == "C03")
        assert np.all(section & mask_bits("BAD")) == (amp.name == "C15")
    whole = prepare_flat(flat, bias, run.detector, bandwidth_fwhm_nm=2.0)
    assert prepared.level_e == pytest.approx(whole.level_e, rel=0.03)


def test_pixels_without_bias_have_no_data(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    holed = bias.mask.copy()
    holed[60:70, 60:70] |= mask_bits("NO_DATA")
    mask = assemble_charge(flat, dataclasses.replace(bias, mask=holed), run.detector).mask
    assert np.all(mask[60:70, 60:70] & mask_bits("NO_DATA"))


# The whole ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", range(len(WAVELENGTHS)))
def test_prepared_flat_is_the_smoothed_truth(run: MockRun, bias: CombinedBias, number: int) -> None:
    prepared = prepare_flat(RawFrame.read(run.flats[number].path), bias, run.detector, bandwidth_fwhm_nm=2.0)
    assert isinstance(prepared, FringeFlat)
    assert prepared.wavelength_nm == WAVELENGTHS[number]
    assert prepared.temperature_k == pytest.approx(183.15)
    assert prepared.bandwidth_fwhm_nm == 2.0
    assert prepared.detector == run.detector.name
    assert prepared.dark_time_s == RawFrame.read(run.flats[number].path).metadata.dark_time_s > 10.0
    good = prepared.mask == 0
    truth = run.truth.expected_electrons(run.flats[number]).astype(np.float32)
    smooth, _ = smooth_masked(truth, np.ones(SHAPE, np.float32), good, 3.0)
    pull = ((prepared.image - (smooth / smooth[good].mean() - 1.0)) / np.sqrt(prepared.variance))[good]
    # About 113 pixels share their noise, so some 200 values are independent.
    assert pull.std() == pytest.approx(1.0, abs=0.12)
    assert pull.mean() == pytest.approx(0.0, abs=0.2)
    assert prepared.level_e == pytest.approx(truth[good].mean(), rel=5e-4)
    assert prepared.image[good].mean(dtype=float) == pytest.approx(0.0, abs=1e-6)


def test_smoothing_is_recorded(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    prepared = prepare_flat(flat, bias, run.detector, bandwidth_fwhm_nm=2.0)
    about = prepared.metadata
    assert about["SMOOTHPX"] == 3.0
    assert about["CORRPX"] == pytest.approx(3.0 * np.sqrt(2.0))
    assert about["NBIAS"] == 5
    assert about["SERIAL"] == "E2V-CCD250-321"
    assert about["EXPID"] == flat.metadata.exposure_id


def test_unsmoothed_flat_keeps_pixel_noise(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    options = FlatPrepOptions(smoothing_sigma_px=0.0)
    prepared = prepare_flat(flat, bias, run.detector, bandwidth_fwhm_nm=2.0, options=options)
    good = prepared.mask == 0
    truth = run.truth.light(960.0)
    pull = ((prepared.image - (truth / truth[good].mean() - 1.0)) / np.sqrt(prepared.variance))[good]
    assert pull.std() == pytest.approx(1.0, abs=0.015)


def test_width_in_the_header_wins(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    stated = dataclasses.replace(flat, metadata=dataclasses.replace(flat.metadata, bandpass_nm=1.25))
    assert prepare_flat(stated, bias, run.detector, bandwidth_fwhm_nm=2.0).bandwidth_fwhm_nm == 1.25


def test_survives_the_trip_to_disk(run: MockRun, bias: CombinedBias, flat: RawFrame, tmp_path: Path) -> None:
    prepared = prepare_flat(flat, bias, run.detector, bandwidth_fwhm_nm=2.0)
    prepared.write_fits(tmp_path / "flat.fits")
    again = FringeFlat.read_fits(tmp_path / "flat.fits")
    np.testing.assert_array_equal(again.image, prepared.image)
    np.testing.assert_array_equal(again.mask, prepared.mask)


@pytest.mark.shared
def test_the_real_frame_is_prepared_as_it_is(shared_dir: Path) -> None:
    """One amplifier with pixels, fifteen zeroed (the public TS8 frame of E2V-CCD250-179 at 700 nm)."""
    frame = RawFrame.read(shared_dir / "measured" / "ts8_raw_201807241028453-RTM-010-S11-det067.fits")
    sensor = Camera.from_name("ts8").detector(frame.metadata.detector)
    prepared = prepare_flat(frame, None, sensor, bandwidth_fwhm_nm=1.0)
    assert prepared.wavelength_nm == pytest.approx(700.03)
    assert prepared.shape == (4004, 4096)
    good = prepared.mask == 0
    alive = np.zeros_like(good)
    alive[:2002, :512] = True
    assert not np.any(good & ~alive)
    assert np.count_nonzero(good) > 0.95 * np.count_nonzero(alive)
    # At 700 nm there are no fringes: what is left is illumination and photon noise.
    assert prepared.image[good].std() < 0.004
    # 47 800 - 27 026 ADU and a noise of 6.4 ADU, times the tabulated gain.
    gain = sensor.amplifier("C00").gain
    assert prepared.level_e == pytest.approx(20_774 * gain, rel=0.01)
    assert prepared.metadata["RDNOISE"] == pytest.approx(6.3 * gain, rel=0.1)


# Bad input ------------------------------------------------------------------------------------------------


def test_saturated_flat_is_refused(run: MockRun, tmp_path: Path) -> None:
    bright = make(tmp_path, level_e=400_000.0, n_bias=0, wavelengths_nm=[960.0])
    with pytest.raises(InputError, match="saturated part") as caught:
        prepare_flat(RawFrame.read(bright.flats[0].path), None, run.detector, bandwidth_fwhm_nm=2.0)
    assert str(bright.flats[0].path) in str(caught.value)


def test_dark_flat_is_refused(run: MockRun, biases: list[RawFrame]) -> None:
    about = dataclasses.replace(biases[0].metadata, observation_type="flat", wavelength_nm=960.0)
    off = edited(biases[0], {amp.name: lambda data: data.fill(0) for amp in biases[0].amplifiers})
    for frame in (biases[0], off):
        with pytest.raises(InputError, match="signal"):
            prepare_flat(
                dataclasses.replace(frame, metadata=about), None, run.detector, bandwidth_fwhm_nm=2.0
            )


def test_flat_with_nothing_but_border_is_refused(run: MockRun, flat: RawFrame) -> None:
    options = FlatPrepOptions(edge_px=200)
    with pytest.raises(InputError, match="good pixels"):
        prepare_flat(flat, None, run.detector, bandwidth_fwhm_nm=2.0, options=options)


def test_what_is_no_flat_is_refused(
    run: MockRun, bias: CombinedBias, biases: list[RawFrame], flat: RawFrame
) -> None:
    with pytest.raises(FrameFormatError, match="IMGTYPE"):
        prepare_flat(biases[0], bias, run.detector, bandwidth_fwhm_nm=2.0)
    with pytest.raises(FrameFormatError, match="IMGTYPE"):
        combine_biases([*biases, flat])
    with pytest.raises(InputError, match="at least one"):
        combine_biases([])


def test_missing_numbers_are_refused(run: MockRun, bias: CombinedBias, flat: RawFrame) -> None:
    with pytest.raises(InputError, match="bandwidth"):
        prepare_flat(flat, bias, run.detector)
    for keyword, changes in (("MONOWL", {"wavelength_nm": None}), ("CCDTEMP", {"temperature_k": None})):
        frame = dataclasses.replace(flat, metadata=dataclasses.replace(flat.metadata, **changes))
        with pytest.raises(FrameFormatError, match=keyword):
            prepare_flat(frame, bias, run.detector, bandwidth_fwhm_nm=2.0)


def test_mixed_sensors_are_refused(
    run: MockRun, bias: CombinedBias, biases: list[RawFrame], flat: RawFrame
) -> None:
    other = Camera.from_name("ts8").detector("R11_S02")
    with pytest.raises(FrameFormatError, match="LSST_NUM"):
        prepare_flat(flat, bias, other, bandwidth_fwhm_nm=2.0)
    with pytest.raises(FrameFormatError, match="LSST_NUM"):
        prepare_flat(
            flat, dataclasses.replace(bias, serial="E2V-CCD250-364"), run.detector, bandwidth_fwhm_nm=2.0
        )
    small = CombinedBias(bias.image[:32], bias.mask[:32], bias.noise_adu, 5, bias.serial)
    with pytest.raises(FrameFormatError, match="detector shape"):
        prepare_flat(flat, small, run.detector, bandwidth_fwhm_nm=2.0)
    stranger = dataclasses.replace(
        biases[1], metadata=dataclasses.replace(biases[1].metadata, serial="ITL-1")
    )
    with pytest.raises(FrameFormatError, match="LSST_NUM"):
        combine_biases([biases[0], stranger])


def test_too_little_overscan_is_refused(biases: list[RawFrame]) -> None:
    amp = biases[0].amplifiers[0]
    narrow = dataclasses.replace(amp, data=amp.data[:, : amp.serial_overscan[1].start + 4])
    with pytest.raises(FrameFormatError, match="serial overscan"):
        correct_overscan(narrow)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"overscan_method": "mean"}, UnknownNameError),
        ({"smoothing_sigma_px": -1.0}, OutOfRangeError),
        ({"saturation_fraction": 1.5}, OutOfRangeError),
        ({"clip_sigma": float("nan")}, OutOfRangeError),
        ({"edge_px": -1}, OutOfRangeError),
    ],
)
def test_impossible_options_are_refused(changes: dict[str, object], error: type[Exception]) -> None:
    with pytest.raises(error, match=next(iter(changes))):
        FlatPrepOptions(**changes)  # type: ignore[arg-type]
