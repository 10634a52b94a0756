"""What all rooms share: texts of errors, descriptions, threads, lines at the prompt; number by number."""

from __future__ import annotations

import math
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lsst.fringe_sim import compiled, resources
from lsst.fringe_sim.cli.progress import progress
from lsst.fringe_sim.compiled import kernel, limit_threads, processors, run_shares, run_threaded, subkernel
from lsst.fringe_sim.descriptions import (
    Description,
    files_of,
    is_file_name,
    with_files_beside,
)
from lsst.fringe_sim.errors import (
    InputError,
    UnknownNameError,
    is_masked,
    printable_name,
    refuse_no_numbers,
    shown,
    without_unit,
)
from lsst.fringe_sim.notebook import OneLine
from lsst.fringe_sim.resources import (
    DEEPEST_NESTING,
    LONGEST_USER_FILE,
    number_of_values,
    parse_user_yaml,
    read_user_text,
    read_user_yaml,
)


def test_long_texts_are_shortened_in_the_middle() -> None:
    assert shown("a" * 100, 100) == "a" * 100
    assert shown("a" * 50 + "b" * 51, 100) == "a" * 50 + " … " + "b" * 25 + " (101 characters)"
    assert shown("a\nb\x1b[1mé\ud800", 100) == "a\\nb\\x1b[1mé\\ud800"
    assert printable_name("name", "a" * 200) == "a" * 200
    for name in ("", "  ", "a" * 201, "a\nb"):
        with pytest.raises(InputError, match="1 to 200 printable characters"):
            printable_name("name", name)
    value = "v" * 301
    assert str(InputError("x", "v" * 298, "y")) == f"x is '{'v' * 298}'; allowed: y"
    assert "(303 characters)" in str(InputError("x", value, "y"))
    assert len(str(InputError("x", 1, "y" * 3000))) < 1600


def test_near_misses_and_long_lists() -> None:
    known = ["alpha", "beta", "gamma"]
    assert UnknownNameError("x", "alpa", known).allowed == "did you mean alpha? (3 are known)"
    assert UnknownNameError("x", "alpa", known[:1]).allowed == "did you mean alpha?"
    assert UnknownNameError("x", "amm", known).allowed == "did you mean gamma? (3 are known)"
    assert UnknownNameError("x", "zzz", known).allowed == "alpha, beta, gamma"
    assert UnknownNameError("x", "", known).allowed == "alpha, beta, gamma"
    assert UnknownNameError("x", "zzz", ()).allowed == "nothing is registered"
    many = [f"n{number:02d}" for number in range(11)]
    assert UnknownNameError("x", "zzz", many[:10]).allowed == ", ".join(many[:10])
    assert UnknownNameError("x", "zzz", many).allowed == "n00, n01, n02, … (11 in all)"


@pytest.mark.parametrize(
    "good", [1.0, None, 3, np.float32(2.0), np.arange(3), [1, 2.0], ((1, 2), (3, 4)), [np.zeros(2), np.zeros(2)],
             [[[1, 2, 3], [4, 5, 6]], np.zeros((2, 3))],
             np.ma.masked_array([1.0, 2.0], [False, False]), iter(())]
)  # fmt: skip
def test_numbers_pass(good: Any) -> None:
    refuse_no_numbers("x", good)


@pytest.mark.parametrize(
    "bad", [True, "1", b"1", 1j, {"a": 1}, object(), np.array([True]), np.array(["a"]), np.array([1j]), [1, True],
            [[1, 2], [3]], [np.zeros(2), np.zeros(3)], np.ma.masked_array([1.0, 2.0], [True, False]), 10**400]
)  # fmt: skip
def test_what_is_no_number_does_not(bad: Any) -> None:
    with pytest.raises(InputError, match=r"^x"):
        refuse_no_numbers("x", bad)


def test_masks_and_units() -> None:
    assert is_masked(np.ma.masked_array([1.0], [True]))
    assert not is_masked(np.ma.masked_array([1.0], [False]))
    assert not is_masked(3.0)
    from astropy import units

    assert without_unit("x", 3.0 * units.um, "nm") == pytest.approx(3000.0)
    assert without_unit("x", 3.0, "nm") == 3.0
    with pytest.raises(InputError, match="a quantity in um'; allowed: plain numbers"):
        without_unit("x", 3.0 * units.um)
    with pytest.raises(InputError, match="one in K, or numbers"):
        without_unit("x", 3.0 * units.um, "K")


# Descriptions


@pytest.mark.parametrize(
    ("first", "last", "step", "number"),
    [
        (880.0, 990.0, 10.0, 12),
        (880.0, 989.9, 10.0, 11),
        (0.0, 0.3, 0.1, 4),
        (5.0, 5.0, 1.0, 1),
        (0.0, 1.0, 0.4, 3),
    ],
)
def test_a_range_has_its_last_value_if_steps_lead_there(
    first: float, last: float, step: float, number: int
) -> None:
    assert number_of_values(first, last, step) == number


