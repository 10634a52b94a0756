"""What a cause outside the catalogue is like: effects that no correction replaces."""

from lsst.fringe_sim.algorithms.discovery.neighbours import not_replaced
from lsst.fringe_sim.algorithms.discovery.options import SearchOptions

BEST = "bad"  # black_coating, amplifier_gain, dark_current, by their first letters


def like(evidence: dict[str, float], corrected: dict[str, float]) -> str:
    """Effects that the best set is said to be like.

    ``evidence``, ``corrected``: log evidence of sets, and of corrections beside them.
    """
    sets = sorted(evidence, key=len, reverse=True)

    def smaller(one: str) -> list[str]:
        return [other for other in sets if len(other) == len(one) - 1 and set(other) < set(one)]

    return not_replaced(BEST, smaller, lambda one: evidence[one] + corrected[one], SearchOptions().sure)


def test_what_does_the_most_alone_stays_alone() -> None:
    """Two of three explain what a correction explains as well."""
    evidence = {
        "bad": 1000.0,
        "ad": 300.0,
        "bd": 980.0,
        "ba": 970.0,
        "b": 950.0,
        "d": 100.0,
        "a": 50.0,
        "": 0.0,
    }
    beside = {"bad": 10.0, "ad": 200.0, "bd": 40.0, "ba": 60.0, "b": 90.0, "d": 300.0, "a": 300.0, "": 400.0}
    assert like(evidence, beside) == "b"


def test_members_that_nothing_replaces_stay() -> None:
    evidence = {"bad": 1000.0, "ad": 300.0, "bd": 980.0, "ba": 970.0, "": 0.0}
    assert like(evidence, {"bad": 10.0, "ad": 200.0, "bd": 20.0, "ba": 30.0, "": 0.0}) == BEST


def test_effects_that_do_less_than_a_correction_are_not_told() -> None:
    evidence = {"bad": 30.0, "ad": 25.0, "bd": 20.0, "ba": 25.0, "d": 15.0, "a": 20.0, "b": 5.0, "": 0.0}
    beside = {"bad": 10.0, "ad": 30.0, "bd": 30.0, "ba": 30.0, "a": 50.0, "b": 40.0, "d": 40.0, "": 100.0}
    assert like(evidence, beside) == ""
