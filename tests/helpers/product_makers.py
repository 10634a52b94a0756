"""Makers of valid products, so that each test spoils or varies one thing."""

from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st

from lsst.fringe_sim import products as p
from lsst.fringe_sim.products.mask import ALL_BITS

SHAPES = st.tuples(st.integers(1, 4), st.integers(1, 4))

KEYWORDS = st.one_of(
    st.from_regex(r"Q[A-Z0-9_\-]{0,7}", fullmatch=True),
    st.from_regex(r"LSST BUTLER [A-Z]{1,6} [0-9]{1,2}( [A-Z]{1,6})?", fullmatch=True),
)
PRINTABLE = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=150).map(str.rstrip)
VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**53), 2**53),
    st.floats(allow_nan=False, allow_infinity=False),
    PRINTABLE,
)
METADATA = st.dictionaries(KEYWORDS, VALUES, max_size=4)
NAMES = st.from_regex(r"[A-Za-z0-9_]{0,12}", fullmatch=True)


def pixels(shape: tuple[int, ...], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.02, shape).astype(np.float32)


def masks(shape: tuple[int, ...], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.where(rng.random(shape) < 0.3, rng.integers(0, ALL_BITS + 1, shape), 0).astype(np.int32)


def with_holes(values: np.ndarray, mask: np.ndarray, seed: int, changes: dict[str, Any]) -> np.ndarray:
    """Put NaN and infinities where the mask allows them, unless another mask is coming."""
    if "mask" in changes:
        return values
    rng = np.random.default_rng(seed)
    holes = (mask != 0) & (rng.random(mask.shape) < 0.5)
    result = values.copy()
    result[holes] = rng.choice([np.nan, np.inf, -np.inf], holes.sum())
    return result


def flat(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.FringeFlat:
    mask = masks(shape, number)
    values: dict[str, Any] = {
        "image": with_holes(pixels(shape, number + 1), mask, number, changes),
        "variance": with_holes(pixels(shape, number + 2) ** 2, mask, number + 1, changes),
        "mask": mask,
        "wavelength_nm": 960.0,
        "bandwidth_fwhm_nm": 2.0,
        "temperature_k": 183.15,
        "level_e": 21234.5,
        "detector": "R11_S01",
    }
    return p.FringeFlat(**(values | changes))


def cube(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.FringeCube:
    full = (2, *shape)
    mask = masks(full, number)
    values: dict[str, Any] = {
        "image": 20000 * (1 + pixels(full, number + 1)),
        "variance": 20000 * (1 + pixels(full, number + 2)),
        "mask": mask,
        "exposures": p.FlatExposures(np.array([990.0, 880.0]), np.array(2.0), np.array(183.0)),
        "unit": "electron",
        "thickness": 14 + pixels(shape, number),
        "thickness_sigma": np.abs(pixels(shape, number)),
        "layer": "epoxy",
        "detector": "R11_S01",
    }
    return p.FringeCube(**(values | changes))


def thickness(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.ThicknessMap:
    mask = masks(shape, number)
    values: dict[str, Any] = {
        "value": with_holes(14 + pixels(shape, number), mask, number, changes),
        "sigma": with_holes(np.abs(pixels(shape, number + 1)), mask, number + 1, changes),
        "chi2": with_holes(np.abs(pixels(shape, number + 2)), mask, number + 2, changes),
        "slip_probability": np.clip(np.abs(pixels(shape, number + 3)), 0, 1),
        "mask": mask,
        "layer": "epoxy",
        "n_wavelengths": np.full(shape, 12),
        "detector": "R11_S01",
    }
    return p.ThicknessMap(**(values | changes))


def frame(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.FringeFrame:
    mask = masks(shape, number)
    image = pixels(shape, number).astype(np.float64)
    good = mask == 0
    if good.any():
        image -= image[good].mean()
    values: dict[str, Any] = {
        "image": image,
        "mask": mask,
        "variance": pixels(shape, number + 1) ** 2,
        "physical_filter": "y_10",
        "creation_datetime": "2022-03-04T05:06:07",
        "detector": "R22_S11",
        "xy0": (5, 7),
    }
    return p.FringeFrame(**(values | changes))


def components(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.FringeComponents:
    values: dict[str, Any] = {
        "mean": pixels(shape, number),
        "components": pixels((2, *shape), number + 1),
        "explained_variance": np.array([3.0, 1.0]),
        "explained_variance_ratio": np.array([0.7, 0.2]),
        "scores": pixels((5, 2), number + 2).astype(np.float64) / 3,
        "mask": masks(shape, number),
        "detector": "R22_S11",
        "physical_filter": "y_10",
    }
    return p.FringeComponents(**(values | changes))


def sky(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.SkyFringe:
    mask = masks(shape, number)
    values: dict[str, Any] = {
        "image": with_holes(2700 * (1 + pixels(shape, number)), mask, number, changes),
        "mask": mask,
        "unit": "electron",
        "mean_electrons": 2717.1,
        "exposure_s": 30.0,
        "airmass": 1.2,
        "hour": 23.0,
        "seed": 17,
        "quadrature_error": 1.1e-6,
        "detector": "R22_S11",
        "physical_filter": "y_10",
    }
    return p.SkyFringe(**(values | changes))


def bias(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.CombinedBias:
    values: dict[str, Any] = {
        "image": pixels(shape, number),
        "mask": masks(shape, number),
        "noise_adu": {"C00": 5.5, "C17": 1 / 3},
        "n_frames": 5,
        "serial": "E2V-CCD250-321",
        "detector": "R11_S01",
    }
    return p.CombinedBias(**(values | changes))


def templates(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.FringeTemplates:
    values: dict[str, Any] = {
        "coverage": np.full(shape, 6.0),
        "patterns": pixels((2, *shape), number),
        "variance": pixels((2, *shape), number + 1) ** 2,
        "scores": pixels((6, 2), number + 2).astype(np.float64) / 3,
        "mask": masks(shape, number),
        "creation_datetime": "2022-03-04T05:06:07",
        "detector": "R22_S11",
        "physical_filter": "y_10",
    }
    return p.FringeTemplates(**(values | changes))


def observed(shape: tuple[int, int] = (3, 4), number: int = 1, **changes: Any) -> p.ObservedFrame:
    mask = masks(shape, number)
    values: dict[str, Any] = {
        "image": with_holes(2700 * (1 + pixels(shape, number)), mask, number, changes),
        "mask": mask,
        "variance": with_holes(2700 + pixels(shape, number + 1), mask, number, changes),
        "unit": "electron",
        "detector": "R22_S11",
        "physical_filter": "y_10",
    }
    return p.ObservedFrame(**(values | changes))


MAKERS: dict[str, Callable[..., Any]] = {
    "FringeFlat": flat,
    "FringeCube": cube,
    "ThicknessMap": thickness,
    "FringeFrame": frame,
    "FringeComponents": components,
    "SkyFringe": sky,
    "CombinedBias": bias,
    "FringeTemplates": templates,
    "ObservedFrame": observed,
}
