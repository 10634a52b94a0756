"""What a model leaves of the flats of a sensor: images of data minus model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..array_types import Float32Array, FloatArray
from ..effects import ImageGeometry, apply_to_image
from ..errors import InputError, named_units
from ..model import FringeModel
from ..products import FringeCube, ThicknessMap
from .thickness_fit import Nuisances, fit_thickness

if TYPE_CHECKING:  # the search is not needed to compare
    from .discovery import Verdict

__all__ = [
    "FlatResidual",
    "ResidualPair",
    "fit_and_compare",
    "flat_residual",
    "relative_flats",
    "residual_pair",
]


@named_units
@dataclass(frozen=True, eq=False)
class FlatResidual:
    """Flats of a sensor beside a model at its best thickness.

    Attributes
    ----------
    wavelength_nm : `numpy.ndarray`, shape ``(W,)``
        Wavelengths [nm].
    residual : `numpy.ndarray`, float32, shape ``(W, ny, nx)``
        Data minus model, each over its mean; NaN where a pixel is masked.
    thickness : `ThicknessMap`
        Thickness at which the model was taken.
    """

    wavelength_nm: FloatArray
    residual: Float32Array
    thickness: ThicknessMap

    @property
    def rms(self) -> FloatArray:
        """Root mean square of each plane, shape ``(W,)``; NaN for a plane without a good pixel."""
        squares = [np.square(plane[np.isfinite(plane)], dtype=float) for plane in self.residual]
        return np.array([np.sqrt(values.mean()) if values.size else np.nan for values in squares])


@named_units
@dataclass(frozen=True, eq=False)
class ResidualPair:
    """Flats minus model, with the unchanged model and with what was found.

    Attributes
    ----------
    before : `FlatResidual`
        Of the model without the effects found.
    after : `FlatResidual` or `None`
        Of the model with them; none where nothing was named.
    order_um : `float`
        Thickness of one fringe order [µm].
    """

    before: FlatResidual
    after: FlatResidual | None
    order_um: float


def relative_flats(cube: FringeCube) -> FloatArray:
    """Counts over their mean, minus one, whatever the unit of the cube; NaN where a pixel is masked.

    Parameters
    ----------
    cube : `FringeCube`
        Flats.

    Returns
    -------
    relative : `numpy.ndarray`, shape ``(W, ny, nx)``
    """
    relative = np.full(cube.shape, np.nan)
    for plane, (image, mask) in enumerate(zip(cube.image, cube.mask, strict=True)):
        good = (mask == 0) & np.isfinite(image)
        if good.any():
            np.divide(image, np.mean(image, where=good, dtype=float), out=relative[plane], where=good)
    relative -= 1.0
    return relative


@named_units
def flat_residual(
    cube: FringeCube,
    model: FringeModel,
    thickness_um: NDArray[np.floating],
    contrast: FloatArray | None = None,
) -> Float32Array:
    """Flats minus model at a given thickness, each plane over its mean.

    Parameters
    ----------
    cube : `FringeCube`
        Flats; masked pixels become NaN.
    model : `FringeModel`
        Its effects on light, response and image are all applied.
    thickness_um : `numpy.ndarray`, shape ``(ny, nx)``
        Thickness of the varying layer [µm]; NaN where it is not known.
    contrast : `numpy.ndarray`, shape ``(W,)``, optional
        Factor on the fringes of the model at each wavelength; 1 if not given.

    Returns
    -------
    residual : `numpy.ndarray`, float32, shape ``(W, ny, nx)``

    Raises
    ------
    InputError
        The map does not fit the cube, or no thickness is known.
    """
    thickness = np.asarray(thickness_um, dtype=float)
    if thickness.shape != cube.shape[1:]:
        raise InputError("shape of the thickness map", thickness.shape, f"{cube.shape[1:]}")
    known = np.isfinite(thickness)
    if not known.any():
        raise InputError("known pixels of the thickness map", 0, "one or more")
    filled = np.where(known, thickness, thickness[known].mean())
    wavelength = np.asarray(cube.wavelength_nm, dtype=float)
    span = float(filled.min()), float(filled.max()) + 1e-6

    def flats(own: FringeModel) -> NDArray[np.floating]:
        table = own.table(span, wavelength)
        return np.stack([table.frame(filled, row) for row in range(len(wavelength))])

    shape = (filled.shape[0], filled.shape[1])
    geometry = ImageGeometry.of_pixels(shape, wavelength, cube.level_e, cube.exposures.dark_time_s)
    image = model.with_islands(flats, geometry)
    if any(active.effect.acts_on == "image" for active in model.effects):
        level = image.mean(axis=(1, 2), keepdims=True, dtype=float)
        image = apply_to_image(model.effects, model.base_system, image / level, geometry)
    residual = np.full(cube.shape, np.nan, dtype=np.float32)
    for plane, modelled in enumerate(image):
        # Both over the mean of the same pixels.
        good = known & (cube.mask[plane] == 0)
        if good.any():
            data = np.asarray(cube.image[plane], dtype=float)[good]
            fringe = modelled[good] / modelled[good].mean(dtype=float) - 1.0
            factor = 1.0 if contrast is None else float(contrast[plane])
            residual[plane][good] = data / data.mean() - 1.0 - factor * fringe
    return residual


def fit_and_compare(cube: FringeCube, model: FringeModel) -> FlatResidual:
    """Fit the thickness, and subtract the model at it.

    Pixels whose fit is bad are kept: they are what is looked for. The fit knows the effects on light, stack and
    response, not those on the image.

    Parameters
    ----------
    cube : `FringeCube`
        Flats at four wavelengths or more.
    model : `FringeModel`
        The model.

    Raises
    ------
    InputError
        No good pixel.
    """
    fitted = fit_thickness(cube, model, nuisances=Nuisances())  # what is missing is to be seen, not learned
    residual = flat_residual(cube, model, fitted.value)
    return FlatResidual(np.asarray(cube.wavelength_nm, dtype=float), residual, fitted)


def residual_pair(cube: FringeCube, model: FringeModel, verdict: Verdict) -> ResidualPair | None:
    """Images of data minus model for the page.

    Parameters
    ----------
    cube : `FringeCube`
        The flats that were searched.
    model : `FringeModel`
        The model before the search.
    verdict : `Verdict`
        What was found.

    Returns
    -------
    residuals : `ResidualPair` or `None`
        None where the thickness cannot be fitted pixel by pixel, as with a single wavelength.
    """
    if "cell_px" not in verdict.data:
        return None  # too poor to be averaged and fitted
    try:
        before = fit_and_compare(cube, model)
        after = None
        if verdict.effects:
            after = fit_and_compare(cube, model.with_effects({**model.effect_settings, **verdict.settings}))
    except InputError:
        return None
    return ResidualPair(before, after, float(model.fringe_order_um(float(np.median(cube.wavelength_nm)))))
