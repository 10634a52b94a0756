"""Files are written whole or not at all, and never through a link."""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from lsst.fringe_sim.files import all_or_nothing, json_text, same_file_key, write_together, write_whole


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "süd.txt"
    path.write_text("old")
    with all_or_nothing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert write_whole(path, "µm") == path
    assert path.read_bytes() == "µm".encode()
    assert list(tmp_path.iterdir()) == [path]
    mask = os.umask(0o027)
    try:
        mode = write_whole(tmp_path / "new.txt", "a").stat().st_mode
    finally:
        os.umask(mask)
    assert mode & 0o777 == 0o640


def test_an_error_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def half() -> None:
        with all_or_nothing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_is_replaced_and_not_followed(tmp_path: Path) -> None:
    far, link = tmp_path / "far.txt", tmp_path / "link.txt"
    far.write_text("untouched")
    link.symlink_to(far)
    write_whole(link, b"here")
    assert far.read_text() == "untouched"
    assert link.read_text() == "here"
    assert not link.is_symlink()


def test_files_are_as_readable_as_others(tmp_path: Path) -> None:
    ordinary = tmp_path / "ordinary"
    ordinary.write_text("")
    written = write_whole(tmp_path / "written", "")
    assert os.stat(written).st_mode == os.stat(ordinary).st_mode


def test_two_writers_at_once_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "one.txt"
    with all_or_nothing(path) as first, all_or_nothing(path) as second:
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_left_is_cleared_by_the_next(tmp_path: Path) -> None:
    path = tmp_path / "one.txt"
    other = tmp_path / ".two.txt.0123456789ab.part"  # of another file
    other.write_text("of two.txt")
    program = (
        "import os, signal, sys, pathlib; from lsst.fringe_sim.files import all_or_nothing\n"
        "with all_or_nothing(pathlib.Path(sys.argv[1])) as part:\n"
        "    part.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    assert len(list(tmp_path.glob(".one.txt.*"))) == 1
    write_whole(path, "whole")
    assert sorted(tmp_path.iterdir()) == sorted([path, other])


def test_of_what_is_left_only_files_of_nobody_are_cleared(tmp_path: Path) -> None:
    """Neither links, of which anybody may have set one, nor what a writer still holds, nor files of other names."""
    path, target = tmp_path / "one.txt", tmp_path / "precious"
    names = [".one.txt.0123456789ab.part", ".one.txt.00000000000f.part", ".one.txt.0123456789a.part"]
    names += [".one.txt.0123456789ab.part2", "xone.txt.0123456789ab.part", ".one.txt.fedcba987654.part"]
    for name in (*names[:5], target.name):
        (tmp_path / name).write_text("left")
    (tmp_path / names[5]).symlink_to(target)
    with (tmp_path / names[1]).open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        write_whole(path, "whole")
        assert {each.name for each in tmp_path.iterdir()} == {"one.txt", "precious", *names[1:]}
    write_whole(path, "whole")
    assert {each.name for each in tmp_path.iterdir()} == {"one.txt", "precious", *names[2:]}
    assert target.read_text() == "left"


@pytest.mark.parametrize("call", ["fsync", "replace", "unlink"])
@pytest.mark.parametrize("number", range(7))
def test_files_of_two_writes_never_stand_beside_the_index(
    call: str, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("a", "b", "index")
    write_together(tmp_path, dict.fromkeys(names, "old"))
    left = itertools.count()

    def stopping(*arguments: Any, **options: Any) -> Any:
        if next(left) == number:
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(*arguments, **options)

    original = getattr(os, call)
    with monkeypatch.context() as patched, suppress(OSError):
        patched.setattr(os, call, stopping)
        write_together(tmp_path, dict.fromkeys(names, "new"))
    found = {path.name: path.read_text() for path in tmp_path.iterdir() if path.name in names}
    assert "index" not in found or len(set(found.values())) == 1
    write_together(tmp_path, dict.fromkeys(names, "newest"))
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(names, "newest")


def test_json_is_indented_for_people() -> None:
    assert json_text({"a": [1, None]}) == '{\n  "a": [\n    1,\n    null\n  ]\n}'


def test_a_folder_that_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "missing" / "file", "")


@pytest.mark.parametrize("pair", [("Süd", "SÜD"), ("s\u00fcd", "su\u0308d"), ("groß", "GROSS")])
def test_names_that_are_one_file_on_some_systems(pair: tuple[str, str]) -> None:
    assert same_file_key(pair[0]) == same_file_key(pair[1])
    assert same_file_key(pair[0]) != same_file_key("nord")
