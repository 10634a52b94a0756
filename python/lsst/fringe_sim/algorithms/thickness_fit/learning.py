"""Light, contrast and wavelengths of the flats, learned from the cells of a sensor together with their thickness.

Before any thickness is known, the mean over the wavelengths shows the light that all flats share: fringes of a
layer of tens of orders turn several times over the wavelengths and average out. With the orders known, light,
contrast and wavelengths are a linear problem, step by step, once the thickness of every cell is eliminated: a small
change of it moves the amplitudes along their slope, so that direction is projected out (variable projection, Golub &
Pereyra 1973, Inverse Problems 19, R1 (2003) for a review).

Each of them has a prior. Those of light and contrast are wide. The width of the wavelengths about their labels is at
most what the set-up states; how wide it is, and whether a single one is off, is found from the flats themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .amplitudes import Amplitudes
from .borders import gather_pixels
from .cells import Cells, effective_number
from .evidence import refine_row
from .nuisances import OVERTONES, NuisanceFit, Nuisances, light_patterns, patterns_of_cells
from .pixels import CellSurface
from .templates import FringeTemplates

__all__ = [
    "CommonOrder",
    "LearningCells",
    "first_nuisances",
    "learn",
    "rank_orders",
    "sample_blocks",
    "spread_of_wavelengths",
]

FloatArray = NDArray[np.float64]

_MOST_CELLS = 3_000
_FIRST_CELLS = 20_000
_MOST_BLOCKS = 6_000
_LARGEST_BLOCK = 6
_LEAST_KEPT = 0.7
"""Share of its contrast that a block must keep."""
_PHASE_SIGMA = 0.1
"""Uncertainty of the phase of a block [rad] at which its noise raises the contrast by half a per cent."""
_ROUNDS = 8
_TOLERANCE = 3e-5
_UNSOUND = 9.0
"""Cells whose chi-square is this many times the median have no say."""
_GAIN_BY_WAVELENGTH = 0.2
"""Standard deviation of the level of a zone at one wavelength, over that of its mean: levels are mostly gains."""
_LIGHT, _LIGHT_BY_WAVELENGTH = 0.1, 0.02
"""Standard deviations of each term of a slow illumination: what wavelengths share, and what each has of its own."""
_CONTRAST_BY_WAVELENGTH = 0.3
"""Standard deviation of the logarithm of the contrast of one wavelength about the mean of all."""
_FADING = 0.1
"""Standard deviation of the logarithmic loss of contrast per thickness [1/µm]."""
_OVERTONE, _OVERTONE_BY_WAVELENGTH = 0.5, 0.2
"""Standard deviations of what is added of the overtones of the model: what wavelengths share, and what each has
besides."""
_LEAST_SHIFT_NM = 0.02
"""Least standard deviation of the wavelengths: that of a calibrated monochromator."""
_TEMPLATE_MARGIN_UM = 0.5
_FREE = 1e-4
"""Precision of what has no prior."""
_TAIL = 6.0
"""Degrees of freedom of the distribution of wavelengths about their labels: now and then one is far off."""
_INDEPENDENT = 100
"""Independent places of a sensor at most, before the fringes are known: they hide light of their own scale."""


@dataclass(frozen=True, eq=False)
class LearningCells:
    """Cells from which nuisances are learned, as they came from the flats."""

    value: NDArray[np.float32]
    weight: NDArray[np.float32]
    thickness_um: NDArray[np.float32]
    pattern: FloatArray
    zones: int
    temper: float

    @classmethod
    def of(
        cls, cells: Cells, thickness_um: NDArray[np.float32], free: Nuisances, temper: float = 1.0
    ) -> LearningCells:
        """Some thousand cells with a thickness, drawn at random but always the same."""
        good = _some(np.flatnonzero(np.isfinite(thickness_um)), _MOST_CELLS)
        pattern, zones = patterns_of_cells(cells, free, *np.unravel_index(good, cells.shape))
        width = cells.value.shape[-1]
        return cls(
            np.ascontiguousarray(cells.value.reshape(-1, width)[good]),
            np.ascontiguousarray(cells.weight.reshape(-1, width)[good]),
            thickness_um.ravel()[good],
            pattern,
            zones,
            temper,
        )


def sample_blocks(
    data: Amplitudes, surface: CellSurface, free: Nuisances, phase_sigma: float, order_um: float
) -> LearningCells:
    """Small blocks of pixels on the surface of the cells, drawn at random but always the same.

    Cells are steep: their averages lose contrast and overtones. A block is only as large as its noise asks for, as
    the contrast of what is mostly noise would be taken for too high.

    Parameters
    ----------
    data : `Amplitudes`
        The flats.
    surface : `CellSurface`
        Thickness of the cells.
    free : `Nuisances`
        What is free.
    phase_sigma : `float`
        Standard uncertainty of the phase of a single pixel [rad].
    order_um : `float`
        Thickness of one order [µm].
    """
    _, ny, nx = data.shape
    side = int(np.clip(np.ceil(phase_sigma / _PHASE_SIGMA), 1, min(_LARGEST_BLOCK, ny, nx)))
    rng = np.random.default_rng(0)
    count = min(_MOST_BLOCKS, (ny // side) * (nx // side))
    place = np.sort(rng.choice((ny // side) * (nx // side), count, replace=False))
    rows, columns = side * (place // (nx // side)), side * (place % (nx // side))
    parts = [gather_pixels(data, rows + b, columns + a) for b in range(side) for a in range(side)]
    weights = np.asarray(sum(weight for _, weight in parts), np.float32)
    sums = np.asarray(sum(value * weight for value, weight in parts), np.float32)
    middle = (side - 1) // 2
    y, x = rows + middle, columns + middle
    thickness = _surface_at(surface, y, x)
    good = np.isfinite(thickness) & (weights > 0).any(axis=1)
    pattern, zones = light_patterns(
        free, (ny, nx), *(np.asarray(part + 0.5 * (side - 1), dtype=float) for part in (rows, columns))
    )
    values = np.divide(sums, weights, out=np.zeros_like(sums), where=weights > 0)
    # What the average over a block keeps of its fringes.
    turns = [
        0.5 * side / order_um * (_surface_at(surface, *ahead) - _surface_at(surface, *behind))
        for ahead, behind in (
            ((np.minimum(y + 1, ny - 1), x), (np.maximum(y - 1, 0), x)),
            ((y, np.minimum(x + 1, nx - 1)), (y, np.maximum(x - 1, 0))),
        )
    ]
    kept = np.sinc(turns[0]) * np.sinc(turns[1]) if side > 1 else np.ones(y.size)
    good &= kept > _LEAST_KEPT
    values, weights = (
        values / kept[:, None].astype(np.float32),
        weights * (kept**2)[:, None].astype(np.float32),
    )
    temper = effective_number(side, side, data.noise_correlation_px) / side**2
    return LearningCells(
        np.asarray(values[good], np.float32),
        np.asarray(temper * weights[good], np.float32),
        thickness[good],
        pattern[good],
        zones,
        1.0,
    )


def _surface_at(surface: CellSurface, y: NDArray[np.intp], x: NDArray[np.intp]) -> NDArray[np.float32]:
    """Bilinear surface at single places [µm]."""
    order = np.argsort(y, kind="stable")
    out = np.empty(y.size, np.float32)
    for part in np.array_split(order, max(y.size // 200, 1)):
        if part.size:
            rows, place = np.unique(y[part], return_inverse=True)
            out[part] = surface.at(rows, x[part])[place, np.arange(part.size)]
    return out


def _some(index: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Some of many, drawn at random but always the same."""
    if index.size <= most:
        return index
    return np.sort(np.random.default_rng(0).choice(index, most, replace=False))


