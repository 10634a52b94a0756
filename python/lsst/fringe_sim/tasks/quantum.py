"""What the tasks share around a quantum: which sensor it is, whose failure it is, when it ran."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

from lsst.daf.butler import DataCoordinate
from lsst.pex.config import Config
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input

from ..errors import FringeSimError, InputError
from ..middleware.instruments import sensor_of
from ..model.provenance import software_cards

__all__ = [
    "SENSOR",
    "SENSOR_EXPOSURE",
    "SENSOR_FILTER",
    "OrderedConnections",
    "UnusableDataError",
    "by_exposure",
    "common_header",
    "config_digest",
    "data_id_of",
    "flats_input",
    "run_datetime",
    "sensor_of",
    "unusable",
]

SENSOR = ("instrument", "detector")
SENSOR_EXPOSURE = ("instrument", "exposure", "detector")
SENSOR_FILTER = ("instrument", "physical_filter", "detector")
"""Dimensions of what there is once for each sensor, and for each of its exposures and filters."""

_TIMESTAMP = re.compile(r"(\d{8}T\d{6})Z?$")


class UnusableDataError(base.AlgorithmError):
    """The data of one sensor cannot be used; the quanta of all others go on.

    Parameters
    ----------
    where : `str`
        Sensor, and exposure if there is one.
    reason : `~lsst.fringe_sim.errors.FringeSimError`
        What is wrong.
    """

    def __init__(self, where: str, reason: FringeSimError) -> None:
        super().__init__(f"{where}: {reason}")
        self.where = where
        self.reason = reason

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.where, self.reason)

    @property
    def metadata(self) -> dict[str, str]:
        """Sensor, kind of error, and, for a bad input, field and value."""
        found = {"where": self.where, "error": type(self.reason).__name__, "message": str(self.reason)}
        if isinstance(self.reason, InputError):
            found |= {
                "field": self.reason.field,
                "value": str(self.reason.value),
                "allowed": self.reason.allowed,
                "source": self.reason.source or "",
            }
        return found


@contextlib.contextmanager
def unusable(where: str) -> Iterator[None]:
    """Turn what the package raises on purpose into the failure of one quantum, with its sensor named."""
    try:
        yield
    except FringeSimError as error:
        raise UnusableDataError(where, error) from error


def data_id_of(butlerQC: base.QuantumContext) -> DataCoordinate:
    """Expanded data id of the quantum that runs."""
    data_id = butlerQC.quantum.dataId
    if data_id is None:
        raise AssertionError("a quantum that runs has a data id")
    return data_id


class OrderedConnections(base.PipelineTaskConnections, dimensions=()):
    """Connections of which one input has its references in order."""

    ORDERED: ClassVar[tuple[str, Callable[[Any], Any]]]  # name of that input, and what it is sorted by

    def adjustQuantum(self, inputs: Any, outputs: Any, label: str, data_id: Any) -> tuple[dict, dict]:
        """Put the references in order."""
        name, key = self.ORDERED
        connection, refs = inputs[name]
        inputs[name] = (connection, sorted(refs, key=key))
        super().adjustQuantum(inputs, outputs, label, data_id)
        return {name: inputs[name]}, {}


def by_exposure(ref: Any) -> int:
    """Number of the exposure of a dataset: the order of time."""
    return int(ref.dataId["exposure"])


def common_header(config: Config) -> dict[str, Any]:
    """Header keywords that every product of the tasks has.

    ``config``: configuration of the task; its digest goes into the header, itself is the dataset
    ``<label>_config``.
    """
    return {**software_cards(), "CFGHASH": config_digest(config)}


def config_digest(config: Config) -> str:
    """Beginning of the SHA-256 of all values of a configuration, whatever files they came from."""
    text = json.dumps(config.toDict(), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


NO_DATE = datetime.datetime(1970, 1, 1)  # Of what a model makes, where nothing tells a date


def run_datetime(run: str, otherwise: datetime.datetime = NO_DATE) -> str:
    """Date of a run, ``YYYY-MM-DDThh:mm:ss``, from the timestamp at the end of its name.

    The clock is not asked: repeating a quantum in its run gives the same bytes.

    ``run``: name of the run; ``pipetask`` ends it in ``20261121T031500Z`` unless told otherwise. ``otherwise``:
    date of a run whose name tells none.
    """
    match = _TIMESTAMP.search(run)
    found = datetime.datetime.strptime(match[1], "%Y%m%dT%H%M%S") if match else otherwise
    return found.isoformat(timespec="seconds")


def flats_input() -> Input:
    """Connection to the prepared flats of each sensor."""
    doc = "Fringe patterns of the sensor at all wavelengths."
    return Input("fringeFlat", "FringeFlat", doc, dimensions=SENSOR_EXPOSURE, multiple=True, deferLoad=True)
