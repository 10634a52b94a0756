"""Fit, simulate, decompose and criticise: arrays in, arrays out.

The public functions are imported on first use, because some of them bring heavy libraries along.
"""

from __future__ import annotations

from ..lazy import on_first_use

_LAZY = {
    "coadd_correlation": ".image_correlation",
    "combine_biases": ".flat_prep",
    "correct_fringes": ".fringe_correction",
    "discover": ".discovery",
    "fit_pca": ".pca",
    "fit_single_pixel": ".single_pixel",
    "fit_thickness": ".thickness_fit",
    "forecast_flats": ".flat_plan",
    "prepare_flat": ".flat_prep",
    "rank_flats": ".flat_plan",
    "recommend_flats": ".flat_plan",
    "simulate_sky_frame": ".sky_frame",
}

__all__ = sorted(_LAZY)  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__ = on_first_use(__name__, _LAZY)
