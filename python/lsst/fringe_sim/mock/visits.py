"""Visits of a simulated sensor behind its telescope: fringes of the night sky, stars, galaxies, disturbances.

The fringes are those of `FlatFieldOptics`, summed over lines and angles; sources are drawn by GalSim. The images are
as after the removal of the instrument's signature: electrons, with a mask of what that removal knows.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..array_types import Float32Array, FloatArray
from ..effects import known_effects
from ..errors import InputError, OutOfRangeError
from ..files import all_or_nothing
from ..instrument.bandpass import Bandpass
from ..instrument.camera import Camera, Detector
from ..instrument.night import StochasticNight
from ..instrument.ray_bundle import lagrange_weights
from ..instrument.sky import SkySpectrum, SpectralComponent, blend_components
from ..instrument.telescope import ConeOptics, telescope_beam
from .film_fields import add_mode, add_periodic_mode, light_in
from .hidden_effect import ActiveHiddenEffect
from .hidden_effects import validate_effects, with_hidden_optics
from .optics import FlatFieldOptics, heights_and_weights
from .raw_frames import checked_thickness, films_of, read_setup_file
from .signal_table import SignalTable
from .visit_sources import MASK_PLANES, Pointing, Scene, VisitConditions, VisitImage, expected_sources

STEP_UM = 0.01
"""Spacing of the table over thickness [µm]: thirty points per fringe, between which a cubic is right to 1e-5."""

BEAM_NODES = 64
"""Angles of the beam; twice as many change the fringes of the centre of the LSST by less than 1e-5."""

BLEND_NM = 0.005  # Rms shift of lines that are summed as one [nm]; a fringe of all the silicon is 1.3 nm wide

FIELD_NODES = 2
"""Distances from the axis at which the beam is traced; between them light changes with the square of the distance."""

CONTINUUM_NODES, CONTINUUM_STEP_NM = 8, 0.1
"""Angles and spacing of the wavelengths of continua: with 96 angles fringes differ by 3e-4, with 0.5 nm by 6e-2."""

PARTS = 3  # Moments of an exposure over which the drifting bands are averaged

FIRST_VISIT = datetime.datetime(2026, 1, 15, 1, 0, tzinfo=datetime.UTC)


@dataclass(frozen=True, eq=False)
class MockVisit:
    """A visit and what is true of it."""

    path: Path  # its file
    fringes: Float32Array  # (ny, nx): light of the sky less its mean over the sensor [e⁻]
    level_e: float  # mean light of the sky [e⁻]


@dataclass(frozen=True, eq=False)
class DetectedSky:
    """Light of the components of a dark sky that a sensor detects, pixel by pixel."""

    names: tuple[str, ...]  # OH bands, then continua
    n_bands: int  # how many of them are bands
    light: Float32Array  # (len(names), ny, nx): electrons per second and pixel


def detected_sky(
    setup: str,
    sensor: Detector,
    thickness_um: NDArray[np.floating],
    effects: Mapping[str, Any] | None = None,
    silicon: str | None = None,
) -> DetectedSky:
    """Sum the light of the night sky over lines, angles and polarisations, for every pixel of a sensor.

    ``setup``: name of a set-up behind a telescope, or its YAML file.
    ``sensor``: where in the field the sensor lies. A map of any size covers all of it.
    ``thickness_um``: thickness of the layer that varies [µm].
    ``effects``: hidden effects of the sensor, as for `validate_effects`.
    ``silicon``: table of its optical constants, as ``Si_franta2017``; by default that of the set-up.
    `InputError`: a set-up without a sky and a filter, an effect that does not act on the layers of a
        whole sensor, or no table of silicon.
    """
    content = _of_the_sky(setup)
    light = content["illumination"]
    optics = with_hidden_optics(_optics(content, setup, silicon), _of_the_sensor(effects))
    sky = SkySpectrum.dark(airmass=float(light["airmass"]))
    parts = sky.components(Bandpass.from_name(str(light["bandpass"])), CONTINUUM_STEP_NM)
    lines = frozenset(sky.lines.bands)
    parts = [
        *blend_components([part for part in parts if part.name in lines], BLEND_NM),
        *(part for part in parts if part.name not in lines),
    ]
    radius = _field_radius_deg(sensor, thickness_um.shape, float(light["pixel_scale_arcsec"]))
    nodes = np.sqrt(np.linspace(radius.min() ** 2, radius.max() ** 2, FIELD_NODES))
    grid = _grid(thickness_um)
    shares = lagrange_weights(nodes**2, radius**2).astype(np.float32)
    total = np.zeros((len(parts), *thickness_um.shape), dtype=np.float32)
    for node, share in zip(nodes, shares, strict=True):
        many, few = (_angles(light["beam"], float(node), number) for number in (BEAM_NODES, CONTINUUM_NODES))
        for row, part in enumerate(parts):
            curve = _summed(optics, part, many if part.name in lines else few, grid)
            total[row] += share * SignalTable(grid, curve[np.newaxis], (0.0,)).evaluate(0, thickness_um)
    total *= np.float32(light["effective_area_m2"] * light["pixel_scale_arcsec"] ** 2)
    names = tuple(part.name for part in parts)
    return DetectedSky(names, sum(name in lines for name in names), total)


def check_visits(
    setup: str,
    shape: tuple[int, int],
    effects: Mapping[str, Any] | None = None,
    conditions: VisitConditions | None = None,
) -> float:
    """Refuse before long work what `write_mock_visits` cannot simulate.

    ``shape``: rows and columns of the sensor; the other arguments are those of `write_mock_visits`.
    Returns the number of sources to be expected in a visit.
    `InputError`: as for `detected_sky`, or too many sources.
    """
    light = _of_the_sky(setup)["illumination"]
    _of_the_sensor(effects)
    return expected_sources(light, conditions or VisitConditions(), shape)


def _of_the_sky(setup: str) -> dict[str, Any]:
    """Content of a set-up that sees the sky through a beam."""
    content = read_setup_file(setup)
    light = content["illumination"]
    if light["kind"] != "sky" or light["beam"]["kind"] not in ("cone", "telescope"):
        raise InputError("set-up", setup, "one with a sky, behind a telescope or in a cone")
    return content


def _angles(beam: Mapping[str, Any], radius_deg: float, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Angles of incidence [rad] and their weights."""
    if beam["kind"] == "cone":
        found = ConeOptics(float(beam["f_number"]), float(beam.get("obscuration", 0.0))).beam(nodes)
    else:
        found = telescope_beam(str(beam["telescope"]), radius_deg, 0.0, nodes)
    return found.theta, found.weight


