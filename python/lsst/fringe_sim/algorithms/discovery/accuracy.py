"""How well the model is known: a disagreement that its tables may be wrong by is none that an effect must explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ...array_types import FloatArray
from ...errors import InputError
from .channels import Channel, State, combined_probability, in_looks, measure_channels
from .fit import Design, Fit, FullColumns, PlaneColumns, Problem
from .learned_columns import over_wavelength
from .selection import Selector, chance_of
from .spots import spot_channel

MODEL_ACCURACY = 0.014
"""Error of the fringes of the model at a wavelength, as a part of their amplitude and in radians of their phase.

It is that of the absorption of silicon at 1 µm. No other table of optical constants states an uncertainty there.
"""

ACCURACY_SOURCE = "absorption of silicon at 1 um, Schinke et al. 2015, doi 10.1063/1.4923419"

TABLE_STEP_NM = 10.0
"""Wavelength over which the errors of a table are alike [nm]: the step at which constants of silicon are stated
(Green 2008, doi 10.1016/j.solmat.2008.06.009); between its entries a table is as wrong as its neighbours are."""

OF_RESIDUAL = ("texture", "achromatic texture", "achromatic peak", "echoes")
"""Tests that look at the residual itself and not along columns."""


def chance_within_accuracy(selector: Selector, fit: Fit, accuracy: float) -> float:
    """Chance that noise, and errors of the model of this size, disagree as much with a fit.

    The errors of amplitude and phase of the fringes at all wavelengths are a block in the covariance of the data,
    alike over `TABLE_STEP_NM`. All tests without a catalogue, and the score tests of the catalogue, have it.

    ``accuracy``: rms of these errors, see `MODEL_ACCURACY`.
    """
    state, problem = selector.state(fit), selector.problem
    block = _block(problem, fit, state, accuracy)
    design = _with_block(state.design, block, problem.field_prior)
    beside = replace(state, design=design)
    left = replace(beside, residual=state.residual - _taken_up(design, state.residual))
    found = [*_channels(selector, fit, beside, left), spot_channel(left, _correlation(problem, fit))]
    chances = [
        _score_chance(selector, fit, beside, name)
        for name in selector.coordinates
        if not (selector.is_sought(name) or problem.forward.is_island(name))
    ]
    catalogue = in_looks(min(chances), len(chances)) if chances else 1.0
    return in_looks(min(combined_probability(found), catalogue), 2)


def _correlation(problem: Problem, fit: Fit) -> float:
    return problem.forward.noise_correlation(fit.settings)


def _block(problem: Problem, fit: Fit, state: State, accuracy: float) -> FullColumns:
    """Whitened columns ``(2 R, W, ny, nx)`` of unit variance: amplitude and phase of the fringes."""
    wavelength = problem.cells.wavelength_nm
    root = accuracy * over_wavelength(wavelength, TABLE_STEP_NM)
    level, fringes = problem.amplitudes(fit.levels)
    prediction = problem.forward.predict(fit.settings, state.thickness_um)
    radian_um = (problem.forward.model.fringe_order_um(wavelength) / (2.0 * np.pi))[:, None, None]
    shapes = np.stack([state.value - level, fringes * prediction.slope * radian_um])
    # (kind, mode, W, ny, nx): every mode is in all exposures.
    return FullColumns(
        state.whiten(shapes[:, np.newaxis] * root.T[np.newaxis, :, :, np.newaxis, np.newaxis]).reshape(
            -1, *state.value.shape
        )
    )


def _with_block(design: Design, block: FullColumns, prior: float) -> Design:
    """The design with errors of the model among its nuisances, each of unit variance."""
    effects = FullColumns(np.concatenate([design.effects.values, block.values]))
    levels: PlaneColumns = design.levels
    free = levels.basis.shape[1] + len(design.effects.values)
    built = Design.build(
        design.basis, design.slope, levels, effects, prior, design.pull, design.slope_changes
    )
    known = block_diag(np.zeros((free, free)), np.eye(len(block.values)))
    return replace(built, _curvature=built.curvature + known)


def _taken_up(design: Design, residual: FloatArray) -> FloatArray:
    """What the likeliest errors of the model, levels and thickness explain of a whitened residual."""
    nothing = np.zeros(len(design.curvature))
    step, field = design.step(residual, nothing, nothing)
    levels = design.levels
    number = levels.basis.shape[1]
    planes = levels.basis @ step[:number]
    change = np.zeros(residual.shape)
    np.add.at(change, levels.plane, levels.amplitude * planes[:, np.newaxis, np.newaxis])
    told = levels.whiten.decorrelate(change) + design.slope * design.basis.expand(field)
    return np.asarray(told + np.tensordot(step[number:], design.effects.values, axes=1))


def _channels(selector: Selector, fit: Fit, beside: State, left: State) -> list[Channel]:
    """Tests without a catalogue: those along columns with the block, those of the residual without what it took."""
    geometry = selector.problem.cells.geometry
    correlation = _correlation(selector.problem, fit)
    pairs = zip(
        *(measure_channels(state, geometry, selector.index, 0.0, correlation) for state in (beside, left)),
        strict=True,
    )
    return [rest if along.name in OF_RESIDUAL else along for along, rest in pairs]


def _score_chance(selector: Selector, fit: Fit, state: State, name: str) -> float:
    """Chance of the score test of an effect."""
    try:
        features = selector.features(state, fit, name)
    except InputError:
        return 1.0
    found = selector.along(state, name, features)
    return chance_of(found.gain, found.degrees, selector.undescribed(name))
