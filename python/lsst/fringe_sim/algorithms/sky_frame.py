"""Night-sky fringe frames: the sum over lines and angles of Eq. 5, converged, with its error stated.

What depends on thickness is computed once per component of the sky (an OH band, a continuum) as a table; a frame, or
a whole night of frames, is then a weighted sum of table rows and one interpolation per pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import BoolArray, Float32Array
from ..effects import ImageGeometry, apply_to_image
from ..errors import InputError, OutOfRangeError, named_units
from ..instrument.bandpass import Bandpass
from ..instrument.night import NightHistory
from ..instrument.setup import LONGEST_EXPOSURE_S
from ..instrument.sky import SkySpectrum
from ..model import FringeModel
from ..products import NOISE, SkyFringe, mask_bits
from ..products.thickness_map import thickness_span_um
from .fringe_amplitudes import fringe_amplitudes
from .image_noise import add_exposure_noise
from .island_response import response_with_islands
from .laboratory_shift import phase_change, widened_um
from .photon_migration import spread_charge
from .sky_response import Response, SkyQuadrature, SkyResponse, is_band, sky_response, sky_with_effects

__all__ = [
    "SkyQuadrature",
    "SkyResponse",
    "is_band",
    "simulate_night",
    "simulate_sky_frame",
    "sky_response",
    "throughput_electrons",
]

_BASELINE_HOUR = 19.0  # Local time of hour 0 of a night [h]


@named_units
def simulate_sky_frame(
    thickness_um: ArrayLike,
    model: FringeModel,
    sky: SkySpectrum | None = None,
    *,
    response: Response | None = None,
    scale: Mapping[str, float] | None = None,
    exposure_s: float | None = None,
    mean_electrons: float | None = None,
    airglow_level: ArrayLike = 1.0,
    read_noise_e: float = 0.0,
    charge_kernel: ArrayLike | None = None,
    seed: int | None = None,
    phase_sigma: float = 0.0,
    hour: float = 24.0,
    detector: str = "",
    physical_filter: str = "",
) -> SkyFringe:
    """Night-sky exposure of one sensor (Eq. 5).

    Parameters
    ----------
    thickness_um : array_like, shape ``(ny, nx)``
        Thickness of the varying layer [µm]; NaN where it is not known, which is masked ``NO_DATA``.
    model : `FringeModel`
        Sensor behind a telescope, with effects; its field position decides the beam.
    sky : `SkySpectrum`, optional
        Lines and continua; by default a dark sky at the airmass of the set-up.
    response : `SkyResponse` or `SensorResponse`, optional
        Result of `sky_response` (one beam for all pixels) or `sensor_response` (the beam of every pixel) for this
        model and sky, or of `response_with_islands` where an effect is local, so that many frames share it. By
        default one beam, that of the model.
    scale : mapping, optional
        Factors on components of the sky: OH bands and continua by name.
    exposure_s : `float`, optional
        Exposure time [s]; by default that of the set-up.
    mean_electrons : `float`, optional
        Mean level of the frame [e⁻]. By default the level that the model itself detects, which for cold silicon is
        below the level that measured quantum efficiencies give (see `throughput_electrons`).
    airglow_level : array_like, optional
        Brightness of the sky relative to the field centre; broadcasts to the image.
    read_noise_e : `float`, optional
        Read noise [e⁻ rms], added if ``seed`` is given.
    charge_kernel : array_like, optional
        Where the photons of a pixel are absorbed (`PhotonMigration.pixel_kernel`); all of them in it if not given.
    seed : `int`, optional
        Seed of photon and read noise; a frame without noise if not given.
    phase_sigma : `float`, optional
        Standard uncertainty of the phase of the adhesive between laboratory and sky [rad per 10 K]: what it does to
        the frame, ``PHASERMS``, is stated in the header. A given response must cover the range of `widened_um`.
    hour, detector, physical_filter
        Go into the product.

    Returns
    -------
    frame : `SkyFringe`
        In electrons; its header states the estimated error of the quadrature, of the interpolation, and the three
        amplitudes of the noiseless fringe.

    Raises
    ------
    InputError
        A map that is not two-dimensional, or that has no thickness at all.
    OutOfRangeError
        A thickness, factor, exposure or level that is not physical.
    """
    thickness = np.asarray(thickness_um)
    if thickness.ndim != 2:
        raise InputError("shape of the thickness map", thickness.shape, "two axes (y, x)")
    known = np.isfinite(thickness)
    if not known.any():
        raise InputError("thickness map", "no finite value", "a thickness in at least one pixel")
    exposure = model.setup.exposure_s if exposure_s is None else exposure_s
    if not 0.0 < exposure <= LONGEST_EXPOSURE_S:
        raise OutOfRangeError("exposure time [s]", exposure, f"above 0, up to {LONGEST_EXPOSURE_S:g}")
    if response is None:
        dark = SkySpectrum.dark(airmass=model.setup.airmass) if sky is None else sky
        span = widened_um(model, thickness_span_um(thickness[known]), phase_sigma)
        response = response_with_islands(model, lambda own: sky_response(own, dark, thickness_range_um=span))

    level = response.sky(scale)
    setup = model.setup
    to_electrons = exposure * setup.effective_area_m2 * setup.pixel_scale_arcsec**2
    shift = phase_change(level, thickness, model, phase_sigma)
    image = level.frame(thickness)
    image *= np.asarray(airglow_level, dtype=np.float32)
    if charge_kernel is not None:
        image = _spread(image, known, charge_kernel)
    image = _with_image_effects(model, image, known, float(level.wavelength_nm[0]), to_electrons)
    amplitudes = fringe_amplitudes(image, ~known)
    mean = amplitudes.mean
    wanted = mean * to_electrons if mean_electrons is None else mean_electrons
    if not 0.0 < wanted < math.inf:
        raise OutOfRangeError("mean level [e]", wanted, "positive")
    image *= np.float32(wanted / mean)
    image[~known] = wanted
    if seed is not None:
        image = add_exposure_noise(image, np.random.default_rng(seed), read_noise_e)
    return SkyFringe(
        image,
        np.where(known, np.int32(0), np.int32(mask_bits("NO_DATA"))),
        "electron",
        mean_electrons=wanted,
        exposure_s=exposure,
        airmass=response.airmass,
        hour=hour,
        seed=seed,
        quadrature_error=response.quadrature_error,
        metadata={
            "INTERR": level.interpolation_error / mean,
            "FRINGRMS": amplitudes.rms,
            "FRINGPTP": amplitudes.half_peak_to_peak,
            "FRING198": amplitudes.half_range_1_99,
            NOISE: seed is not None,
            "RDNOISE": read_noise_e if seed is not None else 0.0,
            **_phase_cards(phase_sigma, shift),
        },
        detector=detector,
        physical_filter=physical_filter,
    )


def _phase_cards(sigma: float, change: Float32Array | None) -> dict[str, float]:
    """Uncertainty of the phase of the adhesive [rad per 10 K], and the rms that it leaves open."""
    if change is None:
        return {}
    return {"PHASESIG": sigma, "PHASERMS": float(np.nanstd(change, dtype=np.float64))}


@named_units
def simulate_night(
    thickness_um: ArrayLike,
    model: FringeModel,
    response: Response,
    night: NightHistory,
    *,
    exposure_s: float | None = None,
    mean_electrons: Sequence[float] | None = None,
    seed: int | None = None,
    read_noise_e: float = 0.0,
    charge_kernel: ArrayLike | None = None,
    phase_sigma: float = 0.0,
    detector: str = "",
    physical_filter: str = "",
) -> Iterator[SkyFringe]:
    """Frames of a night, one per time, one after the other.

    Parameters
    ----------
    thickness_um, model, response, exposure_s, read_noise_e, charge_kernel, phase_sigma, detector, physical_filter
        See `simulate_sky_frame`.
    night : `NightHistory`
        Intensity of the OH bands through the night.
    mean_electrons : sequence of `float`, optional
        Mean level of each frame [e⁻], such as `throughput_electrons` of the sky at its time; by default what the
        model itself detects.
    seed : `int`, optional
        Seed of the night; every frame gets its own noise. No noise if not given.

    Yields
    ------
    frame : `SkyFringe`

    Raises
    ------
    InputError
        Levels that are not as many as the times of the night.
    """
    if mean_electrons is not None and len(mean_electrons) != len(night):
        raise InputError("mean levels", len(mean_electrons), f"one for each of {len(night)} frames")
    children = np.random.SeedSequence(0 if seed is None else seed).generate_state(len(night), np.uint32)
    for time in range(len(night)):
        yield simulate_sky_frame(
            thickness_um,
            model,
            response=response,
            scale=night.band_scale(time, response.bands),
            exposure_s=exposure_s,
            mean_electrons=None if mean_electrons is None else mean_electrons[time],
            read_noise_e=read_noise_e,
            charge_kernel=charge_kernel,
            seed=None if seed is None else int(children[time]),
            phase_sigma=phase_sigma,
            hour=_BASELINE_HOUR + float(night.hours[time]),
            detector=detector,
            physical_filter=physical_filter,
        )


@named_units
def throughput_electrons(
    sky: SkySpectrum, bandpass: Bandpass, model: FringeModel, exposure_s: float | None = None
) -> float:
    """Mean sky [e⁻ per pixel] through the measured quantum efficiency of the throughput tables."""
    exposure = model.setup.exposure_s if exposure_s is None else exposure_s
    return sum(component_electrons(sky, bandpass, model, exposure).values())


def component_electrons(
    sky: SkySpectrum, bandpass: Bandpass, model: FringeModel, exposure_s: float
) -> dict[str, float]:
    """Mean electrons per pixel from each component of a sky, through the measured quantum efficiency."""
    to_electrons = exposure_s * model.setup.effective_area_m2 * model.setup.pixel_scale_arcsec**2
    return {
        item.name: to_electrons * float(item.photons @ bandpass.quantum_efficiency(item.wavelength_nm))
        for item in sky_with_effects(model, sky).components(bandpass)
    }


def _with_image_effects(
    model: FringeModel, image: Float32Array, known: BoolArray, wavelength_nm: float, to_electrons: float
) -> Float32Array:
    """Frame with the effects of sensor and read-out in it; the frame itself if there are none."""
    active = [
        item
        for item in model.effects
        if item.effect.acts_on == "image"
        and not item.effect.laboratory_only
        and not item.is_null(model.base_system)
    ]
    if not active:
        return image
    mean = float(image.mean(dtype=np.float64, where=known))
    relative = np.where(known, image / np.float32(mean), 1.0)[np.newaxis].astype(np.float64)
    geometry = ImageGeometry.of_pixels(image.shape, np.array([wavelength_nm]), mean * to_electrons)
    changed = apply_to_image(active, model.base_system, relative, geometry)[0]
    return np.where(known, mean * changed, np.nan).astype(np.float32)


def _spread(image: Float32Array, known: BoolArray, kernel: ArrayLike) -> Float32Array:
    """Frame after photon migration; pixels that are not known take part with the mean of the others."""
    mean = np.float32(image.mean(dtype=np.float64, where=known))
    spread = spread_charge(np.where(known, image, mean), kernel)
    spread[~known] = np.nan
    return spread
