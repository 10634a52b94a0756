"""Every pixel of a sensor whose silicon has been fitted beside its adhesive."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel, run_threaded, subkernel
from .amplitudes import Amplitudes
from .bands import BAND_ROWS, gather_pixels, load_band
from .conclusion import MISFIT
from .global_fit import GlobalFit, global_fit
from .nuisances import Nuisances
from .pixels import PixelFit
from .rescue import typical_misfit
from .silicon import STEPS_PER_SILICON_ORDER, find_silicon
from .silicon_result import SiliconFit, SiliconForecast, SiliconSearch
from .silicon_tables import SiliconModel, SiliconTables, silicon_free
from .templates import FlatTemplates
from .uncertainty import slip_probability

_STEPS = 3
_LONGEST = 0.1
_SURE = 0.01  # Probability of a wrong order below which a pixel of the first fit is believed
_MEAN_STRIDE = 4  # Every so many pixels of a row and a column enter the mean response
_LEAST_IN_MEAN = 20_000


@dataclass(frozen=True, eq=False)
class AdhesiveAndSilicon:
    """Adhesive of every pixel, and silicon of the sensor."""

    pixels: PixelFit  # the adhesive. Its uncertainty contains that of the silicon
    slip: Float32Array  # probability that the order of a pixel is wrong, float32, ``(ny, nx)``
    silicon: SiliconFit  # the silicon. If it is not decided, its fringes counted as noise of the flats
    found: GlobalFit  # the fit in which the orders of the adhesive were solved


def joint_fit(
    data: Amplitudes,
    templates: FlatTemplates,
    model: SiliconModel,
    search: SiliconSearch,
    *,
    range_um: tuple[float, float],
    cell_px: int | None = None,
    nuisances: Nuisances | None = None,
    threads: int = 2,
) -> AdhesiveAndSilicon:
    """Fit adhesive and silicon.

    ``range_um``: thicknesses of the adhesive that are possible [µm]; ``cell_px``: size of the cells on which orders
    are solved [px]; ``nuisances``: what is learned where the model does not fit; the silicon is then left as it is,
    as the fringes that would tell it lose contrast too.
    """
    free, blurred = silicon_free(data, templates, model)
    found = global_fit(free, blurred, range_um=range_um, cell_px=cell_px, threads=threads)
    if nuisances is not None and typical_misfit(found.pixels) > MISFIT:
        found = global_fit(
            free, blurred, range_um=range_um, cell_px=cell_px, nuisances=nuisances, threads=threads
        )
        slip = slip_probability(found, out=found.border_slip)
        return AdhesiveAndSilicon(found.pixels, slip, _unknown(search, templates.n_wavelengths), found)
    del free
    slip = slip_probability(found, out=found.border_slip)
    order = found.order_um
    silicon = find_silicon(data, _believed(found.pixels, slip), model, search, order)
    if not silicon.decided:
        return AdhesiveAndSilicon(found.pixels, slip, silicon, found)
    if search.degree == 0:
        fixed = replace(templates, response=model.templates(templates, float(silicon.coefficients[0])))
        fixed = replace(fixed, mean_response=fixed.response.mean(axis=0))
        found = global_fit(data, fixed, range_um=range_um, cell_px=cell_px, threads=threads)
        slip = slip_probability(found, out=found.border_slip)
    pixels = _fit_pixels(data, model, silicon, found.pixels, order, threads)
    return AdhesiveAndSilicon(pixels, slip, silicon, found)


def _unknown(search: SiliconSearch, wavelengths: int) -> SiliconFit:
    """Silicon as the model has it, because the flats are not as the model has them."""
    reason = "contrast or light of the flats is not that of the model"
    forecast = SiliconForecast(np.inf, 1.0, 0.0, np.zeros(wavelengths), False, reason)
    terms = search.terms(np.zeros(1), np.zeros(1)).shape[1]
    return SiliconFit(search, np.zeros(terms), np.zeros((terms, terms)), 0.0, 1.0, forecast)


def _believed(pixels: PixelFit, slip: Float32Array) -> Float32Array:
    """Thickness where the order is sure; NaN elsewhere."""
    good = (slip < _SURE) & np.isfinite(pixels.value) & np.isfinite(pixels.sigma)
    return np.where(good, pixels.value, np.float32(np.nan))


def _fit_pixels(
    data: Amplitudes, model: SiliconModel, silicon: SiliconFit, start: PixelFit, order_um: float, threads: int
) -> PixelFit:
    """Adhesive of every pixel at the silicon of its place."""
    shape = start.value.shape
    offset, sigma = (part.astype(np.float32) for part in silicon.offset_um((shape[0], shape[1])))
    known = start.value[np.isfinite(start.value)]
    tables = model.tables(
        (float(offset.min()), float(offset.max())),
        STEPS_PER_SILICON_ORDER,
        (max(float(known.min()) - order_um, 1e-3), float(known.max()) + order_um),
        order_um,
    )
    mean = _mean_response(data, tables, start, offset).astype(np.float32)
    padded = np.ones(tables.response.shape[2], np.float32)
    padded[: mean.size] = mean
    found = PixelFit(start.value.copy(), start.sigma.copy(), start.chi2.copy(), start.n_wavelengths)

    def work(band: int) -> None:
        rows = slice(band * BAND_ROWS, (band + 1) * BAND_ROWS)
        amplitude, weight = load_band(data, rows.start, rows.stop)
        place = (offset[rows], sigma[rows])
        _joint_band(amplitude, weight, tables, padded, order_um, *place, found.rows(rows))

    run_threaded(work, -(-shape[0] // BAND_ROWS), threads)
    return found


def _mean_response(
    data: Amplitudes, tables: SiliconTables, start: PixelFit, offset: Float32Array
) -> FloatArray:
    """Response by which a flat over its mean is to be multiplied: means of model and flat over the same pixels."""
    ny, nx = start.value.shape
    stride = _MEAN_STRIDE if ny * nx > _LEAST_IN_MEAN * _MEAN_STRIDE**2 else 1
    rows, columns = np.nonzero(np.isfinite(start.value[::stride, ::stride]))
    rows, columns = rows * stride, columns * stride
    bands = data.shape[0]
    value, weight = (array[:, :bands] for array in gather_pixels(data, rows, columns))
    response, _, _ = tables.at(offset[rows, columns].astype(float), start.value[rows, columns].astype(float))
    seen = weight > 0.0
    model = np.where(seen, response, 0.0).sum(axis=0)
    flat = np.where(seen, 1.0 + value, 0.0).sum(axis=0, dtype=float)
    return np.asarray(np.divide(model, flat, out=np.ones(bands), where=flat > 0.0))


@kernel
def _joint_band(amplitude, inverse, grid, mean, order, offset, sigma, pixels):  # type: ignore[no-untyped-def]
    """Pixels of some rows; those that left out a wavelength in the first fit stay as they are."""
    tables, silicon_start, silicon_step, start, step, _ = grid
    thickness, spread, reduced, used = pixels
    bands = amplitude.shape[0]
    rows, columns = thickness.shape
    padded = tables.shape[2]
    value, weight = np.zeros(padded), np.zeros(padded)
    cubic, slope = np.zeros(4), np.zeros(4)
    top = tables.shape[1] - 1.001
    for r in range(rows):
        for x in range(columns):
            if not np.isfinite(thickness[r, x]):
                continue
            count = 0
            for band in range(bands):
                weight[band] = 0.0
                if inverse[band, r, x] > 0.0:
                    count += 1
                    weight[band] = inverse[band, r, x] / (mean[band] * mean[band])
                value[band] = (1.0 + amplitude[band, r, x]) * mean[band]
            if count != used[r, x] or count < 2:
                continue
            place = (offset[r, x] - silicon_start) / silicon_step
            first = min(max(int(place) - 1, 0), tables.shape[0] - 4)
            _cubic(place - first, cubic, slope)
            at = min(max((thickness[r, x] - start) / step, 0.0), top)
            move, own, mixed, chi2 = 0.0, 0.0, 0.0, 0.0
            for _ in range(_STEPS):
                at = min(
                    max(at + min(max(move, -_LONGEST * order / step), _LONGEST * order / step), 0.0), top
                )
                below = int(at)
                share = at - below
                gain, own, mixed, chi2 = 0.0, 0.0, 0.0, 0.0
                for band in range(bands):
                    here, rise, along = 0.0, 0.0, 0.0
                    for k in range(4):
                        low = tables[first + k, below, band]
                        up = tables[first + k, below + 1, band] - low
                        here += cubic[k] * (low + share * up)
                        along += slope[k] * (low + share * up)
                        rise += cubic[k] * up
                    left = value[band] - here
                    gain += weight[band] * rise * left
                    own += weight[band] * rise * rise
                    mixed += weight[band] * rise * along
                    chi2 += weight[band] * left * left
                move = gain / own if own > 0.0 else 0.0
            if own <= 0.0:
                continue
            found = start + step * (at + move)
            if abs(found - thickness[r, x]) > 0.25 * order:
                continue
            thickness[r, x] = found
            # The silicon moves the adhesive along the valley of the likelihood.
            common = step * mixed / own * sigma[r, x] / silicon_step
            spread[r, x] = np.sqrt(step * step / own + common * common)
            reduced[r, x] = max(chi2 - gain * move, 0.0) / (count - 1)


@subkernel
def _cubic(place, value, slope):  # type: ignore[no-untyped-def]
    """Weights of nodes 0 to 3 for the value and the derivative of a cubic at a place between them."""
    for k in range(4):
        product, rate, scale = 1.0, 0.0, 1.0
        for j in range(4):
            if j != k:
                rate = rate * (place - j) + product
                product *= place - j
                scale *= k - j
        value[k], slope[k] = product / scale, rate / scale