def first_nuisances(cells: Cells, templates: FringeTemplates, free: Nuisances) -> NuisanceFit:
    """Light and contrast before any thickness is known: fringes average out over wavelengths and over the sensor.

    Parameters
    ----------
    cells : `Cells`
        Mean amplitudes.
    templates : `FringeTemplates`
        The model.
    free : `Nuisances`
        What is free.
    """
    wavelengths, width = templates.n_wavelengths, cells.value.shape[-1]
    seen = _some(np.flatnonzero((cells.weight[..., :wavelengths] > 0).all(axis=-1)), _FIRST_CELLS)
    pattern, zones = patterns_of_cells(cells, free, *np.unravel_index(seen, cells.shape))
    known = replace(NuisanceFit.none(wavelengths, pattern.shape[-1]), contrast=templates.contrast)
    if not free.any or seen.size == 0:
        return known
    weight, value = (
        part.reshape(-1, width)[seen, :wavelengths].astype(float) for part in (cells.weight, cells.value)
    )
    coefficients = known.coefficients.copy()
    if pattern.shape[-1]:
        level = np.log1p(np.clip(value, -0.9, 10.0))
        shared = _ridge(pattern, level.mean(axis=1), _widths(free, zones, pattern.shape[-1], True))
        own = level - (pattern @ shared)[:, None]
        alone = _widths(free, zones, pattern.shape[-1], False)
        coefficients = np.stack([shared + _ridge(pattern, part, alone) for part in own.T])
    rest = (1.0 + value) * np.exp(-pattern @ coefficients.T) - 1.0
    strength = templates.amplitude().std(axis=0)
    power = np.array(
        [_robust_variance(rest[:, k]) - float(np.median(1.0 / weight[:, k])) for k in range(wavelengths)]
    )
    contrast = np.sqrt(np.maximum(power, 0.0)) / strength
    mean = float(np.sum(contrast * strength**2) / np.sum(strength**2))
    if free.contrast == "fixed":
        contrast = np.ones(wavelengths)
    elif free.contrast == "common":
        contrast = np.full(wavelengths, mean)
    else:
        contrast = np.clip(contrast, 0.3 * mean, 3.0 * mean)
    return replace(known, coefficients=coefficients, contrast=np.maximum(contrast, 1e-3) * templates.contrast)


