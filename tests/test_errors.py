"""Errors say the field, the value and what is allowed, and survive the trip between processes."""

import inspect
import math
import pickle

import pytest

from lsst.fringe_sim import errors
from lsst.fringe_sim.errors import FringeSimError, InputError, OutOfRangeError, UnknownNameError, to_number


def test_message_has_source_field_value_and_allowed() -> None:
    message = str(InputError("MONOWL", "wide", "a number [nm]", source="flat_01.fits"))
    assert message == "flat_01.fits: MONOWL is 'wide'; allowed: a number [nm]"


def test_near_misses_are_offered() -> None:
    error = UnknownNameError("raft", "R1l", ["R11", "R22", "R01"])
    assert "did you mean" in str(error)
    assert "R11" in str(error)


@pytest.mark.parametrize("given", ["zzz", "d01", "d"])
def test_of_a_long_list_three_names_are_shown(given: str) -> None:
    known = [f"d{i:03d}" for i in range(189)]
    error = UnknownNameError("detector", given, known)
    assert "189" in str(error)
    assert sum(name in str(error) for name in known) == 3


def test_a_short_list_is_shown_whole() -> None:
    assert "ts8_e2v, ts8_itl" in str(UnknownNameError("set-up", "qqq", ["ts8_itl", "ts8_e2v"]))


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
    kinds = [value for value in vars(errors).values() if inspect.getmodule(value) is errors]
    kinds = [kind for kind in kinds if inspect.isclass(kind)]
    assert {kind.__name__ for kind in kinds} <= set(errors.__all__)
    for kind in kinds:
        assert issubclass(kind, (FringeSimError, Warning))
        assert inspect.getdoc(kind)


@pytest.mark.parametrize("digits", [400, 5000])
def test_numbers_beyond_a_float_are_refused_in_words(digits) -> None:
    """YAML and JSON hold integers of any length; Python neither converts nor even writes the longest."""
    with pytest.raises(OutOfRangeError, match=r"fwhm is -inf; allowed: a number below 1\.8e308"):
        to_number("fwhm", -(10**digits))
    assert len(str(InputError("fwhm", 16**digits, "a number"))) < 600


@pytest.mark.parametrize("value", [True, None, "wide", [1.0], {}])
def test_what_is_no_number_is_refused(value) -> None:
    with pytest.raises(InputError, match=r"own\.yaml: fwhm is .*; allowed: a number \[nm\]"):
        to_number("fwhm", value, "a number [nm]", source="own.yaml")


def test_numbers_and_their_text_are_taken() -> None:
    assert to_number("fwhm", "2.5") == 2.5
    assert math.isnan(to_number("fwhm", math.nan))
