"""Files and settings as they should not be: every one is used or refused, never a traceback, a hang or a leak.

    python tests/faults/fuzz.py --cases 10000
    python tests/faults/fuzz.py --seconds 60

runs all targets with new random cases, so many or for so much processor time, and prints the seeds and how many cases
were used and how many refused. First it tries the files of `corpus/`, one folder for each target; the file of a case
that fails goes there, reduced, and stays. A case fails if it raises anything but `FringeSimError`, takes more than
`LONGEST_S`, needs more than `MOST_BYTES` of memory beyond what the process had, opens a file outside its folder and
the program, makes a map or a flat with good pixels that are no numbers, or light out of nothing.
"""

import argparse
import collections
import contextlib
import functools
import hashlib
import os
import resource
import secrets
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as with_seed
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

import product_makers
from fuzz_files import alter_fits, plain_header
from raw_frame_maker import random_image, raw_hdus, small_detector

from lsst.fringe_sim.algorithms.flat_prep import prepare_flat
from lsst.fringe_sim.algorithms.fringe_correction import CorrectionOptions, correct_fringes
from lsst.fringe_sim.algorithms.pca import fit_pca
from lsst.fringe_sim.algorithms.thickness_fit import fit_thickness
from lsst.fringe_sim.cli.amplitudes import read_line_list
from lsst.fringe_sim.cli.inputs import read_settings, read_thickness
from lsst.fringe_sim.cli.lab_frames import read_cube
from lsst.fringe_sim.cli.provenance import describe, read_header
from lsst.fringe_sim.cli.sky_frames import read_sky_frames
from lsst.fringe_sim.effects import EFFECTS
from lsst.fringe_sim.errors import FringeSimError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.instrument.raw_frame import RawFrame, read_raw_metadata
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.optics import Layer, LayerStack, get_medium, layer_absorption
from lsst.fringe_sim.products.observed_files import observed_images, write_images
from lsst.fringe_sim.resources import resource_path

LONGEST_S = 20.0  # Processor time that one case may take; most take milliseconds

MOST_BYTES = 1 << 30
"""Memory that one case may need beyond what the process had; the files have less than a megabyte."""


@dataclass
class Tally:
    """What became of the cases of each target."""

    used: collections.Counter[str] = field(default_factory=collections.Counter)
    refused: collections.Counter[str] = field(default_factory=collections.Counter)
    slowest_s: float = 0.0


TALLY = Tally()

_OFFENCES: list[str] = []


# What may happen -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def guarded(target: str, folder: Path) -> Iterator[None]:
    """Let a case run under limits, and count how it ends."""
    started = time.monotonic()
    with _limited_time(), _limited_memory(), _limited_paths(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except FringeSimError as error:
            if _OFFENCES:
                # What was raised to stop the case may have been taken for a fault of the file.
                raise AssertionError(f"{target}: {_OFFENCES.pop()}") from error
            text = str(error)
            if len(text) > 20_000:
                raise AssertionError(f"{target}: a message of {len(text)} characters") from error
            TALLY.refused[target] += 1
        else:
            TALLY.used[target] += 1
    TALLY.slowest_s = max(TALLY.slowest_s, time.monotonic() - started)


@contextlib.contextmanager
def _limited_time() -> Iterator[None]:
    """Limit the processor time, and, far beyond it, the time on the clock: other programs may have the processor."""

    def stop(number: int, frame: Any) -> None:
        _OFFENCES.append(f"longer than {LONGEST_S} s")
        raise TimeoutError(_OFFENCES[-1])

    limits = {
        signal.ITIMER_PROF: (signal.SIGPROF, LONGEST_S),
        signal.ITIMER_REAL: (signal.SIGALRM, 20 * LONGEST_S),
    }
    former = {number: signal.signal(number, stop) for number, _ in limits.values()}
    for timer, (_, seconds) in limits.items():
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for timer in limits:
            signal.setitimer(timer, 0)
        for number, handler in former.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _limited_memory() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MOST_BYTES
    resource.setrlimit(
        resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard)
    )
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


