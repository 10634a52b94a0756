"""Principal components of a set of sky fringe frames."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..errors import FrameFormatError, OutOfRangeError
from . import _check as check
from . import _fits as io
from .fits_product import FitsProduct

__all__ = ["FringeComponents"]

_OWN = ("DETNAME", "FILTER")


@dataclass(frozen=True, eq=False)
class FringeComponents(FitsProduct):
    """Mean frame, components, and what each explains.

    Frame j of the training set is ``mean + sum_k scores[j, k] * components[k]`` plus what is left over.

    Parameters
    ----------
    mean : `numpy.ndarray`, float32, shape ``(ny, nx)``
        Mean of the training frames, in fractions of the sky; every pixel a number.
    components : `numpy.ndarray`, float32, shape ``(n_components, ny, nx)``
        Components, strongest first; every pixel a number.
    explained_variance : `numpy.ndarray`, float64, shape ``(n_components,)``
        Variance of the scores of each component.
    explained_variance_ratio : `numpy.ndarray`, float64, shape ``(n_components,)``
        Its share in the variance of the training set; from 0 to 1, in all at most 1.
    scores : `numpy.ndarray`, float64, shape ``(n_frames, n_components)``
        Coefficients of the training frames.
    mask : `numpy.ndarray`, int32, shape ``(ny, nx)``
        Planes of `MASK_PLANES`; 0 is good.
    metadata : `Mapping`
        Further header keywords.
    detector, physical_filter : `str`
        Sensor and filter; empty if not known.

    Raises
    ------
    FrameFormatError
        Arrays of the wrong type or shape, or a pixel without a number.
    OutOfRangeError
        Variances that are negative or not sorted, or ratios that are no fractions.
    InputError
        Metadata that a header cannot hold.
    """

    mean: NDArray[np.float32]
    components: NDArray[np.float32]
    explained_variance: NDArray[np.float64]
    explained_variance_ratio: NDArray[np.float64]
    scores: NDArray[np.float64]
    mask: NDArray[np.int32]
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    physical_filter: str = ""

    def __post_init__(self) -> None:
        mean = check.as_float_array("MEAN", self.mean, 2)
        components = check.as_float_array("COMPONENTS", self.components, 3)
        number = components.shape[0]
        check.check_shape("COMPONENTS", components, (number, *mean.shape))
        check.check_good_pixels("MEAN", mean)
        check.check_good_pixels("COMPONENTS", components)
        scores = check.as_float_array("SCORES", self.scores, 2, np.float64)
        if scores.shape[1] != number:
            raise FrameFormatError("SCORES", f"shape {scores.shape}", f"(n_frames, {number})")
        check.check_good_pixels("SCORES", scores)
        variance = _spectrum("EXPLAINED_VARIANCE", self.explained_variance, number)
        ratio = _spectrum("EXPLAINED_VARIANCE_RATIO", self.explained_variance_ratio, number)
        if ratio.sum() > 1 + 1e-6:
            raise OutOfRangeError("EXPLAINED_VARIANCE_RATIO", float(ratio.sum()), "at most 1 in all")
        values = {
            "mean": mean,
            "components": components,
            "explained_variance": variance,
            "explained_variance_ratio": ratio,
            "scores": scores,
            "mask": check.as_mask("MASK", self.mask, mean.shape),
            "metadata": io.normalise_metadata(self.metadata, _OWN),
            "detector": check.check_name("detector", self.detector),
            "physical_filter": check.check_name("physical_filter", self.physical_filter),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def n_components(self) -> int:
        """Number of components kept."""
        return int(self.components.shape[0])

    def _hdus(self, metadata: Mapping[str, Any] | None) -> list[Any]:
        """MEAN, COMPONENTS, MASK, the table SPECTRUM and the image SCORES."""
        own: list[tuple[str, io.Scalar, str]] = [
            ("DETNAME", self.detector, "sensor"),
            ("FILTER", self.physical_filter, "physical filter"),
        ]
        spectrum: list[tuple[str, NDArray[Any], str | None]] = [
            ("explained_variance", self.explained_variance, None),
            ("explained_variance_ratio", self.explained_variance_ratio, None),
        ]
        hdus = [
            io.primary_hdu("FringeComponents", own, io.merge_metadata(self.metadata, metadata, _OWN)),
            io.image_hdu("MEAN", self.mean, unit=""),
            io.image_hdu("COMPONENTS", self.components, unit=""),
            io.mask_hdu(self.mask),
            io.bintable_hdu("SPECTRUM", spectrum),
            io.image_hdu("SCORES", self.scores, unit=""),
        ]
        return hdus

    @classmethod
    def read_fits(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `write_fits` wrote.

        Raises
        ------
        InputError
            No such file, another product, or a damaged file; the message names the file.
        """
        source = str(path)
        with io.open_fits(path, "FringeComponents") as hdus:
            header = hdus[0].header
            if "SPECTRUM" not in hdus or not isinstance(hdus["SPECTRUM"], fits.BinTableHDU):
                raise FrameFormatError("extension", "no SPECTRUM", "a binary table named SPECTRUM")
            spectrum = hdus["SPECTRUM"].data
            return cls(
                mean=io.read_image(hdus, "MEAN", source=source),
                components=io.read_image(hdus, "COMPONENTS", source=source),
                explained_variance=np.array(spectrum["explained_variance"], dtype=np.float64),
                explained_variance_ratio=np.array(spectrum["explained_variance_ratio"], dtype=np.float64),
                scores=io.read_image(hdus, "SCORES", source=source),
                mask=io.read_mask(hdus, source=source),
                detector=header.get("DETNAME", ""),
                physical_filter=header.get("FILTER", ""),
                metadata=io.read_metadata(header, _OWN),
            )


def _spectrum(name: str, values: object, number: int) -> NDArray[np.float64]:
    array = check.as_float_array(name, np.asarray(values), 1, np.float64)
    if array.size != number:
        raise FrameFormatError(name, f"{array.size} values", f"{number}, one for each component")
    if not np.isfinite(array).all() or (array < 0).any() or (np.diff(array) > 0).any():
        raise OutOfRangeError(name, array.tolist(), "finite, not negative, largest first")
    return array
