"""Header keywords and what each reader does with them, from the declarations that the readers themselves use."""

from __future__ import annotations

from lsst.fringe_sim import products
from lsst.fringe_sim.instrument.header_keywords import NOT_READ, RAW_KEYWORDS, READERS
from lsst.fringe_sim.instrument.stated_facts import RAW_FACTS
from lsst.fringe_sim.products.file_keywords import FILE_KEYWORDS
from lsst.fringe_sim.products.fits_product import NOTED, Card

from .markdown import code, sections, table

READ_BACK = ("ThicknessMap", "FringeCube", "SkyFringe", "FringeFlat", "CombinedBias")
"""Products of which a file may come from outside, or from an earlier task."""


def raw_keywords() -> str:
    """Keywords of raw frames by reader, and those on which nothing depends."""
    rows = [
        (
            code(item.name),
            item.place,
            *(item.treatment.get(reader, "") for reader in READERS),
            item.what,
        )
        for item in RAW_KEYWORDS
    ]
    parts = [
        table(("keyword", "HDU", *READERS, "decides, or must be"), rows),
        "### Stated more than once",
        "What the primary header and every other HDU say of one thing is compared, and refused where it differs by "
        "more than this.",
        table(
            ("fact", "keywords", "may differ by", "because"),
            [
                (
                    fact.name,
                    ", ".join(map(code, fact.keywords)),
                    "" if fact.apart is None else f"{fact.apart:g} {fact.unit}",
                    fact.because,
                )
                for fact in RAW_FACTS
            ],
        ),
        "A keyword that is neither above nor below is named by `fit`, `discover` and `ingest`, and not used.",
        "### On which nothing depends",
        table(("keywords (regular expression)", "because"), [(code(name), why) for name, why in NOT_READ]),
    ]
    return sections(parts)


def file_keywords() -> str:
    """Keywords of maps, cubes and sky frames; then the cards of every product."""
    rows = [(item.file, code(item.name), item.readers, item.treatment, item.what) for item in FILE_KEYWORDS]
    parts = [
        table(("file", "keyword", "readers", "", "decides, or must be"), rows),
        "### Numbers and names of products",
    ]
    cards = [
        (name, code(card.keyword), card.what, card.unit, _allowed(card))
        for name in READ_BACK
        for card in getattr(products, name).CARDS
    ]
    cards += [
        ("any, where it is there", code(card.keyword), card.what, card.unit, _allowed(card)) for card in NOTED
    ]
    parts.append(table(("product", "keyword", "meaning", "unit", "allowed"), cards))
    return sections(parts)


def _allowed(card: Card) -> str:
    if card.kind is str:
        return "text"
    low = f"{'above' if card.open_low else 'from'} {card.low:g}" if card.low > -float("inf") else ""
    high = f"to {card.high:g}" if card.high < float("inf") else ""
    return " ".join(part for part in (low, high) if part) or "finite"
