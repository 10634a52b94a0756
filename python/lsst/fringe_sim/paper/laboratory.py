"""Laboratory flats: Figures 2 and 4 to 7, section 3.3."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import median_filter

from ..algorithms.single_pixel import fit_single_pixel, published_pixel
from ..algorithms.thickness_fit import fit_thickness
from ..array_types import FloatArray
from ..mock.raw_frames import setup_optics
from ..mock.thickness import E2V_SHAPE
from ..model import FringeModel
from ..products import FlatExposures, FringeCube
from .section import Context, Curve, Graph, PaperSection, Picture, columns, missing

PERCENT = 100.0
LAB = "ts8_e2v"
WAVELENGTH_NM = 960.0
SEARCH_UM = (5.0, 30.0)
SEARCH_STEP_UM = 0.002
MAP_RANGE_UM = (14.0, 22.0)  # Colour range of the published map

FIT_NOISE = 2e-3
FIT_CONTRAST = 0.15  # Brings the simulated flats to the measured contrast of about 2 %

FIT_SHAPE = (200, 204)

FOREIGN_SILICON = "Si_schinke2015"
FOREIGN_ERROR_NM = 0.5  # Accuracy of the wavelengths of the stand [nm]

FOREIGN_GRADIENT = 0.02
ROW = 3015  # Row 3000 of the frame trimmed by 15 rows

MEASURED_FLAT = "E2V-321_960nm_flat_measured.fits"
MEASURED_MAP = "RTM-020_S01_E2V-321_epoxy_map.fits"
MEASURED_LOWEST_UM = 14.022
ROW_TREND = 4
RAFT = (
    ("S20", "E2V-350"),
    ("S21", "E2V-365"),
    ("S22", "E2V-361"),
    ("S10", "E2V-364"),
    ("S11", "E2V-357"),
    ("S12", "E2V-363"),
    ("S00", "E2V-319"),
    ("S01", "E2V-321"),
    ("S02", "E2V-359"),
)
"""Slots of RTM-020 and serial numbers of their sensors, upper row of the raft first."""


def one_pixel(context: Context) -> PaperSection:
    """Figure 4."""
    wavelength, amplitude = published_pixel()
    detection = FringeModel.from_setup(context.setup(LAB))
    total = FringeModel.from_setup(context.setup(LAB), observable="total")
    absolute, predicted, searched, misfit_total = _fit_as_published(wavelength, amplitude, total)
    damped = fit_single_pixel(wavelength, amplitude, detection, free_contrast=True, free_offset=True)
    curves = [Curve(wavelength, PERCENT * amplitude, "measured", "o")]
    for name, thickness, model in (
        ("1 − R − T", absolute, predicted),
        ("detection layer, contrast and offset free", damped.thickness_um, damped.predicted),
    ):
        rms = PERCENT * np.sqrt(np.mean((amplitude - model) ** 2))
        label = f"{name}: {thickness:.2f} µm, rms {rms:.2f} %"
        curves.append(Curve(wavelength, PERCENT * model, label, "--"))
    misfit = (
        Curve(searched, PERCENT * misfit_total, "1 − R − T"),
        Curve(damped.searched_um, PERCENT * damped.searched_rms, "detection layer, contrast and offset free"),
    )
    return PaperSection(
        "One pixel: Fig. 4",
        "Twelve flats at pixel (2100, 2100) of E2V-CCD250-321, as published, fitted by exhaustive search.",
        {"pixel_total": absolute, "pixel_contrast": damped.contrast},
        (
            Graph("measured and fitted", "wavelength [nm]", "fringe amplitude [%]", tuple(curves)),
            Graph("misfit at every thickness", "adhesive [µm]", "rms misfit [%]", misfit, logarithmic=True),
        ),
        "Left: the data and two fits. Right: many fringe orders fit nearly alike.",
    )


def _fit_as_published(
    wavelength_nm: FloatArray, amplitude: FloatArray, model: FringeModel
) -> tuple[float, FloatArray, NDArray[np.floating], FloatArray]:
    """Best thickness in the range of the published map, with 1 − R − T less its mean, not divided by it.

    Returns best thickness [µm], the model there, all thicknesses that were tried [µm] and the misfit of each.
    """
    low, high = SEARCH_UM
    searched = low + SEARCH_STEP_UM * np.arange(int((high - low) / SEARCH_STEP_UM) + 1)
    response = model.response_on_grid(wavelength_nm, low, SEARCH_STEP_UM, len(searched))
    departure = response - response.mean(axis=1, keepdims=True)
    misfit = np.sqrt(((amplitude[:, None] - departure) ** 2).mean(axis=0))
    possible = np.where((searched >= MAP_RANGE_UM[0]) & (searched <= MAP_RANGE_UM[1]), misfit, np.inf)
    best = int(np.argmin(possible))
    return float(searched[best]), departure[:, best], searched, misfit


def flat_contrast(context: Context) -> PaperSection:
    """Figures 2, 5 and 6 and the first row of Table 2."""
    phase = (np.arange(256) + 0.5) / 256.0
    lab = context.setup(LAB)
    detection, total = (FringeModel.from_setup(lab, observable=each) for each in ("detection", "total"))
    order = float(total.fringe_order_um(WAVELENGTH_NM))
    layer = 17.0 // order * order + phase * order
    absolute = total.response(layer, [WAVELENGTH_NM])[0]
    relative = detection.response(layer, [WAVELENGTH_NM])[0]
    relative = relative / relative.mean() - 1.0
    values = {
        "flat_total": PERCENT * 0.5 * float(np.ptp(absolute)),
        "flat_detection": PERCENT * 0.5 * float(np.ptp(relative)),
        "flat_fundamental": PERCENT * _fundamental(absolute),
        **missing("flat_measured"),
    }
    normalised = absolute / absolute.mean() - 1.0
    curves = [
        Curve(phase, PERCENT * normalised, "1 − R − T, over its mean"),
        Curve(phase, PERCENT * relative, "detection layer, over its mean"),
    ]
    folded = context.curve("E2V-321_960nm_phase_folded")
    if folded is not None:
        place, measured, simulated = columns(folded, "phase", "measured", "simulated")
        values["flat_measured"] = _fundamental(normalised) / _fundamental(measured)
        # The zero of the published phase is that of its thickness, fitted with 1 − R − T.
        curves.append(Curve(place, PERCENT * measured, "measured (Fig. 2, folded)", "."))
        curves.append(Curve(place, PERCENT * simulated, "simulated as published (Fig. 5)", "--"))
    flat = detection.response(context.thickness_um, [WAVELENGTH_NM])[0]
    picture = PERCENT * (flat / flat.mean() - 1.0)
    return PaperSection(
        "Flats at 960 nm: Figs. 2, 5, 6 and Table 2",
        "What the model says about a flat in parallel light of 2 nm bandwidth, for both observables. The contrast of "
        "the laboratory is the open question of the paper: see the errata.",
        values,
        (
            Graph("one fringe order", "thickness / fringe order", "fringe amplitude [%]", tuple(curves)),
            Picture("detection layer", "flat / mean − 1 [%]", picture, True, context.step_px),
            Picture("adhesive", "thickness [µm]", context.thickness_um, step_px=context.step_px),
        ),
        "Fringe profile at 960 nm, the flat of the whole sensor, and the thickness that makes it.",
    )


def row_3000(context: Context) -> PaperSection:
    """Figure 6."""
    names = ("row_phase", "row_ratio", "row_correlation")
    text = (
        "Row 3000 of the 960 nm flat (the figure calls it a column), beside 1 − R − T on the published map."
    )
    flat, layer = context.map_path(MEASURED_FLAT), context.map_path(MEASURED_MAP)
    if flat is None or layer is None:
        return PaperSection("A row: Fig. 6", f"{text} Flat and map are not at hand.", missing(*names))
    columns, measured, thickness = _row(flat, layer)
    total = FringeModel.from_setup(context.setup(LAB), observable="total")
    response = total.response(thickness, [WAVELENGTH_NM])[0]
    simulated = response - response.mean()
    phase = 2.0 * np.pi * thickness / float(total.fringe_order_um(WAVELENGTH_NM))
    places = np.linspace(-1.0, 1.0, len(columns))
    trend: FloatArray = np.asarray(np.polynomial.legendre.legvander(places, ROW_TREND), dtype=np.float64)
    seen, drawn = (_fitted_fringe(trend, phase, values) for values in (measured, simulated))
    level = trend @ np.linalg.lstsq(trend, measured, rcond=None)[0]
    values = {
        "row_phase": float(np.angle(drawn / seen)) / (2.0 * np.pi),
        "row_ratio": abs(drawn) / abs(seen),
        "row_correlation": float(np.corrcoef(measured - level, simulated)[0, 1]),
    }
    curves = (
        Curve(columns, PERCENT * (measured - level), "measured (Fig. 2), less its trend", "."),
        Curve(columns, PERCENT * simulated, "1 − R − T less its mean, as published"),
    )
    return PaperSection(
        "A row: Fig. 6",
        f"{text} Pixels of the figure are single ones, with the noise of photons; the paper smooths them.",
        values,
        (Graph("row 3000", "column [px]", "fringe amplitude [%]", curves),),
        "Data and simulation along a row.",
    )


def _row(flat: Path, layer: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Columns, measured amplitudes and published thickness [µm] of the row of the figure nearest to it."""
    with fits.open(flat) as hdus:
        image = hdus[0].data.astype(float)
        rows, columns = (hdus[name].data.astype(float) for name in ("YSRC", "XSRC"))
    near = int(np.argmin(np.abs(rows - ROW)))
    with fits.open(layer) as hdus:
        places = hdus["YSRC"].data.astype(float), hdus["XSRC"].data.astype(float)
        interpolate = RegularGridInterpolator(places, hdus["FINE"].data.astype(float) + MEASURED_LOWEST_UM)
    inside = (columns >= places[1][0]) & (columns <= places[1][-1])
    at = columns[inside]
    thickness = interpolate(np.stack([np.full(at.shape, rows[near]), at], axis=1))
    return at, image[near, inside] / np.nanmean(image) - 1.0, np.asarray(thickness, dtype=float)


