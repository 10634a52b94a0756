"""Discovery of missing effects: find the disagreement, name it, add it, show the gap shrink."""

from .search import SearchOptions, discover
from .sky_search import discover_sky
from .verdict import (
    Gap,
    NamedEffect,
    ParameterValue,
    Step,
    Verdict,
    Where,
    read_effects_override,
)

__all__ = [
    "Gap",
    "NamedEffect",
    "ParameterValue",
    "SearchOptions",
    "Step",
    "Verdict",
    "Where",
    "discover",
    "discover_sky",
    "read_effects_override",
]
