"""Lines of a monochromator as nodes and weights."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from ..array_types import FloatArray

LINE_STEP_NM = 0.03
"""Spacing of wavelength nodes [nm]: fifteen per fringe of detection layer and support together."""

LINE_REACH = 6.0
"""Half width of the sampled Gaussian line in standard deviations; 2e-9 of the light is left out."""

LORENTZIAN_REACH = 10.0
"""Full widths at half maximum after which a Lorentzian line is cut off: 3 % of an endless one lie beyond."""


def _gaussian_line(fwhm_nm: float, step_nm: float) -> tuple[FloatArray, FloatArray]:
    """Offsets [nm] and weights; equidistant nodes, exponentially convergent for a Gaussian."""
    sigma = fwhm_nm / math.sqrt(8.0 * math.log(2.0))
    count = max(40, math.ceil(LINE_REACH * sigma / step_nm))
    offset: FloatArray = np.arange(-count, count + 1, dtype=float) * (LINE_REACH * sigma / count)
    weight = np.exp(-0.5 * (offset / sigma) ** 2)
    return offset, weight / weight.sum()


def _triangular_line(fwhm_nm: float, step_nm: float) -> tuple[FloatArray, FloatArray]:
    """Offsets [nm] and weights; Gauss–Legendre on either flank."""
    count = max(20, math.ceil(fwhm_nm / step_nm))
    x, w = np.polynomial.legendre.leggauss(count)
    flank = 0.5 * (x + 1.0)
    offset = fwhm_nm * np.concatenate([flank - 1.0, flank])
    weight = np.concatenate([w * flank, w * (1.0 - flank)])
    return offset, weight / weight.sum()


def _lorentzian_line(fwhm_nm: float, step_nm: float) -> tuple[FloatArray, FloatArray]:
    """Offsets [nm] and weights; equal parts of the light, up to ten times the width."""
    reach = math.atan(2.0 * LORENTZIAN_REACH)
    count = math.ceil(2.0 * reach * LORENTZIAN_REACH * fwhm_nm / step_nm)
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * fwhm_nm * np.tan(reach * x), 0.5 * w


LINE_SHAPES: Mapping[str, Callable[[float, float], tuple[FloatArray, FloatArray]]] = MappingProxyType(
    {"gaussian": _gaussian_line, "triangular": _triangular_line, "lorentzian": _lorentzian_line}
)
