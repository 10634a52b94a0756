"""Effects on the layers of the sensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

from ..optics import Layer, Medium, get_medium
from ..optics.diffuse import DiffuseReturn
from ..optics.system import OpticalSystem, Structure
from .base import Effect, FloatArray, Parameter, PlainNullEffect, ResponseContext, SearchHints, Values

_LAGE = "Lage 2019, doi 10.48550/arXiv.1911.09577"


def _layer(system: OpticalSystem, name: str) -> Layer:
    return system.stack.layers[system.stack.position(name)]


class EpoxyIndex(PlainNullEffect):
    """Another index level and a Cauchy dispersion of the adhesive."""

    name = "epoxy_index"
    title = "adhesive index and dispersion"
    acts_on = "stack"
    reference = (
        "spread of published epoxies: refractiveindex.info (NOA-61, SU-8, EpoCore); the vendor states none"
    )
    parameters = (
        Parameter("offset", "", 0.0, (-0.3, 0.3), 0.03, "index minus that of the set-up at 960 nm"),
        Parameter(
            "cauchy", "um2", 0.0, (-0.05, 0.05), 0.005, "coefficient of 1/wavelength² relative to 960 nm"
        ),
    )
    search = SearchHints(refinements={"cauchy": 1})

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Change the medium of the adhesive."""
        medium = _layer(system, "adhesive").medium
        changed = medium.modified(
            index_offset=medium.index_offset + values["offset"],
            dispersion_um2=medium.dispersion_um2 + values["cauchy"],
        )
        return system.with_layer("adhesive", medium=changed)


class EpoxyAbsorption(PlainNullEffect):
    """The adhesive absorbs: contrast falls with thickness."""

    name = "epoxy_absorption"
    title = "adhesive absorption"
    acts_on = "stack"
    reference = "Guo, Walter, Lage & Lupton 2022 take k = 0; filled epoxies absorb in the near infrared"
    parameters = (Parameter("k", "", 0.0, (0.0, 0.05), 0.002, "extinction coefficient"),)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Add to the extinction coefficient of the adhesive."""
        medium = _layer(system, "adhesive").medium
        changed = medium.modified(extinction_offset=medium.extinction_offset + values["k"])
        return system.with_layer("adhesive", medium=changed)


class LayerThickness(PlainNullEffect):
    """A layer is thicker or thinner than the stack states."""

    acts_on = "stack"
    layer: ClassVar[str]
    """Name of the layer; an empty one stands for the detection layer."""

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Change the thickness of the layer."""
        name = self.layer or system.detection
        return system.with_layer(name, thickness_um=_layer(system, name).thickness_um + values["offset"])


def _offset(bounds: tuple[float, float], prior_scale: float) -> tuple[Parameter, ...]:
    return (Parameter("offset", "um", 0.0, bounds, prior_scale, "thickness minus that of the stack"),)


class SiliconThickness(LayerThickness):
    """The detection layer is thicker or thinner than the stack states."""

    name = "silicon_thickness"
    title = "silicon thickness"
    layer = ""
    reference = "Guo, Walter, Lage & Lupton 2022, Table 1 (100 um, constant)"
    parameters = _offset((-20.0, 20.0), 1.0)
    search = SearchHints(repeats_after={"offset": 0.13})


class GateOxide(LayerThickness):
    """The oxide under the gates is thicker or thinner than the stack states."""

    name = "gate_oxide"
    title = "oxide under the gates"
    layer = "gate_oxide"
    reference = f"{_LAGE} (layers of 0.1-1.0 um, measured on single sensors)"
    parameters = _offset((-0.09, 0.3), 0.02)


class GateThickness(LayerThickness):
    """The gates are thicker or thinner than the stack states."""

    name = "gate_thickness"
    title = "polysilicon gates"
    layer = "gates"
    reference = f"{_LAGE} (0.3-0.34 um)"
    parameters = _offset((-0.2, 0.3), 0.02)


