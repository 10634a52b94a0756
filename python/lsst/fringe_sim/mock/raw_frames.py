"""Raw laboratory frames of a sensor whose every property is known: bias frames and monochromatic flats.

The frames are in the LSST raw layout, as a test stand would have written them; those of another camera have one image
for each amplifier, with overscan, and state gain and noise. What made them (thickness, hidden effects, true gains) is
returned to the caller and stands nowhere in the files, their headers or their names.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..array_types import BoolArray, Float32Array, FloatArray
from ..descriptions import is_file_name, read_description, with_files_beside
from ..errors import InputError, OutOfRangeError, UnknownNameError
from ..instrument.camera import Amplifier, Camera, Detector
from ..resources import list_resources, read_user_yaml, read_yaml
from .defects import Defects, draw_defects
from .hidden_effects import AmplifierState, HiddenEffect, validate_effects, with_hidden_optics
from .optics import Film, FlatFieldOptics
from .raw_files import Clock, primary_header, with_raw_layout, write_frame
from .readout import Readout
from .sensor_signal import SensorSignal

DEFAULT_LEVEL_E = 20_000.0
DEFAULT_BIAS_FRAMES = 5

LEVEL_SCATTER = 0.01  # Rms scatter of the level of the flats

FIRST_EXPOSURE = datetime.datetime(2018, 7, 24, 10, 0, 0)


@dataclass(frozen=True)
class MockExposure:
    """One frame that was written.

    Attributes
    ----------
    path : `~pathlib.Path`
        The file.
    wavelength_nm : `float` or `None`
        Nominal wavelength; `None` for a bias.
    level_e : `float`
        Mean of the expected charge over the sensor [electrons].
    """

    path: Path
    wavelength_nm: float | None
    level_e: float


@dataclass(frozen=True, eq=False)
class MockTruth:
    """Everything that made the frames. Keep it away from whoever analyses them.

    Attributes
    ----------
    thickness_um : `numpy.ndarray` [y, x]
        Thickness of the varying layer [µm].
    effects : `dict`
        Hidden effects, ``{"name": {"parameter": value}}``.
    optics : `FlatFieldOptics`
        Sensor and light with the hidden effects.
    signal : `SensorSignal`
        Signal of every pixel.
    amplifiers : `tuple` [`AmplifierState`, ...]
        True gain, noise, full well and offset, in the order of the raw file.
    response : `numpy.ndarray` [y, x], float32
        Relative response of the pixels, defects included.
    excess_e : `numpy.ndarray` [y, x], float32
        Charge of bright columns and hot pixels in a flat [electrons].
    defective : `numpy.ndarray` [y, x], bool
        Pixels of bad columns and hot pixels.
    """

    thickness_um: FloatArray
    effects: dict[str, dict[str, float]]
    optics: FlatFieldOptics
    signal: SensorSignal
    amplifiers: tuple[AmplifierState, ...]
    response: Float32Array
    excess_e: Float32Array
    defective: BoolArray

    def light(self, wavelength_nm: float) -> FloatArray:
        """Light that becomes charge, relative to its mean over the sensor: fringes and illumination, no defects."""
        signal = self.signal.flat(self.signal.tables.wavelengths_nm.index(float(wavelength_nm)))
        light = signal / signal.mean()
        for effect, values in validate_effects(self.effects):
            if effect.on_light is not None:
                light = effect.on_light(light, wavelength_nm, effect.complete(values))
        return light / light.mean()

    def expected_electrons(self, exposure: MockExposure) -> FloatArray:
        """Mean charge of every pixel of one exposure before full well and non-linearity [electrons]."""
        if exposure.wavelength_nm is None:
            return np.zeros(self.thickness_um.shape)
        return exposure.level_e * self.light(exposure.wavelength_nm) * self.response + self.excess_e


@dataclass(frozen=True)
class MockRun:
    """Frames of one sensor and their truth.

    Attributes
    ----------
    bias, flats : `tuple` [`MockExposure`, ...]
        What was written, in order of time.
    detector : `Detector`
        The sensor as the tables describe it (nominal gains), with the size of the frames.
    truth : `MockTruth`
        What made the frames.
    """

    bias: tuple[MockExposure, ...]
    flats: tuple[MockExposure, ...]
    detector: Detector
    truth: MockTruth

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files, bias frames first."""
        return tuple(exposure.path for exposure in (*self.bias, *self.flats))


def parse_size(size: str) -> tuple[int, int]:
    """Rows and columns from ``"NXxNY"``.

    Raises
    ------
    InputError
        The text is not two whole numbers above 0 with an ``x`` between them.
    """
    first, _, second = size.lower().partition("x")
    if not all(number.isdecimal() and int(number) > 0 for number in (first, second)):
        raise InputError("size", size, "NXxNY, as 256x256")
    return int(second), int(first)


