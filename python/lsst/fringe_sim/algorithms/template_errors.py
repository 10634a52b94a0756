"""Numerical errors of the templates that a thickness is fitted with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..model import FringeModel
from .thickness_fit.fit import STEPS_PER_ORDER

SAMPLES = 257  # Thicknesses at which the errors are looked for; many to every fringe order


def template_errors(
    model: FringeModel,
    wavelength_nm: ArrayLike,
    range_um: tuple[float, float] | None = None,
    observable: str | None = None,
) -> tuple[float, float]:
    """Largest errors of the templates, as fractions of their mean.

    ``wavelength_nm`` (W,). ``range_um``: thicknesses that are searched; by default those of the set-up.
    ``observable`` {"detection", "total"}: what a pixel responds to; by default that of the model. Returns
    the change when the wavelength nodes are twice as dense, and the difference between the model and the
    straight line between two neighbouring thicknesses of the templates, half way between them.
    """
    wavelength = np.unique(np.asarray(wavelength_nm, dtype=float))
    if observable is not None:
        model = replace(model, base_system=replace(model.base_system, observable=observable))
    low, high = range_um or model.setup.thickness_range_um
    thickness = np.linspace(low, high, SAMPLES)
    half_step = 0.5 * float(np.mean(model.fringe_order_um(wavelength))) / STEPS_PER_ORDER
    here = model.response(thickness, wavelength)
    mean = here.mean(axis=1, keepdims=True)
    between = 0.5 * (
        model.response(thickness - half_step, wavelength) + model.response(thickness + half_step, wavelength)
    )
    quadrature = model.quadrature_error(wavelength, thickness) / float(mean.min())
    return quadrature, float(np.abs((here - between) / mean).max())
