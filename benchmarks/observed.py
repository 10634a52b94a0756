"""One full frame with stars, corrected by two templates, and what stands beside it in other packages."""

from __future__ import annotations

from functools import partial

import numpy as np

from lsst.fringe_sim.algorithms.correction import AmplifierGrid
from lsst.fringe_sim.algorithms.correction import quality as gate
from lsst.fringe_sim.algorithms.fringe_correction import CorrectionOptions, TemplateSet, correct_fringes
from lsst.fringe_sim.algorithms.observed_frames import correct_frame
from lsst.fringe_sim.products import ObservedFrame

from ._table import Row, memory_watch, timed

__all__ = ["crowded_frame", "run"]

SIDE, STARS, LEVEL_E = 4096, 3000, 2700.0
APERTURE_PX = 100


def crowded_frame(rng: np.random.Generator, side: int = SIDE) -> tuple[ObservedFrame, np.ndarray]:
    """Frame [electrons] with stars, a slope and 16 amplifiers, and the two patterns of its fringes."""
    y, x = np.mgrid[:side, :side].astype(np.float32)
    phase = x / 11.0 + y / 17.0 + 2e-5 * (x - 0.4 * side) ** 2
    patterns = np.stack([np.sin(phase), np.cos(0.97 * phase)]).astype(np.float32) * np.float32(1e-3)
    sky = LEVEL_E * (1.0 + 1.0 * patterns[0] + 0.3 * patterns[1] + 0.02 * x / side)
    for row, gain in zip(np.array_split(sky, 2), 1.0 + 1e-3 * rng.standard_normal((2, 8)), strict=True):
        for part, factor in zip(np.array_split(row, 8, axis=1), gain, strict=True):
            part *= np.float32(factor)
    half = 40
    away = np.square(np.arange(-half, half + 1))
    star = (1.0 + (away[:, None] + away) / 5.0) ** -2.5 * 1.5 / (5.0 * np.pi)
    for cy, cx in rng.integers(half, side - half, (round(STARS * (side / SIDE) ** 2), 2)):
        sky[cy - half : cy + half + 1, cx - half : cx + half + 1] += min(500.0 / rng.uniform(), 2e6) * star
    image = (sky + np.sqrt(sky + 36.0) * rng.standard_normal(sky.shape, dtype=np.float32)).astype(np.float32)
    frame = ObservedFrame(image, np.zeros(image.shape, np.int32), np.maximum(image, 1.0) + np.float32(36.0))
    return frame, patterns


def run() -> list[Row]:
    """Fit and objects, gate, all of a frame with its record."""
    frame, patterns = crowded_frame(np.random.default_rng(5))
    known, options = TemplateSet.of(patterns), CorrectionOptions(amplifiers=AmplifierGrid(2, 8))
    work = f"frame of {SIDE} × {SIDE}, {STARS} stars, two templates"
    rows = []

    def row(name: str, function: partial[object]) -> object:
        made, wall, cpu = timed(function)
        rows.append(Row(work, name, wall, evaluations=frame.image.size, cpu=cpu))
        return made

    with memory_watch() as peak:
        fitted = partial(correct_fringes, frame.image, known, variance=frame.variance, options=options)
        done = row("scales, background and objects", fitted)
        fit = done.frame  # type: ignore[attr-defined]
        row("gate", partial(gate.prove, fit, fit.sums.weight, APERTURE_PX, known.variances))
        del done, fit
        made = row("all, with the record of the page", partial(_whole, frame, known, options))
    note = f"peak {peak[0]:.1f} GiB; {made}"
    rows[-1] = Row(work, rows[-1].method, rows[-1].seconds, frame.image.size, cpu=rows[-1].cpu, note=note)
    return rows


def _whole(frame: ObservedFrame, known: TemplateSet, options: CorrectionOptions) -> str:
    made = correct_frame(frame, known, options)
    made.record("frame")
    scales = ", ".join(
        f"{a:.2f} ± {b:.2f}" for a, b in zip(made.correction.scale, made.correction.sigma, strict=True)
    )
    return f"scales {scales}; {100.0 * made.proof.part_left:.1f} ± {100.0 * made.proof.part_left_sigma:.1f} % left"