def setup_optics(setup: str, silicon: str | None = None) -> tuple[FlatFieldOptics, str]:
    """Sensor and light of a laboratory set-up, and the camera it belongs to.

    Parameters
    ----------
    setup : `str`
        Name of a file in ``data/setups``, or a YAML file laid out like those.
    silicon : `str`, optional
        Table of silicon in ``data/media/media.yaml``, as ``Si_franta2017``; by default that of the set-up.

    Raises
    ------
    UnknownNameError
        There is no such set-up.
    InputError
        It is not illuminated by a monochromator.
    """
    content = read_setup_file(setup)
    light = content["illumination"]
    if light["kind"] != "monochromator":
        raise InputError("illumination.kind", light["kind"], "monochromator (flats need one)", source=setup)
    beam = light["beam"]["kind"]
    if beam != "collimated":
        raise InputError("illumination.beam.kind", beam, "collimated", source=setup)
    films = films_of(content, setup, silicon)
    optics = FlatFieldOptics(
        films=films,
        temperature_k=float(content["temperature_k"]),
        bandwidth_fwhm_nm=float(light["bandwidth_fwhm_nm"]),
        line_shape=str(light["profile"]),
        varying=str(content["varying"]),
    )
    return optics, str(content["camera"])


def films_of(content: Mapping[str, Any], setup: str, silicon: str | None = None) -> tuple[Film, ...]:
    """Films of a set-up's stack; ``silicon`` as for `setup_optics`.

    `UnknownNameError`: there is no such stack.
    `InputError`: no table of silicon.
    """
    own, media = silicon or str(content.get("silicon", "Si")), str(content.get("media", ""))
    if own.partition("_")[0] != "Si":
        raise InputError("silicon", own, "Si or a table that begins with Si_", source=setup)
    return tuple(
        Film(
            str(layer["name"]),
            own if layer["medium"] == "Si" else str(layer["medium"]),
            float(layer["thickness_um"]),
            media=media,
        )
        for layer in _stack(str(content["stack"]))["layers"]
    )


def write_mock_flats(
    out_dir: str | Path,
    *,
    setup: str,
    detector: int | str,
    thickness_um: NDArray[np.floating],
    wavelengths_nm: Sequence[float],
    rng: np.random.Generator,
    effects: Mapping[str, Any] | None = None,
    size: str | None = None,
    n_bias: int = DEFAULT_BIAS_FRAMES,
    repeats: int = 1,
    level_e: float = DEFAULT_LEVEL_E,
    defects: Defects | None = None,
    silicon: str | None = None,
    progress: Callable[[Path], None] | None = None,
) -> MockRun:
    """Write bias frames and monochromatic flats of one sensor.

    Parameters
    ----------
    out_dir : path-like
        Folder for the files; made if it does not exist.
    setup : `str`
        Name of a laboratory set-up.
    detector : `int` or `str`
        Number, name or serial number of the sensor in the set-up's camera; the name of its place in LSSTCam too.
    thickness_um : `numpy.ndarray` [y, x]
        Thickness of the layer that varies [µm], of the size of the sensor.
    wavelengths_nm : sequence of `float`
        Wavelengths to which the monochromator is set [nm], all different.
    rng : `numpy.random.Generator`
        Source of all randomness; the same generator state gives the same files.
    effects : mapping, optional
        Hidden effects, as for `validate_effects`.
    size : `str`, optional
        ``"NXxNY"`` for a cut-down sensor: as many amplifiers with fewer pixels each, with the usual overscan.
    n_bias : `int`, optional
        Number of bias frames.
    repeats : `int`, optional
        Number of flats at each wavelength.
    level_e : `float`, optional
        Mean charge of the flats [electrons].
    defects : `Defects`, optional
        Blemishes; none by default.
    silicon : `str`, optional
        Table of the optical constants of silicon, as ``Si_franta2017``; by default that of the set-up.
    progress : callable, optional
        Called with the path of each file once it is written.

    Returns
    -------
    run : `MockRun`
        The files and the truth.

    Raises
    ------
    InputError, OutOfRangeError, UnknownNameError
        An argument cannot be used; nothing has been written then.
    """
    optics, camera = setup_optics(setup, silicon)
    sensor = _sensor(camera, detector, size)
    thickness = checked_thickness(thickness_um, sensor.shape)
    wavelengths = _check_wavelengths(wavelengths_nm)
    for name, value, least in (("n_bias", n_bias, 0), ("repeats", repeats, 1), ("level_e", level_e, 1.0)):
        if not least <= value < math.inf:
            raise OutOfRangeError(name, value, f"{least:g} or more")
    active = validate_effects(effects)

    sensor_rng, amplifier_rng, level_rng, frames_rng = rng.spawn(4)
    truth = _make_truth(
        optics, sensor, thickness, wavelengths, active, defects or Defects(), sensor_rng, amplifier_rng
    )
    readout = Readout.of(sensor, truth.amplifiers, sensor_rng)
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)

    plan: list[float | None] = [None] * n_bias
    plan += [wavelength for wavelength in wavelengths for _ in range(repeats)]
    clock = Clock(FIRST_EXPOSURE)
    written: list[MockExposure] = []
    for number, (wavelength, frame_rng) in enumerate(zip(plan, frames_rng.spawn(len(plan)), strict=True)):
        level = 0.0 if wavelength is None else level_e * (1.0 + LEVEL_SCATTER * level_rng.standard_normal())
        start, seconds = clock.next(wavelength)
        header = primary_header(camera, sensor, _nominal_celsius(setup), wavelength, number, start, seconds)
        exposure = MockExposure(folder / str(header["FILENAME"]), wavelength, level)
        images = readout.read(truth.expected_electrons(exposure), seconds, active, frame_rng)
        write_frame(exposure.path, header, sensor, images)
        written.append(exposure)
        if progress is not None:
            progress(exposure.path)
    return MockRun(tuple(written[:n_bias]), tuple(written[n_bias:]), sensor, truth)


