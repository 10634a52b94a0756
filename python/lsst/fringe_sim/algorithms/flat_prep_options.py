"""Choices of the flat preparation."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import OutOfRangeError, UnknownNameError
from ..notebook import OneLine

__all__ = ["DEFAULT_OPTIONS", "GAUSSIAN_MAD", "FlatPrepOptions"]

GAUSSIAN_MAD = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""


@dataclass(frozen=True, repr=False)
class FlatPrepOptions(OneLine):
    """Choices of the preparation; the defaults suit LSST sensors on a test stand.

    Attributes
    ----------
    overscan_method : {"median", "spline"}
        Level of the serial overscan: the median of each row, or a smooth curve through the rows.
    overscan_knots : `int`
        Intervals of that curve.
    overscan_skip : `int`
        Overscan columns and rows next to the imaging section that are left out: deferred charge.
    parallel_overscan : `bool`
        Whether what columns differ from each other in the parallel overscan is taken off.
    clip_sigma : `float`
        Rejection threshold in overscan and bias combination, in standard deviations.
    saturation_fraction : `float`
        Part of an amplifier's saturation level above which a pixel counts as saturated.
    max_saturated : `float`
        Largest part of saturated pixels with which a flat is still used.
    defect_sigma : `float`
        A pixel is a defect if it lies this many standard deviations of its noise beyond its neighbours.
    defect_fraction : `float`
        Least such departure, relative to the signal: what dust and pixel response may do.
    column_sigma, column_fraction : `float`
        The same for the mean of a column; its noise is measured between columns.
    edge_px : `int`
        Border of the sensor that is masked [px].
    midline_px : `int`
        Rows on either side of the middle that are masked too: tearing and the midline implant [px].
    smoothing_sigma_px : `float`
        Standard deviation of the Gaussian kernel [px]; 0 for none. The paper's text speaks of a kernel of
        16 × 16 px, its published code uses 3 px.
    """

    overscan_method: str = "median"
    overscan_knots: int = 16
    overscan_skip: int = 5
    parallel_overscan: bool = True
    clip_sigma: float = 5.0
    saturation_fraction: float = 0.95
    max_saturated: float = 0.5
    defect_sigma: float = 5.0
    defect_fraction: float = 0.02
    column_sigma: float = 8.0
    column_fraction: float = 0.01
    edge_px: int = 10
    midline_px: int = 0
    smoothing_sigma_px: float = 3.0

    def __post_init__(self) -> None:
        if self.overscan_method not in ("median", "spline"):
            raise UnknownNameError("overscan_method", self.overscan_method, ("median", "spline"))
        limits: dict[str, tuple[float, float]] = {
            "overscan_knots": (1, 1000),
            "overscan_skip": (0, 1000),
            "clip_sigma": (1.0, 100.0),
            "saturation_fraction": (0.0, 1.0),
            "max_saturated": (0.0, 1.0),
            "defect_sigma": (3.0, 1e6),
            "defect_fraction": (0.0, 1.0),
            "column_sigma": (3.0, 1e6),
            "column_fraction": (0.0, 1.0),
            "edge_px": (0, 10_000),
            "midline_px": (0, 10_000),
            "smoothing_sigma_px": (0.0, 100.0),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise OutOfRangeError(name, getattr(self, name), f"{low:g} to {high:g}")


DEFAULT_OPTIONS = FlatPrepOptions()
"""What is used where nothing is chosen."""
