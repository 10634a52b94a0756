"""What is deprecated works as before, and says since when, until when, and what takes its place."""

import inspect
import warnings
from dataclasses import dataclass

import pytest

from lsst.fringe_sim.deprecation import deprecated
from lsst.fringe_sim.errors import InputError


@deprecated("1.1", "thickness_of", removed_in="1.2")
def thick(value: float, *, factor: float = 2.0) -> float:
    """A thickness.

    Longer.
    """
    return value * factor


@deprecated("1.1", "width_nm", removed_in="1.2", argument="width")
def line(centre_nm: float, width_nm: float = 2.4) -> tuple[float, float]:
    """A line."""
    return centre_nm, width_nm


@deprecated("1.1", "Layer", removed_in="1.2")
@dataclass(frozen=True)
class Film:
    """A film."""

    thickness_um: float


def test_a_function_warns_where_it_is_called() -> None:
    with pytest.warns(FutureWarning, match=r"thick .* 1\.1 .* 1\.2; use thickness_of") as caught:
        assert thick(3.0, factor=3.0) == 9.0
    assert caught[0].filename == __file__


def test_a_class_stays_a_class() -> None:
    with pytest.warns(FutureWarning, match="Film .* use Layer"):
        film = Film(2.0)
    assert isinstance(film, Film)
    assert film.thickness_um == 2.0


def test_a_former_argument_goes_to_the_new_one() -> None:
    with pytest.warns(FutureWarning, match="argument 'width' of line .* use width_nm"):
        assert line(960.0, width=5.0) == (960.0, 5.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert line(960.0, 3.0) == line(960.0, width_nm=3.0) == (960.0, 3.0)


@deprecated("1.1", "", removed_in="1.2", argument="depth")
@deprecated("1.1", "", removed_in="1.2", argument="width")
@dataclass(frozen=True)
class Line:
    """A line."""

    centre_nm: float = 960.0


def test_an_argument_that_has_no_effect_any_more_is_accepted() -> None:
    with pytest.warns(FutureWarning, match="argument 'width' of Line .*; it has no effect"):
        assert Line(950.0, width=5.0) == Line(950.0)
    with pytest.warns(FutureWarning, match="depth"):
        assert Line(depth=5.0) == Line()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Line(950.0).centre_nm == 950.0
    with pytest.raises(ValueError, match="must have 'nothing' in place of 'centre_nm'"):
        deprecated("1.1", "", removed_in="1.2", argument="centre_nm")(Line)


def test_two_names_of_one_argument_are_refused() -> None:
    with (
        pytest.warns(FutureWarning),
        pytest.raises(InputError, match=r"width is 5\.0; allowed: one value, as width_nm"),
    ):
        line(960.0, width=5.0, width_nm=3.0)


@pytest.mark.parametrize("names", [("gone", "not_there"), ("centre_nm", "width_nm")])
def test_names_that_cannot_be_meant_are_refused_at_once(names: tuple[str, str]) -> None:
    former, instead = names
    with pytest.raises(ValueError, match=f"'{instead}' in place of '{former}'"):
        deprecated("1.1", instead, removed_in="1.2", argument=former)(line)


def test_help_says_so() -> None:
    assert inspect.signature(thick).parameters.keys() == {"value", "factor"}
    first, directive, rest = str(thick.__doc__).split("\n\n")
    assert (first, rest) == ("A thickness.", "Longer.")
    assert directive.startswith(".. deprecated:: 1.1\n   ")
    assert ".. deprecated:: 1.1" in str(Film.__doc__)
