"""Templates from observed frames: weighted principal components of frames without background and objects."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import BoolArray, Float32Array, FloatArray
from ...errors import InputError, UndeterminedError
from ...notebook import do_nothing
from .background import AMPLIFIERS_UNKNOWN, SPACING_PX, AmplifierGrid, BackgroundTerms
from .denoise import shrink_noise
from .objects import fit_frame
from .scales import refuse_part_without_sky, sky_is_subtracted
from .sums import four_digits

__all__ = ["ObservedTemplates", "TemplateOptions", "fit_templates"]

IN_MEMORY = 512 * 2**20
"""Bytes of frames beyond which they lie in a file, so that memory does not grow with their number."""

BAND_BYTES = 64 * 2**20  # Bytes of all frames that are worked on at a time
LEARNING_ROUNDS = 3  # Times that background and objects are found anew with the fringes known so far

STEPS, SETTLED = 6, 1e-4
"""Most alternations between scores and patterns, each a weighted least-squares solution given the other, and the
change of the projection on the scores below which they end."""

LEARNING_STEPS = 2  # Alternations in all learning rounds but the last

MOST_VARIANCE = 20.0
"""Variance of a pixel of a pattern over the usual one beyond which the frames that see it do not decide it."""

ROUNDING = 1e-6  # Part of a sum in single precision below which a difference from it is rounding
ROWS = 64  # Rows that are converted to float64 at a time

JUDGED_ROWS, STRIPS = 256, 2
"""Rows of a strip of the sensor, and the number of strips that tell the number of templates where the frames do not
fit into memory: a template that a frame holds with a hundredth of the noise of a pixel has a scale of ten
standard deviations in a million pixels."""

FOLDS = 4  # Groups of frames, each of which is left out in turn

CHECK_PX = 16
"""Side of the squares of a chequerboard: scores from the white ones predict the black ones, and the other way
round."""


@dataclass(frozen=True)
class TemplateOptions:
    """How templates are made.

    Attributes
    ----------
    components : `int` or `None`
        Number of templates; `None` for as many as predict frames that were left out.
    most : `int`
        Largest number that is tried.
    least_frames : `int`
        Frames that must see a pixel.
    spacing_px : `float`
        Distance between the knots of the background [px].
    amplifiers : `AmplifierGrid`
        Amplifiers with levels of their own; by default the frame tells whether levels differ (`LevelSpread`).
    """

    components: int | None = None
    most: int = 4
    least_frames: int = 3
    spacing_px: float = SPACING_PX
    amplifiers: AmplifierGrid = AMPLIFIERS_UNKNOWN


@dataclass(frozen=True, eq=False)
class ObservedTemplates:
    """Templates and what they were made of.

    Attributes
    ----------
    patterns : `numpy.ndarray`, float32, shape ``(K, ny, nx)``
        Templates in units of the sky, strongest first.
    variance : `numpy.ndarray`, float32, shape ``(K, ny, nx)``
        Variance of their noise.
    coverage : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Frames that see each pixel.
    scores : `numpy.ndarray`, shape ``(N, K)``
        Scale of every template in every frame, in the unit of the frames.
    gain : `numpy.ndarray`
        What 0, 1, 2, … templates take of the squared pulls of frames that they were not made of, as far as they were
        tried; empty if their number was given.
    per_sky : `bool`
        Whether the frames have a sky, of which the templates are parts; or in the unit of the frames.
    """

    patterns: Float32Array
    variance: Float32Array
    coverage: NDArray[np.int32]
    scores: FloatArray
    gain: FloatArray
    per_sky: bool = True


def fit_templates(
    frames: Sequence[Callable[[], tuple[NDArray[Any], Float32Array]]],
    options: TemplateOptions | None = None,
    prior: Sequence[Float32Array] = (),
    advance: Callable[[], None] = do_nothing,
) -> ObservedTemplates:
    """Find the fringes that frames of one sensor share.

    Parameters
    ----------
    frames : sequence of callables
        Each returns the image of a frame and the weight of its pixels (`steady_weight`), both of shape ``(ny, nx)``.
        One is asked at a time, and again in every round.
    options : `TemplateOptions`, optional
        How.
    prior : sequence of `numpy.ndarray`, optional
        Patterns that are expected, as those of a model: what the frames do not decide is taken from them.
    advance : callable, optional
        Called after each frame of each round.

    Raises
    ------
    InputError
        Frames of different shapes, or some without their sky.
    UndeterminedError
        No template predicts frames that it was not made of.

    Notes
    -----
    Frame j is ``B_j + Σ_k a_jk T_k`` and noise. Given the scores a, every pixel of the templates is a weighted mean
    over the frames that see it; given the templates, the scores of a frame are a weighted fit over its pixels. Both
    are repeated in turn (weighted principal components, Bailey 2012, PASP 124, 1015), with the noise taken out of the
    templates in between (`shrink_noise`).
    """
    chosen = options or TemplateOptions()
    shape = frames[0]()[0].shape
    background = BackgroundTerms(shape, chosen.spacing_px, chosen.amplifiers)
    with _Stack(len(frames), shape) as stack:
        patterns: list[Float32Array] = list(prior)
        level, bare = np.ones(len(frames)), np.zeros(len(frames), dtype=bool)
        found: _Decomposition | None = None
        gain = np.zeros(0)
        number = chosen.components or 1
        for turn in range(LEARNING_ROUNDS):
            for place, frame in enumerate(frames):
                level[place], bare[place] = stack.fill(place, frame, patterns, background)
                advance()
            refuse_part_without_sky(bare)
            if turn == LEARNING_ROUNDS - 1 and chosen.components is None:
                gain = _held_out_gain(*stack.strips(prior), min(chosen.most, len(frames) // 3))
                number = int(np.argmax(gain))
                if number == 0:
                    raise UndeterminedError(
                        "gain of a template in frames that it was not made of", four_digits(gain[1]),
                        "above 0: more frames, or stronger fringes",
                    )  # fmt: skip
            # Only the last patterns are wanted to the end; the others tell fringes from objects.
            steps = STEPS if turn == LEARNING_ROUNDS - 1 else LEARNING_STEPS
            start = None if found is None else found.scores
            found = _decompose(stack, number, prior, scores=start, steps=steps)
            patterns = list(found.patterns)
        coverage = stack.coverage()
    assert found is not None
    unit = _per_sky(found.scores, np.where(bare, 1.0, level))
    return ObservedTemplates(
        (found.patterns * unit[:, None, None]).astype(np.float32),
        (found.variance * unit[:, None, None] ** 2).astype(np.float32),
        coverage,
        found.scores / unit,
        gain,
        not bare.any(),
    )


def _per_sky(scores: FloatArray, level: FloatArray) -> FloatArray:
    """Factor of each pattern after which a frame of sky b holds it with a scale of about b."""
    strength = np.sqrt((scores**2).sum(axis=0) / (level**2).sum())
    return np.asarray(np.where(scores.T @ level < 0, -strength, strength))


class _Stack:
    """Frames less their backgrounds, and the weights of their pixels, in memory or in a file."""

    def __init__(self, frames: int, shape: tuple[int, int], *, in_memory: bool = False) -> None:
        size = (frames, *shape)
        self._file: Any = None
        if 8 * int(np.prod(size)) > IN_MEMORY and not in_memory:
            self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by __exit__
            both: Float32Array = np.memmap(self._file, dtype=np.float32, shape=(2, *size), mode="w+")
        else:
            both = np.zeros((2, *size), dtype=np.float32)
        self.values, self.weight = both
        self.frames, self.shape = frames, shape

    def __enter__(self) -> _Stack:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def fill(
        self,
        place: int,
        frame: Callable[[], tuple[NDArray[Any], Float32Array]],
        patterns: Sequence[Float32Array],
        background: BackgroundTerms,
    ) -> tuple[float, bool]:
        """Take background and objects off a frame; the level of its sky, and whether that was subtracted before."""
        image, weight = frame()
        if image.shape != self.shape:
            raise InputError(f"shape of frame {place}", image.shape, f"{self.shape}, as of the first")
        made = fit_frame(image, weight, patterns, background)
        kept = np.where(made.objects, 0, made.fit.weight)
        self.weight[place] = kept / max(made.fit.chi2_per_pixel, 1e-30)
        self.values[place] = np.where(kept > 0, image - made.background, 0)
        level, middle = (float(np.median(each)) for each in (made.background, self.weight[place][kept > 0]))
        return level, sky_is_subtracted(level, 1.0 / math.sqrt(middle))

    def bands(self) -> list[slice]:
        rows = max(1, BAND_BYTES // (4 * self.frames * self.shape[1]))
        return [slice(start, start + rows) for start in range(0, self.shape[0], rows)]

    def strips(self, prior: Sequence[Float32Array]) -> tuple[_Stack, list[Float32Array]]:
        """Some strips of all frames, and of the patterns that are expected, which memory holds."""
        if self._file is None or self.shape[0] <= STRIPS * JUDGED_ROWS:
            return self, list(prior)
        first = np.linspace(0, self.shape[0] - JUDGED_ROWS, STRIPS + 2)[1:-1].astype(int)
        rows = np.unique(first[:, None] + np.arange(JUDGED_ROWS))
        part = _Stack(self.frames, (rows.size, self.shape[1]), in_memory=True)
        for frame in range(self.frames):
            part.values[frame], part.weight[frame] = self.values[frame, rows], self.weight[frame, rows]
        return part, [each[rows] for each in prior]

    def coverage(self) -> NDArray[np.int32]:
        seen = np.zeros(self.shape, dtype=np.int32)
        for weight in self.weight:
            seen += weight > 0
        return seen


@dataclass(frozen=True, eq=False)
class _Decomposition:
    patterns: Float32Array
    variance: Float32Array
    scores: FloatArray


def _decompose(
    stack: _Stack,
    number: int,
    prior: Sequence[Float32Array],
    frames: NDArray[Any] | None = None,
    scores: FloatArray | None = None,
    steps: int = STEPS,
) -> _Decomposition:
    """Patterns and scores of some frames, of all by default, beginning with scores if they are given."""
    chosen = np.arange(stack.frames) if frames is None else frames
    if scores is None or scores.shape[1] != number:
        scores = _first_scores(stack, number, prior, chosen)
    before = np.zeros((chosen.size, number))
    for _ in range(steps):
        orthonormal, _ = np.linalg.qr(scores)
        if np.abs(orthonormal @ orthonormal.T - before @ before.T).max() < SETTLED:
            break
        before = orthonormal
        patterns, variance, known = _patterns_of(stack, orthonormal, chosen)
        # Orthonormal scores give all patterns the same noise; among these the principal ones are orthogonal.
        _, turn = np.linalg.eigh(_gram(patterns))
        patterns = np.tensordot(turn.T[::-1].astype(np.float32), patterns, axes=1)
        patterns, variance = _shrunk(patterns, variance, known, prior)
        scores = _scores_of(stack, patterns, chosen)
    return _Decomposition(patterns, variance, scores)


def _gram(patterns: Float32Array) -> FloatArray:
    """Sums of products of patterns, single precision within a row only."""
    return np.asarray(
        np.einsum("kyx,lyx->kly", patterns, patterns, optimize=True).sum(axis=2, dtype=np.float64)
    )


def _shrunk(
    patterns: Float32Array, variance: Float32Array, known: BoolArray, prior: Sequence[Float32Array]
) -> tuple[Float32Array, Float32Array]:
    made, left = np.empty_like(patterns), np.empty_like(patterns)
    basis = np.stack([each[known] for each in prior], axis=1) if prior else None
    for number, pattern in enumerate(patterns):
        expected: Any = np.float32(0.0)
        if basis is not None:
            factor = np.linalg.lstsq(basis, pattern[known], rcond=None)[0]
            expected = np.tensordot(factor, np.stack(list(prior)), axes=1).astype(np.float32)
        departure, kept = shrink_noise(pattern - expected, variance, known)
        made[number] = expected + departure
        left[number] = np.float32(kept) * variance
    return made, left


def _first_scores(
    stack: _Stack, number: int, prior: Sequence[Float32Array], chosen: NDArray[Any]
) -> FloatArray:
    """Scores of the patterns that are expected, then principal axes of the frames with zeros for what is missing."""
    gram = np.zeros((chosen.size, chosen.size))
    for band in stack.bands():
        whole = stack.values[chosen, band] * np.sqrt(stack.weight[chosen, band])
        flat = whole.reshape(chosen.size, -1)
        gram += flat @ flat.T
    # The noise of a frame stands in its own element only; what the others share is put there instead.
    np.fill_diagonal(gram, 0.0)
    for _ in range(20):
        values, vectors = np.linalg.eigh(gram)
        lead = vectors[:, -number:]
        np.fill_diagonal(gram, np.einsum("ik,k,ik->i", lead, np.maximum(values[-number:], 0.0), lead))
    noise = np.array([1.0 / np.sqrt(max(float(stack.weight[j].max()), 1e-30)) for j in chosen])
    scores = lead[:, ::-1] * noise[:, None]
    if prior:
        expected = _scores_of(stack, np.stack([np.asarray(each, dtype=np.float32) for each in prior]), chosen)
        scores[:, : min(number, len(prior))] = expected[:, :number]
    return scores


def _patterns_of(
    stack: _Stack, scores: FloatArray, chosen: NDArray[Any]
) -> tuple[Float32Array, Float32Array, BoolArray]:
    """Every pixel of the patterns from the frames that see it, its variance, and whether enough of them do."""
    number = scores.shape[1]
    patterns = np.zeros((number, *stack.shape), dtype=np.float32)
    variance = np.zeros(stack.shape, dtype=np.float32)
    known = np.zeros(stack.shape, dtype=bool)
    pairs = [(k, m) for k in range(number) for m in range(k + 1)]
    products = np.stack([scores[:, k] * scores[:, m] for k, m in pairs], axis=1).astype(np.float32)
    factors = scores.astype(np.float32)
    for band in stack.bands():
        weight = stack.weight[chosen, band]
        # A frame alone decides no pixel that K frames are needed for.
        seen = np.count_nonzero(weight, axis=0) > number
        flat = weight.reshape(chosen.size, -1)
        normal = (products.T @ flat).astype(np.float64)
        flat *= stack.values[chosen, band].reshape(flat.shape)
        solution, trace = _solved(dict(zip(pairs, normal, strict=True)), factors.T @ flat, number)
        trace = trace.reshape(seen.shape)
        if seen.any():
            seen &= trace < MOST_VARIANCE * np.median(trace[seen])
        patterns[:, band] = np.where(seen, solution.reshape(number, *seen.shape), 0.0)
        variance[band] = np.where(seen, trace / number, 0.0)
        known[band] = seen
    return patterns, variance, known


def _solved(
    normal: dict[tuple[int, int], FloatArray], moment: NDArray[Any], number: int
) -> tuple[FloatArray, FloatArray]:
    """Solutions of small systems, one for each pixel, and the traces of their inverses, by Cholesky's factors."""
    lower: dict[tuple[int, int], FloatArray] = {}
    for k in range(number):
        for m in range(k + 1):
            rest = normal[k, m] - sum(lower[k, i] * lower[m, i] for i in range(m))
            # What the frames of a pixel do not decide is rounding: it gets a variance that is too large.
            least = np.maximum(ROUNDING * normal[k, k], 1e-300)
            lower[k, m] = np.sqrt(np.maximum(rest, least)) if k == m else rest / lower[m, m]
    forward: list[FloatArray] = []
    for k in range(number):
        forward.append((moment[k] - sum(lower[k, i] * forward[i] for i in range(k))) / lower[k, k])
    solution = np.empty((number, forward[0].size))
    for k in reversed(range(number)):
        rest = forward[k] - sum(lower[i, k] * solution[i] for i in range(k + 1, number))
        solution[k] = rest / lower[k, k]
    # Squares of the elements of the inverse of the factor.
    trace = np.zeros(forward[0].size)
    for column in range(number):
        inverse: dict[int, FloatArray] = {}
        for k in range(column, number):
            one = float(k == column) - sum(lower[k, i] * inverse[i] for i in range(column, k))
            inverse[k] = one / lower[k, k]
            trace += inverse[k] ** 2
    return solution, trace


