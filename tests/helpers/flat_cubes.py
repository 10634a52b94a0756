"""Flats of a known thickness map, as the fit takes them."""

import numpy as np

from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FlatExposures, FringeCube

TEN_NM = np.arange(880.0, 991.0, 10.0)


def relative_flats(
    thickness: np.ndarray,
    model: FringeModel,
    rng: np.random.Generator,
    noise: float = 0.002,
    wavelengths: np.ndarray = TEN_NM,
    light: np.ndarray | float = 1.0,
) -> FringeCube:
    """Relative flats of a map, times the light that falls on it, with Gaussian noise of known size."""
    image = model.response(thickness, wavelengths) * light
    image = image / image.mean(axis=(1, 2), keepdims=True)
    image = image + noise * rng.standard_normal(image.shape)
    return FringeCube(
        image.astype(np.float32),
        np.full(image.shape, noise**2, np.float32),
        np.zeros(image.shape, np.int16),
        FlatExposures(wavelengths, np.array(2.0), np.array(183.15)),
        "relative",
    )