def of(**content: Any) -> Description:
    return Description(content, "a.yaml", "part")


def test_values_of_a_description() -> None:
    reader = of(text="a", number=3, numbers=[1, 2.5], word="b", inner={"x": 1}, list=[{"y": 2}, {"y": 3}])
    assert (reader.text("text"), reader.optional("text", "z"), reader.optional("none", "z")) == (
        "a",
        "a",
        "z",
    )
    assert reader.number("number", low=3.0, high=3.0) == 3.0
    assert reader.number("none", low=0.0, high=1.0, default=7.0) == 7.0
    assert reader.numbers("numbers") == reader.numbers("numbers", 2) == [1.0, 2.5]
    assert reader.choice("word", ("a", "b")) == "b"
    assert reader.section("inner").number("x", low=0.0, high=2.0) == 1.0
    assert [each.number("y", low=0.0, high=9.0) for each in reader.sections("list")] == [2.0, 3.0]


@pytest.mark.parametrize(
    ("content", "read", "said"),
    [
        ({}, lambda r: r.text("k"), "part.k is None; allowed: a value"),
        ({"k": " "}, lambda r: r.text("k"), "allowed: text"),
        ({"k": 3}, lambda r: r.text("k"), "allowed: text"),
        ({"k": "a\tb"}, lambda r: r.text("k"), "in one line"),
        ({"k": 3.1}, lambda r: r.number("k", low=0.0, high=3.0), "0 to 3"),
        ({"k": -0.1}, lambda r: r.number("k", low=0.0, high=3.0), "0 to 3"),
        ({"k": True}, lambda r: r.number("k", low=0.0, high=3.0), "0 to 3"),
        ({"k": "1"}, lambda r: r.number("k", low=0.0, high=3.0), "0 to 3"),
        ({}, lambda r: r.number("k", low=0.0, high=3.0), "the key is missing"),
        ({"k": []}, lambda r: r.numbers("k"), "a list of numbers"),
        ({"k": 1}, lambda r: r.numbers("k"), "a list of numbers"),
        ({"k": [1, "a"]}, lambda r: r.numbers("k"), "a list of numbers"),
        ({"k": [1, True]}, lambda r: r.numbers("k"), "a number"),
        ({"k": [1]}, lambda r: r.numbers("k", 2), "a list of 2 numbers"),
        ({"k": "c"}, lambda r: r.choice("k", ("a", "b")), "a, b"),
        ({"k": 1}, lambda r: r.section("k"), "part.k is 1; allowed: a mapping"),
        ({"k": {}}, lambda r: r.sections("k"), "a list of mappings"),
        ({"k": []}, lambda r: r.sections("k"), "a list of mappings"),
        ({"k": [{}, 2]}, lambda r: r.sections("k"), r"part.k\[1\] is 2; allowed: a mapping"),
        ({"k": [{}]}, lambda r: r.sections("k")[0].text("x"), r"part.k\[0\].x is None"),
    ],
)
def test_what_is_wrong_with_a_description(content: dict[str, Any], read: Any, said: str) -> None:
    with pytest.raises(InputError, match=f"^a.yaml: .*{said}"):
        read(of(**content))


def test_files_beside_a_description(tmp_path: Path) -> None:
    assert [is_file_name(name) for name in ("a.yaml", "a.YML", "a.yaml.txt", "yaml")] == [
        True,
        True,
        False,
        False,
    ]
    inner = {"bandpass": "b.yaml", "beam": {"telescope": "t.yml", "kind": "k.yaml"}}
    content = {"camera": "c.yaml", "stack": "e2v", "media": 3, "illumination": inner}
    found = with_files_beside(content, tmp_path / "x" / "own.yaml")
    folder = tmp_path / "x"
    assert found == {
        "camera": str(folder / "c.yaml"), "stack": "e2v", "media": 3,
        "illumination": {
            "bandpass": str(folder / "b.yaml"), "beam": {"telescope": str(folder / "t.yml"), "kind": "k.yaml"},
        },
    }  # fmt: skip
    assert content["camera"] == "c.yaml"
    assert with_files_beside([1], "x") == [1]
    assert with_files_beside({"illumination": 3}, "x") == {"illumination": 3}
    (tmp_path / "own.yaml").write_text(
        "table: a\nparts: [{table: b}, {table: c, deep: {table: a}}, {table: 3}]\n"
    )
    for name in "ab":
        (tmp_path / name).write_text("")
    assert files_of(tmp_path / "own.yaml") == tuple(str(tmp_path / name) for name in ("own.yaml", "a", "b"))