# Input ----------------------------------------------------------------------------------------------------


def _read_named(what: str, folder: str, name: str) -> dict[str, Any]:
    known = [entry.removesuffix(".yaml") for entry in list_resources(folder)]
    if name not in known:
        raise UnknownNameError(what, name, known)
    return read_yaml(folder, f"{name}.yaml")


def _stack(name: str) -> Mapping[str, Any]:
    return read_description(name, "stack") if is_file_name(name) else _read_named("stack", "stacks", name)


def read_setup_file(setup: str) -> dict[str, Any]:
    """Content of a shipped set-up, or of a YAML file; names of files in it are paths."""
    if not is_file_name(setup):
        return _read_named("set-up", "setups", setup)
    content: dict[str, Any] = with_files_beside(read_user_yaml(setup, "set-up file"), setup)
    return content


def _nominal_celsius(setup: str) -> float:
    return round(float(read_setup_file(setup)["temperature_k"]) - 273.15, 3)


def _sensor(camera: str, detector: int | str, size: str | None) -> Detector:
    sensor = Camera.from_name(camera).detector(detector)
    if sensor.own_layout:
        sensor = with_raw_layout(sensor)
    elif len(sensor.amplifiers) != 16:
        raise InputError("detector", sensor.name, "a whole sensor of 16 amplifiers")
    return sensor if size is None else sensor.cut_down(parse_size(size))


def checked_thickness(thickness_um: NDArray[np.floating], shape: tuple[int, int]) -> FloatArray:
    """Map that has the shape of its sensor and positive numbers everywhere."""
    thickness = np.asarray(thickness_um, dtype=float)
    if thickness.shape != shape:
        raise InputError(
            "shape of the thickness map (rows, columns)", thickness.shape, f"that of the sensor, {shape}"
        )
    if not (np.min(thickness) > 0 and np.max(thickness) < math.inf):
        found = (float(np.min(thickness)), float(np.max(thickness)))
        raise OutOfRangeError("thickness [um]", found, "finite and positive everywhere")
    return thickness


def _check_wavelengths(wavelengths_nm: Sequence[float]) -> tuple[float, ...]:
    wavelengths = tuple(float(value) for value in wavelengths_nm)
    if not wavelengths:
        raise InputError("wavelengths", wavelengths, "at least one")
    if len(set(wavelengths)) != len(wavelengths):
        raise InputError("wavelengths", wavelengths, "every wavelength once (see repeats)")
    return wavelengths


# Truth ----------------------------------------------------------------------------------------------------


_ActiveEffects = tuple[tuple[HiddenEffect, dict[str, float]], ...]


def _make_truth(
    optics: FlatFieldOptics,
    sensor: Detector,
    thickness: FloatArray,
    wavelengths: tuple[float, ...],
    active: _ActiveEffects,
    defects: Defects,
    sensor_rng: np.random.Generator,
    amplifier_rng: np.random.Generator,
) -> MockTruth:
    optics = with_hidden_optics(optics, active)
    response, excess, defective = draw_defects(sensor, defects, sensor_rng)
    return MockTruth(
        thickness_um=thickness,
        effects={effect.name: dict(values) for effect, values in active},
        optics=optics,
        signal=SensorSignal.with_effects(optics, thickness, wavelengths, active),
        amplifiers=tuple(_amplifier_state(amp, active, amplifier_rng) for amp in sensor.amplifiers),
        response=response,
        excess_e=excess,
        defective=defective,
    )


def _amplifier_state(amp: Amplifier, active: _ActiveEffects, rng: np.random.Generator) -> AmplifierState:
    state = AmplifierState(amp.name, amp.gain, amp.read_noise, amp.gain * amp.saturation)
    for effect, values in active:
        if effect.on_amplifier is not None:
            state = effect.on_amplifier(state, effect.complete(values), float(rng.standard_normal()))
    return state