_ALLOWED: list[str] = []
_PROGRAM = tuple(
    str(Path(path).resolve())
    for path in (
        sys.prefix,
        sys.base_prefix,
        Path(__file__).parents[2],
        os.environ.get("NUMBA_CACHE_DIR") or "/dev/null",
        "/dev/null",
        "/usr/share/zoneinfo",
        "/proc/self",
    )
)


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if not _ALLOWED or event != "open" or not isinstance(arguments[0], str | bytes | os.PathLike):
        return
    path = os.path.realpath(os.fsdecode(arguments[0]))
    if not path.startswith((*_PROGRAM, *_ALLOWED)):
        _OFFENCES.append(f"opened {path}")
        raise AssertionError(_OFFENCES[-1])


sys.addaudithook(_watch)


@contextlib.contextmanager
def _limited_paths(folder: Path) -> Iterator[None]:
    _ALLOWED.append(str(folder.resolve()))
    try:
        yield
    finally:
        _ALLOWED.pop()


# Cases ---------------------------------------------------------------------------------------------------------

RAW = raw_hdus(random_image(small_detector()), small_detector())
RAW_BYTES = plain_header(RAW)
PRODUCTS = {
    name: plain_header(product_makers.MAKERS[name]((6, 8)), product=name)
    for name in sorted(product_makers.MAKERS)
}
"""Every product, once with checksums and once as a file from elsewhere, which has none."""
_NONE = np.zeros((6, 8), np.int32)
SKY_FRAMES = plain_header(product_makers.sky((6, 8), mask=_NONE), product="SkyFringe")
SOUND_FRAME = plain_header(product_makers.sky((6, 8), 9, mask=_NONE), product="SkyFringe")[0]
MAP = plain_header(product_makers.thickness((6, 8), mask=_NONE, layer="adhesive"), product="ThicknessMap")[0]
SKY = Setup.from_name("lsst_e2v")


def _plain_flat(wavelength_nm: float) -> bytes:
    cards = {
        "MONOWL": wavelength_nm,
        "BUNIT": "adu",
        "GAIN": 0.7,
        "RDNOISE": 5.0,
        "SATURATE": 60000,
        "TEMPK": 180.0,
    }
    counts = np.random.default_rng(int(wavelength_nm)).poisson(20_000.0, (20, 30)).astype(np.int32)
    header = fits.Header({**cards, "IMGTYPE": "FLAT", "DETNAME": "S1", "DATASEC": "[1:30,1:20]"})
    return plain_header(fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(counts, header)]))


PLAIN, SOUND_FLAT = _plain_flat(950.0), _plain_flat(960.0)
PATTERN = np.sin(np.add.outer(np.arange(48) / 4.0, np.arange(48) / 7.0)).astype(np.float32)


def _observed() -> bytes:
    rng = np.random.default_rng(4)
    image = rng.normal(1000.0 + 30.0 * PATTERN, 5.0).astype(np.float32)
    cards = fits.Header({"BUNIT": "adu", "DETNAME": "S1", "FILTER": "y", "DATE-OBS": "2026-01-02T03:04:05"})
    mask = fits.ImageHDU((rng.random(image.shape) < 0.02).astype(np.int32), name="MASK")
    mask.header["MP_SAT"] = 0
    parts = [
        fits.PrimaryHDU(),
        fits.ImageHDU(image, cards),
        mask,
        fits.ImageHDU(0 * image + 25, name="VARIANCE"),
    ]
    return plain_header(fits.HDUList(parts))


OBSERVED = _observed()


def _file(folder: Path, content: bytes, name: str = "case.fits") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def raw_frame(data: st.DataObject, folder: Path) -> None:
    """A raw frame, and the flat that is made of it."""
    use_raw_frame(_file(folder, alter_fits(data, RAW_BYTES)), folder)


def use_raw_frame(path: Path, folder: Path) -> None:
    """Its metadata, its pixels, and the flat."""
    with guarded("raw frames", folder):
        read_raw_metadata(path)
        frame = RawFrame.read(path)
        flat = prepare_flat(frame, None, small_detector(), bandwidth_fwhm_nm=2.0, f_number=float("inf"))
        _honest(flat.image, flat.mask)


