"""Raw frames with a known truth, from a simulator that shares tables with the fitting model, and no physics.

Nothing that fits, models or criticises may import this room.
"""

from .hidden_effects import HIDDEN_EFFECTS, HiddenEffect, validate_effects
from .optics import Film, FlatFieldOptics, SignalTable, material_index
from .raw_frames import Defects, MockExposure, MockRun, MockTruth, parse_size, setup_optics, write_mock_flats
from .thickness import E2V_SHAPE, e2v_321, fit_to_sensor, random_field

__all__ = [
    "E2V_SHAPE",
    "HIDDEN_EFFECTS",
    "Defects",
    "Film",
    "FlatFieldOptics",
    "HiddenEffect",
    "MockExposure",
    "MockRun",
    "MockTruth",
    "SignalTable",
    "e2v_321",
    "fit_to_sensor",
    "material_index",
    "parse_size",
    "random_field",
    "setup_optics",
    "validate_effects",
    "write_mock_flats",
]
