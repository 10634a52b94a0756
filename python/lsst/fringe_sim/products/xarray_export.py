"""Products as `xarray.Dataset`: named axes, coordinates with units, keywords as attributes.

xarray is an extra of the package (``pip install 'lsst-fringe-sim[xarray]'``); nothing else needs it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, MissingPackageError, UnknownNameError
from ..files import all_or_nothing
from ..resources import open_user_fits, refuse_damage
from ._fits import PRODUCT_KEY, existing_folder
from .fringe_cube import FringeCube
from .mask import MASK_PLANES
from .sensor_section import section_pixels
from .sky_frame import SkyFringe
from .thickness_map import ThicknessMap

if TYPE_CHECKING:
    import xarray

__all__ = ["EXPORTED", "read_exported", "to_xarray", "write_netcdf"]

_Variable = tuple[tuple[str, ...], Any, dict[str, Any]]


def to_xarray(product: ThicknessMap | FringeCube | SkyFringe) -> xarray.Dataset:
    """A product as an `xarray.Dataset`.

    Parameters
    ----------
    product : `ThicknessMap`, `FringeCube` or `SkyFringe`
        The product. Its images are not copied, and cannot be written through the data set.

    Returns
    -------
    dataset : `xarray.Dataset`
        Images with the dimensions ``y`` and ``x``, those of a cube also with ``wavelength``. The coordinates ``y``
        and ``x`` are pixels of the sensor from 0 where the product says what it shows, else pixels of the image;
        ``wavelength`` [nm] has the bandwidth [nm], temperature [K], focal ratio and level [electron] of each plane
        beside it. A sky frame has its hour [h], exposure time [s] and airmass as scalar coordinates, so that
        ``xarray.concat(frames, "hour")`` joins a night. Every variable has ``units`` and ``long_name``, masks
        the names of their planes. Header keywords are attributes.

    Raises
    ------
    MissingPackageError
        xarray is not installed.
    InputError
        Another product.
    """
    build = _BUILDERS.get(type(product))
    if build is None:
        known = ", ".join(cls.__name__ for cls in _BUILDERS)
        raise InputError("product", type(product).__name__, f"one of {known}")
    xr = _xarray()
    variables, coordinates = build(product)
    shape = product.mask.shape[-2:]
    rows, columns = section_pixels((shape[0], shape[1]), product.metadata)
    coordinates |= {
        "y": _variable(("y",), rows, "pixel", "row, upwards, of the sensor"),
        "x": _variable(("x",), columns, "pixel", "column of the sensor"),
    }
    attributes = {"product": type(product).__name__, "detector": product.detector}
    return xr.Dataset(variables, coordinates, {**product.metadata, **attributes})


def write_netcdf(dataset: xarray.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a data set as a NetCDF 3 file, which needs no library beyond scipy; all or nothing.

    Parameters
    ----------
    dataset : `xarray.Dataset`
        Result of `to_xarray`. Keywords without a value are left out, truth values become 0 and 1.
    path : path-like
        File to write; an existing one is replaced when the new one is complete.

    Raises
    ------
    InputError
        The folder does not exist.
    """
    target = existing_folder(path)
    attributes = {
        key: int(value) if isinstance(value, bool) else value
        for key, value in dataset.attrs.items()
        if value is not None
    }
    plain = dataset.copy(deep=False)
    plain.attrs = attributes
    with all_or_nothing(target) as temporary:
        plain.to_netcdf(temporary, engine="scipy", format="NETCDF3_64BIT")


def read_exported(path: str | os.PathLike[str]) -> ThicknessMap | FringeCube | SkyFringe:
    """Read whichever of the products that `to_xarray` takes a file holds.

    Raises
    ------
    InputError
        No such file, or a damaged one.
    UnknownNameError
        Another product; the file is named.
    """
    source = str(path)
    if not Path(path).is_file():
        raise InputError("file", source, "an existing FITS file")
    with refuse_damage("FITS file", "an undamaged FITS file", source), open_user_fits(path) as hdus:
        # A cube from elsewhere does not say what it is.
        name = hdus[0].header.get(PRODUCT_KEY) or ("FringeCube" if "EXPOSURES" in hdus else "")
    if name not in EXPORTED:
        raise UnknownNameError(PRODUCT_KEY, name, EXPORTED, source=source)
    found: ThicknessMap | FringeCube | SkyFringe = EXPORTED[name].read_fits(path)
    return found


def _xarray() -> Any:
    try:
        import xarray
    except ImportError:
        raise MissingPackageError("a data set of xarray", "xarray", "xarray") from None
    return xarray


