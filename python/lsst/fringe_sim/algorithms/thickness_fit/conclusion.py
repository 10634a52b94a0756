"""What a fit says of itself: model error in the uncertainty, numbers of each flat, and words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from ...array_types import Float32Array, FloatArray
from ...products import FlatFit
from .cells import Cells
from .nuisances import NuisanceFit
from .pixels import PixelFit
from .templates import FlatTemplates
from .wavelengths import spread_of_wavelengths

CERTAIN = 25.0
"""Chi-square difference to the next order of the whole sensor below which the order is not decided: flats that the
model does not describe have shown 19 for an order that was wrong."""
MISFIT = 1.1**2
"""Mean square of what is left of small blocks of pixels, over their variance, from which on the model is said not to
fit: it makes uncertainties larger by more than the tenth to which they are stated."""
_OUTLIER = 5.0  # Standard deviations beyond which a wavelength does not belong to its label
_BLOCKS = 16  # Blocks along a side of the sensor at most in the map of the contrast
_BLOCK_PX = 32  # Side of the blocks over which model error is judged [px]
_SIGNIFICANT = 3.0
_SOME = 512  # Rows and columns of which slopes are taken


def model_error(
    pixels: PixelFit, scale_sigma: float, learned_sigma_um: Float32Array | None = None
) -> PixelFit:
    """Uncertainties with the error of the model in them, which chi-square shows, and of what was learned of it.

    What a wrong model leaves over is the same in neighbouring pixels; in the direction of the thickness, where it
    cannot be seen, it is taken to be as large as in the others.

    ``scale_sigma``: standard uncertainty of the scale of the thickness; ``learned_sigma_um``: standard uncertainty
    of the thickness from the nuisances [µm], float32, ``(ny, nx)``.
    """
    most = int(pixels.n_wavelengths.max(initial=0))
    if most < 3:
        return pixels
    expected = 2.0 * float(gammaincinv(0.5 * (most - 1), 0.5)) / (most - 1)
    # A median has the scatter of a mean of about half as many numbers.
    scatter = _SIGNIFICANT * 1.5 * np.sqrt(2.0 / (most - 1))
    middle, count = _block_medians(pixels.chi2)
    excess = middle / expected
    for row, column in zip(*np.nonzero(excess > 1.0 + scatter / np.sqrt(count)), strict=True):
        part = tuple(slice(_BLOCK_PX * k, _BLOCK_PX * (k + 1)) for k in (row, column))
        pixels.sigma[part] *= np.float32(np.sqrt(excess[row, column]))
    if scale_sigma > 0.0:
        np.hypot(pixels.sigma, np.float32(scale_sigma) * pixels.value, out=pixels.sigma)
    if learned_sigma_um is not None:
        np.hypot(pixels.sigma, learned_sigma_um, out=pixels.sigma)
    return pixels


def _block_medians(values: Float32Array) -> tuple[Float32Array, NDArray[np.intp]]:
    """Median of every block, of every second row and column of it, and how many numbers it is of, at least one."""
    side = _BLOCK_PX // 2
    some = values[::2, ::2]
    down, across = (-(-length // side) for length in some.shape)
    padded = np.full((down * side, across * side), np.nan, np.float32)
    padded[: some.shape[0], : some.shape[1]] = some
    blocks = padded.reshape(down, side, across, side).swapaxes(1, 2).reshape(down, across, -1)
    blocks = np.sort(np.where(np.isfinite(blocks), blocks, np.float32(np.inf)), axis=-1)
    count = np.maximum(np.isfinite(blocks).sum(axis=-1), 1)
    pair = np.stack([(count - 1) // 2, count // 2], axis=-1)
    middle = np.take_along_axis(blocks, pair, axis=-1).mean(axis=-1)
    return np.where(np.isfinite(middle), middle, np.float32(0)), count


def contrast_map(cells: Cells, templates: FlatTemplates, thickness_um: Float32Array) -> Float32Array:
    """Contrast in blocks of cells over that of the templates, the thickness of each cell being free.

    ``thickness_um``: thickness of the cells [µm], float32, ``(ncy, ncx)``.
    """
    wavelengths = templates.n_wavelengths
    rows, columns = (np.array_split(np.arange(n), min(_BLOCKS, n)) for n in cells.shape)
    out = np.full((len(rows), len(columns)), np.nan, np.float32)
    table, step = templates.table(), templates.step_um
    for a, strip in enumerate(rows):
        place = (thickness_um[strip].astype(float) - templates.start_um) / step
        known = np.isfinite(place)
        at = np.clip(np.rint(np.where(known, place, 2.0)).astype(int), 1, len(table) - 2)
        model = table[at][..., :wavelengths]
        slope = (table[at + 1] - table[at - 1])[..., :wavelengths]
        weight = np.where(known[..., None], cells.weight[strip][..., :wavelengths], 0.0)
        value = cells.value[strip][..., :wavelengths]
        information = np.maximum((weight * slope**2).sum(axis=-1), 1e-30)
        along = (weight * slope * model).sum(axis=-1) / information
        across = model - along[..., None] * slope
        gain, norm = (weight * across * value).sum(axis=-1), (weight * across * model).sum(axis=-1)
        for b, part in enumerate(columns):
            if norm[:, part].sum() > 0.0:
                out[a, b] = gain[:, part].sum() / norm[:, part].sum()
    return out


def flat_fit(nuisance: NuisanceFit, wavelength_nm: FloatArray) -> FlatFit:
    """Numbers of each flat for a product."""
    misfit = nuisance.misfit if nuisance.misfit.size else np.ones(wavelength_nm.size)
    return FlatFit(
        wavelength_nm, nuisance.contrast, nuisance.contrast_sigma, nuisance.shift_nm, nuisance.shift_sigma_nm,
        misfit,
    )  # fmt: skip


def worst_flat(flats: FlatFit) -> tuple[int, float] | None:
    """The flat whose wavelength is farthest off its label, and by how many standard deviations; `None` if all fit."""
    if not np.any(flats.offset_sigma_nm > 0.0):
        return None
    others = spread_of_wavelengths(flats.offset_nm)
    away = np.abs(flats.offset_nm) / np.hypot(flats.offset_sigma_nm, others)
    worst = int(np.argmax(away))
    return (worst, float(away[worst])) if away[worst] > _OUTLIER else None


def cards(flats: FlatFit, margin: float, scale_sigma: float) -> dict[str, Any]:
    """Header keywords: contrast, misfit of cells, certainty of order and scale, the flat that does not fit."""
    weight = 1.0 / np.maximum(flats.contrast_sigma, 1e-9) ** 2
    found: dict[str, Any] = {
        "CONTRAST": round(float(flats.contrast.mean()), 6),
        "CONTRSIG": round(float(1.0 / np.sqrt(weight.sum())) if np.any(flats.contrast_sigma) else 0.0, 6),
        "CELLMISF": round(float(flats.misfit.mean()), 3),
        "ORDMARG": round(min(margin, 1e6), 1),
        "SCALESIG": float(f"{scale_sigma:.3g}"),
    }
    worst = worst_flat(flats)
    if worst is not None:
        found["WORSTFLT"] = float(flats.wavelength_nm[worst[0]])
        found["WORSTOFF"] = round(float(flats.offset_nm[worst[0]]), 3)
        found["WORSTSIG"] = round(worst[1], 1)
    return found


def slope_cards(thickness_um: Float32Array, order_um: float) -> dict[str, float]:
    """Header keywords: orders from one pixel to the next, and the contrast that is left of fringes so dense.

    A pixel averages the fringes over what the thickness changes within it, which the model does not: it has one
    thickness. Where they turn by an order within a pixel, nothing is left. Pixels that are masked count: they are
    where fringes are densest. Whole orders between neighbours do not, because one of both is in a wrong order.
    """
    some = [max(1, length // _SOME) for length in thickness_um.shape]
    steps = [np.diff(thickness_um[:: some[0]], axis=1), np.diff(thickness_um[:, :: some[1]], axis=0)]
    turns = [step[np.isfinite(step)] / order_um for step in steps]
    orders = [np.abs(turn - np.rint(turn)) for turn in turns]
    if not all(part.size for part in orders):
        return {}
    left = np.prod([np.abs(np.sinc(part)).mean() for part in orders])
    return {
        "SLOPEORD": round(math.hypot(*(float(np.median(part)) for part in orders)), 6),
        "SLOPECON": round(float(left), 6),
    }


def _said_of_misfit(metadata: Mapping[str, Any], flats: FlatFit) -> str:
    """Why small blocks of pixels do not fit, if the slopes tell; else where to look."""
    off = np.sqrt(float(metadata["CELLMISF"]))
    said = f"the model does not fit: small blocks of pixels are off by {off:.2f} times their noise"
    left = float(metadata.get("SLOPECON", 1.0))
    lost = 1.0 - left
    if lost > _OUTLIER * float(metadata["CONTRSIG"]) and lost > 0.5 * (1.0 - float(metadata["CONTRAST"])):
        return (
            f"{said}. The fringes are too dense for these pixels: the thickness changes by "
            f"{metadata['SLOPEORD']:.2f} orders from one to the next (median), so that a pixel averages over "
            f"fringes and a contrast of {left:.2g} is left. Nothing need be hidden in the flats; more pixels "
            "for the same slopes (of simulated flats a larger --size) would fit"
        )
    worst = flats.wavelength_nm[int(np.argmax(flats.misfit))]
    return f"{said}, most at {worst:g} nm; run 'fringe-sim discover' to find out why"


def says_misfit(metadata: Mapping[str, Any]) -> bool:
    """Whether a map says that model and flats do not go together, or that its order is not decided."""
    return (
        float(metadata.get("CELLMISF", 1.0)) > MISFIT
        or float(metadata.get("ORDMARG", CERTAIN)) < CERTAIN
        or "WORSTFLT" in metadata
    )


def remarks(metadata: Mapping[str, Any], flats: FlatFit | None) -> list[str]:
    """What a person should know of a fit first, in sentences.

    ``metadata``: header of a thickness map; ``flats``: what was learned of each flat.
    """
    if flats is None:
        return []
    said = ["contrast held at that of the model"]
    if flats.contrast_sigma.any():
        said = [
            f"contrast {metadata['CONTRAST']:.3g} ± {metadata['CONTRSIG']:.1g} of the model's "
            f"({flats.contrast.min():.3g} to {flats.contrast.max():.3g} over the wavelengths)"
        ]
    if float(metadata["SCALESIG"]) > 0.0:
        said.append(
            f"all thicknesses share an uncertainty of {metadata['SCALESIG']:.1g} of themselves, because the "
            f"wavelengths are off by {np.sqrt(np.mean(flats.offset_nm**2)):.2g} nm rms; σ contains it"
        )
    if float(metadata["CELLMISF"]) > MISFIT:
        said.append(_said_of_misfit(metadata, flats))
    if float(metadata["CELLMISF"]) < 1.0 / MISFIT:
        said.append(
            f"small blocks of pixels scatter by only {np.sqrt(float(metadata['CELLMISF'])):.2g} of their noise: σ is "
            "too large. The gain or the smoothing is another than stated, or the flats are simulated without noise"
        )
    if "WORSTFLT" in metadata:
        label, offset = metadata["WORSTFLT"], metadata["WORSTOFF"]
        said.append(
            f"{label:g} nm does not fit: {metadata['WORSTSIG']:.0f} sigma; its wavelength would have to be "
            f"{label + offset:.1f} nm"
        )
    margin = max(float(metadata["ORDMARG"]), 0.0)
    if margin < CERTAIN:
        said.append(
            f"the order of the sensor is not decided: another one is worse by a chi-square of only {margin:.1f}; all "
            "pixels are flagged SLIP. "
            "Flats over a wider range of wavelengths, or better known wavelengths, would decide"
        )
    return said