def test_yaml_is_as_deep_and_as_long_as_it_may_be(tmp_path: Path) -> None:
    assert parse_user_yaml("[" * DEEPEST_NESTING + "]" * DEEPEST_NESTING, "x")
    assert parse_user_yaml("- [a]\n" * 30, "x") == [["a"]] * 30
    with pytest.raises(
        InputError, match=f"nested {DEEPEST_NESTING + 1} deep; allowed: up to {DEEPEST_NESTING}|nested"
    ):
        parse_user_yaml("[" * (DEEPEST_NESTING + 1) + "]" * (DEEPEST_NESTING + 1), "x")
    assert parse_user_yaml("a" * LONGEST_USER_FILE, "x")
    with pytest.raises(InputError, match="characters"):
        parse_user_yaml("a" * (LONGEST_USER_FILE + 1), "x")
    with pytest.raises(InputError, match=r"key is 'b'; allowed: a key once \(again in line 3\)"):
        parse_user_yaml("a: 1\nb: 2\nb: 3\n", "x")
    with pytest.raises(InputError, match="without references"):
        parse_user_yaml("a: &x 1\nb: *x\n", "x")
    (tmp_path / "a").write_bytes(b"12345")
    assert read_user_text(tmp_path / "a", "x", 5) == "12345"
    with pytest.raises(InputError, match="5 bytes"):
        read_user_text(tmp_path / "a", "x", 4)


