"""What a physical effect is: a few parameters with null values, and one change to the model.

An effect is one final subclass of `Effect`, in the file of the place where it acts, and one line in `EFFECTS`. At its
null values it is exactly the identity: the object that it was given is returned unchanged. What a search for missing
effects must know besides is stated in one place, `Effect.search`.
"""

from __future__ import annotations

import copy
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ..array_types import FloatArray
from ..deprecation import deprecated
from ..errors import UnknownNameError, named_units
from ..instrument.sky import SkySpectrum
from ..optics.system import OpticalSystem
from .geometry import ImageGeometry

__all__ = [
    "Described",
    "Effect",
    "Parameter",
    "PlainNullEffect",
    "Residuals",
    "ResponseContext",
    "SearchHints",
    "numbered",
]

FloatArray = FloatArray
Values = Mapping[str, float]  # Values of parameters by their names


@named_units
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
    wavelength_nm : `float`
        Nominal wavelength of the exposures that it concerns [nm]; NaN if it concerns all.
    """

    name: str
    unit: str
    null: float
    bounds: tuple[float, float]
    prior_scale: float
    description: str
    wavelength_nm: float = math.nan


@deprecated("1.1", "", removed_in="1.2", argument="reach")
@deprecated("1.1", "", removed_in="1.2", argument="exact")
@deprecated("1.1", "", removed_in="1.2", argument="hides_fringes")
@deprecated("1.1", "", removed_in="1.2", argument="repeats_on_sky")
@dataclass(frozen=True)
class SearchHints:
    """What a search for missing effects must know of an effect besides its physics.

    An effect states what departs from the defaults. Mappings go by the names of its parameters, those without an
    entry have the default. What depends on the data is answered by `Effect.propose`, `Effect.bounds_on` and
    `Effect.check_search`.

    Attributes
    ----------
    moves_wavelengths : `bool`
        Whether all that the effect does is to move the wavelengths of exposures.
    exchangeable : `bool`
        Whether its parameters are draws about null from one distribution, the width of which nobody knows.
    sought : `bool`
        Whether it has to be looked for by `Effect.propose`, because at null nothing leads to it.
    places : `tuple` [`str`, ...]
        Parameters that say where the effect is, not how strong: by themselves they change nothing.
    repeats_after : mapping [`str`, `float`]
        Distance after which the fringes look nearly the same again: neighbouring minima of a fit; 0 if they do not.
    steps : mapping [`str`, `float`]
        Change of a parameter to which the effect is in proportion, if that is less than a thousandth of the prior
        scale; 0 if it is not.
    refinements : mapping [`str`, `int`]
        0 for what the effect surely has. Parameters of 1, 2, ... may be absent, each with all of a higher number: the
        effect is judged as if it had those up to a number, any of which is as likely.
    natural_bounds : `tuple` [`float`, ...]
        Those of the bounds of its parameters that nature has: no more than all light is in a line. What is found at
        any other may be beyond what the model is meant for.
    """

    moves_wavelengths: bool = False
    exchangeable: bool = False
    sought: bool = False
    places: tuple[str, ...] = ()
    repeats_after: Mapping[str, float] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)
    refinements: Mapping[str, int] = field(default_factory=dict)
    natural_bounds: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a model leaves of the data.

    Attributes
    ----------
    value : `numpy.ndarray`, shape ``(W, ny, nx)``
        Data minus model, relative to the mean level.
    weight : `numpy.ndarray`, shape ``(W, ny, nx)``
        Inverse variance of the noise; 0 where there are no data.
    geometry : `ImageGeometry`
        Where the samples lie.
    thickness_score, thickness_information : `numpy.ndarray`, shape ``(ny, nx)``, optional
        Derivative of the log likelihood of the fitted thickness with respect to that of every sample [1/µm], and what
        each tells of its own [1/µm²], beside a thickness that is smooth: a fine one takes up what looks like it.
    """

    value: FloatArray
    weight: FloatArray
    geometry: ImageGeometry
    thickness_score: FloatArray | None = None
    thickness_information: FloatArray | None = None


@named_units
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


class Described:
    """What has a name and parameters: an effect of the model, or one that a mock hides."""

    name: str
    title: str
    parameters: tuple[Parameter, ...]

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
        known = [parameter.name for parameter in self.parameters]
        raise UnknownNameError(f"parameter of effect {self.name}", name, known)


