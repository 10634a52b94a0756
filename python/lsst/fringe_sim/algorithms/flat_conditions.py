"""Headers of flats, believed or refused: the model that belongs to what they state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import InputError, OutOfRangeError
from ..model import FringeModel
from ..products import FlatExposures

SAME_K, FARTHEST_K = 0.5, 5.0
"""How far temperatures are taken to be the same, and how far those of flats of one series may be apart [K]."""
_SAME_WIDTH, _OTHER_UNIT = 0.02, 5.0
"""Relative difference of two widths of a line that are the same, and factor from which on one has another unit."""


def model_of_flats(model: FringeModel, exposures: FlatExposures) -> FringeModel:
    """The model at the temperature and the width of the line that the flats state.

    An effect on either of them wins over the headers.

    Returns the same model where the flats state what the set-up does.
    """
    known = {item.effect.name for item in model.effects}
    if "converging_beam" not in known:
        single = model.base_system.beam.theta.size == 1
        if single and np.any(np.isfinite(exposures.f_number)):
            raise InputError(
                "f_number", exposures.f_number.tolist(), "infinite: the set-up's light is parallel"
            )
    if "temperature" not in known:
        model = _at_temperature(model, exposures)
    return model if "bandwidth" in known else _with_line(model, exposures)


def _at_temperature(model: FringeModel, exposures: FlatExposures) -> FringeModel:
    stated, found = model.base_system.temperature_k, np.asarray(exposures.temperature_k, dtype=float)
    middle = float(np.median(found))
    if np.ptp(found) > FARTHEST_K:
        raise InputError(
            "temperature of the flats [K]",
            f"{found.min():g} to {found.max():g}",
            f"one within {FARTHEST_K:g}",
        )
    if abs(middle - stated) <= SAME_K:
        return model
    system = replace(model.base_system, temperature_k=middle)
    try:
        system.stack.indices(np.asarray(exposures.wavelength_nm, dtype=float), middle)
    except InputError as error:
        raise OutOfRangeError(
            "temperature of the flats [K]", middle, f"what the tables of the sensor cover ({error})"
        ) from error
    return replace(model, base_system=system)


def _with_line(model: FringeModel, exposures: FlatExposures) -> FringeModel:
    stated = model.setup.bandwidth_fwhm_nm
    widths = np.asarray(exposures.bandwidth_fwhm_nm, dtype=float)
    widths = widths[widths > 0.0]
    if widths.size == 0 or stated == 0.0:
        return model
    if widths.max() > _OTHER_UNIT * stated:
        raise OutOfRangeError(
            "bandwidth FWHM [nm]",
            float(widths.max()),
            f"near the set-up's {stated:g}; a header in ångström has to be divided by 10, and another line needs a "
            "set-up of its own or the effect bandwidth.fwhm",
        )
    if np.ptp(widths) > _SAME_WIDTH * stated or abs(widths.mean() - stated) <= _SAME_WIDTH * stated:
        return model
    setup = replace(model.setup, bandwidth_fwhm_nm=float(widths.mean()))
    return replace(model, setup=setup, base_system=replace(model.base_system, profile=setup.profile))
