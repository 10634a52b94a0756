"""Light, contrast and wavelengths of the flats, learned from the cells of a sensor together with their thickness.

With the orders known, light, contrast and wavelengths are a linear problem, step by step, once the thickness of every
cell is eliminated: a small change of it moves the amplitudes along their slope, so that direction is projected out
(variable projection, Golub & Pereyra 1973, Inverse Problems 19, R1 (2003) for a review).

Each of them has a prior. Those of light and contrast are wide. The width of the wavelengths about their labels is at
most what the set-up states; how wide it is, and whether a single one is off, is found from the flats themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...array_types import FloatArray
from .evidence import refine_row
from .learning_cells import LearningCells
from .misfit import Misfit, shared_variances
from .nuisances import OVERTONES, NuisanceFit, Nuisances, light_widths
from .templates import FlatTemplates
from .wavelengths import CommonError, common_error, shift_precision

_ROUNDS = 8
_TOLERANCE = 3e-5
_CONTRAST_BY_WAVELENGTH = 0.3
"""Standard deviation of the logarithm of the contrast of one wavelength about the mean of all."""
_FADING = 0.1  # Standard deviation of the logarithmic loss of contrast per thickness [1/µm]
_OVERTONE, _OVERTONE_BY_WAVELENGTH = 0.5, 0.2
"""Standard deviations of what is added of the overtones of the model: what wavelengths share, and what each has
besides."""
_TEMPLATE_MARGIN_UM = 0.5
_FREE = 1e-4  # Precision of what has no prior


def learn(
    cells: LearningCells,
    base: FlatTemplates,
    free: Nuisances,
    start: NuisanceFit,
    rounds: int = _ROUNDS,
    final: bool = False,
) -> tuple[NDArray[np.float32], NuisanceFit]:
    """Fit light, contrast, wavelengths and the thickness of the cells together, the orders being known.

    ``cells``: mean amplitudes, with their thickness to within a fraction of an order; ``rounds``: most steps;
    ``final``: keep the covariance of what was learned, which nobody asks of an order that is compared. Returns
    ``thickness_um``: thickness of the cells looked at, float32.
    """
    problem = _Problem.of(cells, base, free)
    fit, thickness = replace(start, middle_um=float(np.median(cells.thickness_um))), cells.thickness_um
    fit = problem.normalised(fit, thickness)
    for _ in range(rounds):
        before = fit
        moved, fit = problem.step(fit, thickness)
        if not (_is_finite(fit) and np.isfinite(moved).all()):
            # Fringes that the model hardly has would need a contrast beyond all numbers.
            fit = before
            break
        thickness = moved
        # A mean that follows the thickness one step behind lets both swing; a free level makes up for any mean.
        fit = fit if free.patterned else problem.normalised(fit, thickness)
        if _change(before, fit) < _TOLERANCE:
            break
    return problem.conclude(fit, thickness, final)


def _is_finite(fit: NuisanceFit) -> bool:
    """Whether all that was learned is a number."""
    learned = (fit.contrast, fit.shift_nm, fit.fading, fit.overtones, fit.coefficients)
    return all(np.isfinite(each).all() for each in learned)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Cells, model and prior of one sensor."""

    cells: LearningCells
    base: FlatTemplates
    free: Nuisances
    overtones: FloatArray | None

    @classmethod
    def of(cls, cells: LearningCells, base: FlatTemplates, free: Nuisances) -> _Problem:
        """Only the part of the templates that the cells need."""
        margin = _TEMPLATE_MARGIN_UM + 0.01 * float(cells.thickness_um.max())
        part, rows = base.part(
            float(cells.thickness_um.min()) - margin, float(cells.thickness_um.max()) + margin
        )
        return cls(cells, part, free, base.overtones[rows] if free.contrast == "wavelength" else None)

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

    def templates(self, fit: NuisanceFit) -> FlatTemplates:
        """The model with what was learned."""
        return self.base.as_found(
            fit.contrast, fit.shift_nm, fit.fading, fit.overtones, fit.middle_um, self.overtones
        )

    def normalised(self, fit: NuisanceFit, thickness: NDArray[np.float32]) -> NuisanceFit:
        """With the mean response over these thicknesses."""
        return replace(fit, mean_response=self.templates(fit).normalised_to(thickness).mean_response)

    def residual(
        self, fit: NuisanceFit, thickness: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], FloatArray, FloatArray, FloatArray]:
        """Refined thickness, model amplitude, its slope, and what is left of the cells."""
        wavelengths = self.base.n_wavelengths
        fitted = replace(self.templates(fit), mean_response=fit.mean_response)
        grid = fitted.grid()
        value = self.cells.value.copy()
        if fit.coefficients.size:
            light = np.exp(self.cells.pattern @ fit.coefficients.T)
            value[:, :wavelengths] = (1.0 + value[:, :wavelengths]) / light - 1.0
        found = np.full_like(thickness, np.nan)
        refine_row(value, self.cells.weight, *grid, thickness, found)
        found = np.where(np.isfinite(found), found, thickness)
        model, slope = _curve(fitted, grid.table, found)
        return found, model, slope, value[:, :wavelengths] - model

    def step(
        self, fit: NuisanceFit, thickness: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NuisanceFit]:
        """One Gauss-Newton step of all nuisances."""
        thickness, model, slope, rest = self.residual(fit, thickness)
        normal, right = self._system(fit, thickness, model, slope, rest)
        moved = np.asarray(np.linalg.solve(normal, right), dtype=float)
        return self._centred(self._moved(fit, moved), thickness)

    def _centred(
        self, fit: NuisanceFit, thickness: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NuisanceFit]:
        """With the common error of the wavelengths where their labels have it, and the thickness that follows it."""
        if self.free.wavelength_accuracy_nm == 0.0:
            return thickness, fit
        along = self._along(fit)
        move = along * self._common(fit).mean_nm
        turned = self.base.turn_um(thickness[:, None]) @ move / move.size
        return np.asarray(thickness - turned, np.float32), replace(fit, shift_nm=fit.shift_nm + move)

    def _along(self, fit: NuisanceFit) -> FloatArray:
        """Change of the wavelengths that a change of the thickness makes up for, 1 nm in the mean."""
        turn = self.base.turn_um(fit.middle_um)
        return np.asarray(turn.mean() / turn)

    def _common(self, fit: NuisanceFit) -> CommonError:
        return common_error(fit.shift_nm, self._along(fit), self.free.wavelength_accuracy_nm)

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
        weight = self.cells.weight[:, :wavelengths].astype(float)
        weight = self.cells.temper * self._trust(rest, weight)[2][:, None] * weight
        weight = weight / np.maximum(
            (weight * rest**2).sum(axis=0) / np.maximum((weight > 0).sum(axis=0), 1), 1.0
        )
        information = np.maximum((weight * slope**2).sum(axis=1), 1e-30)
        # The direction in which a change of the thickness moves a cell is projected out.
        lean = np.ascontiguousarray((weight * slope / np.sqrt(information)[:, None]).T)
        heavy = np.ascontiguousarray(weight.T)
        each, common = self._design(fit, thickness, model, slope)
        size = wavelengths * own
        along = (each * lean[:, None]).reshape(size, len(rest))
        along_common = (common * lean[:, None]).sum(axis=0)
        weighted, turned = each * heavy[:, None], common.transpose(0, 2, 1)
        normal = np.empty((size + shared, size + shared))
        normal[:size, :size] = -along @ along.T
        for band, block in enumerate(weighted @ each.transpose(0, 2, 1)):
            part = slice(band * own, (band + 1) * own)
            normal[part, part] += block
        normal[:size, size:] = (weighted @ turned).reshape(size, shared) - along @ along_common.T
        normal[size:, :size] = normal[:size, size:].T
        normal[size:, size:] = (common * heavy[:, None] @ turned).sum(axis=0) - along_common @ along_common.T
        left = heavy * rest.T - lean * (lean * rest.T).sum(axis=0)
        right = np.concatenate(
            [(each @ left[..., None]).ravel(), (common @ left[..., None]).sum(axis=0).ravel()]
        )
        precision, where = self._prior(fit)
        return normal + precision, right - precision @ where

    def _design(
        self, fit: NuisanceFit, thickness: NDArray[np.float32], model: FloatArray, slope: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """What parameters of each wavelength, and those that all share, change, wavelength by wavelength."""
        count = self.cells.pattern.shape[1]
        far = thickness.astype(float)
        wavelengths, cells = model.shape[1], model.shape[0]
        each = np.empty((wavelengths, self.own, cells))
        each[:, :count] = (1.0 + model.T)[:, None] * self.cells.pattern.T
        if self.overtones is not None:
            each[:, count] = model.T
            seen = far[:, None] + self.base.turn_um(far[:, None]) * fit.shift_nm
            place = np.rint((seen - self.base.start_um) / self.base.step_um).astype(int)
            place = np.clip(place, 0, len(self.overtones) - 1)
            wave = self.overtones[place, np.arange(wavelengths)]
            scale = fit.contrast / fit.mean_response
            each[:, count + 1 : count + 1 + OVERTONES] = (scale[:, None] * wave).transpose(1, 2, 0)
        if self.free.wavelength_accuracy_nm > 0.0:
            each[:, -1] = (slope * self.base.turn_um(far[:, None])).T
        common = np.empty((wavelengths, self.shared, cells))
        if self.free.contrast == "common":
            common[:, 0] = model.T
        elif self.free.contrast == "wavelength":
            common[:, 0] = -model.T * (far - fit.middle_um)
        return each, common

    def _prior(self, fit: NuisanceFit) -> tuple[FloatArray, FloatArray]:
        """Precision of the prior, and where the parameters stand relative to its middle."""
        wavelengths, own, count = self.base.n_wavelengths, self.own, self.cells.pattern.shape[1]
        precision = np.zeros((wavelengths, own, wavelengths, own))
        bands = np.arange(wavelengths)
        where = np.zeros((wavelengths, own))
        where[:, :count] = fit.coefficients
        if count:
            together = light_widths(self.free, self.cells.zones, count, True) ** 2
            alone = light_widths(self.free, self.cells.zones, count, False) ** 2
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
            precision[bands, count, bands, count] = shift_precision(
                fit.shift_nm, self.free.wavelength_accuracy_nm
            )
        size = wavelengths * own
        whole = np.zeros((size + self.shared, size + self.shared))
        whole[:size, :size] = precision.reshape(size, size)
        stands = np.concatenate([where.ravel(), np.zeros(self.shared)])
        if self.free.contrast == "common":
            whole[size, size] = _FREE
        elif self.free.contrast == "wavelength":
            whole[size, size], stands[size] = _FADING**-2.0, fit.fading
        return whole, stands

    def _moved(self, fit: NuisanceFit, moved: FloatArray) -> NuisanceFit:
        """Where a step ends."""
        wavelengths, count = self.base.n_wavelengths, self.cells.pattern.shape[1]
        table = moved[: wavelengths * self.own].reshape(wavelengths, self.own)
        rest = moved[wavelengths * self.own :]
        coefficients = fit.coefficients + np.clip(table[:, :count], -0.2, 0.2)
        contrast, shift, fading, overtones = fit.contrast, fit.shift_nm, fit.fading, fit.overtones
        # A contrast cannot turn negative: that would be half an order.
        if self.free.contrast == "wavelength":
            contrast = contrast * np.exp(np.clip(table[:, count], -0.7, 0.7))
            fading = float(np.clip(fading + np.clip(rest[0], -0.1, 0.1), -0.5, 0.5))
            overtones = overtones + np.clip(table[:, count + 1 : count + 1 + OVERTONES], -0.3, 0.3)
        elif self.free.contrast == "common":
            contrast = contrast * np.exp(np.clip(rest[0], -0.7, 0.7))
        if self.free.wavelength_accuracy_nm > 0.0:
            shift = shift + np.clip(table[:, -1], -0.7, 0.7)
        return replace(
            fit, coefficients=coefficients, contrast=contrast, shift_nm=shift, fading=fading, overtones=overtones
        )  # fmt: skip

    def conclude(
        self, fit: NuisanceFit, thickness: NDArray[np.float32], final: bool
    ) -> tuple[NDArray[np.float32], NuisanceFit]:
        """Uncertainties, misfit of each flat, and the chi-square with that of the prior."""
        thickness, model, slope, rest = self.residual(fit, thickness)
        normal, _ = self._system(fit, thickness, model, slope, rest)
        precision, _ = self._prior(fit)
        variance = np.asarray(np.linalg.inv(normal), dtype=float)
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
            turn = float(np.abs(self.base.turn_um(fit.middle_um)).mean())
            scale = self._common(fit).sigma_nm * turn / fit.middle_um
        weight = self.cells.weight[:, :wavelengths].astype(float)
        misfit, each, trust = self._trust(rest, weight)
        # The thickness of each cell takes one degree of freedom, and each nuisance as much as it is not held.
        held = np.diag(variance @ precision)[: wavelengths * own].reshape(wavelengths, own).sum(axis=1)
        seen = (weight > 0).sum(axis=0)
        freedom = np.maximum(seen * (1.0 - 1.0 / wavelengths) - (own - held), 1.0)
        squares = (trust[:, None] * weight * rest**2).sum(axis=0) / freedom
        standard = np.sqrt(trust[:, None] * weight / np.maximum(squares, 1.0)) * rest
        return thickness, replace(
            fit,
            contrast_sigma=contrast_sigma, shift_sigma_nm=shift_sigma, scale_sigma=scale,
            misfit=misfit.scale * squares, chi2=self.cells.temper * misfit.cost(each), prior=self._prior_chi2(fit),
            shared=float(shared_variances(standard, thickness, self.cells.order_um)[-1]),
            covariance=variance if final else fit.covariance,
        )  # fmt: skip

    def moves(self, fit: NuisanceFit) -> tuple[FloatArray, FloatArray]:
        """See `moves_of`."""
        thickness, wavelengths = self.cells.thickness_um, self.base.n_wavelengths
        fitted = replace(self.templates(fit), mean_response=fit.mean_response)
        model, slope = _curve(fitted, fitted.table(), thickness)
        each, common = self._design(fit, thickness, model, slope)
        lean = (self.cells.weight[:, :wavelengths] * slope).T
        information = np.maximum((lean * slope.T).sum(axis=0), 1e-30)
        moves = (each * lean[:, None]).reshape(wavelengths * self.own, thickness.size)
        moves = np.concatenate([moves, (common * lean[:, None]).sum(axis=0)]) / information
        if self.free.wavelength_accuracy_nm > 0.0:  # what is common to them is the scale
            along, place = self._along(fit), np.arange(self.own - 1, wavelengths * self.own, self.own)
            moves[place] -= np.outer(along, along @ moves[place]) / (along @ along)
        return moves, information

    def _trust(self, rest: FloatArray, weight: FloatArray) -> tuple[Misfit, FloatArray, FloatArray]:
        """How far cells can be off, the chi-square of each, and how far it is to be trusted."""
        chi2 = (weight * rest**2).sum(axis=1)
        misfit = Misfit.of(chi2, max(self.base.n_wavelengths - 1.0, 1.0))
        return misfit, chi2, misfit.trust(chi2)

    def _prior_chi2(self, fit: NuisanceFit) -> float:
        """Twice the negative logarithm of the prior, but for a constant."""
        precision, where = self._prior(fit)
        if self.free.wavelength_accuracy_nm == 0.0:
            return float(where @ precision @ where)
        where[np.arange(self.base.n_wavelengths) * self.own + self.own - 1] = 0.0
        return float(where @ precision @ where) + self._common(fit).cost


def moves_of(
    cells: LearningCells, base: FlatTemplates, free: Nuisances, fit: NuisanceFit
) -> tuple[FloatArray, FloatArray]:
    """What a change of all that was learned does to the thickness of each cell.

    ``cells, base, free``: as for `learn`. Returns ``moves``: thickness per unit of each parameter [µm]: those of
    one wavelength after the other, then what all share. Without the common error of the wavelengths,
    ``(n, n_cells)``; ``information``: inverse variance of the thickness from the noise of the cell [1/µm²],
    ``(n_cells,)``.
    """
    return _Problem.of(cells, base, free).moves(fit)


def _curve(
    fitted: FlatTemplates, table: NDArray[np.float32], thickness_um: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray]:
    """Amplitudes of templates, whose table it is, and their slopes [1/µm], shape ``(n, n_wavelengths)``."""
    place = np.clip((thickness_um.astype(float) - fitted.start_um) / fitted.step_um, 2.0, len(table) - 4.0)

    def at(place: FloatArray) -> FloatArray:
        below = place.astype(int)
        share = (place - below)[:, None]
        return np.asarray(table[below] * (1.0 - share) + table[below + 1] * share)[:, : fitted.n_wavelengths]

    return at(place), (at(place + 2.0) - at(place - 2.0)) / (4.0 * fitted.step_um)


def _change(before: NuisanceFit, after: NuisanceFit) -> float:
    """Length of a step."""
    return max(
        float(np.abs(after.coefficients - before.coefficients).max(initial=0.0)),
        0.1 * float(np.abs(np.log(after.contrast / before.contrast)).max()),
        0.01 * float(np.abs(after.shift_nm - before.shift_nm).max()),
    )