class Insulation(LayerThickness):
    """The insulation between gates and adhesive is thicker or thinner than the stack states."""

    name = "insulation"
    title = "insulation behind the gates"
    layer = "insulation"
    reference = f"{_LAGE} (layers of 0.1-1.0 um, measured on single sensors)"
    parameters = _offset((-0.3, 0.5), 0.05)


def _with_silicon(system: OpticalSystem, change: Callable[[Medium], Medium]) -> OpticalSystem:
    """System in which all layers of silicon have another medium."""
    for layer in system.stack.layers:
        if layer.medium.is_silicon:
            system = system.with_layer(layer.name, medium=change(layer.medium))
    return system


class SiliconAbsorption(PlainNullEffect):
    """All silicon absorbs more or less than the tabulated one, at all wavelengths by one factor."""

    name = "silicon_absorption"
    title = "silicon extinction"
    acts_on = "stack"
    reference = (
        "Schinke et al. 2015, doi 10.1063/1.4923419: 11 % at 600 nm, 1.4 % at 1000 nm, 12 % at 1200 nm"
    )
    parameters = (Parameter("scale", "", 1.0, (0.5, 2.0), 0.1, "factor on the extinction coefficient"),)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Scale the extinction coefficient of every layer of silicon."""
        return _with_silicon(
            system, lambda medium: medium.modified(extinction_scale=medium.extinction_scale * values["scale"])
        )


class SiliconConstants(PlainNullEffect):
    """Index and extinction of all silicon lie on the way from the table of the set-up to another one.

    Tables of crystalline silicon at room temperature disagree by up to a quarter in extinction and by 0.004 in index,
    in a way that is smooth in wavelength. A parameter is 0 at the table of the set-up and 1 at the other.
    """

    name = "silicon_constants"
    title = "table of the constants of silicon"
    acts_on = "stack"
    reference = (
        "Green 2008, doi 10.1016/j.solmat.2008.06.009; Schinke et al. 2015, doi 10.1063/1.4923419; "
        "Franta et al. 2017, doi 10.1016/j.apsusc.2017.02.021"
    )
    parameters = (
        Parameter("franta", "", 0.0, (-1.0, 2.0), 0.5, "part of the way to the table of Franta et al."),
        Parameter("schinke", "", 0.0, (-1.0, 2.0), 0.5, "part of the way to the table of Schinke et al."),
    )
    search = SearchHints(refinements={"schinke": 1})

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Move the constants of every layer of silicon."""
        way = (("Si_franta2017", values["franta"]), ("Si_schinke2015", values["schinke"]))
        return _with_silicon(system, lambda medium: medium.modified(toward=(*medium.toward, *way)))


class Temperature(Effect):
    """The silicon is warmer or colder than the set-up states."""

    name = "temperature"
    title = "sensor temperature"
    acts_on = "stack"
    laboratory_only = True
    reference = "Green 2008, doi 10.1016/j.solmat.2008.06.009"
    parameters = (Parameter("kelvin", "K", math.nan, (120.0, 320.0), 5.0, "temperature of the silicon"),)

    def null_values(self, system: OpticalSystem) -> dict[str, float]:
        """Temperature that the set-up states."""
        return {"kelvin": system.temperature_k}

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Replace the temperature."""
        return replace(system, temperature_k=values["kelvin"])


class ArCoating(PlainNullEffect):
    """Both coating layers are thicker or thinner by a common factor."""

    name = "ar_coating"
    title = "anti-reflection coating"
    acts_on = "stack"
    reference = "Rasmussen, LSST Document-8590: thicknesses fitted to a quantum efficiency curve"
    parameters = (Parameter("scale", "", 1.0, (0.5, 1.5), 0.05, "factor on both thicknesses"),)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Scale the coating."""
        for name in ("ar_outer", "ar_inner"):
            thickness_um = _layer(system, name).thickness_um * values["scale"]
            system = system.with_layer(name, thickness_um=thickness_um)
        return system


