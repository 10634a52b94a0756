"""Names by which commands and tasks choose how the thickness is fitted; apart from the fit, which is compiled."""

from __future__ import annotations

FIT_METHODS = ("global", "guo2022")

SILICON_FIELDS = {"sensor": 0, "plane": 1, "paraboloid": 2}
"""Degree of the polynomial over the sensor, by its name."""

ZONES = ("sensor", "halves", "amplifiers")
"""Areas with a level of their own: all, upper and lower half, or 8 by 2 amplifiers."""

CONTRASTS = ("fixed", "common", "wavelength")
"""Contrast as the model has it, one factor for all wavelengths, or one for each."""
