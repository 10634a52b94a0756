"""Light of a flat field: white, a lamp of one colour, or a measured spectrum."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..array_types import FloatArray
from ..errors import InputError, OutOfRangeError, named_units, to_number
from ..resources import read_user_table
from .sky import SpectralComponent

if TYPE_CHECKING:  # filters take time to import, and effects do without
    from .bandpass import Bandpass

STEP_NM = 0.2  # Spacing of the wavelengths that stand for white light [nm]
NODES = 160  # Least number of wavelengths that stand for the light of a lamp
REACH = 4.0  # Standard deviations to which a Gaussian lamp shines

SIGMA_PER_FWHM = 1.0 / math.sqrt(8.0 * math.log(2.0))


@named_units
@dataclass(frozen=True, eq=False)
class FlatSpectrum:
    """Light of the flat field by which frames are divided; the fringes that it has are printed into them."""

    name: str = "white"  # what it is, as for `from_name`
    # wavelength_nm, photons: (K,): photons per nm of a lamp in front of the filter, up to a factor, linear
    # between these wavelengths [nm] and 0 beyond; empty for white light
    wavelength_nm: FloatArray = field(default_factory=lambda: np.zeros(0))
    photons: FloatArray = field(default_factory=lambda: np.zeros(0))
    share: float = 0.0  # part of the light behind the filter that is the lamp's; the rest is white

    def __post_init__(self) -> None:
        if not 0.0 <= self.share <= 1.0:
            raise OutOfRangeError("share of the lamp in the flat field", self.share, "0 to 1")
        wave = self.wavelength_nm
        if self.share and not (wave.size > 1 and (np.diff(wave) > 0.0).all() and (self.photons >= 0.0).all()):
            allowed = "two or more increasing wavelengths, photons that are not negative"
            raise InputError("spectrum of the flat field", self.name, allowed)

    @classmethod
    @named_units
    def gaussian(cls, mean_nm: float, fwhm_nm: float, share: float = 1.0) -> FlatSpectrum:
        """A lamp, LED or laser with a Gaussian line; ``share`` is its part of the light."""
        if not (100.0 < mean_nm < 3000.0 and 0.0 < fwhm_nm < 1000.0):
            allowed = "mean from 100 to 3000, width from 0 to 1000, exclusive"
            raise OutOfRangeError("mean and width of the flat field [nm]", (mean_nm, fwhm_nm), allowed)
        away = np.linspace(-REACH, REACH, NODES + 1)
        wave = mean_nm + SIGMA_PER_FWHM * fwhm_nm * away
        return cls(f"gaussian:{mean_nm:g}:{fwhm_nm:g}", wave, np.exp(-0.5 * away**2), share)

    @classmethod
    def from_name(cls, name: str) -> FlatSpectrum:
        """``white``, ``gaussian:MEAN:FWHM`` [nm], or an ECSV table of ``wavelength`` [nm] and ``photons``."""
        if name == "white":
            return cls()
        if name.startswith("gaussian:"):
            numbers = name.split(":")[1:]
            if len(numbers) != 2:
                raise InputError("spectrum of the flat field", name, "gaussian:MEAN:FWHM in nm")
            mean, fwhm = (to_number("spectrum of the flat field", each) for each in numbers)
            return cls.gaussian(mean, fwhm)
        if not Path(name).is_file():
            raise InputError(
                "spectrum of the flat field", name, "white, gaussian:MEAN:FWHM in nm, or a table"
            )
        table = read_user_table(name, "spectrum of the flat field")
        missing = [column for column in ("wavelength", "photons") if column not in table.colnames]
        if missing:
            raise InputError("columns of the flat field", table.colnames, "wavelength, photons", source=name)
        wave, photons = (np.asarray(table[key], dtype=float) for key in ("wavelength", "photons"))
        return cls(Path(name).name, wave, photons, 1.0)

    def component(self, bandpass: Bandpass) -> SpectralComponent:
        """The light behind the filter, 1 in all."""
        low, high = bandpass.support()
        wave, photons = [], []
        if self.share < 1.0:
            count = math.ceil((high - low) / STEP_NM)
            wave.append(low + (np.arange(count) + 0.5) * (high - low) / count)
            passed = bandpass.transmission(wave[-1])
            photons.append((1.0 - self.share) * passed / passed.sum())
        if self.share > 0.0:
            first, last = max(low, float(self.wavelength_nm[0])), min(high, float(self.wavelength_nm[-1]))
            count = max(NODES, math.ceil((last - first) / STEP_NM))
            wave.append(first + (np.arange(count) + 0.5) * (last - first) / count)
            passed = bandpass.transmission(wave[-1]) * np.interp(wave[-1], self.wavelength_nm, self.photons)
            if not (last > first and passed.sum() > 0.0):
                raise InputError(
                    "spectrum of the flat field", self.name, f"light from {low:g} to {high:g} nm"
                )
            photons.append(self.share * passed / passed.sum())
        order = np.argsort(np.concatenate(wave), kind="stable")
        return SpectralComponent("flat field", np.concatenate(wave)[order], np.concatenate(photons)[order])
