"""Figures and the HTML report."""

from .page import Report

__all__ = ["Report"]
