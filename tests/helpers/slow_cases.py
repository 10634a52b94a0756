"""Cases of a test of which only the first runs in the quick suite."""

from collections.abc import Iterable
from typing import Any

import pytest


def first_is_quick(cases: Iterable[Any]) -> list[Any]:
    """The cases for ``pytest.mark.parametrize``: all but the first are slow."""
    first, *others = cases
    marked = [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in others
    ]
    return [first, *marked]
