"""The bias frames of a sensor, combined."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input, Output
from lsst.utils.logging import getLogger

from ..algorithms.flat_prep import combine_biases
from ..instrument.raw_frame import RawFrame
from ..products import CombinedBias
from .flat_prep_config import FlatPrepConfig
from .quantum import SENSOR, SENSOR_EXPOSURE, common_header, data_id_of, sensor_of, unusable

_LOG = getLogger(__name__)


class FringeBiasConnections(base.PipelineTaskConnections, dimensions=SENSOR):
    """Raw biases in, one combined bias out."""

    raws = Input(
        "raw",
        "RawFrame",
        "Raw frames of the sensor; those that are no biases are left aside.",
        dimensions=SENSOR_EXPOSURE,
        multiple=True,
        deferLoad=True,
    )
    bias = Output("fringeBias", "CombinedBias", "Mean bias.", dimensions=SENSOR)

    def __init__(self, *, config: FringeBiasConfig | None = None) -> None:
        if config is not None and not config.raws_limit_graph:
            self.raws = dataclasses.replace(self.raws, deferGraphConstraint=True)

    def adjustQuantum(self, inputs: Any, outputs: Any, label: str, data_id: Any) -> tuple[dict, dict]:
        """Keep the biases only."""
        connection, refs = inputs["raws"]
        biases = [ref for ref in refs if ref.dataId.records["exposure"].observation_type == "bias"]
        if not biases:
            if refs:
                _LOG.warning("%s: no bias frames of %s; its flats will not be prepared", label, data_id)
            raise base.NoWorkFound(label, "raws", connection)
        biases.sort(key=lambda ref: ref.dataId["exposure"])
        inputs["raws"] = (connection, biases)
        super().adjustQuantum(inputs, outputs, label, data_id)
        return {"raws": (connection, biases)}, {}


class FringeBiasConfig(FlatPrepConfig, base.PipelineTaskConfig, pipelineConnections=FringeBiasConnections):
    """Configuration of `FringeBiasTask`."""


class FringeBiasTask(base.PipelineTask):
    """Combine the bias frames of a sensor."""

    ConfigClass = FringeBiasConfig
    config: FringeBiasConfig
    _DefaultName = "fringeBias"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the frames one by one while they are combined."""
        detector = sensor_of(data_id_of(butlerQC))
        with unusable(detector.name):
            result = self.run((butlerQC.get(ref).get() for ref in inputRefs.raws), detector.name)
        butlerQC.put(result, outputRefs)

    def run(self, raws: Iterable[RawFrame], detector: str) -> base.Struct:
        """Combine bias frames.

        Parameters
        ----------
        raws : iterable of `RawFrame`
            Bias frames of one sensor.
        detector : `str`
            Name of the sensor.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``bias``, a `CombinedBias`.

        Raises
        ------
        InputError
            There is no frame.
        FrameFormatError
            A frame is no bias, or of another sensor or size.
        """
        bias: CombinedBias = combine_biases(self._told(raws), self.config.options())
        self.log.info("%s: %d bias frames combined", detector, bias.n_frames)
        metadata = {**common_header(self.config), **bias.metadata}
        return base.Struct(bias=dataclasses.replace(bias, detector=detector, metadata=metadata))

    def _told(self, raws: Iterable[RawFrame]) -> Iterator[RawFrame]:
        """The frames; what was taken for granted of each is said."""
        for raw in raws:
            for note in raw.metadata.notes:
                self.log.warning("bias exposure %s: %s", raw.metadata.exposure_id, note)
            yield raw
