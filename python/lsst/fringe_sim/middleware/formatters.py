"""How datasets lie in files: FITS for arrays, JSON for verdicts, Python for overrides. No pickle."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from lsst.daf.butler import DataCoordinate, DatasetProvenance, FormatterV2
from lsst.resources import ResourcePath

from ..errors import InputError, UnknownNameError
from ..instrument.raw_frame import RawFrame, read_raw_metadata
from ..products import FringeFrame, SensorSection
from .afw import read_exposure
from .instruments import sensor_of

PROVENANCE_PREFIX = "LSST BUTLER"
"""Start of the header keywords that say from which datasets a product was made, as in other Rubin images."""

MOST_INPUTS_IN_HEADER = 1000  # With more inputs than this only their number is written

LONGEST_RUN_IN_HEADER = 60
"""Names of runs beyond this length would need continued cards under long keywords, which not every reader takes."""


class FitsProductFormatter(FormatterV2):
    """Reads and writes any product that has ``read_fits`` and ``write_fits``.

    The class comes from the storage class of the dataset. Identifiers of the inputs go into the primary header.
    """

    default_extension = ".fits"
    supported_extensions = frozenset({".fits"})
    can_read_from_local_file = True

    _provenance: Mapping[str, Any] | None = None

    def read_from_local_file(self, path: str, component: str | None = None, expected_size: int = -1) -> Any:
        """Read the product."""
        product: Any = self.file_descriptor.storageClass.pytype
        return product.read_fits(path)

    def write_local_file(self, in_memory_dataset: Any, uri: ResourcePath) -> None:
        """Write the product, with the provenance and the world coordinates of its sensor in the headers."""
        section = _section_of(in_memory_dataset, self.data_id)
        in_memory_dataset.write_fits(uri.ospath, metadata=self._provenance, section=section)

    def add_provenance(
        self, in_memory_dataset: Any, /, *, provenance: DatasetProvenance | None = None
    ) -> Any:
        """Keep the provenance until the file is written; that of an earlier file is taken out of the product."""
        self._provenance = _provenance_cards(provenance or DatasetProvenance(), self.dataset_ref)
        metadata = in_memory_dataset.metadata
        own = {key: value for key, value in metadata.items() if not key.startswith(PROVENANCE_PREFIX)}
        if len(own) == len(metadata):
            return in_memory_dataset
        return dataclasses.replace(in_memory_dataset, metadata=own)


def _section_of(product: Any, data_id: DataCoordinate) -> SensorSection | None:
    """Pixels of the sensor that a product shows; `None` where its sensor or its place there are not known."""
    try:
        detector = sensor_of(data_id)
    except (UnknownNameError, KeyError):
        return None
    shape = product.mask.shape[-2:]
    return SensorSection.of_image(detector, shape, product.metadata)


def _provenance_cards(provenance: DatasetProvenance, ref: Any) -> dict[str, Any]:
    """Header cards that name the dataset, its quantum and its inputs."""
    flat = provenance.to_flat_dict(
        ref, prefix=PROVENANCE_PREFIX, sep=" ", simple_types=True, max_inputs=MOST_INPUTS_IN_HEADER
    )
    return {
        keyword: str(value)[:LONGEST_RUN_IN_HEADER] if keyword.endswith(" RUN") else value
        for keyword, value in flat.items()
    }


class FringeFrameFormatter(FitsProductFormatter):
    """Reads a fringe frame as it is, or as an afw exposure if that is asked for."""

    def can_accept(self, in_memory_dataset: Any) -> bool:
        """Whether the dataset can be written without being converted first.

        True for a `FringeFrame` even where the dataset type is ``ExposureF``: the file is the same.
        """
        return isinstance(in_memory_dataset, FringeFrame)

    def read_from_local_file(self, path: str, component: str | None = None, expected_size: int = -1) -> Any:
        """Read a `FringeFrame`, or an ``ExposureF`` if the caller asked for one."""
        descriptor = self.file_descriptor
        wanted = descriptor.readStorageClass or descriptor.storageClass
        if wanted.name.startswith("Exposure"):
            return read_exposure(path)
        return FringeFrame.read_fits(path)


class RawFrameFormatter(FormatterV2):
    """Reads raw frames in the LSST layout, or their metadata alone. Raw frames are never written."""

    default_extension = ".fits"
    supported_extensions = frozenset({".fits", ".fits.gz", ".fits.fz", ".fz"})
    can_read_from_local_file = True

    def read_from_local_file(self, path: str, component: str | None = None, expected_size: int = -1) -> Any:
        """Read the frame, or its metadata without its pixels."""
        return read_raw_metadata(path) if component == "metadata" else RawFrame.read(path)


class StrictJsonFormatter(FormatterV2):
    """Reads and writes mappings as JSON that every reader takes: no NaN, no infinity, UTF-8."""

    default_extension = ".json"
    supported_extensions = frozenset({".json"})
    can_read_from_uri = True

    def read_from_uri(self, uri: ResourcePath, component: str | None = None, expected_size: int = -1) -> Any:
        """Read the mapping."""
        return json.loads(uri.read())

    def to_bytes(self, in_memory_dataset: Any) -> bytes:
        """Serialise the mapping.

        `InputError`: it holds a number that is not finite, or something that JSON does not know.
        """
        try:
            text = json.dumps(in_memory_dataset, allow_nan=False, ensure_ascii=False, indent=2)
        except (TypeError, ValueError) as error:
            raise InputError("content", str(error), "finite numbers, text, lists and mappings") from None
        return f"{text}\n".encode()


class ConfigOverrideFormatter(FormatterV2):
    """Reads and writes the text of a configuration override as it is. Reading executes nothing."""

    default_extension = ".py"
    supported_extensions = frozenset({".py"})
    can_read_from_uri = True

    def read_from_uri(self, uri: ResourcePath, component: str | None = None, expected_size: int = -1) -> Any:
        """Read the text."""
        return uri.read().decode("utf-8")

    def to_bytes(self, in_memory_dataset: Any) -> bytes:
        """The text in UTF-8."""
        return str(in_memory_dataset).encode("utf-8")