def _variable(dims: tuple[str, ...], values: ArrayLike, units: str, long_name: str) -> _Variable:
    return dims, values, {"units": units, "long_name": long_name}


def _mask(dims: tuple[str, ...], values: NDArray[Any]) -> _Variable:
    """Mask with the attributes by which the CF conventions name the bits of a flag."""
    bits = np.array([1 << bit for bit in MASK_PLANES.values()], values.dtype)
    return (
        dims,
        values,
        {
            "units": "1",
            "long_name": "mask; 0 is good",
            "flag_masks": bits,
            "flag_meanings": " ".join(MASK_PLANES),
        },
    )


def _of_thickness(product: Any) -> tuple[dict[str, _Variable], dict[str, _Variable]]:
    image = ("y", "x")
    variables = {
        "thickness": _variable(image, product.value, "um", f"thickness of {product.layer}"),
        "sigma": _variable(image, product.sigma, "um", "standard uncertainty of the thickness"),
        "chi2": _variable(image, product.chi2, "1", "chi-square per degree of freedom"),
        "slip_probability": _variable(
            image, product.slip_probability, "1", "probability of a wrong fringe order"
        ),
        "mask": _mask(image, product.mask),
    }
    variables["thickness"][2]["layer"] = product.layer
    if product.n_wavelengths is not None:
        variables["n_wavelengths"] = _variable(image, product.n_wavelengths, "1", "wavelengths of the fit")
    return variables, {}


def _of_cube(product: Any) -> tuple[dict[str, _Variable], dict[str, _Variable]]:
    dims = ("wavelength", "y", "x")
    unit, squared = (("electron", "electron2"), ("1", "1"))[product.unit == "relative"]
    image = "counts" if product.unit == "electron" else "counts over their mean"
    variables = {
        "image": _variable(dims, product.image, unit, image),
        "variance": _variable(dims, product.variance, squared, "variance of the image"),
        "mask": _mask(dims, product.mask),
    }
    for name, values in (("thickness", product.thickness), ("thickness_sigma", product.thickness_sigma)):
        if values is not None:
            variables[name] = _variable(("y", "x"), values, "um", f"{name} of {product.layer}")
            variables[name][2]["layer"] = product.layer
    rows, plane = product.exposures, ("wavelength",)
    return variables, {
        "wavelength": _variable(plane, rows.wavelength_nm, "nm", "wavelength in vacuum"),
        "bandwidth_fwhm": _variable(plane, rows.bandwidth_fwhm_nm, "nm", "full width at half maximum"),
        "temperature": _variable(plane, rows.temperature_k, "K", "temperature of the sensor"),
        "f_number": _variable(plane, rows.f_number, "1", "focal ratio; infinite: collimated"),
        "level": _variable(plane, rows.level_e, "electron", "mean level; 0: not known"),
        "dark_time": _variable(plane, rows.dark_time_s, "s", "time of gathering charge; 0: not known"),
    }


def _of_sky(product: Any) -> tuple[dict[str, _Variable], dict[str, _Variable]]:
    image = ("y", "x")
    unit = "electron" if product.unit == "electron" else "1"
    name = "sky" if product.unit == "electron" else "(sky - mean) / mean"
    variables = {
        "image": _variable(image, product.image, unit, name),
        "mask": _mask(image, product.mask),
        "mean": _variable((), product.mean_electrons, "electron", "mean sky"),
        "quadrature_error": _variable(
            (), product.quadrature_error, "1", "error of the sums over the mean sky"
        ),
    }
    coordinates = {
        "hour": _variable((), product.hour, "h", "local time since the midnight before the evening"),
        "exposure_time": _variable((), product.exposure_s, "s", "exposure time"),
        "airmass": _variable((), product.airmass, "1", "airmass"),
    }
    if product.physical_filter:
        coordinates["physical_filter"] = _variable((), product.physical_filter, "", "filter")
        del coordinates["physical_filter"][2]["units"]
    if product.seed is not None:
        variables["image"][2]["seed"] = product.seed
    return variables, coordinates


_BUILDERS: Mapping[type, Callable[[Any], tuple[dict[str, _Variable], dict[str, _Variable]]]] = {
    ThicknessMap: _of_thickness,
    FringeCube: _of_cube,
    SkyFringe: _of_sky,
}

EXPORTED: Mapping[str, Any] = {cls.__name__: cls for cls in _BUILDERS}
"""Products that `to_xarray` takes, by name."""