def _optics(content: Mapping[str, Any], setup: str, silicon: str | None) -> FlatFieldOptics:
    # The line of a monochromator plays no part in sums over lines of the sky.
    return FlatFieldOptics(
        films=films_of(content, setup, silicon),
        temperature_k=float(content["temperature_k"]),
        bandwidth_fwhm_nm=1.0,
        varying=str(content["varying"]),
    )


def _of_the_sensor(effects: Mapping[str, Any] | None) -> tuple[ActiveHiddenEffect, ...]:
    """Active effects; those that the sky does not see, or that only a part of the sensor has, are refused."""
    active = validate_effects(effects)
    elsewhere = {effect.name for effect in known_effects() if effect.laboratory_only}
    for effect, _ in active:
        if effect.on_optics is None or effect.on_island is not None or effect.name in elsewhere:
            raise InputError("hidden effect", effect.name, "one of the layers of the whole sensor")
    return active


def _field_radius_deg(sensor: Detector, shape: tuple[int, ...], scale_arcsec: float) -> FloatArray:
    """Distance of every pixel from the optical axis [deg]."""
    turn = math.radians(sensor.yaw_deg)
    y, x = (
        scale_arcsec / 3600.0 * pixels * ((np.arange(number) + 0.5) / number - 0.5)
        for pixels, number in zip(sensor.shape, shape, strict=True)
    )
    along = sensor.field_x_deg + math.cos(turn) * x - math.sin(turn) * y[:, np.newaxis]
    across = sensor.field_y_deg + math.sin(turn) * x + math.cos(turn) * y[:, np.newaxis]
    return np.asarray(np.hypot(along, across))


def _grid(thickness_um: NDArray[np.floating]) -> FloatArray:
    low, high = float(np.min(thickness_um)), float(np.max(thickness_um))
    points = math.ceil((high - low) / STEP_UM) + 9
    return np.asarray(max(low - 4.0 * STEP_UM, 0.0) + STEP_UM * np.arange(points, dtype=float))


def _summed(
    optics: FlatFieldOptics,
    part: SpectralComponent,
    angles: tuple[FloatArray, FloatArray],
    grid_um: FloatArray,
) -> FloatArray:
    """Light of one component against thickness, with the fringes that come back coherently."""
    modes = [
        light_in(
            optics,
            part.wavelength_nm,
            0.5 * weight * share * more * part.photons,
            float(theta),
            s_wave,
            height_um,
            support_um,
        )
        for support_um, more in heights_and_weights(optics.support_spread_um, 1e-3 * optics.height_step_nm)
        for height_um, share in heights_and_weights(1e-3 * optics.spread_nm, 1e-3 * optics.height_step_nm)
        for theta, weight in zip(*angles, strict=True)
        for s_wave in (True, False)
    ]

    def coherent(thickness_um: FloatArray) -> FloatArray:
        total = np.zeros(thickness_um.size)
        for light in modes:
            add = add_mode if light.phase.imag.any() else add_periodic_mode
            add(total, light, thickness_um)
        return total

    seen = coherent(grid_um)
    if optics.coherent_part == 1.0:
        return seen
    mean_nm = float(np.average(part.wavelength_nm, weights=part.photons))
    mean = coherent(optics.one_order_um(mean_nm)).mean()
    return np.asarray(mean + optics.coherent_part * (seen - mean))


