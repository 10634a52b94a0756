"""Thickness of the silicon of a sensor: what is free, what the flats can tell, and what was found."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...array_types import FloatArray
from ...effects.geometry import unit_place
from ...errors import OutOfRangeError
from ...model import FringeModel
from ...products import ThicknessMap, mask_bits


@dataclass(frozen=True)
class SiliconSearch:
    """What of the silicon is free.

    Raises `OutOfRangeError`: a degree beyond 2, or a length or probability that is not positive.
    """

    degree: int = 0  # 0 for one thickness of the whole sensor, 1 for a plane, 2 for a paraboloid
    span_um: float = 1.0  # how far the mean may lie from the thickness in the model, on both sides [µm]
    tilt_um: float = (
        0.2  # largest difference between middle and edge of the sensor, for a degree above 0 [µm]
    )
    slip_limit: float = (
        0.01  # the silicon is held fixed if its order would be wrong with a larger probability
    )

    def __post_init__(self) -> None:
        if self.degree not in (0, 1, 2):
            raise OutOfRangeError("degree of the silicon", self.degree, "0, 1 or 2")
        if not 0.0 < self.span_um <= 20.0:
            raise OutOfRangeError("span of the silicon [um]", self.span_um, "above 0, at most 20")
        if not 0.0 < self.tilt_um <= 2.0:
            raise OutOfRangeError("tilt of the silicon [um]", self.tilt_um, "above 0, at most 2")
        if not 0.0 < self.slip_limit <= 1.0:
            raise OutOfRangeError("slip limit", self.slip_limit, "above 0, at most 1")

    def terms(self, y: FloatArray, x: FloatArray) -> FloatArray:
        """Monomials 1, x, y, x², xy, y² at places of pixels, shape ``(n, n_terms)``.

        A place is -1 in the first and 1 in the last row or column: a wedge is twice its term from edge to edge.
        """
        columns = [np.ones_like(x), x, y, x * x, x * y, y * y]
        return np.stack(columns[: (1, 3, 6)[self.degree]], axis=-1)


@dataclass(frozen=True, eq=False)
class SiliconForecast:
    """What the flats can tell about the silicon."""

    sigma_um: float  # largest uncertainty of the thickness of the silicon on the sensor, from its fringes alone [µm]
    slip_probability: float  # probability that its order is wrong
    order_um: float  # thickness of one fringe order of the silicon [µm]
    # half peak to peak of its fringes in each flat, as a fraction of the level, ``(n_wavelengths,)``
    fringe: FloatArray
    decided: bool  # whether the flats decide
    reason: str  # why, or why not


@dataclass(frozen=True, eq=False)
class SiliconFit:
    """Thickness of the silicon over a sensor."""

    search: SiliconSearch  # what was free
    # of the terms of `SiliconSearch.terms`, relative to the thickness in the model [µm]; zeros if not decided,
    # ``(n_terms,)``
    coefficients: FloatArray
    # their covariance [µm²], larger by the misfit of the flats if that is above one, ``(n_terms, n_terms)``
    covariance: FloatArray
    chi2: float  # chi-square per degree of freedom of the pixels that were asked
    slip_probability: float  # probability that another order of the silicon is the right one
    forecast: SiliconForecast  # what was to be expected

    @property
    def decided(self) -> bool:
        """Whether the thickness was fitted; otherwise it is that of the model."""
        return self.forecast.decided and self.slip_probability <= self.search.slip_limit

    def offset_um(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Thickness minus that of the model at every pixel, and its uncertainty [µm]; arrays of ``shape``."""
        y, x = np.meshgrid(*(pixel_places(size) for size in shape), indexing="ij")
        terms = self.search.terms(y.ravel(), x.ravel())
        variance = np.einsum("ij,jk,ik->i", terms, self.covariance, terms)
        return (terms @ self.coefficients).reshape(shape), np.sqrt(variance).reshape(shape)

    def cards(self) -> dict[str, Any]:
        """Keywords for the header of a thickness map."""
        found: dict[str, Any] = {
            "SIFIT": self.decided,
            "SISLIP": round(self.slip_probability, 9),
            "SIORDER": round(self.forecast.order_um, 6),
            "SIWHY": self.forecast.reason[:60],
        }
        if self.decided:
            spread = np.sqrt(np.diag(self.covariance))
            for number, (value, sigma) in enumerate(zip(self.coefficients, spread, strict=True)):
                found[f"SICOEF{number}"] = round(float(value), 7)
                found[f"SISIGM{number}"] = round(float(sigma), 8)
            correlation = self.covariance / np.outer(spread, spread)
            for first, second in itertools.combinations(range(spread.size), 2):
                found[f"SICORR{first}{second}"] = round(float(correlation[first, second]), 6)
        return found


def silicon_map(fitted: ThicknessMap, model: FringeModel) -> ThicknessMap | None:
    """Thickness of the silicon on the pixels of a map that was fitted together with it; `None` if it was not decided.

    ``fitted``: map of the other layer, with the keywords of `SiliconFit.cards`.
    """
    header = fitted.metadata
    if not header.get("SIFIT"):
        return None
    count = sum(key.startswith("SICOEF") for key in header)
    coefficients, spread = (
        np.array([float(header[f"{word}{number}"]) for number in range(count)])
        for word in ("SICOEF", "SISIGM")
    )
    covariance = np.diag(spread**2)
    for first, second in itertools.combinations(range(count), 2):
        shared = float(header[f"SICORR{first}{second}"]) * spread[first] * spread[second]
        covariance[first, second] = covariance[second, first] = shared
    search = SiliconSearch({1: 0, 3: 1, 6: 2}[count])
    system, slip = model.system, float(header["SISLIP"])
    shape = (fitted.value.shape[0], fitted.value.shape[1])
    forecast = SiliconForecast(0.0, slip, float(header["SIORDER"]), np.zeros(0), True, str(header["SIWHY"]))
    found = SiliconFit(search, coefficients, covariance, 1.0, slip, forecast)
    offset, sigma = found.offset_um(shape)
    nominal = system.stack.layers[system.stack.position(system.detection)].thickness_um
    return ThicknessMap(
        value=(nominal + offset).astype(np.float32),
        sigma=sigma.astype(np.float32),
        chi2=np.zeros(shape, np.float32),
        slip_probability=np.full(shape, slip, np.float32),
        mask=fitted.mask & mask_bits("NO_DATA"),
        layer=system.detection,
        metadata={key: value for key, value in header.items() if key.startswith("SI")},
        detector=fitted.detector,
    )


def pixel_places(size: int) -> FloatArray:
    """Places of pixels, as effects of a sensor have them."""
    return unit_place(np.arange(size, dtype=float), size)
