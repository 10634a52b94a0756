"""Limits of what set-ups and headers may state: both ends are in, and what lies beyond either is out."""

import copy
import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from raw_frame_maker import LSSTCAM_HEADER, TS8_HEADER, header_with

from lsst.fringe_sim.errors import FrameFormatError, FringeSimError
from lsst.fringe_sim.instrument.raw_frame import RawMetadata
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.optics.stack import LayerStack
from lsst.fringe_sim.resources import read_yaml


def changed(content: Any, path: str, value: Any) -> Any:
    """A description with one entry changed, which ``path`` names as messages do."""
    content = copy.deepcopy(content)
    *before, last = path.split(".")
    target = content
    for key in before:
        target = target[int(key) if key.isdigit() else key]
    target[last] = value
    return content


def beyond(low: float, high: float) -> tuple[float, float]:
    """Numbers just outside of an interval."""
    return low - 1e-6 * (abs(low) or 1.0), high + 1e-6 * high


@pytest.mark.parametrize(
    ("name", "path", "low", "high"),
    [
        ("ts8_e2v", "temperature_k", 100.0, 400.0),
        ("ts8_e2v", "illumination.bandwidth_fwhm_nm", 0.0, 200.0),
        ("ts8_e2v", "illumination.wavelength_accuracy_nm", 0.0, 20.0),
        ("monocam", "illumination.beam.f_number", 0.5, 1e6),
        ("monocam", "illumination.beam.obscuration", 0.0, 0.999),
        ("lsst_e2v", "laboratory_temperature_k", 100.0, 400.0),
        ("lsst_e2v", "illumination.effective_area_m2", 1e-6, 1e6),
        ("lsst_e2v", "illumination.pixel_scale_arcsec", 1e-6, 1e4),
        ("lsst_e2v", "illumination.exposure_s", 0.0, 1e6),
        ("lsst_e2v", "illumination.airmass", 1.0, 10.0),
    ],
)
def test_numbers_of_a_set_up(name: str, path: str, low: float, high: float) -> None:
    content, key = read_yaml("setups", f"{name}.yaml"), path.rpartition(".")[2]
    for value in (low, high):
        made = Setup.from_mapping("mine", changed(content, path, value))
        assert getattr(made, key) == value
    for value in beyond(low, high):
        with pytest.raises(FringeSimError, match=key):
            Setup.from_mapping("mine", changed(content, path, value))


def test_thicknesses_that_are_searched() -> None:
    content = read_yaml("setups", "ts8_e2v.yaml")
    made = Setup.from_mapping("mine", changed(content, "thickness_range_um", [0.0, 1e-3]))
    assert made.thickness_range_um == (0.0, 1e-3)
    for wrong in ([-1e-6, 10.0], [10.0, 10.0]):
        with pytest.raises(FringeSimError, match="two increasing numbers"):
            Setup.from_mapping("mine", changed(content, "thickness_range_um", wrong))


def test_a_set_up_without_numbers_that_may_be_absent() -> None:
    """A cone without obscuration is filled; thickness was measured at the temperature of the sensor."""
    content = copy.deepcopy(read_yaml("setups", "monocam.yaml"))
    content["illumination"]["beam"].pop("obscuration", None)
    assert Setup.from_mapping("mine", content).obscuration == 0.0
    sky = copy.deepcopy(read_yaml("setups", "lsst_e2v.yaml"))
    sky.pop("laboratory_temperature_k", None)
    made = Setup.from_mapping("mine", changed(sky, "temperature_k", 166.0))
    assert made.laboratory_temperature_k == 166.0
    laboratory = Setup.from_name("ts8_e2v")
    of_the_sky = ("effective_area_m2", "pixel_scale_arcsec", "exposure_s", "airmass")
    assert not any(getattr(laboratory, name) for name in of_the_sky)
    assert not any((made.bandwidth_fwhm_nm, made.wavelengths_nm, made.wavelength_accuracy_nm))


@pytest.mark.parametrize("key", ["roughness_nm", "thickness_spread_um"])
def test_numbers_of_a_stack(key: str, tmp_path: Path) -> None:
    content = read_yaml("stacks", "e2v_ccd250.yaml")
    inner = 2

    def stack(value: float) -> LayerStack:
        file = tmp_path / "stack.yaml"
        file.write_text(yaml.safe_dump(changed(content, f"layers.{inner}.{key}", value)))
        return LayerStack.from_file(file)

    for value in (0.0, 1e6):
        assert getattr(stack(value), key)[inner - (key == "roughness_nm")] == value
    for value in beyond(0.0, 1e6):
        with pytest.raises(FringeSimError, match=key):
            stack(value)


