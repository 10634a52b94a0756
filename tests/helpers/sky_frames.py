"""A night sky of few lines, and frames of one with photon noise, for searches."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lsst.fringe_sim.algorithms.image_noise import add_exposure_noise
from lsst.fringe_sim.algorithms.sky_frame import simulate_sky_frame, sky_response
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.instrument.sky import EmissionLines, SkySpectrum, airglow_continuum
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import SkyFringe, band_cards

SHAPE = (48, 48)
FRAMES = 3
FINER = 3


def bright_lines(count: int) -> EmissionLines:
    """The brightest lines of OH."""
    lines = EmissionLines.oh()
    chosen = np.sort(np.argsort(lines.photon_radiance)[-count:])
    return EmissionLines(
        lines.wavelength_nm[chosen],
        lines.photon_radiance[chosen],
        lines.transmission[chosen],
        lines.band[chosen],
    )


def bright_sky(count: int = 20, airmass: float = 1.2) -> SkySpectrum:
    """The same and a continuum."""
    return SkySpectrum(bright_lines(count), (airglow_continuum(),), airmass)


def sky_frames_of(
    setup: str,
    settings: Mapping[str, float],
    seed: int,
    level: float = 4e6,
    *,
    shape: tuple[int, int] = SHAPE,
    span: float = 2.5,
    sky: SkySpectrum | None = None,
) -> tuple[list[SkyFringe], np.ndarray]:
    """Frames of a night with photon noise, and the map of their sensor at the centres of the pixels."""
    rng = np.random.default_rng(seed)
    model = FringeModel.from_setup(setup, settings)
    fine = random_field((FINER * shape[0], FINER * shape[1]), rng, mean=14.0, span=span)
    truth = fine[FINER // 2 :: FINER, FINER // 2 :: FINER]
    sky = sky or SkySpectrum.dark(airmass=model.setup.airmass)
    response = sky_response(model, sky, thickness_range_um=(float(fine.min()) - 0.1, float(fine.max()) + 0.1))
    night, frames = NightHistory.guo2022(), []
    for time in range(FRAMES):
        scale = night.band_scale(3 * time, response.bands)
        frame = simulate_sky_frame(fine, model, response=response, scale=scale, mean_electrons=level)
        # Pixels average the light over their area.
        light = frame.image.reshape(shape[0], FINER, shape[1], FINER).mean(axis=(1, 3), dtype=np.float64)
        image = add_exposure_noise(light.astype(np.float32), np.random.default_rng(seed + 10 * time), 0.0)
        cards = {**frame.metadata, "NOISE": True, **band_cards(scale)}
        mask = np.zeros(shape, dtype=frame.mask.dtype)
        frames.append(replace(frame, image=image, mask=mask, seed=seed + 10 * time, metadata=cards))
    return frames, truth + 0.002 * rng.standard_normal(shape)
