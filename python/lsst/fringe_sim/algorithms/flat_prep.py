"""From a raw monochromatic flat to its fringe pattern.

The order is that of the charge's way back: overscan, bias, gain, masks, variance, smoothing, division by the mean
(Guo, Walter, Lage & Lupton 2022, section 3.2). The geometry comes from the frame's own headers, so any sensor in
the LSST raw layout is prepared alike. Every function takes arrays and frozen objects and returns new ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_propagation

from ..array_types import Float32Array
from ..errors import FrameFormatError, InputError, named_units
from ..instrument.camera import Detector
from ..instrument.raw_frame import RawFrame
from ..products.combined_bias import CombinedBias
from ..products.fringe_flat import FringeFlat
from ..products.mask import mask_bits
from .flat_prep_options import DEFAULT_OPTIONS, FlatPrepOptions
from .masked_smoothing import smooth_masked
from .overscan import OverscanCorrected, correct_overscan
from .sensor_defects import bad_columns, column_means, isolated_defects

__all__ = [
    "CombinedBias",
    "FlatPrepOptions",
    "OverscanCorrected",
    "PreparedCharge",
    "assemble_charge",
    "combine_biases",
    "correct_overscan",
    "prepare_flat",
    "smooth_masked",
]

Image = Float32Array
Mask = NDArray[np.int32]

ADC_MAXIMUM = 2**18 - 1  # Largest number of the 18-bit converters [ADU]; a pixel there has lost its value
MINIMUM_SIGNAL = 5.0  # Least median signal of a flat, in units of its read noise

AMPLIFIER_LEVELS = (0.1, 2.0)
"""Signal of an amplifier relative to the median of its sensor outside which it is not used: dead, or hot. Gains and
illumination of amplifiers differ by tens of per cent."""

SATURATED_AMPLIFIER = 0.5  # An amplifier with more than this part of its pixels saturated is not used

SHOULDER = 2.0
"""Pixels above so many times the median of their amplifier belong to the saturated ones that they touch."""

BESIDE_SATURATED_PX = 2  # Pixels around a saturated one that are masked with it


@dataclass(frozen=True, eq=False)
class PreparedCharge:
    """Assembled charge of a frame before smoothing.

    Attributes
    ----------
    image, variance : `numpy.ndarray` [y, x], float32
        Charge [electrons] and its variance [electrons²]; 0 where there are no data.
    mask : `numpy.ndarray` [y, x], int32
        BAD, SAT, EDGE and NO_DATA; 0 is good.
    read_noise_e : `Mapping` [`str`, `float`]
        Read noise by amplifier [electrons], measured in the overscan.
    unused : `tuple` [`str`, ...]
        Amplifiers that are masked whole: dead in the flat or in a bias, hot or saturated.
    """

    image: Image
    variance: Image
    mask: Mask
    read_noise_e: Mapping[str, float]
    unused: tuple[str, ...] = ()


# Bias -----------------------------------------------------------------------------------------------------


def combine_biases(frames: Iterable[RawFrame], options: FlatPrepOptions = DEFAULT_OPTIONS) -> CombinedBias:
    """Mean of overscan-corrected bias frames of one sensor, outliers rejected.

    One frame is held at a time. In every pixel the highest and the lowest value are left out when they lie more
    than ``clip_sigma`` read noises from the mean of the others; this needs three frames.

    Parameters
    ----------
    frames : iterable of `RawFrame`
        Bias frames; a generator that reads one file after the other will do.
    options : `FlatPrepOptions`, optional
        Choices.

    Returns
    -------
    bias : `CombinedBias`
        The mean.

    Raises
    ------
    InputError
        There is no frame.
    FrameFormatError
        A frame that is not a bias, or frames of different sensors or sizes.
    """
    total: Image | None = None
    first: RawFrame | None = None
    noise: dict[str, list[float]] = {}
    dead: set[str] = set()
    count = 0
    for frame in frames:
        told = frame.metadata
        if told.observation_type != "bias":
            raise FrameFormatError("IMGTYPE", told.observation_type, "bias", source=told.source)
        first = frame if first is None else first
        _check_same_sensor(frame, first.detector_shape, first.metadata.serial)
        image, measured = _assemble_adu(frame, options)
        if total is None:
            total, lowest, highest = np.zeros_like(image), image.copy(), image.copy()
        total += image
        np.minimum(lowest, image, out=lowest)
        np.maximum(highest, image, out=highest)
        for name, value in measured.items():
            noise.setdefault(name, []).append(value)
        dead |= {amp.name for amp in frame.amplifiers} - set(measured)
        count += 1
    if total is None or first is None:
        raise InputError("bias frames", 0, "at least one")
    noise_adu = {name: float(np.median(values)) for name, values in noise.items()}
    mask = np.zeros(first.detector_shape, dtype=np.int32)
    for amp in first.amplifiers:
        where = amp.destination
        if amp.name in dead:
            total[where] = 0.0
            mask[where] |= mask_bits("NO_DATA")
            continue
        if count >= 3:
            reach = options.clip_sigma * noise_adu[amp.name]
            total[where] = _trimmed_mean(total[where], lowest[where], highest[where], count, reach)
        else:
            total[where] /= count
        # Bias structure is constant along the columns of an amplifier.
        departure = np.abs(total[where] - np.median(total[where], axis=0))
        mask[where][departure > 2.0 * options.defect_sigma * noise_adu[amp.name]] |= mask_bits("BAD")
    return CombinedBias(total, mask, noise_adu, count, first.metadata.serial)


def _trimmed_mean(total: Image, lowest: Image, highest: Image, count: int, reach: float) -> Image:
    rest = (total - lowest - highest) / np.float32(count - 2)
    drop_low = rest - lowest > reach
    drop_high = highest - rest > reach
    kept = count - drop_low.astype(np.float32) - drop_high
    return (total - lowest * drop_low - highest * drop_high) / kept


def _check_same_sensor(frame: RawFrame, shape: tuple[int, int], serial: str) -> None:
    source = frame.metadata.source
    if frame.detector_shape != shape:
        raise FrameFormatError(
            "detector shape", frame.detector_shape, f"{shape}, as the other frames", source=source
        )
    if frame.metadata.serial != serial:
        raise FrameFormatError(
            "LSST_NUM", frame.metadata.serial, f"{serial}, as the other frames", source=source
        )


def _assemble_adu(frame: RawFrame, options: FlatPrepOptions) -> tuple[Image, dict[str, float]]:
    """Overscan-corrected frame [ADU] and the read noise of the amplifiers that live [ADU]."""
    image = np.zeros(frame.detector_shape, dtype=np.float32)
    noise: dict[str, float] = {}
    for amp in frame.amplifiers:
        corrected = correct_overscan(amp, options)
        if corrected is not None:
            image[amp.destination] = amp.oriented(corrected.image)
            noise[amp.name] = corrected.noise_adu
    return image, noise


# Charge ---------------------------------------------------------------------------------------------------


def assemble_charge(
    frame: RawFrame, bias: CombinedBias | None, detector: Detector, options: FlatPrepOptions = DEFAULT_OPTIONS
) -> PreparedCharge:
    """Charge of every pixel of a flat on the assembled, trimmed sensor, with variance and mask.

    Parameters
    ----------
    frame : `RawFrame`
        The flat.
    bias : `CombinedBias` or `None`
        Structure to take off; `None` where no bias frames exist.
    detector : `Detector`
        Gains and saturation levels by amplifier; its size does not matter.
    options : `FlatPrepOptions`, optional
        Choices.

    Returns
    -------
    charge : `PreparedCharge`
        Electrons. The variance is that of photons, of the read-out, and of the mean bias.

    Raises
    ------
    FrameFormatError
        The bias, the frame and the detector are not of one sensor.
    InputError
        No amplifier has any signal.
    UnknownNameError
        The detector has no such amplifier.
    """
    source = frame.metadata.source
    if detector.serial and frame.metadata.serial not in ("", detector.serial):
        raise FrameFormatError("LSST_NUM", frame.metadata.serial, detector.serial, source=source)
    if bias is not None:
        _check_same_sensor(frame, bias.image.shape, bias.serial)
    image, noise_adu = _assemble_adu(frame, options)
    if bias is not None:
        image -= bias.image
    variance = np.zeros_like(image)
    mask = np.zeros(image.shape, dtype=np.int32) if bias is None else bias.mask.copy()
    mask[~np.isfinite(image)] |= mask_bits("NO_DATA")
    read_noise: dict[str, float] = {}
    for amp in frame.amplifiers:
        where = amp.destination
        if amp.name not in noise_adu:
            mask[where] |= mask_bits("NO_DATA")
            continue
        known = detector.amplifier(amp.name)
        full = image[where] >= options.saturation_fraction * known.saturation
        full |= amp.oriented(amp.data[amp.imaging] >= ADC_MAXIMUM)
        mask[where][full] |= mask_bits("SAT")
        image[where] *= np.float32(known.gain)
        read_noise[amp.name] = known.gain * noise_adu[amp.name]
        floor = read_noise[amp.name] ** 2 * (1.0 + (1.0 / bias.n_frames if bias is not None else 0.0))
        variance[where] = np.maximum(image[where], 0.0) + np.float32(floor)
    missing = (mask & mask_bits("NO_DATA")) != 0
    image[missing] = 0.0
    variance[missing] = 0.0
    unused = _mask_odd_amplifiers(frame, image, mask, float(np.median([*read_noise.values()] or [0.0])))
    mask[isolated_defects(image, variance, mask == 0, options)] |= mask_bits("BAD")
    mask |= _border(image.shape, options)
    _mask_bad_columns(frame, image, mask, options)
    return PreparedCharge(image, variance, mask, read_noise, unused)


def _mask_odd_amplifiers(frame: RawFrame, image: Image, mask: Mask, read_noise_e: float) -> tuple[str, ...]:
    """Set BAD in amplifiers that do not see the light that most others see, and grow SAT; names of those amplifiers.

    The reference is the median of the amplifiers that see light, so that no single one can move it.
    """
    medians: dict[str, float] = {}
    odd = []
    for amp in frame.amplifiers:
        section = mask[amp.destination][::4, ::4]
        usable = section & mask_bits("NO_DATA", "BAD") == 0
        below = usable & (section & mask_bits("SAT") == 0)
        if np.count_nonzero(below) < (1.0 - SATURATED_AMPLIFIER) * np.count_nonzero(usable):
            odd.append(amp.name)
        elif below.any():
            medians[amp.name] = float(np.median(image[amp.destination][::4, ::4][below]))
    least = MINIMUM_SIGNAL * read_noise_e
    lit = [value for value in medians.values() if value > least]
    if not lit and not odd:
        brightest = round(max(medians.values(), default=0.0), 1)
        allowed = f"a flat with light, above {least:.0f}"
        raise InputError("signal [electrons]", brightest, allowed, source=frame.metadata.source)
    low, high = (limit * float(np.median(lit or [0.0])) for limit in AMPLIFIER_LEVELS)
    odd += [name for name, value in medians.items() if not low <= value <= high]
    _grow_saturated(frame, image, mask, medians)
    for amp in frame.amplifiers:
        if amp.name in odd:
            mask[amp.destination] |= mask_bits("BAD")
        elif np.all(mask[amp.destination] & mask_bits("NO_DATA")):
            odd.append(amp.name)
    return tuple(sorted(odd))


def _grow_saturated(frame: RawFrame, image: Image, mask: Mask, medians: Mapping[str, float]) -> None:
    """Set SAT in the shoulders of blooming: bright pixels that touch saturated ones, and a rim around all."""
    full = mask & mask_bits("SAT") != 0
    if not full.any():
        return
    bright = full.copy()
    for amp in frame.amplifiers:
        level = medians.get(amp.name, np.inf)
        bright[amp.destination] |= image[amp.destination] > SHOULDER * level
    square = np.ones((3, 3), dtype=bool)
    grown = binary_propagation(full, square, bright)
    mask[binary_dilation(grown, square, BESIDE_SATURATED_PX)] |= mask_bits("SAT")


def _border(shape: tuple[int, int], options: FlatPrepOptions) -> Mask:
    edge = np.zeros(shape, dtype=np.int32)
    bit, width = mask_bits("EDGE"), options.edge_px
    if width:
        edge[:width] = edge[-width:] = bit
        edge[:, :width] = edge[:, -width:] = bit
    if options.midline_px:
        middle = shape[0] // 2
        edge[max(0, middle - options.midline_px) : middle + options.midline_px] = bit
    return edge


def _mask_bad_columns(frame: RawFrame, image: Image, mask: Mask, options: FlatPrepOptions) -> None:
    """Set BAD in columns of one row of amplifiers whose mean does not continue that of the columns beside it."""
    starts = sorted({(amp.destination[0].start, amp.destination[0].stop) for amp in frame.amplifiers})
    for start, stop in starts:
        # Single hot pixels are found before, but not in the outermost rows.
        inner = slice(start + 1, stop - 1)
        bad = bad_columns(*column_means(image[inner], mask[inner]), options)
        mask[start:stop, bad] |= mask_bits("BAD")


# The whole ------------------------------------------------------------------------------------------------


@named_units
def prepare_flat(
    frame: RawFrame,
    bias: CombinedBias | None,
    detector: Detector,
    *,
    bandwidth_fwhm_nm: float | None = None,
    f_number: float = math.inf,
    options: FlatPrepOptions = DEFAULT_OPTIONS,
) -> FringeFlat:
    """Fringe pattern of one raw monochromatic flat: counts / mean - 1.

    Parameters
    ----------
    frame : `RawFrame`
        The flat.
    bias : `CombinedBias` or `None`
        Mean bias of the same sensor; `None` where no bias frames exist.
    detector : `Detector`
        The sensor, with its gains.
    bandwidth_fwhm_nm : `float`, optional
        Width of the monochromator line [nm]; not needed if the header states it, which then wins.
    f_number : `float`, optional
        Focal ratio of the light; infinite for a parallel beam.
    options : `FlatPrepOptions`, optional
        Choices.

    Returns
    -------
    flat : `FringeFlat`
        The pattern. Its metadata state the smoothing and the correlation length of the noise. The variance is that
        of a smoothed pixel; the (much smaller) variance of the mean is left out.

    Raises
    ------
    FrameFormatError
        Not a flat, no wavelength or temperature in the header, or frames of different sensors.
    InputError
        No light, too many saturated pixels, no good pixel, or an unknown bandwidth.
    """
    metadata = frame.metadata
    source = metadata.source
    if metadata.observation_type != "flat":
        raise FrameFormatError("IMGTYPE", metadata.observation_type, "flat", source=source)
    wavelength, temperature = metadata.require_wavelength_nm(), metadata.require_temperature_k()
    bandwidth = metadata.bandpass_nm if metadata.bandpass_nm is not None else bandwidth_fwhm_nm
    if bandwidth is None:
        raise InputError("bandwidth FWHM [nm]", None, "a number (the header has none)", source=source)
    charge = assemble_charge(frame, bias, detector, options)
    _refuse_saturated(charge.mask, options, source)
    good = charge.mask == 0
    if not good.any():
        raise InputError("good pixels", 0, "at least one outside all masks", source=source)
    image, variance = smooth_masked(charge.image, charge.variance, good, options.smoothing_sigma_px)
    level = float(np.mean(image, where=good, dtype=np.float64))
    if not level > 0.0:
        raise InputError("mean signal [electrons]", level, "above 0", source=source)
    image /= np.float32(level)
    image -= np.float32(1.0)
    variance /= np.float32(level * level)
    mask = charge.mask
    mask[~np.isfinite(image)] |= mask_bits("NO_DATA")
    return FringeFlat(
        image=image,
        variance=variance,
        mask=mask,
        wavelength_nm=wavelength,
        bandwidth_fwhm_nm=bandwidth,
        temperature_k=temperature,
        level_e=level,
        metadata=_flat_metadata(frame, bias, charge, options),
        detector=detector.name,
        f_number=f_number,
        dark_time_s=metadata.dark_time_s,
    )


def _refuse_saturated(mask: Mask, options: FlatPrepOptions, source: str) -> None:
    exposed = mask.size - int(np.count_nonzero(mask & mask_bits("NO_DATA")))
    saturated = int(np.count_nonzero(mask & mask_bits("SAT"))) / max(exposed, 1)
    if saturated > options.max_saturated:
        raise InputError(
            "saturated part of the pixels",
            round(saturated, 3),
            f"up to {options.max_saturated:g}",
            source=source,
        )


def _flat_metadata(
    frame: RawFrame, bias: CombinedBias | None, charge: PreparedCharge, options: FlatPrepOptions
) -> dict[str, Any]:
    sigma = options.smoothing_sigma_px
    return {
        "EXPID": frame.metadata.exposure_id,
        "DATE-OBS": frame.metadata.date_obs.isoformat(timespec="milliseconds"),
        "RUNNUM": frame.metadata.run,
        "SERIAL": frame.metadata.serial,
        "NBIAS": 0 if bias is None else bias.n_frames,
        "RDNOISE": float(np.median(list(charge.read_noise_e.values()))),
        "BADAMPS": " ".join(charge.unused) or "none",
        "OVERSCAN": options.overscan_method,
        "SMOOTHPX": sigma,
        "CORRPX": math.sqrt(2.0) * sigma,
    }
