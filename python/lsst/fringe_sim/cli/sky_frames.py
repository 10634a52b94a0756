"""Frames of the night sky from files, with the thickness map of their sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from ..errors import InputError
from ..instrument.detector import Detector
from ..model import FringeModel, Setup
from ..products import FringeFrame, FringeTemplates, SkyFrames, SkyFringe
from ..products.same_light import pixels_digest
from ..resources import complete_fits
from .inputs import placed_model, read_map


@dataclass(frozen=True, eq=False)
class SkyData:
    """What a search on the sky starts from: frames and thickness of a sensor behind a telescope."""

    sky: SkyFrames
    setup: Setup
    detector: Detector

    def model(self, settings: Mapping[str, float]) -> FringeModel:
        """The sensor in its place, with effects that are known."""
        return placed_model(self.setup, settings, self.detector)


def read_sky_frames(paths: Sequence[str], setup: Setup, thickness: str | None) -> SkyData:
    """Read frames and map.

    ``paths``: FITS files written as `SkyFringe`, or folders with them, templates in which are passed over.
    ``thickness``: file with the map; it is needed.
    """
    if thickness is None:
        raise InputError("--thickness", None, "a thickness map: frames of the sky alone do not tell it")
    files = _files(paths)
    frames = _each_once(files)
    sensor = setup.sensor(next((frame.detector for frame in frames if frame.detector), None))
    return SkyData(SkyFrames(frames, read_map(thickness, setup, sensor)), setup, sensor)


def _each_once(files: Sequence[Path]) -> list[SkyFringe]:
    """Frames without copies, which are named."""
    frames: dict[str, SkyFringe] = {}
    copies = []
    for file in files:
        frame = SkyFringe.read_fits(file)
        if frames.setdefault(pixels_digest(frame.image), frame) is not frame:
            copies.append(str(file))
    if copies:
        click.echo(f"copies of other frames, not counted again: {', '.join(copies)}", err=True)
    return list(frames.values())


def _files(paths: Sequence[str]) -> list[Path]:
    found: list[Path] = []
    for text in paths:
        path = Path(text)
        if path.is_dir():
            found.extend(file for file in sorted(path.glob("*.fits")) if not _is_template(file))
        elif path.is_file():
            found.append(path)
        else:
            raise FileNotFoundError(2, "there is no such file or folder", text)
    if not found:
        raise InputError("sky frames", list(paths), "FITS files, or folders with them")
    return found


def _is_template(file: Path) -> bool:
    """Whether a file holds what ``fringe-sim sky --templates`` writes beside the frames."""
    with complete_fits(file) as hdus:
        return hdus[0].header.get("PRODUCT") in (FringeFrame.__name__, FringeTemplates.__name__)
