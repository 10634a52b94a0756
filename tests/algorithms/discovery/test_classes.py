"""Effects are one class if all data, not only the part that was searched, cannot tell them apart."""

import math
from dataclasses import replace

import numpy as np
import pytest
from lsst.fringe_sim.algorithms.discovery.classes import (
    EffectClass,
    classes_in_all_data,
    outsider_probability,
    outsiders_for_one,
)
from lsst.fringe_sim.algorithms.discovery.fit import Coordinate, Fit
from lsst.fringe_sim.algorithms.discovery.selection import Hypothesis

from lsst.fringe_sim.algorithms.discovery.channels import Channel

WIDTH = 5.0
NEAR, FAR = "contrast_loss", "bandwidth"


def fitted(name: str, log_evidence: float) -> Hypothesis:
    item = Coordinate(name, "size", 0.0, -1.0, 1.0, 0.1, False, "")
    settings, one = {f"{name}.size": 0.2}, np.ones(1)
    fit = Fit(
        settings, (item,), 0.2 * one, one, 0.0 * one, -2.0 * log_evidence, np.eye(1), 5, True
    )  # fmt: skip
    return Hypothesis((name,), fit, log_evidence)


def class_in_part() -> tuple[Hypothesis, EffectClass]:
    chosen = fitted("roughness", 60.0)
    rivals = {NEAR: fitted(NEAR, 60.0 - 2.0 * WIDTH), FAR: fitted(FAR, 60.0 - 4.0 * WIDTH)}
    return chosen, EffectClass({"roughness": 1.0}, 1.0, {}, 11.0, chosen, rivals)


def in_all_data(near: float) -> EffectClass:
    chosen, group = class_in_part()
    known = {NEAR: fitted(NEAR, near)}  # one far behind is not fitted again
    final = fitted("roughness", 80.0)
    return classes_in_all_data(
        {"roughness": group}, chosen, final, lambda rival: known[rival.names[0]], WIDTH
    )["roughness"]


def test_a_rival_that_was_behind_in_a_part_joins_where_all_data_want_it() -> None:
    group = in_all_data(79.0)
    share = np.exp(-1.0) / (1.0 + np.exp(-1.0))
    assert group.members == pytest.approx({"roughness": 1.0 - share, NEAR: share})
    assert group.values[NEAR] == {"size": 0.2}
    assert group.probability == pytest.approx(1.0)


def test_one_that_is_behind_in_all_data_does_not() -> None:
    assert set(in_all_data(70.0).members) == {"roughness"}


def test_the_effect_that_was_chosen_stays_in_its_class() -> None:
    group = in_all_data(90.0)
    assert set(group.members) == {"roughness", NEAR}
    assert group.members[NEAR] > 0.99


def test_a_wider_class_is_no_likelier_than_in_the_part_that_chose_it() -> None:
    chosen, group = class_in_part()
    unsure = replace(group, probability=0.9)
    found = classes_in_all_data(
        {"roughness": unsure}, chosen, fitted("roughness", 80.0), lambda _: fitted(NEAR, 80.0), WIDTH
    )
    assert found["roughness"].probability == 0.9


def test_a_cause_outside_the_catalogue_leaves_the_more_the_stronger_it_is() -> None:
    """Noise of one sensor in two hundred is no reason to doubt an effect of signal to noise 160, but one of 30."""
    left = replace(fitted("roughness", 60.0), channels=(Channel("amplifiers", 50.0, 20.0, 0.005),))
    strong, weak = (outsider_probability(left, 0.15, signal_to_noise**2) for signal_to_noise in (160.0, 30.0))
    assert strong < 0.03
    assert weak > 0.05
    much = replace(left, channels=(Channel("amplifiers", 90.0, 20.0, 1e-9),))
    assert outsider_probability(much, 0.15, 160.0**2) > 0.99


def test_a_cause_outside_is_likelier_in_the_place_of_several_effects() -> None:
    """Against the sum over all numbers of causes, Poisson distributed with mean 1, one of them outside."""

    def of_causes(number: int) -> float:
        return math.exp(-1.0) / math.factorial(number)

    for number, factor in ((1, 1), (2, 4), (3, 15)):
        with_one_outside = sum((kept + 1) * of_causes(kept + 1) for kept in range(number))
        assert with_one_outside / of_causes(number) == pytest.approx(factor)
        assert outsiders_for_one(number) == factor
    one = replace(fitted("roughness", 60.0), channels=(Channel("amplifiers", 20.0, 20.0, 0.5),))
    odds = []
    for names in (("roughness",), ("roughness", NEAR), ("roughness", NEAR, FAR)):
        chance = outsider_probability(replace(one, names=names), 0.15, 1000.0**2)
        odds.append(chance / (1.0 - chance))
    assert odds[1:] == pytest.approx([4.0 * odds[0], 15.0 * odds[0]])
    spots = outsider_probability(replace(one, names=("gain", "void")), 0.15, 1000.0**2, 0.0)
    assert spots / (1.0 - spots) - odds[1] == pytest.approx(2.0 * 0.15 / 0.85)
