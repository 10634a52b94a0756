"""Effects on the spectrum of the night sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..instrument.sky import SECOND_RADIATION_CM_K, SkySpectrum
from .base import FloatArray, Parameter, PlainNullEffect, SearchHints, Values

__all__ = ["HotRotation", "OHBands", "RotationalTemperature", "SkyContinuum", "WaterVapour"]

REFERENCE_K, HOT_K = 190.0, 1000.0
"""Rotational temperature of the low levels in the line list, from which departures count, and of the hot ones."""

BANDS = ("7-3", "8-4", "3-0", "9-5", "4-1", "5-2")
"""Bands of OH that matter in the y band. A factor common to all is one of the level."""


class RotationalTemperature(PlainNullEffect):
    """Rotational levels are populated as in warmer or colder air; every band keeps its photons."""

    name = "rotational_temperature"
    title = "rotational temperature of OH"
    acts_on = "spectrum"
    reference = "Noll et al. 2025, Geosci. Model Dev. 18, 4353 (PALACE: 190-200 K, +-20 K through a night)"
    parameters = (
        Parameter("offset", "K", 0.0, (-80.0, 200.0), 15.0, "departure from the 190 K of the line list"),
    )

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Multiply populations by the ratio of two Boltzmann factors."""
        colder = SECOND_RADIATION_CM_K * (1.0 / REFERENCE_K - 1.0 / (REFERENCE_K + values["offset"]))
        return replace(sky, lines=sky.lines.with_rotation(lambda energy: np.exp(colder * energy)))


class HotRotation(PlainNullEffect):
    """A second rotational population of 1000 K, which fills levels that cold air leaves empty."""

    name = "hot_rotation"
    title = "hot rotational population of OH"
    acts_on = "spectrum"
    reference = "Oliva et al. 2015, doi 10.1051/0004-6361/201526291 (hot OH in the nightglow)"
    parameters = (
        Parameter(
            "ratio",
            "",
            0.0,
            (0.0, 1.0),
            0.01,
            "size over that of the cold one, at zero rotational energy, added",
        ),
    )

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Add the population in proportion to the cold one."""
        step = SECOND_RADIATION_CM_K * (1.0 / REFERENCE_K - 1.0 / HOT_K)

        def factor(energy_cm: FloatArray) -> FloatArray:
            # Beyond 2000 1/cm the list holds the hot population already.
            return np.asarray(1.0 + values["ratio"] * np.exp(step * np.minimum(energy_cm, 2000.0)))

        return replace(sky, lines=sky.lines.with_rotation(factor))


class OHBands(PlainNullEffect):
    """Vibrational levels are populated otherwise: every band is brighter or fainter."""

    name = "oh_bands"
    title = "strengths of the OH bands"
    acts_on = "spectrum"
    reference = "Guo, Walter, Lage & Lupton 2022, section 4.1 (bands change through a night)"
    parameters = tuple(
        Parameter(f"band_{band.replace('-', '_')}", "", 1.0, (0.0, 10.0), 0.2, f"factor on the band {band}")
        for band in BANDS
    )
    search = SearchHints(natural_bounds=(0.0,))

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Multiply the bands that the sky has."""
        factors = {
            band: values[parameter.name] for band, parameter in zip(BANDS, self.parameters, strict=True)
        }
        there = set(sky.lines.bands)
        return replace(
            sky, lines=sky.lines.scaled({band: factor for band, factor in factors.items() if band in there})
        )


class SkyContinuum(PlainNullEffect):
    """All light without lines is brighter or fainter; it has nearly no fringes and dilutes those of the lines."""

    name = "sky_continuum"
    title = "level of the sky continuum"
    acts_on = "spectrum"
    reference = (
        "Noll et al. 2025, Geosci. Model Dev. 18, 4353: the airglow continuum varies by tens of per cent"
    )
    parameters = (Parameter("scale", "", 1.0, (0.0, 20.0), 0.3, "factor on all terms of the continuum"),)
    search = SearchHints(natural_bounds=(0.0,))

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Multiply every term."""
        terms = tuple(
            replace(term, photon_radiance=values["scale"] * term.photon_radiance) for term in sky.continua
        )
        return replace(sky, continua=terms)


class WaterVapour(PlainNullEffect):
    """More or less of the molecules that absorb lines, mostly water between 930 and 980 nm."""

    name = "water_vapour"
    title = "absorption of the lines by water vapour"
    acts_on = "spectrum"
    reference = "Noll et al. 2012, doi 10.1051/0004-6361/201219040 (sky model of Paranal, 2.5 mm of water)"
    parameters = (Parameter("scale", "", 1.0, (0.0, 8.0), 0.5, "column over that of the line list"),)
    search = SearchHints(natural_bounds=(0.0,))

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Raise the transmission of every line to a power."""
        return replace(sky, lines=replace(sky.lines, transmission=sky.lines.transmission ** values["scale"]))
