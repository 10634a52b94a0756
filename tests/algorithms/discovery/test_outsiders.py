"""How likely a cause outside the catalogue is, from what effects leave and how many they are."""

import math

import pytest

from lsst.fringe_sim.algorithms.discovery.outsiders import outsider_probability, outsiders_for_one


def test_a_cause_outside_the_catalogue_leaves_the_more_the_stronger_it_is() -> None:
    """Noise of one sensor in two hundred is no reason to doubt an effect of signal to noise 160, but one of 30."""
    strong, weak = (
        outsider_probability(1, 0.005, 0.15, signal_to_noise**2) for signal_to_noise in (160.0, 30.0)
    )
    assert strong < 0.03
    assert weak > 0.05
    assert outsider_probability(1, 1e-9, 0.15, 160.0**2) > 0.99


def test_a_cause_outside_is_likelier_in_the_place_of_several_effects() -> None:
    """Against the sum over all numbers of causes, Poisson distributed with mean 1, one of them outside."""

    def of_causes(number: int) -> float:
        return math.exp(-1.0) / math.factorial(number)

    for number, factor in ((1, 1), (2, 4), (3, 15)):
        with_one_outside = sum((kept + 1) * of_causes(kept + 1) for kept in range(number))
        assert with_one_outside / of_causes(number) == pytest.approx(factor)
        assert outsiders_for_one(number) == factor
    odds = []
    for number in (1, 2, 3):
        chance = outsider_probability(number, 0.5, 0.15, 1000.0**2)
        odds.append(chance / (1.0 - chance))
    assert odds[1:] == pytest.approx([4.0 * odds[0], 15.0 * odds[0]])
    spots = outsider_probability(2, 0.5, 0.15, 1000.0**2, 0.0)
    assert spots / (1.0 - spots) - odds[1] == pytest.approx(2.0 * 0.15 / 0.85)
