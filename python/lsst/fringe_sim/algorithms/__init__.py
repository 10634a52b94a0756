"""Fit, simulate, decompose and criticise: arrays in, arrays out.

The public functions are imported on first use, because some of them bring heavy libraries along.
"""

from __future__ import annotations

from ..lazy import homes, on_first_use

_LAZY = homes(
    discovery="discover",
    flat_plan="forecast_flats rank_flats recommend_flats",
    flat_prep="combine_biases prepare_flat",
    fringe_correction="correct_fringes",
    image_correlation="coadd_correlation",
    pca="fit_pca",
    single_pixel="fit_single_pixel",
    sky_frame="simulate_sky_frame",
    thickness_fit="fit_thickness",
)

__all__ = sorted(_LAZY)  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__ = on_first_use(__name__, _LAZY)
