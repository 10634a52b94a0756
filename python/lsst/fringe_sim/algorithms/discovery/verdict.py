"""What a search for missing effects found: one frozen object, and the files it becomes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from astropy.table import Table

from ...errors import named_units
from ...files import table_text, write_together
from ...model.effects_override import effects_override
from ...notebook import InNotebook, axes_or_new
from .skeleton import learned_files
from .verdict_words import accuracy_text, learned_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_CANDIDATES = 15  # Effects that a picture shows at most

_SIZES = ("of_counts", "of_fringes", "of_fringes_at_most")

CONFIDENCE = 0.95
"""Of the upper limit of a disagreement: a convention of how limits are stated, which decides nothing."""


def probability_text(probability: float) -> str:
    """A probability to three digits, rounded down: what missed a threshold does not read as if it had reached it.

    Parameters
    ----------
    probability : `float`
        Between 0 and 1.

    Returns
    -------
    text : `str`
    """
    return f"{math.floor(1000.0 * probability) / 1000.0:.3f}"


@dataclass(frozen=True)
class ParameterValue:
    """Fitted value of one parameter with its standard deviation and unit."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class NamedEffect:
    """One effect that was found.

    Attributes
    ----------
    name : `str`
        The likeliest member of its class.
    parameters : `dict`
        Values by parameter.
    probability : `float`
        Probability that the cause is in the class: this effect or one of ``ambiguous_with``.
    ambiguous_with : `tuple` [`str`, ...]
        Effects that explain these data about as well.
    break_ambiguity : `str`
        Which data would decide.
    share : `float`
        Probability of this member within the class.
    significance : `float`
        Signal to noise of the effect beside the others: root of what it takes off χ².
    """

    name: str
    parameters: dict[str, ParameterValue]
    probability: float
    ambiguous_with: tuple[str, ...] = ()
    break_ambiguity: str = ""
    share: float = 1.0
    significance: float = math.nan

    def values_text(self) -> str:
        """Values with their standard deviations and units, for people."""
        values = (
            f"{name} = {p.value:.6g} ± {p.sigma:.2g} {p.unit}".rstrip() for name, p in self.parameters.items()
        )
        return ", ".join(values)


@named_units
@dataclass(frozen=True)
class Where:
    """Where model and data disagree before anything is added.

    Attributes
    ----------
    wavelength : `tuple` of `dict`
        ``wavelength_nm``, ``chi2``, ``degrees`` of the phase-folded residual of each plane.
    amplifier : `tuple` of `dict`
        ``amplifier``, ``offset`` (relative), ``sigma``.
    scale_px : `float`
        Spatial scale with the largest excess [px]; 0 if none stands out.
    thickness_phase : `tuple` of `dict`
        ``phase`` (fraction of an order), ``residual``, ``sigma``, folded over all wavelengths.
    channels : `tuple` of `dict`
        Tests with statistic, degrees of freedom and probability.
    """

    wavelength: tuple[dict[str, float], ...] = ()
    amplifier: tuple[dict[str, Any], ...] = ()
    scale_px: float = 0.0
    thickness_phase: tuple[dict[str, float], ...] = ()
    channels: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class Gap:
    """Distance of model and data before and after; the noise floor is what a perfect model leaves."""

    metric: str
    before: float
    after: float
    heldout_before: float
    heldout_after: float
    noise_floor: float


@dataclass(frozen=True)
class Step:
    """One round of the search."""

    added: tuple[str, ...]
    log_evidence: float
    delta_chi2: float
    gap_before: float
    gap_after: float
    consistent: bool