def _fitted_fringe(trend: FloatArray, phase: FloatArray, values: FloatArray) -> complex:
    """Complex amplitude of a fringe whose phase is known, beside a trend."""
    columns = np.concatenate([trend, np.stack([np.cos(phase), np.sin(phase)], axis=1)], axis=1)
    found = np.linalg.lstsq(columns, values, rcond=None)[0]
    return complex(found[-2], -found[-1])


def thickness_fit(context: Context) -> PaperSection:
    """Section 3.3, on flats whose thickness is known: of the model that is fitted, and of another one."""
    model = FringeModel.from_setup(context.setup(LAB), {"contrast_loss.factor": FIT_CONTRAST})
    detail = context.detail_um[: FIT_SHAPE[0], : FIT_SHAPE[1]]
    order = float(model.fringe_order_um(WAVELENGTH_NM))
    wavelength = np.array(model.setup.wavelengths_nm)
    own = model.response(detail, wavelength)
    other = _foreign_light(detail, wavelength)
    values, pictures = {}, []
    for kind, light, suffix in (("own model", own, ""), ("other model", other, "_foreign")):
        cube = _flats(model, light, context.rng("thickness fit"))
        for method, item in (("guo2022", "walk_slips"), ("global", "global_slips")):
            fitted = fit_thickness(cube, model, method, threads=2)
            wrong = np.asarray(fitted.value, dtype=float) - detail
            # Pixels that the fit itself flags as doubtful count too: the paper flags none.
            good = np.isfinite(wrong)
            values[item + suffix] = PERCENT * float((np.abs(wrong[good]) > 0.5 * order).mean())
            name = {"guo2022": "walk from pixel to pixel", "global": "all pixels at once"}[method]
            picture = 1e3 * np.where(good, wrong, np.nan)
            pictures.append(Picture(f"{name}, {kind}", "fitted − true [nm]", picture, True))
    return PaperSection(
        "Thickness fit: section 3.3",
        f"{len(wavelength)} simulated flats of {detail.shape[1]} × {detail.shape[0]} px with "
        f"{PERCENT * FIT_NOISE:g} % of noise and the measured contrast of 2 %, fitted with the algorithm of the "
        "paper and with the one that is the default here. Both use the detection layer. The flats are first of the "
        "model that is fitted, then of another simulator: its own sum over films and line, another table of "
        f"silicon, wavelengths off by {FOREIGN_ERROR_NM:g} nm in turn and light that falls by "
        f"{PERCENT * FOREIGN_GRADIENT:g} % over the part.",
        values,
        tuple(pictures),
        "Error of the fitted thickness.",
    )