class InterfaceRoughness(PlainNullEffect):
    """The back surface is rough: the reflected wave loses coherence."""

    name = "roughness"
    title = "interface roughness"
    acts_on = "stack"
    reference = "Beckmann & Spizzichino 1963; Davies 1954, doi 10.1049/pi-3.1954.0067"
    parameters = (Parameter("sigma", "nm", 0.0, (0.0, 300.0), 50.0, "rms height of the support surface"),)

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Add the roughness in quadrature to the upper face of the support."""
        sigma = (_layer(system, "support").roughness_nm ** 2 + values["sigma"] ** 2) ** 0.5
        return system.with_layer("support", roughness_nm=sigma)


def _with_spread(system: OpticalSystem, name: str, spread_um: float) -> OpticalSystem:
    """System with a variation of thickness inside a pixel added in quadrature to that of a layer."""
    total = (_layer(system, name).thickness_spread_um ** 2 + spread_um**2) ** 0.5
    return system.with_layer(name, thickness_spread_um=total)


class ThicknessSpread(PlainNullEffect):
    """A pixel sees the mean over a Gaussian distribution of thicknesses: every harmonic loses by its own square."""

    name = "thickness_spread"
    title = "thickness variation inside a pixel"
    acts_on = "stack"
    reference = "Davies 1954, doi 10.1049/pi-3.1954.0067: average over the phase of a rough layer"
    parameters = (
        Parameter("sigma", "nm", 0.0, (0.0, 300.0), 30.0, "rms variation of the layer that varies"),
    )

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Add the variation to that of the varying layer."""
        return _with_spread(system, system.varying, 1e-3 * values["sigma"])


class InsertedLayer(PlainNullEffect):
    """A layer that the stack has not; where the stack has it, that one becomes thicker."""

    acts_on = "stack"
    layer: ClassVar[str]
    medium: ClassVar[str]
    before: ClassVar[str]
    """Name and medium of the layer, and the layer of the stack before which it lies."""

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Insert the layer."""
        thickness_um = values["thickness"] * (1e-3 if self.parameter("thickness").unit == "nm" else 1.0)
        if self.layer in system.stack.names:
            return system.with_layer(
                self.layer, thickness_um=_layer(system, self.layer).thickness_um + thickness_um
            )
        inserted = Layer(self.layer, get_medium(self.medium), thickness_um)
        return replace(system, stack=system.stack.with_inserted(inserted, before=self.before))


class AirGap(InsertedLayer):
    """The adhesive has come off the support: a thin gap, empty in the cryostat, lies between them."""

    name = "air_gap"
    title = "gap between adhesive and support"
    layer, medium, before = "air_gap", "vacuum", "support"
    reference = (
        "Born & Wolf, Principles of Optics, section 1.6 (layered media): an adhesive that has come off"
    )
    parameters = (Parameter("thickness", "nm", 0.0, (0.0, 2000.0), 30.0, "thickness of the gap"),)
    search = SearchHints(repeats_after={"thickness": 470.0})


class BlackCoating(InsertedLayer):
    """A layer of black resist lies between the gates and the adhesive, as on ITL sensors."""

    name = "black_coating"
    title = "black coating behind the gates"
    layer, medium, before = "black_coating", "litho_black", "adhesive"
    reference = "Guo, Walter, Lage & Lupton 2022, section 2.3 (Litho-Black on ITL sensors)"
    parameters = (Parameter("thickness", "um", 0.0, (0.0, 3.0), 0.3, "thickness added to that of the stack"),)


class SupportIndex(PlainNullEffect):
    """The support reflects more or less than the tabulated material."""

    name = "support_index"
    title = "index of the support"
    acts_on = "stack"
    reference = "Guo, Walter, Lage & Lupton 2022, Table 1 assumes silicon; ceramics have an index of 1.7-2.2"
    parameters = (Parameter("offset", "", 0.0, (-2.4, 1.0), 0.3, "index minus that of the set-up"),)
    # The support is an etalon of its own: its fringes return after half a wavelength in its optical thickness.
    search = SearchHints(repeats_after={"offset": 0.00285})

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Shift the index of the support."""
        medium = _layer(system, "support").medium
        changed = medium.modified(index_offset=medium.index_offset + values["offset"])
        return system.with_layer("support", medium=changed)


