"""Frames of a night sky that shares no code and no line list with the package: sums over lines and rays, then pixels.

Lines are those of the ESO sky model (Hanuschik 2003, Cosby 2006, Rousselot 2000), silicon is that of Franta et al.
2017 at its own cold temperatures, the other layers have constant indices, the telescope is a plain ring, and the
filter is an analytic curve.
"""

import functools
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import lsst.fringe_sim

DATA = Path(lsst.fringe_sim.__file__).parent / "data"

ABOVE = ((1.375, 0.1221), (2.10, 0.0441))  # Index and thickness [µm] of the coating, from the light on
BELOW = ((1.451, 0.1), (None, 0.3), (1.451, 1.0))
"""Oxide, gates (of silicon) and insulation between detection layer and adhesive."""
EPOXY, SUPPORT_UM, SUBSTRATE = 1.6, 165.0, 1.99

RAYS, FEW_RAYS = 32, 8
"""Nodes over the square of the sine of the angle: for lines, in whose light the phase turns by 56 rad over the pupil,
and for light whose fringes average out over the wavelength."""

STEP_UM = 0.004  # Grid of the adhesive, over which waves are summed: 75 points per fringe
FAINTEST = 1e-3  # Lines fainter than so much of the brightest are left out
CONTINUUM = "continuum"


class Media(NamedTuple):
    """Layers at one wavelength; those below without an index are of silicon."""

    above: tuple[tuple[complex, float], ...]
    silicon: complex
    below: tuple[tuple[complex | None, float], ...]
    substrate: complex


