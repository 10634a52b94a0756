"""An effect that does what was learned, for a person to finish: name, source and physics are missing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ...array_types import FloatArray
from ...effects import LEARNED, ImageGeometry
from ...effects.learned import LEARNED_HARMONICS, LEARNED_NODES_NM
from ...model.effects_override import effects_override, ended

if TYPE_CHECKING:
    from .verdict import Verdict

PHASES = 16  # Places in the fringe phase at which a wave form is written down

_ON_RESPONSE = ("response", "change_system(self, system, values)", "change_system(system, learned)")
_ON_IMAGE = ("image", "change_image(self, image, values, geometry)", "change_image(image, learned, geometry)")
"""What a correction acts on, its method, and how that is called."""

_TEMPLATE = '''"""An effect for what a search of data of set-up {setup} left without a name.

It is not physics yet: it does what was learned, times a size. To finish it, write the cause into the method that
changes the model, with parameters that have units and a source, and give it a name.

    fringe-sim discover RAWS --effects-from learned_effect.py     # is it in other data, too?
{table}
"""

from lsst.fringe_sim.effects.base import Parameter, PlainNullEffect
from lsst.fringe_sim.effects.learned import {parent}

LEARNED = {values}


class Unnamed(PlainNullEffect):
    """What was learned, times a size."""

    name = "unnamed"
    title = "what was learned from residuals (to be finished)"
    acts_on = "{acts_on}"
    reference = "to be found"
    parameters = (Parameter("size", "", 0.0, (-10.0, 10.0), 1.0, "1 for what was learned"),)

    def {method}:
        """Write the physics here."""
        shape = {parent}()
        learned = {{p.name: values["size"] * LEARNED.get(p.name, 0.0) for p in shape.parameters}}
        return shape.{call}


EFFECTS = [Unnamed()]
'''


def wave_form(own: Mapping[str, float]) -> tuple[list[int], FloatArray]:
    """Wavelengths [nm] of a wave form, and the form ``(wavelengths, PHASES)`` in parts of the mean response."""
    values = {key.partition(".")[2]: value for key, value in own.items()}
    nodes = [node for node in LEARNED_NODES_NM if f"cos1_{node}" in values]
    phase = 2.0 * np.pi * np.arange(PHASES) / PHASES
    shape = np.zeros((len(nodes), PHASES))
    for harmonic in LEARNED_HARMONICS:
        for wave, function in (("cos", np.cos), ("sin", np.sin)):
            each = np.array([values[f"{wave}{harmonic}_{node}"] for node in nodes])
            shape += each[:, np.newaxis] * function(harmonic * phase)
    return nodes, shape


def patterns_of(name: str, own: Mapping[str, float], side: int) -> tuple[list[int], FloatArray]:
    """Wavelengths of a pattern [nm], one where it is the same at all, and what it makes of even light, minus 1.

    ``name``: the correction, not `LearnedResponse`. Returns ``(wavelengths, side, side)``.
    """
    nodes = [LEARNED_NODES_NM[len(LEARNED_NODES_NM) // 2]]
    if name == "learned_light":
        nodes = sorted({int(key.split("_")[2]) for key in own})
    (effect,) = (one for one in LEARNED if one.name == name)
    values = {parameter.name: 0.0 for parameter in effect.parameters}
    values |= {key.partition(".")[2]: value for key, value in own.items()}
    geometry = ImageGeometry.of_pixels((side, side), np.array(nodes, dtype=float))
    return nodes, effect.change_image(np.ones((len(nodes), side, side)), values, geometry) - 1.0


def learned_files(verdict: Verdict, detector: str | None = None) -> dict[str, str]:
    """Texts by file name: an override with a correction, and the beginning of an effect; none without.

    ``detector``: name of the sensor, for the override.
    """
    if not verdict.has_learned:
        return {}
    beside, own = verdict.learned["beside"], {key: x for key, x in verdict.learned["own"].items() if x}
    told = f"{verdict.verdict}; learned from what no effect explains, not physics"
    override = effects_override(
        {**beside, **own}, verdict.setup, told, known=verdict.known, detector=detector
    )
    return {"learned.py": override, "learned_effect.py": effect_skeleton(verdict)}


def effect_skeleton(verdict: Verdict) -> str:
    """Python file with an effect that does what was learned; `verdict` has a correction."""
    told = verdict.learned
    (parent,) = (type(one).__name__ for one in LEARNED if one.name == told["name"])
    acts_on, method, call = _ON_RESPONSE if told["name"] == "learned_response" else _ON_IMAGE
    values = {key.partition(".")[2]: value for key, value in told["own"].items() if value}
    listed = "{\n" + "".join(f"    {key!r}: {value!r},\n" for key, value in values.items()) + "}"
    table = _wave_table(told["own"]) if told["name"] == "learned_response" else ""
    text = _TEMPLATE.format(
        setup=ascii(verdict.setup)[1:-1], table=table, parent=parent, values=listed, acts_on=acts_on,
        method=method, call=call,
    )  # fmt: skip
    return ended(text)


def _wave_table(own: Mapping[str, float]) -> str:
    """The wave form in numbers, in parts of a thousand of the mean response."""
    nodes, shape = wave_form(own)
    lines = [
        "",
        "Wave form in 1e-3 of the mean response; phase in fringes, then a column for each wavelength [nm]:",
        "",
    ]
    lines.append("    phase  " + " ".join(f"{node:8d}" for node in nodes))
    for place, row in enumerate(shape.T):
        lines.append(f"    {place / PHASES:5.3f}  " + " ".join(f"{1e3 * value:8.3f}" for value in row))
    return "\n".join(lines)
