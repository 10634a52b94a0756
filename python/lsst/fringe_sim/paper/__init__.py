"""The paper, recomputed: what it states, what this package finds, and the reason where they differ."""

from .published import Finding, PublishedNumber, published_numbers
from .reproduce import SECTIONS, Reproduction, reproduce

__all__ = ["SECTIONS", "Finding", "PublishedNumber", "Reproduction", "published_numbers", "reproduce"]
