"""Bandpasses without the detector: what the telescope and the air leave of a photon before the sensor.

The thin-film model computes the quantum efficiency itself, so a throughput curve that contains one must not be used
as it is (Eq. 4 of the paper; its Figure 8 counts the detector twice). A bandpass is a YAML file in
``data/bandpasses`` that names the factors of a shipped table; any filter of speclite can be used once its detector
and air are divided out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import FloatArray
from ..descriptions import described, is_file_name, read_description, read_table_of
from ..errors import (
    InputError,
    MissingPackageError,
    OutOfRangeError,
    ResourceError,
    UnknownNameError,
    named_units,
    printable_name,
)
from ..notebook import OneLine
from ..resources import list_resources, read_table, read_yaml

if TYPE_CHECKING:
    from astropy.table import Table

__all__ = ["Atmosphere", "Bandpass", "bandpass_names"]

_LEAST_DETECTOR = 1e-3  # Below this quantum efficiency (times air) a throughput cannot be divided by it


@named_units
@dataclass(frozen=True, eq=False)
class Atmosphere:
    """Transmission of the air.

    Attributes
    ----------
    wavelength_nm, transmission : `numpy.ndarray`, shape ``(K,)``
        Transmission at `reference_airmass`.
    reference_airmass : `float`
        Airmass of the table.
    scattering_depth_1000nm, scattering_exponent : `float`
        Optical depth per airmass of what is not molecular absorption (Rayleigh and aerosols), as a power law
        ``depth * (wavelength / 1000 nm)**-exponent``.
    absorption_growth : `float`
        Power of the airmass with which the optical depth of molecular bands grows: 1 for weak lines, 1/2 for
        saturated ones. 0.6 describes the water band at 935 nm.
    """

    wavelength_nm: FloatArray
    transmission: FloatArray
    reference_airmass: float
    scattering_depth_1000nm: float
    scattering_exponent: float
    absorption_growth: float = 0.6

    @named_units
    def total(self, wavelength_nm: ArrayLike, airmass: float = 1.0) -> FloatArray:
        """Transmission of scattering and absorption together, for a continuum."""
        wavelength = np.asarray(wavelength_nm, dtype=float)
        table = np.interp(wavelength, self.wavelength_nm, self.transmission)
        clear = self.scattering(wavelength, self.reference_airmass)
        growth = (_checked_airmass(airmass) / self.reference_airmass) ** self.absorption_growth
        # The power law exceeds the table by a few 1e-3 in clear windows; there the rest follows the airmass too.
        absorbed = np.minimum(table / clear, 1.0) ** growth
        return absorbed * (clear * np.maximum(table / clear, 1.0)) ** (airmass / self.reference_airmass)

    @named_units
    def scattering(self, wavelength_nm: ArrayLike, airmass: float = 1.0) -> FloatArray:
        """Transmission of scattering alone, for emission lines whose molecular absorption is known by line."""
        relative = np.asarray(wavelength_nm, dtype=float) / 1000.0
        depth = self.scattering_depth_1000nm * relative**-self.scattering_exponent
        return np.exp(-depth * _checked_airmass(airmass))


@named_units
@dataclass(frozen=True, eq=False, repr=False)
class Bandpass(OneLine):
    """Filter and optics without detector and air.

    Attributes
    ----------
    name : `str`
        Name of the bandpass, or of its filter where several bandpasses have one.
    wavelength_nm, optics : `numpy.ndarray`, shape ``(K,)``
        Transmission of mirrors, lenses, window and filter.
    detector : `numpy.ndarray`, shape ``(K,)``
        The quantum efficiency that was left out; for comparison and for zero points. Shape ``(0,)`` if not known.
    air : `Atmosphere`
        The air above the telescope.
    """

    name: str
    wavelength_nm: FloatArray
    optics: FloatArray
    detector: FloatArray
    air: Atmosphere

    @classmethod
    def from_name(cls, name: str) -> Bandpass:
        """Bandpass of ``data/bandpasses/<name>.yaml``; a name that ends in ``.yaml`` is that of a file.

        Raises
        ------
        UnknownNameError
            There is no such bandpass.
        """
        if is_file_name(name):
            return cls.from_file(name)
        if name not in bandpass_names():
            raise UnknownNameError("bandpass", name, bandpass_names())
        content = read_yaml("bandpasses", f"{name}.yaml")
        try:
            return cls._of(name, content, lambda file: read_table("sky", file))
        except KeyError as error:
            raise ResourceError(f"data/bandpasses/{name}.yaml: wrong or missing entry {error}") from error

    @classmethod
    def from_file(cls, path: str | Path) -> Bandpass:
        """Bandpass that a YAML file describes, laid out like the shipped ones; it is named after the file.

        Its tables lie beside it, or are shipped ones. Without ``detector`` the quantum efficiency is not known.

        Raises
        ------
        InputError
            There is no such file, or it does not describe a bandpass.
        """
        content = read_description(path, "bandpass")
        allowed = "every entry and column that lsst_y.yaml and its table have, but for detector and speclite"
        with described("bandpass", allowed, str(path)):
            name = printable_name("name of the bandpass", Path(path).stem)
            return cls._of(name, content, lambda file: read_table_of(path, file, "sky"))

    @classmethod
    def _of(cls, name: str, content: Mapping[str, Any], read: Callable[[str], Table]) -> Bandpass:
        table = read(content["table"])
        wavelength = np.asarray(table["wavelength"].quantity.to_value("nm"), dtype=float)
        optics = np.prod([np.asarray(table[factor], dtype=float) for factor in content["factors"]], axis=0)
        detector = np.zeros(0)
        if "detector" in content:
            detector = _detector(content["detector"], table, wavelength, read)
        air = _atmosphere(wavelength, table, content["atmosphere"])
        return cls(content.get("filter", name), wavelength, optics, detector, air)

    @classmethod
    def from_speclite(
        cls, filter_name: str, detector: tuple[ArrayLike, ArrayLike], air: Atmosphere
    ) -> Bandpass:
        """Bandpass of a speclite filter whose curve contains a detector and air.

        Parameters
        ----------
        filter_name : `str`
            Name in speclite, e.g. ``lsst2023-y``.
        detector : `tuple`
            Wavelengths [nm] and quantum efficiency that the curve contains.
        air : `Atmosphere`
            Air that the curve contains.

        Raises
        ------
        MissingPackageError
            speclite is not installed.
        UnknownNameError
            speclite has no such filter.
        InputError
            The curve transmits where the detector or the air does not.
        """
        try:
            import speclite.filters
        except ImportError as error:
            raise MissingPackageError("a filter of speclite", "speclite", "speclite") from error
        known = speclite.filters.filter_group_names
        try:
            curve = speclite.filters.load_filter(filter_name)
        except ValueError as error:
            raise UnknownNameError(
                "speclite filter", filter_name, [f"{group}-*" for group in known]
            ) from error
        wavelength = np.asarray(curve.wavelength, dtype=float) / 10.0
        response = np.asarray(curve.response, dtype=float)
        efficiency = _inside(wavelength, *detector)
        other = efficiency * air.total(wavelength, air.reference_airmass)
        usable = other > _LEAST_DETECTOR
        lost = float(response[~usable].sum() / response.sum())
        if lost > 1e-3:
            raise InputError("speclite filter", filter_name, "one that is blind where detector and air are")
        optics = np.zeros_like(response)
        np.divide(response, other, out=optics, where=usable)
        return cls(filter_name, wavelength, optics, efficiency, air)

    @named_units
    def transmission(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Transmission of everything but detector and air; zero outside the table."""
        return _inside(wavelength_nm, self.wavelength_nm, self.optics)

    @named_units
    def quantum_efficiency(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Quantum efficiency that the throughput tables assume; zero outside the table.

        Raises
        ------
        InputError
            The bandpass does not state one.
        """
        if not self.detector.size:
            raise InputError(
                "quantum efficiency", None, "a bandpass that states its detector", source=self.name
            )
        return _inside(wavelength_nm, self.wavelength_nm, self.detector)

    def support(self, threshold: float = 1e-4) -> tuple[float, float]:
        """Wavelengths between which the transmission exceeds ``threshold`` times its maximum [nm]."""
        inside = np.flatnonzero(self.optics > threshold * self.optics.max())
        last = self.wavelength_nm.size - 1
        return (
            float(self.wavelength_nm[max(inside[0] - 1, 0)]),
            float(self.wavelength_nm[min(inside[-1] + 1, last)]),
        )


def bandpass_names() -> tuple[str, ...]:
    """Names of the shipped bandpasses."""
    return tuple(entry.removesuffix(".yaml") for entry in list_resources("bandpasses"))


def _detector(content: Any, table: Table, wavelength: FloatArray, read: Callable[[str], Table]) -> FloatArray:
    """Quantum efficiency: a column of the table of the optics, or the product of columns of a table of its own."""
    if isinstance(content, str):
        return np.asarray(table[content], dtype=float)
    own = read(content["table"])
    factors = [np.asarray(own[name], dtype=float) for name in content["columns"]]
    nodes = own["wavelength"].quantity.to_value("nm")
    return np.interp(wavelength, np.asarray(nodes, dtype=float), np.prod(factors, axis=0))


def _atmosphere(wavelength: FloatArray, table: Mapping[str, Any], content: Mapping[str, Any]) -> Atmosphere:
    return Atmosphere(
        wavelength,
        np.asarray(table[content["column"]], dtype=float),
        float(content["airmass"]),
        float(content["scattering_depth_1000nm"]),
        float(content["scattering_exponent"]),
    )


def _inside(wavelength_nm: ArrayLike, nodes_nm: ArrayLike, values: ArrayLike) -> FloatArray:
    """Linear interpolation that is zero outside the nodes."""
    wavelength, nodes, at_nodes = (
        np.asarray(array, dtype=float) for array in (wavelength_nm, nodes_nm, values)
    )
    return np.asarray(np.interp(wavelength, nodes, at_nodes, left=0.0, right=0.0))


def _checked_airmass(airmass: float) -> float:
    if not 1.0 <= airmass < 10.0 or math.isnan(airmass):
        raise OutOfRangeError("airmass", airmass, "1 to below 10")
    return float(airmass)
