"""Families of corrections that may be learned: what each does to the cells, and how smooth it may be."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...array_types import FloatArray
from ...effects import AMPLIFIERS, LEARNED, Effect, ImageGeometry
from ...effects.learned import (
    LEARNED_HARMONICS,
    LEARNED_NODES_NM,
    amplifier_colour,
    cosines,
    light_orders,
    map_orders,
    node_shares,
)
from .channels import State
from .columns import Columns, PlaneColumns

LENGTHS_NM = (1.0, 30.0, 100.0)
"""Correlation lengths over wavelength that are tried [nm]: none at all, some exposures, all of them."""

DECAYS = (1.0, 0.3)  # Factors from one harmonic of the fringe to the next

ORDERS = (1.5, 3.0, 6.0, 12.0)
"""Widths of the spectra of smooth patterns over the sensor [half waves along a side]."""

LEAST_POWER = 1e-4
"""Relative power of a wave that is left out: columns that are all but dependent would cost time and say nothing."""


@dataclass(frozen=True, eq=False)
class LocalColumns:
    """Whitened derivatives that are products of patterns over the sensor and functions of wavelength and cell."""

    patterns: FloatArray  # (K, ny, nx)
    terms: FloatArray  # (T, W, ny, nx), whitened

    @property
    def _flat(self) -> FloatArray:
        return self.patterns.reshape(len(self.patterns), -1)

    def dot(self, values: FloatArray) -> FloatArray:
        """Products with whitened ``(..., W, ny, nx)``, shape ``(..., T * K)``."""
        own = np.einsum("twyx,...wyx->...tyx", self.terms, values)
        flat = self._flat
        found = own.reshape(*own.shape[:-2], flat.shape[1]) @ flat.T
        return np.asarray(found.reshape(*values.shape[:-3], len(self.terms) * len(flat)))

    def along(self, slope: FloatArray) -> FloatArray:
        """Products cell by cell with a whitened slope ``(W, ny, nx)``, shape ``(T * K, ny, nx)``."""
        own = np.einsum("twyx,wyx->tyx", self.terms, slope)
        return (own[:, np.newaxis] * self.patterns).reshape(-1, *slope.shape[1:])

    @functools.cached_property
    def gram(self) -> FloatArray:
        """Products with one another, shape ``(T * K, T * K)``."""
        terms, patterns = len(self.terms), len(self.patterns)
        found = np.zeros((terms, patterns, terms, patterns))
        for i in range(terms):
            for j in range(i + 1):
                weight = (self.terms[i] * self.terms[j]).sum(axis=0).ravel()
                if weight.any():
                    found[i, :, j] = (self._flat * weight) @ self._flat.T
                    found[j, :, i] = found[i, :, j].T
        return found.reshape(terms * patterns, -1)

    def against(self, levels: PlaneColumns) -> FloatArray:
        """Products with other columns, shape ``(T * K, their L)``."""
        rows = []
        for amplitude, plane in zip(levels.amplitude, levels.plane, strict=True):
            one = np.zeros(self.terms.shape[1:])
            one[plane] = amplitude
            rows.append(self.dot(one))
        return np.asarray((levels.basis.T @ np.stack(rows)).T)


@dataclass(frozen=True, eq=False)
class Family:
    """One kind of correction, in the parameters of its effect."""

    name: str
    keys: tuple[str, ...]  # ``effect.parameter`` of every column
    columns: Columns
    # How smooth it may be: words, and a factor (L, R) of the prior covariance of the parameters
    priors: tuple[tuple[str, FloatArray], ...]


class Fitted(Protocol):
    """Cells with a model fitted to them, as far as corrections look at it."""

    @property
    def settings(self) -> dict[str, float]:
        """Effects by ``name.parameter``."""

    @property
    def state(self) -> State:
        """Residual, model and noise."""

    @property
    def geometry(self) -> ImageGeometry:
        """Centres of the cells, wavelengths."""

    def change(self, settings: dict[str, float]) -> FloatArray:
        """What other settings change in the data, at the same thickness and levels, ``(W, ny, nx)``."""


def with_learned(catalogue: Sequence[Effect]) -> list[Effect]:
    """A catalogue with corrections among the effects that may be set."""
    known = {effect.name for effect in catalogue}
    return [*catalogue, *(effect for effect in LEARNED if effect.name not in known)]


def families(fitted: Fitted, only: str = "") -> list[Family]:
    """All kinds of corrections at a fit, or the one of a name."""
    geometry, state = fitted.geometry, fitted.state
    makers = {
        "learned_response": lambda: _of_phase(fitted),
        "learned_map": lambda: _of_map(geometry, state),
        "learned_light": lambda: _of_light(geometry, state),
    }
    if len(np.unique(geometry.amplifier)) > 1:
        makers["learned_amplifiers"] = lambda: _of_amplifiers(geometry, state)
    return [make() for name, make in makers.items() if only in ("", name)]


def _used_nodes(wavelength_nm: FloatArray) -> tuple[list[int], FloatArray]:
    """Nodes between which there are exposures, and their shares ``(W, nodes)``."""
    shares = node_shares(wavelength_nm)
    used = np.flatnonzero(shares.any(axis=0))
    return [LEARNED_NODES_NM[number] for number in used], shares[:, used]


def _alike(length_nm: float) -> str:
    """How far wavelengths know of each other, in words."""
    return "each wavelength by itself" if length_nm == LENGTHS_NM[0] else f"alike over {length_nm:g} nm"


def over_wavelength(wavelength_nm: ArrayLike, length_nm: float) -> FloatArray:
    """Root ``(W, R)`` of the covariance of a smooth function of unit variance; what has no power is left out."""
    away = np.subtract.outer(wavelength_nm, wavelength_nm) / length_nm
    values, vectors = np.linalg.eigh(np.exp(-0.5 * away**2))
    keep = values > LEAST_POWER * values[-1]
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))


def _product(first: FloatArray, second: FloatArray) -> FloatArray:
    """Root of the covariance of products of two independent processes."""
    return np.asarray(np.kron(first, second), dtype=float)


def _of_phase(fitted: Fitted) -> Family:
    """Harmonics of the fringe at every wavelength."""
    settings = fitted.settings
    nodes, shares = _used_nodes(fitted.geometry.wavelength_nm)
    waves = [f"{wave}{harmonic}" for harmonic in LEARNED_HARMONICS for wave in ("cos", "sin")]
    amplitude, step = [], 1e-3
    for wave in waves:
        names = [f"learned_response.{wave}_{node}" for node in LEARNED_NODES_NM]
        moved = {name: settings.get(name, 0.0) + step for name in names}
        amplitude.append(fitted.state.root * fitted.change({**settings, **moved}) / step)
    planes = np.tile(np.arange(len(shares)), len(waves))
    basis = _product(np.eye(len(waves)), shares)
    columns = PlaneColumns(np.concatenate(amplitude), planes, basis)
    keys = tuple(f"learned_response.{wave}_{node}" for wave in waves for node in nodes)
    priors = []
    for length in LENGTHS_NM:
        for decay in DECAYS:
            sizes = np.repeat([decay ** (harmonic - 1) for harmonic in LEARNED_HARMONICS], 2)
            words = f"{_alike(length)}, harmonics falling by {decay:g}"
            priors.append((words, _product(np.diag(sizes), over_wavelength(nodes, length))))
    return Family("learned_response", keys, columns, tuple(priors))


def _patterns(geometry: ImageGeometry, orders: Sequence[tuple[int, int]]) -> FloatArray:
    highest = 1 + max(max(pair) for pair in orders)
    down, along = cosines(geometry, highest)
    return np.stack([np.outer(down[:, j], along[:, i]) for j, i in orders])


def _resolved(orders: Sequence[tuple[int, int]], shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Those that the cells tell apart."""
    return [(j, i) for j, i in orders if j < shape[0] and i < shape[1]]


