"""Set-ups and the fringe model."""

from ..instrument.setup import Setup, setup_names
from .fringe_model import LABORATORY_TEMPERATURE, FringeModel
from .response_table import ResponseTable, response_table, tabulate

__all__ = [
    "LABORATORY_TEMPERATURE",
    "FringeModel",
    "ResponseTable",
    "Setup",
    "response_table",
    "setup_names",
    "tabulate",
]
