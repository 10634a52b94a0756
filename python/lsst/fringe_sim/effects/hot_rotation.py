"""OH that has not come to rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..instrument.sky import SECOND_RADIATION_CM_K, SkySpectrum
from .base import FloatArray, Parameter, PlainNullEffect
from .rotational_temperature import REFERENCE_K

__all__ = ["HotRotation"]

HOT_K = 1000.0


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

    def change_sky(self, sky: SkySpectrum, values: Mapping[str, float]) -> SkySpectrum:
        """Add the population in proportion to the cold one."""
        step = SECOND_RADIATION_CM_K * (1.0 / REFERENCE_K - 1.0 / HOT_K)

        def factor(energy_cm: FloatArray) -> FloatArray:
            # Beyond 2000 1/cm the list holds the hot population already.
            return np.asarray(1.0 + values["ratio"] * np.exp(step * np.minimum(energy_cm, 2000.0)))

        return replace(sky, lines=sky.lines.with_rotation(factor))
