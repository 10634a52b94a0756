"""From the flats of a sensor to the effect that its model lacks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import numpy as np

from lsst.pex.config import Field
from lsst.pipe.base import (
    InputQuantizedConnection,
    NoWorkFound,
    OutputQuantizedConnection,
    PipelineTask,
    PipelineTaskConfig,
    PipelineTaskConnections,
    QuantumContext,
    Struct,
)
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms import discover
from ..algorithms.discovery import SearchOptions, Verdict
from ..instrument.detector import Detector
from ..products import FringeCube, FringeFlat
from .model_config import FringeModelConfig, ModelChoice
from .quantum import common_header, data_id_of, sensor_of, unusable

__all__ = ["EffectDiscoveryConfig", "EffectDiscoveryConnections", "EffectDiscoveryTask"]


class EffectDiscoveryConnections(PipelineTaskConnections, dimensions=("instrument", "detector")):
    """The flats of a sensor in; a verdict, and what it means for the model of all other tasks, out."""

    flats = Input(
        doc="Fringe patterns of the sensor at all wavelengths.",
        name="fringeFlat",
        storageClass="FringeFlat",
        dimensions=("instrument", "exposure", "detector"),
        multiple=True,
        deferLoad=True,
    )
    verdict = Output(
        doc="Whether flats and model disagree, and which effect is the reason.",
        name="effectDiscovery",
        storageClass="FringeJson",
        dimensions=("instrument", "detector"),
    )
    override = Output(
        doc="Effects that were known and that were found, as an override for any task with a fringe model: "
        "-C label:FILE.",
        name="effectOverride",
        storageClass="ConfigOverride",
        dimensions=("instrument", "detector"),
    )

    def adjustQuantum(self, inputs: Any, outputs: Any, label: str, data_id: Any) -> tuple[dict, dict]:
        """A sensor without flats is no work."""
        connection, refs = inputs["flats"]
        if not refs:
            raise NoWorkFound(label, "flats", connection)
        super().adjustQuantum(inputs, outputs, label, data_id)
        return {}, {}


class EffectDiscoveryConfig(
    FringeModelConfig, PipelineTaskConfig, pipelineConnections=EffectDiscoveryConnections
):
    """Configuration of `EffectDiscoveryTask`; ``effects`` are those that are known already."""

    task_name: ClassVar[str] = "effectDiscovery"

    seed: Field[int] = Field(
        dtype=int, default=1, doc="With the number of the sensor: which parts of it are held out."
    )
    most_cells: Field[int] = Field(
        dtype=int, default=20_000, doc="Cells that the flats are averaged to, if the pattern allows it."
    )
    significance: Field[float] = Field(
        dtype=float, default=1e-3, doc="Chance of noise below which the model is held to disagree."
    )


class EffectDiscoveryTask(PipelineTask):
    """Find where model and flats of a sensor disagree, and name the missing effect."""

    ConfigClass = EffectDiscoveryConfig
    config: EffectDiscoveryConfig
    _DefaultName = "effectDiscovery"

    def runQuantum(
        self,
        butlerQC: QuantumContext,
        inputRefs: InputQuantizedConnection,
        outputRefs: OutputQuantizedConnection,
    ) -> None:
        """Read the flats one by one into a cube, search, store."""
        detector = sensor_of(data_id_of(butlerQC))
        flats = (butlerQC.get(ref).get() for ref in inputRefs.flats)
        with unusable(detector.name):
            result = self.run(flats, len(inputRefs.flats), detector)
        butlerQC.put(result, outputRefs)

    def run(self, flats: Iterable[FringeFlat], number: int, detector: Detector) -> Struct:
        """Search one sensor.

        Parameters
        ----------
        flats : iterable of `FringeFlat`
            Flats of the sensor, not smoothed.
        number : `int`
            How many they are.
        detector : `Detector`
            The sensor.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``verdict``, the layout of ``discovery.json``; ``override``, the text of a configuration override. The
            verdict names the dataset type of the override in place of a file.

        Raises
        ------
        InputError
            Flats that do not belong together, or a set-up that contradicts them.
        """
        choice = self.config.choice_of(detector)
        cube = FringeCube.from_flats(flats, number=number)
        options = SearchOptions(most_cells=self.config.most_cells, significance=self.config.significance)
        rng = np.random.default_rng([self.config.seed, detector.id])
        verdict = discover(cube, choice.model(), rng=rng, options=options, report=self._say)
        self.log.info("%s: %s", detector.name, verdict.summary())
        stated = {**common_header(self.config), **choice.header(), "SEED": self.config.seed}
        content = verdict.as_mapping(model_override=self.config.connections.override)
        return Struct(
            verdict={**content, "provenance": stated},
            override=_override(choice, verdict, detector),
        )

    def _say(self, line: str) -> None:
        self.log.verbose("%s", line)


def _override(choice: ModelChoice, verdict: Verdict, detector: Detector) -> str:
    """Override with the effects that were known before, and behind them those that were found."""
    known = "".join(f'config.effects["{key}"] = {value!r}\n' for key, value in sorted(choice.effects.items()))
    head = f"# Sensor {detector.name}.\n"
    if known:
        head += f"# Known before the search:\n{known}"
    return head + verdict.override()
