"""Frames of the night sky from files, with the thickness map of their sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..algorithms.field_response import SensorPlacement
from ..errors import InputError
from ..instrument.camera import Camera
from ..instrument.detector import Detector
from ..model import FringeModel, Setup
from ..products import SkyFringe, ThicknessMap
from .inputs import read_thickness

__all__ = ["SkyFrames", "read_sky_frames"]

FloatArray = NDArray[np.float64]

UNKNOWN_SIGMA_UM = 0.003
"""Uncertainty of a map that states none."""


@dataclass(frozen=True, eq=False)
class SkyFrames:
    """What a search on the sky starts from.

    Attributes
    ----------
    frames : `list` [`SkyFringe`]
        Frames of one sensor.
    setup : `Setup`
        The telescope.
    detector : `Detector`
        The sensor.
    thickness_um, thickness_sigma_um : `numpy.ndarray`, shape ``(ny, nx)``
        The map and its uncertainty [µm].
    """

    frames: list[SkyFringe]
    setup: Setup
    detector: Detector
    thickness_um: FloatArray
    thickness_sigma_um: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.frames[0].shape

    def model(self, settings: Mapping[str, float]) -> FringeModel:
        """The sensor in its place, with effects that are known."""
        place = SensorPlacement.of(self.detector, self.setup.pixel_scale_arcsec)
        return FringeModel.from_setup(
            self.setup, settings, field_x_deg=place.field_x_deg, field_y_deg=place.field_y_deg
        )


def read_sky_frames(paths: Sequence[str], setup: Setup, thickness: str | None) -> SkyFrames:
    """Read frames and map.

    Parameters
    ----------
    paths : sequence of `str`
        FITS files written as `SkyFringe`, or folders with them.
    setup : `Setup`
        A telescope.
    thickness : `str` or `None`
        File with the map; it is needed.

    Raises
    ------
    InputError
        No map, no frames, frames of several sensors, files of another kind or damaged.
    """
    if thickness is None:
        raise InputError("--thickness", None, "a thickness map: frames of the sky alone do not tell it")
    files = _files(paths)
    frames = [SkyFringe.read_fits(file) for file in files]
    names = sorted({frame.detector for frame in frames if frame.detector})
    if len(names) > 1:
        raise InputError("detectors of the sky frames", names, "one sensor")
    sensor = Camera.from_name(setup.camera).detector(names[0] if names else setup.detector)
    layer = read_thickness(thickness)
    return SkyFrames(frames, setup, sensor, layer, _sigma(thickness, layer.shape))


def _files(paths: Sequence[str]) -> list[Path]:
    found: list[Path] = []
    for text in paths:
        path = Path(text)
        if path.is_dir():
            found.extend(sorted(path.glob("*.fits")))
        elif path.is_file():
            found.append(path)
        else:
            raise FileNotFoundError(2, "there is no such file or folder", text)
    if not found:
        raise InputError("sky frames", list(paths), "FITS files, or folders with them")
    return found


def _sigma(path: str, shape: tuple[int, ...]) -> FloatArray:
    """Uncertainty of a map [µm]; some nm where the file states none."""
    try:
        return np.asarray(ThicknessMap.read_fits(path).sigma, dtype=float)
    except InputError:
        return np.full(shape, UNKNOWN_SIGMA_UM)
