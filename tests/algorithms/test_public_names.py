"""What `lsst.fringe_sim.algorithms` offers is callable, however often and in whatever order it is asked for."""

import pytest

from lsst.fringe_sim import algorithms


@pytest.mark.parametrize("name", algorithms.__all__)
def test_every_public_name_stays_callable(name) -> None:
    assert callable(getattr(algorithms, name))
    assert callable(getattr(algorithms, name))


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="nothing_here"):
        algorithms.nothing_here  # noqa: B018
