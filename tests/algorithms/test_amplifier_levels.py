"""Levels of amplifiers in a thickness fit: where the camera of the set-up has them."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.thickness_fit import Nuisances
from lsst.fringe_sim.errors import InputError


def test_zones_begin_where_amplifiers_do() -> None:
    assert Nuisances(zones="amplifiers").breaks(100, 80) == ((50,), (10, 20, 30, 40, 50, 60, 70))
    assert Nuisances(zones="amplifiers", grid=(1, 4)).breaks(100, 80) == ((), (20, 40, 60))
    assert Nuisances(zones="amplifiers", grid=(3, 1)).breaks(99, 80) == ((33, 66), ())
    assert Nuisances(zones="amplifiers", grid=(1, 1)).breaks(100, 80) == ((), ())
    assert Nuisances(zones="halves", grid=(1, 4)).breaks(100, 80) == ((50,), ())
    with pytest.raises(InputError, match="zones"):
        Nuisances(zones="amplifiers", grid=(1, 90)).breaks(100, 80)


def test_levels_are_known_where_an_amplifier_is_large_enough() -> None:
    free = Nuisances.automatic(grid=(1, 4))
    assert np.isfinite(free.gain_accuracy)
    assert free.fitting(16, 64).zones == "amplifiers"
    assert free.fitting(16, 63).zones == "sensor"
    assert Nuisances.automatic().fitting(32, 127).zones == "sensor"
    assert Nuisances.automatic().fitting(32, 128).zones == "amplifiers"
