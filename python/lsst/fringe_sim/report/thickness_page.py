"""Page of a thickness fit: the map, the flats, data and model over the fringe phase, what is left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy import units
from astropy.table import Table
from numpy.typing import NDArray

from ..algorithms.flat_residual import flat_residual, relative_flats
from ..algorithms.thickness_fit import remarks, says_misfit
from ..model import FringeModel
from ..products import FlatFit, FringeCube, SensorSection, ThicknessMap
from .figures import contrast_figure, flats_figure, phase_figure, residuals_figure, thickness_figure
from .page import Origin, Report
from .words import masked_text, of_sensor, sigma_text

PERCENT = 100.0
PHASE_BINS = 32
RMS = "rms of flat − model"


def write_thickness_report(
    folder: Path,
    cube: FringeCube,
    fitted: ThicknessMap,
    model: FringeModel,
    method: str,
    *,
    section: SensorSection | None = None,
    origin: Origin | None = None,
) -> Path:
    """One page with the map, the flats and the comparison of both; the whole map lies beside it.

    ``section``: pixels of the sensor that the flats show, where that is known. ``origin``: command, and pages of
    what it was given.
    """
    wavelength = [float(w) for w in cube.wavelength_nm]
    report = Report(
        f"Thickness of {fitted.layer}, {fitted.detector or 'one sensor'}",
        f"Set-up {model.setup.name}, method {method}, {len(wavelength)} flats.",
        origin or Origin(),
    )
    left = residual_of_fit(cube, model, fitted)
    residuals = residual_table(left, cube)
    report.summary(_summary(cube, fitted, residuals, section))
    said = remarks(fitted.metadata, fitted.flats)
    if said:
        text = ". ".join(line[0].upper() + line[1:] for line in said)
        report.section("What the fit says of itself", f"{text}.")
    order_um = float(model.fringe_order_um(960.0))
    report.section("Thickness", "One contour is one fringe order at 960 nm.")
    report.figure(thickness_figure(fitted, order_um), "Fitted thickness and its uncertainty.")
    report.map(folder / "thickness.png", fitted.value, mask=fitted.mask, unit="µm")
    report.section("Flats", "Counts over their mean, minus one.")
    report.figure(
        flats_figure(relative_flats(cube), cube.mask, wavelength), "Prepared flats on one scale of colours."
    )
    report.section(
        "Data and model", "Folded on the fitted thickness, modulo one fringe order of each wavelength."
    )
    phase, data, modelled = phase_folded(cube, fitted, model)
    report.figure(
        phase_figure(phase, data, modelled, wavelength),
        "Mean of all pixels of equal fringe phase. Points: flats; line: model at the fitted thickness.",
    )
    report.section(
        "Residuals",
        "Flats minus the model at the fitted thickness, where the fit is good, averaged until the noise of pixels "
        "hides nothing, and over the noise that is left: a model that fits leaves colours without a pattern.",
    )
    noise = np.asarray(residuals["noise"], dtype=float) / PERCENT
    report.figure(residuals_figure(left, wavelength, noise), "All wavelengths on one scale of colours.")
    report.table(residuals, "flat_residuals")
    _add_flats(report, fitted)
    return report.write(folder / "report.html")


def _summary(
    cube: FringeCube, fitted: ThicknessMap, residuals: Table, section: SensorSection | None
) -> list[tuple[str, str]]:
    good = fitted.mask == 0
    value = fitted.value[good]
    low, middle, high = np.percentile(value, [0.0, 50.0, 100.0]) if value.size else [np.nan] * 3
    rms, noise = (float(np.sqrt(np.nanmean(np.square(residuals[name])))) for name in (RMS, "noise"))
    wavelength = cube.wavelength_nm
    fits = "does not describe the flats" if says_misfit(fitted.metadata) else "describes the flats"
    return [
        ("result", f"The model {fits}; thickness {middle:.2f} µm (median)"),
        ("thickness", f"{low:.2f} to {high:.2f} µm"),
        ("median σ of a pixel", sigma_text(fitted.sigma[good])),
        ("flats minus model, rms", f"{rms:.3g} %, {rms / noise:.3g} times the noise"),
        ("pixels a fringe order off, expected", f"{float(fitted.slip_probability[good].sum()):.2g}"),
        ("masked", masked_text(fitted.mask)),
        ("fitted part", of_sensor(fitted.shape, section)),
        ("flats", f"{len(wavelength)} from {min(wavelength):g} to {max(wavelength):g} nm"),
    ]


def _add_flats(report: Report, fitted: ThicknessMap) -> None:
    """What the fit says of each flat, and of parts of the sensor."""
    if fitted.flats is None:
        return
    report.section(
        "Flat by flat", "Misfit: mean square of what is left over in small cells, over their variance."
    )
    report.table(flat_table(fitted.flats), "flats")
    if fitted.contrast_map is not None and fitted.contrast_map.size > 1:
        report.figure(
            contrast_figure(fitted.contrast_map, fitted.shape[0] / len(fitted.contrast_map)),
            "Contrast in blocks, over that of the whole.",
        )


def residual_of_fit(cube: FringeCube, model: FringeModel, fitted: ThicknessMap) -> NDArray[np.float32]:
    """Flats minus model, shape ``(W, ny, nx)``; NaN where flat or thickness are masked."""
    if not (fitted.mask == 0).any():
        return np.full(cube.shape, np.nan, np.float32)
    return flat_residual(cube, model, np.where(fitted.mask == 0, fitted.value, np.nan), fitted.contrast)


def flat_table(flats: FlatFit) -> Table:
    """What the fit learned of each flat."""
    table = Table(
        {
            "wavelength": flats.wavelength_nm,
            "contrast": flats.contrast,
            "σ of contrast": flats.contrast_sigma,
            "offset": flats.offset_nm,
            "σ of offset": flats.offset_sigma_nm,
            "misfit": flats.misfit,
        }
    )
    for name in ("wavelength", "offset", "σ of offset"):
        table[name].unit = units.nm
    table["wavelength"].info.format = "g"
    return table


def residual_table(residual: NDArray[np.float32], cube: FringeCube) -> Table:
    """Rms of data minus model at each wavelength, beside the noise that the variances foretell."""
    rows = []
    for plane, left in enumerate(residual):
        good = np.isfinite(left)
        level = float(cube.image[plane][good].mean(dtype=float)) if good.any() else np.nan
        noise = float(np.sqrt(cube.variance[plane][good].mean(dtype=float))) / level if good.any() else np.nan
        rms = float(np.sqrt(np.mean(np.square(left[good], dtype=float)))) if good.any() else np.nan
        rows.append((float(cube.wavelength_nm[plane]), PERCENT * rms, PERCENT * noise, rms / noise))
    table = Table(rows=rows, names=("wavelength", RMS, "noise", "ratio"))
    for name, unit in (("wavelength", units.nm), (RMS, units.percent), ("noise", units.percent)):
        table[name].unit = unit
    table["wavelength"].info.format = "g"
    return table


def phase_folded(
    cube: FringeCube, fitted: ThicknessMap, model: FringeModel
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mean amplitude of data and model in bins of fringe phase; shapes ``(B,)``, ``(W, B)``, ``(W, B)``."""
    phase = (np.arange(PHASE_BINS) + 0.5) / PHASE_BINS
    good = (fitted.mask == 0) & (cube.mask == 0).all(axis=0)
    thickness = np.asarray(fitted.value, dtype=float)[good]
    if thickness.size == 0:
        empty = np.full((len(cube.wavelength_nm), PHASE_BINS), np.nan)
        return phase, empty, empty
    low = float(thickness.min())
    step = 1e-3
    count = int(np.ceil((float(thickness.max()) - low) / step)) + 2
    table = model.response_on_grid(cube.wavelength_nm, low, step, count)
    place = (thickness - low) / step
    index = np.minimum(place.astype(int), count - 2)
    fraction = place - index
    measured = np.empty((len(table), PHASE_BINS))
    modelled = np.empty_like(measured)
    order_of = model.fringe_order_um(cube.wavelength_nm)
    for row, (values, order_um) in enumerate(zip(table, order_of, strict=True)):
        orders = thickness / order_um
        bins = np.minimum(((orders - np.floor(orders)) * PHASE_BINS).astype(int), PHASE_BINS - 1)
        weight = np.maximum(np.bincount(bins, minlength=PHASE_BINS), 1)
        predicted = values[index] * (1.0 - fraction) + values[index + 1] * fraction
        predicted = (predicted / predicted.mean() - 1.0) * (
            1.0 if fitted.contrast is None else fitted.contrast[row]
        )
        flat = np.asarray(cube.image[row], dtype=float)[good]
        measured[row] = np.bincount(bins, flat / flat.mean() - 1.0, PHASE_BINS) / weight
        modelled[row] = np.bincount(bins, predicted, PHASE_BINS) / weight
    return phase, measured, modelled
