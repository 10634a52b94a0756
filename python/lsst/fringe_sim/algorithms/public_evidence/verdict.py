"""Sets of effects compared on all public data: the class that is left, what it foretells, and what would decide."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import logsumexp

from ...array_types import FloatArray
from ...errors import InputError
from ...notebook import do_nothing
from ..discovery.options import SearchOptions
from .joint import Axis, JointFit, Predictor, parse_set
from .kinds import SHIFT_UM, FlatPhase, Kind, PixelFlats, PublishedMap, harmonics, public_kinds, sky_amplitude
from .models import LAB, Models, models_with, without_bench

CLASS_WIDTH = SearchOptions().class_width
"""Difference of the logarithms of evidence within which sets are one class, as in the search."""

PAPER_SILICON = "Si_green2008"
NARROW_NM = 0.5
OF_THE_LINE = ("bandwidth", "line_wing", "line_triangle")

RIVALS: tuple[tuple[str, ...], ...] = (
    ("contrast_loss",),
    ("diffuse_gate_side",),
    ("epoxy_absorption",),
    ("bandwidth",),
    ("ghost_pedestal",),
    ("diffuse_gate_side", "contrast_loss"),
    ("diffuse_gate_side", "epoxy_absorption"),
    ("diffuse_gate_side", "thickness_spread"),
    ("diffuse_gate_side", "bandwidth"),
    ("diffuse_gate_side", "ghost_pedestal"),
)
"""Sets that are compared if none is stated: what lowers the contrast, alone and with what raises the efficiency."""


@dataclass(frozen=True)
class DecidingMeasurement:
    """One that would tell members of a class apart."""

    # name, unit: what is measured
    name: str
    unit: str
    accuracy: float  # relative accuracy that is taken for granted
    expect: Callable[[Mapping[str, float]], float]  # ``(settings) -> value`` with effects at given values


@dataclass(frozen=True)
class KindRow:
    """One kind of data, foretold from all others."""

    name: str  # kind
    # paper, plane, foretold: rms misfit of the model of the paper, of plane layers without any effect, and of
    # what the best set says after the other kinds; of logarithms for contrasts, efficiencies and amplitudes
    paper: float
    plane: float
    foretold: float
    # logarithm of the probability of these data given the others, less that of plane layers
    log_probability: float
    paper_fitted: bool  # whether the paper has fitted its map to these data, so that it foretells nothing

    @property
    def factor(self) -> float:
        """How much better than the paper's model; NaN for what the paper fitted to these very data."""
        return math.nan if self.paper_fitted else self.paper / self.foretold


