"""Files are written whole or not at all, and never through a link."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lsst.fringe_sim.files import all_or_nothing, write_whole


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


def test_a_folder_that_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "missing" / "file", "")