def _foreign_light(layer: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
    """Flats of the independent simulator, with what the fitted model does not have."""
    errors = FOREIGN_ERROR_NM * (-1.0) ** np.arange(len(wavelength_nm))
    optics = replace(
        setup_optics(LAB, FOREIGN_SILICON)[0],
        coherent_part=FIT_CONTRAST,
        wavelength_errors_nm=tuple(zip(wavelength_nm.tolist(), errors.tolist(), strict=True)),
    )
    table = optics.table((float(layer.min()), float(layer.max())), wavelength_nm.tolist())
    slope = 1.0 + FOREIGN_GRADIENT * np.linspace(-0.5, 0.5, layer.shape[1])
    return np.stack([slope * table.evaluate(row, layer) for row in range(len(wavelength_nm))])


def raft(context: Context) -> PaperSection:
    """Figure 7."""
    text = "Flats at 960 nm from the published maps of the nine sensors, as 1 − R − T, on one scale."
    paths = [
        (f"{slot} {serial}", context.map_path(f"RTM-020_{slot}_{serial}_epoxy_map.fits"))
        for slot, serial in RAFT
    ]
    if not all(path for _, path in paths):
        return PaperSection("Raft: Fig. 7", f"{text} The maps are not at hand.", missing("row_jumps"))
    model = FringeModel.from_setup(context.setup(LAB), observable="total")
    order = float(model.fringe_order_um(WAVELENGTH_NM))
    pictures, jumping = [], 0
    for title, path in paths:
        with fits.open(path) as hdus:
            relative = hdus["FINE"].data.astype(float)
        jumping += row_jumps(relative, order) > 0
        # Only the range of each map is published, not its zero.
        layer = relative - np.nanmin(relative) + MAP_RANGE_UM[0]
        table = model.table((float(np.nanmin(layer)), float(np.nanmax(layer))), [WAVELENGTH_NM])
        image = table.lookup(layer)[0]
        flat = PERCENT * (image / image.mean() - 1.0)
        pictures.append(Picture(title, "flat / mean − 1 [%]", flat, True, E2V_SHAPE[0] / len(flat)))
    values = {"row_jumps": float(jumping)}
    return PaperSection("Raft: Fig. 7", text, values, tuple(pictures), "The nine sensors of RTM-020.")


def row_jumps(thickness_um: FloatArray, order_um: float) -> int:
    """Number of successive rows between which a map jumps by whole fringe orders.

    ``thickness_um`` ``(ny, nx)``: thickness [µm].
    ``order_um``: thickness of one fringe order [µm].
    """
    steps = np.median(np.diff(thickness_um, axis=0), axis=1)
    # A sensor changes slowly: a jump is a step unlike the steps around it.
    beyond = steps - median_filter(steps, 7, mode="nearest")
    return int(np.count_nonzero(np.rint(beyond / order_um)))


def _fundamental(profile: FloatArray) -> float:
    """Amplitude of the first harmonic of one period."""
    return float(2.0 * np.abs(np.fft.rfft(profile)[1]) / len(profile))


def _flats(model: FringeModel, light: FloatArray, rng: np.random.Generator) -> FringeCube:
    """Flats over their means, with white noise, at the wavelengths of the model's set-up."""
    setup = model.setup
    wavelength = np.array(setup.wavelengths_nm)
    clean = light / light.mean(axis=(1, 2), keepdims=True)
    image = (clean + FIT_NOISE * rng.standard_normal(clean.shape)).astype(np.float32)
    exposures = FlatExposures(
        wavelength, np.array(setup.bandwidth_fwhm_nm), np.array(setup.temperature_k), np.array(np.inf)
    )
    variance = np.full(image.shape, FIT_NOISE**2, dtype=np.float32)
    return FringeCube(image, variance, np.zeros(image.shape, dtype=np.int16), exposures, unit="relative")
