"""Frames of a night sky with photon noise, for searches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lsst.fringe_sim.algorithms.sky_frame import simulate_sky_frame, sky_response
from lsst.fringe_sim.instrument.night import NightHistory
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.mock.thickness import random_field
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import SkyFringe, band_cards

SHAPE = (48, 48)
FRAMES = 3


def sky_frames_of(
    setup: str, settings: Mapping[str, float], seed: int, level: float = 4e6
) -> tuple[list[SkyFringe], np.ndarray]:
    """Frames of a night with photon noise, and the map of their sensor."""
    rng = np.random.default_rng(seed)
    model = FringeModel.from_setup(setup, settings)
    truth = random_field(SHAPE, rng, mean=14.0, span=2.5)
    sky = SkySpectrum.dark(airmass=model.setup.airmass)
    response = sky_response(
        model, sky, thickness_range_um=(float(truth.min()) - 0.1, float(truth.max()) + 0.1)
    )
    night, frames = NightHistory.guo2022(), []
    for time in range(FRAMES):
        scale = night.band_scale(3 * time, response.bands)
        frame = simulate_sky_frame(
            truth, model, response=response, scale=scale, mean_electrons=level, seed=seed + 10 * time
        )
        frames.append(replace(frame, metadata={**frame.metadata, **band_cards(scale)}))
    return frames, truth + 0.002 * rng.standard_normal(SHAPE)
