"""The whole paper: sections in order, findings, the machine-readable table."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import Table

from ..notebook import do_nothing
from . import coadds, laboratory, optics, sky, stack
from .published import Finding, published_number
from .section import COLD_SILICON, Context, PaperSection

SECTIONS: tuple[Callable[[Context], PaperSection], ...] = (
    stack.layers,
    stack.bandwidth,
    stack.other_vendor,
    stack.absorption_depth,
    laboratory.one_pixel,
    laboratory.flat_contrast,
    laboratory.row_3000,
    laboratory.thickness_fit,
    laboratory.raft,
    optics.oh_lines,
    optics.angles,
    optics.photon_walk,
    sky.monocam,
    sky.hsc,
    sky.lsst,
    sky.surface_brightness,
    coadds.components,
    coadds.coadd,
)
"""Recomputations in the order of the paper."""

_OF_ONE_SILICON = (
    laboratory.row_3000,
    laboratory.thickness_fit,
    laboratory.raft,
    optics.oh_lines,
    optics.angles,
    coadds.coadd,
)
WITH_COLD_SILICON = tuple(section for section in SECTIONS if section not in _OF_ONE_SILICON)
"""Those that are computed a second time, with silicon as it was measured in the cold."""

NOT_AT_HAND = "needs curves or maps read off the published figures"
STATUSES = ("agrees", "erratum", "differs", "skipped")


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Sections with their findings."""

    sections: tuple[PaperSection, ...]  # what was computed
    findings: tuple[tuple[Finding, ...], ...]  # findings of each section

    @property
    def all_findings(self) -> tuple[Finding, ...]:
        """Findings of all sections, in order."""
        return tuple(finding for group in self.findings for finding in group)

    def count(self, status: str) -> int:
        """How many findings have a status."""
        return sum(finding.status == status for finding in self.all_findings)

    def summary(self) -> str:
        """One line of counts."""
        words = {
            "agrees": "agree with the paper",
            "erratum": "confirm an erratum",
            "differs": "differ",
            "skipped": "were skipped",
        }
        return ", ".join(f"{self.count(status)} {words[status]}" for status in STATUSES)

    def table(self) -> Table:
        """One row per number."""
        return findings_table(self.all_findings)


def _finding(item: str, value: float, cold: float) -> Finding:
    compared = published_number(item).compare(float(value), NOT_AT_HAND if math.isnan(value) else "")
    return replace(compared, cold=float(cold))


def findings_table(findings: Sequence[Finding]) -> Table:
    """Table of findings, numbers as numbers."""
    table = Table(
        {
            "item": [f.number.item for f in findings],
            "place": [f.number.place for f in findings],
            "quantity": [f.number.quantity for f in findings],
            "unit": [f.number.unit for f in findings],
            "published_low": np.array([f.number.low for f in findings], dtype=float),
            "published_high": np.array([f.number.high for f in findings], dtype=float),
            "tolerance": np.array([f.number.tolerance for f in findings], dtype=float),
            "corrected": np.array([f.number.corrected for f in findings], dtype=float),
            "recomputed": np.array([f.value for f in findings], dtype=float),
            "cold_silicon": np.array([f.cold for f in findings], dtype=float),
            "status": [f.status for f in findings],
            "from_figure": [f.number.from_figure for f in findings],
            "note": [f.reason or f.number.note for f in findings],
        },
        descriptions={
            "published_low": "as the paper states it; NaN where it gives no number",
            "published_high": "the same, upper end of a range",
            "tolerance": "allowed on either side",
            "corrected": "right value where the paper errs",
            "recomputed": "with the constants of the paper; NaN where it was skipped",
            "cold_silicon": "the same with silicon as measured in the cold; NaN where it was not recomputed",
            "status": "agrees, erratum (the paper errs, the correction is confirmed), differs, skipped",
            "from_figure": "measured in a figure rather than printed",
        },
    )
    table.meta["source"] = "doi:10.1088/1538-3873/acbe67"
    return table


def reproduce(
    context: Context,
    sections: Sequence[Callable[[Context], PaperSection]] | None = None,
    advance: Callable[[], None] = do_nothing,
) -> Reproduction:
    """Recompute the paper; ``advance`` is called after each section."""
    made, findings = [], []
    cold_context = replace(context, silicon=COLD_SILICON)
    for compute in SECTIONS if sections is None else sections:
        section = compute(context)
        made.append(section)
        cold = compute(cold_context).values if compute in WITH_COLD_SILICON else {}
        findings.append(
            tuple(_finding(item, value, cold.get(item, math.nan)) for item, value in section.values.items())
        )
        advance()
    return Reproduction(tuple(made), tuple(findings))