class SupportCoherence(PlainNullEffect):
    """The support varies in thickness inside a pixel; a fraction of a wavelength makes it incoherent."""

    name = "support_coherence"
    title = "partially incoherent support"
    acts_on = "stack"
    reference = "Harbecke 1986, doi 10.1007/BF00616616 (coherent and incoherent multilayers)"
    parameters = (
        Parameter("spread", "um", 0.0, (0.0, 2.0), 0.05, "rms thickness variation of the support in a pixel"),
    )

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Add the variation to that of the support."""
        return _with_spread(system, "support", values["spread"])


class DiffuseGateSide(PlainNullEffect):
    """A part of the gate side returns light into the silicon evenly in all directions, and lets none pass.

    The plane wave loses that part on the way down and on the way up, so that fringes fade. The returned light crosses
    the silicon, leaves through the front within the escape cone or is reflected there, and comes to the gate side
    again. What is not absorbed on the way and not returned again is lost below the gates.
    """

    name = "diffuse_gate_side"
    title = "diffuse return of light at the gate side"
    acts_on = "stack"
    reference = "Yablonovitch 1982, doi 10.1364/JOSA.72.000899 (light scattered and trapped in silicon)"
    parameters = (
        Parameter("reflectance", "", 0.0, (0.0, 0.95), 0.2, "part of the gate side that returns light"),
    )
    search = SearchHints(natural_bounds=(0.0,))

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Put a layer without thickness below the detection layer, in which light is scattered."""
        place = system.stack.position(system.detection)
        medium, below = system.stack.layers[place].medium, system.stack.names[place + 1]
        stack, names = system.stack, ("gate_side_upper", "gate_side_lower")
        for name in names:
            stack = stack.with_inserted(Layer(name, medium, 0.0), before=below)
        return replace(system, stack=stack, diffuse=DiffuseReturn(*names, values["reflectance"]))


class GateStructure(PlainNullEffect):
    """In a part of every pixel gates of neighbouring phases overlap: there is one more layer of polysilicon.

    Its fringes are out of step with those of the rest, by an angle that depends on the wavelength.
    """

    name = "gate_structure"
    title = "overlapping gates"
    acts_on = "stack"
    reference = f"{_LAGE} (gates of 0.3-0.34 um, measured on single sensors)"
    parameters = (Parameter("part", "", 0.0, (0.0, 1.0), 0.2, "part of a pixel in which gates overlap"),)
    search = SearchHints(natural_bounds=(0.0, 1.0))

    def change_system(self, system: OpticalSystem, values: Values) -> OpticalSystem:
        """Add the overlap, as thick as the gates."""
        added_um = _layer(system, "gates").thickness_um
        return replace(system, structure=Structure("gates", added_um, values["part"]))


class ContrastLoss(PlainNullEffect):
    """A structured back side returns only a part of the light coherently."""

    name = "contrast_loss"
    title = "constant contrast loss (structured back side)"
    acts_on = "response"
    reference = "needed at the measured pixel of Guo, Walter, Lage & Lupton 2022, Fig. 4 (factor about 0.13)"
    parameters = (
        Parameter("factor", "", 1.0, (0.0, 1.5), 0.3, "factor on the departure from the phase mean"),
    )
    search = SearchHints(natural_bounds=(0.0,))

    def change_response(self, response: FloatArray, values: Values, context: ResponseContext) -> FloatArray:
        """Pull the response towards its phase average."""
        mean = context.phase_mean.reshape((-1,) + (1,) * (response.ndim - 1))
        return mean + values["factor"] * (response - mean)