@dataclass(frozen=True, eq=False)
class Comparison:
    """Sets of effects, compared."""

    fits: tuple[JointFit, ...]  # best first; one of them is the empty set

    @property
    def best(self) -> JointFit:
        """Set with the largest evidence."""
        return self.fits[0]

    @property
    def members(self) -> tuple[JointFit, ...]:
        """Sets that these data do not tell from the best one."""
        best = self.best.log_evidence
        return tuple(fit for fit in self.fits if best - fit.log_evidence < CLASS_WIDTH)

    @cached_property
    def probabilities(self) -> FloatArray:
        """Of the sets, if all were equally likely before and nothing else were possible."""
        logs = np.array([fit.log_evidence for fit in self.fits])
        return np.asarray(np.exp(logs - logsumexp(logs)))

    @cached_property
    def rows(self) -> tuple[KindRow, ...]:
        """Every kind from the others."""
        plane = next(fit for fit in self.fits if not fit.axes)
        paper = models_with({}, PAPER_SILICON, "total")
        rows = []
        for kind in self.best.kinds:
            foretold = self.best.foretold(kind)
            rows.append(
                KindRow(
                    kind.name,
                    _at_published_map(kind, kind.predict(paper)),
                    _at_published_map(kind, kind.predict(models_with({}))),
                    float(kind.misfit(foretold)[0]),
                    self.best.log_predictive(kind) - plane.log_predictive(kind),
                    isinstance(kind, FlatPhase | PublishedMap),
                )
            )
        return tuple(rows)

    @cached_property
    def wavelengths(self) -> dict[str, float]:
        """Rms error of each of the twelve amplitudes of the pixel, foretold from the others, by who foretells."""
        kind = next(kind for kind in self.best.kinds if isinstance(kind, PixelFlats))
        model = models_with({}, PAPER_SILICON, "total")(LAB)
        absolute = kind.amplitudes(model, absolute=True)
        found = {
            "paper, as published": _refitted(kind, absolute, free=False),
            "paper, offset and slope free": _refitted(kind, absolute, free=True),
        }
        for fit in (*self.members, next(fit for fit in self.fits if not fit.axes)):
            found[fit.name] = kind.values - fit.foretold_wavelengths(kind)
        return {name: float(np.sqrt((error**2).mean())) for name, error in found.items()}

    @cached_property
    def forecast(self) -> dict[str, tuple[float, float]]:
        """Rms fringes of the LSST sky in the field centre [%] for every member, and for plane layers."""
        return {fit.name: _on_lsst(fit.best) for fit in self.members}

    @cached_property
    def decisions(self) -> tuple[tuple[DecidingMeasurement, dict[str, float], float], ...]:
        """Measurements, what each member expects, and the least separation of two [σ]; the most decisive first."""
        found = []
        for measurement in DECIDING:
            expected = {fit.name: measurement.expect(fit.best) for fit in self.members}
            pairs = itertools.combinations(expected.values(), 2)
            apart = [abs(math.log(one / two)) / (math.sqrt(2.0) * measurement.accuracy) for one, two in pairs]
            found.append((measurement, expected, min(apart, default=0.0)))
        return tuple(sorted(found, key=lambda item: -item[2]))

    def goes_to_the_sky(self, fit: JointFit) -> dict[str, bool]:
        """Whether the sensor takes each effect of a set along to the telescope."""
        return {axis.effect.name: not axis.effect.laboratory_only for axis in fit.axes}

    def content(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {
            "sets": [
                {
                    "effects": fit.name,
                    "log_evidence": fit.log_evidence,
                    "probability": float(probability),
                    "parameters": {key: {"mean": a, "sigma": b} for key, (a, b) in fit.values.items()},
                    "goes_to_the_sky": self.goes_to_the_sky(fit),
                    "in_class": fit in self.members,
                }
                for fit, probability in zip(self.fits, self.probabilities, strict=True)
            ],
            "map_shift_um": self.best.shift_um(),
            "kinds": [
                {**vars(row), "factor": row.factor if math.isfinite(row.factor) else None} for row in self.rows
            ],
            "wavelengths_left_out": self.wavelengths,
            "lsst_rms_percent": self.forecast,
            "deciding": [
                {"measurement": item.name, "unit": item.unit, "accuracy": item.accuracy, "expected": expected,
                 "separation_sigma": apart}
                for item, expected, apart in self.decisions
            ],
        }  # fmt: skip


def compare(
    sets: Sequence[Sequence[str]] | None = None,
    kinds: Sequence[Kind] | None = None,
    advance: Callable[[], None] = do_nothing,
) -> Comparison:
    """Compare sets of effects or of single parameters (`RIVALS`), and none at all, on all public data."""
    wanted = [parse_set(names) for names in ((), *(RIVALS if sets is None else sets))]
    predictor = Predictor(public_kinds() if kinds is None else kinds)
    _refuse_unfelt({axis.key: axis for axes in wanted for axis in axes}, predictor)
    fits = []
    for axes in wanted:
        fit = JointFit(axes, predictor)
        fits.append((fit.log_evidence, fit))
        advance()
    return Comparison(tuple(fit for _, fit in sorted(fits, key=lambda item: -item[0])))


def _refuse_unfelt(axes: Mapping[str, Axis], predictor: Predictor) -> None:
    """Refuse parameters of which no prediction of any kind depends."""
    for axis in axes.values():
        first, last = ({axis.key: float(one)} for one in (axis.low, axis.high))
        felt = any(
            not np.array_equal(predictor.predict(kind, first), predictor.predict(kind, last))
            for kind in predictor.kinds
        )
        if not felt:
            raise InputError(
                "effect", axis.key, "one on which the public data depend: optics, sensor or bench"
            )


def _at_published_map(kind: Kind, prediction: FloatArray) -> float:
    """Misfit with the map as it is published."""
    misfit = kind.misfit(prediction)
    return float(misfit[len(SHIFT_UM) // 2] if len(misfit) > 1 else misfit[0])


def _refitted(kind: PixelFlats, amplitudes: FloatArray, *, free: bool) -> FloatArray:
    """Errors of each wavelength with the thickness that fits the others best."""
    errors = []
    for number in range(kind.size):
        keep = np.arange(kind.size) != number
        if free:
            misfit = kind.without(number).chi2(amplitudes[keep])
            own = kind.foretold(amplitudes, number)
        else:
            misfit = ((kind.values[keep, np.newaxis] - amplitudes[keep]) ** 2).sum(axis=0)
            own = amplitudes[number]
        errors.append(kind.values[number] - own[int(np.argmin(misfit))])
    return np.array(errors)


def _on_lsst(settings: Mapping[str, float]) -> tuple[float, float]:
    """Rms of the LSST sky with what goes along of a set, and without any of it."""
    return (
        sky_amplitude(models_with(without_bench(settings)), "lsst_e2v", "rms"),
        sky_amplitude(models_with({}), "lsst_e2v", "rms"),
    )


def _narrow(settings: Mapping[str, float]) -> Models:
    """Models with a monochromator line of another make, and narrow."""
    own = {key: value for key, value in settings.items() if key.partition(".")[0] not in OF_THE_LINE}
    return models_with({**own, "bandwidth.fwhm": NARROW_NM})


def _contrast(models: Models, wavelength_nm: float, layer_um: float | None = None) -> float:
    layer, first, _ = harmonics(models(LAB), wavelength_nm)
    contrast = np.abs(first)
    return float(100.0 * (contrast.mean() if layer_um is None else np.interp(layer_um, layer, contrast)))


def _silicon_ripple(models: Models) -> float:
    """Rms of the fringes of the silicon over wavelength, those of the adhesive averaged out [%]."""
    model = models(LAB)
    wavelength = np.arange(958.0, 962.0, 0.1)
    layer = 17.0 + float(model.fringe_order_um(960.0)) * np.arange(16) / 16.0
    level = model.response(layer, wavelength).mean(axis=1)
    smooth = np.polynomial.Polynomial.fit(wavelength, level, 2)(wavelength)
    return float(100.0 * (level / smooth - 1.0).std())


DECIDING = (
    DecidingMeasurement(
        f"contrast of the adhesive's fringe at 960 nm in a line of {NARROW_NM} nm", "%", 0.05,
        lambda settings: _contrast(_narrow(settings), 960.0),
    ),
    DecidingMeasurement(
        f"silicon fringes from 958 to 962 nm in a line of {NARROW_NM} nm, rms", "%", 0.1,
        lambda settings: _silicon_ripple(_narrow(settings)),
    ),
    DecidingMeasurement(
        "contrast at 960 nm where the adhesive has 21 µm, over 15 µm", "", 0.05,
        lambda settings: _contrast(models_with(settings), 960.0, 21.0)
        / _contrast(models_with(settings), 960.0, 15.0),
    ),
    DecidingMeasurement(
        "contrast at 1000 nm over that at 900 nm", "", 0.05,
        lambda settings: _contrast(models_with(settings), 1000.0) / _contrast(models_with(settings), 900.0),
    ),
    DecidingMeasurement(
        "this very sensor under a y-band sky at f/4, half peak to peak", "%", 0.1,
        lambda settings: sky_amplitude(models_with(settings), "monocam", "half_peak_to_peak"),
    ),
    DecidingMeasurement(
        "LSST sky in the field centre, rms", "%", 0.1,
        lambda settings: sky_amplitude(models_with(settings), "lsst_e2v", "rms"),
    ),
)  # fmt: skip
"""Measurements that could be made, and how well one may hope to make them."""
