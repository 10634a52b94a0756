"""The search on the core of `algorithms.inference`, behind ``SearchOptions(core="marginal")``."""

from .verdict import search_marginal

__all__ = ["search_marginal"]
