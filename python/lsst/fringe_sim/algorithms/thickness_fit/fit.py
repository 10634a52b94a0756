"""From a cube of flats to a map of thickness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ...array_types import Float32Array, FloatArray
from ...compiled import kernel, one_blas_thread, processors, run_threaded
from ...errors import InputError, OutOfRangeError, UnknownNameError, named_units
from ...model import FringeModel
from ...optics.system import OBSERVABLES
from ...products import FlatFit, FringeCube, ThicknessMap, mask_bits, refuse_noiseless
from ..flat_conditions import model_of_flats
from ..thickness_fit_options import CONTRASTS, FIT_METHODS
from .amplitudes import Amplitudes
from .cells import sample_pixels
from .conclusion import CERTAIN, cards, flat_fit, slope_cards
from .global_fit import global_fit
from .guo2022 import walk_fit
from .islands import fit_islands
from .joint import joint_fit
from .mean_response import normalise_to_cells, spans_orders
from .nuisances import Nuisances
from .pixels import PixelFit
from .rescue import chi2_limits, typical_misfit
from .silicon_result import SiliconSearch
from .silicon_tables import SiliconModel
from .templates import FlatTemplates
from .uncertainty import lone_slip_probability, slip_probability

STEPS_PER_ORDER = 300
"""Template thicknesses in one fringe order: 1 nm of epoxy; linear interpolation is then good to 3e-5 of the swing."""
FEWEST_WAVELENGTHS = 4
"""With fewer wavelengths than this a pixel is flagged: phase, order and fit quality cannot all be told."""
_TURNING_NM = 0.1
"""Step of the derivative in wavelength: a fringe of the thickest layer then turns by less than 0.1 rad."""
_TURNING_STRIDE = 10
_ROWS = 64  # Rows that are flagged at a time by one thread


@named_units
@one_blas_thread
def fit_thickness(
    cube: FringeCube,
    model: FringeModel,
    method: str = "global",
    *,
    range_um: tuple[float, float] | None = None,
    observable: str | None = None,
    start_pixel: tuple[int, int] | None = None,
    cell_px: int | None = None,
    noise_correlation_px: float | None = None,
    nuisances: Nuisances | None = None,
    contrast: str = "wavelength",
    slip_limit: float = 0.01,
    silicon: SiliconSearch | None = None,
    threads: int | None = None,
) -> ThicknessMap:
    """Thickness of the varying layer at every pixel of a sensor.

    Parameters
    ----------
    cube : `FringeCube`
        Flats of one sensor, in any order of wavelengths.
    model : `FringeModel`
        Its response, divided by its mean over the sensor, is compared with the flats, divided by theirs.
    method : {"global", "guo2022"}, optional
        ``global`` solves the fringe order of the whole sensor at once. ``guo2022`` is the walk from pixel to
        pixel of the paper, section 3.3.
    range_um : `tuple` [`float`, `float`], optional
        Thicknesses that are possible [µm]; those of the set-up if not given.
    observable : {"detection", "total"}, optional
        What a pixel responds to; that of ``model`` if not given. ``total`` is 1 - R - T of the whole stack,
        as in the paper's code; its fringes are out of step with those of the detection layer by half an order.
    start_pixel : `tuple` [`int`, `int`], optional
        Row and column at which the walk of ``guo2022`` begins; the middle of the sensor if not given.
    cell_px : `int`, optional
        Size of the cells on which ``global`` solves the orders [px]; chosen from the data if not given.
    noise_correlation_px : `float`, optional
        Standard deviation of the Gaussian kernel with which the flats were smoothed [px]. If not given, the
        keyword ``SMOOTHPX`` of the cube's metadata, else 0.
    nuisances : `Nuisances`, optional
        What else than thickness is free; only with ``global``. By default (`Nuisances.automatic`): the contrast,
        levels of amplifiers as well as gains are known, a slow illumination, and wavelengths as well as they are
        known. ``Nuisances()`` takes the model as it is.
    contrast : {"wavelength", "common", "fixed"}, optional
        Contrast of the fringes if no ``nuisances`` are given: a free factor at each wavelength, one for all, or that
        of the model.
    slip_limit : `float`, optional
        Pixels whose order is wrong with a larger probability are flagged SLIP.
    silicon : `SiliconSearch`, optional
        Fit the thickness of the silicon too, which flats with a narrow line tell. Only with ``global``, and without
        nuisances. If the flats cannot tell, the fringes of the silicon count as noise and the
        keyword ``SIFIT`` of the map is false; ``SIWHY`` says why.
    threads : `int`, optional
        Number of threads; that of `compiled.processors` if not given. Has no influence on the result.

    Returns
    -------
    thickness : `ThicknessMap`
        Masked pixels keep their value where there is one. Planes: NO_DATA (nothing to fit), LOW_SIGNAL (fewer
        than four wavelengths), SLIP (the order may be wrong), SUSPECT (improbable chi-square).

    Raises
    ------
    UnknownNameError
        An unknown method or observable.
    InputError, OutOfRangeError
        No good pixel, simulated flats without noise, a range that holds less than two orders, a start pixel
        outside the sensor.
    """
    if contrast not in CONTRASTS:
        raise UnknownNameError("contrast", contrast, CONTRASTS)
    if method not in FIT_METHODS:
        raise UnknownNameError("method", method, FIT_METHODS)
    if method == "guo2022" and nuisances is not None and nuisances.any:
        raise InputError("nuisances", nuisances, "none with method guo2022, which has none")
    if silicon is not None and (method == "guo2022" or (nuisances is not None and nuisances.any)):
        raise InputError("silicon", silicon, "fixed with method guo2022, and beside nuisances")
    if not 0.0 < slip_limit <= 1.0:
        raise OutOfRangeError("slip limit", slip_limit, "above 0, at most 1")
    refuse_noiseless(cube.metadata, cube.detector or None)
    workers = processors() if threads is None else threads
    if not any((plane == 0).any() for plane in cube.mask):
        raise InputError("good pixels of the cube", 0, "one or more", source=cube.detector or None)
    model = model_of_flats(model, cube.exposures)
    data = amplitudes_from_cube(cube, noise_correlation_px)
    low, high = range_um or model.setup.thickness_range_um
    templates = make_templates(model, cube.wavelength_nm, (low, high), observable)
    free = nuisances or Nuisances.automatic(contrast, model.setup.wavelength_accuracy_nm)
    free = replace(free, grid=model.setup.amplifier_grid)
    flats: FlatFit | None = None
    coarse: Float32Array | None = None
    notes: dict[str, Any] = {"METHOD": method, "RANGELO": low, "RANGEHI": high}
    notes["OBSERVAB"] = observable or model.base_system.observable
    if method == "guo2022":
        start = start_pixel or (data.shape[1] // 2, data.shape[2] // 2)
        pixels, fitted = _repeated_walk(data, templates, start, (low, high), workers)
        slip = lone_slip_probability(data, fitted, pixels.value, fitted.order_um(), workers)
        notes |= {"STARTROW": start[0], "STARTCOL": start[1]}
    elif silicon is not None:
        seen = model if observable is None else with_observable(model, observable)
        exposures = cube.exposures
        any_silicon = SiliconModel(seen, exposures.wavelength_nm, exposures.bandwidth_fwhm_nm)
        joint = joint_fit(
            data, templates, any_silicon, silicon, range_um=(low, high), cell_px=cell_px,
            nuisances=free, threads=workers,
        )  # fmt: skip
        if joint.found.nuisance.misfit.size:
            flats = flat_fit(joint.found.nuisance, np.asarray(cube.wavelength_nm, dtype=float))
            coarse = joint.found.contrast_map
            notes |= cards(flats, joint.found.margin, joint.found.nuisance.scale_sigma)
        pixels, slip = joint.pixels, joint.slip
        notes |= {"ORDERUM": round(joint.found.order_um, 6), **joint.silicon.cards()}
    else:
        found = global_fit(
            data, templates, range_um=(low, high), cell_px=cell_px, nuisances=free, threads=workers
        )
        pixels = found.pixels
        slip = slip_probability(found, out=found.border_slip)
        notes |= {"ORDERUM": round(found.order_um, 6), "NORMALIS": found.normalisation}
        notes["CELLPX"] = int(np.diff(found.cells.y_edges).max())
        flats = flat_fit(found.nuisance, np.asarray(cube.wavelength_nm, dtype=float))
        coarse = found.contrast_map
        notes |= cards(flats, found.margin, found.nuisance.scale_sigma)
    # The probability of another order trusts the model; where the model is wrong, a small margin is all that tells.
    limit = slip_limit if float(notes.get("ORDMARG", CERTAIN)) >= CERTAIN else -1.0
    everywhere = _assemble(pixels, slip, limit, cube, model.base_system.varying, notes, workers)
    everywhere = replace(everywhere, flats=flats, contrast_map=coarse)
    return fit_islands(everywhere, cube, model if observable is None else with_observable(model, observable))


def amplitudes_from_cube(cube: FringeCube, noise_correlation_px: float | None = None) -> Amplitudes:
    """Fringe amplitudes of a cube: counts over their mean over the sensor, less one.

    ``cube``: flats; a cube in electrons is divided by the mean of its good pixels, a relative one is left as it is;
    ``noise_correlation_px``: see `fit_thickness`. Raises `InputError`: a wavelength without a good pixel, or with a
    mean that is not positive.
    """
    if noise_correlation_px is None:
        noise_correlation_px = float(cube.metadata.get("SMOOTHPX") or 0.0)
    scale = np.ones(len(cube.wavelength_nm))
    if cube.unit == "electron":
        for band, wavelength in enumerate(cube.wavelength_nm):
            good = cube.mask[band] == 0
            mean = float(np.mean(cube.image[band], where=good, dtype=float)) if good.any() else 0.0
            if not mean > 0.0:
                raise InputError(f"mean level at {wavelength:g} nm", mean, "a positive number of electrons")
            scale[band] = 1.0 / mean
    return Amplitudes(cube.image, cube.variance, cube.mask, scale, noise_correlation_px)


def make_templates(
    model: FringeModel,
    wavelength_nm: FloatArray,
    range_um: tuple[float, float],
    observable: str | None = None,
) -> FlatTemplates:
    """Templates of a model over a range of thickness, with a margin of one order on both sides.

    Parameters
    ----------
    model : `FringeModel`
        The model.
    wavelength_nm : `numpy.ndarray`, shape ``(n_wavelengths,)``
        Nominal wavelengths [nm].
    range_um : `tuple` [`float`, `float`]
        Thicknesses that are possible [µm].
    observable : {"detection", "total"}, optional
        See `fit_thickness`.

    Raises
    ------
    UnknownNameError
        An unknown observable.
    OutOfRangeError
        A range that is not positive and increasing.
    """
    low, high = range_um
    if not 0.0 < low < high < np.inf:
        raise OutOfRangeError("thickness range [um]", (low, high), "two increasing, positive numbers")
    if observable is not None:
        model = with_observable(model, observable)
    system = model.system
    index = system.stack.indices(wavelength_nm, system.temperature_k)[system.stack.position(system.varying)]
    order = float(np.mean(1e-3 * wavelength_nm / (2.0 * index.real)))
    step = order / STEPS_PER_ORDER
    start = max(low - order, step)
    count = int(np.ceil((high + order - start) / step)) + 1
    response = model.response_on_grid(wavelength_nm, start, step, count)
    response = np.ascontiguousarray(response.T)
    near = system.stack.indices(wavelength_nm + 1.0, system.temperature_k)[
        system.stack.position(system.varying)
    ]
    group = 1.0 - wavelength_nm * (near.real - index.real) / index.real
    beside = _turn_beside(model, wavelength_nm, response, group, (start, step))
    return FlatTemplates(response, start, step, wavelength_nm, group=group, beside_um=beside)


def _turn_beside(
    model: FringeModel,
    wavelength_nm: FloatArray,
    response: FloatArray,
    group: FloatArray,
    grid_um: tuple[float, float],
) -> FloatArray:
    """What the thin layers beside the varying one add to how its fringe turns, as `FlatTemplates` takes it.

    The derivative of the response in wavelength is that in thickness times a straight line in thickness, whose slope
    is the group index, and a change of level and swing.
    """
    start, step = grid_um
    sparse = slice(1, len(response) - 1, _TURNING_STRIDE)
    count = len(range(*sparse.indices(len(response))))
    ahead, behind = (
        model.response_on_grid(wavelength_nm + side, start + step, step * _TURNING_STRIDE, count)
        for side in (_TURNING_NM, -_TURNING_NM)
    )
    turned = (ahead - behind) / (2.0 * _TURNING_NM)
    slope = -np.gradient(response, step, axis=0)[sparse].T / wavelength_nm[:, None]
    thickness = start + step + step * _TURNING_STRIDE * np.arange(count)
    beside = np.zeros(wavelength_nm.size)
    for band, level in enumerate(response[sparse].T):
        rest = turned[band] - slope[band] * thickness * group[band]
        terms = np.stack([slope[band], level, thickness * level, np.ones(count)], axis=1)
        beside[band] = np.linalg.lstsq(terms, rest, rcond=None)[0][0]
    return beside


def with_observable(model: FringeModel, observable: str) -> FringeModel:
    """The model with another observable.

    Raises `UnknownNameError`: there is no such observable.
    """
    if observable not in OBSERVABLES:
        raise UnknownNameError("observable", observable, OBSERVABLES)
    return replace(model, base_system=replace(model.base_system, observable=observable))


def _repeated_walk(
    data: Amplitudes,
    templates: FlatTemplates,
    start: tuple[int, int],
    range_um: tuple[float, float],
    threads: int,
) -> tuple[PixelFit, FlatTemplates]:
    """Walk twice: the mean response over the sensor is known after the first time."""
    first = walk_fit(data, templates, start_pixel=start, range_um=range_um, threads=threads)
    sample = sample_pixels(data)
    seen = first.value[np.ix_(sample.y_edges[:-1], sample.x_edges[:-1])]
    if not spans_orders(seen, templates.order_um()):
        return first, templates
    _, fitted = normalise_to_cells(sample, templates, seen, threads)
    return walk_fit(data, fitted, start_pixel=start, range_um=range_um, threads=threads), fitted


def _assemble(
    pixels: PixelFit,
    slip: Float32Array,
    slip_limit: float,
    cube: FringeCube,
    layer: str,
    notes: Mapping[str, Any],
    threads: int,
) -> ThicknessMap:
    used = pixels.n_wavelengths
    if not used.any():
        raise InputError("pixels", "all masked", "at least one good pixel")
    scale = typical_misfit(pixels)
    limit = np.asarray(scale * chi2_limits(int(used.max())), np.float32)
    bits = np.array([mask_bits(name) for name in ("NO_DATA", "LOW_SIGNAL", "SLIP", "SUSPECT")], np.int32)
    mask = np.empty(used.shape, np.int32)

    def flag(band: int) -> None:
        rows = slice(band * _ROWS, (band + 1) * _ROWS)
        _flag_rows(
            used[rows], pixels.sigma[rows], pixels.chi2[rows], slip[rows], limit, slip_limit, bits, mask[rows]
        )

    run_threaded(flag, -(-len(mask) // _ROWS), threads)
    notes = dict(notes) | {"NWAVE": len(cube.wavelength_nm), "MISFIT": round(scale, 4)}
    if "ORDERUM" in notes:
        notes |= slope_cards(pixels.value, notes["ORDERUM"])
    return ThicknessMap(
        pixels.value, pixels.sigma, pixels.chi2, slip, mask, layer, notes, used, cube.detector
    )


@kernel
def _flag_rows(used, sigma, chi2, slip, limit, slip_limit, bits, mask):  # type: ignore[no-untyped-def]
    """Mask planes of some rows; ``bits`` are those of NO_DATA, LOW_SIGNAL, SLIP and SUSPECT."""
    for r in range(used.shape[0]):
        for x in range(used.shape[1]):
            number = used[r, x]
            flags = bits[0] if number == 0 else np.int32(0)
            flags |= bits[1] if number < FEWEST_WAVELENGTHS or not np.isfinite(sigma[r, x]) else np.int32(0)
            flags |= bits[2] if slip[r, x] > slip_limit else np.int32(0)
            flags |= bits[3] if chi2[r, x] > limit[number] else np.int32(0)
            mask[r, x] = flags