@pytest.mark.parametrize(
    ("letters", "good"), [("\U0001f600" * 20, True), ("a" * 20, True), ("a" * 21, False)]
)
def test_a_yaml_file_is_measured_in_characters(
    letters: str, good: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of UTF-8 has up to four bytes."""
    monkeypatch.setattr(resources, "LONGEST_USER_FILE", 20)
    (tmp_path / "a").write_text(letters, encoding="utf-8")
    if good:
        assert read_user_yaml(tmp_path / "a", "x") == letters
    else:
        with pytest.raises(InputError, match="21 characters"):
            read_user_yaml(tmp_path / "a", "x")
    (tmp_path / "a").write_bytes(b"a" * 81)
    with pytest.raises(InputError, match="81 bytes"):
        read_user_yaml(tmp_path / "a", "x")


# Threads


@pytest.mark.parametrize("threads", [None, 1, 2, 3, 50])
def test_every_item_is_done_once(threads: int | None) -> None:
    done: list[int] = []
    run_threaded(done.append, 11, threads)
    assert sorted(done) == list(range(11))
    run_threaded(done.append, 0, threads)
    assert len(done) == 11


@pytest.mark.parametrize(("threads", "count", "least", "number"), [
    (1, 100, 1, 1), (2, 100, 1, 8), (2, 100, 30, 3), (2, 100, 101, 1), (3, 5, 0, 5), (2, 7, 2, 3),
])  # fmt: skip
def test_shares_are_all_of_it(threads: int, count: int, least: int, number: int) -> None:
    limit_threads(threads)
    try:
        assert processors() == threads
        parts: list[tuple[int, int]] = []
        run_shares(lambda first, last: parts.append((first, last)), count, least)
    finally:
        limit_threads(None)
    assert len(parts) == number
    assert [item for first, last in sorted(parts) for item in range(first, last)] == list(range(count))
    assert max(last - first for first, last in parts) - min(last - first for first, last in parts) <= 1


def test_two_threads_work_at_once() -> None:
    """Each of two items is waited for by the other."""
    together = threading.Barrier(2)
    run_threaded(lambda item: together.wait(timeout=20.0), 2, 2)
    assert not together.broken


def test_one_thread_works_in_its_own() -> None:
    seen: list[int] = []
    run_threaded(lambda item: seen.append(threading.get_ident()), 4, 1)
    assert set(seen) == {threading.get_ident()}


def test_only_what_asks_for_it_is_rounded_freely() -> None:
    for declared in (kernel, subkernel):
        assert not declared(lambda x: x).targetoptions["fastmath"]
        assert declared(lambda x: x, relaxed=True).targetoptions["fastmath"]


def test_compiled_functions_work_where_none_can_be_kept(monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    """Each is compiled all the same, and it is said once; an error of another kind is not taken for that one."""
    asked: list[bool] = []

    def njit(cache: bool, **options: Any) -> Any:
        asked.append(cache)
        if cache:
            raise RuntimeError("cannot cache")
        return lambda function: function

    monkeypatch.setattr(compiled.numba, "njit", njit)
    monkeypatch.setattr(compiled, "_keep", [True])
    for _ in range(2):
        assert compiled.kernel(lambda x: x + 1.0)(2.0) == 3.0
    assert asked == [True, False, False]
    assert len(caplog.records) == 1

    def broken(cache: bool, **options: Any) -> Any:
        raise RuntimeError("no function")

    monkeypatch.setattr(compiled.numba, "njit", broken)
    with pytest.raises(RuntimeError, match="no function"):
        compiled.kernel(lambda x: x)


def test_what_cannot_be_kept_is_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    """Of a full disk and of a damaged file it is told once each."""
    monkeypatch.setattr(compiled, "_said", set())

    class Cache:
        flushed = 0

        def save_overload(self, signature: Any, data: Any) -> None:
            raise OSError("no space left")

        def load_overload(self, signature: Any, context: Any) -> None:
            raise EOFError("half a file")

        def flush(self) -> None:
            Cache.flushed += 1

    dispatchers = [SimpleNamespace(_cache=Cache()) for _ in range(2)]
    for dispatcher in dispatchers:
        compiled._work_without_cache(dispatcher, None)
        dispatcher._cache.save_overload("signature", "data")
        assert dispatcher._cache.load_overload("signature", "context") is None
    assert len(caplog.records) == 2
    assert Cache.flushed == 2
    compiled._work_without_cache(SimpleNamespace(_cache=None), None)


@pytest.mark.parametrize(
    ("own", "for_all", "found"), [(1, None, 1), (1, 2, 2), (None, 2, 2), (None, None, None)]
)
def test_what_is_kept_for_all_is_looked_into_first(own: Any, for_all: Any, found: Any) -> None:
    def kept(what: Any) -> Any:
        return SimpleNamespace(load_overload=lambda *given: what, save_overload=None)

    dispatcher = SimpleNamespace(_cache=kept(own))
    compiled._work_without_cache(dispatcher, None if for_all is None else kept(for_all))
    assert dispatcher._cache.load_overload("signature", "context") == found
    dispatcher = SimpleNamespace(_cache=kept(own))
    compiled._work_without_cache(dispatcher, kept(None))
    assert dispatcher._cache.load_overload("signature", "context") == own


def test_only_a_folder_that_is_there_is_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What an image keeps for all is read where it cannot be written; it is found by its place, or there is none."""
    monkeypatch.setattr(compiled.numba.config, "CACHE_DIR", str(tmp_path))
    assert compiled._kept_for_all(shown) is None
    monkeypatch.setattr(compiled.os, "access", lambda *_: False)
    assert compiled._kept_for_all(shown) is None
    locator = compiled._cache_for_all()._impl_class._locator_classes[0]
    (tmp_path / Path(locator(shown, shown.__code__.co_filename).get_cache_path()).name).mkdir()
    assert compiled._kept_for_all(shown) is not None
    monkeypatch.setattr(compiled.os, "access", lambda *_: True)  # numba itself looks there
    assert compiled._kept_for_all(shown) is None
    monkeypatch.setattr(compiled.numba.config, "CACHE_DIR", "")
    assert compiled._kept_for_all(shown) is None


# At the prompt


@dataclass(frozen=True, repr=False)
class Shown(OneLine):
    text: str = "a"
    number: float = 1.0
    flag: bool = True
    array: Any = None
    items: Any = ()
    _hidden: int = 3


class Named:
    name = "it"


def test_fields_in_a_line() -> None:
    assert repr(Shown()) == "Shown()"
    assert (
        repr(Shown("a" * 61, 1.23456789, False)) == f"Shown(text='{'a' * 59}…', number=1.23457, flag=False)"
    )
    assert repr(Shown("a" * 60)) == f"Shown(text='{'a' * 60}')"
    assert repr(Shown(array=np.zeros((2, 3)))) == "Shown(array=<2 x 3 float64>)"
    assert repr(Shown(array=np.float32(2.0))) == "Shown(array=<one float32>)"
    assert (
        repr(Shown(items=(1, "b", 2.0, Named(), None, True))) == "Shown(items=(1, 'b', 2, 'it', None, True))"
    )
    assert repr(Shown(items=tuple(range(12)))) == f"Shown(items=({', '.join(map(str, range(12)))}))"
    assert repr(Shown(items=tuple(range(13)))) == "Shown(items=<13 items>)"
    assert repr(Shown(items={1: 2}, array=object())) == "Shown(array=<object>, items=<1 items>)"
    assert repr(Shown(number=1, _hidden=4)) == "Shown(number=1)"


@pytest.mark.parametrize("steps", [1, 3, 10, 25])
def test_progress_without_a_terminal(steps: int, capsys: pytest.CaptureFixture[str]) -> None:
    with progress("working", steps) as advance:
        for _ in range(steps):
            advance()
    quarters = sorted({math.ceil(0.25 * part * steps) for part in (1, 2, 3, 4)})
    assert capsys.readouterr().err.splitlines() == [f"working: {done} of {steps}" for done in quarters]


def test_progress_on_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress("working", 4) as advance:
        for _ in range(4):
            advance()
    assert "working" in capsys.readouterr().err