def product(data: st.DataObject, folder: Path) -> None:
    """A product from disk, also without the checksums that would show the damage; provenance of the same file."""
    name = data.draw(st.sampled_from(sorted(PRODUCTS)))
    content = PRODUCTS[name][data.draw(st.integers(0, 1))]
    use_product(_file(folder, alter_fits(data, content), f"{name}.fits"), folder)


def use_product(path: Path, folder: Path) -> None:
    """The product after which the file is named, and its provenance."""
    name = path.stem.partition("-")[0]
    with guarded(f"product {name}", folder):
        product_makers.p.__dict__[name].read_fits(path)
    with guarded("provenance", folder):
        describe(read_header(str(path)))


def thickness_file(data: st.DataObject, folder: Path) -> None:
    """A thickness map from anywhere."""
    use_thickness(_file(folder, alter_fits(data, PRODUCTS["ThicknessMap"][-1])), folder)


def use_thickness(path: Path, folder: Path) -> None:
    """The map as commands read it."""
    with guarded("thickness maps", folder):
        read_thickness(path, MODEL.setup)


def sky_frame_file(data: st.DataObject, folder: Path) -> None:
    """A frame of the sky, spoiled, beside a sound one, as a search reads them."""
    content = SKY_FRAMES[data.draw(st.integers(0, 1))]
    use_sky_frame(_file(folder, alter_fits(data, content)), folder)


def use_sky_frame(path: Path, folder: Path) -> None:
    """Both frames with the map of their sensor; then templates of them."""
    night = folder / "night"
    night.mkdir(exist_ok=True)
    shutil.copy(path, night / "case.fits")
    _file(night, SOUND_FRAME, "sound.fits")
    _file(folder, MAP, "map.fits")
    with guarded("sky frames", folder):
        found = read_sky_frames([str(night)], SKY, str(folder / "map.fits"))
        components = fit_pca(found.sky.frames, n_components=1)
        _honest(components.mean, components.mask)


def plain_flat_file(data: st.DataObject, folder: Path) -> None:
    """A flat that is one image, with what its header says of it."""
    use_plain_flat(_file(folder, alter_fits(data, PLAIN)), folder)


def use_plain_flat(path: Path, folder: Path) -> None:
    """The cube of it and of a sound one."""
    sound = _file(folder, SOUND_FLAT, "sound.fits")
    with guarded("plain flats", folder):
        found = product_makers.p.read_plain_flats([path, sound], temperature_k=183.0, bandwidth_fwhm_nm=2.0)
        _honest(found.image, found.mask)
        _honest(found.variance, found.mask)


def observed_file(data: st.DataObject, folder: Path) -> None:
    """A frame from a pipeline, with mask and weight."""
    use_observed(_file(folder, alter_fits(data, OBSERVED)), folder)


def use_observed(path: Path, folder: Path) -> None:
    """The frame corrected, and its file written again with other pixels."""
    with guarded("observed frames", folder):
        for image in observed_images(path):
            frame = image.read()
            _honest(frame.image, frame.mask)
            done = correct_fringes(
                frame.image,
                PATTERN[np.newaxis],
                variance=frame.variance,
                mask=frame.mask,
                options=CorrectionOptions(16.0),
                header=image.header(),
            )
            _honest(done.image, frame.mask)
            target, at = folder / "out.fits", image.index
            write_images(path, target, {at: done.image}, {at: done.cards}, {at: done.uncorrected}, {})
            (again,) = [each for each in observed_images(target) if each.index == at]
            again.read()


def _honest(image: Any, mask: Any) -> None:
    """A pixel that is not masked holds a number: nothing wrong is passed on in silence."""
    if not np.all(np.isfinite(np.asarray(image)[np.asarray(mask) == 0])):
        raise AssertionError("a good pixel that is not a number")


FINITE = st.floats(width=32, allow_nan=True, allow_infinity=True)

RANGE_UM = (12.5, 13.5)  # Where a thickness is looked for: two fringe orders, so that a case costs little


