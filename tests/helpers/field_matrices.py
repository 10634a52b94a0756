"""Flats of a sensor from matrices of the fields; nothing but the tables of the media is shared with the package."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline

from lsst.fringe_sim.optics import get_medium

KELVIN = 183.15
LINE_NM = 2.0  # Full width of a Gaussian line [nm]

LAYERS = (
    ("MgF2", 0.1221),
    ("Ta2O5", 0.0441),
    ("Si", 100.0),
    ("SiO2", 0.1),
    ("Si", 0.3),
    ("SiO2", 1.0),
    ("epoxy", np.nan),
    ("Si", 165.0),
)
"""Layers of the e2v sensor under vacuum, from the light on, with their thickness [µm]; the support lies below."""

SUPPORT = "Si3N4"
DETECTION, INSULATION, EPOXY = 2, 5, 6

AMPLIFIER_ROWS, AMPLIFIER_COLUMNS = 2, 8

Wave = tuple[np.ndarray, np.ndarray]
"""Electric and magnetic field along the layers, each ``(wavelengths, thicknesses)`` or ``(wavelengths, 1)``."""


@dataclass(frozen=True)
class Stain:
    """A rectangle on the sensor that is not as the rest; lengths are parts of the side of the sensor."""

    centre: tuple[float, float]  # Middle and half sides along y and x
    half: tuple[float, float]
    # Index and thickness [µm] of a film between insulation and adhesive
    film: tuple[complex, float] | None = None
    absorbed: float = 0.0  # Part of the light that does not come in

    def covers(self, shape: tuple[int, ...]) -> np.ndarray:
        """Places of a map that lie on it."""
        y, x = ((np.arange(size) + 0.5) / size for size in shape)
        rows = np.abs(y - self.centre[0]) < self.half[0]
        return rows[:, np.newaxis] & (np.abs(x - self.centre[1]) < self.half[1])


@dataclass(frozen=True)
class Window:
    """A plate before the sensor, in which light goes to and fro once."""

    amplitude: float  # Of its fringes, in a line without width
    thickness_um: float  # Thickness in the middle, and rise along the columns over the sensor [µm]
    wedge_um: float
    index: float = 1.45  # Index of the plate

    def passed(self, wavelength_nm: np.ndarray, share: np.ndarray, columns: int) -> np.ndarray:
        """Light behind it in every column, averaged over the wavelengths with weights whose sum is 1."""
        thickness = self.thickness_um + self.wedge_um * ((np.arange(columns) + 0.5) / columns - 0.5)
        phase = 4.0 * np.pi * self.index * thickness / (1e-3 * wavelength_nm[:, np.newaxis])
        return np.asarray(share @ (1.0 + self.amplitude * np.cos(phase)))


@dataclass(frozen=True)
class ForeignSensor:
    """A sensor in its light that may differ from those of the set-up."""

    line: float = 1.0  # Factor on the width of the line
    # Part of the light in a second line, and how far that lies away [nm]
    satellite: tuple[float, float] = (0.0, 0.0)
    offset_nm: float = 0.0  # True minus nominal wavelength
    jitter_nm: tuple[float, ...] = ()  # The same of each exposure, besides
    # Sine of the largest angle of a cone of light whose brightness is the same in all directions
    aperture: float = 0.0
    epoxy_k: float = 0.0  # Absorption of the adhesive
    # What is added to the thickness of a layer, by its number [µm]
    thicker_um: Mapping[int, float] = field(default_factory=dict)
    # Index and thickness [µm] of a film between insulation and adhesive
    film: tuple[complex, float] | None = None
    roughness_nm: float = 0.0  # Rms height of the upper face of the support
    warming_k: float = 0.0  # How much warmer than the first the last exposure is; the mean is as stated
    contrast: float = 1.0  # Part of the light that meets the fringes; the rest sees the mean over one order
    pedestal: float = 0.0  # Level added to every flat, relative to its mean
    gradient: tuple[float, float] = (0.0, 0.0)  # Relative rise of the light along y and x over the sensor
    gains: tuple[float, ...] = ()  # Relative errors of the amplifiers, two rows of eight
    stain: Stain | None = None  # See there
    window: Window | None = None  # See there

    # Optics -------------------------------------------------------------------------------------------------

    def absorbed(self, wavelength_nm: np.ndarray, epoxy_um: np.ndarray, kelvin: float = KELVIN) -> np.ndarray:
        """Light absorbed in the detection layer, ``(wavelengths, thicknesses)``, relative to what comes in."""
        total = np.zeros((len(wavelength_nm), len(epoxy_um)))
        for weight, sine, polarised in self._rays():
            flux = self.net_flux(wavelength_nm, epoxy_um, kelvin, sine, polarised)
            total += weight * (flux[DETECTION] - flux[DETECTION + 1])
        return total

    def _rays(self) -> Iterator[tuple[float, float, str]]:
        """Weight, sine and polarisation of rays: the middles of rings of equal solid angle."""
        if not self.aperture:
            yield 1.0, 0.0, "s"
            return
        rings = 8 + int(400.0 * self.aperture**2)
        for number in range(rings):
            for polarised in "sp":
                yield 0.5 / rings, self.aperture * np.sqrt((number + 0.5) / rings), polarised

    def net_flux(
        self,
        wavelength_nm: np.ndarray,
        epoxy_um: np.ndarray,
        kelvin: float = KELVIN,
        sine: float = 0.0,
        polarised: str = "s",
    ) -> dict[int, np.ndarray]:
        """Flux downwards at the upper face of every layer, and into the support, relative to what comes in."""
        nominal = np.asarray(wavelength_nm, dtype=float)
        wavelength = 1e-3 * nominal[:, np.newaxis]

        def index_of(name: str) -> np.ndarray:
            return np.asarray(get_medium(name).index(nominal, kelvin))[:, np.newaxis] + 0j

        # One wave leaves downwards.
        below = _admittance(index_of(SUPPORT), sine, polarised)[0]
        wave: Wave = np.ones(wavelength.shape, complex), below
        flux = {len(LAYERS): np.real(np.conj(wave[0]) * wave[1])}
        for number in reversed(range(len(LAYERS))):
            name, thickness = LAYERS[number]
            index = index_of(name)
            passed = np.asarray([[thickness + self.thicker_um.get(number, 0.0)]])
            if number == EPOXY:
                index, passed = index + 1j * self.epoxy_k, np.asarray(epoxy_um)[np.newaxis, :]
                wave = self._off_rough_face(wave, index, wavelength, sine, polarised)
            wave = _through(wave, index, passed / wavelength, sine, polarised)
            flux[number] = np.real(np.conj(wave[0]) * wave[1])
            if number == EPOXY and self.film is not None:
                film = np.full(wavelength.shape, self.film[0], complex)
                wave = _through(wave, film, self.film[1] / wavelength, sine, polarised)
        vacuum = _admittance(np.ones(wavelength.shape, complex), sine, polarised)[0]
        incident = np.real(vacuum) * np.abs(0.5 * (wave[0] + wave[1] / vacuum)) ** 2
        return {number: each / incident for number, each in flux.items()}

    def _off_rough_face(
        self, wave: Wave, index: np.ndarray, wavelength: np.ndarray, sine: float, polarised: str
    ) -> Wave:
        """The wave over the support, if what it returns is the mean over many heights of its face."""
        if not self.roughness_nm:
            return wave
        admittance, cosine = _admittance(index, sine, polarised)
        down, up = 0.5 * (wave[0] + wave[1] / admittance), 0.5 * (wave[0] - wave[1] / admittance)
        away = np.linspace(-6.0, 6.0, 97)
        share = np.exp(-0.5 * away**2) / np.exp(-0.5 * away**2).sum()
        # What has to go through the adhesive once more, and back.
        turns = 4.0 * np.pi * np.real(index * cosine) * 1e-3 * self.roughness_nm / wavelength
        up = up * (np.exp(1j * turns * away) @ share)[:, np.newaxis]
        return down + up, admittance * (down - up)

    # Flats --------------------------------------------------------------------------------------------------

    def flats(self, wavelength_nm: np.ndarray, epoxy_um: np.ndarray, px: int) -> np.ndarray:
        """Relative flats of a map with ``px`` by ``px`` places in a pixel, shape ``(wavelengths, ny, nx)``."""
        grid = np.linspace(epoxy_um.min() - 0.01, epoxy_um.max() + 0.01, int(np.ptp(epoxy_um) / 0.004) + 12)
        nominal = np.asarray(wavelength_nm, dtype=float)
        warmer = self.warming_k * np.linspace(-0.5, 0.5, len(nominal))
        jitter = self.jitter_nm or (0.0,) * len(nominal)
        images = []
        for middle, error, kelvin in zip(nominal, jitter, KELVIN + warmer, strict=True):
            nodes, share = self._line(middle + self.offset_nm + error)
            image = self._pixels(nodes, share, epoxy_um, grid, kelvin, px)
            if self.window is not None:
                image = image * self.window.passed(nodes, share, image.shape[1])
            image = image / image.mean() + self.pedestal
            images.append(image / image.mean())
        flats = np.array(images) * self._uneven(images[0].shape)
        return np.asarray(flats / flats.mean(axis=(1, 2), keepdims=True))

    def _line(self, middle_nm: float) -> tuple[np.ndarray, np.ndarray]:
        """Wavelengths of a line, and weights whose sum is 1."""
        away = np.linspace(-3.5, 3.5, 81)
        nodes = middle_nm + self.line * LINE_NM / np.sqrt(8.0 * np.log(2.0)) * away
        share = np.exp(-0.5 * away**2) / np.exp(-0.5 * away**2).sum()
        part, distance_nm = self.satellite
        if not part:
            return nodes, share
        return np.concatenate([nodes, nodes + distance_nm]), np.concatenate(
            [(1.0 - part) * share, part * share]
        )

    def _pixels(
        self,
        nodes: np.ndarray,
        share: np.ndarray,
        epoxy_um: np.ndarray,
        grid: np.ndarray,
        kelvin: float,
        px: int,
    ) -> np.ndarray:
        """Light of one line in every pixel."""
        places = self._seen(nodes, share, grid, kelvin)(epoxy_um)
        stain = self.stain
        if stain is not None:
            on = stain.covers(epoxy_um.shape)
            stained = replace(self, film=stain.film or self.film)._seen(nodes, share, grid, kelvin)
            places[on] = (1.0 - stain.absorbed) * stained(epoxy_um[on])
        ny, nx = (length // px for length in epoxy_um.shape)
        return np.asarray(places.reshape(ny, px, nx, px).mean(axis=(1, 3)))

    def _seen(self, nodes: np.ndarray, share: np.ndarray, grid: np.ndarray, kelvin: float) -> CubicSpline:
        """Response to a line over the thickness of the adhesive."""
        response = share @ self.absorbed(nodes, grid, kelvin)
        if self.contrast != 1.0:
            wavelength = float(share @ nodes)
            index = float(np.real(get_medium("epoxy").index(np.array([wavelength]), kelvin)[0]))
            order_um = 1e-3 * wavelength / (2.0 * index)
            one = grid.mean() + order_um * (np.arange(24) / 24.0 - 0.5)
            mean = float((share @ self.absorbed(nodes, one, kelvin)).mean())
            response = mean + self.contrast * (response - mean)
        return CubicSpline(grid, response)

    def _uneven(self, shape: tuple[int, ...]) -> np.ndarray:
        """Light and gain of every pixel, relative."""
        y, x = ((np.arange(size) + 0.5) / size - 0.5 for size in shape)
        light = 1.0 + self.gradient[0] * y[:, np.newaxis] + self.gradient[1] * x
        if not self.gains:
            return np.asarray(light)
        row, column = (
            np.arange(size) * parts // size
            for size, parts in zip(shape, (AMPLIFIER_ROWS, AMPLIFIER_COLUMNS), strict=True)
        )
        gains = 1.0 + np.reshape(self.gains, (AMPLIFIER_ROWS, AMPLIFIER_COLUMNS))
        return np.asarray(light * gains[row[:, np.newaxis], column])


def _admittance(index: np.ndarray, sine: float, polarised: str) -> Wave:
    """Magnetic over electric field along the layers of a wave downwards, and the cosine of its direction."""
    cosine = np.sqrt(1.0 - (sine / index) ** 2)
    return (index * cosine if polarised == "s" else index / cosine), cosine


def _through(wave: Wave, index: np.ndarray, waves: np.ndarray, sine: float, polarised: str) -> Wave:
    """Fields at the upper face of a layer from those at its lower; its thickness in vacuum wavelengths."""
    admittance, cosine = _admittance(index, sine, polarised)
    phase = 2.0 * np.pi * index * cosine * waves
    electric, magnetic = wave
    turned, mixed = np.cos(phase), 1j * np.sin(phase)
    return (
        turned * electric - mixed / admittance * magnetic,
        turned * magnetic - mixed * admittance * electric,
    )
