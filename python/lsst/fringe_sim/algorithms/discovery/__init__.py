"""Discovery of missing effects: find the disagreement, name it, add it, show the gap shrink."""

from ...model.effects_override import read_effects_override
from .options import SearchOptions
from .search import discover
from .sky_search import SKY_SEARCH, discover_sky, placement_in_frames
from .verdict import Gap, NamedEffect, ParameterValue, Step, Verdict, Where, probability_text

__all__ = [
    "SKY_SEARCH",
    "Gap",
    "NamedEffect",
    "ParameterValue",
    "SearchOptions",
    "Step",
    "Verdict",
    "Where",
    "discover",
    "discover_sky",
    "placement_in_frames",
    "probability_text",
    "read_effects_override",
]
