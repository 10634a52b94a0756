"""Sources drawn into copies of a frame, and what photometry finds of them before and after a correction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from ...errors import InputError

__all__ = ["InjectionOptions", "Measured", "inject_sources", "injection_table"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

POINT, EXTENDED = "point", "extended"

STAMP_FWHM = 6.0
"""Side of the images of sources, in widths of the image of a star."""


@dataclass(frozen=True)
class InjectionOptions:
    """Which sources are drawn, and how they are measured.

    Attributes
    ----------
    fwhm_arcsec : `float`
        Width of the image of a star [arcsec].
    half_light_arcsec : `float`
        Half-light radius of the exponential discs that stand for galaxies [arcsec].
    signal_to_noise : `tuple` [`float`, ...]
        Fluxes, over the noise of the sky in the aperture.
    number : `int`
        Most sources of each kind and flux.
    seed : `int`
        Of the places.
    """

    fwhm_arcsec: float = 0.8
    half_light_arcsec: float = 0.5
    signal_to_noise: tuple[float, ...] = (10.0, 30.0, 100.0)
    number: int = 200
    seed: int = 1


@dataclass(frozen=True, eq=False)
class Measured:
    """Sources of one kind and flux in one frame.

    Attributes
    ----------
    kind : `str`
        ``point`` or ``extended``.
    flux : `float`
        What each has, in the unit of the frame.
    before, after : `numpy.ndarray`, shape ``(N,)``
        Fluxes that are found in the frame with its fringes and without.
    """

    kind: str
    flux: float
    before: FloatArray
    after: FloatArray


def inject_sources(
    image: NDArray[np.float32],
    free: BoolArray,
    noise: float,
    pixel_arcsec: float,
    correct: Callable[[NDArray[np.float32]], tuple[NDArray[np.float32], NDArray[np.float32]]],
    options: InjectionOptions | None = None,
) -> list[Measured]:
    """Draw sources into a copy of a frame, correct it anew, and measure them.

    Parameters
    ----------
    image : `numpy.ndarray`, shape ``(ny, nx)``
        The frame with its fringes, which stays as it is.
    free : `numpy.ndarray` of `bool`, shape ``(ny, nx)``
        Good pixels without objects.
    noise : `float`
        Standard deviation of a pixel.
    pixel_arcsec : `float`
        Size of a pixel [arcsec].
    correct : callable
        ``image -> (before, after)``: the frame less its smooth background, with and without fringes.
    options : `InjectionOptions`, optional
        Sources.

    Raises
    ------
    InputError
        No place where a source would be alone.

    Notes
    -----
    Fluxes are sums over a circle whose radius is the width of a star, less the mean of a ring around it, over the
    part of the flux that the same measurement finds of the source without noise. Noise of the sources themselves is
    not added: what scatters is the sky and its fringes.
    """
    chosen = options or InjectionOptions()
    stars = {kind: _stamp(kind, chosen, pixel_arcsec) for kind in (POINT, EXTENDED)}
    aperture = _Aperture.of(stars[POINT].shape[0], chosen.fwhm_arcsec / pixel_arcsec)
    groups = [(kind, snr) for kind in stars for snr in chosen.signal_to_noise]
    places = _places(free, aperture.side, len(groups) * chosen.number, np.random.default_rng(chosen.seed))
    if len(places) < len(groups):
        raise InputError("free places for sources", len(places), f"{len(groups)} or more")
    crowded = image.copy()
    fluxes = []
    for number, (kind, snr) in enumerate(groups):
        seen = aperture.flux(stars[kind])
        flux = snr * noise * math.sqrt(aperture.pixels) / seen
        fluxes.append((flux, seen))
        for y, x in places[number :: len(groups)]:
            crowded[aperture.around(y, x)] += (flux * stars[kind]).astype(np.float32)
    images = correct(crowded)
    found = []
    for number, ((kind, _), (flux, seen)) in enumerate(zip(groups, fluxes, strict=True)):
        own = places[number :: len(groups)]
        before, after = (
            np.array([aperture.flux(each[aperture.around(y, x)]) / seen for y, x in own]) for each in images
        )
        found.append(Measured(kind, flux, before, after))
    return found


def injection_table(name: str, measured: Sequence[Measured]) -> Table:
    """Bias and scatter of the fluxes, by kind and magnitude: one row for each.

    Magnitudes are ``-2.5 log10`` of the flux in the unit of the frame; bias and scatter are fractions of the flux.
    """
    rows: list[dict[str, Any]] = []
    for each in measured:
        row: dict[str, Any] = {
            "name": name,
            "kind": each.kind,
            "magnitude": -2.5 * math.log10(each.flux),
            "number": each.before.size,
        }
        for when, values in (("before", each.before), ("after", each.after)):
            off = values / each.flux - 1.0
            row[f"bias_{when}"] = float(np.mean(off))
            row[f"bias_{when}_sigma"] = float(np.std(off) / math.sqrt(off.size))
            row[f"scatter_{when}"] = float(np.std(off))
        rows.append(row)
    return Table(rows)


def _stamp(kind: str, options: InjectionOptions, pixel_arcsec: float) -> FloatArray:
    """Image of a source of flux 1 in the middle of a square."""
    import galsim

    star = galsim.Moffat(beta=3.0, fwhm=options.fwhm_arcsec)
    profile = star
    if kind == EXTENDED:
        profile = galsim.Convolve(star, galsim.Exponential(half_light_radius=options.half_light_arcsec))
    half = math.ceil(0.5 * STAMP_FWHM * options.fwhm_arcsec / pixel_arcsec)
    side = 2 * half + 1
    drawn = profile.drawImage(nx=side, ny=side, scale=pixel_arcsec)
    return np.asarray(drawn.array, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Aperture:
    """Circle and ring about the middle of a square."""

    side: int
    circle: BoolArray
    ring: BoolArray

    @classmethod
    def of(cls, side: int, fwhm_px: float) -> _Aperture:
        half = side // 2
        away = np.hypot(*np.mgrid[-half : half + 1, -half : half + 1])
        return cls(side, away <= fwhm_px, away > 2.0 * fwhm_px)

    @property
    def pixels(self) -> int:
        return int(np.count_nonzero(self.circle))

    def around(self, y: int, x: int) -> tuple[slice, slice]:
        half = self.side // 2
        return slice(y - half, y + half + 1), slice(x - half, x + half + 1)

    def flux(self, stamp: NDArray[Any]) -> float:
        sky = float(np.mean(stamp[self.ring], dtype=np.float64))
        return float(stamp[self.circle].sum(dtype=np.float64)) - self.pixels * sky


def _places(free: BoolArray, side: int, most: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Middles of squares without a pixel that is not free, one in each cell of a grid, in random order."""
    cell = side + side // 2
    ny, nx = (size // cell for size in free.shape)
    corner = rng.integers(0, cell - side + 1, (ny, nx, 2))
    found = []
    for number in rng.permutation(ny * nx):
        row, column = divmod(int(number), nx)
        y, x = row * cell + corner[row, column, 0], column * cell + corner[row, column, 1]
        if free[y : y + side, x : x + side].all():
            found.append((int(y) + side // 2, int(x) + side // 2))
            if len(found) == most:
                break
    return found
