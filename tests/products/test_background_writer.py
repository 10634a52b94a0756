"""Files that are written while the next product is made: the same bytes, in order, and no error is lost."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from product_makers import sky

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.products import BackgroundWriter, SkyFringe


def frames(count: int) -> list[SkyFringe]:
    return [sky((5, 7), metadata={"NUMBER": number}) for number in range(count)]


def write_all(paths: list[Path], error: Exception | None = None) -> None:
    """Write a frame to each path, then fail if told to."""
    with BackgroundWriter() as writer:
        for frame, path in zip(frames(len(paths)), paths, strict=True):
            writer.write(frame, path)
        if error is not None:
            raise error


def test_files_are_those_that_are_written_at_once(tmp_path: Path) -> None:
    with BackgroundWriter() as writer:
        for number, frame in enumerate(frames(4)):
            writer.write(frame, tmp_path / f"{number}.fits", {"NOTE": "x"})
    for number, frame in enumerate(frames(4)):
        frame.write_fits(tmp_path / "expected.fits", {"NOTE": "x"})
        assert (tmp_path / f"{number}.fits").read_bytes() == (tmp_path / "expected.fits").read_bytes()


def test_the_caller_goes_on_while_a_file_is_written_and_waits_for_it_before_the_next(tmp_path, monkeypatch):
    may_write, order = threading.Event(), []

    def slow(self: SkyFringe, path: Path, metadata: object = None, *, section: object = None) -> None:
        assert may_write.wait(60.0)
        order.append(path.name)

    monkeypatch.setattr(SkyFringe, "write_fits", slow)
    with BackgroundWriter() as writer:
        writer.write(frames(1)[0], tmp_path / "first")
        assert order == []
        may_write.set()
        writer.write(frames(1)[0], tmp_path / "second")
        assert order[0] == "first"
    assert order == ["first", "second"]


def test_an_error_is_raised_at_the_next_file_which_is_not_written(tmp_path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        write_all([tmp_path / "0.fits", tmp_path / "nowhere" / "1.fits", tmp_path / "2.fits"])
    assert [path.name for path in tmp_path.iterdir()] == ["0.fits"]
    np.testing.assert_array_equal(SkyFringe.read_fits(tmp_path / "0.fits").image, frames(1)[0].image)


def test_the_error_of_the_last_file_is_raised_at_the_end(tmp_path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        write_all([tmp_path / "nowhere" / "0.fits"])


def test_an_error_of_the_caller_wins_and_tells_of_the_other(tmp_path) -> None:
    with pytest.raises(ValueError, match="mine") as found:
        write_all([tmp_path / "nowhere" / "0.fits"], ValueError("mine"))
    assert "nowhere" in found.value.__notes__[0]


def test_an_error_of_the_caller_leaves_whole_files(tmp_path) -> None:
    with pytest.raises(ValueError, match="mine"):
        write_all([tmp_path / "0.fits"], ValueError("mine"))
    assert [path.name for path in tmp_path.iterdir()] == ["0.fits"]
    SkyFringe.read_fits(tmp_path / "0.fits")
