"""Small work that calls every compiled function of a fit, a sky frame and a search, so that it is compiled."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from ..array_types import Float32Array, FloatArray
from ..instrument.sky import SkySpectrum
from ..model import FringeModel
from ..model.response_table import ResponseTable
from ..products import FlatExposures, FringeCube
from .discovery import SearchOptions, discover
from .field_response import FieldTable
from .night_sums import NightSums, ShiftSums
from .sensor_placement import SensorPlacement
from .sky_frame import simulate_sky_frame, sky_response
from .sky_model_error import Envelope
from .smooth_field import Splines
from .thickness_fit import fit_thickness
from .thickness_fit.amplitudes import Amplitudes
from .thickness_fit.global_fit import global_fit
from .thickness_fit.templates import FlatTemplates
from .thickness_fit.uncertainty import slip_probability

_WAVELENGTHS = np.arange(880.0, 991.0, 10.0)
_RANGE_UM = (14.0, 18.0)
_ORDER_UM = 0.3
_SETUP = "ts8_e2v"


def _relief(side: int) -> FloatArray:
    """Thickness with a step, over which pixels have more than one surface to choose from [µm]."""
    y, x = np.mgrid[0:side, 0:side] / side
    return np.asarray(15.0 + 1.2 * x + 0.8 * y * y + np.where(x > 0.7, 0.45, 0.0))


def _spoilt(image: FloatArray, noise: float) -> Float32Array:
    """With noise, a bad column, one wavelength wrong here and there, and a patch where no thickness fits."""
    rng = np.random.default_rng(1)
    image = image + noise * rng.standard_normal(image.shape)
    side = image.shape[1]
    image[:, :, side // 3] += 0.2
    image[3, rng.integers(0, side, 40), rng.integers(0, side, 40)] += 0.4
    image[:, 20:28, 40:48] += 0.3 * rng.standard_normal((len(image), 8, 8))
    return image.astype(np.float32)


def _fit_cells_and_pixels() -> None:
    """The fit on templates that need no optics."""
    grid = np.arange(_RANGE_UM[0] - _ORDER_UM, _RANGE_UM[1] + _ORDER_UM, _ORDER_UM / 300)
    turns = 4.0 * np.pi * 1.55e3 / _WAVELENGTHS
    templates = FlatTemplates(
        1.0 + 0.1 * np.cos(grid[:, None] * turns), float(grid[0]), _ORDER_UM / 300, _WAVELENGTHS
    )
    image = 0.1 * np.cos(_relief(128)[None] * turns[:, None, None])
    data = Amplitudes.from_arrays(_spoilt(image, 0.01), np.full(image.shape, 1e-4, np.float32))
    slip_probability(global_fit(data, templates, range_um=_RANGE_UM))


@functools.lru_cache(maxsize=1)
def _cube(side: int = 128) -> FringeCube:
    model = FringeModel.from_setup(_SETUP)
    response = model.response(_relief(side), _WAVELENGTHS)
    image = _spoilt(response / response.mean(axis=(1, 2), keepdims=True), 0.002)
    return FringeCube(
        image,
        np.full(image.shape, 4e-6, np.float32),
        np.zeros(image.shape, np.int16),
        FlatExposures(_WAVELENGTHS, np.array(2.0), np.array(183.15)),
        "relative",
    )


def _with_weak_pixels(cube: FringeCube) -> FringeCube:
    """With columns whose noise is as large as their fringes, so that they lean on the cells around them."""
    image, variance = cube.image.copy(), np.array(cube.variance)
    noise = 0.05
    image[:, :, 80:90] += noise * np.random.default_rng(2).standard_normal(image[:, :, 80:90].shape)
    variance[:, :, 80:90] = noise**2
    return replace(cube, image=image, variance=variance)


def _sky() -> None:
    """Response to the sky, and a frame."""
    model = FringeModel.from_setup("lsst_e2v")
    layer = _relief(64)
    response = sky_response(
        model, SkySpectrum.dark(), thickness_range_um=(float(layer.min()) - 0.1, float(layer.max()) + 0.1)
    )
    rows, wavelength = np.ones((2, 9)), np.full(2, 970.0)
    table = ResponseTable(float(layer.min()) - 1.0, 1.0, rows, wavelength, 0.0)
    sensor = SensorPlacement.of(model.setup.sensor(None), model.setup.pixel_scale_arcsec)
    field = FieldTable(table, 0.0, 1.0, sensor)
    for kind in (np.float32, np.float64):
        simulate_sky_frame(layer.astype(kind), model, response=response)
        field.frame(layer.astype(kind))


def _fits() -> None:
    """Both methods of the fit, from a cube to a map."""
    for method in ("global", "guo2022"):
        fit_thickness(_with_weak_pixels(_cube()), FringeModel.from_setup(_SETUP), method=method)


def _search() -> None:
    """A search among few cells."""
    options = SearchOptions(most_cells=400, most_effects=1, refits=1)
    discover(_cube(), _SETUP, rng=np.random.default_rng(1), options=options)


def _night() -> None:
    """Sums of a map that is held against a night."""
    layer = _relief(16)
    bands = np.cos(layer)[None]
    envelope = Envelope.of(1.0, layer, _ORDER_UM)
    sums = NightSums.of([(bands[0], np.ones(layer.shape))])
    _, side = sums.products(bands, layer, envelope)
    ShiftSums.of(sums, (bands, layer, envelope), side, bands, Splines.of(layer.shape, 1))


FIRST = {"thickness of cells and pixels": _fit_cells_and_pixels, "optics and sky": _sky, "night": _night}
"""Work that shares no compiled function, and can be done at the same time."""
THEN = {"fit of a cube": _fits, "search": _search}  # Work that needs what the first has compiled