def _scores_of(
    stack: _Stack, patterns: Float32Array, chosen: NDArray[Any], part: NDArray[Any] | None = None
) -> FloatArray:
    """Scores of frames by weighted least squares over their pixels, or over a part of them."""
    number = len(patterns)
    scores = np.zeros((chosen.size, number))
    for place, frame in enumerate(chosen):
        normal, moment = np.zeros((number, number)), np.zeros(number)
        for start in range(0, stack.shape[0], ROWS):
            rows = slice(start, start + ROWS)
            weight = stack.weight[frame, rows]
            if part is not None:
                weight = weight * part[rows]
            flat = patterns[:, rows].reshape(number, -1).astype(np.float64)
            weighted = flat * weight.ravel()
            normal += weighted @ flat.T
            moment += weighted @ stack.values[frame, rows].ravel().astype(np.float64)
        normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal) + 1e-300
        scores[place] = np.linalg.solve(normal, moment)
    return scores


def _held_out_gain(stack: _Stack, prior: Sequence[Float32Array], most: int) -> FloatArray:
    """What 0, 1, 2, … patterns take of the squared pulls of frames that they were not made of, until it falls."""
    rows, columns = (np.arange(side) // CHECK_PX for side in stack.shape)
    white = (np.add.outer(rows, columns) % 2).astype(np.float32)
    gain = [0.0]
    for number in range(1, most + 1):
        gain.append(sum(_fold_gain(stack, number, prior, fold, white) for fold in range(FOLDS)))
        if gain[-1] < gain[-2]:
            break
    return np.array(gain)


def _fold_gain(
    stack: _Stack, number: int, prior: Sequence[Float32Array], fold: int, white: Float32Array
) -> float:
    left = np.arange(fold, stack.frames, FOLDS)
    others = np.setdiff1d(np.arange(stack.frames), left)
    if left.size == 0 or others.size <= number:
        return 0.0
    patterns = _decompose(stack, number, prior, others).patterns
    gain = 0.0
    for part in (white, 1.0 - white):
        scores = _scores_of(stack, patterns, left, 1.0 - part)
        for score, frame in zip(scores, left, strict=True):
            fringes = np.tensordot(score.astype(np.float32), patterns, axes=1)
            both = (2.0 * stack.values[frame] - fringes) * fringes
            gain += float((part * stack.weight[frame] * both).sum(dtype=np.float64))
    return gain
