"""What ``templates`` and ``correct`` share: the frames they are pointed at, options, templates from a folder."""

from __future__ import annotations

import functools
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import InputError, UnknownNameError
from ..files import same_file_key
from .bad_files import refuse_bad
from .command import Decorate, option
from .parameters import SIZE

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    from ..algorithms.correction import AmplifierGrid
    from ..algorithms.fringe_correction import CorrectionOptions, TemplateSet
    from ..products import FringeFrame, ObservedFrame
    from ..products.observed_files import ObservedImage

SPACING_PX = 256.0

NO_SKY = "their sky was subtracted, perhaps with part of the fringes; --background puts it back"


@dataclass(frozen=True)
class Background:
    """What is fitted beside the fringes."""

    folder: Path | None  # of the backgrounds that were subtracted
    spacing_px: float
    amplifiers: tuple[int, int] | None  # columns x rows; where nobody states them the frame tells

    @property
    def grid(self) -> AmplifierGrid:
        """Amplifiers with levels of their own."""
        from ..algorithms.correction import AMPLIFIERS_UNKNOWN, AmplifierGrid

        return AmplifierGrid(*self.amplifiers[::-1]) if self.amplifiers else AMPLIFIERS_UNKNOWN

    @property
    def options(self) -> CorrectionOptions:
        """The same for a correction."""
        from ..algorithms.fringe_correction import CorrectionOptions

        return CorrectionOptions(self.spacing_px, self.grid)

    def of(self, image: ObservedImage) -> Path | None:
        """File with what was subtracted from a frame; `InputError` if the folder does not have it."""
        path = None if self.folder is None else self.folder / image.path.name
        if path is not None and not path.is_file():
            raise InputError("background", str(path), f"a file named as the frame {image.path}")
        return path

    def loaders(self, images: Sequence[ObservedImage]) -> list[Callable[[], ObservedFrame]]:
        """What reads each frame, its background added."""
        return [partial(image.read, self.of(image)) for image in images]


def background_options() -> Any:
    """Options of a command, which gets them as one `Background`."""
    folder = option(
        "Folder with the backgrounds that were subtracted, in files named as the frames; added first.",
        kind=click.Path(exists=True, file_okay=False, path_type=Path),
    )
    scale = "Scale of the smooth background that is fitted beside the fringes."
    spacing_px = option(scale, SPACING_PX, click.FloatRange(8.0))
    grid = option(
        "Amplifiers beside and on top of each other, such as 3x1, each with a level of its own, or 1x1. By default a "
        "frame tells whether the levels of 8x2, 4x1, 2x1 or 2x2 differ.",
        kind=SIZE,
    )

    def declare(name: str) -> Decorate:
        def decorate(command: Callable[..., None]) -> Callable[..., None]:
            @functools.wraps(command)
            def with_background(
                *, background: Any, background_px: Any, amplifiers: Any, **others: Any
            ) -> None:
                command(**{name: Background(background, background_px, amplifiers)}, **others)

            made = spacing_px("background_px")(folder("background")(with_background))
            return grid("amplifiers")(made)

        return decorate

    return declare


def images_of(
    paths: Sequence[Path], accept: Callable[[Mapping[str, Any], str], None]
) -> tuple[list[ObservedImage], list[InputError]]:
    """Images in files and in the files of folders, and an error for each file that cannot be used.

    Companions such as masks and weights are no frames. A file that is meant twice counts once.

    ``accept``: raises `InputError` over a header, with the name of its file, of a frame that is not to be used.

    `InputError`: there are no files, or no usable one.
    """
    from ..products.observed_files import is_companion, observed_images

    files: dict[Path, Path] = {}
    for path in paths:
        found = sorted(path.glob("*.fits*")) if path.is_dir() else [path]
        for file in found:
            if not (path.is_dir() and is_companion(file)):
                files.setdefault(file.resolve(), file)
    images: list[ObservedImage] = []
    bad: list[InputError] = []
    for file in files.values():
        try:
            parts = observed_images(file)
            for image in parts:
                accept(image.header(), str(file))
        except InputError as error:
            bad.append(error)
        else:
            images.extend(parts)
    if not images:
        refuse_bad(bad, skip_bad=False, others=False)
        raise InputError("frames", [str(path) for path in paths], "FITS files, or folders with them")
    return images, bad


def target_names(images: Sequence[ObservedImage], ending: str, former: str = "") -> dict[Path, str]:
    """Name of the file that is written for each file; ``ending`` follows the stem, in place of ``former``.

    `InputError`: two files would become one.
    """
    names = {path: f"{stem_of(path).removesuffix(former)}{ending}.fits" for path in _paths(images)}
    taken: dict[str, Path] = {}
    for path, name in names.items():
        other = taken.setdefault(same_file_key(name), path)
        if other != path:
            raise InputError("frames", f"{other} and {path}", f"names that differ: both would become {name}")
    return names


