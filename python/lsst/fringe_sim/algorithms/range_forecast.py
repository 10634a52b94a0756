"""How many frames of the night sky would tell a thickness map of which nothing but a range is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, named_units
from ..products import ObservedFrame
from .fringe_correction import CorrectionOptions
from .map_on_sky import fringes_alone

__all__ = ["RangeForecast", "forecast_of_range", "frame_noise"]

STEPS_PER_ORDER = 24  # Thicknesses in one fringe order at which the sky is asked: 15 degrees of phase

PLANE_ORDERS = 0.125
"""What a layer may depart from a plane over a part of the sensor [orders]: 45 degrees of phase."""

CHANCE = 0.01  # Probability of a wrong answer with the frames that are stated


@named_units
@dataclass(frozen=True)
class RangeForecast:
    """Frames that would be needed, at the least.

    Attributes
    ----------
    fringe_rms : `float`
        Fringes of the dark sky, over the sky.
    noise : `float`
        Noise of a pixel in a frame, over its sky.
    orders : `float`
        Fringe orders within the range.
    part_px : `int`
        Side of the parts of the sensor over which the layer is a plane [px].
    to_see : `int`
        Frames after which the fringes of such a part stand out from all that noise could be taken for.
    to_tell_order : `int`
        Frames after which all pixels together tell in which order the layer is, if the model is right.
    sigma_um : `float`
        What one frame tells of the thickness of a part within its order, one standard deviation [µm].
    """

    fringe_rms: float
    noise: float
    orders: float
    part_px: int
    to_see: int
    to_tell_order: int
    sigma_um: float

    @property
    def frames(self) -> int:
        """Frames for both."""
        return max(self.to_see, self.to_tell_order)


@named_units
def forecast_of_range(
    predict: Callable[[FloatArray], ArrayLike],
    range_um: tuple[float, float],
    order_um: float,
    shape: tuple[int, int],
    pixels: int,
    noise: float,
) -> RangeForecast:
    """Frames without which no map is found from a range of its thickness.

    Parameters
    ----------
    predict : callable
        ``thickness_um -> light`` of the dark sky, up to one order beyond the range; any unit.
    range_um : `tuple` [`float`, `float`]
        Smallest and largest thickness [µm].
    order_um : `float`
        Thickness of one fringe order [µm].
    shape : `tuple` [`int`, `int`]
        Rows and columns of the frames.
    pixels : `int`
        Pixels of a frame that are good.
    noise : `float`
        Noise of a pixel over its sky.

    Raises
    ------
    OutOfRangeError
        A range of no extent, or a noise that is not positive.
    InputError
        No pixels.

    Notes
    -----
    The likelihood is that of `fit_sky_shift`: Gaussian, the strength of the fringes being free. A layer that goes
    through its range once, as a parabola does, is a plane over parts of the sensor; phase and slopes of a part are
    so many independent trials. Of two patterns whose squared distance is so many times the noise, the wrong one is
    likelier with the probability of a normal number beyond half the distance; the patterns of two waves lie apart by
    the squares of both, those of two orders by what one leaves of the other, over all pixels. All trials together are
    to go wrong with `CHANCE`. What the background takes of the fringes, and errors of the model,
    need more.
    """
    low, high = range_um
    if not 0.0 < low < high:
        raise OutOfRangeError("range of the thickness [um]", range_um, "two increasing, positive numbers")
    if not 0.0 < noise < math.inf:
        raise OutOfRangeError("noise of a pixel", noise, "positive")
    if pixels < 1:
        raise InputError("good pixels", pixels, "some")
    grid = np.arange(low, high + order_um, order_um / STEPS_PER_ORDER)
    light = np.asarray(predict(grid), dtype=float)
    light = light / light.mean() - 1.0
    inside = light[: max(2, round((high - low) / (order_um / STEPS_PER_ORDER)))]
    information = float(np.mean(np.square(np.gradient(light, grid)))) / noise**2
    orders, side = (high - low) / order_um, min(shape)
    part = max(1, min(side, round(side * math.sqrt(PLANE_ORDERS / orders))))
    # Waves of a part that fit into it, up to the steepest slope: twice the range over half a side.
    waves = max(1.0, math.pi * (4.0 * orders * part / side) ** 2)
    signal = part**2 * pixels / (shape[0] * shape[1]) * float(inside.var()) / noise**2
    apart = pixels * _apart(light) / noise**2
    return RangeForecast(
        float(inside.std()),
        noise,
        orders,
        part,
        math.ceil(_needed(2.0 * waves) / (2.0 * signal)),
        math.ceil(_needed(max(2.0, 2.0 * orders)) / max(apart, 1e-300)),
        1.0 / math.sqrt(part**2 * pixels / (shape[0] * shape[1]) * information),
    )


def frame_noise(frame: ObservedFrame, options: CorrectionOptions) -> tuple[float, int]:
    """Noise of a pixel of a frame over its sky, and pixels without objects and defects."""
    _, weight = fringes_alone(frame, [], options, frame.shape)
    used = weight[weight > 0.0]
    if not used.size:
        raise InputError("good pixels", 0, "some")
    return 1.0 / math.sqrt(float(np.median(used))), int(used.size)


def _needed(trials: float) -> float:
    """Squared distance over the noise at which none of so many trials is likelier, but by `CHANCE`."""
    return 4.0 * float(ndtri(CHANCE / trials)) ** 2


def _apart(light: FloatArray) -> float:
    """Mean square of the fringes that the same ones of the next order, whatever their strength, leave."""
    here, next_order = light[:-STEPS_PER_ORDER], light[STEPS_PER_ORDER:]
    here, next_order = here - here.mean(), next_order - next_order.mean()
    power = float(next_order @ next_order)
    scale = float(here @ next_order) / power if power > 0.0 else 0.0
    return float(np.mean(np.square(here - scale * next_order)))