def cube(data: st.DataObject, folder: Path) -> None:
    """A cube of few pixels with any numbers in it, through its file, fitted."""
    shape = (data.draw(st.integers(1, 7)), data.draw(st.integers(1, 5)), data.draw(st.integers(1, 7)))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    # At most one of the headers is odd: of two, one would never be asked about.
    odd = data.draw(st.sampled_from(["wavelength", "variance", "bandwidth", "temperature", *[""] * 6]))
    unit = data.draw(st.sampled_from(["electron", "electron", "electron", "relative", "relative", "adu"]))
    level = 1.0 if unit == "relative" else 20000.0
    wavelength = np.linspace(880.0, 990.0, shape[0])
    thickness = 13.0 + 0.2 * rng.random(shape[1:])
    with guarded("fringe cubes", folder):
        response = MODEL.response(thickness.ravel(), wavelength).reshape(shape)
        response /= response.mean()
        if odd == "wavelength":
            wavelength = np.array([data.draw(_numbers(700.0, 1200.0)) for _ in range(shape[0])])
        image = (level * response * (1.0 + 0.003 * rng.standard_normal(shape))).astype(np.float32)
        for place, value in data.draw(
            st.lists(st.tuples(st.integers(0, image.size - 1), FINITE), max_size=4)
        ):
            image.flat[place] = value
        variance = data.draw(_numbers(0.0, 1e6)) if odd == "variance" else level * 1e-4
        made = product_makers.p.FringeCube(
            image=image,
            variance=np.full(shape, variance, np.float32),
            mask=(rng.random(shape) < data.draw(st.sampled_from([0.0, 0.0, 0.1, 0.5, 1.0]))).astype(np.int32),
            exposures=product_makers.p.FlatExposures(
                wavelength,
                np.array(data.draw(_numbers(0.0, 5.0)) if odd == "bandwidth" else 2.0),
                np.array(data.draw(_numbers(150.0, 310.0)) if odd == "temperature" else 173.0),
            ),
            unit=unit,
        )
        path = folder / "cube.fits"
        made.write_fits(path)
        _fit(path, data.draw(st.sampled_from(["global", "guo2022"])))


def cube_file(data: st.DataObject, folder: Path) -> None:
    """The file of a cube, spoiled, as the commands read it, and fitted if it is still one."""
    use_cube(_file(folder, alter_fits(data, PRODUCTS["FringeCube"][data.draw(st.integers(0, 1))])), folder)


def use_cube(path: Path, folder: Path) -> None:
    """The cube, fitted if it is still one."""
    with guarded("files of fringe cubes", folder):
        _fit(path, "global")


def _fit(path: Path, method: str) -> None:
    found = read_cube(str(path), MODEL.setup)
    if found is None:
        return
    fitted = fit_thickness(found, MODEL, method, range_um=RANGE_UM)
    _honest(fitted.value, fitted.mask)
    _honest(fitted.sigma, fitted.mask)
    value = np.asarray(fitted.value)[np.asarray(fitted.mask) == 0]
    # The walk of the paper only begins in the range.
    if (
        method == "global"
        and value.size
        and not (value.min() > RANGE_UM[0] - 0.1 and value.max() < RANGE_UM[1] + 0.1)
    ):
        raise AssertionError("a thickness that was not allowed")


MODEL = FringeModel.from_setup("ts8_e2v")


