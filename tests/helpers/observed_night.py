"""A night of small frames with one fringe pattern, stars, slopes and amplifier steps, quickly made."""

from dataclasses import dataclass

import numpy as np

LEVEL = 2000.0


@dataclass(frozen=True)
class ObservedNight:
    """Frames in electrons, and the light of the fringes in each."""

    images: list[np.ndarray]
    fringes: list[np.ndarray]


def observed_night(
    rng: np.random.Generator, frames: int = 6, side: int = 96, strength: float = 0.02, stars: int = 8
) -> ObservedNight:
    """Two patterns, the second of a third of the strength, whose scales vary from frame to frame."""
    y, x = np.mgrid[:side, :side]
    patterns = [np.sin(x / 4.0 + 0.03 * y), np.sin(y / 3.0 - x / 11.0)]
    offset = np.arange(-7, 8)
    star = np.exp(-0.5 * (offset[:, None] ** 2 + offset**2) / 2.5)
    images, fringes = [], []
    for _ in range(frames):
        scales = strength * LEVEL * np.array([rng.uniform(0.6, 1.4), rng.uniform(-0.4, 0.4)])
        fringe = np.tensordot(scales, patterns, axes=1)
        sky = LEVEL * rng.uniform(0.8, 1.2) * (1.0 + 0.05 * rng.normal() * x / side + 0.02 * (x >= side // 2))
        for cy, cx in rng.integers(7, side - 7, (stars, 2)):
            sky[cy - 7 : cy + 8, cx - 7 : cx + 8] += rng.pareto(1.5) * 300.0 * star
        images.append(rng.poisson(sky + fringe).astype(np.float32))
        fringes.append(fringe)
    return ObservedNight(images, fringes)
