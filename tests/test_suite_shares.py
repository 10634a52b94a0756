"""The shares of the slow suite: each test in exactly one of them."""

import argparse

import pytest
from suite_shares import Share

GROUPS = [f"tests/room/test_{name}.py::test_{number}" for name in ("fit", "sky") for number in range(100)]


def test_shares_are_the_whole_suite_and_do_not_overlap() -> None:
    shares = [{group for group in GROUPS if Share(number, 5).has(group)} for number in range(1, 6)]
    assert sum(map(len, shares)) == len(GROUPS)
    assert set().union(*shares) == set(GROUPS)
    assert min(map(len, shares)) > len(GROUPS) // 10


@pytest.mark.parametrize("text", ["0/5", "6/5", "5", "a/5", "", "2/"])
def test_a_share_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        Share.parse(text)
