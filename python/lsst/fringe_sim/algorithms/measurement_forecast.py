"""What further flats would tell about effects, from derivatives of the model at a sample of pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..array_types import FloatArray
from ..effects import Effect, ImageGeometry, Parameter, activate_effects, apply_to_image
from ..errors import OutOfRangeError
from ..model import FringeModel
from .flat_series import FlatSeries

Report = Callable[[str], None]

SENSOR_PX = (4004, 4096)  # Rows and columns of the sensor whose information is forecast

SAMPLES = (6, 24)
"""Thicknesses of the silicon, within one of its fringe orders, and of the varying layer at each of them."""

RESPONSE_SCATTER = 0.01  # Scatter of the response of single pixels that is known beforehand (relative)
DERIVATIVE_STEP = 0.002  # Step of a difference in units of the prior scale of a parameter
THICKNESS_STEP_UM = 1e-4  # Step of a difference in thickness [µm]; a fringe of the silicon takes 0.13

ORDERS_MOVED, STEPS_PER_ORDER = 6, 24
"""Fringe orders, either way, and steps in which the thickness that suits an effect is looked for."""

LINE_STEP_NM = 0.1
"""Spacing of wavelength nodes [nm]: five per fringe of detection layer and support together."""


@dataclass(frozen=True)
class Tested:
    """An effect, the values at which it is differentiated, and the direction from null that was found.

    If it has been fitted, and not to its null, the values are those of the fit.
    """

    effect: Effect
    values: dict[str, float]
    direction: FloatArray
    scale: FloatArray
    fitted: bool = False

    @property
    def settings(self) -> dict[str, dict[str, float]]:
        """The effect at its values."""
        return {self.effect.name: self.values}

    @classmethod
    def of(cls, effect: Effect, values: Mapping[str, float], model: FringeModel) -> Tested:
        """The effect at fitted values, elsewhere at null, or a prior scale away from it if that is a bound."""
        nulls = effect.null_values(model.base_system)
        at, direction = {}, []
        for parameter in effect.parameters:
            null, (low, high) = nulls[parameter.name], parameter.bounds
            one_sided = null <= low or null >= high
            given = float(values.get(parameter.name, null))
            if parameter.name in values and not (one_sided and given == null):
                at[parameter.name] = given
                direction.append(given - null)
                continue
            # What starts from a bound may start with its square, without a derivative at the bound itself.
            sign = -1.0 if null >= high else 1.0
            at[parameter.name] = null + sign * parameter.prior_scale * one_sided
            direction.append(0.0 if values else sign * parameter.prior_scale)
        for name in values:
            effect.parameter(name)
        activate_effects({effect.name: at}, (effect,))
        scales = np.array([parameter.prior_scale for parameter in effect.parameters])
        as_fitted = bool(values) and all(at[name] == value for name, value in values.items())
        return cls(effect, at, np.array(direction), scales, as_fitted)

    def neighbours(self, parameter: Parameter) -> tuple[float, float]:
        """Values on both sides, within the bounds, between which a difference is taken."""
        step = DERIVATIVE_STEP * parameter.prior_scale
        repeats_after = self.effect.search.repeats_after.get(parameter.name, 0.0)
        if repeats_after:
            step = min(step, 0.1 * DERIVATIVE_STEP * repeats_after)
        low, high = parameter.bounds
        value = self.values[parameter.name]
        return max(value - step, low), min(value + step, high)


@dataclass(frozen=True, eq=False)
class Sample:
    """Pixels that stand for a sensor: every fringe phase of both layers, scattered over the sensor."""

    thickness_um: FloatArray  # (ny, nx): thickness of the varying layer
    # (ny,): thickness of the detection layer minus that of the stack; zero if that is the layer that
    # varies
    silicon_um: FloatArray

    @classmethod
    def of(cls, model: FringeModel, range_um: tuple[float, float] | None) -> Sample:
        """Sample of thicknesses within a range, by default about that of the stack."""
        system = model.base_system
        rows, columns = SAMPLES
        if range_um is None:
            middle = float(system.stack.thickness_um[system.stack.position(system.varying)])
            range_um = (middle - 1.5, middle + 1.5)
        low, high = range_um
        if not 0.0 < low < high < math.inf:
            raise OutOfRangeError("thickness range [um]", range_um, "two increasing, positive numbers")
        golden = 0.5 * (math.sqrt(5.0) - 1.0)
        place = ((np.arange(rows * columns) + 0.5) * golden) % 1.0
        silicon: FloatArray = np.zeros(rows)
        if system.varying != system.detection:
            medium = system.stack.layers[system.stack.position(system.detection)].medium
            order_um = 0.5e-3 * 950.0 / float(medium.index(950.0, system.temperature_k).real)
            silicon = np.asarray(order_um * (((np.arange(rows) + 0.5) * golden) % 1.0 - 0.5))
        thickness: FloatArray = np.asarray(low + (high - low) * place, dtype=float)
        return cls(thickness.reshape(rows, columns), silicon)

    def geometry(self, series: FlatSeries) -> ImageGeometry:
        """Positions of the samples, spread over the sensor."""
        y, x = (
            np.linspace(0.0, size - 1.0, count)
            for size, count in zip(SENSOR_PX, self.thickness_um.shape, strict=True)
        )
        waves = np.array(series.wavelength_nm)
        level, dark_time = np.full(waves.shape, series.level_e), np.array(series.dark_time_s)
        return ImageGeometry(SENSOR_PX, y, x, waves, level, dark_time_s=dark_time)


@dataclass(frozen=True, eq=False)
class Block:
    """One series of flats at the sample, shapes ``(W, P)`` and ``(K, W, P)``."""

    image: FloatArray  # signal relative to its mean
    weight: FloatArray  # inverse standard deviation of the noise of a pixel
    # thickness, silicon: derivatives with respect to the two thicknesses [1/µm]
    thickness: FloatArray
    silicon: FloatArray
    # tested, further: derivatives with respect to the parameters of the effects, in units of their prior
    # scales
    tested: FloatArray
    further: FloatArray
    # What the effect that was found does, and what it does that each of the others does not
    difference: FloatArray


@dataclass(frozen=True)
class Likeness:
    """Strength of the effect that was found, and what another one cannot imitate of it."""

    strength: float
    separation: float

    @property
    def likeness(self) -> float:
        """Cosine between the two signatures, 0 to 1; NaN where the first does nothing."""
        if not self.strength > 0.0:
            return math.nan
        return math.sqrt(max(1.0 - (self.separation / self.strength) ** 2, 0.0))


@dataclass(frozen=True, eq=False)
class Forecast:
    """Fisher information of sets of flats about the effects of a class, of which the ``present`` ones are there."""

    model: FringeModel
    catalogue: Sequence[Effect]
    tested: tuple[Tested, ...]
    further: tuple[Tested, ...]
    sample: Sample
    present: FlatSeries
    _blocks: dict[FlatSeries, Block] = field(default_factory=dict, init=False)
    _flats: dict[tuple[object, ...], FloatArray] = field(default_factory=dict, init=False)
    _shifts: dict[str, FloatArray] = field(default_factory=dict, init=False)

    def pairs(self, series: Sequence[FlatSeries]) -> list[Likeness]:
        """The first effect against each of the others."""
        sizes = [item.scale.size for item in self.tested]
        signature = self.signatures([self._block(each) for each in series])
        tested, difference = np.split(signature, [sum(sizes)], axis=1)
        strength = float(np.linalg.norm(difference[:, 0]))
        tangents = np.split(tested, np.cumsum(sizes)[:-1], axis=1)[1:]
        result = []
        for tangent, own in zip(tangents, difference[:, 1:].T, strict=True):
            basis = _orthonormal(tangent)
            result.append(Likeness(strength, float(np.linalg.norm(own - basis @ (basis.T @ own)))))
        return result

    def signatures(self, blocks: Sequence[Block]) -> FloatArray:
        """What the effects do to the flats of a sensor and nothing else does, in units of the noise.

        Returns (rows, K): one column for each parameter, and one for each difference; the products of columns
        are the Fisher information.
        """
        joined = [np.concatenate([getattr(block, name) for block in blocks], axis=-2) for name in _FIELDS]
        image, weight, thickness, silicon, tested, further, difference = joined
        asked = np.concatenate([tested, difference])
        flats, pixels = image.shape
        level = np.zeros((flats, flats, pixels))
        level[np.arange(flats), np.arange(flats)] = image
        columns = np.concatenate([asked, further, silicon[np.newaxis], level]) * weight
        local = np.stack([thickness, image]) * weight
        # The response of a pixel is known a little: a further datum of each pixel, whose expectation no effect moves.
        columns = np.concatenate([columns, np.zeros((len(columns), 1, pixels))], axis=1)
        known = np.zeros((2, 1, pixels))
        known[1] = 1.0 / RESPONSE_SCATTER
        local = np.concatenate([local, known], axis=1)
        basis, _ = np.linalg.qr(np.ascontiguousarray(local.transpose(2, 1, 0)))
        design = np.ascontiguousarray(columns.transpose(2, 1, 0))
        design -= basis @ (basis.transpose(0, 2, 1) @ design)
        design = design.reshape(-1, len(columns)) * math.sqrt(SENSOR_PX[0] * SENSOR_PX[1] / pixels)
        wanted, nuisance = np.split(design, [len(asked)], axis=1)
        # Derivatives are per prior scale, so that the priors are unit rows.
        prior = np.eye(nuisance.shape[1])[: len(further)]
        nuisance = _orthonormal(np.concatenate([nuisance, prior]))
        wanted = np.concatenate([wanted, np.zeros((len(prior), wanted.shape[1]))])
        signature: FloatArray = wanted - nuisance @ (nuisance.T @ wanted)
        return signature

    def _block(self, series: FlatSeries) -> Block:
        if series not in self._blocks:
            self._blocks[series] = self._differentiated(series)
        return self._blocks[series]

    def _differentiated(self, series: FlatSeries) -> Block:
        step, found = THICKNESS_STEP_UM, self.tested[0]
        base = found.settings if found.fitted else {}
        image = self._observe(series, base)
        thickness = self._observe(series, base, step) - self._observe(series, base, -step)
        silicon = np.zeros(image.shape)
        if self.model.base_system.varying != self.model.base_system.detection:
            silicon = self._observe(series, base, 0.0, step) - self._observe(series, base, 0.0, -step)
        tested, further = (
            np.array([
                self._slope(series, item, parameter, self._shift(item))
                for item in items for parameter in item.effect.parameters
            ]).reshape(-1, *image.shape)
            for items in (self.tested, self.further)
        )  # fmt: skip
        own = tested[: found.scale.size]
        strong = image - self._observe(series, {}) if found.fitted else self._along(found, own)
        difference = [strong] + [
            image - self._observe(series, other.settings, self._shift(other))
            if found.fitted and other.fitted
            else strong
            for other in self.tested[1:]
        ]
        weight = np.sqrt(series.level_e / np.maximum(image, 1e-6))
        return Block(
            image, weight, thickness / (2.0 * step), silicon / (2.0 * step), tested, further,
            np.stack(difference),
        )  # fmt: skip

    def _along(self, item: Tested, slopes: FloatArray) -> FloatArray:
        """An effect of which only the direction is known."""
        return np.asarray(np.tensordot(item.direction / item.scale, slopes, axes=1))

    def _shift(self, item: Tested) -> FloatArray:
        """Move of the thickness of every pixel [µm] with which an effect comes next to the one that was found."""
        found = self.tested[0]
        if item is found or not (found.fitted and item.fitted):
            return np.zeros(self.sample.thickness_um.shape)
        name = item.effect.name
        if name not in self._shifts:
            self._shifts[name] = self._nearest_shift(item)
        return self._shifts[name]

    def _nearest_shift(self, item: Tested) -> FloatArray:
        """Best move of all pixels together within some orders, then of each of them within half an order."""
        order = float(self.model.fringe_order_um(np.median(self.present.wavelength_nm)))
        steps = np.arange(-ORDERS_MOVED * STEPS_PER_ORDER, ORDERS_MOVED * STEPS_PER_ORDER + 1)
        steps = steps[self.sample.thickness_um.min() + steps * (order / STEPS_PER_ORDER) > 0.0]
        shifts = steps * (order / STEPS_PER_ORDER)
        wanted = self._observe(self.present, self.tested[0].settings)
        weight = 1.0 / np.maximum(wanted, 1e-6)
        cost = []
        for shift in shifts:
            other = self._observe(self.present, item.settings, float(shift))
            response = (weight * other * wanted).sum(axis=0) / (weight * other**2).sum(axis=0)
            cost.append((weight * (wanted - response * other) ** 2).sum(axis=0))
        misfit = np.array(cost)
        common = int(misfit.sum(axis=1).argmin())
        misfit[np.abs(steps - steps[common]) > STEPS_PER_ORDER // 4] = np.inf
        return np.asarray(shifts[misfit.argmin(axis=0)].reshape(self.sample.thickness_um.shape))

    def _slope(
        self, series: FlatSeries, item: Tested, parameter: Parameter, shift_um: FloatArray | float = 0.0
    ) -> FloatArray:
        """Derivative with respect to a parameter, in units of its prior scale."""
        low, high = item.neighbours(parameter)
        ends = [
            self._observe(series, {item.effect.name: {**item.values, parameter.name: value}}, shift_um)
            for value in (low, high)
        ]
        slope: FloatArray = (ends[1] - ends[0]) * (parameter.prior_scale / (high - low))
        return slope

    def _observe(
        self,
        series: FlatSeries,
        effects: Mapping[str, Mapping[str, float]],
        shift_um: FloatArray | float = 0.0,
        silicon_um: float = 0.0,
    ) -> FloatArray:
        """Flats of the sample over their means, shape ``(W, P)``."""
        model = self.model.with_effects({**self.model.effect_settings, **effects}, self.catalogue)
        model = series.conditions(model)
        optical = tuple(item for item in model.effects if item.effect.acts_on != "image")
        # Neither the level, nor the time it takes, nor an effect on the image changes what the optics do.
        settings = tuple((item.effect.name, *sorted(item.values.items())) for item in optical)
        moved = np.broadcast_to(shift_um, self.sample.thickness_um.shape)
        key = (replace(series, level_e=1.0, dark_time_s=()), settings, moved.tobytes(), silicon_um)
        if key not in self._flats:
            bare = replace(model, effects=optical)
            self._flats[key] = self._optical(bare, series, moved, silicon_um)
        geometry = self.sample.geometry(series)
        image = apply_to_image(model.effects, model.base_system, self._flats[key], geometry)
        return image.reshape(len(image), -1)

    def _optical(
        self, model: FringeModel, series: FlatSeries, shift_um: FloatArray, silicon_um: float
    ) -> FloatArray:
        """Response of the sample over its means, shape ``(W, ny, nx)``."""
        system, waves = model.base_system, np.array(series.wavelength_nm)
        nominal = system.stack.layers[system.stack.position(system.detection)].thickness_um
        rows = []
        places = zip(self.sample.thickness_um + shift_um, self.sample.silicon_um, strict=True)
        for thickness, offset in places:
            moved = system.with_layer(system.detection, thickness_um=nominal + offset + silicon_um)
            one = replace(model, base_system=moved)
            rows.append(one.respond(one.system.flat_fields(waves, LINE_STEP_NM), thickness, waves))
        image = np.stack(rows, axis=1)
        image /= image.mean(axis=(1, 2), keepdims=True)
        return image


_FIELDS = ("image", "weight", "thickness", "silicon", "tested", "further", "difference")


def _orthonormal(columns: FloatArray) -> FloatArray:
    """Orthonormal basis of what the columns span; directions that are only rounding are left out."""
    norm = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(norm > 0.0, norm, 1.0)
    basis, size, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(basis[:, size > 1e-9 * max(float(size.max()), 1e-300)])
