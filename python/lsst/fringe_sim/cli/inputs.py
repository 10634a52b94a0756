"""Reading what a command is pointed at: thickness maps, settings, output folders."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits
from numpy.typing import NDArray

from ..errors import FrameFormatError, InputError
from ..model import FringeModel
from ..model.provenance import model_cards, software_cards

__all__ = ["effect_cards", "prepare_folder", "read_settings", "read_thickness"]


def read_thickness(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Thickness map from a FITS file.

    Parameters
    ----------
    path : path-like
        A map written by this package (its mask is honoured: masked pixels become NaN), or any FITS file whose
        first image is the thickness in µm.

    Returns
    -------
    thickness_um : `numpy.ndarray`, shape ``(ny, nx)``

    Raises
    ------
    FrameFormatError
        The file is not FITS, is truncated, or holds no two-dimensional image.
    FileNotFoundError
        There is no such file.
    """
    source = str(path)
    if not Path(path).is_file():
        raise FileNotFoundError(2, "there is no such file", source)
    try:
        with fits.open(path, memmap=False) as hdus:
            image = next((hdu.data for hdu in hdus if hdu.is_image and hdu.data is not None), None)
            mask = hdus["MASK"].data if "MASK" in hdus else None
    except (OSError, ValueError, TypeError) as error:
        raise FrameFormatError("file", str(error), "a complete FITS file", source=source) from None
    if image is None or image.ndim != 2:
        found = "no image" if image is None else f"shape {image.shape}"
        raise FrameFormatError("thickness map", found, "a two-dimensional image in µm", source=source)
    thickness = np.asarray(image, dtype=float)
    if mask is not None and mask.shape == thickness.shape:
        thickness[mask != 0] = np.nan
    if not np.any(np.isfinite(thickness)):
        raise FrameFormatError("thickness map", "no finite pixel", "a thickness in µm", source=source)
    return thickness


def read_settings(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Mapping from a YAML file, read with the safe loader.

    Raises
    ------
    InputError
        The file is not YAML or not a mapping.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError("settings file", str(error).split("\n")[0], "YAML", source=str(path)) from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError("settings file", type(content).__name__, "a mapping", source=str(path))
    return content


def prepare_folder(path: str | os.PathLike[str]) -> Path:
    """Make an output folder, or find out early that it cannot be written.

    Raises
    ------
    InputError
        The path is a file, or the folder cannot be written.
    """
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise InputError("output folder", str(folder), "a folder, not a file")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "output folder", str(folder), f"a folder that can be made ({error.strerror})"
        ) from None
    if not os.access(folder, os.W_OK):
        raise InputError("output folder", str(folder), "a folder that can be written")
    return folder


def effect_cards(model: FringeModel) -> dict[str, str | float]:
    """Header keywords of a product: software, set-up, effects, revisions of tables."""
    return {**software_cards(), **model_cards(model.setup, model.effect_settings)}
