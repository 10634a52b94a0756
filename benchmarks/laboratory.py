"""Flats of a simulator of its own, as the model has them and not: rows of sensors by contrast and by electrons.

Each cell of the table is one map of 128 × 128 pixels that its seed draws. At most 1e-3 of the unmasked pixels may be
off by more than half an order, at least 95 % must be unmasked where the order can be decided, and pulls are to be
1.0 ± 0.1. Of a map that is masked, flats without noise tell whether its order can be decided: whether they tell the
true one from the next by a chi-square of 25 or more, all nuisances being free. A pixel of a large uncertainty is off
by half an order now and then although the order about it is right; how often follows from the uncertainty.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

from lsst.fringe_sim.model import FringeModel

from ._table import Row

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))

from laboratory_flats import CERTAIN, ROWS, Result, expected_margin, fit_one

ASKED = (
    "as the model",
    "roughness 80 nm",
    "line of 6 nm",
    "epoxy k 0.005",
    "roughness 80 nm, gradient 3 %",
    "gains 1 %",
    "wavelengths 0.6 nm",
    "one flat 2 nm off",
)
CONTRASTS = (0.05, 0.13, 0.25, 0.5, 1.0)
ELECTRONS = (5_000.0, 20_000.0, 80_000.0)
WALKED = ("as the model",)
WALKED_CONTRASTS = (0.05, 0.25, 1.0)
WALKED_ELECTRONS = 20_000.0
SIZE = 128
FIRST_SEED = 41_000
WRONG, MASKED, PULLS = 1e-3, 0.05, 0.1


@dataclass(frozen=True)
class Cell:
    """One map: its case, how it compares with the truth, and the expected margin of its order where it is masked."""

    case: str
    result: Result
    margin: float

    @property
    def decidable(self) -> bool:
        """Whether noise allows to tell the order, as far as it matters."""
        return self.margin >= CERTAIN

    @property
    def misses(self) -> bool:
        """Whether the map misses the goal."""
        result = self.result
        if not self.decidable:
            return result.wrong > WRONG
        return result.wrong > WRONG or result.masked > MASKED or not abs(result.own - 1.0) <= PULLS

    def __str__(self) -> str:
        result = self.result
        return (
            f"{self.case}: wrong {result.wrong:.1e} ({result.foretold:.1e} by σ), masked {result.masked:.1e}, "
            f"pulls {result.own:.2f}"
        )


def asked(name: str, seed: int, contrast: float, electrons: float, model: FringeModel) -> Cell:
    """One map, told on the error stream as it comes."""
    laboratory = replace(ROWS[name], contrast=contrast, electrons=electrons)
    result, margin = fit_one(laboratory, seed, model, SIZE)[1], math.inf
    if result.masked > MASKED:
        margin = expected_margin(laboratory, seed, model, SIZE)
    print(
        f"{name}: contrast {contrast:g}, {electrons:.0f} e-: {result}  expected {margin:.3g}", file=sys.stderr
    )
    return Cell(f"{contrast:g} at {electrons:.0f} e⁻", result, margin)


def row(name: str, first_seed: int, model: FringeModel) -> list[Row]:
    """All contrasts and levels of one row: the worst of its decidable maps, and which miss the goal."""
    start, begun = time.perf_counter(), time.process_time()
    found = [
        asked(name, seed, contrast, electrons, model)
        for seed, (contrast, electrons) in enumerate(itertools.product(CONTRASTS, ELECTRONS), first_seed)
    ]
    good = [cell.result for cell in found if cell.decidable and not cell.misses]
    notes = [f"{sum(cell.decidable for cell in found)} of {len(found)} decidable, {len(good)} meet the goal"]
    if good:
        notes.append(
            f"these at worst: wrong {max(result.wrong for result in good):.1e}, "
            f"masked {max(result.masked for result in good):.1e}, "
            f"pulls {min(result.own for result in good):.2f} to {max(result.own for result in good):.2f}"
        )
    notes += [str(cell) for cell in found if cell.misses]
    rows = [
        Row(
            name,
            "`global`",
            time.perf_counter() - start,
            len(found),
            None,
            "; ".join(notes),
            time.process_time() - begun,
        )
    ]
    return rows + ([walked(name, first_seed, model)] if name in WALKED else [])


def walked(name: str, first_seed: int, model: FringeModel) -> Row:
    """The walk of the paper over some of the same maps."""
    start, begun = time.perf_counter(), time.process_time()
    notes = []
    for seed, (contrast, electrons) in enumerate(itertools.product(CONTRASTS, ELECTRONS), first_seed):
        if contrast in WALKED_CONTRASTS and electrons == WALKED_ELECTRONS:
            laboratory = replace(ROWS[name], contrast=contrast, electrons=electrons)
            result = fit_one(laboratory, seed, model, SIZE, method="guo2022")[1]
            notes.append(str(Cell(f"{contrast:g} at {electrons:.0f} e⁻", result, math.inf)))
    wall, cpu = time.perf_counter() - start, time.process_time() - begun
    return Row(name, "`guo2022`", wall, len(notes), None, "; ".join(notes), cpu)


def run() -> list[Row]:
    """All rows."""
    model = FringeModel.from_setup("ts8_e2v")
    per_row = len(CONTRASTS) * len(ELECTRONS)
    return [each for at, name in enumerate(ASKED) for each in row(name, FIRST_SEED + per_row * at, model)]
