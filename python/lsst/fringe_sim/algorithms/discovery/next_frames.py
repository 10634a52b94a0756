"""Which further data would tell effects apart that frames of the night sky have left in one class.

As for flats (`next_measurement`), but at the cells, the map and the noise of the search itself: further frames share
the thickness with those that are there; flats of the laboratory have levels and a thickness of their own, and their
information adds up with that of the sky. What belongs to the sky leaves flats as they are: flats that show nothing
decide as well.
"""

from __future__ import annotations

import math

from ...array_types import FloatArray
from ...model import FringeModel, Setup, setup_names
from ..inference import solved
from ..next_measurement import FlatMeasurement, FlatSeries


def pair_of(information: FloatArray, own: slice) -> tuple[float, float]:
    """Likeness of the effect and another one, and the standard deviations by which the other fits worse."""
    difference, tangent = own.start, slice(own.start + 1, own.stop)
    cross = information[tangent, difference]
    moved = float(cross @ solved(information[tangent, tangent], cross))
    left = max(float(information[difference, difference]) - moved, 0.0)
    strength = float(information[0, 0])
    likeness = math.sqrt(max(1.0 - left / strength, 0.0)) if strength > 0.0 else math.nan
    return likeness, math.sqrt(left)


def laboratory_of(setup: Setup) -> Setup | None:
    """Set-up of a laboratory with the sensor of another set-up, that with most wavelengths; `None` without one."""
    shipped = [Setup.from_name(name) for name in setup_names()]
    own = [
        each
        for each in shipped
        if each.kind == "monochromator" and each.varying == setup.varying and each.stack == setup.stack
    ]
    return max(own, key=lambda each: len(each.wavelengths_nm), default=None)


def laboratory_flats(model: FringeModel) -> list[tuple[FlatMeasurement, FringeModel]]:
    """Flats that the laboratory of a sensor on the sky would take of it, and its model there; none without one."""
    setup = laboratory_of(model.setup)
    if setup is None:
        return []
    series = FlatSeries(setup.wavelengths_nm)
    title = f"{len(series.wavelength_nm)} laboratory flats of {series.level_e:.0f} electrons ({setup.name})"
    settings = {
        f"{item.effect.name}.{key}": value
        for item in model.effects
        if not (item.effect.laboratory_only or item.effect.sky_only)
        for key, value in item.values.items()
    }
    return [(FlatMeasurement("laboratory", title, series), FringeModel.from_setup(setup, settings))]