def _robust_variance(values: FloatArray) -> float:
    """Variance of a fringe and its noise without its outliers: values beyond four times the median are cut."""
    size = np.abs(values - np.median(values))
    return float(np.mean(np.minimum(size, 4.0 * np.median(size)) ** 2))


def _widths(free: Nuisances, zones: int, count: int, shared: bool) -> FloatArray:
    """Standard deviations of the coefficients of the light: what wavelengths share, or what each has besides."""
    known = np.isfinite(free.gain_accuracy)
    width = np.full(count, (_LIGHT if shared else _LIGHT_BY_WAVELENGTH) if known else 1.0)
    width[0] = 1.0
    gain = free.gain_accuracy * (1.0 if shared else _GAIN_BY_WAVELENGTH) if known else 1.0
    width[1 : 1 + zones] = gain
    return width


def _ridge(pattern: FloatArray, value: FloatArray, width: FloatArray) -> FloatArray:
    """Least squares with a prior; what is left over is counted as noise of few independent places."""
    centred = value - value.mean()
    noise = max(float(np.mean(centred**2)), 1e-12)
    for _ in range(2):
        share = min(_INDEPENDENT / len(value), 1.0) / noise
        normal = share * pattern.T @ pattern + np.diag(width**-2.0)
        found = np.linalg.solve(normal, share * pattern.T @ value)
        noise = max(float(np.mean((value - pattern @ found) ** 2)), 1e-12)
    return np.asarray(found)


