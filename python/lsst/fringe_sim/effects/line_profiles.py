"""Shapes of a monochromator line besides those of the set-ups."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..errors import InputError, OutOfRangeError
from ..optics.illumination import DEFAULT_STEP_NM, GaussianProfile, SpectralProfile, TriangularProfile
from .base import FloatArray

_REACH = 10.0
_PANEL_NODES = 8


@dataclass(frozen=True)
class LorentzianProfile(SpectralProfile):
    """Lorentzian line, cut off at ten times its width: 3 % of an endless one lie beyond."""

    fwhm_nm: float  # full width at half maximum [nm]

    def nodes(self, step_nm: float = DEFAULT_STEP_NM) -> tuple[FloatArray, FloatArray]:
        """Composite Gauss-Legendre nodes; see `SpectralProfile.nodes`."""
        reach = _REACH * self.fwhm_nm
        # The line varies over its own width in the middle, the fringes need the step elsewhere.
        longest = min(_PANEL_NODES * step_nm, 0.5 * self.fwhm_nm)
        panels = 2 * math.ceil(reach / longest)
        edges = np.linspace(-reach, reach, panels + 1)
        x, w = np.polynomial.legendre.leggauss(_PANEL_NODES)
        half = 0.5 * (edges[1] - edges[0])
        place = (0.5 * (edges[1:] + edges[:-1])[:, None] + half * x).ravel()
        weight = np.tile(w, panels) / (1.0 + (2.0 * place / self.fwhm_nm) ** 2)
        return place, weight / weight.sum()


@dataclass(frozen=True)
class MixedProfile(SpectralProfile):
    """Light of two shapes about the same wavelength."""

    # first, second: the shapes
    first: SpectralProfile
    second: SpectralProfile
    share: float  # part of the light in the second, 0 to 1

    def __post_init__(self) -> None:
        if not 0.0 <= self.share <= 1.0:
            raise OutOfRangeError("share of the light", self.share, "0 to 1")

    def nodes(self, step_nm: float = DEFAULT_STEP_NM) -> tuple[FloatArray, FloatArray]:
        """Nodes of both; see `SpectralProfile.nodes`."""
        parts = [profile.nodes(step_nm) for profile in (self.first, self.second)]
        shares = (1.0 - self.share, self.share)
        place = np.concatenate([part[0] for part in parts])
        weight = np.concatenate([share * part[1] for share, part in zip(shares, parts, strict=True)])
        return place, weight


def line_width(profile: SpectralProfile, effect: str) -> float:
    """Full width at half maximum of a line, or of the first of the shapes that it is mixed from [nm].

    `InputError`: the profile has no width.
    """
    while isinstance(profile, MixedProfile):
        profile = profile.first
    if not isinstance(profile, GaussianProfile | TriangularProfile):
        raise InputError(
            f"effect {effect}", type(profile).__name__, "set-ups with a Gaussian or triangular line"
        )
    return profile.fwhm_nm