class Effect(Described, ABC):
    """A physical effect with named parameters.

    Subclasses are final. They override `change_system`, `change_response`, `change_image` (or `change_image_of`) or
    `change_sky`, or several of them; each is only called when some parameter differs from its null value.
    """

    acts_on: ClassVar[str]
    """``stack``, ``illumination``, ``response``, ``image`` or ``spectrum`` (of the night sky)."""
    local: ClassVar[bool] = False
    """Whether it changes the stack in a part of the sensor only, that of `coverage`."""
    several: ClassVar[bool] = False
    """Whether a sensor may have several of it: the second is called by its name and ``_2``, see `numbered`."""
    laboratory_only: ClassVar[bool] = False
    """Whether it belongs to lamp, bench or cryostat, which a sensor does not take along to the telescope."""
    sky_only: ClassVar[bool] = False
    """Whether it belongs to the sensor at the telescope, or to its sky: neither flats nor maps made from them know of
    it. So is all that acts on the spectrum."""
    learned: ClassVar[bool] = False
    """Whether it is no physics but what a search learned: no search looks for it, and no forecast counts on it."""
    reference: ClassVar[str]
    search: ClassVar[SearchHints] = SearchHints()
    """What a search must know of it."""

    def __repr__(self) -> str:
        """As it is made."""
        return f"{type(self).__name__}()"

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.sky_only = cls.sky_only or getattr(cls, "acts_on", "") == "spectrum"

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Return the optical system with the effect in it."""
        return system

    def coverage(self, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Part of every sample that has the effect, if it is local; shape ``(ny, nx)``."""
        return np.ones(geometry.sample_shape)

    def coverage_moments(self, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Moments of that part about the middle of the sample, along rows y and columns x [samples, samples²].

        Shape ``(5, ny, nx)``: means over the sample of y, x, y², yx and x² where it is covered, and of 0 elsewhere.
        """
        even = np.array([0.0, 0.0, 1.0, 0.0, 1.0]) / 12.0
        return even[:, np.newaxis, np.newaxis] * self.coverage(values, geometry)

    def change_response(self, response: FloatArray, values: Values, context: ResponseContext) -> FloatArray:
        """Return the response ``[W, ...]`` with the effect in it; must not write into ``response``."""
        return response

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Return the image cube ``[W, y, x]`` with the effect in it; must not write into ``image``.

        The image is in units of its mean level, and stays so: patterns have a mean of one over the sensor, and what
        is added in electrons is a part of the level.
        """
        return image

    def change_image_of(
        self, system: OpticalSystem, image: FloatArray, values: Values, geometry: ImageGeometry
    ) -> FloatArray:
        """Like `change_image`, for an effect that depends on the sensor; ``system`` is the one before any effect."""
        return self.change_image(image, values, geometry)

    def blur_px(self, values: Values) -> float:
        """Rms radius along one axis by which all signal is spread alike [px]."""
        return 0.0

    def charge_spread_px2(self, values: Values, level_e: float) -> float:
        """Variance along one axis by which what arrives last is spread, behind a mean level [electrons]."""
        return 0.0

    def dark_charge(self, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Electrons of every sample that are not light, a part of the mean level; shape ``(W, 1, 1)``.

        What all effects add is one part of the level, and light the rest.
        """
        return np.zeros((1, 1, 1))

    def change_sky(self, sky: SkySpectrum, values: Values) -> SkySpectrum:
        """Return the night sky with the effect in it."""
        return sky

    def propose(self, residuals: Residuals) -> tuple[dict[str, float], ...]:
        """Values of all parameters from which to fit the effect, the best first; none where it is not seen.

        An effect that is sought (`SearchHints.sought`) overrides it. For the others a search knows starts itself: the
        null with its derivative, sizes about it, and what lies a repetition away.
        """
        return ()

    def bounds_on(self, parameter: Parameter, geometry: ImageGeometry) -> tuple[float, float]:
        """Bounds of a parameter in a search on some samples; narrower where it could imitate something simpler."""
        return parameter.bounds

    def seen_parameters(self, geometry: ImageGeometry) -> tuple[Parameter, ...]:
        """Parameters that concern some exposure of these samples."""
        nodes = np.array([parameter.wavelength_nm for parameter in self.parameters])
        if np.isnan(nodes).any():
            return tuple(self.parameters)
        return tuple(
            parameter
            for parameter, alone in zip(self.parameters, np.eye(len(nodes)), strict=True)
            if np.interp(geometry.wavelength_nm, nodes, alone).any()
        )

    def check_search(self, geometry: ImageGeometry) -> None:
        """Refuse to be looked for on some samples.

        Raises
        ------
        InputError
            They do not state what the effect depends on, or it is nothing but a simpler one there.
        """

    def noise_correlation(self, values: Values, geometry: ImageGeometry) -> float:
        """Correlation that the effect gives the noise of neighbouring samples; 0 where it leaves noise alone."""
        return 0.0

    @abstractmethod
    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """Value of every parameter at which this effect leaves ``system`` as it is."""


@functools.cache
def numbered(effect: Effect, number: int) -> Effect:
    """The second, third, ... of an effect of which a sensor may have several, with a name of its own."""
    own = copy.copy(effect)
    own.name, own.title = f"{effect.name}_{number}", f"{effect.title}, number {number}"
    return own


class PlainNullEffect(Effect):
    """An effect whose null values are the constants declared with its parameters."""

    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """The declared null values."""
        return {parameter.name: parameter.null for parameter in self.parameters}
