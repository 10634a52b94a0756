"""Principal components of a set of sky fringe frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..array_types import Float32Array, FloatArray
from ..errors import FrameFormatError, OutOfRangeError
from . import _check as check
from . import _fits as io
from .fits_product import DETECTOR, FILTER, MASK, Extension, FitsProduct, Image

_COLUMNS = ("explained_variance", "explained_variance_ratio")


class _Spectrum(Extension):
    """What each component explains."""

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:
        number = len(product.components)
        values = {name: _spectrum(name.upper(), getattr(product, name), number) for name in _COLUMNS}
        ratio = float(values["explained_variance_ratio"].sum())
        if ratio > 1 + 1e-6:
            raise OutOfRangeError("EXPLAINED_VARIANCE_RATIO", ratio, "at most 1 in all")
        return values

    def hdu(self, product: Any) -> fits.BinTableHDU:
        return io.bintable_hdu(self.name, [(name, getattr(product, name), None) for name in _COLUMNS])

    def read(self, hdus: fits.HDUList, source: str, native: bool) -> dict[str, Any]:
        rows = self.table(hdus, source)
        return {name: np.array(rows[name], dtype=np.float64) for name in _COLUMNS}


def _spectrum(name: str, values: object, number: int) -> FloatArray:
    array = check.as_float_array(name, np.asarray(values), 1, np.float64)
    if array.size != number:
        raise FrameFormatError(name, f"{array.size} values", f"{number}, one for each component")
    if not np.isfinite(array).all() or (array < 0).any() or (np.diff(array) > 0).any():
        raise OutOfRangeError(name, array.tolist(), "finite, not negative, largest first")
    return array


@dataclass(frozen=True, eq=False, repr=False)
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

    mean: Float32Array
    components: Float32Array
    explained_variance: FloatArray
    explained_variance_ratio: FloatArray
    scores: FloatArray
    mask: NDArray[np.int32]
    metadata: Mapping[str, Any] = field(default_factory=dict)
    detector: str = ""
    physical_filter: str = ""

    CARDS = (DETECTOR, FILTER)
    EXTENSIONS = (
        Image("mean", "MEAN", everywhere=True),
        Image("components", "COMPONENTS", ndim=3, everywhere=True),
        MASK,
        _Spectrum("explained_variance", "SPECTRUM"),
        Image("scores", "SCORES", dtype=np.float64, everywhere=True, on_sensor=False),
    )

    def _picture(self) -> tuple[NDArray[Any], str, bool]:
        return 100.0 * self.mean, "mean frame, sky / mean − 1 [%]", True

    def _check(self) -> None:
        if self.scores.shape[1] != self.n_components:
            raise FrameFormatError("SCORES", f"shape {self.scores.shape}", f"(n_frames, {self.n_components})")

    @property
    def n_components(self) -> int:
        """Number of components kept."""
        return int(self.components.shape[0])