def test_usual_wavelengths_that_are_missing() -> None:
    setup = Setup.from_name("ts8_e2v")
    first, second, *rest = setup.wavelengths_nm
    found = [first + 0.999, second - 0.999, *rest]
    assert setup.missing_nm(found) == ()
    assert setup.missing_nm([first + 1.001, second - 1.001, *rest]) == (first, second)


DARK = {"IMGTYPE": "DARK", "TESTTYPE": "DARK"}
BIAS = {"IMGTYPE": "BIAS", "TESTTYPE": "BIAS", "EXPTIME": 0.0}


@pytest.mark.parametrize(
    ("base", "about", "keyword", "inside", "outside"),
    [
        (LSSTCAM_HEADER, {}, "SEQNUM", (0, 99_999), (-1, 100_000, 0.5)),
        (LSSTCAM_HEADER, {}, "AMSTART", (1.0, 40.0), (0.999, 40.001)),
        (LSSTCAM_HEADER, {}, "CCDTEMP", (-200.0, 60.0), (-200.001, 60.001)),
        (LSSTCAM_HEADER, {"TESTTYPE": "LAMBDA", "FILTER": None}, "MONOWL", (200.0, 1300.0), (199.9, 1300.1)),
        (LSSTCAM_HEADER, {}, "EXPTIME", (15.0 + 0.19, 0.001), (math.inf, -0.001)),
        (LSSTCAM_HEADER, DARK, "EXPTIME", (0.0,), (-0.001,)),
        (LSSTCAM_HEADER, {**DARK, "EXPTIME": 0.0}, "DARKTIME", (0.0,), (-0.001,)),
        (TS8_HEADER, {}, "MONOCH-BANDPASS", (0.0, 0.001, 999.999), (-0.001, 1000.0)),
        (TS8_HEADER, {}, "MJD-OBS", (58323.43663590262 + 0.9 / 86400,), (58323.43663590262 + 1.1 / 86400,)),
        (LSSTCAM_HEADER, {}, "DAYOBS", ("20211211", "20211213"), ("20211210", "20211214")),
        (LSSTCAM_HEADER, {}, "STUTTER ROWS", (0,), (1, 2)),
        (LSSTCAM_HEADER, BIAS, "EXPTIME", (0.0,), (-0.001, 1.0)),
    ],
)
def test_numbers_of_a_header(
    base: dict[str, Any],
    about: dict[str, Any],
    keyword: str,
    inside: tuple[Any, ...],
    outside: tuple[Any, ...],
) -> None:
    def interpret(value: Any) -> RawMetadata:
        return RawMetadata.from_header(header_with({**about, keyword: value}, base), source="raw.fits")

    for value in inside:
        interpret(value)
    for value in outside:
        with pytest.raises(FrameFormatError, match=keyword.split()[0]):
            interpret(value)


def test_what_a_header_states_is_kept() -> None:
    """To the last digit; nothing stands for what it does not state."""
    about = {"AMSTART": 1.25, "MONOCH-BANDPASS": 2.5, "SHUTTIME": 14.9, "SEQNUM": 99_999}
    stated = RawMetadata.from_header(header_with(about, LSSTCAM_HEADER), source="raw.fits")
    assert (stated.airmass, stated.bandpass_nm, stated.exposure_time_s) == (1.25, 2.5, 14.9)
    assert (stated.dark_time_s, stated.seq_num) == (15.2, 99_999)
    silent = {"AMSTART": 0, "DARKTIME": None}
    nothing = RawMetadata.from_header(header_with(silent, LSSTCAM_HEADER), source="raw.fits")
    assert (nothing.airmass, nothing.bandpass_nm) == (None, None)
    assert nothing.dark_time_s == nothing.exposure_time_s == 15.0
    bias = RawMetadata.from_header(header_with({**BIAS, "EXPTIME": None}, TS8_HEADER), source="raw.fits")
    assert (bias.exposure_time_s, bias.dark_time_s, bias.wavelength_nm) == (0.0, 0.0, None)
