"""Local effects that a fine thickness may have taken up, and that leave no disagreement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ...array_types import FloatArray
from ...effects import Effect
from .basis import CellBasis
from .fit import Fit, Problem, fit_model
from .preparation import Prepared, prepare_again, smoother
from .selection import Hypothesis, Selector

LEAST_PROMISED, LEAST_EXPLAINED = 0.2, 0.9
"""Part of what the fine thickness gains over a smooth one, beyond noise, that a local effect must promise and explain
beside the smooth one."""

CLEAR = 45.0
"""Fall of χ² beside a thickness of each cell from which on an island is no step of the thickness: four parameters in
ten thousand places. An island is not looked for where the fine thickness gains less than that over a smooth one."""


@dataclass(frozen=True, eq=False)
class HiddenIsland:
    """A local effect beside which the thickness is as smooth on an island as around it."""

    effect: Effect
    fit: Fit  # fit with it
    # The data with a thickness that is smooth beside it, if no step of the thickness is as good
    prepared: Prepared | None

    @property
    def told(self) -> str:
        """Sentence for a verdict."""
        units = {parameter.name: parameter.unit for parameter in self.effect.parameters}
        values = ", ".join(
            f"{name} {self.fit.settings[f'{self.effect.name}.{name}']:.4g} {unit}".strip()
            for name, unit in units.items()
        )
        return (
            f"the thickness steps on an island as {self.effect.name} would make it seem ({values}): "
            "these data cannot tell the two apart"
        )


def hidden_island(prepared: Prepared, catalogue: Sequence[Effect], found: Hypothesis) -> HiddenIsland | None:
    """A local effect beside which a smooth thickness is as good as the fine one of a fit; `None` if there is none.

    A thin gap moves the fringes, and does little else. A thickness that steps at the rim of the island explains it as
    well, and nothing disagrees; that layers do not step is knowledge that no flat holds. Only what no thickness of
    the cells would explain tells them apart.

    ``prepared``: the data; a map of the thickness tells where it steps. ``found``: fit of all data with what
    was found so far.
    """
    local = [effect for effect in catalogue if effect.local and effect.name not in found.names]
    if not local or not prepared.rich or prepared.problem.field_prior:
        return None
    chosen = [effect for effect in catalogue if effect.name in found.names] + local
    thickness = prepared.problem.basis.expand(found.fit.field)
    for smooth in smoother(prepared):
        problem, base = smooth.problem, smooth.null
        if found.names:
            field = problem.basis.fit(thickness, problem.cells.seen.astype(float))
            base = fit_model(problem, found.fit.coordinates, found.fit.position, field, found.fit.levels)
        missing = base.chi2 - found.fit.chi2 - (prepared.problem.basis.size - problem.basis.size)
        if missing < CLEAR:
            # What the fine thickness gains is noise, and so would be an island in it.
            continue
        selector = Selector(problem, chosen, smooth.null, smooth.index)
        for effect in local:
            if effect.name in selector.left_out:  # of a layer that this sensor does not have
                continue
            beside = selector.at_step(effect.name, base, LEAST_PROMISED * missing)
            if beside is not None and base.chi2 - beside.fit.chi2 > LEAST_EXPLAINED * missing:
                smooth_um = problem.basis.expand(beside.fit.field)
                refined = None
                if _fall_beside_steps(problem, found.fit, thickness, beside.fit, smooth_um) > CLEAR:
                    refined, _ = prepare_again(prepared, beside.fit, smooth_um)
                return HiddenIsland(effect, beside.fit, refined)
    return None


def _fall_beside_steps(
    problem: Problem, found: Fit, thickness_um: FloatArray, beside: Fit, smooth_um: FloatArray
) -> float:
    """Fall of χ² that an island brings beside a thickness of each cell, which may step anywhere."""
    free = replace(problem, basis=CellBasis((thickness_um.shape[0], thickness_um.shape[1])))
    fits = [
        fit_model(free, fit.coordinates, fit.position, thickness.ravel(), fit.levels)
        for fit, thickness in ((found, thickness_um), (beside, smooth_um))
    ]
    return fits[0].chi2 - fits[1].chi2
