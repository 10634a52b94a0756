"""What a physical effect is: a few parameters with null values, and one change to the model.

An effect is one small file with one final subclass of `Effect` and one line in `EFFECTS`. At its null values it is
exactly the identity: the object that it was given is returned unchanged.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, OutOfRangeError, UnknownNameError, to_number
from ..instrument.sky import SkySpectrum
from ..optics.system import OpticalSystem
from .image_geometry import ImageGeometry

__all__ = [
    "ActiveEffect",
    "Effect",
    "Parameter",
    "ResponseContext",
    "activate_effects",
    "apply_to_image",
    "apply_to_response",
    "apply_to_sky",
    "apply_to_system",
]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """One number that says how strong an effect is.

    Attributes
    ----------
    name, unit, description : `str`
        ``unit`` is empty for pure numbers.
    null : `float`
        Value at which the effect is absent. NaN means "as the set-up says".
    bounds : `tuple` [`float`, `float`]
        Smallest and largest value in which the model is meaningful.
    prior_scale : `float`
        Typical departure from null in a real laboratory, in the same unit.
    repeats_after : `float`
        Distance after which the fringes look nearly the same again: neighbouring minima of a fit; 0 if they do not.
    wavelength_nm : `float`
        Nominal wavelength of the exposures that it concerns [nm]; NaN if it concerns all.
    place : `bool`
        Whether it says where the effect is, not how strong: by itself it changes nothing. Unless the effect is
        seen from the null value of its place, it needs `Effect.look`.
    step : `float`
        Change of the parameter to which the effect is in proportion, if that is less than a thousandth of
        `prior_scale`; 0 if it is not.
    refinement : `int`
        0 for what the effect surely has. Parameters of 1, 2, ... may be absent, each with all of a higher number: the
        effect is judged as if it had those up to a number, any of which is as likely.
    natural_bounds : `tuple` [`float`, ...]
        Those of the bounds that nature has: no more than all light is in a line. What is found at any other may be
        beyond what the model is meant for.
    """

    name: str
    unit: str
    null: float
    bounds: tuple[float, float]
    prior_scale: float
    description: str
    repeats_after: float = 0.0
    wavelength_nm: float = math.nan
    place: bool = False
    step: float = 0.0
    refinement: int = 0
    natural_bounds: tuple[float, ...] = ()


@dataclass(frozen=True)
class ResponseContext:
    """What an effect on the response may know besides the response itself.

    Attributes
    ----------
    wavelength_nm : `numpy.ndarray`, shape ``(W,)``
        Nominal wavelengths [nm].
    phase_mean : `numpy.ndarray`, shape ``(W,)``
        Response averaged over the fringe phase.
    """

    wavelength_nm: FloatArray
    phase_mean: FloatArray


class Effect(ABC):
    """A physical effect with named parameters.

    Subclasses are final. They override `change_system`, `change_response`, `change_image` (or `change_image_of`) or
    `change_sky`, or several of them; each is only called when some parameter differs from its null value.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    acts_on: ClassVar[str]
    """``stack``, ``illumination``, ``response``, ``image`` or ``spectrum`` (of the night sky)."""
    local: ClassVar[bool] = False
    """Whether it changes the stack in a part of the sensor only, that of `coverage`."""
    laboratory_only: ClassVar[bool] = False
    """Whether it belongs to lamp, bench or cryostat, which a sensor does not take along to the telescope."""
    couples_pixels: ClassVar[bool] = False
    """Whether the signal of a pixel depends on other pixels, so that scattered samples of an image cannot show it."""
    blurs: ClassVar[bool] = False
    """Whether those other pixels are all near: no farther than the thickness changes evenly."""
    moves_wavelengths: ClassVar[bool] = False
    """Whether all that it does is to move the wavelengths of exposures."""
    exact: ClassVar[bool] = False
    """Whether its form is no guess: electrons or factors that all pixels of an amplifier share."""
    exchangeable: ClassVar[bool] = False
    """Whether its parameters are draws about null from one distribution, the width of which nobody knows."""
    parameters: ClassVar[tuple[Parameter, ...]]
    reference: ClassVar[str]

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Return the optical system with the effect in it."""
        return system

    def coverage(self, values: Mapping[str, float], geometry: ImageGeometry) -> FloatArray:
        """Part of every sample that has the effect, if it is local; shape ``(ny, nx)``."""
        return np.ones(geometry.sample_shape)

    def coverage_moments(self, values: Mapping[str, float], geometry: ImageGeometry) -> FloatArray:
        """Moments of that part about the middle of the sample, along rows y and columns x [samples, samples²].

        Shape ``(5, ny, nx)``: means over the sample of y, x, y², yx and x² where it is covered, and of 0 elsewhere.
        """
        even = np.array([0.0, 0.0, 1.0, 0.0, 1.0]) / 12.0
        return even[:, np.newaxis, np.newaxis] * self.coverage(values, geometry)

    def change_response(
        self, response: FloatArray, values: Mapping[str, float], context: ResponseContext
    ) -> FloatArray:
        """Return the response ``[W, ...]`` with the effect in it; must not write into ``response``."""
        return response

    def change_image(
        self, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Return the image cube ``[W, y, x]`` with the effect in it; must not write into ``image``.

        The image is in units of its mean level, and stays so: patterns have a mean of one over the sensor, and what
        is added in electrons is a part of the level.
        """
        return image

    def change_image_of(
        self, system: OpticalSystem, image: FloatArray, values: Mapping[str, float], geometry: ImageGeometry
    ) -> FloatArray:
        """Like `change_image`, for an effect that depends on the sensor; ``system`` is the one before any effect."""
        return self.change_image(image, values, geometry)

    def blur_px(self, values: Mapping[str, float]) -> float:
        """Rms radius along one axis by which all signal is spread alike [px]."""
        return 0.0

    def dark_charge(self, values: Mapping[str, float], geometry: ImageGeometry) -> FloatArray:
        """Electrons of every sample that are not light, a part of the mean level; shape ``(W, 1, 1)``.

        What all effects add is one part of the level, and light the rest.
        """
        return np.zeros((1, 1, 1))

    def change_sky(self, sky: SkySpectrum, values: Mapping[str, float]) -> SkySpectrum:
        """Return the night sky with the effect in it."""
        return sky

    def look(self, residual: FloatArray, weight: FloatArray, geometry: ImageGeometry) -> dict[str, float]:
        """Values from which to fit an effect whose place is not known; empty where none is seen.

        Parameters
        ----------
        residual : `numpy.ndarray`, shape ``(W, ny, nx)``
            Data minus model, relative to the mean level.
        weight : `numpy.ndarray`, shape ``(W, ny, nx)``
            Inverse variance of the noise; 0 where there are no data.
        geometry : `ImageGeometry`
            Where the samples lie.
        """
        return {}

    def bounds_on(self, parameter: Parameter, geometry: ImageGeometry) -> tuple[float, float]:
        """Bounds of a parameter in a search on some samples; narrower where it could imitate something simpler."""
        return parameter.bounds

    def check_search(self, geometry: ImageGeometry) -> None:  # noqa: B027
        """Refuse to be looked for on some samples.

        Raises
        ------
        InputError
            They do not state what the effect depends on, or it is nothing but a simpler one there.
        """

    def noise_correlation(self, values: Mapping[str, float], geometry: ImageGeometry) -> float:
        """Correlation that the effect gives the noise of neighbouring samples; 0 where it leaves noise alone."""
        return 0.0

    @abstractmethod
    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """Value of every parameter at which this effect leaves ``system`` as it is."""

    def parameter(self, name: str) -> Parameter:
        """Parameter called ``name``.

        Raises
        ------
        UnknownNameError
            The effect has no such parameter.
        """
        for candidate in self.parameters:
            if candidate.name == name:
                return candidate
        raise UnknownNameError(
            f"parameter of effect {self.name}", name, [parameter.name for parameter in self.parameters]
        )


class PlainNullEffect(Effect):
    """An effect whose null values are the constants declared with its parameters."""

    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """The declared null values."""
        return {parameter.name: parameter.null for parameter in self.parameters}


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
            parameter = self.effect.parameter(name)
            low, high = parameter.bounds
            if not low <= value <= high:
                raise OutOfRangeError(
                    f"{self.effect.name}.{name} [{parameter.unit or '1'}]", value, f"{low:g} to {high:g}"
                )

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
        nulls, places = self.effect.null_values(system), {p.name for p in self.effect.parameters if p.place}
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
    by_name = {effect.name: effect for effect in effects}
    chosen: dict[str, dict[str, float]] = {}
    for effect_name, parameter_name, value in _flatten(settings):
        if effect_name not in by_name:
            raise UnknownNameError("effect", effect_name, by_name)
        by_name[effect_name].parameter(parameter_name)
        chosen.setdefault(effect_name, {})[parameter_name] = to_number(
            f"{effect_name}.{parameter_name}", value
        )
    return tuple(ActiveEffect(effect, chosen[effect.name]) for effect in effects if effect.name in chosen)


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
