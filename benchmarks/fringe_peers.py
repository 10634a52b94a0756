"""Fringes that several ways of correction leave, on the same frames of a simulator that none of them knows.

Every way gets the same training frames and corrects the same other ones. What is left is the light of the
fringes less what was subtracted, beside a smooth background, as a fraction of the light of the fringes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.ndimage import binary_dilation

from lsst.fringe_sim.algorithms.correction import AmplifierGrid, BackgroundTerms, fit_scales
from lsst.fringe_sim.algorithms.correction.empirical import TemplateOptions
from lsst.fringe_sim.algorithms.fringe_correction import CorrectionOptions, correct_fringes
from lsst.fringe_sim.algorithms.laboratory_shift import ADHESIVE_PHASE_SIGMA, template_pair
from lsst.fringe_sim.algorithms.map_on_sky import map_on_sky, reach_um
from lsst.fringe_sim.algorithms.observed_frames import make_templates
from lsst.fringe_sim.algorithms.sky_response import sky_response
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.products import FringeFrame, ObservedFrame, ThicknessMap

from ._table import Row, timed

__all__ = ["aperture_scale", "left_over", "median_template", "pca_fringes", "run"]

Image = np.ndarray
FRAMES, TRAINING = 20, 12
SIDE, AMPLIFIERS = 256, AmplifierGrid(2, 8)
NOW = "2026-01-01T00:00:00"
NIGHTS = ((2.25, 2700.0), (1.7, 2700.0), (2.25, 40000.0))
"""Focal ratio and electrons of the sky: fringes of a quarter, of a sixth, and of all of the noise of a pixel."""

COMPONENTS = 6
"""Components that fringez keeps."""

EMPCA_ROUNDS = 25
"""Rounds that empca makes by default."""

MAP_ERROR_UM = 0.02
"""Rms of a smooth error of the thickness map, 0.06 orders, that no way knows of."""


def run() -> list[Row]:
    """One row per way and telescope."""
    import sys
    from pathlib import Path

    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
    from foreign_sky import ForeignClutter, ForeignSky, foreign_map, foreign_night

    rows = []
    clutter = ForeignClutter(1.0, 0.05, gradient=0.03, amplifier_steps=0.002, moon=0.2)
    for ratio, electrons in NIGHTS:
        rng = np.random.default_rng(17)
        layer = foreign_map(rng, (SIDE, SIDE), 13.0, 14.6)
        night = foreign_night(ForeignSky(f_number=ratio), layer, rng, FRAMES, clutter, electrons=electrons)
        images, fringes = [each.image for each in night], [each.fringes for each in night]
        strength = np.median([each.fringes.std() / np.sqrt(each.sky.mean()) for each in night])
        work = f"fringes of {strength:.2f} of the noise, {TRAINING} frames of {SIDE}², {FRAMES - TRAINING} others"
        for name, way in {**WAYS, **map_ways(layer, ratio)}.items():
            subtracted, wall, cpu = timed(partial(way, images[:TRAINING], images[TRAINING:]))
            left = [left_over(f, s) for f, s in zip(fringes[TRAINING:], subtracted, strict=True)]
            spread = 125.0 * float(np.std(left, ddof=1)) / np.sqrt(len(left))
            parts = f"{100 * np.median(left):.1f} ± {spread:.1f} %"
            note = f"left: {parts} of the fringes, at most {100 * max(left):.0f} %"
            rows.append(Row(work, name, wall, cpu=cpu, note=note))
    return rows


def map_ways(layer_um: Image, f_number: float) -> dict[str, Callable[..., list[Image]]]:
    """Ways that begin with a thickness map, which is wrong, and with the lines and silicon of the package."""
    rng = np.random.default_rng(3)
    v, u = (np.linspace(-1.0, 1.0, side) for side in layer_um.shape)
    wave = np.sin(2.5 * u + rng.uniform(0.0, 6.0)) + np.cos(2.0 * v + rng.uniform(0.0, 6.0))[:, None]
    found_um = layer_um + MAP_ERROR_UM * (wave - wave.mean()) / wave.std()
    setup = replace(
        Setup.from_name("lsst_e2v"),
        beam_kind="cone",
        f_number=f_number,
        obscuration=0.61,
        temperature_k=173.15,
    )
    model = FringeModel.from_setup(setup)
    order_um = float(model.fringe_order_um(960.0))
    reach = reach_um(order_um)
    span = float(found_um.min()) - reach, float(found_um.max()) + reach
    response = sky_response(model, SkySpectrum.dark(), thickness_range_um=span)

    def templates_of(map_um: Image) -> list[FringeFrame]:
        return template_pair(map_um, model, response, ADHESIVE_PHASE_SIGMA, NOW)

    def by_map(training: Sequence[Image], others: Sequence[Image]) -> list[Image]:
        return corrected_by(templates_of(found_um), others)

    def by_both(training: Sequence[Image], others: Sequence[Image]) -> list[Image]:
        return corrected_by(observed_templates(training, templates_of(found_um)), others)

    moved: list[Image] = []

    def by_moved_map(training: Sequence[Image], others: Sequence[Image]) -> list[Image]:
        zero = np.zeros(found_um.shape)
        known = ThicknessMap(found_um, zero + 1e-3, zero, zero, zero.astype(int), "adhesive")
        loaders = [partial(frame_of, image) for image in training]
        options = CorrectionOptions(amplifiers=AMPLIFIERS)
        moved.append(map_on_sky(loaders, known, response, order_um, options).moved.value)
        return corrected_by(templates_of(moved[0]), others)

    def by_moved_and_frames(training: Sequence[Image], others: Sequence[Image]) -> list[Image]:
        return corrected_by(observed_templates(training, templates_of(moved[0])), others)

    return {
        "this package, a map that is off": by_map,
        "this package, that map and the frames": by_both,
        "this package, that map moved by fit-sky": by_moved_map,
        "this package, the moved map and the frames": by_moved_and_frames,
    }


def left_over(fringes: Image, subtracted: Image, amplifiers: AmplifierGrid | None = None) -> float:
    """Standard deviation of the fringes that are left over that of all, beside a smooth background."""
    grid = amplifiers or AMPLIFIERS
    background = BackgroundTerms((fringes.shape[0], fringes.shape[1]), amplifiers=grid)

    def beside(image: Image) -> float:
        fit = fit_scales(image, np.ones(image.shape), [], background, clip_sigma=np.inf)
        return float(np.std(image - background.surface(fit.coefficient)))

    return beside(fringes - subtracted) / beside(fringes)


def frame_of(image: Image) -> ObservedFrame:
    """The frame without a variance, as of a file that holds an image alone."""
    return ObservedFrame(image.astype(np.float32), np.zeros(image.shape, dtype=np.int32))


def observed_templates(training: Sequence[Image], prior: Sequence[FringeFrame] = ()) -> list[FringeFrame]:
    """Templates of the training frames."""
    loaders = [partial(frame_of, image) for image in training]
    return make_templates(loaders, NOW, TemplateOptions(amplifiers=AMPLIFIERS), prior).frames()


def corrected_by(templates: Sequence[FringeFrame], others: Sequence[Image]) -> list[Image]:
    """What a correction with templates subtracts."""
    options = CorrectionOptions(amplifiers=AMPLIFIERS)
    return [image - correct_fringes(image, templates, options=options).image for image in others]


def by_this_package(training: Sequence[Image], others: Sequence[Image]) -> list[Image]:
    return corrected_by(observed_templates(training), others)


def clipped_fraction(image: Image) -> tuple[Image, Image]:
    """Departure from a smooth background as a fraction of the sky, and pixels within three standard deviations of it.

    The background is ours, so that the ways differ in what they do with fringes only.
    """
    background = BackgroundTerms((image.shape[0], image.shape[1]))
    fit = fit_scales(image, np.ones(image.shape), [], background, clip_sigma=3.0)
    left = image - background.surface(fit.coefficient)
    spread = 1.4826 * np.median(np.abs(left))
    bright = binary_dilation(np.abs(left) > 3.0 * spread, iterations=2)
    return left / np.median(image), ~bright


def median_template(training: Sequence[Image]) -> Image:
    """Median of normalised frames without their bright pixels, as ccdproc or cp_pipe combine them."""
    fractions = [np.where(good, fraction, np.nan) for fraction, good in map(clipped_fraction, training)]
    template = np.nanmedian(np.stack(fractions), axis=0)
    return np.nan_to_num(template - np.nanmean(template))


def by_median(training: Sequence[Image], others: Sequence[Image]) -> list[Image]:
    """A median template, and one scale that takes most of the variance away."""
    template = median_template(training)
    subtracted = []
    for image in others:
        fraction, good = clipped_fraction(image)
        pattern = template[good] - template[good].mean()
        scale = float(pattern @ fraction[good] / (pattern @ pattern)) * np.median(image)
        subtracted.append(scale * template)
    return subtracted


def pca_fringes(
    training: Sequence[Image], others: Sequence[Image], components: int = COMPONENTS
) -> list[Image]:
    """Principal components of frames with outliers put to the median, as fringez has them (Medford et al. 2021)."""
    from sklearn.decomposition import PCA

    def flat(image: Image) -> tuple[Image, float]:
        left = clipped_fraction(image)[0] * np.median(image)
        deviation = float(np.median(np.abs(left)))
        kept = np.where(np.abs(left) < 5.0 * 1.48 * deviation, left, 0.0)
        return (kept / deviation).ravel(), deviation

    model = PCA(min(components, len(training))).fit([flat(image)[0] for image in training])
    subtracted = []
    for image in others:
        row, deviation = flat(image)
        made = model.inverse_transform(model.transform(row[None]))[0]
        subtracted.append(deviation * made.reshape(image.shape))
    return subtracted


def empca_fringes(training: Sequence[Image], others: Sequence[Image], components: int = 2) -> list[Image]:
    """Weighted components by expectation and maximisation (Bailey 2012, PASP 124, 1015), bright pixels left out."""
    rows, good = (np.array(each) for each in zip(*map(clipped_fraction, training), strict=True))
    rows, weight = rows.reshape(len(rows), -1), good.reshape(len(good), -1).astype(float)
    rng = np.random.default_rng(1)
    vectors = np.linalg.qr(rng.standard_normal((rows.shape[1], components)))[0].T

    def scores_of(row: Image, weights: Image) -> Image:
        return np.linalg.solve((vectors * weights) @ vectors.T, (vectors * weights) @ row)

    for _ in range(EMPCA_ROUNDS):
        scores = np.array([scores_of(*each) for each in zip(rows, weight, strict=True)])
        left = rows.copy()
        for k in range(components):
            own = scores[:, k, None]
            vectors[k] = (weight * own * left).sum(axis=0) / np.maximum((weight * own**2).sum(axis=0), 1e-300)
            left -= own * vectors[k]
        vectors = np.linalg.qr(vectors.T)[0].T
    subtracted = []
    for image in others:
        row, used = clipped_fraction(image)
        scores = scores_of(row.ravel(), used.ravel().astype(float))
        subtracted.append(np.median(image) * (scores @ vectors).reshape(image.shape))
    return subtracted


def aperture_scale(
    image: Image,
    template: Image,
    rng: np.random.Generator,
    statistic: Callable[[Image], float] = np.median,
    number: int = 30_000,
    small: int = 3,
    large: int = 30,
    clip: float = 3.0,
) -> float:
    """Scale of one template by the algorithm of ``FringeTask`` of ip_isr, with its defaults.

    At random places the statistic of a small square less that of a large one, on image and template; least squares
    without a constant, after outliers are left out beforehand and in each of twenty rounds.
    """
    ny, nx = image.shape
    places = np.stack([rng.integers(large, side - large, number) for side in (ny, nx)], axis=1)
    levels = np.array(
        [
            [
                statistic(each[y - small : y + small, x - small : x + small])
                - statistic(each[y - large : y + large, x - large : x + large])
                for each in (image, template)
            ]
            for y, x in places
        ]
    )

    def spread(values: Image) -> float:
        low, high = np.percentile(values, [25.0, 75.0])
        return float(0.74 * (high - low))

    for column in (0, 1):
        values = levels[:, column]
        levels = levels[np.abs(values - np.median(values)) < clip * spread(values)]
    scale = 0.0
    for _ in range(20):
        science, fringe = levels.T
        scale = float(fringe @ science / (fringe @ fringe))
        residual = science - scale * fringe
        keep = np.abs(residual) <= clip * spread(residual)
        if keep.all():
            break
        levels = levels[keep]
    return scale


def by_apertures(statistic: Callable[[Image], float], number: int) -> Callable[..., list[Image]]:
    def way(training: Sequence[Image], others: Sequence[Image]) -> list[Image]:
        template, rng = median_template(training), np.random.default_rng(1)
        return [aperture_scale(image, template, rng, statistic, number) * template for image in others]

    return way


WAYS: dict[str, Callable[[Sequence[Image], Sequence[Image]], list[Image]]] = {
    "this package": by_this_package,
    "median template, one scale (ccdproc, cp_pipe)": by_median,
    "median template, apertures with medians (ip_isr, 3000 places)": by_apertures(np.median, 3000),
    "median template, apertures with means (ip_isr, 3000 places)": by_apertures(np.mean, 3000),
    "principal components of clipped frames (fringez)": pca_fringes,
    "weighted components with missing pixels (empca, 2)": empca_fringes,
    "nothing": lambda _, others: [np.zeros(image.shape) for image in others],
}
