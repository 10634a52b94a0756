"""Sources drawn into copies of a frame, and the fluxes and shapes found before and after a correction."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from ...array_types import BoolArray, Float32Array, FloatArray
from ...errors import InputError

POINT, EXTENDED = "point", "extended"

STAMP_FWHM = 6.0  # Side of the images of sources, in widths of the image of a star

QUANTITIES = ("", "e1_", "e2_", "size_")
"""What is measured, as columns of tables begin: the flux, two components of the ellipticity, the size."""


@dataclass(frozen=True)
class InjectionOptions:
    """Which sources are drawn, and how they are measured."""

    fwhm_arcsec: float = 0.8  # width of the image of a star [arcsec]
    # half-light radius of the exponential discs that stand for galaxies [arcsec]
    half_light_arcsec: float = 0.5
    signal_to_noise: tuple[float, ...] = (
        10.0,
        30.0,
        100.0,
    )  # fluxes, over the noise of the sky in the aperture
    number: int = 200  # most sources of each kind and flux
    seed: int = 1  # of the places


@dataclass(frozen=True, eq=False)
class Measured:
    """Sources of one kind and flux in one frame."""

    kind: str  # ``point`` or ``extended``
    flux: float  # what each has, in the unit of the frame
    # before, after: departures from what the source has, in the frame with its fringes and without: of the flux as
    # a part of it, of the two components of the ellipticity, of the size as a part of it. NaN where no shape is
    # found, ``(4, N)``
    before: FloatArray
    after: FloatArray


def inject_sources(
    image: Float32Array,
    free: BoolArray,
    noise: float,
    pixel_arcsec: float,
    correct: Callable[[Float32Array], tuple[Float32Array, Float32Array]],
    options: InjectionOptions | None = None,
) -> list[Measured]:
    """Draw sources into a copy of a frame, correct it anew, and measure them.

    ``image``: the frame with its fringes, which stays as it is, ``(ny, nx)``; ``free``: good pixels without
    objects, ``(ny, nx)``; ``noise``: standard deviation of a pixel; ``pixel_arcsec``: size of a pixel [arcsec];
    ``correct``: ``image -> (before, after)``: the frame less its smooth background, with and without fringes.
    Raises `InputError`: no place where a source would be alone. Fluxes are sums over a circle whose radius is the
    width of a star, less the mean of a ring around it, over the part of the flux that the same measurement finds of
    the source without noise. Shapes are adaptive moments (``hsm`` of GalSim; Hirata & Seljak 2003, MNRAS 343, 459,
    doi 10.1046/j.1365-8711.2003.06683.x) of the image less the same mean, compared with those of the source without
    noise. Noise of the sources themselves is not added: what scatters is the sky and its fringes.
    """
    chosen = options or InjectionOptions()
    sources = Source.of_all(chosen, pixel_arcsec)
    groups = [(source, snr) for source in sources for snr in chosen.signal_to_noise]
    side = stamp_side(chosen, pixel_arcsec)
    places = free_places(free, side, len(groups) * chosen.number, np.random.default_rng(chosen.seed))
    if len(places) < len(groups):
        raise InputError("free places for sources", len(places), f"{len(groups)} or more")
    crowded = image.copy()
    fluxes = [source.flux_at(snr, noise) for source, snr in groups]
    for number, ((source, _), flux) in enumerate(zip(groups, fluxes, strict=True)):
        for y, x in places[number :: len(groups)]:
            crowded[source.around(y, x)] += (flux * source.stamp).astype(np.float32)
    images = correct(crowded)
    found = []
    for number, ((source, _), flux) in enumerate(zip(groups, fluxes, strict=True)):
        own = places[number :: len(groups)]
        before, after = (
            np.stack([source.departure(each[source.around(y, x)], flux) for y, x in own], axis=1)
            for each in images
        )
        found.append(Measured(source.kind, flux, before, after))
    return found


def injection_table(name: str, measured: Sequence[Measured]) -> Table:
    """Bias and scatter of fluxes and shapes, by kind and magnitude: one row for each.

    Magnitudes are ``-2.5 log10`` of the flux in the unit of the frame; bias and scatter of fluxes and sizes are
    fractions. Shapes are those of sources that have one before and after.
    """
    rows: list[dict[str, Any]] = []
    for each in measured:
        row: dict[str, Any] = {
            "name": name,
            "kind": each.kind,
            "magnitude": -2.5 * math.log10(each.flux),
            "number": each.before.shape[1],
            "shapes": int(np.isfinite(each.before + each.after).all(axis=0).sum()),
        }
        rows.append(row | bias_columns({"before": each.before, "after": each.after}))
    return Table(rows)


def bias_columns(departures: Mapping[str, FloatArray]) -> dict[str, float]:
    """Bias with its error, and scatter, of all quantities of the sources that have them in all of several images.

    ``departures``: departures by the name of the image, which ends the names of the columns, ``(4, N)``.
    """
    known = np.logical_and.reduce([np.isfinite(each) for each in departures.values()])
    row = {}
    for item, quantity in enumerate(QUANTITIES):
        for when, values in departures.items():
            own = values[item, known[item]]
            scatter = float(np.std(own)) if own.size else math.nan
            row[f"{quantity}bias_{when}"] = float(np.mean(own)) if own.size else math.nan
            row[f"{quantity}bias_{when}_sigma"] = scatter / math.sqrt(max(own.size, 1))
            row[f"{quantity}scatter_{when}"] = scatter
    return row


@dataclass(frozen=True, eq=False)
class Source:
    """A kind of source: its image of flux 1, and what is found of it without noise."""

    kind: str  # ``point`` or ``extended``
    stamp: FloatArray  # image in the middle of a square, ``(S, S)``
    _aperture: _Aperture
    _seen: FloatArray  # part of the flux in the aperture, two components of the ellipticity, size [px]

    @classmethod
    def of_all(cls, options: InjectionOptions, pixel_arcsec: float) -> list[Source]:
        """Point and extended source."""
        made = []
        for kind in (POINT, EXTENDED):
            stamp = _stamp(kind, options, pixel_arcsec)
            aperture = _Aperture.of(stamp.shape[0], options.fwhm_arcsec / pixel_arcsec)
            made.append(
                cls(kind, stamp, aperture, _measured(stamp, aperture, options.fwhm_arcsec / pixel_arcsec))
            )
        return made

    def flux_at(self, signal_to_noise: float, noise: float) -> float:
        """Flux whose part in the aperture is so much of the noise of the sky there."""
        return signal_to_noise * noise * math.sqrt(self._aperture.pixels) / float(self._seen[0])

    def around(self, y: int, x: int) -> tuple[slice, slice]:
        """Square about a pixel."""
        half = self.stamp.shape[0] // 2
        return slice(y - half, y + half + 1), slice(x - half, x + half + 1)

    def departure(self, image: NDArray[Any], flux: float) -> FloatArray:
        """Departures of what an image of the source shows from what it has, see `Measured`."""
        found = _measured(image, self._aperture, float(self._seen[3]))
        e1, e2 = found[1:3] - self._seen[1:3]
        return np.array([found[0] / (flux * self._seen[0]) - 1.0, e1, e2, found[3] / self._seen[3] - 1.0])


def _measured(image: NDArray[Any], aperture: _Aperture, size_px: float) -> FloatArray:
    """Flux, ellipticity and size of what is in the middle of a square; NaN for a shape that is not found."""
    import galsim

    sky = float(np.mean(image[aperture.ring], dtype=np.float64))
    flux = float(image[aperture.circle].sum(dtype=np.float64)) - aperture.pixels * sky
    drawn = galsim.Image(np.ascontiguousarray(image - sky, dtype=np.float64))
    moments = galsim.hsm.FindAdaptiveMom(drawn, guess_sig=size_px, strict=False)
    if moments.moments_status != 0:
        return np.array([flux, math.nan, math.nan, math.nan])
    shape = moments.observed_shape
    return np.array([flux, shape.e1, shape.e2, moments.moments_sigma])


def stamp_side(options: InjectionOptions, pixel_arcsec: float) -> int:
    """Side of the image of a source [px]."""
    return 2 * math.ceil(0.5 * STAMP_FWHM * options.fwhm_arcsec / pixel_arcsec) + 1


def _stamp(kind: str, options: InjectionOptions, pixel_arcsec: float) -> FloatArray:
    """Image of a source of flux 1 in the middle of a square."""
    import galsim

    star = galsim.Moffat(beta=3.0, fwhm=options.fwhm_arcsec)
    profile = star
    if kind == EXTENDED:
        profile = galsim.Convolve(star, galsim.Exponential(half_light_radius=options.half_light_arcsec))
    side = stamp_side(options, pixel_arcsec)
    drawn = profile.drawImage(nx=side, ny=side, scale=pixel_arcsec)
    return np.asarray(drawn.array, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Aperture:
    """Circle and ring about the middle of a square."""

    circle: BoolArray
    ring: BoolArray

    @classmethod
    def of(cls, side: int, fwhm_px: float) -> _Aperture:
        half = side // 2
        away = np.hypot(*np.mgrid[-half : half + 1, -half : half + 1])
        return cls(away <= fwhm_px, away > 2.0 * fwhm_px)

    @property
    def pixels(self) -> int:
        return int(np.count_nonzero(self.circle))


def free_places(free: BoolArray, side: int, most: int, rng: np.random.Generator) -> list[tuple[int, int]]:
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
