"""Numbers of the paper as ``fringe-sim reproduce-paper`` has found them."""

from __future__ import annotations

from pathlib import Path

from astropy.table import Table

from .markdown import table

__all__ = ["counts", "numbers"]

FOUND = Path(__file__).resolve().parents[2] / "guide" / "paper.ecsv"
"""What the command wrote with all published curves at hand."""

WORDS = {"agrees": "agrees", "erratum": "paper errs", "differs": "**differs**", "skipped": "skipped"}


def counts() -> str:
    """One sentence."""
    status = [str(value) for value in Table.read(FOUND, format="ascii.ecsv")["status"]]
    return (
        f"With the curves at hand {status.count('agrees')} numbers agree, {status.count('erratum')} confirm an "
        f"erratum, {status.count('differs')} differ and {status.count('skipped')} were skipped."
    )


def numbers() -> str:
    """Every number: paper, here, with cold silicon, verdict and reason."""
    found = Table.read(FOUND, format="ascii.ecsv")
    rows = []
    for row in found:
        unit = f" {row['unit']}" if row["unit"] else ""
        low, high = row["published_low"], row["published_high"]
        paper = "–" if low != low else f"{low:g}{unit}" if low == high else f"{low:g} to {high:g}{unit}"
        here = "–" if row["recomputed"] != row["recomputed"] else f"{row['recomputed']:.4g}{unit}"
        cold = "–" if row["cold_silicon"] != row["cold_silicon"] else f"{row['cold_silicon']:.4g}"
        rows.append(
            [row["place"], row["quantity"], paper, here, cold, WORDS[str(row["status"])], row["note"] or ""]
        )
    return table(["where", "quantity", "paper", "here", "cold silicon", "verdict", "note"], rows)
