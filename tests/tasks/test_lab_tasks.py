"""The laboratory tasks without a repository."""

import copy
import dataclasses
import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lsst.daf.butler import DataCoordinate, DimensionUniverse
from recorded_numbers import Record

from lsst.fringe_sim.errors import FrameFormatError, FringeSimError, InputError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.raw_frame import RawFrame
from lsst.fringe_sim.mock.raw_frames import MockRun
from lsst.fringe_sim.products import CombinedBias, FringeFlat
from lsst.fringe_sim.products.mask import mask_bits
from lsst.fringe_sim.tasks import (
    EpoxyFitConfig,
    EpoxyFitTask,
    FringeBiasConfig,
    FringeBiasTask,
    IsrFlatPrepConfig,
    IsrFlatPrepTask,
    UnusableDataError,
)
from lsst.fringe_sim.tasks.quantum import run_datetime, sensor_of, unusable

NAME, SERIAL = "RTM-020_S01", "E2V-CCD250-321"
ORDER_NM = 300.0
DETECTOR = Camera.from_name("ts8").detector(NAME)


@pytest.fixture(scope="module")
def frames(raws: dict[str, MockRun]) -> MockRun:
    return raws[NAME]


@pytest.fixture(scope="module")
def bias(frames: MockRun) -> CombinedBias:
    task = FringeBiasTask(config=FringeBiasConfig())
    combined: CombinedBias = task.run((RawFrame.read(item.path) for item in frames.bias), NAME).bias
    return combined


@pytest.fixture(scope="module")
def flats(frames: MockRun, bias: CombinedBias) -> list[FringeFlat]:
    task = IsrFlatPrepTask(config=IsrFlatPrepConfig(smoothing_sigma_px=0.0, edge_px=2))
    return [task.run(RawFrame.read(item.path), bias, DETECTOR).flat for item in frames.flats]


def fit(flats: list[FringeFlat], **config: Any) -> Any:
    return EpoxyFitTask(config=EpoxyFitConfig(**config)).run(iter(flats), len(flats), DETECTOR).thickness


def test_bias_and_flats_say_which_sensor_and_how(bias: CombinedBias, flats: list[FringeFlat]) -> None:
    assert (bias.n_frames, bias.detector, bias.serial) == (3, NAME, SERIAL)
    assert {flat.detector for flat in flats} == {NAME}
    assert {flat.bandwidth_fwhm_nm for flat in flats} == {2.0}
    assert {flat.metadata["SETUP"] for flat in flats} == {"ts8_e2v"}
    assert {flat.metadata["SMOOTHPX"] for flat in flats} == {0.0}


