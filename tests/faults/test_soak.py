"""The same night over and over, short; the long one is ``python tests/faults/soak.py``."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from soak import growth, soak

pytestmark = [pytest.mark.middleware, pytest.mark.slow]

MOST_GROWTH_BYTES = 4 << 20  # A night; one kept frame would be less, the arrays of a response more


def test_nights_in_one_process(tmp_path: Path) -> None:
    nights = soak(tmp_path, nights=6, hours="19:20", sensors=2)
    assert [night.quanta for night in nights] == [6] * 6
    assert growth(nights) < MOST_GROWTH_BYTES
    # Files are closed, all but those of the first night that every later one uses.
    assert len({night.open_files for night in nights[1:]}) == 1
