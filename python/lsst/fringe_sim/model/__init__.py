"""Set-ups and the fringe model."""

from .fringe_model import FringeModel
from .setup import Setup, setup_names

__all__ = ["FringeModel", "Setup", "setup_names"]
