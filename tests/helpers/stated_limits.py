"""Values at the ends of what may be stated, and just beyond them."""

from collections.abc import Callable
from typing import Any

import pytest

from lsst.fringe_sim.errors import FringeSimError


def check_ends(made: Callable[[Any], Any], inside: tuple[Any, ...], outside: tuple[Any, ...]) -> None:
    """Make something of values that are allowed, and see that those beyond are refused."""
    for value in inside:
        made(value)
    for value in outside:
        with pytest.raises(FringeSimError):
            made(value)
