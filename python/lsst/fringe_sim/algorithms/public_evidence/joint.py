"""Joint likelihood of a set of effects given all kinds of public data, on a grid of its parameters.

Every kind may be off by a common factor of its stated uncertainty, at least 1, of which every magnitude is as likely:
no kind is believed because its noise was stated optimistically.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.special import gammainc, gammaln, logsumexp

from ...array_types import FloatArray
from ...effects import Effect, Parameter, known_effects
from ...errors import InputError, UnknownNameError
from ...model import FringeModel
from .kinds import SHIFT_UM, Kind, PixelFlats
from .models import LAB, models_with, without_bench

MOST_PARAMETERS = 3
COARSE_NODES = (0, 11, 7, 5)
"""Values of each parameter that are computed, by the number of parameters; a second time where it matters."""

FINE_NODES = (0, 61, 21, 9)
RESOLVED = 2  # Times that the grid is made finer about the posterior; nothing is computed anew for it
NEGLIGIBLE = 1e-5  # Posterior mass that a range of parameters may leave out, relative to its largest value


@dataclass(frozen=True)
class Axis:
    """One parameter of an effect and the range in which it is tried."""

    effect: Effect
    parameter: Parameter
    null: float
    low: float
    high: float

    @property
    def key(self) -> str:
        """``effect.parameter``."""
        return f"{self.effect.name}.{self.parameter.name}"

    def nodes(self, count: int) -> FloatArray:
        """Values, dense about the null."""
        scale = self.parameter.prior_scale
        ends = np.arcsinh((np.array([self.low, self.high]) - self.null) / scale)
        values = self.null + scale * np.sinh(np.linspace(ends[0], ends[1], count))
        return np.asarray(np.clip(values, self.low, self.high))

    def log_prior(self, values: FloatArray) -> FloatArray:
        """Logarithm of the prior mass of fine nodes: a Cauchy distribution of the catalogue's scale in its bounds."""
        scale = self.parameter.prior_scale
        place = (values - self.null) / scale
        bounds = (np.array(self.parameter.bounds) - self.null) / scale
        whole = scale * float(np.ptp(np.arctan(bounds)))
        return np.asarray(np.log(np.gradient(values)) - np.log1p(place**2) - math.log(whole))


def parse_set(names: Sequence[str]) -> tuple[Axis, ...]:
    """Parameters of a set of effects.

    ``names``: ``effect`` for all of its parameters, or ``effect.parameter`` for one.
    `UnknownNameError`: there is no such effect or parameter.
    `InputError`: more than three parameters, or one twice.
    """
    known = {effect.name: effect for effect in known_effects()}
    system = FringeModel.from_setup(LAB).base_system
    axes = []
    for given in names:
        name, _, parameter = given.partition(".")
        if name not in known:
            raise UnknownNameError("effect", name, known)
        effect = known[name]
        chosen = (effect.parameter(parameter),) if parameter else effect.parameters
        nulls = effect.null_values(system)
        axes += [Axis(effect, item, nulls[item.name], *item.bounds) for item in chosen]
    keys = [axis.key for axis in axes]
    if len(keys) > MOST_PARAMETERS:
        raise InputError(
            "parameters of the effects", len(keys), f"{MOST_PARAMETERS} at most; name one as effect.parameter"
        )
    if len(set(keys)) < len(keys):
        raise InputError("effects", list(names), "each once")
    return tuple(axes)


class Predictor:
    """Predictions of every kind, kept for as long as the same settings return."""

    def __init__(self, kinds: Sequence[Kind]) -> None:
        self.kinds = tuple(kinds)
        self._known: dict[tuple[str, tuple[tuple[str, float], ...]], FloatArray] = {}

    def predict(self, kind: Kind, settings: Mapping[str, float]) -> FloatArray:
        """Prediction of one kind with effects."""
        models = models_with(settings if kind.on_the_bench else without_bench(settings))
        used = models(kind.setup).effect_settings
        key = (kind.name, tuple(sorted(used.items())))
        if key not in self._known:
            self._known[key] = kind.predict(models)
        return self._known[key]


@dataclass(frozen=True, eq=False)
class _Table:
    """Predictions on a grid of parameters, ``[*grid, values, S]`` for each kind, and the prior mass of its points."""

    values: tuple[FloatArray, ...]
    log_prior: FloatArray
    predictions: tuple[FloatArray, ...]


