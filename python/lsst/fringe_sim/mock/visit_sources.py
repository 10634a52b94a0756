"""What a visit sees beside the fringes: stars, galaxies, moonlight, cosmic rays, saturation; and its image."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import galsim
import numpy as np
from astropy.wcs import WCS
from numpy.typing import NDArray

from ..array_types import BoolArray, ComplexArray, Float32Array, FloatArray
from ..errors import InputError
from ..instrument.bandpass import Bandpass
from ..instrument.detector import Detector
from ..instrument.readout import zero_point

MASK_PLANES = {"BAD": 0, "SAT": 1}  # Bits as Rubin's masks have them
CENTRE_DEG = (150.1, 2.2)  # Right ascension and declination about which the visits point

BRIGHTEST, COUNTED, FAINTEST = 13.0, 22.0, 24.0
"""Magnitudes: of the brightest source, down to which densities are given, and of the faintest source."""

STAR_SLOPE, GALAXY_SLOPE = 0.2, 0.4
"""Slopes of log counts with magnitude: stars near the galactic pole, galaxies brighter than their turnover."""

BLUR_OF_A_RAY_PX = 0.4  # Diffusion of the charge of a cosmic ray [px rms]
RAY_E_PER_UM = 80.0  # Charge that a minimum ionising particle leaves in silicon [e⁻ / µm]

STAMP_PX, STAMP_ARCSEC = 513, 102.6
"""Largest side of the image of a source, and of that of a bright star: GalSim's Fourier transform of a star over many
arcminutes does not fit into memory."""

MOST_SOURCES = 100_000  # In a visit: some twenty seconds. A whole sensor of the LSST has 18,000.

DTYPE = [("x", float), ("y", float), ("magnitude", float), ("electrons", float), ("galaxy", bool)]


@dataclass(frozen=True)
class VisitConditions:
    """What the visits of a night look like."""

    visits: int = 1  # number of visits
    # stars_per_arcmin2, galaxies_per_arcmin2: sources brighter than magnitude 22
    stars_per_arcmin2: float = 3.0
    galaxies_per_arcmin2: float = 5.0
    seeing_arcsec: tuple[float, float] = (0.6, 1.1)  # least and largest full width at half maximum of a star
    slope: float = 0.02  # rms of the relative slope of scattered light over the sensor, along either side
    amplifier_rms: float = 0.001  # rms relative error of the gains that is left
    cosmic_rays_per_s_cm2: float = 0.03  # tracks in each second and square centimetre
    # dither_arcsec, rotation_deg: rms of the pointing along either axis, and half the range of the angle of
    # the camera
    dither_arcsec: float = 15.0
    rotation_deg: float = 90.0
    hours: float = 8.0  # length of the night
    read_noise_e: float = 6.0  # read noise [e⁻ rms]
    moon: float = 0.5  # largest level of moonlight, relative to the dark sky


@dataclass(frozen=True)
class Pointing:
    """Where on the sky a visit looks; offsets from the centre of the field."""

    east_arcsec: float
    north_arcsec: float
    angle_rad: float
    scale_arcsec: float

    def pixels(
        self, east: FloatArray, north: FloatArray, shape: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        """Columns and rows of places on the sky [arcsec]."""
        dx, dy = (
            (east - self.east_arcsec) / self.scale_arcsec,
            (north - self.north_arcsec) / self.scale_arcsec,
        )
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return cos * dx + sin * dy + 0.5 * (shape[1] - 1), -sin * dx + cos * dy + 0.5 * (shape[0] - 1)

    def wcs(self, shape: tuple[int, int]) -> WCS:
        """The same as a projection of the sky."""
        found = WCS(naxis=2)
        found.wcs.ctype = ["RA---TAN", "DEC--TAN"]
        north = CENTRE_DEG[1] + self.north_arcsec / 3600.0
        east = CENTRE_DEG[0] + self.east_arcsec / 3600.0 / math.cos(math.radians(CENTRE_DEG[1]))
        found.wcs.crval, found.wcs.crpix = [east, north], [0.5 * (shape[1] + 1), 0.5 * (shape[0] + 1)]
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        found.wcs.cd = self.scale_arcsec / 3600.0 * np.array([[cos, -sin], [sin, cos]])
        return found


@dataclass(frozen=True, eq=False)
class Scene:
    """A patch of the sky that all visits see, and what a night is like."""

    conditions: VisitConditions
    scale_arcsec: float
    electrons_per_s_at_zero: float  # of magnitude 0
    east: FloatArray  # [arcsec]
    north: FloatArray
    magnitude: FloatArray
    radius_arcsec: FloatArray  # half-light radius; 0 of stars
    shear: ComplexArray

    @classmethod
    def draw(
        cls,
        light: Mapping[str, Any],
        conditions: VisitConditions,
        shape: tuple[int, int],
        rng: np.random.Generator,
    ) -> Scene:
        """Sources on a patch that is large enough for all pointings."""
        scale = float(light["pixel_scale_arcsec"])
        bandpass, area_m2 = Bandpass.from_name(str(light["bandpass"])), float(light["effective_area_m2"])
        half = _half_arcsec(scale, conditions, shape)
        area = (2.0 * half / 60.0) ** 2
        stars = _magnitudes(conditions.stars_per_arcmin2 * area, STAR_SLOPE, rng)
        galaxies = _magnitudes(conditions.galaxies_per_arcmin2 * area, GALAXY_SLOPE, rng)
        number = stars.size + galaxies.size
        east, north = rng.uniform(-half, half, (2, number))
        # Fainter galaxies are smaller: 0.5 arcsec at magnitude 22, with a scatter of a third.
        size = 0.5 * 10.0 ** (0.12 * (COUNTED - galaxies)) * np.exp(0.33 * rng.standard_normal(galaxies.size))
        shear = 0.25 * (rng.standard_normal(number) + 1j * rng.standard_normal(number))
        return cls(
            conditions,
            scale,
            10.0 ** (0.4 * zero_point(bandpass, area_m2, airmass=1.0)),
            east,
            north,
            np.concatenate([stars, galaxies]),
            np.concatenate([np.zeros(stars.size), np.clip(size, 0.1, 5.0)]),
            np.asarray(shear / np.maximum(1.0, np.abs(shear) / 0.6), dtype=np.complex128),
        )

    def pointing(self, rng: np.random.Generator) -> Pointing:
        """One of the pointings of the night."""
        east, north = self.conditions.dither_arcsec * np.clip(rng.standard_normal(2), -3.0, 3.0)
        turn = math.radians(self.conditions.rotation_deg)
        return Pointing(float(east), float(north), float(rng.uniform(-turn, turn)), self.scale_arcsec)


@dataclass(frozen=True, eq=False)
class VisitImage:
    """Pixels of a visit."""

    electrons: Float32Array
    mask: NDArray[np.int32]
    variance: Float32Array
    pointing: Pointing
    sources: NDArray[Any]

    @classmethod
    def expose(
        cls, scene: Scene, sky_e: Float32Array, sensor: Detector, seconds: float, rng: np.random.Generator
    ) -> VisitImage:
        """Put sources, disturbances and noise on the light of the sky."""
        night = scene.conditions
        pointing = scene.pointing(rng)
        light = sky_e + rng.uniform(0.0, night.moon) * np.float32(sky_e.mean())
        light *= _slope(sky_e.shape, night.slope, rng)
        sources = _draw_sources(light, scene, pointing, seconds, rng)
        charge = rng.poisson(light).astype(np.float32)
        _add_cosmic_rays(charge, sensor, night.cosmic_rays_per_s_cm2 * seconds, rng)
        variance = charge + np.float32(night.read_noise_e**2)
        saturated = np.zeros(charge.shape, dtype=bool)
        for amp in sensor.amplifiers:
            part = slice(amp.y0, amp.y0 + amp.height), slice(amp.x0, amp.x0 + amp.width)
            saturated[part] = _bleed(charge[part], amp.gain * amp.saturation)
            charge[part] *= np.float32(1.0 + night.amplifier_rms * rng.standard_normal())
        charge += np.float32(night.read_noise_e) * rng.standard_normal(charge.shape, dtype=np.float32)
        mask = np.where(saturated, np.int32(1 << MASK_PLANES["SAT"]), np.int32(0))
        return cls(charge, mask, variance, pointing, sources)


def expected_sources(light: Mapping[str, Any], conditions: VisitConditions, shape: tuple[int, int]) -> float:
    """Mean number of the sources that a night draws; `InputError` if they cannot be drawn in a reasonable time."""
    scale, widest = float(light["pixel_scale_arcsec"]), max(conditions.seeing_arcsec)
    if scale > widest:
        raise InputError(
            "pixel_scale_arcsec", scale, f"at most {widest:g}, the width of a star in bad seeing"
        )
    area = (2.0 * _half_arcsec(scale, conditions, shape) / 60.0) ** 2
    number = 0.0
    for density, slope in (
        (conditions.stars_per_arcmin2, STAR_SLOPE),
        (conditions.galaxies_per_arcmin2, GALAXY_SLOPE),
    ):
        low, high = _counts(slope)
        number += density * area * (high - low)
    if number > MOST_SOURCES:
        allowed = (
            f"at most {MOST_SOURCES}; {shape[1]} x {shape[0]} pixels of {scale:g} arcsec see "
            f"{area:.3g} square arcminutes: take fewer or smaller pixels, or fewer stars"
        )
        raise InputError("sources in a visit", round(number), allowed)
    return number


def _half_arcsec(scale_arcsec: float, conditions: VisitConditions, shape: tuple[int, int]) -> float:
    """Half of the side of a patch of the sky that holds all pointings."""
    return 0.5 * scale_arcsec * math.hypot(*shape) + 4.0 * conditions.dither_arcsec + 10.0


def _counts(slope: float) -> tuple[float, float]:
    """Sources up to the brightest and the faintest magnitude, relative to those up to `COUNTED`."""
    return 10.0 ** (slope * (BRIGHTEST - COUNTED)), 10.0 ** (slope * (FAINTEST - COUNTED))


def _magnitudes(bright: float, slope: float, rng: np.random.Generator) -> FloatArray:
    """Magnitudes of sources of which so many are brighter than `COUNTED`."""
    low, high = _counts(slope)
    number = rng.poisson(bright * (high - low))
    return np.asarray(COUNTED + np.log10(rng.uniform(low, high, number)) / slope)


def _slope(shape: tuple[int, ...], rms: float, rng: np.random.Generator) -> Float32Array:
    """Light that falls off slowly over the sensor, relative to its mean."""
    y, x = (np.linspace(-1.0, 1.0, number) for number in shape)
    along, across, curved = rms * rng.standard_normal(3)
    bend = curved * (x**2 + y[:, np.newaxis] ** 2 - 2.0 / 3.0)
    return (1.0 + along * x + across * y[:, np.newaxis] + bend).astype(np.float32)


def _draw_sources(
    light: Float32Array, scene: Scene, pointing: Pointing, seconds: float, rng: np.random.Generator
) -> NDArray[Any]:
    """Add all sources to an image; those whose centre lies on it are returned."""
    shape = light.shape[0], light.shape[1]
    image = galsim.Image(light, xmin=0, ymin=0)
    psf = _psf(scene.conditions, rng)
    turn = complex(np.exp(-2j * pointing.angle_rad))
    x, y = pointing.pixels(scene.east, scene.north, shape)
    electrons = seconds * scene.electrons_per_s_at_zero * 10.0 ** (-0.4 * scene.magnitude)
    reach = 0.5 * STAMP_PX
    near = (x > -reach) & (y > -reach) & (x < shape[1] + reach) & (y < shape[0] + reach)
    for number in np.flatnonzero(near):
        shear = complex(scene.shear[number]) * turn
        source = _source(psf, float(scene.radius_arcsec[number]), shear).withFlux(float(electrons[number]))
        _draw(source, image, float(x[number]), float(y[number]), scene.scale_arcsec)
    inside = (x > -0.5) & (y > -0.5) & (x < shape[1] - 0.5) & (y < shape[0] - 0.5)
    table = np.zeros(int(inside.sum()), dtype=DTYPE)
    columns = x, y, scene.magnitude, electrons, scene.radius_arcsec > 0.0
    for (name, _), column in zip(DTYPE, columns, strict=True):
        table[name] = column[inside]
    return table


def _psf(conditions: VisitConditions, rng: np.random.Generator) -> galsim.GSObject:
    """Star of a visit, of the atmosphere and a little elongated."""
    width = float(rng.uniform(*conditions.seeing_arcsec))
    e1, e2 = 0.02 * rng.standard_normal(2)
    return galsim.Kolmogorov(fwhm=width).shear(g1=float(e1), g2=float(e2))


def _source(psf: galsim.GSObject, radius_arcsec: float, shear: complex) -> galsim.GSObject:
    if not radius_arcsec:
        return psf
    disc = galsim.Exponential(half_light_radius=radius_arcsec).shear(g1=shear.real, g2=shear.imag)
    return galsim.Convolve(disc, psf)


def _draw(source: galsim.GSObject, image: galsim.Image, x: float, y: float, scale_arcsec: float) -> None:
    side = min(source.getGoodImageSize(scale_arcsec), STAMP_PX)
    if source.flux > 1e5:  # the wings of a bright star stand above the noise
        side = max(side, min(STAMP_PX, math.ceil(STAMP_ARCSEC / scale_arcsec)))
    left, low = round(x) - side // 2, round(y) - side // 2
    bounds = galsim.BoundsI(left, left + side - 1, low, low + side - 1)
    shared = bounds & image.bounds
    if not shared.isDefined():
        return
    stamp = galsim.Image(bounds, dtype=np.float32, scale=scale_arcsec)
    source.drawImage(stamp, center=galsim.PositionD(x, y))
    image[shared] += stamp[shared]


def _add_cosmic_rays(
    charge: Float32Array, sensor: Detector, per_cm2: float, rng: np.random.Generator
) -> None:
    """Straight tracks of particles through the silicon."""
    ny, nx = charge.shape
    area = ny * nx * (1e-4 * sensor.pixel_um) ** 2
    for _ in range(rng.poisson(per_cm2 * area)):
        x, y, turn = rng.uniform(0.0, nx), rng.uniform(0.0, ny), rng.uniform(0.0, 2.0 * math.pi)
        length = min(rng.exponential(30.0), 400.0)
        steps = max(int(4 * length), 8)
        along = length * (np.arange(steps) + 0.5) / steps
        blur = BLUR_OF_A_RAY_PX * rng.standard_normal((2, steps))
        columns = np.floor(x + along * math.cos(turn) + blur[0]).astype(int)
        rows = np.floor(y + along * math.sin(turn) + blur[1]).astype(int)
        kept = (rows >= 0) & (rows < ny) & (columns >= 0) & (columns < nx)
        total = RAY_E_PER_UM * math.hypot(100.0, length * sensor.pixel_um) * rng.gamma(4.0, 0.25)
        np.add.at(charge, (rows[kept], columns[kept]), np.float32(total / steps))


def _bleed(charge: Float32Array, full_well: float) -> BoolArray:
    """Spread charge beyond the full well along columns; pixels that are full."""
    for column in np.flatnonzero((charge > full_well).any(axis=0)):
        values = charge[:, column]
        excess = float(np.maximum(values - full_well, 0.0).sum())
        np.minimum(values, np.float32(full_well), out=values)
        middle = int(np.argmax(values >= full_well)) + int((values >= full_well).sum()) // 2
        for distance in range(values.size):
            for row in {middle - distance, middle + distance}:
                if 0 <= row < values.size and excess > 0.0:
                    taken = min(excess, full_well - float(values[row]))
                    values[row] += np.float32(taken)
                    excess -= taken
            if excess <= 0.0:
                break
    return np.asarray(charge >= np.float32(full_well))
