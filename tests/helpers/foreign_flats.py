"""Exposures of the foreign sensor: its map, its charge and its noise; no code is shared with the mock."""

from dataclasses import dataclass

import numpy as np
from field_matrices import KELVIN, LINE_NM, ForeignSensor

from lsst.fringe_sim.products.fringe_cube import FlatExposures, FringeCube

WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
READ_NOISE_E = 6.0
PLACES = 5  # Places along a side of a pixel


@dataclass(frozen=True)
class ForeignCharge:
    """What becomes of the light after it has come in."""

    electrons: float = 30_000.0  # Mean charge of a pixel
    level_rms: float = 0.02  # Relative error of the level of each flat
    response_rms: float = 0.003  # Relative scatter of the response of the pixels
    # Part of the charge that every pixel leaves for the next one along y when it is read
    trailing: float = 0.0
    noise: float = 1.0  # True over stated standard deviation


def smooth_map(
    rng: np.random.Generator, shape: tuple[int, int], mean_um: float, span_um: float, places: int = PLACES
) -> np.ndarray:
    """Thickness [µm] at so many places by places in every pixel: a few waves of random direction on a plane."""
    v, u = (np.linspace(-1.0, 1.0, size * places) for size in shape)
    v = v[:, np.newaxis]
    total = rng.normal() * u + rng.normal() * v
    for _ in range(5):
        ky, kx, phase = rng.normal(0.0, 1.8), rng.normal(0.0, 1.8), rng.uniform(0.0, 2.0 * np.pi)
        total = total + 0.5 * np.cos(ky * v + kx * u + phase)
    total = (total - total.min()) / np.ptp(total) - 0.5
    return np.asarray(mean_um + span_um * total)


def exposed(
    sensor: ForeignSensor,
    thickness_um: np.ndarray,
    rng: np.random.Generator,
    charge: ForeignCharge | None = None,
    places: int = PLACES,
) -> FringeCube:
    """Twelve flats with photon and read noise."""
    own = charge or ForeignCharge()
    flats = sensor.flats(WAVELENGTHS, thickness_um, places)
    levels = own.electrons * (1.0 + own.level_rms * rng.standard_normal(len(flats)))
    response = 1.0 + own.response_rms * rng.standard_normal(flats.shape[1:])
    light = levels[:, np.newaxis, np.newaxis] * flats * response
    image = rng.poisson(light) + READ_NOISE_E * rng.standard_normal(light.shape)
    if own.trailing:
        image[:, 1:] += own.trailing * (image[:, :-1] - image[:, 1:])
    variance = (np.maximum(image, 1.0) + READ_NOISE_E**2) / own.noise**2
    rows = FlatExposures(WAVELENGTHS, np.full(len(flats), LINE_NM), np.full(len(flats), KELVIN))
    mask = np.zeros(image.shape, np.int32)
    return FringeCube(
        image.astype(np.float32), variance.astype(np.float32), mask, rows, "electron", detector="foreign"
    )
