"""Errors say the field, the value and what is allowed, and survive the trip between processes."""

from __future__ import annotations

import inspect
import pickle

import pytest

from lsst.fringe_sim import errors
from lsst.fringe_sim.errors import FringeSimError, InputError, OutOfRangeError, UnknownNameError


def test_message_has_source_field_value_and_allowed() -> None:
    message = str(InputError("MONOWL", "wide", "a number [nm]", source="flat_01.fits"))
    assert message == "flat_01.fits: MONOWL is 'wide'; allowed: a number [nm]"


def test_near_misses_are_offered() -> None:
    error = UnknownNameError("raft", "R1l", ["R11", "R22", "R01"])
    assert "did you mean" in str(error)
    assert "R11" in str(error)


def test_long_lists_are_cut() -> None:
    error = UnknownNameError("detector", "zzz", [f"d{i:03d}" for i in range(189)])
    assert "189 in all" in str(error)
    assert len(str(error)) < 400


@pytest.mark.parametrize("kind", [InputError, OutOfRangeError])
def test_errors_survive_pickling(kind) -> None:
    error = kind("field", 3, "4", source="file")
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    assert type(copy) is kind
    assert str(copy) == str(error)


def test_unknown_names_survive_pickling() -> None:
    error = UnknownNameError("set-up", "ts8", ["ts8_e2v"], source="file")
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    assert str(copy) == str(error)


def test_source_can_be_added() -> None:
    assert str(OutOfRangeError("x", 1, "2").in_source("a.fits")).startswith("a.fits: x is 1")


def test_everything_derives_from_one_base() -> None:
    for name in errors.__all__:
        assert issubclass(getattr(errors, name), (FringeSimError, Warning))
        assert inspect.getdoc(getattr(errors, name))
