"""The core of the inference: one log marginal likelihood by which everything is compared."""

from .cell_average import CellShape
from .common_offset import led, with_common_offset
from .coordinates import Coordinate, coordinates_of
from .forward import Forward
from .marginal import Columns, Data, Point, Problem, joined, kept, solved
from .optimise import (
    Hypothesis,
    effect_columns,
    fit,
    free_columns,
    in_best_orders,
    in_open_orders,
    in_whole_orders,
    jumped,
    relaxed,
    with_free_contrast,
)

__all__ = [
    "CellShape",
    "Columns",
    "Coordinate",
    "Data",
    "Forward",
    "Hypothesis",
    "Point",
    "Problem",
    "coordinates_of",
    "effect_columns",
    "fit",
    "free_columns",
    "in_best_orders",
    "in_open_orders",
    "in_whole_orders",
    "joined",
    "jumped",
    "kept",
    "led",
    "relaxed",
    "solved",
    "with_common_offset",
    "with_free_contrast",
]
