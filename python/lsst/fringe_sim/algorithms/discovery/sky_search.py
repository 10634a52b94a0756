"""The search on the night sky: frames of one sensor whose thickness is known from the laboratory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...array_types import Float32Array
from ...effects import Effect, known_effects
from ...errors import InputError, named_units
from ...instrument.detector import Detector
from ...instrument.sky import SkySpectrum
from ...model import FringeModel, Setup
from ...products import (
    FlatExposures,
    FringeCube,
    SensorSection,
    SkyFringe,
    bands_of_header,
    mask_bits,
    refuse_corrected,
    refuse_noiseless,
)
from ..field_response import SensorPlacement
from ..sky_response import (
    bandpass_of,
    component_factors,
)
from .noise import scatter_of_pixels
from .options import SearchOptions
from .search import Report, search_exposures
from .sky_exposures import BeamsOverSensor, SkyExposures
from .verdict import Verdict

LEAST_SCATTER_E, COUNTED_E = 1.0, 100.0
"""Scatter of pixels that counted electrons have, whatever was averaged: whole numbers alone scatter by 0.3. And the
level above which they scatter by ten times that [e⁻]."""

AIRMASS_RANGE = 0.2  # Largest difference in airmass of frames that are searched together

SKY_SEARCH = SearchOptions(most_effects=2)
"""Smaller sets than of flats: one pattern does not tell three effects apart."""

_NO_DATA = mask_bits("NO_DATA")


@named_units
def discover_sky(
    frames: Sequence[SkyFringe],
    thickness_um: ArrayLike,
    thickness_sigma_um: ArrayLike | float,
    setup: str | Setup | FringeModel,
    effects: Sequence[Effect] | None = None,
    *,
    rng: np.random.Generator,
    sky: SkySpectrum | None = None,
    scales: Sequence[Mapping[str, float]] | None = None,
    placement: SensorPlacement | None = None,
    options: SearchOptions | None = None,
    report: Report | None = None,
) -> Verdict:
    """Find out whether frames of the night sky and the model disagree beyond noise, and what is the reason.

    All frames of a night show nearly the same pattern; what tells effects apart is how it changes with thickness.
    So the thickness must be known, and several orders of it on the sensor help.

    Parameters
    ----------
    frames : sequence of `SkyFringe`
        Frames of one sensor, not corrected for fringes.
    thickness_um : array_like, shape ``(ny, nx)``
        Thickness of the varying layer [µm]; NaN where it is not known.
    thickness_sigma_um : array_like or `float`
        Its standard uncertainty [µm].
    setup : `str`, `Setup` or `FringeModel`
        Sensor behind a telescope; a model may hold effects that are known already, such as those named from flats.
    effects : sequence of `Effect`, optional
        The catalogue; those of the laboratory are left out.
    rng, report
        See `discover`.
    options : `SearchOptions`, optional
        Thresholds and sizes; those of `SKY_SEARCH` by default.
    sky : `SkySpectrum`, optional
        Lines and continua; by default a dark sky at the mean airmass of the frames.
    scales : sequence of mapping, optional
        Factors on components of that sky for each frame, as `NightHistory.band_scale` gives them; by default what the
        headers of the frames say (`band_cards`). The bands change by factors during a night, and what they do to a
        frame looks like many an effect: a search that guessed them would find what is not there.
    placement : `SensorPlacement`, optional
        Where the pixels lie, of flat-fielded frames in which every pixel sees its own beam, as in any real one; by
        default all see that of the model.

    Returns
    -------
    verdict : `Verdict`

    Raises
    ------
    InputError
        No frames, frames of different shapes, sensors or airmass, already corrected or without noise, a map of
        another shape, a set-up of a laboratory; bands that nobody states.
    UnknownNameError
        A factor on a component that the sky does not have.
    """
    model = setup if isinstance(setup, FringeModel) else FringeModel.from_setup(setup)
    if model.setup.kind != "sky":
        raise InputError("set-up", model.setup.name, "one behind a telescope")
    _check_frames(frames)
    if sky is None:
        sky = SkySpectrum.dark(airmass=float(np.mean([frame.airmass for frame in frames])))
    factors = tuple(_stated_bands(frames) if scales is None else scales)
    if len(factors) != len(frames):
        raise InputError("factors on the sky", len(factors), f"one mapping for each of {len(frames)} frames")
    _check_components(sky, factors)
    over = None if placement is None else BeamsOverSensor.of(model.setup.telescope, placement)
    light = SkyExposures(model, sky, bandpass_of(model), factors, over)
    order = np.argsort(light.wavelength_nm(), kind="stable")  # that of a search
    light = replace(light, scales=tuple(light.scales[number] for number in order))
    cube = _as_cube(_images_of(frames).in_order(order), light, model, thickness_um, thickness_sigma_um)
    known = {item.effect.name for item in model.effects}
    own = [
        effect
        for effect in known_effects(effects)
        if not (effect.laboratory_only or effect.learned) or effect.name in known
    ]
    verdict = search_exposures(cube, model, own, rng, options or SKY_SEARCH, report, light)
    return replace(verdict, known=model.effect_settings)


@named_units
def placement_in_frames(
    frames: Sequence[SkyFringe], detector: Detector, pixel_scale_arcsec: float
) -> SensorPlacement | None:
    """Placement for `discover_sky`; `None` for frames that were simulated with the beam of the centre only.

    Raises
    ------
    InputError
        No frames, or frames of several parts of the sensor.
    """
    _check_frames(frames)
    if all(str(frame.metadata.get("BEAMS", "")) == "centre" for frame in frames):
        return None
    sections = {SensorSection.of_image(detector, frame.shape, frame.metadata) for frame in frames}
    if len(sections) > 1:
        raise InputError("sections of the sky frames", len(sections), "one part of the sensor")
    return SensorPlacement.of(detector, pixel_scale_arcsec, sections.pop())


def _stated_bands(frames: Sequence[SkyFringe]) -> list[dict[str, float]]:
    """Intensity of the OH bands as the headers of the frames state it."""
    found = [bands_of_header(frame.metadata) for frame in frames]
    silent = [number for number, bands in enumerate(found) if not bands]
    if silent:
        raise InputError(
            f"OH bands of frames {silent}",
            "not stated",
            "header cards like 'BAND 8-4' with their intensity relative to the reference sky",
        )
    return found


def _check_frames(frames: Sequence[SkyFringe]) -> None:
    if not frames:
        raise InputError("sky frames", 0, "one or more")
    shapes = sorted({frame.shape for frame in frames})
    if len(shapes) > 1:
        raise InputError("shapes of the sky frames", shapes, "one, that of the sensor")
    names = sorted({frame.detector for frame in frames if frame.detector})
    if len(names) > 1:
        raise InputError("detectors of the sky frames", names, "one sensor")
    airmass = [frame.airmass for frame in frames]
    if np.ptp(airmass) > AIRMASS_RANGE:
        raise InputError("airmass of the sky frames", airmass, f"one sky: within {AIRMASS_RANGE:g}")
    for frame in frames:
        refuse_corrected(frame.metadata, frame.detector or None)
        refuse_noiseless(frame.metadata, frame.detector or None)
        if frame.mean_electrons > COUNTED_E:
            _refuse_uncounted(frame)


def _refuse_uncounted(frame: SkyFringe) -> None:
    """Refuse a frame without noise whose header does not say so."""
    scatter = scatter_of_pixels(_electrons(frame), frame.mask == 0)
    if scatter < LEAST_SCATTER_E:
        allowed = (
            f"{LEAST_SCATTER_E:g} or more: {frame.mean_electrons:.4g} counted electrons scatter by "
            f"{np.sqrt(frame.mean_electrons):.3g}. The frame is simulated without noise, or smoothed"
        )
        raise InputError(
            "scatter of the pixels [electron]", f"{scatter:.2g}", allowed, source=frame.detector or None
        )


def _check_components(sky: SkySpectrum, scales: Sequence[Mapping[str, float]]) -> None:
    names = (*sky.lines.bands, *(term.name for term in sky.continua))
    for scale in scales:
        component_factors(names, np.ones(len(names)), scale)


class _Images(NamedTuple):
    """Frames in electrons, ``(F, ny, nx)``."""

    value: Float32Array
    variance: Float32Array
    mask: NDArray[np.int16]
    detector: str

    def in_order(self, order: NDArray[np.intp]) -> _Images:
        return _Images(self.value[order], self.variance[order], self.mask[order], self.detector)


def _images_of(frames: Sequence[SkyFringe]) -> _Images:
    value = np.stack([_electrons(frame) for frame in frames])
    read_noise: list[Any] = [frame.metadata.get("RDNOISE", 0.0) for frame in frames]
    noise = np.array([float(each) for each in read_noise])[:, None, None]
    mask = np.stack([frame.mask for frame in frames]).astype(np.int16)
    variance = (np.maximum(value, 1.0) + noise**2).astype(np.float32)
    return _Images(value, variance, mask, frames[0].detector)


def _as_cube(
    images: _Images,
    light: SkyExposures,
    model: FringeModel,
    thickness_um: ArrayLike,
    sigma_um: ArrayLike | float,
) -> FringeCube:
    """Frames and map in the form of a cube."""
    thickness = np.asarray(thickness_um, dtype=np.float32)
    shape = images.value.shape[1:]
    if thickness.shape != shape:
        raise InputError("shape of the thickness map", thickness.shape, f"{shape}, that of the frames")
    known = np.isfinite(thickness)
    if not known.any():
        raise InputError("thickness map", "no finite value", "a thickness in at least one pixel")
    low, high = light.band.support()
    good = images.mask == 0
    return FringeCube(
        images.value,
        images.variance,
        np.where(known, images.mask, images.mask | np.int16(_NO_DATA)),
        FlatExposures(
            light.wavelength_nm(),
            np.array(high - low),
            np.array(model.system.temperature_k),
            level_e=np.array(
                [plane[ok].mean() if ok.any() else 1.0 for plane, ok in zip(images.value, good, strict=True)]
            ),
        ),
        "electron",
        thickness=thickness,
        thickness_sigma=np.broadcast_to(np.asarray(sigma_um, dtype=np.float32), shape).copy(),
        layer=model.system.varying,
        detector=images.detector,
    )


def _electrons(frame: SkyFringe) -> Float32Array:
    if frame.unit == "electron":
        return frame.image
    return np.asarray(frame.mean_electrons * (1.0 + frame.image), dtype=np.float32)
