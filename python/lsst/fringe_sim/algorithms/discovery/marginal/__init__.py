"""The search on the core of `algorithms.inference`, behind ``SearchOptions(core="marginal")``."""

from .verdict import MarginalSearch

__all__ = ["MarginalSearch"]