@dataclass(frozen=True, eq=False)
class JointFit:
    """A set of effects given all data."""

    axes: tuple[Axis, ...]  # its parameters
    predictor: Predictor  # data and predictions

    @property
    def name(self) -> str:
        """Names of the effects."""
        return " + ".join(dict.fromkeys(axis.effect.name for axis in self.axes)) or "none"

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Kinds of data."""
        return self.predictor.kinds

    @cached_property
    def _table(self) -> _Table:
        axes = self.axes
        table = self._tabulate(axes, tuple(axis.nodes(_of(FINE_NODES, axes)) for axis in axes))
        if not axes:
            return table
        # Computed where the posterior is, with all kinds or without any one of them; then resolved where it is.
        near = self._narrowed(table, (None, *self.kinds))
        for _ in range(RESOLVED):
            close = self._narrowed(table, (None,))
            fine = tuple(
                np.unique(
                    np.concatenate([one.nodes(_of(FINE_NODES, axes) // 2), two.nodes(_of(FINE_NODES, axes))])
                )
                for one, two in zip(near, close, strict=True)
            )
            table = self._tabulate(near, fine)
        return table

    def _narrowed(self, table: _Table, left_out: Sequence[Kind | None]) -> tuple[Axis, ...]:
        """Ranges that hold the posterior without each of some kinds."""
        likelihoods = self._likelihoods(table)
        masses = [
            np.asarray(logsumexp(_product(self.kinds, likelihoods, table.log_prior, kind), axis=-1))
            for kind in left_out
        ]
        axes = []
        for number, (axis, values) in enumerate(zip(self.axes, table.values, strict=True)):
            others = tuple(n for n in range(len(self.axes)) if n != number)
            lows, highs = [], []
            for mass in masses:
                own = logsumexp(mass, axis=others) if others else mass
                inside = np.flatnonzero(own > own.max() + math.log(NEGLIGIBLE))
                lows.append(values[max(inside[0] - 1, 0)])
                highs.append(values[min(inside[-1] + 1, len(values) - 1)])
            axes.append(Axis(axis.effect, axis.parameter, axis.null, float(min(lows)), float(max(highs))))
        return tuple(axes)

    def _tabulate(self, axes: tuple[Axis, ...], fine: tuple[FloatArray, ...]) -> _Table:
        count = len(axes)
        coarse = [axis.nodes(_of(COARSE_NODES, axes)) for axis in axes]
        points = np.stack(np.meshgrid(*coarse, indexing="ij"), -1).reshape(-1, count) if axes else [()]
        predictions = []
        for kind in self.kinds:
            computed = [
                self.predictor.predict(
                    kind, {axis.key: float(value) for axis, value in zip(axes, point, strict=True)}
                )
                for point in points
            ]
            values = np.stack(computed).reshape(*(len(nodes) for nodes in coarse), *computed[0].shape)
            for place, (nodes, wanted) in enumerate(zip(coarse, fine, strict=True)):
                values = PchipInterpolator(nodes, values, axis=place)(np.clip(wanted, nodes[0], nodes[-1]))
            predictions.append(values)
        prior = np.zeros(())
        for place, (axis, wanted) in enumerate(zip(axes, fine, strict=True)):
            shape = [1] * count
            shape[place] = -1
            prior = prior + axis.log_prior(wanted).reshape(shape)
        return _Table(fine, np.asarray(prior), tuple(predictions))

    def _likelihoods(self, table: _Table) -> tuple[FloatArray, ...]:
        """Logarithm of the likelihood of every kind, ``[*grid, S or 1]``."""
        return tuple(
            log_likelihood(kind, prediction)
            for kind, prediction in zip(self.kinds, table.predictions, strict=True)
        )

    @cached_property
    def _all(self) -> tuple[FloatArray, ...]:
        return self._likelihoods(self._table)

    def _log_weight(self, left_out: Kind | None = None) -> FloatArray:
        """Logarithm of prior times likelihood, ``[*grid, S]``, not normalised."""
        return _product(self.kinds, self._all, self._table.log_prior, left_out)

    @cached_property
    def _log_posterior(self) -> FloatArray:
        """The same, summed over shifts of the map."""
        return np.asarray(logsumexp(self._log_weight(), axis=-1))

    @cached_property
    def log_evidence(self) -> float:
        """Logarithm of the likelihood of all data, averaged over the prior."""
        return float(logsumexp(self._log_posterior))

    def log_predictive(self, kind: Kind) -> float:
        """Logarithm of the probability of one kind of data given all others."""
        return self.log_evidence - float(logsumexp(self._log_weight(kind)))

    @cached_property
    def values(self) -> dict[str, tuple[float, float]]:
        """Posterior mean and standard deviation of every parameter."""
        mass = self._log_posterior
        weight = np.exp(mass - logsumexp(mass))
        found = {}
        for number, (axis, values) in enumerate(zip(self.axes, self._table.values, strict=True)):
            own = weight.sum(axis=tuple(n for n in range(len(self.axes)) if n != number))
            mean = float((own * values).sum())
            found[axis.key] = (mean, math.sqrt(max(float((own * (values - mean) ** 2).sum()), 0.0)))
        return found

    @cached_property
    def best(self) -> dict[str, float]:
        """Parameters at the largest posterior density."""
        if not self.axes:
            return {}
        mass = self._log_posterior
        place = np.unravel_index(int(np.argmax(mass)), mass.shape)
        return {
            axis.key: float(values[n])
            for axis, values, n in zip(self.axes, self._table.values, place, strict=True)
        }

    def shift_um(self) -> tuple[float, float]:
        """Mean and standard deviation of the shift of the published map [µm]."""
        log = self._log_weight()
        weight = np.exp(log - log.max()).reshape(-1, len(SHIFT_UM)).sum(axis=0)
        weight /= weight.sum()
        mean = float((weight * SHIFT_UM).sum())
        return mean, math.sqrt(float((weight * (SHIFT_UM - mean) ** 2).sum()))

    def foretold(self, kind: Kind) -> FloatArray:
        """What all other kinds say of one, ``[values, 1]``: the mean over their posterior."""
        log = self._log_weight(kind)
        return _mean(log, self._table.predictions[self.kinds.index(kind)])

    def foretold_wavelengths(self, kind: PixelFlats) -> FloatArray:
        """Amplitude of the pixel at each wavelength, from those at all others and all other kinds, shape ``(W,)``."""
        prediction = self._table.predictions[self.kinds.index(kind)]
        others = self._log_weight(kind)
        found = []
        for number in range(kind.size):
            less = kind.without(number)
            keep = np.arange(kind.size) != number
            log = others + log_likelihood(less, prediction[..., keep, :])
            own = kind.foretold(prediction, number)[..., np.newaxis, :]
            found.append(float(_mean(log, own)[0, 0]))
        return np.array(found)


def _of(nodes: tuple[int, ...], axes: Sequence[Axis]) -> int:
    """Number of nodes of each of so many axes."""
    return nodes[len(axes)]


def log_likelihood(kind: Kind, prediction: FloatArray) -> FloatArray:
    """Logarithm of the likelihood of a kind, but for a constant of the kind.

    The integral of ``s**-n exp(-chi2 / 2 s²) ds / s`` over scales s of its uncertainty from 1 on, with n values:
    an incomplete gamma function.
    """
    shape, half = 0.5 * kind.size, np.maximum(0.5 * kind.chi2(prediction), 1e-9)
    return np.asarray(np.log(gammainc(shape, half)) + gammaln(shape) - shape * np.log(half) - math.log(2.0))


def _product(
    kinds: Sequence[Kind], likelihoods: Sequence[FloatArray], log_prior: FloatArray, left_out: Kind | None
) -> FloatArray:
    """Logarithm of prior times likelihood of all kinds but one, ``[*grid, S]``."""
    total = np.full((*log_prior.shape, len(SHIFT_UM)), -math.log(len(SHIFT_UM))) + log_prior[..., np.newaxis]
    for kind, own in zip(kinds, likelihoods, strict=True):
        if kind is not left_out:
            total = total + own
    return np.asarray(total)


def _mean(log: FloatArray, prediction: FloatArray) -> FloatArray:
    """Mean of ``[*grid, values, S or 1]`` with weights of ``[*grid, S]``."""
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    if prediction.shape[-1] == 1:
        weight = weight.sum(axis=-1, keepdims=True)
    mean = (weight[..., np.newaxis, :] * prediction).sum(axis=-1)
    return np.asarray(mean.reshape(-1, mean.shape[-1]).sum(axis=0)[:, np.newaxis])
