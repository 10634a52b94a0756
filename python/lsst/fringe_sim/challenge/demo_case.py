"""What the demo hides in its flats, drawn by a seed, and whether its search has found it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType

import numpy as np

from ..algorithms.discovery import Verdict
from ..array_types import FloatArray
from ..effects import AMPLIFIERS, EFFECTS
from ..errors import InputError
from ..instrument.measured_thickness import e2v_321, fit_to_sensor
from ..mock.hidden_effects import HIDDEN_EFFECTS
from .run import is_right

CONTRAST = 0.13
"""Fringes of the flats over those of the model, as at the one measured pixel of such a sensor (Guo et al. 2022)."""

CELLS = 4096
"""Cells to which the search averages the flats at most; the few fringes of the demo need a quarter of them."""

PART_PX, CORNER_PX = (1024, 1024), (1536, 192)
"""Rows and columns of the part of E2V-CCD250-321, and its first: five fringes, of 175 px where they are narrowest."""

Draw = Callable[[np.random.Generator, tuple[int, int]], dict[str, float]]


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * _between(rng, low, high))


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform between two numbers."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _of_amplifiers(name: str, rng: np.random.Generator, rms: float) -> dict[str, float]:
    """One value for every amplifier; their mean, which relative flats do not show, is 0."""
    values = rng.standard_normal(len(AMPLIFIERS))
    values *= rms / values.std()
    return {
        f"{name}.{each}": float(value) for each, value in zip(AMPLIFIERS, values - values.mean(), strict=True)
    }


def _rings(rng: np.random.Generator, shape: tuple[int, int]) -> dict[str, float]:
    """Rings about a point outside the part, several cells of the search apart."""
    size, phase, away = (
        _between(rng, 3e-4, 1.2e-3),
        rng.uniform(0.0, 2.0 * math.pi),
        rng.uniform(0.0, 2.0 * math.pi),
    )
    side = float(min(shape))
    return {
        "tree_rings.cosine": size * math.cos(phase),
        "tree_rings.sine": size * math.sin(phase),
        "tree_rings.centre_x": 0.5 * shape[1] + 1.5 * side * math.cos(away),
        "tree_rings.centre_y": 0.5 * shape[0] + 1.5 * side * math.sin(away),
        "tree_rings.period": side * _between(rng, 0.15, 0.35),
    }


SECOND_EFFECTS: Mapping[str, Draw] = MappingProxyType(
    {
        "illumination": lambda r, _: {
            f"illumination.gradient_{axis}": _signed(r, 1e-3, 4e-3) for axis in ("x", "y")
        },
        "chromatic_illumination": lambda r, _: {
            f"chromatic_illumination.gradient_{axis}": _signed(r, 1e-3, 4e-3) for axis in ("x", "y")
        },
        "amplifier_gain": lambda r, _: _of_amplifiers("amplifier_gain", r, _between(r, 4e-4, 1.6e-3)),
        "amplifier_offset": lambda r, _: _of_amplifiers("amplifier_offset", r, _between(r, 8.0, 32.0)),
        "tree_rings": _rings,
    }
)
"""Effects of which one is hidden beside the weak fringes, and how its size is drawn."""


@dataclass(frozen=True)
class DemoCase:
    """What is hidden in the flats of the demo. Nothing that analyses them may see it."""

    seed: int  # Decides the effect, its size and all noise
    shape: tuple[int, int]
    values: dict[str, float]  # Sizes by ``effect.parameter``

    @property
    def names(self) -> tuple[str, ...]:
        """Effects that are hidden."""
        return tuple(dict.fromkeys(key.partition(".")[0] for key in self.values))

    @property
    def on_sky(self) -> dict[str, float]:
        """Those that the whole sensor takes along to the telescope, which the mock can put into its visits."""
        laboratory = {effect.name for effect in EFFECTS if effect.laboratory_only}
        layers = {
            effect.name
            for effect in HIDDEN_EFFECTS
            if effect.on_optics is not None and effect.on_island is None and effect.name not in laboratory
        }
        return {key: value for key, value in self.values.items() if key.partition(".")[0] in layers}

    @property
    def frames_rng(self) -> np.random.Generator:
        """Source of the noise of the flats."""
        return np.random.default_rng([self.seed, 1])

    @property
    def visits_rng(self) -> np.random.Generator:
        """Source of the sources and the noise of the visits."""
        return np.random.default_rng([self.seed, 2])

    def to_json(self) -> str:
        """Text for the sealed folder."""
        return json.dumps(asdict(self), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> DemoCase:
        """Read back what `to_json` wrote."""
        try:
            content = json.loads(text)
            return cls(content["seed"], tuple(content["shape"]), dict(content["values"]))
        except (ValueError, TypeError, KeyError):
            raise InputError("sealed case of the demo", text[:60], "what the demo has written") from None


def draw_demo_case(seed: int, shape: tuple[int, int]) -> DemoCase:
    """Draw what is hidden: the weak contrast of real sensors, and one effect of `SECOND_EFFECTS`."""
    rng = np.random.default_rng([seed, 0])
    name = str(rng.choice(list(SECOND_EFFECTS)))
    second = SECOND_EFFECTS[name](rng, shape)
    return DemoCase(seed, shape, {"contrast_loss.factor": CONTRAST, **second})


def thickness_of_demo(shape: tuple[int, int]) -> FloatArray:
    """Adhesive of a part of E2V-CCD250-321, sampled at so many rows and columns [µm]."""
    return fit_to_sensor(e2v_321(PART_PX, sampling="window", corner=CORNER_PX), shape)


def found_words(case: DemoCase, verdict: Verdict) -> str:
    """How truth and verdict compare: ``right``, ``right class``, ``wrong`` or ``no name``."""
    if verdict.verdict != "named":
        return "no name"
    if not is_right(case.names, verdict):
        return "wrong"
    exact = {effect.name for effect in verdict.effects} == set(case.names)
    return (
        "right" if exact and not any(effect.ambiguous_with for effect in verdict.effects) else "right class"
    )


def of_the_layers(settings: Mapping[str, float]) -> dict[str, float]:
    """Effects of sensor and light without those of the image, as gains: flat fields take these out of visits.

    The fit of the thickness does not use them.
    """
    of_image = {effect.name for effect in EFFECTS if effect.acts_on == "image"}
    return {key: value for key, value in settings.items() if key.partition(".")[0] not in of_image}