def write_mock_visits(
    out_dir: str | Path,
    *,
    setup: str,
    detector: int | str,
    thickness_um: NDArray[np.floating],
    rng: np.random.Generator,
    effects: Mapping[str, Any] | None = None,
    conditions: VisitConditions | None = None,
    silicon: str | None = None,
) -> Iterator[MockVisit]:
    """Write visits of one night, after the removal of the instrument's signature.

    ``out_dir``: folder for the files; made if it does not exist.
    ``setup``: name of a set-up behind a telescope, or its YAML file.
    ``detector``: number or name of the sensor in the set-up's camera.
    ``thickness_um``: thickness of the layer that varies [µm]. A map smaller than the sensor is of a cut-down one,
        whose pixels are spread over the same part of the field for the beam, and have their usual size for sources.
    ``rng``: source of all randomness.
    ``effects``: hidden effects of the sensor, as for `validate_effects`.
    ``conditions``: number of visits, sources, seeing, light, and what disturbs.
    ``silicon``: as for `detected_sky`.
    Returns the files, each written when it is asked for, and the truth, which stands nowhere in them.
    `InputError`, `OutOfRangeError`, `UnknownNameError`: an argument cannot be used; nothing has been written
        then.
    """
    night = conditions or VisitConditions()
    visits = night.visits
    if visits < 1:
        raise OutOfRangeError("visits", visits, "1 or more")
    content = read_setup_file(setup)
    whole = Camera.from_name(str(content["camera"])).detector(detector)
    if np.ndim(thickness_um) != 2:
        raise InputError("thickness map", f"{np.ndim(thickness_um)} dimensions", "rows and columns")
    shape = (len(thickness_um), len(thickness_um[0]))
    sensor = whole if shape == whole.shape else whole.cut_down(shape)
    check_visits(setup, shape, effects, night)
    thickness = checked_thickness(thickness_um, shape)
    sky = detected_sky(setup, whole, thickness, effects, silicon)
    scene_rng, band_rng, *visit_rngs = rng.spawn(2 + visits)
    light = content["illumination"]
    scene = Scene.draw(light, night, sensor.shape, scene_rng)
    seconds = float(light["exposure_s"])
    scales = _band_scales(sky, night.hours, visits, seconds, band_rng)
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)

    def write(number: int) -> MockVisit:
        start = FIRST_VISIT + datetime.timedelta(hours=night.hours * number / visits)
        sky_e = seconds * np.tensordot(scales[number], sky.light, axes=1).astype(np.float32)
        image = VisitImage.expose(scene, sky_e, sensor, seconds, visit_rngs[number])
        path = folder / f"visit_{number + 1:03d}_{sensor.name}.fits"
        _write(path, image, _header(sensor, light, image.pointing, start, seconds))
        return MockVisit(path, sky_e - np.float32(sky_e.mean()), float(sky_e.mean()))

    return map(write, range(visits))


def _band_scales(
    sky: DetectedSky, hours: float, visits: int, seconds: float, rng: np.random.Generator
) -> FloatArray:
    """Strength of every component in every visit, ``(visits, components)``; bands drift within an exposure."""
    begin = np.linspace(0.0, hours, visits, endpoint=False)
    moments = begin[:, np.newaxis] + seconds / 3600.0 * (np.arange(PARTS) + 0.5) / PARTS
    history = StochasticNight().draw(moments.ravel(), rng)
    bands = sky.names[: sky.n_bands]
    scale = np.ones((moments.size, len(sky.names)))
    for moment in range(moments.size):
        found = history.band_scale(moment, bands)
        scale[moment, : sky.n_bands] = [found[name] for name in bands]
    return scale.reshape(visits, PARTS, len(sky.names)).mean(axis=1)


def _header(
    sensor: Detector, light: Mapping[str, Any], pointing: Pointing, start: datetime.datetime, seconds: float
) -> fits.Header:
    header = fits.Header()
    header["DETNAME"] = (sensor.name, "sensor")
    # The last part of its name: y of hsc_y and of hsc_y.yaml.
    header["FILTER"] = (Path(str(light["bandpass"])).stem.rpartition("_")[2], "filter")
    header["EXPTIME"] = (seconds, "[s] exposure")
    header["TIMESYS"] = "UTC"
    header["DATE-OBS"] = start.replace(tzinfo=None).isoformat(timespec="milliseconds")
    header["AIRMASS"] = float(light["airmass"])
    header["ROTPA"] = (math.degrees(pointing.angle_rad), "[deg] of the sensor's rows on the sky")
    header.update(pointing.wcs(sensor.shape).to_header())
    return header


def _write(path: Path, image: VisitImage, header: fits.Header) -> None:
    """A file with image, mask and variance, as Rubin's exposures have them."""
    pixels = fits.ImageHDU(image.electrons, header, name="IMAGE")
    pixels.header["BUNIT"] = "electron"
    mask = fits.ImageHDU(image.mask, name="MASK")
    for plane, bit in MASK_PLANES.items():
        mask.header[f"MP_{plane}"] = bit
    variance = fits.ImageHDU(image.variance, name="VARIANCE")
    with all_or_nothing(path) as temporary:
        fits.HDUList([fits.PrimaryHDU(), pixels, mask, variance]).writeto(temporary, checksum=True)
