"""A thickness map from the laboratory, checked on frames of the night sky and moved where they disagree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from ..array_types import FloatArray
from ..errors import InputError, named_units
from .correction.objects import square_sums
from .night_levels import BAND_SIGMA, Predictor, background_terms, levels_of, thinned
from .night_sums import BACKGROUND, NightSums, ShiftSums
from .sky_model_error import SIZES, Envelope, ModelError
from .smooth_field import Splines, Spread, nearest_coefficients, prior_covariance

MAP_SIGMA_ORDERS = 0.15
"""What a map may be off by as a whole before the sky is seen [orders]: 1 rad of phase, as much as the adhesive may
change between the temperatures of laboratory and sky."""

STEPS_PER_ORDER = 24
"""Shifts in one order at which a night is compared before anything is linear: 15 degrees of phase."""

SPANS = (0, 1, 2, 4, 8, 16)
"""Spans of the splines along a side that compete; with none, all pixels have one shift."""

LEAST_PX_OF_SPAN = 8  # Pixels in a span: fewer would not carry a cubic

SPREADS = 13  # Spreads of the shifts over which the evidence is averaged, from a thousandth of an order to one order

MOST_STARTS = 4  # Most common shifts from which splines begin; an order has about one

NEGLIGIBLE = 10.0
"""Splines whose evidence is e to this less than that of coarser ones end the search for finer ones."""

ROUNDS, FINISHED_ORDERS = 25, 1e-3
"""Most rounds of Gauss and Newton, and the step at which they end [orders]; the spread is sought in every fourth."""

DERIVATIVE_ORDERS = 1e-2
"""Half the distance of the two predictions that make a derivative [orders]; its error is 6e-4 of it."""


@named_units
@dataclass(frozen=True, eq=False)
class SkyShift:
    """How far a map is from what the sky shows."""

    # (ny, nx): what is to be added to the map, and its uncertainty [µm], averaged over all that compete by
    # their evidence
    shift_um: FloatArray
    sigma_um: FloatArray
    chance_unmoved: float  # Probability that the map is right as it is
    # Probability that all of it is whole fringe orders away from the shift that is stated
    chance_other_order: float
    # Spans along a side of the likeliest splines; -1 if the map is likeliest as it is, 0 for one shift
    spans: int
    strength: float  # Fringes of the frames over those predicted for the dark sky
    strength_sigma: float
    # Mean square of the residuals over their variance where the map is as it was, over that with the shift
    residual: float
    # Median uncertainty that the frames alone give to shifts over an eighth of the sensor [µm]
    alone_um: float
    # Size of the errors of the envelope that the frames ask for (`Envelope`); with a third of the fringes
    # or more the order is that of the model, and may be wrong whatever the probabilities say
    model_error: float = 0.0

    @named_units
    def frames_for(self, sigma_um: float, frames: int) -> int:
        """Frames like the ``frames`` that were used, from which an eighth of the sensor is known to ``sigma_um``."""
        return math.ceil(frames * (self.alone_um / sigma_um) ** 2)


@named_units
def fit_sky_shift(
    values: Sequence[ArrayLike],
    weights: Sequence[ArrayLike],
    thickness_um: ArrayLike,
    predict: Predictor,
    order_um: float,
    *,
    map_sigma_um: float | None = None,
) -> SkyShift:
    """How a thickness map must move for the fringes of sky frames.

    ``values`` are frames over their mean, minus one; ``weights`` inverse variances in any unit, 0 for a pixel that is
    left out; ``thickness_um`` is NaN where it is not known. ``predict`` takes thicknesses [µm] and returns the light
    of the OH bands of the dark sky, over the mean of that sky, first axis.

    The shift is a spline whose coefficients have mean and tilts, normal about zero, and a normal spread about them,
    over which the evidence is averaged. Its number of spans, one shift for all, and none at all compete by evidence
    (Laplace's, about the best point). In each frame the strength of each band and a background of second degree are
    free, and integrated over; so are errors of the model's envelope (`Envelope`) that all frames share, of the size
    that has the largest evidence. The variance of each frame is that of its residuals, and larger where the frames
    miss something alike.
    """
    layer = np.asarray(thickness_um, dtype=float)
    frames = _frames(values, weights, layer)
    known = np.isfinite(layer)
    filled = np.where(known, layer, float(layer[known].mean()))
    night = _Night(frames, filled, predict, order_um, map_sigma_um or MAP_SIGMA_ORDERS * order_um)
    likeliest = night.starts()[0]
    tried = [night.fitted(Splines.of(layer.shape, spans), likeliest) for spans in (0, 1)]
    night = night.with_noise_of(max(tried, key=lambda fit: fit.log_evidence))
    found: list[_Fit] = []
    others: list[_Fit] = []
    starts = night.starts()
    for spans in SPANS:
        if spans * LEAST_PX_OF_SPAN > min(layer.shape):
            break
        each = [night.fitted(Splines.of(layer.shape, spans), start) for start in starts]
        best = max(each, key=lambda fit: fit.log_evidence)
        found.append(best)
        others.extend(each)
        if spans > 0:
            starts = [best.shift_um]
            if best.log_evidence < max(fit.log_evidence for fit in found) - NEGLIGIBLE:
                break
    unmoved = night.state(np.zeros(layer.shape))._replace(bands=None)
    return _averaged(night, unmoved, found, others)


def _frames(
    values: Sequence[ArrayLike], weights: Sequence[ArrayLike], layer: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    if not values or len(values) != len(weights):
        raise InputError(
            "sky frames, weights", (len(values), len(weights)), "as many of each, and one or more"
        )
    made = []
    for value, weight in zip(values, weights, strict=True):
        image, inverse = np.asarray(value, dtype=float), np.asarray(weight, dtype=float)
        if image.shape != layer.shape or inverse.shape != layer.shape:
            allowed = f"{layer.shape}, that of the thickness map"
            raise InputError("shape of a sky frame", image.shape, allowed)
        good = np.isfinite(image) & np.isfinite(inverse) & (inverse > 0.0) & np.isfinite(layer)
        if np.count_nonzero(good) < LEAST_PX_OF_SPAN**2:
            allowed = f"{LEAST_PX_OF_SPAN**2} or more that the thickness map knows"
            raise InputError("pixels of a sky frame", int(np.count_nonzero(good)), allowed)
        made.append((np.where(good, image, 0.0), np.where(good, inverse, 0.0)))
    return made


class _State(NamedTuple):
    """A night at one shift, with the best levels of its bands, backgrounds and errors of the envelope."""

    shift_um: FloatArray
    bands: FloatArray | None  # (B, ny, nx): light of the bands, less its mean; None where it was let go
    half_chi2: float  # with the prior of the bands
    log_volume: float  # -0.5 log det of the levels
    levels: FloatArray  # (F, terms): of all terms of `NightSums`
    inverses: list[FloatArray]  # (terms, terms) each: covariance of the levels but those of the envelope
    strength: FloatArray  # (F,): fringes over those of the dark sky
    error: ModelError | None = None


@dataclass(frozen=True, eq=False)
class _Fit:
    """The best point of one kind of splines."""

    splines: Splines
    coefficient: FloatArray
    covariance: FloatArray
    information: FloatArray
    shift_um: FloatArray
    log_evidence: float
    state: _State


@dataclass(frozen=True, eq=False)
class _Night:
    """Frames of a night, and what is expected of them."""

    frames: list[tuple[FloatArray, FloatArray]]
    layer_um: FloatArray
    predict: Predictor
    order_um: float
    map_sigma_um: float
    envelope: Envelope | None = None  # what the model may have wrong

    @cached_property
    def sums(self) -> NightSums:
        """The same frames, as their sums want them."""
        return NightSums.of(self.frames)

    def starts(self) -> list[FloatArray]:
        """Common shifts to begin with: all at which the night is likelier than on either side, and none."""
        half = max(STEPS_PER_ORDER, math.ceil(3.0 * STEPS_PER_ORDER * self.map_sigma_um / self.order_um))
        steps = np.arange(-half, half + 1) * (self.order_um / STEPS_PER_ORDER)
        thin = max(1, min(self.layer_um.shape) // 128)
        some = replace(
            self,
            frames=[
                (value[::thin, ::thin], thin**2 * weight[::thin, ::thin]) for value, weight in self.frames
            ],
            layer_um=self.layer_um[::thin, ::thin],
            predict=thinned(self.predict, self.layer_um, thin),
        )
        log = np.array([-some.state(np.full(some.layer_um.shape, step)).half_chi2 for step in steps])
        log -= 0.5 * (steps / self.map_sigma_um) ** 2
        padded = np.pad(log, 1, constant_values=-np.inf)
        peaks = np.flatnonzero((log >= padded[:-2]) & (log >= padded[2:]))
        best = peaks[np.argsort(-log[peaks])][:MOST_STARTS]
        return [np.full(self.layer_um.shape, step) for step in (*steps[best], 0.0)]

    def with_noise_of(self, fit: _Fit) -> _Night:
        """The same with weights of the residuals' own variance, and of what all frames miss alike."""
        night, residuals = self, self.residuals(fit.state)
        for _ in range(2):  # what the model has wrong is no noise
            night = night._scaled_to(residuals).with_likeliest_envelope(fit.shift_um)
            residuals = night.residuals(night.state(fit.shift_um))
        night = night._scaled_to(residuals)
        share = night._noise_share(residuals)
        return replace(night, frames=[(value, share * weight) for value, weight in night.frames])

    def _scaled_to(self, residuals: Sequence[FloatArray]) -> _Night:
        frames = []
        for (value, weight), residual in zip(self.frames, residuals, strict=True):
            freedom = np.count_nonzero(weight)
            frames.append((value, weight * (freedom / float((weight * residual**2).sum()))))
        return replace(self, frames=frames)

    def with_likeliest_envelope(self, shift_um: FloatArray) -> _Night:
        """The same with the error of the model that has the largest evidence at a shift."""
        tried = [None, *(Envelope.of(size, self.layer_um, self.order_um) for size in SIZES if size > 0.0)]
        bands = self._bands(shift_um)
        sums = self.sums.products(bands, self.layer_um + shift_um, tried[-1])
        states = [self._solved(shift_um, bands, sums, envelope) for envelope in tried]
        likeliest = np.argmax([state.log_volume - state.half_chi2 for state in states])
        return replace(self, envelope=tried[int(likeliest)])

    def _noise_share(self, residuals: Sequence[FloatArray]) -> float:
        """Part of the variance of the mean residual that is noise, in squares of a quarter of a fringe.

        Noise differs from frame to frame; what a model lacks, other lines or layers, is there in all of them and does
        not shrink with their number. Neighbouring pixels share it within a quarter of a fringe.
        """
        weights = [weight for _, weight in self.frames]
        total = np.sum(weights, axis=0)
        shared = np.sum([weight * each for weight, each in zip(weights, residuals, strict=True)], axis=0)
        slope = float(np.median(np.hypot(*np.gradient(self.layer_um))))
        side = max(
            1, min(round(0.25 * self.order_um / max(slope, 1e-12)), min(total.shape) // LEAST_PX_OF_SPAN)
        )
        shared, total = (square_sums(each, side) for each in (shared, total))
        known = total > 0.0
        # Where all is noise, these squares have a mean of 1, and the scatter of a mean.
        return min(1.0, 1.0 / float(np.mean(shared[known] ** 2 / total[known], dtype=float)))

    def _bands(self, shift_um: FloatArray) -> FloatArray:
        """Light of the bands at a shift, less its mean, which a background has."""
        bands = self.predict(self.layer_um + shift_um)
        return np.asarray(bands - bands.mean(axis=(1, 2), keepdims=True), dtype=float)

    def state(self, shift_um: FloatArray) -> _State:
        """The night at a shift, with the levels that suit it best."""
        bands = self._bands(shift_um)
        sums = self.sums.products(bands, self.layer_um + shift_um, self.envelope)
        return self._solved(shift_um, bands, sums, self.envelope)

    def _solved(
        self,
        shift_um: FloatArray,
        bands: FloatArray,
        sums: tuple[FloatArray, FloatArray],
        envelope: Envelope | None,
    ) -> _State:
        """The levels that suit a night best; ``sums``: of `NightSums.products`, maybe of more than these terms."""
        number, terms = len(bands), len(bands) + BACKGROUND
        half_chi2 = log_volume = 0.0
        inverses, strength = [], np.zeros(len(self.frames))
        levels = np.zeros(sums[1].shape)
        for frame, (product, side) in enumerate(zip(*sums, strict=True)):
            level, inverse, log_det = levels_of(product[:terms, :terms], side[:terms], number)
            away = (level[:number] - 1.0) / BAND_SIGMA
            chi2 = self.sums.squares[frame] + level @ (product[:terms, :terms] @ level - 2.0 * side[:terms])
            half_chi2 += 0.5 * float(chi2 + away @ away)
            log_volume -= 0.5 * log_det
            levels[frame, :terms] = level
            inverses.append(inverse)
            inner = product[:number, :number].diagonal()
            power = inner - product[:number, number] ** 2 / product[number, number]
            strength[frame] = float(level[:number] @ power / max(power.sum(), 1e-300))
        made = _State(shift_um, bands, half_chi2, log_volume, levels, inverses, strength)
        return made if envelope is None else _with_error(made, envelope, sums, terms)

    def residuals(self, state: _State) -> list[FloatArray]:
        """What is left of every frame."""
        bands = self._bands(state.shift_um) if state.bands is None else state.bands
        terms = np.concatenate([bands, background_terms(self.layer_um.shape)])
        left = [
            value - np.tensordot(level[: len(terms)], terms, axes=1)
            for (value, _), level in zip(self.frames, state.levels, strict=True)
        ]
        if state.error is not None:
            envelope = state.error.envelope.terms(self.layer_um + state.shift_um, bands)
            taken = (state.error.coefficient @ envelope).reshape(self.layer_um.shape)
            left = [each - part * taken for each, part in zip(left, state.strength, strict=True)]
        return left

    def normal(self, splines: Splines, state: _State) -> tuple[FloatArray, FloatArray]:
        """Information on the coefficients, the levels being free, and minus the gradient of half the χ²."""
        apart = DERIVATIVE_ORDERS * self.order_um
        above, below = (self.predict(self.layer_um + state.shift_um + step) for step in (apart, -apart))
        change = (above - below) / (2.0 * apart)  # of each band with the shift [1/µm]
        bands = self._bands(state.shift_um) if state.bands is None else state.bands
        error, terms = state.error, len(bands) + BACKGROUND
        told = (bands, self.layer_um + state.shift_um, None if error is None else error.envelope)
        used = state.levels if error is not None else state.levels[:, :terms]
        slopes = ShiftSums.of(self.sums, told, used, change, splines)
        reduced = np.zeros((splines.count, splines.count))
        shared = np.zeros(1)
        for frame, (inverse, cross) in enumerate(zip(state.inverses, slopes.cross, strict=True)):
            own = cross[:terms].T
            crossed = own @ inverse
            reduced += crossed @ own.T
            if error is not None:
                shared = shared + error.cross(cross[terms:].T, frame, crossed)
        if error is not None:
            reduced += shared @ error.inverse @ np.transpose(shared)
        return splines.products(slopes.total) - reduced, splines.sums(slopes.gradient)

    def fitted(self, splines: Splines, start_um: FloatArray) -> _Fit:
        """Gauss and Newton from a start, with the spread of the coefficients that the evidence prefers."""
        coefficient = nearest_coefficients(splines, start_um)
        reach = self.map_sigma_um
        spreads = self.order_um * np.geomspace(1e-3, 1.0, SPREADS)
        spread = float(spreads[SPREADS // 2])
        state = self.state(splines.surface(coefficient))
        for number in range(ROUNDS):
            information, gradient = self.normal(splines, state)
            if number % 4 == 0:
                spread = Spread.of(splines, information, gradient, coefficient, spreads, reach).likeliest
            penalty = np.asarray(np.linalg.inv(prior_covariance(splines, spread, reach)), dtype=float)
            wanted = gradient - penalty @ coefficient
            step = np.asarray(np.linalg.solve(information + penalty, wanted), dtype=float)
            moved, state = self._moved(splines, coefficient, step, penalty, state)
            change = float(np.abs(moved - coefficient).max())
            coefficient = moved
            if change < FINISHED_ORDERS * self.order_um:
                break
        found = Spread.of(splines, *self.normal(splines, state), coefficient, spreads, reach)
        total = found.log_evidence - state.half_chi2 + state.log_volume
        mean, covariance = found.posterior()
        kept = state._replace(bands=None)
        return _Fit(splines, mean, covariance, found.information, splines.surface(mean), total, kept)

    def _moved(
        self, splines: Splines, coefficient: FloatArray, step: FloatArray, penalty: FloatArray, state: _State
    ) -> tuple[FloatArray, _State]:
        """As much of a step as makes the fit better."""
        # Beyond a quarter of a fringe nothing is linear.
        limit = 0.25 * self.order_um / max(float(np.abs(step).max()), 1e-300)
        step = min(1.0, limit) * step
        before = state.half_chi2 + 0.5 * float(coefficient @ penalty @ coefficient)
        for _ in range(6):
            tried = coefficient + step
            new = self.state(splines.surface(tried))
            if new.half_chi2 + 0.5 * float(tried @ penalty @ tried) <= before:
                return tried, new
            step = 0.5 * step
        return coefficient, state


def _with_error(state: _State, envelope: Envelope, sums: tuple[FloatArray, FloatArray], terms: int) -> _State:
    """The same where the envelope of the fringes is another than the model's, in all frames alike."""
    found = ModelError.of(envelope, sums, state.levels[:, :terms], state.inverses, state.strength)
    for frame, inverse in enumerate(state.inverses):
        state.levels[frame, :terms] += found.change(frame, inverse)
        state.levels[frame, terms:] = found.strength[frame] * found.coefficient
    return state._replace(
        half_chi2=state.half_chi2 - found.gain, log_volume=state.log_volume + found.log_volume, error=found
    )


def _averaged(night: _Night, unmoved: _State, fits: Sequence[_Fit], others: Sequence[_Fit]) -> SkyShift:
    """All that compete, by their evidence; ``others`` began elsewhere."""
    logs = np.array([unmoved.log_volume - unmoved.half_chi2, *(fit.log_evidence for fit in fits)])
    weight = np.exp(logs - logsumexp(logs))
    shift = sum((w * fit.shift_um for w, fit in zip(weight[1:], fits, strict=True)), np.zeros(1))
    variance = weight[0] * shift**2
    for w, fit in zip(weight[1:], fits, strict=True):
        variance = variance + w * (fit.splines.variance(fit.covariance) + (fit.shift_um - shift) ** 2)
    best = int(logs.argmax())
    state = unmoved if best == 0 else fits[best - 1].state
    eighth = min(fits, key=lambda fit: abs(fit.splines.spans - 8))
    alone = eighth.splines.variance(
        np.asarray(np.linalg.pinv(eighth.information, hermitian=True), dtype=float)
    )
    ratio = _mean_square(night, unmoved) / _mean_square(night, state)
    strength = state.strength
    return SkyShift(
        shift,
        np.sqrt(np.maximum(variance, 0.0)),
        float(weight[0]),
        _other_order(night, fits, others),
        -1 if best == 0 else fits[best - 1].splines.spans,
        float(strength.mean()),
        float(strength.std(ddof=1) / math.sqrt(strength.size)) if strength.size > 1 else math.nan,
        ratio,
        float(np.sqrt(np.median(alone))),
        0.0 if night.envelope is None else night.envelope.size,
    )


def _other_order(night: _Night, fits: Sequence[_Fit], others: Sequence[_Fit]) -> float:
    """Chance of what ended half an order or more from the likeliest."""
    best = max(fits, key=lambda fit: fit.log_evidence)
    logs = np.array([fit.log_evidence for fit in others])
    away = np.array(
        [abs(float(np.mean(fit.shift_um - best.shift_um))) > 0.5 * night.order_um for fit in others]
    )
    return float(np.exp(logsumexp(logs[away]) - logsumexp(logs))) if away.any() else 0.0


def _mean_square(night: _Night, state: _State) -> float:
    pairs = list(zip(night.frames, night.residuals(state), strict=True))
    total = sum(float((weight * residual**2).sum()) for (_, weight), residual in pairs)
    return total / sum(int(np.count_nonzero(weight)) for (_, weight), _ in pairs)