def _paths(images: Sequence[ObservedImage]) -> list[Path]:
    return list(dict.fromkeys(image.path for image in images))


def stem_of(path: Path) -> str:
    """Name of a file without the endings of FITS and of its compression."""
    name = path.name
    for ending in (".gz", ".fz", ".bz2", ".fits", ".fit"):
        name = name.removesuffix(ending)
    return name


BAND = re.compile(r"(?:[a-z]+[_-])?([ugrizy])(?:_\d+)?")
"""Names of filters that tell the band: y, y_10, HSC-Y, lsst_y."""


class TemplateFolder:
    """Templates by sensor, from ``fringe-sim templates`` or of a model."""

    def __init__(self, path: Path) -> None:
        self._last: tuple[tuple[str, str], TemplateSet] | None = None
        self._files: dict[str, list[Path]] = defaultdict(list)
        found = [path] if path.is_file() else sorted(path.glob("templates_*.fits"))
        for file in found or sorted(path.glob("fringe_*.fits")):
            self._files[_keyword(file, "DETNAME")].append(file)
        if not self._files:
            allowed = "a folder with templates_*.fits of 'fringe-sim templates', or fringe_*.fits of a model"
            raise InputError("--templates", str(path), allowed)

    def check(self, images: Sequence[ObservedImage]) -> None:
        """Read the templates of all sensors of images, before long work.

        `InputError`: a file is damaged, or there twice.
        """
        from ..products.observed_files import detector_of

        for sensor in sorted({detector_of(image.header()) for image in images}):
            with suppress(UnknownNameError):  # that is the matter of the frame
                self.of(sensor)

    def of(self, detector: str, physical_filter: str = "") -> list[FringeFrame]:
        """Templates of a sensor; templates without a name are those of any sensor.

        `InputError`: there are none of it, or those of another filter, or a file is damaged or there twice.
        """
        names = sorted(self._files)
        if detector not in self._files and names != [""]:
            raise UnknownNameError("sensor that a frame names", detector, names)
        files = tuple(self._files[detector if detector in self._files else names[0]])
        found = _read_templates(files)
        for name in {each.physical_filter for each in found}:
            if other_light(name, physical_filter, _keyword(files[0], "PRODUCT") == "FringeFrame"):
                raise InputError("filter of a frame", physical_filter, f"{name}, that of the templates")
        return found

    def prepared(self, detector: str, physical_filter: str = "") -> TemplateSet:
        """The same as a fit wants them; those of the last sensor are kept, for its next frame."""
        from ..algorithms.fringe_correction import TemplateSet

        wanted = detector, physical_filter
        if self._last is None or self._last[0] != wanted:
            self._last = (wanted, TemplateSet.of(self.of(*wanted)))
        return self._last[1]


def other_light(template: str, frame: str, is_model: bool) -> bool:
    """Whether the names of two filters are of different ones.

    A model names its filter as its telescope does, which a file need not: only the bands of both can differ.
    """
    if not template or not frame:
        return False
    if not is_model:
        return template != frame
    bands = [BAND.fullmatch(name.strip().lower()) for name in (template, frame)]
    return bands[0] is not None and bands[1] is not None and bands[0][1] != bands[1][1]


def _read_templates(files: tuple[Path, ...]) -> list[FringeFrame]:
    """Templates of one sensor."""
    from ..products import FringeFrame, FringeTemplates
    from ..products.same_light import refuse_equal_pixels

    frames: list[FringeFrame] = []
    for file in files:
        if _keyword(file, "PRODUCT") == "FringeFrame":
            frames.append(FringeFrame.read_fits(file))
        else:
            frames.extend(FringeTemplates.read_fits(file).frames())
    refuse_equal_pixels(f"templates in {files[0].parent}", [each.image for each in frames])
    return frames


def _keyword(path: Path, keyword: str) -> str:
    """Value in the primary header of a FITS file; empty if there is none."""
    from ..resources import complete_fits

    with complete_fits(path) as hdus:
        return str(hdus[0].header.get(keyword, ""))


def latest_date(headers: Sequence[Mapping[str, Any]]) -> str:
    """Date of the last frame, ``YYYY-MM-DDThh:mm:ss``: two runs on the same frames agree to the byte."""
    dates = [str(header.get("DATE-OBS", header.get("OBSDATE", ""))) for header in headers]
    found = [match[0] for date in dates if (match := re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d", date))]
    return max(found, default="1970-01-01T00:00:00")
