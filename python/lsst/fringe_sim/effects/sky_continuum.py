"""Light of the night sky between its lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ..instrument.sky import SkySpectrum
from .base import Parameter, PlainNullEffect

__all__ = ["SkyContinuum"]


class SkyContinuum(PlainNullEffect):
    """All light without lines is brighter or fainter; it has nearly no fringes and dilutes those of the lines."""

    name = "sky_continuum"
    title = "level of the sky continuum"
    acts_on = "spectrum"
    reference = (
        "Noll et al. 2025, Geosci. Model Dev. 18, 4353: the airglow continuum varies by tens of per cent"
    )
    parameters = (
        Parameter(
            "scale", "", 1.0, (0.0, 20.0), 0.3, "factor on all terms of the continuum", natural_bounds=(0.0,)
        ),
    )

    def change_sky(self, sky: SkySpectrum, values: Mapping[str, float]) -> SkySpectrum:
        """Multiply every term."""
        terms = tuple(
            replace(term, photon_radiance=values["scale"] * term.photon_radiance) for term in sky.continua
        )
        return replace(sky, continua=terms)
