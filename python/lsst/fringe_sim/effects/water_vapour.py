"""Water vapour in front of the lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..instrument.sky import SkySpectrum
from .base import Parameter, PlainNullEffect

__all__ = ["WaterVapour"]


class WaterVapour(PlainNullEffect):
    """More or less of the molecules that absorb lines, mostly water between 930 and 980 nm."""

    name = "water_vapour"
    title = "absorption of the lines by water vapour"
    acts_on = "spectrum"
    reference = "Noll et al. 2012, doi 10.1051/0004-6361/201219040 (sky model of Paranal, 2.5 mm of water)"
    parameters = (
        Parameter(
            "scale",
            "",
            1.0,
            (0.0, 8.0),
            0.5,
            "column over that of the line list",
            natural_bounds=(0.0,),
        ),
    )

    def change_sky(self, sky: SkySpectrum, values: Mapping[str, float]) -> SkySpectrum:
        """Raise the transmission of every line to a power."""
        return replace(sky, lines=replace(sky.lines, transmission=sky.lines.transmission ** values["scale"]))
