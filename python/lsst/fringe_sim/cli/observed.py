"""What ``templates`` and ``correct`` share: the frames they are pointed at, options, templates from a folder."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import InputError
from .parameters import SIZE

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    from ..algorithms.correction import AmplifierGrid
    from ..algorithms.fringe_correction import TemplateSet
    from ..products import FringeFrame
    from ..products.observed_files import ObservedImage

__all__ = [
    "TemplateFolder",
    "background_options",
    "background_path",
    "grid_of",
    "images_of",
    "latest_date",
    "stem_of",
]

SPACING_PX = 256.0


def background_options(command: Callable[..., None]) -> Callable[..., None]:
    """Options of what is fitted beside the fringes."""
    for option in (
        click.option(
            "--background",
            type=click.Path(exists=True, file_okay=False, path_type=Path),
            help="Folder with the backgrounds that were subtracted, in files named as the frames; added first.",
        ),
        click.option(
            "--background-px",
            type=click.FloatRange(8.0),
            default=SPACING_PX,
            show_default=True,
            help="Scale of the smooth background that is fitted beside the fringes.",
        ),
        click.option(
            "--amplifiers",
            type=SIZE,
            default=None,
            help="Amplifiers beside and on top of each other, such as 8x2, each with a level of its own.",
        ),
    ):
        command = option(command)
    return command


def grid_of(amplifiers: tuple[int, int] | None) -> AmplifierGrid:
    """Amplifiers of columns x rows."""
    from ..algorithms.correction import AmplifierGrid

    columns, rows = amplifiers or (1, 1)
    return AmplifierGrid(rows, columns)


def images_of(paths: Sequence[Path], pattern: str = "*.fits*") -> list[ObservedImage]:
    """Images in files, and in the files of folders; companions such as masks and weights are no frames.

    Raises
    ------
    InputError
        There are none, or a file is damaged.
    """
    from ..products.observed_files import is_companion, observed_images

    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob(pattern)) if path.is_dir() else [path]
        files.extend(file for file in found if not (path.is_dir() and is_companion(file)))
    if not files:
        raise InputError("frames", [str(path) for path in paths], "FITS files, or folders with them")
    return [image for file in files for image in observed_images(file)]


def background_path(folder: Path | None, image: ObservedImage) -> Path | None:
    """File with the background of a frame.

    Raises
    ------
    InputError
        The folder does not have it.
    """
    if folder is None:
        return None
    path = folder / image.path.name
    if not path.is_file():
        raise InputError("background", str(path), f"a file named as the frame {image.path}")
    return path


def stem_of(path: Path) -> str:
    """Name of a file without the endings of FITS and of its compression."""
    name = path.name
    for ending in (".gz", ".fz", ".bz2", ".fits", ".fit"):
        name = name.removesuffix(ending)
    return name


class TemplateFolder:
    """Templates by sensor, from ``fringe-sim templates`` or of a model."""

    def __init__(self, path: Path) -> None:
        self._last: tuple[str, TemplateSet] | None = None
        self._files: dict[str, list[Path]] = defaultdict(list)
        found = [path] if path.is_file() else sorted(path.glob("templates_*.fits"))
        for file in found or sorted(path.glob("fringe_*.fits")):
            self._files[_keyword(file, "DETNAME")].append(file)
        if not self._files:
            allowed = "a folder with templates_*.fits of 'fringe-sim templates', or fringe_*.fits of a model"
            raise InputError("--templates", str(path), allowed)

    def of(self, detector: str) -> list[FringeFrame]:
        """Templates of a sensor; the only ones there are for a sensor or templates without a name.

        Raises
        ------
        InputError
            There are none of it, or a file is damaged.
        """
        names = sorted(self._files)
        if detector not in self._files and (len(names) > 1 or (names[0] and detector)):
            raise InputError("sensor of a frame", detector, f"one with templates: {', '.join(names)}")
        return _read_templates(tuple(self._files[detector if detector in self._files else names[0]]))

    def prepared(self, detector: str) -> TemplateSet:
        """The same as a fit wants them; those of the last sensor are kept, for its next frame."""
        from ..algorithms.fringe_correction import TemplateSet

        if self._last is None or self._last[0] != detector:
            self._last = (detector, TemplateSet.of(self.of(detector)))
        return self._last[1]


def _read_templates(files: tuple[Path, ...]) -> list[FringeFrame]:
    """Templates of one sensor."""
    from ..products import FringeFrame, FringeTemplates

    frames: list[FringeFrame] = []
    for file in files:
        if _keyword(file, "PRODUCT") == "FringeFrame":
            frames.append(FringeFrame.read_fits(file))
        else:
            frames.extend(FringeTemplates.read_fits(file).frames())
    return frames


def _keyword(path: Path, keyword: str) -> str:
    """Value in the primary header of a FITS file; empty if there is none."""
    from ..resources import open_user_fits, refuse_damage

    with refuse_damage("file", "a complete FITS file", str(path)), open_user_fits(path) as hdus:
        return str(hdus[0].header.get(keyword, ""))


def latest_date(headers: Sequence[Mapping[str, Any]]) -> str:
    """Date of the last frame, ``YYYY-MM-DDThh:mm:ss``: two runs on the same frames agree to the byte."""
    import re

    dates = [str(header.get("DATE-OBS", header.get("OBSDATE", ""))) for header in headers]
    found = [match[0] for date in dates if (match := re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d", date))]
    return max(found, default="1970-01-01T00:00:00")