def learn(
    cells: LearningCells,
    base: FringeTemplates,
    free: Nuisances,
    start: NuisanceFit,
    rounds: int = _ROUNDS,
    overtones: FloatArray | None = None,
) -> tuple[NDArray[np.float32], NuisanceFit]:
    """Fit light, contrast, wavelengths and the thickness of the cells together, the orders being known.

    Parameters
    ----------
    cells : `LearningCells`
        Mean amplitudes, with their thickness to within a fraction of an order.
    base : `FringeTemplates`
        The model, normalised to the sensor.
    free : `Nuisances`
        What is free.
    start : `NuisanceFit`
        Where to begin.
    rounds : `int`, optional
        Most steps.
    overtones : `numpy.ndarray`, optional
        Those of ``base``, if they are known.

    Returns
    -------
    thickness_um : `numpy.ndarray`, float32
        Thickness of the cells looked at.
    fit : `NuisanceFit`
    """
    if overtones is None and free.contrast == "wavelength":
        overtones = base.overtones()
    problem = _Problem.of(cells, base, free, overtones)
    fit, thickness = replace(start, middle_um=float(np.median(cells.thickness_um))), cells.thickness_um
    fit = problem.normalised(fit, thickness)
    for _ in range(rounds):
        thickness, fit, change = problem.step(fit, thickness)
        # A mean that follows the thickness one step behind lets both swing; a free level makes up for any mean.
        fit = fit if free.patterned else problem.normalised(fit, thickness)
        if change < _TOLERANCE:
            break
    return problem.conclude(fit, thickness)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Cells, model and prior of one sensor."""

    cells: LearningCells
    base: FringeTemplates
    free: Nuisances
    overtones: FloatArray

    @classmethod
    def of(
        cls, cells: LearningCells, base: FringeTemplates, free: Nuisances, overtones: FloatArray | None
    ) -> _Problem:
        """Only the part of the templates that the cells need."""
        margin = _TEMPLATE_MARGIN_UM + 0.01 * float(cells.thickness_um.max())
        part, rows = base.part(
            float(cells.thickness_um.min()) - margin, float(cells.thickness_um.max()) + margin
        )
        return cls(cells, part, free, np.zeros((0, 0)) if overtones is None else overtones[rows])

    @property
    def shared(self) -> int:
        """Number of parameters that all wavelengths share."""
        return 0 if self.free.contrast == "fixed" else 1

    @property
    def own(self) -> int:
        """Number of parameters of each wavelength: light, contrast, wavelength."""
        return (
            self.cells.pattern.shape[1]
            + (1 + OVERTONES) * (self.free.contrast == "wavelength")
            + (self.free.wavelength_accuracy_nm > 0.0)
        )

    def normalised(self, fit: NuisanceFit, thickness: NDArray[np.float32]) -> NuisanceFit:
        """With the mean response over these thicknesses."""
        waves = self.overtones if len(self.overtones) else None
        found = self.base.as_found(
            fit.contrast, fit.shift_nm, fit.fading, fit.overtones, fit.middle_um, waves
        ).normalised_to(thickness)
        return replace(fit, mean_response=found.mean_response)

    def residual(
        self, fit: NuisanceFit, thickness: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], FloatArray, FloatArray, FloatArray]:
        """Refined thickness, model amplitude, its slope, and what is left of the cells."""
        wavelengths = self.base.n_wavelengths
        waves = self.overtones if len(self.overtones) else None
        fitted = self.base.as_found(
            fit.contrast, fit.shift_nm, fit.fading, fit.overtones, fit.middle_um, waves
        )
        fitted = replace(fitted, mean_response=fit.mean_response)
        table = fitted.table()
        value = self.cells.value.copy()
        if fit.coefficients.size:
            light = np.exp(self.cells.pattern @ fit.coefficients.T)
            value[:, :wavelengths] = (1.0 + value[:, :wavelengths]) / light - 1.0
        found = np.full_like(thickness, np.nan)
        refine_row(value, self.cells.weight, table, fitted.start_um, fitted.step_um, thickness, found)
        place = np.clip((found.astype(float) - fitted.start_um) / fitted.step_um, 2.0, len(table) - 4.0)

        def curve(at: FloatArray) -> FloatArray:
            below = at.astype(int)
            share = (at - below)[:, None]
            return np.asarray(table[below] * (1.0 - share) + table[below + 1] * share)[:, :wavelengths]

        model = curve(place)
        slope = (curve(place + 2.0) - curve(place - 2.0)) / (4.0 * fitted.step_um)
        return found, model, slope, value[:, :wavelengths] - model

    def step(
        self, fit: NuisanceFit, thickness: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NuisanceFit, float]:
        """One Gauss-Newton step of all nuisances."""
        thickness, model, slope, rest = self.residual(fit, thickness)
        normal, right = self._system(fit, thickness, model, slope, rest)
        moved = np.asarray(np.linalg.solve(normal, right), dtype=float)
        return thickness, *self._moved(fit, moved)

    def _system(
        self,
        fit: NuisanceFit,
        thickness: NDArray[np.float32],
        model: FloatArray,
        slope: FloatArray,
        rest: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and right-hand side, the prior included."""
        wavelengths, own, shared = self.base.n_wavelengths, self.own, self.shared
        weight = self.cells.temper * self.cells.weight[:, :wavelengths].astype(float)
        weight = weight * _sound(rest, weight)[:, None]
        weight = weight / np.maximum(
            (weight * rest**2).sum(axis=0) / np.maximum((weight > 0).sum(axis=0), 1), 1.0
        )
        information = np.maximum((weight * slope**2).sum(axis=1), 1e-30)
        lean = weight * slope / np.sqrt(information)[:, None]
        each, common = self._design(fit, thickness, model, slope)
        along = (each * lean[..., None]).reshape(len(rest), -1)
        along_common = (common * lean[..., None]).sum(axis=1)
        size = wavelengths * own
        normal = np.zeros((size + shared, size + shared))
        weighted = each * weight[..., None]
        blocks = np.matmul(np.moveaxis(each, 0, -1).transpose(0, 1, 2), np.moveaxis(weighted, 0, 1))
        for band in range(wavelengths):
            part = slice(band * own, (band + 1) * own)
            normal[part, part] = blocks[band]
            normal[part, size:] = weighted[:, band].T @ common[:, band]
        normal[:size, :size] -= along.T @ along
        normal[:size, size:] -= along.T @ along_common
        normal[size:, :size] = normal[:size, size:].T
        normal[size:, size:] = (
            np.einsum("nwq,nw,nwr->qr", common, weight, common) - along_common.T @ along_common
        )
        left = weight * rest - lean * (lean * rest).sum(axis=1)[:, None]
        right = np.concatenate(
            [np.einsum("nwp,nw->wp", each, left).ravel(), np.einsum("nwq,nw->q", common, left)]
        )
        precision, where = self._prior(fit)
        return normal + precision, right - precision @ where

    def _design(
        self, fit: NuisanceFit, thickness: NDArray[np.float32], model: FloatArray, slope: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """What each parameter changes in each cell: of each wavelength by itself, and of those that share it."""
        count = self.cells.pattern.shape[1]
        far = thickness.astype(float)
        each = np.empty((*model.shape, self.own))
        each[..., :count] = (1.0 + model)[..., None] * self.cells.pattern[:, None, :]
        if self.free.contrast == "wavelength":
            each[..., count] = model
            seen = far[:, None] + self.base.turn_um(far[:, None]) * fit.shift_nm
            place = np.rint((seen - self.base.start_um) / self.base.step_um).astype(int)
            place = np.clip(place, 0, len(self.overtones) - 1)
            wave = self.overtones[place, np.arange(self.base.n_wavelengths)]
            scale = fit.contrast / fit.mean_response
            each[..., count + 1 : count + 1 + OVERTONES] = scale[:, None] * wave
            count += 1 + OVERTONES
        if self.free.wavelength_accuracy_nm > 0.0:
            each[..., count] = slope * self.base.turn_um(far[:, None])
        common = np.empty((*model.shape, self.shared))
        if self.free.contrast == "common":
            common[..., 0] = model
        elif self.free.contrast == "wavelength":
            common[..., 0] = -model * (far - fit.middle_um)[:, None]
        return each, common

    def _prior(self, fit: NuisanceFit) -> tuple[FloatArray, FloatArray]:
        """Precision of the prior, and where the parameters stand relative to its middle."""
        wavelengths, own, count = self.base.n_wavelengths, self.own, self.cells.pattern.shape[1]
        precision = np.zeros((wavelengths, own, wavelengths, own))
        bands = np.arange(wavelengths)
        where = np.zeros((wavelengths, own))
        where[:, :count] = fit.coefficients
        if count:
            together = _widths(self.free, self.cells.zones, count, True) ** 2
            alone = _widths(self.free, self.cells.zones, count, False) ** 2
            for k in range(count):
                precision[:, k, :, k] = np.linalg.inv(alone[k] * np.eye(wavelengths) + together[k])
        if self.free.contrast == "wavelength":
            logarithm = np.log(fit.contrast)
            where[:, count] = logarithm - logarithm.mean()
            spread = np.eye(wavelengths) - 1.0 / wavelengths
            precision[:, count, :, count] = spread / _CONTRAST_BY_WAVELENGTH**2
            precision[bands, count, bands, count] += _FREE
            together = np.full((wavelengths, wavelengths), _OVERTONE**2)
            tied = np.linalg.inv(together + _OVERTONE_BY_WAVELENGTH**2 * np.eye(wavelengths))
            for k in range(OVERTONES):
                where[:, count + 1 + k] = fit.overtones[:, k]
                precision[:, count + 1 + k, :, count + 1 + k] = tied
            count += 1 + OVERTONES
        if self.free.wavelength_accuracy_nm > 0.0:
            where[:, count] = fit.shift_nm
            precision[bands, count, bands, count] = _shift_precision(fit, self.free.wavelength_accuracy_nm)
        size = wavelengths * own
        whole = np.zeros((size + self.shared, size + self.shared))
        whole[:size, :size] = precision.reshape(size, size)
        stands = np.concatenate([where.ravel(), np.zeros(self.shared)])
        if self.free.contrast == "common":
            whole[size, size] = _FREE
        elif self.free.contrast == "wavelength":
            whole[size, size], stands[size] = _FADING**-2.0, fit.fading
        return whole, stands

    def _moved(self, fit: NuisanceFit, moved: FloatArray) -> tuple[NuisanceFit, float]:
        """Where a step ends, and its length."""
        wavelengths, count = self.base.n_wavelengths, self.cells.pattern.shape[1]
        table = moved[: wavelengths * self.own].reshape(wavelengths, self.own)
        rest = moved[wavelengths * self.own :]
        coefficients = fit.coefficients + np.clip(table[:, :count], -0.2, 0.2)
        change = float(np.abs(table[:, :count]).max(initial=0.0))
        contrast, shift, fading, overtones = fit.contrast, fit.shift_nm, fit.fading, fit.overtones
        if self.free.contrast == "wavelength":
            # A contrast cannot turn negative: that would be half an order.
            contrast = contrast * np.exp(np.clip(table[:, count], -0.7, 0.7))
            change = max(change, 0.1 * float(np.abs(table[:, count]).max()))
            fading = float(np.clip(fading + np.clip(rest[0], -0.1, 0.1), -0.5, 0.5))
            overtones = overtones + np.clip(table[:, count + 1 : count + 1 + OVERTONES], -0.3, 0.3)
            count += 1 + OVERTONES
        elif self.free.contrast == "common":
            contrast = contrast * np.exp(np.clip(rest[0], -0.7, 0.7))
            change = max(change, 0.1 * float(np.abs(rest[0])))
        if self.free.wavelength_accuracy_nm > 0.0:
            shift = shift + np.clip(table[:, count], -0.7, 0.7)
            change = max(change, 0.01 * float(np.abs(table[:, count]).max()))
        return (
            replace(
                fit,
                coefficients=coefficients,
                contrast=contrast,
                shift_nm=shift,
                fading=fading,
                overtones=overtones,
            ),
            change,
        )

    def conclude(
        self, fit: NuisanceFit, thickness: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NuisanceFit]:
        """Uncertainties, misfit of each flat, and the chi-square with that of the prior."""
        thickness, model, slope, rest = self.residual(fit, thickness)
        normal, _ = self._system(fit, thickness, model, slope, rest)
        precision, _ = self._prior(fit)
        variance = np.linalg.inv(normal)
        wavelengths, own, count = self.base.n_wavelengths, self.own, self.cells.pattern.shape[1]
        diagonal = np.sqrt(np.maximum(np.diag(variance), 0.0))
        table = diagonal[: wavelengths * own].reshape(wavelengths, own)
        contrast_sigma, shift_sigma, scale = np.zeros(wavelengths), np.zeros(wavelengths), 0.0
        if self.free.contrast == "wavelength":
            contrast_sigma = fit.contrast * table[:, count]
            count += 1 + OVERTONES
        elif self.free.contrast == "common":
            contrast_sigma = fit.contrast * diagonal[wavelengths * own]
        if self.free.wavelength_accuracy_nm > 0.0:
            shift_sigma = table[:, count]
            scale = _scale_sigma(fit.shift_nm, self.base.wavelength_nm, self.free.wavelength_accuracy_nm)
        weight = self.cells.weight[:, :wavelengths].astype(float)
        sound = _sound(rest, weight)
        seen = (weight[sound] > 0).sum(axis=0)
        # The thickness of each cell takes one degree of freedom, and each nuisance as much as it is not held.
        held = np.diag(variance @ precision)[: wavelengths * own].reshape(wavelengths, own).sum(axis=1)
        freedom = np.maximum(seen * (1.0 - 1.0 / wavelengths) - (own - held), 1.0)
        squares = (weight * rest**2)[sound].sum(axis=0)
        excess = squares.sum() / freedom.sum() - 1.0 - _SIGNIFICANT * np.sqrt(2.0 / freedom.sum())
        each_cell = (weight * rest**2).sum(axis=1)
        capped = np.minimum(each_cell, _UNSOUND * np.median(each_cell))
        return thickness, replace(
            fit,
            contrast_sigma=contrast_sigma, shift_sigma_nm=shift_sigma, scale_sigma=scale, misfit=squares / freedom,
            chi2=self.cells.temper * float(capped.sum()), prior=self._prior_chi2(fit),
            excess=max(float(excess), 0.0), cells=len(capped),
        )  # fmt: skip

    def _prior_chi2(self, fit: NuisanceFit) -> float:
        """Twice the negative logarithm of the prior, but for a constant."""
        precision, where = self._prior(fit)
        accuracy = self.free.wavelength_accuracy_nm
        if accuracy == 0.0:
            return float(where @ precision @ where)
        at = np.arange(self.base.n_wavelengths) * self.own + self.own - 1
        where[at] = 0.0
        width = spread_of_wavelengths(fit.shift_nm, accuracy)
        return float(where @ precision @ where) + float(_wavelength_prior(fit.shift_nm, width, accuracy))


def _wavelength_prior(shift_nm: FloatArray, width_nm: FloatArray | float, accuracy_nm: float) -> FloatArray:
    """Twice the negative logarithm of the probability of offsets that scatter with some width, now and then far off.

    The width itself is probable up to what is stated, and less and less beyond.
    """
    width = np.asarray(width_nm, dtype=float)[..., None]
    tail = (_TAIL + 1.0) * np.log1p(shift_nm**2 / (_TAIL * width**2)) + 2.0 * np.log(width)
    return np.asarray(tail.sum(axis=-1) + (width[..., 0] / accuracy_nm) ** 2)


def spread_of_wavelengths(shift_nm: FloatArray, accuracy_nm: float = np.inf) -> float:
    """Most probable standard deviation of most wavelengths about their labels [nm]."""
    widths = _widths_of_wavelengths(min(accuracy_nm, max(float(np.abs(shift_nm).max()), _LEAST_SHIFT_NM)))
    return float(widths[np.argmin(_wavelength_prior(shift_nm, widths, accuracy_nm))])


def _widths_of_wavelengths(accuracy_nm: float) -> FloatArray:
    """Standard deviations of wavelengths about their labels that are possible where some accuracy is stated [nm]."""
    return np.geomspace(min(_LEAST_SHIFT_NM, accuracy_nm), 3.0 * accuracy_nm, 50)


def _scale_sigma(shift_nm: FloatArray, wavelength_nm: FloatArray, accuracy_nm: float) -> float:
    """Standard uncertainty of the scale of the thickness, to which only the labels of the wavelengths testify.

    The flats tell how far the wavelengths are off relative to each other. What all of them are off by is as uncertain
    as the labels scatter, and their scatter is uncertain itself.
    """
    widths = _widths_of_wavelengths(accuracy_nm)
    common = np.linspace(-4.0, 4.0, 401) * max(accuracy_nm, _LEAST_SHIFT_NM)
    moved = shift_nm + common[:, None] * wavelength_nm / wavelength_nm.mean()
    cost = np.stack([_wavelength_prior(moved, np.full(common.size, width), accuracy_nm) for width in widths])
    share = np.exp(-0.5 * (cost - cost.min())).sum(axis=0)
    share /= share.sum()
    middle = float(share @ common)
    return float(np.sqrt(share @ (common - middle) ** 2)) / float(wavelength_nm.mean())


def _shift_precision(fit: NuisanceFit, accuracy_nm: float) -> FloatArray:
    """Precision of the prior of each wavelength: that of a distribution with long tails, where it stands now."""
    if not np.any(fit.shift_nm):
        return np.full(fit.shift_nm.shape, accuracy_nm**-2.0)
    width = spread_of_wavelengths(fit.shift_nm, accuracy_nm)
    return np.asarray((_TAIL + 1.0) / (_TAIL * width**2 + fit.shift_nm**2))


def _sound(rest: FloatArray, weight: FloatArray) -> NDArray[np.bool_]:
    """Cells that fit no worse than most."""
    misfit = (weight * rest**2).sum(axis=1)
    return np.asarray(misfit <= _UNSOUND * np.median(misfit))


@dataclass(frozen=True, eq=False)
class CommonOrder:
    """Order of a whole sensor, all nuisances being free.

    Attributes
    ----------
    shift : `float`
        Orders by which the thickness is to be moved.
    fit : `NuisanceFit`
        Nuisances there.
    margin : `float`
        Chi-square by which the next best order is worse, model error allowed for.
    slip : `float`
        Probability that the order is another.
    """

    shift: float
    fit: NuisanceFit
    margin: float
    slip: float


_MOST_ORDERS = 8
_CLEAR = 100.0
"""Chi-square difference beyond which the orders behind one need not be asked."""


def rank_orders(
    cells: LearningCells,
    base: FringeTemplates,
    free: Nuisances,
    start: NuisanceFit,
    order_um: float,
    range_um: tuple[float, float],
) -> CommonOrder:
    """Compare the orders of a whole sensor: each with the light, contrast and wavelengths that it needs.

    Parameters
    ----------
    cells : `LearningCells`
        Cells with their thickness.
    base : `FringeTemplates`
        The model.
    free : `Nuisances`
        What is free.
    start : `NuisanceFit`
        Nuisances at the present order.
    order_um : `float`
        Thickness of one order [µm].
    range_um : `tuple` [`float`, `float`]
        Thicknesses that are possible [µm].
    """
    overtones = base.overtones() if free.contrast == "wavelength" else None
    thickness, here = learn(cells, base, free, start, overtones=overtones)
    tried, places = {0.0: here}, {0.0: thickness}

    def ask(shift: float, side: float) -> None:
        """Begin at the order beside this one: from far away, too few steps would reach the best."""
        near = replace(cells, thickness_um=places[shift - side])
        moved, guess = _guess_at_order(near, base, free, tried[shift - side], side * order_um)
        inside = (moved.thickness_um > range_um[0]) & (moved.thickness_um < range_um[1])
        if inside.mean() < _INSIDE:
            tried[shift] = replace(here, chi2=np.inf)
        else:
            places[shift], tried[shift] = learn(moved, base, free, guess, _ROUNDS_ELSEWHERE, overtones)

    def costs() -> dict[float, float]:
        """Chi-square of all, each where the model error of the best is counted as noise."""
        noise = _noise_with_model_error(min(tried.values(), key=lambda fit: fit.chi2 + fit.prior))
        return {shift: fit.chi2 / noise + fit.prior for shift, fit in tried.items()}

    def clear(shift: float) -> bool:
        cost = costs()
        return cost[shift] > min(cost.values()) + _CLEAR

    for side in (-1.0, 1.0):
        shift = side
        ask(shift, side)
        while abs(shift) < _MOST_ORDERS and not clear(shift):
            shift += side
            ask(shift, side)
    cost = costs()
    best = min(cost, key=lambda shift: cost[shift])
    excess = np.array([cost[shift] - cost[best] for shift in tried if shift != best])
    odds = float(np.exp(-0.5 * excess).sum())
    return CommonOrder(best, tried[best], float(excess.min()), odds / (1.0 + odds))


def _noise_with_model_error(fit: NuisanceFit) -> float:
    """Variance of cells with model error over that of their noise: it does not average out over cells."""
    return 1.0 + fit.excess * (1.0 + fit.cells / _ALIKE)


_SIGNIFICANT = 3.0
_ALIKE = 50
"""Parts of a sensor in which model error differs: it repeats with the phase and changes slowly with the thickness."""


def _guess_at_order(
    cells: LearningCells, base: FringeTemplates, free: Nuisances, start: NuisanceFit, move_um: float
) -> tuple[LearningCells, NuisanceFit]:
    """Cells moved by some orders, and the wavelengths at which their fringes look the same there."""
    moved = replace(cells, thickness_um=cells.thickness_um + np.float32(move_um))
    if free.wavelength_accuracy_nm == 0.0:
        return moved, start
    wavelength = base.wavelength_nm
    away = move_um * (1.0 - wavelength / wavelength.mean())
    shift = start.shift_nm - away / base.turn_um(float(np.median(moved.thickness_um)))
    return moved, replace(start, shift_nm=shift)


_ROUNDS_ELSEWHERE = 6
_INSIDE = 0.99
"""Share of a sensor that must lie in the range of thicknesses."""
