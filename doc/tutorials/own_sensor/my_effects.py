"""An effect of one's own: ice that has grown on the cold sensor."""

from collections.abc import Mapping
from dataclasses import replace

from lsst.fringe_sim.effects.base import Parameter, PlainNullEffect
from lsst.fringe_sim.optics import Layer, constant_medium
from lsst.fringe_sim.optics.system import OpticalSystem

ICE = constant_medium("ice", 1.30, source="Warren & Brandt 2008, doi 10.1029/2007JD009744: 1.302 at 950 nm")


class Ice(PlainNullEffect):
    """A film of ice in front of the coating."""

    name = "ice"
    title = "ice on the sensor"
    acts_on = "stack"
    reference = "worked example"
    parameters = (Parameter("thickness", "nm", 0.0, (0.0, 1000.0), 100.0, "thickness of the ice"),)

    def change_system(self, system: OpticalSystem, values: Mapping[str, float]) -> OpticalSystem:
        """Insert the ice."""
        film = Layer("ice", ICE, 1e-3 * values["thickness"])
        return replace(system, stack=system.stack.with_inserted(film, before="ar_outer"))


EFFECTS = [Ice()]
