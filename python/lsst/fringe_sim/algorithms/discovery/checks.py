"""Whether data can answer at all, and agree with what is known of them."""

from __future__ import annotations

import numpy as np

from ...array_types import FloatArray
from ...errors import InputError
from ...model import FringeModel
from ...products.fringe_cube import FringeCube

FARTHEST_K, SAME_K = 5.0, 0.5
"""How far the temperature of flats may be from that of the set-up, and how far it is taken to be the same [K]."""

FEWEST_ROWS = 6  # Rows and columns of cells from which on noise and levels can be measured

FEWEST_OF_A_MEAN = 500
"""Pixels in fewer rows or columns than that from which on their mean is about that of a fringe."""


def check_setup(cube: FringeCube, model: FringeModel) -> None:
    """Refuse data that contradict the set-up."""
    if model.setup.kind != "monochromator":
        raise InputError("set-up", model.setup.name, "a laboratory set-up with a monochromator")
    rows = cube.exposures
    known = {item.effect.name for item in model.effects}
    stated = model.base_system.temperature_k
    if np.any(np.abs(rows.temperature_k - stated) > FARTHEST_K) and "temperature" not in known:
        allowed = f"within {FARTHEST_K:g} of the set-up's {stated:g}, or with the effect temperature.kelvin"
        farthest = rows.temperature_k[np.abs(rows.temperature_k - stated).argmax()]
        raise InputError("temperature of the flats [K]", float(farthest), allowed)
    width = model.setup.bandwidth_fwhm_nm
    measured = rows.bandwidth_fwhm_nm[rows.bandwidth_fwhm_nm > 0.0]
    if np.any(np.abs(measured - width) > 0.02 * width) and "bandwidth" not in known:
        raise InputError("bandwidth FWHM [nm]", rows.bandwidth_fwhm_nm.tolist(), f"the set-up's {width:g}")
    single = model.base_system.beam.theta.size == 1
    if single and np.any(np.isfinite(rows.f_number)) and "converging_beam" not in known:
        raise InputError("f_number", rows.f_number.tolist(), "infinite: the set-up's light is parallel")


def headers_apart(cube: FringeCube, model: FringeModel) -> tuple[str, ...]:
    """What the flats say of the laboratory and the model does not follow, for the verdict."""
    stated, temperature = model.base_system.temperature_k, cube.exposures.temperature_k
    known = any(item.effect.name == "temperature" for item in model.effects)
    if known or not np.any(np.abs(temperature - stated) > SAME_K):
        return ()
    return (
        f"the flats state {_span(temperature)} K, the model has the set-up's {stated:g} K; to believe the flats, "
        f"set the effect temperature.kelvin",
    )


def _span(values: FloatArray) -> str:
    """A number, or the smallest and the largest of several."""
    low, high = float(values.min()), float(values.max())
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def are_few(shape: tuple[int, ...], pixels: int) -> bool:
    """Whether the mean of so many good pixels in rows and columns is not about that of a fringe."""
    return min(shape) < FEWEST_ROWS and pixels < FEWEST_OF_A_MEAN


def why_too_poor(cube: FringeCube, model: FringeModel) -> str:
    """Why these data cannot answer, or nothing."""
    good = (np.asarray(cube.mask) == 0).reshape(cube.shape[0], -1)
    pixels = int(good.any(axis=0).sum())
    if pixels == 0:
        return "no good pixel"
    dark = [f"{cube.wavelength_nm[k]:g} nm" for k in range(cube.shape[0]) if not good[k].any()]
    if dark:
        return f"no good pixel at {', '.join(dark)}"
    constant = [
        f"{cube.wavelength_nm[k]:g} nm"
        for k in range(cube.shape[0])
        if pixels > 1 and float(np.ptp(np.asarray(cube.image[k]).reshape(-1)[good[k]])) == 0.0
    ]
    if constant:
        return f"the frame is constant at {', '.join(constant)}: no fringes and no noise, so not data"
    if cube.unit == "electron" and are_few(cube.shape[1:], pixels):
        return (
            f"{pixels} pixel(s) in electrons: their mean is not the level of the flats; give counts relative to the "
            "mean of the whole sensor, or more pixels"
        )
    waves = int(np.unique(cube.wavelength_nm).size)
    if cube.thickness is None:
        if waves < 3:
            return (
                f"{waves} wavelength(s) without a thickness map: thickness and effects cannot be told apart"
            )
        if pixels < 8 and waves < 6:
            return f"{pixels} pixel(s) at {waves} wavelengths: fewer data than free parameters"
    elif pixels < 16 and waves < 4:
        return f"{pixels} pixel(s) at {waves} wavelength(s): fewer data than free parameters"
    return ""
