"""Figures and the HTML report."""

from .discovery_page import ResidualPair, discovery_page
from .page import Report

__all__ = ["Report", "ResidualPair", "discovery_page"]