def _numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Mostly sensible numbers, now and then one that is not."""
    sensible = st.floats(low, high)
    odd = st.sampled_from([0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e308, 1e-308, 2**63])
    return st.one_of(sensible, sensible, sensible, sensible, odd)


LARGE = 10**400  # An integer that no float can hold


def _near(value: float) -> st.SearchStrategy[float]:
    """Numbers as they stand in a file of a user: near one that is sound, now and then any."""
    if not abs(value) < 1e300:
        return _numbers(0.0, 1.0)
    low, high = sorted((0.5 * value, 2.0 * value))
    return st.one_of(_numbers(low, high), st.integers(-5, 5), st.just(LARGE))


def _yaml_values() -> st.SearchStrategy[Any]:
    leaves = st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        st.text(max_size=12),
        st.dates(),
        st.binary(max_size=8),
        st.sampled_from(["ts8", "e2v_ccd250", "../../../etc/passwd", "/etc/passwd", "sky", "LSST", LARGE]),
    )
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.lists(inner, max_size=4),
            st.dictionaries(st.one_of(st.text(max_size=8), st.integers()), inner, max_size=4),
        ),
        max_leaves=8,
    )


HOSTILE = (
    "!!python/object/apply:os.system ['touch /tmp/fuzzed']",
    "a: &a [1, 1]\nb: &b [*a, *a, *a]\nc: [*b, *b, *b]",
    "a: &a [*a]",
    "[" * 5000,
    "{" * 300 + "}" * 300,
    "2021-13-45",
    "a: 2021-99-99 99:99:99",
    "? [1, 2]\n: 3",
    "{1: 2, [3]: 4}",
    "0x",
    "bandwidth.fwhm: 0x" + "f" * 5000,
    "a: 0b",
    "\x00",
    "- \t- a",
    "%YAML 9.9\n---\na: 1",
    "--- a\n--- b",
    "<<: 3",
    "=: =",
    "190:20:30.15",
    "+._",
)


def _alter_text(data: st.DataObject, text: str) -> str:
    for _ in range(data.draw(st.integers(0, 4))):
        place = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 12))
        text = text[:place] + data.draw(st.text(max_size=6)) + text[place + length :]
    return text


def _alter_mapping(data: st.DataObject, content: Any) -> Any:
    """Replace one entry, at some depth, by anything."""
    if isinstance(content, dict) and content and data.draw(st.integers(0, 4)):
        key = data.draw(st.sampled_from(sorted(content, key=str)))
        if not data.draw(st.integers(0, 5)):
            return {other: value for other, value in content.items() if other != key}
        return {**content, key: _alter_mapping(data, content[key])}
    if isinstance(content, list) and content and data.draw(st.integers(0, 2)):
        place = data.draw(st.integers(0, len(content) - 1))
        return [*content[:place], _alter_mapping(data, content[place]), *content[place + 1 :]]
    if isinstance(content, int | float) and data.draw(st.integers(0, 3)):
        return data.draw(_near(content))
    return data.draw(_yaml_values())


def _yaml_text(data: st.DataObject, valid: str) -> bytes:
    kind = data.draw(st.integers(0, 5))
    if kind == 0:
        return data.draw(st.sampled_from(HOSTILE)).encode()
    if kind == 1:
        return data.draw(st.binary(max_size=200))
    if kind == 2:
        return _alter_text(data, valid).encode("utf-8", "surrogatepass")
    content = yaml.safe_load(valid)
    for _ in range(data.draw(st.integers(1, 3))):
        content = _alter_mapping(data, content)
    return yaml.safe_dump(content, allow_unicode=True).encode("utf-8", "surrogatepass")


NAMES = [f"{effect.name}.{parameter.name}" for effect in EFFECTS for parameter in effect.parameters]


def effects_file(data: st.DataObject, folder: Path) -> None:
    """A file of effects, and the model with them."""
    keys = data.draw(st.lists(st.one_of(st.sampled_from(NAMES), st.text(max_size=20)), max_size=3))
    valid = yaml.safe_dump({key: data.draw(_near(1.5)) for key in keys} or {"bandwidth": {"fwhm": 2.4}})
    use_effects(_file(folder, _yaml_text(data, valid), "effects.yaml"), folder)


def use_effects(path: Path, folder: Path) -> None:
    """Models of both vendors with the effects."""
    for setup in ("ts8_e2v", "ts8_itl"):
        with guarded("effects files", folder):
            model = FringeModel.from_setup(setup, read_settings(path))
            model.response([13.0, 13.1], [900.0, 960.0])


def setup_file(data: st.DataObject, folder: Path) -> None:
    """A set-up of the user, and the response of its sensor."""
    name = data.draw(st.sampled_from(["ts8_e2v", "ts8_itl", "bnl_ts8_e2v", "lsst_e2v"]))
    valid = resource_path("setups", f"{name}.yaml").read_text()
    use_setup(_file(folder, _yaml_text(data, valid), "own.yaml"), folder)


def use_setup(path: Path, folder: Path) -> None:
    """The set-up, and what its sensor answers."""
    with guarded("set-up files", folder):
        found = Setup.from_file(path)
        if found.kind == "monochromator":
            FringeModel.from_setup(found).response([13.0], found.wavelengths_nm[:3] or [960.0])


def camera_file(data: st.DataObject, folder: Path) -> None:
    """A camera of the user."""
    name = data.draw(st.sampled_from(["monocam", "hsc"]))
    valid = resource_path("instrument", f"{name}.yaml").read_text()
    use_camera(_file(folder, _yaml_text(data, valid), "own.yaml"), folder)


def use_camera(path: Path, folder: Path) -> None:
    """The camera."""
    with guarded("camera files", folder):
        Camera.from_file(path)


MEDIA = ("vacuum", "MgF2", "Ta2O5", "Si", "SiO2", "epoxy", "Si3N4", "HfO2")
ODD = ("thickness", "wavelength", "temperature", "theta", "roughness", "medium", "name", "end", "number")


def layer_stack(data: st.DataObject, folder: Path) -> None:
    """Layers of anything, and the light in them: fractions that add up to 1. At most one thing is odd."""
    odd = data.draw(st.sampled_from([*ODD, *[""] * len(ODD)]))

    def number(what: str, low: float, high: float) -> float:
        return data.draw(_numbers(low, high) if odd == what else st.floats(low, high))

    count = data.draw(st.integers(0, 2) if odd == "number" else st.integers(2, 7))
    with guarded("layer stacks", folder):
        layers = []
        for place in range(count):
            end = place in (0, count - 1) and odd != "end"
            name = data.draw(st.text(max_size=3)) if odd == "name" else f"layer{place}"
            layers.append(
                Layer(
                    name,
                    get_medium(data.draw(st.text(max_size=5) if odd == "medium" else st.sampled_from(MEDIA))),
                    float("inf") if end else number("thickness", 0.0, 200.0),
                    roughness_nm=number("roughness", 0.0, 20.0),
                )
            )
        stack = LayerStack(tuple(layers))
        wavelength = np.array([number("wavelength", 600.0, 1000.0) for _ in range(2)])
        index = stack.indices(wavelength, number("temperature", 170.0, 300.0))
        parts = layer_absorption(
            index, stack.thickness_um[:, None], 1e-3 * wavelength, number("theta", 0.0, 1.5)
        )
        if not (np.isfinite(parts).all() and np.abs(parts.sum(axis=0) - 1.0).max() < 1e-6):
            raise AssertionError(f"light that is lost or made: {parts.sum(axis=0)}")


def line_list(data: st.DataObject, folder: Path) -> None:
    """Emission lines of the user, alone and in a sky."""
    count = data.draw(st.integers(0, 5))
    columns = [
        data.draw(
            st.lists(_numbers(low, high), min_size=count, max_size=count + data.draw(st.integers(0, 1)) // 1)
        )
        for low, high in ((880.0, 1100.0), (0.0, 10.0), (0.0, 1.0))
    ]
    if data.draw(st.booleans()):
        columns[0] = sorted(columns[0])
    with guarded("line lists", folder):
        lines = EmissionLines(*(np.array(column) for column in columns), np.array(["8-4"] * count, dtype=str))
        for component in SkySpectrum.dark(lines).components(Bandpass.from_name("lsst_y")):
            if not np.all(np.isfinite(component.weight if hasattr(component, "weight") else [0.0])):
                raise AssertionError("a sky that is not finite")


LINES = """\
# %ECSV 1.0
# ---
# datatype:
# - {name: wavelength, unit: nm, datatype: float64}
# - {name: intensity, datatype: float64}
wavelength intensity
930.1 1.0
951.2 2.5
977.7 0.3
"""


def line_file(data: st.DataObject, folder: Path) -> None:
    """A line list as a file of the user."""
    text = _alter_text(data, LINES) if data.draw(st.integers(0, 5)) else data.draw(st.sampled_from(HOSTILE))
    use_lines(_file(folder, text.encode("utf-8", "surrogatepass"), "lines.ecsv"), folder)


def use_lines(path: Path, folder: Path) -> None:
    """The list as commands read it."""
    with guarded("files of line lists", folder):
        read_line_list(path)


def effects_override(data: st.DataObject, folder: Path) -> None:
    """A Python override as a search leaves it: read, never executed."""
    quote = data.draw(st.sampled_from("\"'"))
    valid = (
        f"# found\nconfig.effects[{quote}roughness.sigma{quote}] = 4.0\n"
        f"config.effects[{quote}bandwidth.fwhm{quote}] = 2.1\n"
    )
    text = _alter_text(data, valid)
    if not data.draw(st.integers(0, 3)):
        text += data.draw(st.sampled_from(CODE)).format(folder)
    use_override(_file(folder, text.encode("utf-8", "surrogatepass"), "effects.py"), folder)


def use_override(path: Path, folder: Path) -> None:
    """The model with its effects, and nothing executed."""
    with guarded("effects overrides", folder):
        FringeModel.from_setup("ts8_e2v", read_settings(path))
    if (folder / "executed").exists():
        raise AssertionError("an override was executed")


CODE = (
    "open('{0}/executed', 'w')\n",
    "import os; os.system('touch {0}/executed')\n",
    "config.effects['roughness.sigma'] = open('{0}/executed', 'w').fileno()\n",
    "config.effects[open('{0}/executed', 'w').name] = 1.0\n",
    "config.load('/etc/passwd')\n",
    "raise SystemExit\n",
)


def any_document(data: st.DataObject, folder: Path) -> None:
    """Tables and documents whose provenance is asked for."""
    suffix = data.draw(st.sampled_from([".json", ".ecsv", ".fits"]))
    valid = '{"provenance": {"TABLE0": "media/x.ecsv 1", "EFFECT0": "a", "EFFVAL0": 1}}'
    if suffix == ".ecsv":
        valid = "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\n# meta: {SETUP: x}\na\n1\n"
    text = _alter_text(data, valid) if data.draw(st.booleans()) else data.draw(st.sampled_from(HOSTILE))
    use_document(_file(folder, text.encode("utf-8", "surrogatepass"), f"case{suffix}"), folder)


def use_document(path: Path, folder: Path) -> None:
    """Its provenance."""
    with guarded("documents", folder):
        describe(read_header(str(path)))


TARGETS: dict[Callable[[st.DataObject, Path], None], int] = {
    raw_frame: 5,
    product: 5,
    thickness_file: 2,
    sky_frame_file: 2,
    plain_flat_file: 2,
    observed_file: 2,
    layer_stack: 3,
    cube: 4,
    cube_file: 2,
    effects_file: 2,
    setup_file: 2,
    camera_file: 2,
    line_list: 2,
    line_file: 2,
    effects_override: 1,
    any_document: 1,
}
"""Targets and their share of the cases."""

QUICK = (
    raw_frame,
    product,
    thickness_file,
    sky_frame_file,
    plain_flat_file,
    observed_file,
    layer_stack,
    setup_file,
    camera_file,
    line_file,
)
"""Targets of which a case takes milliseconds."""

CORPUS = Path(__file__).parent / "corpus"

USES: dict[str, Callable[[Path, Path], None]] = {
    "raw_frame": use_raw_frame,
    "product": use_product,
    "thickness_file": use_thickness,
    "sky_frame_file": use_sky_frame,
    "plain_flat_file": use_plain_flat,
    "observed_file": use_observed,
    "cube": use_cube,
    "cube_file": use_cube,
    "effects_file": use_effects,
    "setup_file": use_setup,
    "camera_file": use_camera,
    "line_file": use_lines,
    "effects_override": use_override,
    "any_document": use_document,
}
"""What is done with the file of a case, by the name of its target; line lists and stacks have none."""


def try_corpus() -> int:
    """Try every file that failed once, or that somebody has put there; return their number."""
    found = sorted(path for path in CORPUS.glob("*/*") if path.is_file())
    for path in found:
        with tempfile.TemporaryDirectory() as name:
            copy = Path(shutil.copy(path, name))
            print(f"corpus/{path.parent.name}/{path.name}", flush=True)
            USES[path.parent.name](copy, Path(name))
    return len(found)


def keep(target: str, folder: Path) -> None:
    """Put the file of a failing case into the corpus."""
    for path in folder.iterdir():
        if path.is_file() and target in USES:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
            (CORPUS / target).mkdir(parents=True, exist_ok=True)
            shutil.copy(path, CORPUS / target / f"{path.stem}-{digest}{path.suffix}")


ROUND = 10 * sum(TARGETS.values())  # Cases between two looks at the clock


@functools.cache
def warm_up_quickly() -> None:
    """Let what quick targets call be compiled or read from the cache."""
    MODEL.response([13.0, 13.1], [900.0, 960.0])
    with tempfile.TemporaryDirectory() as name:
        for use, content in (
            (use_raw_frame, RAW_BYTES),
            (use_sky_frame, SKY_FRAMES[0]),
            (use_plain_flat, PLAIN),
            (use_observed, OBSERVED),
        ):
            with contextlib.suppress(TimeoutError):
                use(_file(Path(name), content), Path(name))
    TALLY.used.clear()
    TALLY.slowest_s = 0.0


@functools.cache
def warm_up() -> None:
    """Let everything be compiled on sound input: a case has not the time for it."""
    warm_up_quickly()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cube.fits"
        wavelength = np.linspace(880.0, 990.0, 6)
        thickness = 13.0 + 0.2 * np.random.default_rng(1).random(24)
        response = MODEL.response(thickness, wavelength).reshape(6, 4, 6)
        product_makers.p.FringeCube(
            image=(20000.0 * response / response.mean()).astype(np.float32),
            variance=np.full(response.shape, 2e4, np.float32),
            mask=np.zeros(response.shape, np.int32),
            exposures=product_makers.p.FlatExposures(wavelength, np.array(2.0), np.array(173.0)),
        ).write_fits(path)
        for method in ("global", "guo2022"):
            _fit(path, method)


def run_target(target: Callable[[st.DataObject, Path], None], cases: int, seed: int | None = None) -> None:
    """Run so many cases of a target; a failing one is reduced and raised."""
    (warm_up_quickly if target in QUICK else warm_up)()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        @settings(
            max_examples=cases,
            deadline=None,
            database=None,
            derandomize=False,
            suppress_health_check=list(HealthCheck),
            phases=(Phase.generate, Phase.shrink),
            report_multiple_bugs=False,
        )
        @given(data=st.data())
        def case(data: st.DataObject) -> None:
            target(data, folder)

        try:
            (case if seed is None else with_seed(seed)(case))()
        except BaseException:
            keep(target.__name__, folder)  # the last case that ran is the reduced one
            raise


def run_cases(
    chosen: dict[Callable[[st.DataObject, Path], None], int], cases: int, rng: np.random.Generator
) -> None:
    """Run so many cases in all, each target with its share and a seed of its own, which is printed."""
    for target, share in chosen.items():
        seed = int(rng.integers(2**62))
        started, used = time.monotonic(), time.process_time()
        print(f"{target.__name__} --seed {seed}", end="", flush=True)
        run_target(target, -(-cases * share // sum(chosen.values())), seed)
        print(f": {time.process_time() - used:.1f} s of processor time, {time.monotonic() - started:.0f} s")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, help="processor time, in place of a number of cases")
    parser.add_argument(
        "--quick", action="store_true", help="only targets of which a case takes milliseconds"
    )
    parser.add_argument("--only", help="one target, by the name of its function")
    parser.add_argument("--seed", type=int, help="of one target, as it was printed; by default new ones")
    arguments = parser.parse_args()
    chosen = {target: share for target, share in TARGETS.items() if arguments.only in (None, target.__name__)}
    chosen = {target: share for target, share in chosen.items() if target in QUICK or not arguments.quick}
    print(f"{try_corpus()} files of the corpus")
    if arguments.seed is not None:
        (target,) = chosen
        run_target(target, arguments.cases, arguments.seed)
    else:
        rng = np.random.default_rng(secrets.randbits(128))
        (warm_up_quickly if arguments.quick else warm_up)()
        began = time.process_time()
        while True:
            run_cases(chosen, arguments.cases if arguments.seconds is None else ROUND, rng)
            if arguments.seconds is None or time.process_time() - began >= arguments.seconds:
                break
    for name in sorted(TALLY.used | TALLY.refused):
        print(f"{name:28s} {TALLY.used[name]:6d} used {TALLY.refused[name]:6d} refused")
    total = TALLY.used.total() + TALLY.refused.total()
    print(f"{total} cases, slowest {TALLY.slowest_s:.2f} s; no traceback, no hang, no file outside")


if __name__ == "__main__":
    main()
