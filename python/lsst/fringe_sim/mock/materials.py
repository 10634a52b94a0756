"""Complex index of the materials of a stack, interpolated without the code of the fitting model.

References: Green 2008, Franta et al. 2017 (silicon and its temperature dependence).
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from ..array_types import ComplexArray, FloatArray
from ..descriptions import read_table_of
from ..errors import OutOfRangeError, UnknownNameError
from ..resources import read_table, read_user_yaml, read_yaml

GREEN_TEMPERATURE_K = 300.0


EXTINCTION_FLOOR = 1e-12


COLD_RANGE_NM = (300.0, 1200.0)  # Wavelengths at which silicon was measured cold (Franta et al. 2017) [nm].


def material_index(
    medium: str, wavelength_nm: FloatArray, temperature_k: float, media: str = ""
) -> ComplexArray:
    """Complex index of a material; ``n`` by cubic spline, ``log k`` by monotone cubic.

    Parameters
    ----------
    medium : `str`
        Name in ``data/media/media.yaml``, or in a file laid out like it.
    wavelength_nm : `numpy.ndarray`
        Wavelength in vacuum [nm].
    temperature_k : `float`
        Temperature [K].
    media : `str`, optional
        That file.

    Raises
    ------
    UnknownNameError
        There is no such material.
    OutOfRangeError
        A wavelength at which it is not tabulated.
    """
    curve, low, high = _material(medium, media)
    if not (np.min(wavelength_nm) >= low and np.max(wavelength_nm) <= high):
        found = (float(np.min(wavelength_nm)), float(np.max(wavelength_nm)))
        raise OutOfRangeError(f"wavelength [nm] in {medium}", found, f"{low:g} to {high:g}")
    return curve(wavelength_nm, temperature_k)


_Curve = Callable[[FloatArray, float], ComplexArray]


@functools.lru_cache(maxsize=64)
def _material(medium: str, media: str) -> tuple[_Curve, float, float]:
    own = read_user_yaml(media, "media file") if media else {}
    entries = {**read_yaml("media", "media.yaml"), **own}
    if medium not in entries:
        raise UnknownNameError("medium", medium, entries)
    entry = entries[medium]
    if "constant" in entry:
        constant = complex(*entry["constant"])
        low, high = entry["range_nm"]
        return lambda wavelength, _: np.full(wavelength.shape, constant), float(low), float(high)
    named = entry["table"]
    table = read_table_of(media, named, "media") if medium in own else read_table("media", named)
    nodes = table["wavelength"].quantity.to_value("nm")
    first, second = entry.get("columns", ("n", "k"))
    n_curve = CubicSpline(nodes, table[first])
    extinction = np.asarray(table[second], dtype=float)
    log_k = PchipInterpolator(nodes, np.log(np.maximum(extinction, EXTINCTION_FLOOR)))
    transparent = not np.any(extinction > 0.0)
    kind = entry.get("temperature", "")
    measured_k = float(entry.get("measured_at_k", GREEN_TEMPERATURE_K))

    def curve(wavelength: FloatArray, temperature_k: float) -> ComplexArray:
        n = n_curve(wavelength)
        k = np.zeros(wavelength.shape) if transparent else np.exp(log_k(wavelength))
        if kind == "franta2017":
            cold_k = min(temperature_k, GREEN_TEMPERATURE_K)
            now, then = (_cold_silicon(wavelength, each) for each in (cold_k, measured_k))
            n, k = n + now[0] - then[0], k * now[1] / then[1]
        if kind == "green2008" or (kind and temperature_k > GREEN_TEMPERATURE_K):
            exponent = _green_exponents(wavelength)
            n, k = (
                each * (temperature_k / GREEN_TEMPERATURE_K) ** power
                for each, power in zip((n, k), exponent, strict=True)
            )
        return n + 1j * k

    ends = nodes if kind != "franta2017" else np.clip(nodes, *COLD_RANGE_NM)
    return curve, float(ends[0]), float(ends[-1])


def _green_exponents(wavelength_nm: FloatArray) -> list[FloatArray]:
    """Exponents of T / 300 K in n and k of silicon."""
    table = read_table("media", "nk_Si_green2008.ecsv")
    nodes = table["wavelength"].quantity.to_value("nm")
    return [
        PchipInterpolator(nodes, table[name])(wavelength_nm) * 1e-4 * GREEN_TEMPERATURE_K
        for name in ("C_n", "C_k")
    ]


def _cold_silicon(wavelength_nm: FloatArray, temperature_k: float) -> tuple[FloatArray, FloatArray]:
    """Index and extinction of silicon that was measured cold: polynomials in temperature through the nodes."""
    table = read_table("media", "nk_Si_franta2017_T.ecsv")
    nodes = table["wavelength"].quantity.to_value("nm")
    kelvin = np.arange(100.0, 301.0, 50.0)
    columns = {part: [np.asarray(table[f"{part}_{t:.0f}K"], dtype=float) for t in kelvin] for part in "nk"}
    n = np.stack([CubicSpline(nodes, each)(wavelength_nm) for each in columns["n"]])
    log_k = np.stack([PchipInterpolator(nodes, np.log(each))(wavelength_nm) for each in columns["k"]])
    at = 0.02 * (temperature_k - 200.0)
    powers = np.linalg.solve(np.vander(0.02 * (kelvin - 200.0)).T, at ** np.arange(4, -1, -1))
    return np.asarray(powers @ n), np.exp(powers @ log_k)
