"""Curves and numbers that say where model and data disagree, and what a leftover looks like."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn
from scipy.ndimage import gaussian_filter, label
from scipy.special import chdtrc

from ...array_types import BoolArray, FloatArray
from ...effects import AMPLIFIERS, ImageGeometry
from ..flat_prep_options import GAUSSIAN_MAD
from .channels import Channel, State, fringe_phase
from .verdict import Where

PHASE_BINS = 16

FEWEST_ROWS = 16  # Rows and columns of cells from which on scales and places say something
PLACE_CELLS = 1.5  # Standard deviation of the window through which places are looked for [cells]
PLACE_SIGMA = 6.0  # Standard deviations by which a place fits worse than the rest of the sensor
LARGEST_PLACES = 0.25  # Part of the sensor beyond which a misfit is no longer one of places
MOST_PLACES = 5  # Places that are listed, the worst first


def disagreement(
    state: State,
    channels: tuple[Channel, ...],
    geometry: ImageGeometry,
    index: FloatArray,
    cell_px: int,
    filled: float = 1.0,
) -> Where:
    """Where a fit and the data disagree.

    ``filled``: part of the cells that the fit has data of; the others are 0 in its residual.
    """
    phase = fringe_phase(state.thickness_um, geometry.wavelength_nm, index)
    return Where(
        tuple(_by_wavelength(state, phase, geometry)),
        tuple(_by_amplifier(state, geometry)),
        _strongest_scale(state, cell_px, filled),
        tuple(_by_phase(state, phase)),
        tuple(
            {"name": c.name, "statistic": c.statistic, "degrees": c.degrees, "probability": c.probability}
            for c in channels
        ),
    )


def describe_residual(
    state: State,
    geometry: ImageGeometry,
    index: FloatArray,
    cell_px: int,
    channels: tuple[Channel, ...],
    filled: float = 1.0,
) -> dict[str, Any]:
    """What a leftover looks like, without a name: waveform, colour, scales, pattern of amplifiers, modes.

    ``filled``: see `disagreement`.
    """
    phase = fringe_phase(state.thickness_um, geometry.wavelength_nm, index)
    colour = []
    for plane, wavelength in enumerate(geometry.wavelength_nm):
        used = state.raw_residual[plane] != 0.0
        beyond = float((state.residual[plane][used] ** 2).mean() - 1.0) if used.any() else 0.0
        colour.append({"wavelength_nm": float(wavelength), "variance_beyond_noise": beyond})
    harmonics = []
    for harmonic in (1, 2, 3):
        cosine, sine, sigma = _harmonic(state, phase, harmonic)
        harmonics.append({"harmonic": harmonic, "cos": cosine, "sin": sine, "sigma": sigma})
    planes = state.residual.reshape(len(state.residual), -1)
    modes = np.linalg.svd(planes @ planes.T / (filled * planes.shape[1]), compute_uv=False)
    return {
        "channels": [c.name for c in sorted(channels, key=lambda c: c.probability) if c.probability < 1e-3],
        "wavelength": colour,
        "thickness_phase_waveform": _by_phase(state, phase),
        "harmonics": harmonics,
        "spatial_power": _radial_power(state, cell_px, filled),
        "amplifiers": _by_amplifier(state, geometry),
        "principal_modes": [float(x) for x in modes[:5]],
        "places": places_apart(state.residual, geometry),
    }


def places_apart(residual: FloatArray, geometry: ImageGeometry) -> list[dict[str, float]]:
    """Places of the sensor that fit worse than the rest of it, the worst first.

    ``residual`` (W, ny, nx): whitened residual; 0 where there are no data. Returns row and column of the middle
    and diameter of a disk of the same area [px], part of the excess of all places that lies here, and standard
    deviations of its worst cell. Empty where the misfit is everywhere.
    """
    number = (residual != 0.0).sum(axis=0)
    seen = number > 0
    if min(number.shape) < FEWEST_ROWS or not seen.any():
        return []
    sigma = _badness(residual, number)
    middle = float(np.median(sigma[seen]))
    sigma = (sigma - middle) / max(1.0, GAUSSIAN_MAD * float(np.median(np.abs(sigma[seen] - middle))))
    # Cells without data in the midst of a place do not cut it in two.
    bad = sigma > PLACE_SIGMA
    if (bad & seen).sum() > LARGEST_PLACES * seen.sum():
        return []
    excess = (residual**2).sum(axis=0) - number
    places = [place for place in _pieces(bad) if excess[place].sum() > 0.0]
    total = sum(float(excess[place].sum()) for place in places)
    cell_px = math.sqrt(geometry.cell_px[0] * geometry.cell_px[1])
    rows = []
    for place in places:
        weight = np.where(place, np.maximum(excess, 0.0), 0.0)
        rows.append(
            {
                "y_px": float((weight.sum(axis=1) * geometry.y_px).sum() / weight.sum()),
                "x_px": float((weight.sum(axis=0) * geometry.x_px).sum() / weight.sum()),
                "diameter_px": cell_px * 2.0 * math.sqrt(place.sum() / math.pi),
                "excess_share": float(excess[place].sum()) / total,
                "sigma": float(sigma[place & seen].max()),
            }
        )
    return sorted(rows, key=lambda row: -row["excess_share"])[:MOST_PLACES]


def _pieces(marked: BoolArray) -> list[BoolArray]:
    """Parts of an image that hang together."""
    number, found = label(marked)
    return [number == one for one in range(1, found + 1)]


def _badness(residual: FloatArray, number: NDArray[np.int_]) -> FloatArray:
    """Standard deviations by which the surroundings of every cell fit worse than noise, ``(ny, nx)``.

    A smoothed sum of squares is nearly a χ²; its cube root is nearly Gaussian (Wilson & Hilferty 1931).
    """
    degrees = number.astype(float)
    known = np.maximum(gaussian_filter(degrees, PLACE_CELLS), 1e-9)
    # The square of a Gaussian window is a narrower one, of this area.
    area = 1.0 / (4.0 * math.pi * PLACE_CELLS**2)
    variance = area * gaussian_filter(degrees, PLACE_CELLS / math.sqrt(2.0))
    width = 2.0 / 9.0 * variance / known**2
    ratio = gaussian_filter((residual**2).sum(axis=0), PLACE_CELLS) / known
    return np.asarray((np.cbrt(ratio) - 1.0 + width) / np.sqrt(np.maximum(width, 1e-300)))


def _by_wavelength(state: State, phase: FloatArray, geometry: ImageGeometry) -> list[dict[str, float]]:
    rows = []
    for plane, wavelength in enumerate(geometry.wavelength_nm):
        shapes = [f(h * phase[plane]) for h in (1, 2, 3) for f in (np.cos, np.sin)] + [
            np.ones(phase.shape[1:])
        ]
        root = state.root[plane]
        columns = np.stack([(root * shape).ravel() for shape in shapes], axis=1)
        data = (root * state.raw_residual[plane]).ravel()
        solution = np.linalg.lstsq(columns, data, rcond=None)[0]
        explained = float(data @ columns @ solution)
        rows.append(
            {"wavelength_nm": float(wavelength), "chi2": explained, "degrees": float(len(shapes)),
             "rms": float(np.sqrt((state.raw_residual[plane] ** 2).mean()))}
        )  # fmt: skip
    return rows


def _by_amplifier(state: State, geometry: ImageGeometry) -> list[dict[str, Any]]:
    place = geometry.amplifier
    common = state.root
    rows = []
    for number, name in enumerate(AMPLIFIERS):
        inside = place == number
        if not inside.any():
            continue
        weight = float((common[:, inside] ** 2).sum())
        if weight > 0.0:
            offset = float((common * state.residual)[:, inside].sum()) / weight
            rows.append({"amplifier": name, "offset": offset, "sigma": weight**-0.5})
    return rows


def _by_phase(state: State, phase: FloatArray) -> list[dict[str, float]]:
    turn = np.mod(phase / (2.0 * np.pi), 1.0)
    place = np.minimum((turn * PHASE_BINS).astype(int), PHASE_BINS - 1)
    weight = state.root**2
    rows = []
    for number in range(PHASE_BINS):
        inside = place == number
        total = float(weight[inside].sum())
        if total > 0.0:
            mean = float((weight * state.raw_residual)[inside].sum()) / total
            rows.append({"phase": (number + 0.5) / PHASE_BINS, "residual": mean, "sigma": total**-0.5})
    return rows


def _harmonic(state: State, phase: FloatArray, harmonic: int) -> tuple[float, float, float]:
    weight = state.root**2
    total = float(weight.sum())
    cosine = 2.0 * float((weight * state.raw_residual * np.cos(harmonic * phase)).sum()) / total
    sine = 2.0 * float((weight * state.raw_residual * np.sin(harmonic * phase)).sum()) / total
    return cosine, sine, float(np.sqrt(2.0 / total))


def _radial_power(state: State, cell_px: int, filled: float) -> list[dict[str, float]]:
    if min(state.thickness_um.shape) < FEWEST_ROWS:
        return []
    power = np.mean([dctn(plane, norm="ortho") ** 2 for plane in state.residual], axis=0)
    ny, nx = power.shape
    frequency = 0.5 * np.hypot(np.arange(ny)[:, None] / ny, np.arange(nx)[None, :] / nx)  # per cell
    edges = np.geomspace(1.0 / max(ny, nx), 0.7, 13)
    rows = []
    for low, high in itertools.pairwise(edges):
        inside = (frequency >= low) & (frequency < high)
        count = filled * int(inside.sum()) * len(state.residual)
        if count:
            mean = float(power[inside].mean()) / filled
            rows.append(
                {"scale_px": cell_px / float(np.sqrt(low * high)), "power": mean,
                 "probability": float(chdtrc(count, mean * count))}
            )  # fmt: skip
    return rows


def _strongest_scale(state: State, cell_px: int, filled: float) -> float:
    rows = [row for row in _radial_power(state, cell_px, filled) if row["probability"] < 1e-3]
    return max(rows, key=lambda row: row["power"])["scale_px"] if rows else 0.0