def _roots(power: FloatArray) -> FloatArray:
    """Root of a covariance without correlations; what has no power is left out."""
    return np.asarray(np.diag(np.sqrt(power))[:, power > LEAST_POWER * power.max()])


def _of_map(geometry: ImageGeometry, state: State) -> Family:
    """A pattern that all exposures share."""
    orders = _resolved(map_orders(), geometry.sample_shape)
    down, along = np.array(orders).T
    keys = tuple(f"learned_map.y{j}x{i}" for j, i in orders)
    columns = LocalColumns(_patterns(geometry, orders), state.whiten(state.value)[np.newaxis])
    priors = [
        (
            f"smooth over {1.0 / width:.2g} of the sensor",
            _roots(np.exp(-0.5 * (down**2 + along**2) / width**2)),
        )
        for width in ORDERS
    ]
    priors.append(("of any scale", _roots(np.ones(len(orders)))))
    for words, across in (("columns", down), ("rows", along)):
        priors.append((words, _roots((across == 0).astype(float))))
    return Family("learned_map", keys, columns, tuple(priors))


def _of_light(geometry: ImageGeometry, state: State) -> Family:
    """A pattern in each exposure."""
    orders = _resolved(light_orders(), geometry.sample_shape)
    nodes, shares = _used_nodes(geometry.wavelength_nm)
    keys = tuple(f"learned_light.at_{node}_y{j}x{i}" for node in nodes for j, i in orders)
    terms = state.whiten(state.value * shares.T[:, :, np.newaxis, np.newaxis])
    size = np.hypot(*np.array(orders).T)
    priors = []
    for length in LENGTHS_NM:
        for width in (1.5, 4.0):
            over = _roots(np.exp(-0.5 * (size / width) ** 2))
            words = f"{_alike(length)}, smooth over {1.0 / width:.2g} of the sensor"
            priors.append((words, _product(over_wavelength(nodes, length), over)))
    return Family("learned_light", keys, LocalColumns(_patterns(geometry, orders), terms), tuple(priors))


def _of_amplifiers(geometry: ImageGeometry, state: State) -> Family:
    """A factor for each amplifier, and its colour."""
    here = [number for number in range(len(AMPLIFIERS)) if (geometry.amplifier == number).any()]
    patterns = np.stack([(geometry.amplifier == number).astype(float) for number in here])
    colour = amplifier_colour(geometry.wavelength_nm)[:, np.newaxis, np.newaxis]
    terms = np.stack([state.whiten(state.value), state.whiten(state.value * colour)])
    names = [AMPLIFIERS[number] for number in here]
    keys = tuple(f"learned_amplifiers.{name}{end}" for end in ("", "_colour") for name in names)
    both = np.eye(2 * len(here))
    priors = (("without colour", both[:, : len(here)]), ("with colour", both))
    return Family("learned_amplifiers", keys, LocalColumns(patterns, terms), priors)
