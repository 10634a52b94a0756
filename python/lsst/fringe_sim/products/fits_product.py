"""What all products have in common: they are written as one FITS file."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from . import _fits as io
from .sensor_section import SensorSection

__all__ = ["FitsProduct"]


class FitsProduct(ABC):
    """A product that a FITS file can hold; the class says which extensions."""

    def write_fits(
        self,
        path: str | os.PathLike[str],
        metadata: Mapping[str, Any] | None = None,
        *,
        section: SensorSection | None = None,
    ) -> None:
        """Write the product with checksums, repeatable to the byte.

        Parameters
        ----------
        path : path-like
            File to write; an existing one is replaced when the new one is complete.
        metadata : `Mapping`, optional
            Further header keywords, which win over those of the product.
        section : `SensorSection`, optional
            Pixels of the sensor that the images show; their world coordinates are written with them.

        Raises
        ------
        InputError
            The folder does not exist, or a keyword that no header can hold.
        """
        io.write_hdus(path, self._hdus(metadata), section)

    @abstractmethod
    def _hdus(self, metadata: Mapping[str, Any] | None) -> list[Any]:
        """Primary HDU and extensions; ``metadata`` as for `write_fits`."""
