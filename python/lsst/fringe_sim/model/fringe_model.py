"""The one model that every stage uses: response of a pixel as a function of layer thickness."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import FloatArray
from ..effects import (
    ActiveEffect,
    Effect,
    ImageGeometry,
    ResponseContext,
    activate_effects,
    apply_to_image,
    apply_to_response,
    apply_to_system,
    known_effects,
)
from ..effects.active import settings_of
from ..errors import InputError, named_units, to_number, without_unit
from ..instrument.setup import Setup
from ..notebook import InNotebook
from ..optics.harmonics import ROUNDING
from ..optics.illumination import DEFAULT_STEP_NM, Illumination
from ..optics.media import TEMPERATURE_RANGE_K, check_range
from ..optics.phase_response import PhaseResponse
from ..optics.system import OpticalSystem
from .response_table import DEFAULT_TOLERANCE, ResponseTable, response_table, tabulate
from .spectrum import StackSpectrum, spectrum_of

LABORATORY_TEMPERATURE = "LABTEMP"
"""Keyword of the temperature of the sensor during the flats from which a thickness map was made [K]."""

BEYOND_THE_RANGE = 10.0
"""Factor by which a thickness may leave the range of its set-up; any wrong unit is wrong by a thousand or more."""

PHASE_MEAN_SAMPLES = 256
"""Thicknesses over which the phase average is taken; the fringe harmonics are below 1e-12 beyond the 20th."""


@dataclass(frozen=True, repr=False)
class FringeModel(InNotebook):
    """Response of a sensor, with effects.

    Attributes
    ----------
    setup : `Setup`
        Where the numbers come from.
    base_system : `OpticalSystem`
        Stack and light before any effect.
    effects : `tuple` [`ActiveEffect`, ...]
        Effects with their values, in the order of the catalogue.
    system : `OpticalSystem`
        Stack and light with the effects in them.
    """

    setup: Setup
    base_system: OpticalSystem
    effects: tuple[ActiveEffect, ...] = ()
    system: OpticalSystem = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "system", apply_to_system(self.effects, self.base_system))

    @classmethod
    @named_units
    def from_setup(
        cls,
        setup: str | Setup,
        effects: Mapping[str, Any] | None = None,
        *,
        field_x_deg: float = 0.0,
        field_y_deg: float = 0.0,
        observable: str = "detection",
        catalogue: Sequence[Effect] | None = None,
    ) -> FringeModel:
        """Model of a set-up.

        Parameters
        ----------
        setup : `str` or `Setup`
            Set-up, by name or as an object.
        effects : mapping, optional
            ``{"bandwidth.fwhm": 2.4}`` or ``{"bandwidth": {"fwhm": 2.4}}``.
        field_x_deg, field_y_deg : `float`, optional
            Field position [deg]; decides the beam behind a telescope.
        observable : {"detection", "total"}, optional
            Absorption in the detection layer, or 1 - R - T of the stack as the paper's fit used.
        catalogue : sequence of `Effect`, optional
            The effects that may be named; `known_effects` by default.

        Raises
        ------
        UnknownNameError
            An unknown set-up, effect or parameter.
        OutOfRangeError
            A value outside the bounds of its parameter.
        """
        chosen = Setup.from_name(setup) if isinstance(setup, str) else setup
        system = chosen.optical_system(
            field_x_deg=field_x_deg, field_y_deg=field_y_deg, observable=observable
        )
        return cls(chosen, system, activate_effects(effects or {}, known_effects(catalogue)))

    def with_effects(
        self, effects: Mapping[str, Any], catalogue: Sequence[Effect] | None = None
    ) -> FringeModel:
        """Same set-up and light with other effects in place of the present ones."""
        return replace(self, effects=activate_effects(effects, known_effects(catalogue)))

    def at_laboratory_temperature(self, header: Mapping[str, Any]) -> FringeModel:
        """The model for a thickness map with this header, which may state at which temperature it was measured.

        Raises
        ------
        InputError
            The temperature is not one.
        """
        if self.setup.kind != "sky" or LABORATORY_TEMPERATURE not in header:
            return self
        kelvin = to_number(LABORATORY_TEMPERATURE, header[LABORATORY_TEMPERATURE], "a temperature in K")
        check_range(f"{LABORATORY_TEMPERATURE} [K]", np.array([kelvin]), *TEMPERATURE_RANGE_K)
        setup = replace(self.setup, laboratory_temperature_k=kelvin)
        return replace(
            self, setup=setup, base_system=replace(self.base_system, laboratory_temperature_k=kelvin)
        )

    def __repr__(self) -> str:
        """Name of the set-up, and the effects."""
        effects = f", effects={self.effect_settings}" if self.effects else ""
        return f"FringeModel({self.setup.name!r}{effects})"

    def facts(self) -> dict[str, Any]:
        """Those of the set-up, and the effects."""
        effects = ", ".join(f"{name} = {value:g}" for name, value in self.effect_settings.items())
        return {**self.setup.facts(), "effects": effects or "none"}

    @named_units
    def spectrum(self, wavelength_nm: ArrayLike, thickness_um: float | None = None) -> StackSpectrum:
        """Where light of each wavelength ends: reflected, absorbed layer by layer, transmitted.

        For plane layers and strictly monochromatic light, averaged over the angles of the beam; the width of a line
        and effects that act on the response are not in it.

        Parameters
        ----------
        wavelength_nm : array_like, shape ``(W,)``
            Wavelengths in vacuum [nm].
        thickness_um : `float`, optional
            Thickness of the varying layer [µm]; by default the middle of the range of the set-up.

        Raises
        ------
        OutOfRangeError
            As for `response`.
        InputError
            An effect makes the stack more than plane layers, or acts on the response.
        """
        late = [item.effect.name for item in self.effects if item.effect.acts_on == "response"]
        if late:
            raise InputError("effects", late, "effects of the stack or of the illumination")
        middle = sum(self.setup.thickness_range_um) / 2.0
        thickness = self.checked_thickness_um(middle if thickness_um is None else thickness_um)
        if thickness.ndim:
            raise InputError("thickness_um", thickness_um, "one number")
        return spectrum_of(self.system, self._wavelength(wavelength_nm), float(thickness))

    @property
    def effect_settings(self) -> dict[str, float]:
        """Values of all effects by ``name.parameter``; what a header or an override file holds."""
        return settings_of(self.effects)

    @property
    def islands(self) -> tuple[tuple[ActiveEffect, FringeModel], ...]:
        """Effects that are local, each with the model of where it is; this model is that of all other places."""
        present = [item for item in self.effects if item.effect.local and not item.is_null(self.base_system)]
        everywhere = tuple(item for item in self.effects if not item.effect.local)
        return tuple(
            (
                item,
                replace(
                    self,
                    base_system=item.effect.change_system(
                        self.base_system, item.complete_values(self.base_system)
                    ),
                    effects=everywhere,
                ),
            )
            for item in present
        )

    def with_islands(
        self, evaluate: Callable[[FringeModel], NDArray[Any]], geometry: ImageGeometry
    ) -> NDArray[Any]:
        """Images of a sensor with its local effects where they are.

        Parameters
        ----------
        evaluate : callable
            ``(model) -> image``, shape ``(..., ny, nx)``: what it would be if all of the sensor were like ``model``.
        geometry : `ImageGeometry`
            Where the samples lie.
        """
        image = evaluate(self)
        for item, inside in self.islands:
            part = item.coverage(self.base_system, geometry).astype(image.dtype)
            if part.any():
                image = image + part * (evaluate(inside) - image)
        return image

    @named_units
    def response(self, thickness_um: ArrayLike, wavelength_nm: ArrayLike) -> FloatArray:
        """Response to monochromator flats, outside local effects.

        Parameters
        ----------
        thickness_um : array_like
            Thickness of the varying layer [µm], any shape; a quantity of astropy is converted, here as elsewhere.
        wavelength_nm : array_like, shape ``(W,)``
            Nominal wavelengths [nm].

        Returns
        -------
        response : `numpy.ndarray`, shape ``(W, *thickness.shape)``
            Detected electrons per incident photon.

        Raises
        ------
        OutOfRangeError
            A wavelength outside the range of a medium, or a thickness that cannot be one of the set-up's: it is not
            finite, or beyond its range by a factor of ten, as one in another unit is.
        InputError
            A quantity that is no length.
        """
        wavelength = self._wavelength(wavelength_nm)
        thickness = self.checked_thickness_um(thickness_um)
        return self.respond(self.system.flat_fields(wavelength), thickness, wavelength)

    @named_units
    def flat_image(self, thickness_um: ArrayLike, geometry: ImageGeometry) -> FloatArray:
        """Images of monochromator flats, each over its mean, with the effects of light, sensor and read-out.

        Parameters
        ----------
        thickness_um : array_like, shape ``(ny, nx)``
            Thickness of the varying layer at the samples of ``geometry`` [µm].
        geometry : `ImageGeometry`
            Positions of the samples, wavelengths and levels.

        Returns
        -------
        image : `numpy.ndarray`, shape ``(W, ny, nx)``

        Raises
        ------
        InputError
            The map does not fit the geometry, or an effect in electrons meets a level that is not known.
        """
        thickness = self.checked_thickness_um(thickness_um)
        if thickness.shape != geometry.sample_shape:
            raise InputError("shape of the thickness map", thickness.shape, f"{geometry.sample_shape}")
        image = self.with_islands(lambda model: model.response(thickness, geometry.wavelength_nm), geometry)
        image /= image.mean(axis=(1, 2), keepdims=True)
        return apply_to_image(self.effects, self.base_system, image, geometry)

    @named_units
    def respond(
        self, illumination: Illumination, thickness_um: ArrayLike, wavelength_nm: ArrayLike | None = None
    ) -> FloatArray:
        """Response to any illumination, effects included; shape ``(W, *thickness.shape)``."""
        reduced = self.system.reduce(illumination)
        response = reduced.averaged(illumination.weight, thickness_um)
        return self.finish(reduced, illumination, response, wavelength_nm)

    @named_units
    def respond_on_grid(
        self,
        illumination: Illumination,
        start_um: float,
        step_um: float,
        count: int,
        wavelength_nm: ArrayLike | None = None,
        *,
        tolerance: float = ROUNDING,
    ) -> FloatArray:
        """Like `respond` on ``start + step * arange(count)``, several times faster; shape ``(W, count)``.

        ``tolerance`` is that of `PhaseResponse.averaged_on_grid`.
        """
        reduced = self.system.reduce(illumination)
        response = reduced.averaged_on_grid(
            illumination.weight, start_um, step_um, count, tolerance=tolerance
        )
        return self.finish(reduced, illumination, response, wavelength_nm)

    @named_units
    def response_on_grid(
        self, wavelength_nm: ArrayLike, start_um: float, step_um: float, count: int
    ) -> FloatArray:
        """Like `response` on a uniform grid of thickness; shape ``(W, count)``."""
        wavelength = self._wavelength(wavelength_nm)
        illumination = self.system.flat_fields(wavelength)
        return self.respond_on_grid(illumination, start_um, step_um, count, wavelength)

    @named_units
    def table(
        self,
        thickness_range_um: tuple[float, float],
        wavelength_nm: ArrayLike,
        *,
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> ResponseTable:
        """Response to monochromator flats as a table.

        Parameters
        ----------
        thickness_range_um : `tuple` [`float`, `float`]
            Thicknesses that the table must cover [µm].
        wavelength_nm : array_like, shape ``(W,)``
            Nominal wavelengths [nm].
        tolerance : `float`, optional
            Largest interpolation error.
        """
        wavelength = self._wavelength(wavelength_nm)
        low, high = self.checked_thickness_um(thickness_range_um).tolist()
        illumination = self.system.flat_fields(wavelength)
        return self.table_of(illumination, (low, high), wavelength_nm=wavelength, tolerance=tolerance)

    @named_units
    def table_of(
        self,
        illumination: Illumination,
        thickness_range_um: tuple[float, float],
        *,
        wavelength_nm: ArrayLike | None = None,
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> ResponseTable:
        """Response to any illumination as a table; parameters as for `table`."""
        if not any(item.effect.acts_on == "response" for item in self.effects):
            return response_table(
                self.system,
                illumination,
                thickness_range_um,
                wavelength_nm=wavelength_nm,
                tolerance=tolerance,
            )
        reduced = self.system.reduce(illumination)

        def sample(start_um: float, step_um: float, count: int) -> FloatArray:
            response = reduced.averaged_on_grid(illumination.weight, start_um, step_um, count)
            return self.finish(reduced, illumination, response, wavelength_nm)

        labels = illumination.mean_wavelength_nm if wavelength_nm is None else wavelength_nm
        return tabulate(sample, thickness_range_um, labels, tolerance=tolerance)

    @named_units
    def fringe_order_um(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Thickness of one fringe order at normal incidence, λ / 2n of the varying layer [µm].

        Eq. 3 of the paper with cos θ in the denominator and θ = 0.
        """
        wavelength = np.asarray(without_unit("wavelength", wavelength_nm, "nm"), dtype=float)
        medium = self.system.stack.layers[self.system.stack.position(self.system.varying)].medium
        return 0.5e-3 * wavelength / medium.index(wavelength, self.system.temperature_k).real

    @named_units
    def quadrature_error(self, wavelength_nm: ArrayLike, thickness_um: ArrayLike) -> float:
        """Largest change of the response when the wavelength nodes are twice as dense."""
        wavelength, thickness = self._wavelength(wavelength_nm), self.checked_thickness_um(thickness_um)
        coarse = self.system.flat_fields(wavelength)
        fine = self.system.flat_fields(wavelength, DEFAULT_STEP_NM / 2.0)
        difference = self.respond(coarse, thickness) - self.respond(fine, thickness)
        return float(np.abs(difference).max())

    @named_units
    def finish(
        self,
        reduced: PhaseResponse,
        illumination: Illumination,
        response: FloatArray,
        wavelength_nm: ArrayLike | None,
    ) -> FloatArray:
        """Apply the effects that act after the optics."""
        if not any(item.effect.acts_on == "response" for item in self.effects):
            return response
        nominal = (
            illumination.mean_wavelength_nm
            if wavelength_nm is None
            else np.asarray(wavelength_nm, dtype=float)
        )
        context = ResponseContext(nominal, self._phase_mean(reduced, illumination))
        return apply_to_response(self.effects, self.base_system, response, context)

    def _wavelength(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Nominal wavelengths ``(W,)`` at which every layer is known."""
        wavelength = np.atleast_1d(np.asarray(without_unit("wavelength", wavelength_nm, "nm"), dtype=float))
        if not wavelength.size:
            raise InputError("wavelength [nm]", "none", "one or more")
        known = [layer.medium.wavelength_range_nm for layer in self.system.stack.layers]
        check_range(
            "wavelength [nm]", wavelength, max(low for low, _ in known), min(high for _, high in known)
        )
        return wavelength

    @named_units
    def checked_thickness_um(self, thickness_um: ArrayLike) -> FloatArray:
        """Thicknesses [µm], refused if the varying layer cannot have them; those in nm or mm are a thousandfold.

        Raises
        ------
        OutOfRangeError
            One is far outside the range of the set-up.
        """
        thickness = np.asarray(thickness_um, dtype=float)
        low, high = self.setup.thickness_range_um
        check_range(
            f"thickness of {self.setup.varying} [um]",
            thickness,
            low / BEYOND_THE_RANGE,
            high * BEYOND_THE_RANGE,
        )
        return thickness

    def _phase_mean(self, reduced: PhaseResponse, illumination: Illumination) -> FloatArray:
        low, high = self.setup.thickness_range_um
        step = (high - low) / PHASE_MEAN_SAMPLES
        grid = reduced.averaged_on_grid(illumination.weight, low + 0.5 * step, step, PHASE_MEAN_SAMPLES)
        return grid.mean(axis=1)