def test_what_is_taken_for_granted_of_a_frame_is_told(
    frames: MockRun, bias: CombinedBias, caplog: pytest.LogCaptureFixture
) -> None:
    def noted(path: Path, note: str) -> RawFrame:
        raw = RawFrame.read(path)
        return dataclasses.replace(raw, metadata=dataclasses.replace(raw.metadata, notes=(note,)))

    FringeBiasTask(config=FringeBiasConfig()).run([noted(frames.bias[0].path, "of a bias")], NAME)
    IsrFlatPrepTask(config=IsrFlatPrepConfig()).run(noted(frames.flats[0].path, "of a flat"), bias, DETECTOR)
    told = " ".join(record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert "of a bias" in told
    assert "of a flat" in told


def test_a_flat_among_the_biases_is_refused(frames: MockRun) -> None:
    paths = (frames.bias[0].path, frames.flats[0].path)
    with pytest.raises(FrameFormatError, match="IMGTYPE"):
        FringeBiasTask(config=FringeBiasConfig()).run((RawFrame.read(path) for path in paths), NAME)


def test_both_methods_find_the_truth(flats: list[FringeFlat], frames: MockRun) -> None:
    for method in ("global", "guo2022"):
        found = fit(flats, method=method)
        fitted = (found.mask & mask_bits("NO_DATA")) == 0
        error_nm = 1e3 * np.abs(found.value - frames.truth.thickness_um)[fitted]
        assert fitted.mean() > 0.95
        assert np.median(error_nm) < 5.0
        assert error_nm.max() < 0.5 * ORDER_NM
        assert found.metadata["METHOD"] == method
        assert found.detector == NAME


@pytest.mark.slow
def test_only_the_walk_doubts_the_orders_of_single_pixels(flats: list[FringeFlat]) -> None:
    """The walk judges every pixel on its own amplitudes, the global fit on those of the region."""
    slips = {
        method: np.mean((fit(flats, method=method).mask & mask_bits("SLIP")) != 0)
        for method in ("global", "guo2022")
    }
    assert slips["global"] == 0.0
    assert 0.01 < slips["guo2022"] < 0.5


def test_flats_that_are_not_of_the_total_absorption_are_refused(flats: list[FringeFlat]) -> None:
    """The published fit took 1 - R - T for the signal; these flats are not made of it, and no pixel is sure."""
    with pytest.raises(InputError, match=f"^{NAME}: good pixels of the thickness map is 0; allowed"):
        fit(flats, observable="total", range_um=[12.0, 14.5])


def test_missing_wavelengths_are_listed(flats: list[FringeFlat]) -> None:
    kept = [flat for flat in flats if flat.wavelength_nm not in (890.0, 950.0)]
    found = fit(kept)
    assert found.metadata["MISSING"] == "890,950"
    assert found.metadata["NFLATS"] == 10


def test_too_few_wavelengths_are_refused(flats: list[FringeFlat]) -> None:
    with pytest.raises(InputError, match="number of wavelengths is 3; allowed: 4 or more"):
        fit(flats[:3])
    nearly = dataclasses.replace(flats[3], wavelength_nm=flats[2].wavelength_nm + 2e-4)
    with pytest.raises(InputError, match="number of wavelengths is 3; allowed: 4 or more"):
        fit([*flats[:3], nearly])


def test_a_failure_names_sensor_field_and_value_and_survives_the_way_between_processes() -> None:
    with pytest.raises(UnusableDataError) as caught, unusable("R11_S01, exposure 5"):
        raise FrameFormatError("MONOWL", None, "a wavelength", source="a.fits")
    for error in (caught.value, copy.copy(caught.value)):
        assert str(error) == "R11_S01, exposure 5: a.fits: MONOWL is None; allowed: a wavelength"
        assert error.metadata == {
            "where": "R11_S01, exposure 5",
            "error": "FrameFormatError",
            "message": "a.fits: MONOWL is None; allowed: a wavelength",
            "field": "MONOWL",
            "value": "None",
            "allowed": "a wavelength",
            "source": "a.fits",
        }


def test_what_the_package_does_not_raise_on_purpose_is_left_alone() -> None:
    with pytest.raises(ZeroDivisionError), unusable("R11_S01"):
        _ = 1 / 0
    with pytest.raises(UnusableDataError), unusable("R11_S01"):
        raise FringeSimError("on purpose")


def test_the_sensor_is_found_by_the_name_of_its_instrument() -> None:
    universe = DimensionUniverse()
    for instrument, detector, serial in (("LSST-TS8", 145, SERIAL), ("LSSTCam", 37, SERIAL)):
        data_id = DataCoordinate.standardize(instrument=instrument, detector=detector, universe=universe)
        assert sensor_of(data_id).serial == serial
    unknown = DataCoordinate.standardize(instrument="DECam", detector=1, universe=universe)
    with pytest.raises(UnknownNameError, match="instrument is 'DECam'"):
        sensor_of(unknown)


def test_date_of_a_run_comes_from_its_name() -> None:
    otherwise = datetime.datetime(2026, 1, 2, 3, 4, 5)
    assert run_datetime("u/me/sky/20261121T034340Z", otherwise) == "2026-11-21T03:43:40"
    assert run_datetime("u/me/sky", otherwise) == "2026-01-02T03:04:05"


def test_bias_flats_and_maps_are_as_recorded(
    bias: CombinedBias, flats: list[FringeFlat], recorded: Record
) -> None:
    """A record, beside the truth that the tests above compare with."""
    maps = {method: fit(flats, method=method) for method in ("global", "guo2022")}
    recorded({"bias": bias, "flats": flats[::5], "maps": maps})
