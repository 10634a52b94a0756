"""Effects on the spectrum of the night sky."""

from __future__ import annotations

from dataclasses import replace

from ..instrument.flat_spectrum import FlatSpectrum
from ..instrument.sky import SkySpectrum
from .base import Parameter, PlainNullEffect, SearchHints, Values

HOT_K = 1000.0  # Temperature of a hot population that is added to that of the line list [K]

_TWO_POPULATIONS = "Noll et al. 2020, doi 10.5194/acp-20-5269-2020 (two populations in every v')"

BANDS = ("7-3", "8-4", "3-0", "9-5", "4-1", "5-2")
"""Bands of OH that matter in the y band. A factor common to all is one of the level."""


class RotationalTemperature(PlainNullEffect):
    """The cold population of the rotational levels is as in warmer or colder air; the hot one stays.

    Every vibrational level keeps what it holds.
    """

    name = "rotational_temperature"
    title = "rotational temperature of OH"
    acts_on = "spectrum"
    reference = f"{_TWO_POPULATIONS}; Noll et al. 2025, doi 10.5194/gmd-18-4353-2025 (+-20 K in a night)"
    parameters = (
        Parameter(
            "offset", "K", 0.0, (-80.0, 200.0), 15.0, "departure from the temperature of the line list"
        ),
    )

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Warm the cold population."""
        offset = values["offset"]
        return replace(
            sky, lines=sky.lines.with_rotation(lambda levels: levels.warmed(levels.cold_k + offset))
        )


class HotRotation(PlainNullEffect):
    """The hot population of the rotational levels is larger or smaller, or one of 1000 K is added to it.

    Every vibrational level keeps what it holds; the cold population keeps its temperature.
    """

    name = "hot_rotation"
    title = "hot rotational population of OH"
    acts_on = "spectrum"
    reference = f"{_TWO_POPULATIONS}; Oliva et al. 2015, doi 10.1051/0004-6361/201526291 (hot OH)"
    parameters = (
        Parameter(
            "ratio", "", 0.0, (0.0, 1.0), 0.01, "added population of 1000 K, over the cold one at zero energy"
        ),
        Parameter("scale", "", 1.0, (0.0, 20.0), 0.5, "factor on the hot population of the line list"),
    )  # fmt: skip
    search = SearchHints(natural_bounds=(0.0,), refinements={"ratio": 1})

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Scale the hot population, and add to it."""
        return replace(
            sky,
            lines=sky.lines.with_rotation(
                lambda levels: levels.with_hot(values["scale"], values["ratio"], HOT_K)
            ),
        )


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


class FlatFringes(PlainNullEffect):
    """The flat field by which the frames are divided was lit by a lamp of one colour, and prints its fringes.

    The rest of its light is white.
    """

    name = "flat_fringes"
    title = "fringes of the flat field"
    acts_on = "spectrum"
    reference = "Howell 2012, PASP 124, 263 (fringes of flats with lamps of lines, and of the sky)"
    parameters = (
        Parameter(
            "share", "", 0.0, (0.0, 1.0), 0.3, "part of the light of the flat field that is the lamp's"
        ),
        Parameter("mean", "nm", 970.0, (700.0, 1100.0), 20.0, "mean wavelength of the lamp"),
        Parameter("fwhm", "nm", 40.0, (0.5, 120.0), 15.0, "full width of its line at half of its height"),
    )
    search = SearchHints(places=("mean", "fwhm"), natural_bounds=(0.0, 1.0))

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Divide by another flat field."""
        return replace(sky, flat=FlatSpectrum.gaussian(values["mean"], values["fwhm"], values["share"]))
