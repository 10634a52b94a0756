"""Strengths of the bands of OH."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..instrument.sky import SkySpectrum
from .base import Parameter, PlainNullEffect

__all__ = ["OHBands"]

BANDS = ("7-3", "8-4", "3-0", "9-5", "4-1", "5-2")
"""Those that matter in the y band. A factor common to all is one of the level."""


class OHBands(PlainNullEffect):
    """Vibrational levels are populated otherwise: every band is brighter or fainter."""

    name = "oh_bands"
    title = "strengths of the OH bands"
    acts_on = "spectrum"
    reference = "Guo, Walter, Lage & Lupton 2022, section 4.1 (bands change through a night)"
    parameters = tuple(
        Parameter(
            f"band_{band.replace('-', '_')}",
            "",
            1.0,
            (0.0, 10.0),
            0.2,
            f"factor on the band {band}",
            natural_bounds=(0.0,),
        )
        for band in BANDS
    )

    def change_sky(self, sky: SkySpectrum, values: Mapping[str, float]) -> SkySpectrum:
        """Multiply the bands that the sky has."""
        factors = {
            band: values[parameter.name] for band, parameter in zip(BANDS, self.parameters, strict=True)
        }
        there = set(sky.lines.bands)
        return replace(
            sky, lines=sky.lines.scaled({band: factor for band, factor in factors.items() if band in there})
        )
