"""Response to a sky of a sensor that has other optics in places, such as a void in its adhesive."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import Float32Array, FloatArray
from ..effects import ActiveEffect, ImageGeometry
from ..model import FringeModel

if TYPE_CHECKING:
    from .sky_response import FrameTable, Response


def response_with_islands(model: FringeModel, respond: Callable[[FringeModel], Response]) -> Response:
    """Response of a sensor with its local effects where they are.

    ``respond``: ``(model) -> response``: what it would be if all of the sensor were like ``model``. Returns
    that of ``respond`` itself where no effect is local.
    """
    outside = respond(model)
    islands = tuple((item, respond(inside)) for item, inside in model.islands)
    return IslandResponse(model, outside, islands) if islands else outside


def parts_of(response: Response | None) -> tuple[Response, ...]:
    """What `response_with_islands` asked for, in its order."""
    if isinstance(response, IslandResponse):
        return (response.outside, *(inside for _, inside in response.islands))
    return () if response is None else (response,)


@dataclass(frozen=True, eq=False)
class IslandResponse:
    """Stands for a `SkyResponse` in `simulate_sky_frame`."""

    model: FringeModel
    outside: Response  # response outside local effects
    islands: tuple[tuple[ActiveEffect, Response], ...]  # local effects, each with the response where it is

    @property
    def component(self) -> tuple[str, ...]:
        """Names of the components of the sky."""
        return self.outside.component

    @property
    def bands(self) -> tuple[str, ...]:
        """Those that are OH bands."""
        return self.outside.bands

    @property
    def quadrature_error(self) -> float:
        """Estimated error of the sums over lines and angles, relative to the mean sky."""
        return max(each.quadrature_error for each in (self.outside, *(inside for _, inside in self.islands)))

    @property
    def airmass(self) -> float:
        """Airmass of the sky."""
        return self.outside.airmass

    def sky(self, scale: Mapping[str, float] | None = None) -> IslandTable:
        """Electrons s⁻¹ m⁻² arcsec⁻² over thickness, and over the sensor."""
        return IslandTable(
            self.model,
            self.outside.sky(scale),
            tuple((item, response.sky(scale)) for item, response in self.islands),
        )


@dataclass(frozen=True, eq=False)
class IslandTable:
    """Makes frames from thickness; attributes as of `IslandResponse`."""

    model: FringeModel
    outside: FrameTable
    islands: tuple[tuple[ActiveEffect, FrameTable], ...]

    @property
    def wavelength_nm(self) -> FloatArray:
        """Mean wavelength [nm], shape ``(1,)``."""
        return self.outside.wavelength_nm

    @property
    def interpolation_error(self) -> float:
        """Largest error of interpolation, in the units of the frame."""
        tables = (self.outside, *(inside for _, inside in self.islands))
        return max(table.interpolation_error for table in tables)

    def frame(self, thickness_um: ArrayLike) -> Float32Array:
        """Frame of a thickness map [µm] that covers the sensor, shape ``(ny, nx)``."""
        thickness = np.asarray(thickness_um)
        image = self.outside.frame(thickness)
        geometry = ImageGeometry.of_pixels((image.shape[0], image.shape[1]), self.wavelength_nm)
        for item, inside in self.islands:
            part = item.coverage(self.model.base_system, geometry)
            image = image + part.astype(np.float32) * (inside.frame(thickness) - image)
        return image