@dataclass(frozen=True, repr=False)
class Verdict(InNotebook):
    """Outcome of a search.

    Attributes
    ----------
    verdict : {"named", "no_discrepancy", "unexplained"}
        What was found. There is no discrepancy either where `within_accuracy`.
    effects : `tuple` [`NamedEffect`, ...]
        Effects, strongest first; empty unless named.
    where : `Where`
        Where they disagree.
    gap : `Gap`
        How far apart they are, before and after.
    steps : `tuple` [`Step`, ...]
        Rounds of the search.
    unexplained : `dict`
        Description of what is left over, or why there is no answer.
    global_probability : `float`
        Chance that noise alone disagrees as much with the unchanged model.
    candidates : `tuple` of `dict`
        Every effect that was tried, with score, gain in χ² and evidence.
    next_measurements : `tuple` of `dict`
        Measurements that would help, best first.
    complete : `bool`
        Whether the search came to its end; otherwise it was stopped, and this is the best answer so far.
    size : `dict`
        How large the disagreement with the unchanged model is: ``of_counts``, rms relative to the mean counts without
        what noise adds, ``of_fringes``, the same relative to the rms of the fringes, and ``of_fringes_at_most``, its
        upper limit at 95 % confidence, which is never below that of data with a mean noise.
    learned : `dict`
        A correction learned from what no effect explains, and what cells say of it that took no part; empty without.
        Its settings are ``own``, those of the effects beside it ``beside``.
    accuracy : `dict`
        What the model may be wrong by: ``assumed``, a part of the fringes, its ``source``, and the ``chance`` that
        noise and such errors together disagree as much with the unchanged model, and ``within``, whether that is why
        there is no discrepancy; empty where that was not asked.
    known : `dict`
        Settings of the effects that were in the model before the search; the override holds them, too.
    """

    verdict: str
    effects: tuple[NamedEffect, ...]
    where: Where
    gap: Gap
    steps: tuple[Step, ...]
    unexplained: dict[str, Any]
    setup: str
    global_probability: float
    candidates: tuple[dict[str, Any], ...] = ()
    next_measurements: tuple[dict[str, Any], ...] = ()
    notes: tuple[str, ...] = ()
    data: dict[str, Any] = field(default_factory=dict)
    complete: bool = True
    size: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_SIZES, math.nan))
    learned: dict[str, Any] = field(default_factory=dict)
    accuracy: dict[str, Any] = field(default_factory=dict)
    known: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        """What was found, and with which set-up."""
        found = f", {self.settings}" if self.effects else ""
        return f"Verdict({self.verdict!r}{found}, setup={self.setup!r})"

    def facts(self) -> dict[str, str]:
        """What was found, with values and probabilities, and how large the disagreement is."""
        shown = {
            "verdict": self.verdict if self.complete else f"{self.verdict}, of a search that was stopped"
        }
        shown["set-up"] = self.setup
        for effect in self.effects:
            shown[effect.name] = f"{effect.values_text()}; probability {probability_text(effect.probability)}"
        if math.isfinite(self.size["of_counts"]):
            what, _, size = self.size_text().partition(": ")
            shown[what] = size
        return shown

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the fall of χ² that each effect promises, those that were found in another colour.

        Parameters
        ----------
        axes : `matplotlib.axes.Axes`, optional
            Where to draw; new ones of pyplot if not given.
        """
        from ...style import LINES

        drawn = axes_or_new(axes)
        found = {effect.name for effect in self.effects}
        alike = {other for effect in self.effects for other in effect.ambiguous_with} - found
        shown = [item for item in self.candidates if item["score"] > 0.0][:MOST_CANDIDATES]
        kinds = (
            ("named", LINES[1], "", found),
            ("in the same class", LINES[5], "//", alike),
            ("not chosen", LINES[4], "", {item["name"] for item in shown} - found - alike),
        )
        for label, color, hatch, names in kinds:
            chosen = [(place, item["score"]) for place, item in enumerate(shown) if item["name"] in names]
            if chosen:
                places, scores = zip(*chosen, strict=True)
                drawn.barh(places, scores, color=color, hatch=hatch, edgecolor="white", label=label)
        drawn.set_yticks(range(len(shown)), [item["name"] for item in shown])
        drawn.invert_yaxis()
        drawn.set_xlabel("fall of χ² promised by the score test [1]")
        drawn.set_title("candidates" if shown else "no effect promises anything")
        if shown:
            drawn.legend(loc="lower right", fontsize=8, frameon=True)
        return drawn

    @property
    def settings(self) -> dict[str, float]:
        """Effects by ``name.parameter``, as `FringeModel.from_setup` takes them."""
        return {
            f"{effect.name}.{name}": parameter.value
            for effect in self.effects
            for name, parameter in effect.parameters.items()
        }

    def as_mapping(self, model_override: str = "") -> dict[str, Any]:
        """Plain mapping in the layout of the verdict file."""
        effects = []
        for effect in self.effects:
            entry = asdict(effect)
            entry["ambiguous_with"] = list(effect.ambiguous_with)
            effects.append(entry)
        content = {
            "verdict": self.verdict,
            "complete": self.complete,
            "size": self.size,
            "effects": effects,
            "where": asdict(self.where),
            "gap": asdict(self.gap),
            "steps": [asdict(step) for step in self.steps],
            "unexplained": self.unexplained,
            "model_override": model_override,
            "setup": self.setup,
            "global_probability": self.global_probability,
            "candidates": list(self.candidates),
            "next_measurements": list(self.next_measurements),
            "notes": list(self.notes),
            "data": self.data,
            "learned": self.learned or None,
            "like": list(self.unexplained.get("like", ())),
            "accuracy": self.accuracy,
            "known": self.known,
        }
        cleaned: dict[str, Any] = _plain(content)
        return cleaned

    def to_json(self, model_override: str = "") -> str:
        """Text of ``discovery.json``; what is not a number becomes null."""
        return json.dumps(self.as_mapping(model_override), indent=2, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Verdict:
        """Read the text of ``discovery.json`` back."""
        content = json.loads(text)
        effects = tuple(
            NamedEffect(
                entry["name"],
                {
                    key: ParameterValue(_number(p["value"]), _number(p["sigma"]), p["unit"])
                    for key, p in entry["parameters"].items()
                },
                entry["probability"],
                tuple(entry["ambiguous_with"]),
                entry["break_ambiguity"],
                entry["share"],
                _number(entry.get("significance")),
            )
            for entry in content["effects"]
        )
        where: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in content["where"].items()
        }
        gap = {key: value if key == "metric" else _number(value) for key, value in content["gap"].items()}
        return cls(
            content["verdict"],
            effects,
            Where(**where),
            Gap(str(gap.pop("metric")), **gap),
            tuple(Step(**{**step, "added": tuple(step["added"])}) for step in content["steps"]),
            content["unexplained"],
            content["setup"],
            content["global_probability"],
            tuple(content["candidates"]),
            tuple(content["next_measurements"]),
            tuple(content["notes"]),
            content["data"],
            complete=content.get("complete", True),
            size={key: _number(content.get("size", {}).get(key)) for key in _SIZES},
            **{key: content.get(key) or {} for key in ("learned", "accuracy", "known")},
        )

    def table(self) -> Table:
        """One row for each parameter of each effect that was found."""
        rows = [
            (
                effect.name,
                name,
                p.value,
                p.sigma,
                p.unit,
                effect.probability,
                ", ".join(effect.ambiguous_with),
            )
            for effect in self.effects
            for name, p in effect.parameters.items()
        ]
        names = ("effect", "parameter", "value", "sigma", "unit", "probability", "ambiguous_with")
        kinds = (str, str, float, float, str, float, str)
        table = Table(rows=rows or None, names=names, dtype=kinds)
        table.meta.update({"verdict": self.verdict, "setup": self.setup})
        return table

    def override(self) -> str:
        """Text of a config override that puts effects, known and found, into fit, sky simulation and templates."""
        return effects_override(self.settings, self.setup, self.verdict, known=self.known)

    @property
    def within_accuracy(self) -> bool:
        """Whether data and model disagree beyond noise, but by no more than the tables of the model may be wrong."""
        return bool(self.accuracy.get("within"))

    @property
    def has_learned(self) -> bool:
        """Whether a correction was learned that noise alone would hardly give."""
        return bool(self.learned.get("believed"))

    def write(self, out_dir: str | Path) -> Path:
        """Write ``effects.py``, ``discovery.ecsv`` and ``discovery.json``; returns the path of the last.

        While there is a ``discovery.json``, all are of one verdict. A correction that was learned is in
        ``learned.py``, and ``learned_effect.py`` is an effect for a person to finish.
        """
        folder = Path(out_dir)
        folder.mkdir(parents=True, exist_ok=True)
        contents = {
            "effects.py": self.override(),
            "discovery.ecsv": table_text(self.table()),
            **learned_files(self),
            "discovery.json": self.to_json(str(folder / "effects.py")),
        }
        return write_together(folder, contents)

    def size_text(self) -> str:
        """How large the disagreement is, for people."""
        counts, fringes = self.size["of_counts"], self.size["of_fringes"]
        if counts == 0.0:
            found = (
                "none beyond the noise" if self.verdict == "no_discrepancy" else "too small to be measured"
            )
            most = self.size["of_fringes_at_most"]
            if math.isfinite(most):
                found += f", at most {100.0 * most:.2g} % of the fringes ({100.0 * CONFIDENCE:g} %)"
            return f"size of the disagreement: {found}"
        return (
            f"size of the disagreement: {100.0 * fringes:.2g} % of the fringes "
            f"({100.0 * counts:.2g} % of the counts)"
        )

    def summary(self) -> str:
        """A few lines for people."""
        stopped = "" if self.complete else " (the search was stopped; the best answer so far)"
        lines = [f"verdict: {self.verdict}{stopped}"]
        if math.isfinite(self.size["of_counts"]):
            lines.append(f"  {self.size_text()}")
        for effect in self.effects:
            values = effect.values_text()
            lines.append(f"  {effect.name}: {values}  (probability {probability_text(effect.probability)})")
            if effect.ambiguous_with:
                lines.append(f"    these data cannot tell it from: {', '.join(effect.ambiguous_with)}")
                lines.append(f"    what would decide: {effect.break_ambiguity}")
        lines += [f"  {text}" for text in (accuracy_text(self), learned_text(self)) if text]
        if self.unexplained.get("reason"):
            lines.append(f"  {self.unexplained['reason']}")
        gap = self.gap
        if not math.isfinite(gap.before):  # data too poor to be searched
            return "\n".join(lines)
        lines.append(
            f"  {gap.metric}: {gap.before:.6g} -> {gap.after:.6g} "
            f"(held out {gap.heldout_before:.6g} -> {gap.heldout_after:.6g}, noise floor {gap.noise_floor:.6g})"
        )
        return "\n".join(lines)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, int):
        return value
    number = float(value)
    return number if math.isfinite(number) else None


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
