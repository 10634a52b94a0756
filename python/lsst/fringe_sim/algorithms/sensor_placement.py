"""Where the pixels of a sensor lie in the field of a telescope."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..instrument.detector import Detector
from ..products import SensorSection


@dataclass(frozen=True)
class SensorPlacement:
    """Where the pixels of a sensor lie in the field."""

    # field_x_deg, field_y_deg: field angle of the centre
    field_x_deg: float
    field_y_deg: float
    # width_deg, height_deg: extent along columns and along rows; negative where the pixels are counted
    # the other way round
    width_deg: float
    height_deg: float
    yaw_deg: float = 0.0  # rotation of the sensor in the focal plane

    @classmethod
    def of(
        cls, detector: Detector, pixel_scale_arcsec: float, section: SensorSection | None = None
    ) -> SensorPlacement:
        """Placement of a sensor of a camera, or of a part of it; on the axis where the camera states no angles."""
        seen = SensorSection.whole(detector) if section is None else section
        scale = pixel_scale_arcsec / 3600.0
        on_axis = math.isnan(detector.field_radius_deg)
        rows, columns = detector.shape
        x, y = (
            scale * 0.5 * (first + last + 1 - size)
            for (first, last), size in ((seen.x, columns), (seen.y, rows))
        )
        width, height = (
            scale * math.copysign(abs(last - first) + 1, last - first) for first, last in (seen.x, seen.y)
        )
        turn = math.radians(detector.yaw_deg)
        return cls(
            (0.0 if on_axis else detector.field_x_deg) + math.cos(turn) * x - math.sin(turn) * y,
            (0.0 if on_axis else detector.field_y_deg) + math.sin(turn) * x + math.cos(turn) * y,
            width,
            height,
            detector.yaw_deg,
        )

    def plane(self, shape: tuple[int, int]) -> FloatArray:
        """Field angles as a linear function of pixel indices, for a map of any shape that covers the sensor.

        Returns (2, 3): rows for x and y; ``angle = plane @ (1, column, row)`` [deg].
        """
        turn = math.radians(self.yaw_deg)
        along = np.array([math.cos(turn), math.sin(turn)]) * self.width_deg / shape[1]
        across = np.array([-math.sin(turn), math.cos(turn)]) * self.height_deg / shape[0]
        centre = np.array([self.field_x_deg, self.field_y_deg])
        corner = centre - 0.5 * (shape[1] - 1) * along - 0.5 * (shape[0] - 1) * across
        return np.stack([corner, along, across], axis=1)

    def radius_deg(self, shape: tuple[int, int]) -> FloatArray:
        """Field radius of every pixel of a map that covers the sensor [deg], ``shape``."""
        return self.radius_at_deg(shape, np.arange(shape[0]), np.arange(shape[1]))

    def radius_at_deg(self, shape: tuple[int, int], rows: ArrayLike, columns: ArrayLike) -> FloatArray:
        """Field radius on a grid of rows and columns of such a map [deg], shape ``(rows, columns)``."""
        y, x = np.asarray(rows, dtype=float)[:, None], np.asarray(columns, dtype=float)[None, :]
        return np.asarray(np.hypot(*(line[0] + line[1] * x + line[2] * y for line in self.plane(shape))))

    @property
    def radius_range_deg(self) -> tuple[float, float]:
        """Smallest and largest field radius on the sensor [deg]."""
        turn = math.radians(-self.yaw_deg)
        x = math.cos(turn) * self.field_x_deg - math.sin(turn) * self.field_y_deg
        y = math.sin(turn) * self.field_x_deg + math.cos(turn) * self.field_y_deg
        half = 0.5 * abs(self.width_deg), 0.5 * abs(self.height_deg)
        near = math.hypot(max(abs(x) - half[0], 0.0), max(abs(y) - half[1], 0.0))
        return near, math.hypot(abs(x) + half[0], abs(y) + half[1])
