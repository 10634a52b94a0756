"""The search on one likelihood from a cube to a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ....effects import Effect
from ....model import FringeModel
from ....products.fringe_cube import FringeCube
from ...inference import Hypothesis
from ..channels import Channel
from ..classes import outsider_probability
from ..describe import describe_residual, disagreement
from ..evaluations import OutOfTimeError, time_limit
from ..verdict import CONFIDENCE, Gap, NamedEffect, ParameterValue, Step, Verdict, probability_text
from .critics import judge, state_of, total_chance
from .heldout import Unseen, judge_unseen
from .preparation import prepare, prepare_again
from .rules import Rules
from .search import Catalogue, SetSearch

__all__ = ["MarginalSearch"]

FloatArray = NDArray[np.float64]

_METRIC = "rms of data minus model, relative counts"


class MarginalSearch:
    """One search of flats by one log marginal likelihood, and how its answer is put.

    Parameters are those of `discover`; thickness and noise are fitted with the unchanged model when it is made.
    """

    def __init__(
        self,
        cube: FringeCube,
        model: FringeModel,
        effects: Sequence[Effect],
        rng: np.random.Generator,
        most_cells: int,
        report: Callable[[str], None],
    ) -> None:
        rules = Rules()
        report("fitting the thickness with the unchanged model")
        prepared = prepare(cube, model, effects, most_cells, rules, rng)
        self.prepared, self.model, self.rules, self.report = prepared, model, rules, report
        stack = model.system.stack
        medium = stack.layers[stack.position(model.system.varying)].medium
        wavelength = prepared.cells.wavelength_nm
        self.index = np.real(medium.index(wavelength, model.system.temperature_k))
        self.notes = ["searched by one likelihood (core marginal)"]
        self._judged_with: list[set[str]] = []
        self._judged: dict[tuple[Hypothesis, Hypothesis], tuple[Channel, ...]] = {}
        self.catalogue = Catalogue.of(effects, prepared.problem.forward)
        self.sets = SetSearch(self.catalogue, prepared.null, rules, report, self._leaves_noise)

    def _leaves_noise(self, found: Hypothesis) -> bool:
        return total_chance(self._channels(found)) > self.rules.significance

    def _channels(self, found: Hypothesis) -> tuple[Channel, ...]:
        key = found, self.prepared.null
        if key not in self._judged:
            self._judged[key] = judge(*key, self.index, self.rules)
        return self._judged[key]

    def run(self) -> Verdict:
        """The answer."""
        before = self._channels(self.prepared.null)
        self.report(f"chance that noise alone disagrees as much: {total_chance(before):.3g}")
        best = self._best()
        null, before = self.prepared.null, self._channels(self.prepared.null)
        if best.effects:
            return self._concluded(best)
        if total_chance(before) > self.rules.significance:
            return self._told("no_discrepancy", null, before, (), {}, None)
        return self._unexplained(null, ["no effect of the catalogue explains it"], (), None)

    def best_so_far(self, until: float) -> Verdict:
        """Answer of a search that was stopped; the part held out is asked about it until an instant [s]."""
        null, best = self.prepared.null, self.sets.best_so_far()
        if best.effects:
            try:
                with time_limit(until):
                    return replace(self._concluded(best), complete=False)
            except OutOfTimeError:
                self.notes.append(f"best so far, not judged on data held out: {', '.join(best.effects)}")
        return replace(self._unexplained(null, ["the search was stopped"], (), None), complete=False)

    def _concluded(self, best: Hypothesis) -> Verdict:
        """Judgement of the set that was selected."""
        best = self.sets.alike(best)
        before, after = self._channels(self.prepared.null), self._channels(best)
        unseen = judge_unseen(self.prepared, best)
        named, doubts = self._named(best, total_chance(after))
        reasons = []
        if total_chance(after) < self.rules.significance:
            worst, names = min(after, key=lambda channel: channel.probability), ", ".join(best.effects)
            reasons.append(
                f"with {names} a residual remains in '{worst.name}' (chance {worst.probability:.2g})"
            )
        reasons += [*self._at_ends(best), *doubts]
        if unseen is not None and not unseen.better:
            reasons.append("data held out are not predicted better")
        if reasons:
            return self._unexplained(best, reasons, named, unseen)
        return self._told("named", best, before, named, {}, unseen)

    def _best(self) -> Hypothesis:
        """The best set, found one effect at a time; noise and cells are judged with the best of every size."""
        best = self.prepared.null
        for _ in range(self.rules.most_effects):
            size = len(best.effects)
            best = self._judged_again(self.sets.larger(best))
            if len(best.effects) <= size:
                break
        return best

    def _judged_again(self, best: Hypothesis) -> Hypothesis:
        """The best set once noise and slopes in the cells are those that it leaves itself."""
        for _ in range(self.rules.most_judged if len(best.effects) == 1 else 1):
            if not best.effects or set(best.effects) in self._judged_with or self._is_judged_with_alike(best):
                break
            self._judged_with.append(set(best.effects))
            self.report(f"noise and cells are judged again with {', '.join(best.effects)}")
            prepared = prepare_again(self.prepared, best, self.rules)
            self.sets, self.prepared = self.sets.on(prepared.null), prepared
            best = self.sets.settled(best)
        return best

    def _is_judged_with_alike(self, best: Hypothesis) -> bool:
        """Whether noise and cells are those that a set of the same class leaves."""
        last = self.sets.pool.get(frozenset(self._judged_with[-1])) if self._judged_with else None
        if last is None or len(last.effects) != len(best.effects):
            return False
        return best.log_evidence - last.log_evidence < self.rules.class_width

    def _at_ends(self, best: Hypothesis) -> list[str]:
        """Parameters at an end of their range that nature does not have."""
        found = []
        for item, value in zip(best.items, best.values, strict=True):
            natural = self.catalogue.effects[item.effect].search.natural_bounds
            if not item.place and value in (item.low, item.high) and value not in (item.null, *natural):
                found.append(f"{item.key} is at the end of its range ({value:g})")
        return found

    # Classes --------------------------------------------------------------------------------------------------

    def _named(self, best: Hypothesis, chance: float) -> tuple[tuple[NamedEffect, ...], list[str]]:
        """Every effect of the best set with its class, and what is too doubtful."""
        pool = list(self.sets.pool.values())
        top = self.sets.posterior(best)
        weights = np.exp(np.minimum([self.sets.posterior(one) - top for one in pool], 0.0))
        explained = self.prepared.null.chi2 - best.chi2
        like = cast(Any, SimpleNamespace(names=best.effects, probability_of_noise=chance))
        outsider = outsider_probability(like, self.rules.outsider_prior, explained)
        named, doubts = [], []
        for name in best.effects:
            members = self._class_of(best, name)
            inside = np.array([bool(set(one.effects) & set(members)) for one in pool])
            probability = float((weights * inside).sum() / weights.sum()) * (1.0 - outsider)
            if probability < self.rules.least_probability:
                doubts.append(f"the class of {name} has probability {probability_text(probability)} only")
            others = tuple(sorted((one for one in members if one != name), key=lambda one: -members[one]))
            without = self.sets.without(best, name)
            named.append(
                NamedEffect(
                    name,
                    self._parameters(best, name),
                    probability,
                    others,
                    "further wavelengths; this search does not rank them yet" if others else "",
                    members[name] / sum(members.values()),
                    math.sqrt(max(without.chi2 - best.chi2, 0.0)),
                )
            )
        return tuple(sorted(named, key=lambda one: -one.significance)), doubts

    def _class_of(self, best: Hypothesis, name: str) -> dict[str, float]:
        """Weights of the effects that explain the data about as well in the place of one."""
        rest = frozenset(best.effects) - {name}
        top, members = best.log_evidence, {name: 1.0}
        for names, one in self.sets.pool.items():
            extra = names - rest
            if rest < names and len(extra) == 1 and len(names) == len(best.effects):
                behind = top - one.log_evidence
                if behind < self.rules.class_width:
                    members[next(iter(extra))] = math.exp(-max(behind, 0.0))
        return members

    @staticmethod
    def _parameters(best: Hypothesis, name: str) -> dict[str, ParameterValue]:
        sigma = np.sqrt(np.maximum(np.diag(best.covariance), 0.0))
        return {
            item.parameter: ParameterValue(float(value), float(error), item.unit)
            for item, value, error in zip(best.items, best.values, sigma, strict=True)
            if item.effect == name
        }

    # Layout ---------------------------------------------------------------------------------------------------

    def _unexplained(
        self,
        found: Hypothesis,
        reasons: Sequence[str],
        partial: Sequence[NamedEffect],
        unseen: Unseen | None,
    ) -> Verdict:
        state = state_of(found.point, found.point.level_columns)
        cells = self.prepared.cells
        channels = self._channels(found)
        description = {
            "reason": "; ".join(reasons),
            "too_poor": False,
            "partial": [
                {"name": e.name, "probability": e.probability, "significance": e.significance,
                 "parameters": {k: [p.value, p.sigma] for k, p in e.parameters.items()}}
                for e in partial
            ],
            **describe_residual(state, cells.geometry, self.index, cells.cell_px, channels),
        }  # fmt: skip
        before = self._channels(self.prepared.null)
        return self._told("unexplained", found, before, (), description, unseen)

    def _told(
        self,
        word: str,
        found: Hypothesis,
        before: tuple[Channel, ...],
        effects: tuple[NamedEffect, ...],
        unexplained: dict[str, Any],
        unseen: Unseen | None,
    ) -> Verdict:
        null, cells = self.prepared.null, self.prepared.cells
        state = state_of(null.point, null.point.level_columns)
        first, last = self._rms(null), self._rms(found)
        outside = (first, last) if unseen is None else (unseen.before_rms, unseen.after_rms)
        steps: tuple[Step, ...] = ()
        if found.effects:
            gained = found.log_evidence - null.log_evidence
            quiet = word == "named"
            steps = (Step(found.effects, gained, null.chi2 - found.chi2, first, last, quiet),)
        notes = self.notes + [f"{name} was left out: {why}" for name, why in self.catalogue.left_out.items()]
        scored = self.sets.scores(null)
        return Verdict(
            word, effects,
            disagreement(state, before, cells.geometry, self.index, cells.cell_px),
            Gap(_METRIC, first, last, *outside, cells.noise_rms),
            steps, unexplained, self.model.setup.name, total_chance(before),
            tuple({"name": one.name, "score": 2.0 * one.gain, "degrees": one.degrees} for one in scored),
            (), tuple(notes), self._data(found), size=self._size(null),
        )  # fmt: skip

    def _data(self, found: Hypothesis) -> dict[str, Any]:
        cells, thickness = self.prepared.cells, found.point.thickness_um
        return {
            "shape": list(cells.shape),
            "cell_px": cells.cell_px,
            "wavelength_nm": cells.wavelength_nm.tolist(),
            "noise_factor": self.prepared.noise_factor.tolist(),
            "response_scatter": cells.response_scatter,
            "thickness_um": [float(thickness.min()), float(thickness.max())],
        }

    def _chi2(self, found: Hypothesis) -> tuple[float, float]:
        """Chi square beside all that is free, and its degrees of freedom."""
        point = found.point
        seen = point.problem.data.seen
        left = point.projected(point.residual)[:, seen]
        free = len(point.levels) + len(found.items)
        return float((left**2).sum()), float(point.noise_share[:, seen].sum()) - free

    def _rms(self, found: Hypothesis) -> float:
        chi2, degrees = self._chi2(found)
        return self.prepared.cells.noise_rms * math.sqrt(chi2 / degrees)

    def _size(self, null: Hypothesis) -> dict[str, float]:
        """Size of what the unchanged model leaves beyond noise."""
        chi2, degrees = self._chi2(null)
        noise = self.prepared.cells.noise_rms
        counts, most = (
            noise * math.sqrt(max(chi2 / expected - 1.0, 0.0))
            for expected in (degrees, float(chdtri(degrees, CONFIDENCE)))
        )
        pattern = null.point.value[:, null.point.problem.data.seen]
        fringes = math.sqrt(float(pattern.var(axis=1).mean()))
        return {
            "of_counts": counts,
            "of_fringes": counts / fringes,
            "of_fringes_at_most": most / fringes,
        }
