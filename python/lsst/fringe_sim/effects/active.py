"""Settings of effects: checked, turned into active effects, and applied."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from ..errors import InputError, OutOfRangeError, UnknownNameError, to_number
from ..instrument.sky import SkySpectrum
from ..optics.system import OpticalSystem
from .base import Described, Effect, FloatArray, ResponseContext, numbered
from .geometry import ImageGeometry

AnyEffect = TypeVar("AnyEffect", bound=Described)


@dataclass(frozen=True)
class ActiveEffect:
    """An effect with values for its parameters; those not given are at null.

    Attributes
    ----------
    effect : `Effect`
        Which effect.
    values : `dict` [`str`, `float`]
        Values by parameter name, validated.
    """

    effect: Effect
    values: dict[str, float]

    def __post_init__(self) -> None:
        for name, value in self.values.items():
            _check_bounds(self.effect, name, value)

    def complete_values(self, system: OpticalSystem) -> dict[str, float]:
        """Values of all parameters, null where none is given."""
        return {**self.effect.null_values(system), **self.values}

    def coverage(self, system: OpticalSystem, geometry: ImageGeometry) -> FloatArray:
        """Part of every sample that has the effect (`Effect.coverage`); ``system`` is the one before any effect."""
        return self.effect.coverage(self.complete_values(system), geometry)

    def coverage_moments(self, system: OpticalSystem, geometry: ImageGeometry) -> FloatArray:
        """Moments of that part (`Effect.coverage_moments`)."""
        return self.effect.coverage_moments(self.complete_values(system), geometry)

    def is_null(self, system: OpticalSystem) -> bool:
        """Whether every value equals its null, but those that only say where the effect would be."""
        nulls, places = self.effect.null_values(system), self.effect.search.places
        return all(
            value == nulls[name] for name, value in self.complete_values(system).items() if name not in places
        )


def activate_effects(settings: Mapping[str, Any], effects: Sequence[Effect]) -> tuple[ActiveEffect, ...]:
    """Turn settings into active effects, in the order of the catalogue.

    Parameters
    ----------
    settings : mapping
        Either ``{"bandwidth.fwhm": 2.4}`` or ``{"bandwidth": {"fwhm": 2.4}}``, or both mixed.
    effects : sequence of `Effect`
        The catalogue.

    Raises
    ------
    UnknownNameError
        An effect or a parameter that is not in the catalogue.
    OutOfRangeError
        A value outside the bounds of its parameter.
    InputError
        A value that is not a number, or a setting without a parameter.
    """
    return tuple(ActiveEffect(effect, values) for effect, values in check_settings(settings, effects))


def settings_of(active: Iterable[ActiveEffect], *, on_sky: bool = False) -> dict[str, float]:
    """Values by ``name.parameter``; on the sky without the effects of the laboratory.

    A sensor takes its layers and its electronics to the telescope, but not the temperature of the cryostat nor the
    lamp and the reflections of the bench.
    """
    return {
        f"{item.effect.name}.{parameter}": value
        for item in active
        if not (on_sky and item.effect.laboratory_only)
        for parameter, value in item.values.items()
    }


def check_settings(
    settings: Mapping[str, Any], effects: Sequence[AnyEffect]
) -> tuple[tuple[AnyEffect, dict[str, float]], ...]:
    """Effects that settings name, with the values given for them, in the order of the catalogue.

    Parameters and errors are those of `activate_effects`.
    """
    by_name = {effect.name: effect for effect in effects}
    chosen: dict[str, dict[str, float]] = {}
    for effect, parameter, value in _flatten(settings):
        if effect not in by_name:
            by_name[effect] = another(effect, by_name)
        by_name[effect].parameter(parameter)
        number = to_number(f"{effect}.{parameter}", value)
        _check_bounds(by_name[effect], parameter, number)
        chosen.setdefault(effect, {})[parameter] = number
    return tuple((effect, chosen[name]) for name, effect in by_name.items() if name in chosen)


def another(name: str, by_name: Mapping[str, AnyEffect]) -> AnyEffect:
    """The second, third, ... of an effect, by its name."""
    first, _, number = name.rpartition("_")
    effect = by_name.get(first)
    if not (isinstance(effect, Effect) and effect.several and number.isdecimal() and int(number) > 1):
        raise UnknownNameError("effect", name, by_name)
    return cast(AnyEffect, numbered(effect, int(number)))


def _check_bounds(effect: Described, name: str, value: float) -> None:
    parameter = effect.parameter(name)
    low, high = parameter.bounds
    if not low <= value <= high:
        raise OutOfRangeError(
            f"{effect.name}.{name} [{parameter.unit or '1'}]", value, f"{low:g} to {high:g}"
        )


def flat_settings(settings: Mapping[str, Any], source: str | None = None) -> dict[str, Any]:
    """Values by ``name.parameter`` of settings that may be nested."""
    flat: dict[str, Any] = {}
    try:
        for effect, parameter, value in _flatten(settings):
            name = f"{effect}.{parameter}"
            if name in flat:
                raise InputError("effect setting", name, "once, nested or with a point")
            flat[name] = value
    except InputError as error:
        raise (error if source is None else error.in_source(source)) from None
    return flat


def _flatten(settings: Mapping[str, Any]) -> Iterable[tuple[str, str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            for parameter, number in value.items():
                yield str(key), str(parameter), number
            continue
        effect, dot, parameter = str(key).partition(".")
        if not dot or not effect or not parameter:
            raise InputError("effect setting", key, "name.parameter=value")
        yield effect, parameter, value


def apply_to_system(active: Iterable[ActiveEffect], system: OpticalSystem) -> OpticalSystem:
    """Optical system with all effects in it, but those that are local."""
    changed = system
    for item in active:
        if not item.effect.local and not item.is_null(system):
            changed = item.effect.change_system(changed, item.complete_values(system))
    return changed


def apply_to_response(
    active: Iterable[ActiveEffect], system: OpticalSystem, response: FloatArray, context: ResponseContext
) -> FloatArray:
    """Response ``[W, ...]`` with all effects in it; ``response`` itself is left alone.

    Parameters
    ----------
    active : iterable of `ActiveEffect`
        The effects.
    system : `OpticalSystem`
        The system before any effect, by which null values are judged.
    response : `numpy.ndarray`, shape ``(W, ...)``
        Response of the optics.
    context : `ResponseContext`
        Wavelengths and phase-averaged response.
    """
    for item in active:
        if not item.is_null(system):
            response = item.effect.change_response(response, item.complete_values(system), context)
    return response


def apply_to_image(
    active: Iterable[ActiveEffect], system: OpticalSystem, image: FloatArray, geometry: ImageGeometry
) -> FloatArray:
    """Image cube with all effects in it; ``image`` itself is left alone.

    Parameters
    ----------
    active : iterable of `ActiveEffect`
        The effects.
    system : `OpticalSystem`
        The system before any effect, by which null values are judged.
    image : `numpy.ndarray`, shape ``(W, ny, nx)``
        Signal of each plane in units of its mean level.
    geometry : `ImageGeometry`
        Where the samples lie.
    """
    present = [(item.effect, item.complete_values(system)) for item in active if not item.is_null(system)]
    dark = {effect.name: effect.dark_charge(values, geometry) for effect, values in present}
    of_dark = [name for name, charge in dark.items() if charge.any()]
    for effect, values in present:
        image = effect.change_image_of(system, image, values, geometry)
        if effect.name in of_dark[:1]:
            part = sum(dark[name] for name in of_dark) / geometry.require_levels(effect.name)
            image = (1.0 - part) * image + part
    return image


def apply_to_sky(active: Iterable[ActiveEffect], system: OpticalSystem, sky: SkySpectrum) -> SkySpectrum:
    """Night sky with all effects in it; parameters as of `apply_to_image`."""
    for item in active:
        if not item.is_null(system):
            sky = item.effect.change_sky(sky, item.complete_values(system))
    return sky
