"""Frames of the night sky of one sensor with its thickness: what a search for effects on the sky works on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import FloatArray
from ..errors import FrameFormatError, InputError, named_units, without_unit
from ..notebook import InNotebook
from . import _check as check
from .mask import mask_bits
from .same_light import refuse_equal_pixels, refuse_mixed_models
from .sky_frame import SkyFringe
from .thickness_map import UNKNOWN_SIGMA_UM, ThicknessMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, repr=False)
class SkyFrames(InNotebook):
    """Frames of one sensor, and its thickness.

    Parameters
    ----------
    frames : sequence of `SkyFringe`
        Frames of one size and of one sensor.
    thickness : `ThicknessMap`
        Thickness of the layer that varies, of the same size.

    Raises
    ------
    InputError
        No frames, frames of several sensors or of several models, or one frame twice.
    FrameFormatError
        Sizes that differ.
    """

    frames: Sequence[SkyFringe]
    thickness: ThicknessMap

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", tuple(self.frames))
        if not self.frames:
            raise InputError("sky frames", "none", "one frame at least")
        names = sorted({frame.detector for frame in self.frames if frame.detector})
        if len(names) > 1:
            raise InputError("detectors of the sky frames", names, "one sensor")
        refuse_mixed_models([frame.metadata for frame in self.frames])
        refuse_equal_pixels("sky frames", [frame.image for frame in self.frames])
        for frame in self.frames:
            if frame.shape != self.thickness.shape:
                allowed = f"shape {self.thickness.shape}, that of the thickness map"
                raise FrameFormatError("sky frame", f"shape {frame.shape}", allowed)

    @classmethod
    @named_units
    def from_arrays(
        cls,
        images: ArrayLike,
        thickness_um: ArrayLike,
        thickness_sigma_um: ArrayLike = UNKNOWN_SIGMA_UM,
        mask: ArrayLike | None = None,
        *,
        layer: str = "adhesive",
        hour: Any = 24.0,
        **fields: Any,
    ) -> Self:
        """Frames from plain arrays, or from arrays with astropy units.

        Parameters
        ----------
        images : array-like, shape ``(n_frames, ny, nx)``
            Sky in electrons. Pixels without a number are masked as NO_DATA.
        thickness_um, thickness_sigma_um : array-like, shape ``(ny, nx)``
            Thickness and its uncertainty [µm]; NaN where it is not known. One uncertainty is enough.
        mask : array-like, integer, optional
            Planes of `MASK_PLANES`, 0 is good: ``(ny, nx)``, or one for each frame.
        layer : `str`, optional
            Layer that the thickness is of.
        hour : array-like, optional
            Local time of each frame, in hours since the midnight before the evening.
        **fields
            Further fields of every `SkyFringe`: ``exposure_s`` (30 s by default), ``airmass`` (1.2), ``detector``,
            ``physical_filter``, ``seed`` (`None`: not simulated), ``metadata``.

        Raises
        ------
        InputError
            Shapes that do not belong together, or numbers that cannot be.
        """
        image = check.as_float_array("images", images, 3, unit="electron")
        masks = np.zeros(image.shape, np.int32) if mask is None else np.asarray(mask)
        if masks.shape == image.shape[1:]:
            masks = np.broadcast_to(masks, image.shape)
        check.check_shape("mask", masks, image.shape)
        hours = np.asarray(without_unit("hour", hour, "h"), dtype=float)
        hours = np.full(len(image), hours) if hours.ndim == 0 else hours
        check.check_shape("hour", hours, (len(image),))
        given = {"exposure_s": 30.0, "airmass": 1.2, "seed": None, "quadrature_error": 0.0, **fields}
        frames = [_frame(*item, given) for item in zip(image, masks, hours, strict=True)]
        return cls(frames, _map(thickness_um, thickness_sigma_um, layer, fields.get("detector", "")))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return self.thickness.shape

    @property
    def detector(self) -> str:
        """Name of the sensor; empty if no frame has it."""
        return next((frame.detector for frame in self.frames if frame.detector), "")

    @property
    def thickness_um(self) -> FloatArray:
        """Thickness [µm]; NaN where it is not known."""
        return self.thickness.known_um().astype(float)

    @property
    def thickness_sigma_um(self) -> FloatArray:
        """Uncertainty of the thickness [µm]."""
        return self.thickness.sigma.astype(float)

    def facts(self) -> dict[str, Any]:
        """How many frames, when, and of what."""
        hours = [frame.hour for frame in self.frames]
        return {
            "frames": len(self.frames),
            "local time": f"{min(hours):g} to {max(hours):g} h",
            "layer": self.thickness.layer,
            **self.frames[0].facts(),
        }

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the first frame."""
        return self.frames[0].plot(axes)

    def __repr__(self) -> str:
        rows, columns = self.shape
        named = f", detector={self.detector!r}" if self.detector else ""
        return f"SkyFrames({len(self.frames)} x {rows} x {columns}{named}, layer={self.thickness.layer!r})"


def _frame(image: NDArray[Any], mask: NDArray[Any], hour: float, fields: dict[str, Any]) -> SkyFringe:
    mask = np.where(np.isfinite(image), mask, mask | mask_bits("NO_DATA"))
    good = image[mask == 0]
    mean = float(good.mean(dtype=np.float64)) if good.size else 0.0
    return SkyFringe(
        image=image, mask=mask, unit="electron", hour=float(hour), **{"mean_electrons": mean, **fields}
    )


def _map(thickness: ArrayLike, sigma: ArrayLike, layer: str, detector: str) -> ThicknessMap:
    value = check.as_float_array("thickness", thickness, 2, unit="um")
    spread = np.asarray(without_unit("thickness_sigma", sigma, "um"), dtype=float)
    spread = np.full(value.shape, spread) if spread.ndim == 0 else spread
    empty = np.zeros(value.shape, np.float32)
    mask = np.where(np.isfinite(value), 0, mask_bits("NO_DATA"))
    return ThicknessMap(value, spread, empty, empty, mask, layer, detector=detector)