@dataclass(frozen=True)
class ForeignSky:
    """Sky, telescope and sensor."""

    silicon_um: float = 100.0  # Thickness [µm] and temperature [K] of the detection layer
    kelvin: float = 173.15
    f_number: float = 1.234  # Of the telescope; the obscuration is that of the radius
    obscuration: float = 0.61
    # Wavelengths at which the filter lets half of the light through
    edges_nm: tuple[float, float] = (923.0, 1083.0)
    # Photons per second, square metre, square arcsecond and nanometre that are in no line
    continuum: float = 0.3
    coherence: float = 1.0  # Part of the fringes that is left, by whatever the back side does to them

    def detected(self, thickness_um: np.ndarray) -> dict[str, np.ndarray]:
        """Light of every group of lines and of the continuum that is detected, relative to all of it together.

        Lines of one group share their vibrational levels, so that they vary alike. Each entry has the shape of the
        map of the adhesive.
        """
        grid = np.arange(thickness_um.min() - 2 * STEP_UM, thickness_um.max() + 3 * STEP_UM, STEP_UM)
        seen = {
            name: self._summed(wavelength, photons, grid, FEW_RAYS if name == CONTINUUM else RAYS)
            for name, (wavelength, photons) in self._light().items()
        }
        total = float(sum(each.mean() for each in seen.values()))
        maps = {}
        for name, curve in seen.items():
            kept = curve.mean() + self.coherence * (curve - curve.mean())
            maps[name] = np.interp(thickness_um, grid, kept / total)
        return maps

    def _light(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Wavelengths [nm] and photons behind the filter of each part of the light."""
        low, high = self.edges_nm
        lines = _table("sky/sky_airglow_lines_eso_sm01.ecsv")
        inside = (lines["wavelength"] > low - 15.0) & (lines["wavelength"] < high + 15.0)
        lines = {name: column[inside] for name, column in lines.items()}
        photons = lines["photon_radiance"] * lines["transmission"] * self._filter(lines["wavelength"])
        light = {}
        for group in np.unique(lines["groupA"]):
            own = (lines["groupA"] == group) & (photons > FAINTEST * photons.max())
            if own.any():
                light[f"group {int(group)}"] = lines["wavelength"][own], photons[own]
        even = np.arange(low - 15.0, high + 15.0, 0.5)
        light[CONTINUUM] = even, 0.5 * self.continuum * self._filter(even)
        return light

    def _filter(self, wavelength_nm: np.ndarray) -> np.ndarray:
        low, high = self.edges_nm
        return (
            0.25
            * (1.0 + np.tanh((wavelength_nm - low) / 3.0))
            * (1.0 - np.tanh((wavelength_nm - high) / 8.0))
        )

    def _summed(
        self, wavelength_nm: np.ndarray, photons: np.ndarray, grid_um: np.ndarray, rays: int
    ) -> np.ndarray:
        total = np.zeros(grid_um.size)
        share, sine = self._rays(rays)
        for wavelength, number in zip(wavelength_nm, photons, strict=True):
            for polarised in "sp":
                seen = self.absorbed(float(wavelength), sine, polarised, grid_um)
                total += 0.5 * number * share @ seen
        return total

    def _rays(self, rays: int) -> tuple[np.ndarray, np.ndarray]:
        """Shares and sines: Gauss's rule over the ring of the pupil."""
        rim = (0.5 / self.f_number) ** 2
        nodes, shares = np.polynomial.legendre.leggauss(rays)
        squares = rim * (self.obscuration**2 + (1.0 - self.obscuration**2) * 0.5 * (nodes + 1.0))
        return 0.5 * shares, np.sqrt(squares)

    def media(self, wavelength_nm: float) -> Media:
        """Indices and thicknesses of the layers but the adhesive."""
        return Media(ABOVE, _silicon(wavelength_nm, self.kelvin), BELOW, SUBSTRATE)

    def absorbed(
        self, wavelength_nm: float, sine: np.ndarray, polarised: str, epoxy_um: np.ndarray
    ) -> np.ndarray:
        """Part of plane waves that the detection layer takes, ``(rays, thicknesses of the adhesive)``."""
        waves, media = 1e3 / wavelength_nm, self.media(wavelength_nm)
        silicon = media.silicon
        away = np.stack([np.ones(sine.size), _admittance(media.substrate, sine, polarised)], axis=1)
        fields = _matrix(silicon, SUPPORT_UM * waves, sine, polarised) @ away[:, :, np.newaxis]
        # The adhesive absorbs nothing and turns the fields by a real angle: all energy flows are p + q cos + r sin of
        # twice that angle, which three angles determine.
        angle = np.pi / 3.0 * np.arange(3)
        turns = angle[:, np.newaxis] / (2.0 * np.pi * np.sqrt(EPOXY**2 - sine**2))
        turned = [_matrix(EPOXY, each, sine, polarised) @ fields for each in turns]
        fields = np.concatenate(turned, axis=2)
        for index, thickness in reversed(media.below):
            fields = _matrix(index or silicon, thickness * waves, sine, polarised) @ fields
        bottom = _flux(fields)
        fields = _matrix(silicon, self.silicon_um * waves, sine, polarised) @ fields
        top = _flux(fields)
        for index, thickness in reversed(media.above):
            fields = _matrix(index, thickness * waves, sine, polarised) @ fields
        vacuum = _admittance(1.0, sine, polarised).real[:, np.newaxis]
        incident = 0.25 * np.abs(vacuum * fields[:, 0] + fields[:, 1]) ** 2 / vacuum
        circle = np.stack([np.ones(3), np.cos(2.0 * angle), np.sin(2.0 * angle)], axis=1)
        (p, q, r), (u, v, w) = (
            np.linalg.solve(circle, each.T)[:, :, np.newaxis] for each in (top - bottom, incident)
        )
        twice = 4.0 * np.pi * np.sqrt(EPOXY**2 - sine**2)[:, np.newaxis] * epoxy_um * waves
        c, s = np.cos(twice), np.sin(twice)
        return np.asarray((p + q * c + r * s) / (u + v * c + w * s))


@dataclass(frozen=True)
class ForeignClutter:
    """What else is in a frame; all zero is the sky alone."""

    stars: float = 0.0  # Stars per thousand pixels; a tenth of them is brighter than 5e3 electrons
    cosmic_rays: float = 0.0  # Tracks per thousand pixels
    gradient: float = 0.0  # Rms of the relative rise of the sky along either side, another in every frame
    # Rms of the relative errors of the gain of sixteen amplifiers, two rows of eight, the same in all
    # frames
    amplifier_steps: float = 0.0
    # Smooth light of another source, relative to the dark sky; in every frame a random part of it
    moon: float = 0.0
    fwhm_px: float = 3.5  # Of the image of a star


@dataclass(frozen=True)
class ForeignFrame:
    """One frame in electrons, and what it is made of."""

    image: np.ndarray  # (ny, nx): what is measured, with its variance
    variance: np.ndarray
    sky: np.ndarray  # Smooth light of the sky without its fringes
    fringes: np.ndarray  # Light of the fringes: their mean over all phases is zero
    objects: np.ndarray  # Light of the stars
    hit: np.ndarray  # Pixels of cosmic rays
    gain: np.ndarray  # Relative gain, by which all light is multiplied
    # Brightness of the groups of lines relative to their mean
    group: dict[str, float] = field(default_factory=dict)


def foreign_map(
    rng: np.random.Generator, shape: tuple[int, int], low_um: float, high_um: float
) -> np.ndarray:
    """Adhesive between two thicknesses [µm]: a dome with some waves on it."""
    v, u = np.meshgrid(*(np.linspace(-1.0, 1.0, size) for size in shape), indexing="ij")
    height = 1.2 * (u - rng.uniform(-0.4, 0.4)) ** 2 + (v - rng.uniform(-0.4, 0.4)) ** 2
    for _ in range(4):
        tilt = rng.normal(0.0, 2.0, 2)
        height += 0.25 * np.sin(tilt[0] * u + tilt[1] * v + rng.uniform(0.0, 2.0 * np.pi))
    height = (height - height.min()) / np.ptp(height)
    return np.asarray(low_um + (high_um - low_um) * height)


def foreign_night(
    sky: ForeignSky,
    thickness_um: np.ndarray,
    rng: np.random.Generator,
    frames: int = 8,
    clutter: ForeignClutter | None = None,
    *,
    electrons: float = 2700.0,
    read_noise_e: float = 6.0,
    places: int = 1,
    steady: bool = False,
) -> list[ForeignFrame]:
    """Frames of one sensor in one night, with Poisson and read noise."""
    own = clutter or ForeignClutter()
    parts = {name: _binned(image, places) for name, image in sky.detected(thickness_um).items()}
    shape = next(iter(parts.values())).shape
    gain = _amplifiers(1.0 + own.amplifier_steps * rng.standard_normal((2, 8)), shape)
    night = []
    for _ in range(frames):
        spread = 0.0 if steady else 0.25
        # Bands rise and fall together by more than they differ from one another.
        common = np.exp(spread * rng.standard_normal())
        group = {
            name: 1.0 if name == CONTINUUM else float(common * np.exp(0.3 * spread * rng.standard_normal()))
            for name in parts
        }
        level = electrons * sum(group[name] * image.mean() for name, image in parts.items())
        fringes = electrons * sum(group[name] * (image - image.mean()) for name, image in parts.items())
        moon = own.moon * rng.uniform() * electrons
        smooth = level * (1.0 + _tilt(own.gradient * rng.standard_normal(2), shape)) + moon
        lit = fringes * smooth / (level + moon) if own.gradient else fringes
        stars = _stars(own, rng, shape)
        clean = ForeignFrame(smooth, smooth, smooth, lit, stars, np.zeros(shape, bool), gain, group)
        night.append(_exposed(clean, own, rng, read_noise_e))
    return night


def _exposed(
    clean: ForeignFrame, clutter: ForeignClutter, rng: np.random.Generator, read_noise_e: float
) -> ForeignFrame:
    """Frame with noise and cosmic rays."""
    light = np.maximum(clean.gain * (clean.sky + clean.fringes + clean.objects), 0.0)
    image = rng.poisson(light) + read_noise_e * rng.standard_normal(light.shape)
    hit = np.zeros(light.shape, bool)
    for _ in range(rng.poisson(clutter.cosmic_rays * light.size / 1000.0)):
        start, angle, length = rng.uniform(0.0, light.shape), rng.uniform(0.0, np.pi), rng.uniform(1.0, 12.0)
        steps = np.arange(0.0, length, 0.5)[:, np.newaxis]
        track = np.unique((start + steps * [np.sin(angle), np.cos(angle)]).astype(int), axis=0)
        track = track[np.all((track >= 0) & (track < light.shape), axis=1)]
        hit[track[:, 0], track[:, 1]] = True
        image[track[:, 0], track[:, 1]] += rng.uniform(300.0, 5000.0, len(track))
    variance = np.maximum(image, 1.0) + read_noise_e**2
    return replace(clean, image=image, variance=variance, hit=hit)


def _stars(clutter: ForeignClutter, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Moffat images of stars: as many are brighter than a flux as its inverse says, from 500 electrons on."""
    image = np.zeros(shape)
    core = 0.5 * clutter.fwhm_px / np.sqrt(2.0 ** (1.0 / 2.5) - 1.0)
    y, x = np.ogrid[: shape[0], : shape[1]]
    for _ in range(rng.poisson(clutter.stars * image.size / 1000.0)):
        flux = min(500.0 / rng.uniform(), 2e6)
        cy, cx = rng.uniform(0.0, shape)
        reach = int(4 + 8.0 * core * (flux / 500.0) ** 0.2)
        rows, columns = (
            slice(max(int(c) - reach, 0), min(int(c) + reach, size))
            for c, size in zip((cy, cx), shape, strict=True)
        )
        square = ((y[rows] - cy) ** 2 + (x[:, columns] - cx) ** 2) / core**2
        image[rows, columns] += flux * 1.5 / (np.pi * core**2) * (1.0 + square) ** -2.5
    return image


def _tilt(rise: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    v, u = (np.linspace(-0.5, 0.5, size) for size in shape)
    return np.asarray(rise[0] * v[:, np.newaxis] + rise[1] * u)


def _amplifiers(gain: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    row, column = (np.arange(size) * parts // size for size, parts in zip(shape, gain.shape, strict=True))
    return np.asarray(gain[row[:, np.newaxis], column])


def _binned(image: np.ndarray, places: int) -> np.ndarray:
    ny, nx = (size // places for size in image.shape)
    return np.asarray(image.reshape(ny, places, nx, places).mean(axis=(1, 3)))


def _admittance(index: complex, sine: np.ndarray, polarised: str) -> np.ndarray:
    cosine = np.sqrt(1.0 - (sine / (index + 0j)) ** 2)
    return np.asarray(index * cosine if polarised == "s" else index / cosine)


def _matrix(index: complex, waves: float | np.ndarray, sine: np.ndarray, polarised: str) -> np.ndarray:
    """Fields at the upper face of a layer from those at its lower, ``(rays, 2, 2)``; they go as exp(-iωt)."""
    cosine = np.sqrt(1.0 - (sine / (index + 0j)) ** 2)
    angle, admittance = 2.0 * np.pi * index * cosine * waves, _admittance(index, sine, polarised)
    turned, mixed = np.cos(angle), -1j * np.sin(angle)
    rows = [[turned, mixed / admittance], [mixed * admittance, turned]]
    return np.moveaxis(np.array(rows), 2, 0)


def _flux(fields: np.ndarray) -> np.ndarray:
    return np.asarray(np.real(fields[:, 0] * np.conj(fields[:, 1])))


@functools.cache
def _silicon(wavelength_nm: float, kelvin: float) -> complex:
    """Index between two of the temperatures at which it was measured."""
    table = _table("media/nk_Si_franta2017_T.ecsv")
    measured = np.array([100.0, 150.0, 200.0, 250.0, 300.0])
    n, k = (
        np.array(
            [np.interp(wavelength_nm, table["wavelength"], f(table[f"{part}_{t:.0f}K"])) for t in measured]
        )
        for part, f in (("n", np.asarray), ("k", np.log))
    )
    return complex(np.interp(kelvin, measured, n), np.exp(np.interp(kelvin, measured, k)))


@functools.cache
def _table(path: str) -> dict[str, np.ndarray]:
    """Columns of a plain table of numbers."""
    rows = [line for line in (DATA / path).read_text().splitlines() if line and not line.startswith("#")]
    values = np.array([[float(word) for word in row.split()] for row in rows[1:]])
    return dict(zip(rows[0].split(), values.T, strict=True))
