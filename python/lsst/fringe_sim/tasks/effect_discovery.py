"""From the flats of a sensor, or from frames of the sky, to the effect that its model lacks."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from lsst.pex.config import Config, Field, FieldValidationError
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms import discover
from ..algorithms.discovery import SKY_SEARCH, SearchOptions, Verdict, discover_sky, placement_in_frames
from ..algorithms.discovery.skeleton import learned_files
from ..instrument.detector import Detector
from ..model.effects_override import effects_override
from ..products import FringeCube, FringeFlat, SkyFringe, ThicknessMap
from .model_config import FringeModelConfig, ModelChoice
from .quantum import SENSOR, SENSOR_EXPOSURE, common_header, data_id_of, flats_input, sensor_of, unusable
from .sky_model import MapConnections, SkyModelConfig


class EffectDiscoveryConnections(base.PipelineTaskConnections, dimensions=SENSOR):
    """The flats of a sensor in; a verdict, and what it means for the model of all other tasks, out."""

    flats = flats_input()
    verdict = Output(
        "effectDiscovery",
        "FringeJson",
        "Whether flats and model disagree, and which effect is the reason.",
        dimensions=SENSOR,
    )
    override = Output(
        "effectOverride",
        "ConfigOverride",
        "Effects that were known and that were found, as an override for any task with a fringe model: -C "
        "label:FILE.",
        dimensions=SENSOR,
    )
    learned = Output(
        "learnedOverride",
        "ConfigOverride",
        "A correction that was learned from what no effect explains, as an override; nothing where none is "
        "believed.",
        dimensions=SENSOR,
    )
    learned_effect = Output(
        "learnedEffect",
        "ConfigOverride",
        "The beginning of an effect that does what was learned, for --effects-from; nothing where none is "
        "believed.",
        dimensions=SENSOR,
    )


class SearchConfig(Config):
    """How hard a search looks."""

    seed = Field[int](default=1, doc="With the number of the sensor: which parts of it are held out.")
    most_cells = Field[int](
        default=20_000, doc="Cells that the images are averaged to, if the pattern allows it."
    )
    significance = Field[float](
        default=1e-3, doc="Chance of noise below which the model is held to disagree."
    )
    time_budget_s = Field[float](
        default=None,
        optional=True,
        doc="Time for one sensor [s], after which the best answer so far is given; by default as long as it takes.",
    )

    model_accuracy = Field[float](
        default=SearchOptions().model_accuracy,
        doc="Part of the fringes by which the model may be wrong; by default as the tables of silicon.",
    )

    def options(self, usual: SearchOptions) -> SearchOptions:
        """The same for the algorithm, which has its usual ones."""
        budget = math.inf if self.time_budget_s is None else self.time_budget_s
        return replace(
            usual,
            most_cells=self.most_cells,
            significance=self.significance,
            time_budget_s=budget,
            model_accuracy=self.model_accuracy,
        )

    def rng(self, detector: Detector) -> np.random.Generator:
        """Random numbers of a sensor."""
        return np.random.default_rng([self.seed, detector.id])


class EffectDiscoveryConfig(
    SearchConfig, FringeModelConfig, base.PipelineTaskConfig, pipelineConnections=EffectDiscoveryConnections
):
    """Configuration of `EffectDiscoveryTask`; ``effects`` are those that are known already."""

    task_name: ClassVar[str] = "effectDiscovery"


class EffectDiscoveryTask(base.PipelineTask):
    """Find where model and flats of a sensor disagree, and name the missing effect."""

    ConfigClass = EffectDiscoveryConfig
    config: EffectDiscoveryConfig
    _DefaultName = "effectDiscovery"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the flats one by one into a cube, search, store."""
        detector = sensor_of(data_id_of(butlerQC))
        flats = (butlerQC.get(ref).get() for ref in inputRefs.flats)
        with unusable(detector.name):
            result = self.run(flats, len(inputRefs.flats), detector)
        butlerQC.put(result, outputRefs)

    def run(self, flats: Iterable[FringeFlat], number: int, detector: Detector) -> base.Struct:
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
            verdict names the dataset type of the override in place of a file. ``learned`` and ``learned_effect`` are
            the texts of ``learned.py`` and ``learned_effect.py``; `None` without a correction that is believed.

        Raises
        ------
        InputError
            Flats that do not belong together, or a set-up that contradicts them.
        """
        choice = self.config.choice_of(detector)
        cube = FringeCube.from_flats(flats, number=number)
        verdict = discover(
            cube,
            choice.model(),
            rng=self.config.rng(detector),
            options=self.config.options(SearchOptions()),
            report=functools.partial(self.log.verbose, "%s"),
        )
        self.log.info("%s: %s", detector.name, verdict.summary())
        learned = learned_files(verdict, detector.name)
        return base.Struct(
            learned=learned.get("learned.py"),
            learned_effect=learned.get("learned_effect.py"),
            **_stored(self.config, choice, verdict, detector).getDict(),
        )


class SkyEffectDiscoveryConnections(base.PipelineTaskConnections, dimensions=SENSOR):
    """Frames of the sky and the thickness of a sensor in; a verdict, and an override with what was found, out."""

    frames = Input(
        "skyFringe",
        "SkyFringe",
        "Frames of the night sky, not corrected for fringes, whose headers state the OH bands.",
        dimensions=SENSOR_EXPOSURE,
        multiple=True,
        deferLoad=True,
    )
    thickness = MapConnections.thickness
    verdict = Output(
        "skyEffectDiscovery",
        "FringeJson",
        "Whether the sky and the model disagree, and which effect is the reason.",
        dimensions=SENSOR,
    )
    override = Output(
        "skyEffectOverride",
        "ConfigOverride",
        "Effects that were known and that were found, as an override for any task with a fringe model: -C "
        "label:FILE.",
        dimensions=SENSOR,
    )


class SkyEffectDiscoveryConfig(
    SearchConfig, SkyModelConfig, base.PipelineTaskConfig, pipelineConnections=SkyEffectDiscoveryConnections
):
    """Configuration of `SkyEffectDiscoveryTask`; ``effects`` are those that are known already."""

    task_name: ClassVar[str] = "skyEffectDiscovery"

    def validate(self) -> None:
        """A search needs the thickness of its sensor."""
        super().validate()
        if self.stand_in:
            raise FieldValidationError(SkyModelConfig.stand_in, self, "a search needs the map of the sensor")


class SkyEffectDiscoveryTask(base.PipelineTask):
    """Find where model and sky of a sensor disagree, and name the missing effect."""

    ConfigClass = SkyEffectDiscoveryConfig
    config: SkyEffectDiscoveryConfig
    _DefaultName = "skyEffectDiscovery"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read frames and map, search, store."""
        detector = sensor_of(data_id_of(butlerQC))
        frames = [butlerQC.get(ref).get() for ref in inputRefs.frames]
        with unusable(detector.name):
            result = self.run(frames, butlerQC.get(inputRefs.thickness), detector)
        butlerQC.put(result, outputRefs)

    def run(self, frames: Sequence[SkyFringe], thickness: ThicknessMap, detector: Detector) -> base.Struct:
        """Search one sensor.

        Parameters
        ----------
        frames : sequence of `SkyFringe`
            Frames of the sensor, with the intensity of the OH bands in their headers.
        thickness : `ThicknessMap`
            Its thickness, fitted to flats of the laboratory.
        detector : `Detector`
            The sensor; its place in the focal plane decides the beams.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``verdict`` and ``override``, as of `EffectDiscoveryTask`.

        Raises
        ------
        InputError
            Frames that do not belong together, are corrected already, or do not state the OH bands; a map of another
            layer or shape.
        """
        choice = self.config.choice_of(detector)
        layer = self.config.map_of(thickness, detector)
        known = layer.known_um()
        sky_model = self.config.sky_model(
            detector, float(np.mean([frame.airmass for frame in frames])), known, layer.metadata
        )
        model = sky_model.fringe_model()
        verdict = discover_sky(
            frames,
            known,
            layer.sigma,
            model,
            rng=self.config.rng(detector),
            sky=sky_model.spectrum(),
            placement=placement_in_frames(frames, detector, model.setup.pixel_scale_arcsec),
            options=self.config.options(SKY_SEARCH),
            report=functools.partial(self.log.verbose, "%s"),
        )
        self.log.info("%s: %s", detector.name, verdict.summary())
        return _stored(self.config, choice, verdict, detector)


def _stored(
    config: EffectDiscoveryConfig | SkyEffectDiscoveryConfig,
    choice: ModelChoice,
    verdict: Verdict,
    detector: Detector,
) -> base.Struct:
    """Verdict and override as they are stored."""
    stated = {**common_header(config), **choice.header(), "SEED": config.seed}
    content = verdict.as_mapping(model_override=config.connections.override)
    return base.Struct(
        verdict={**content, "provenance": stated}, override=_override(choice, verdict, detector)
    )


def _override(choice: ModelChoice, verdict: Verdict, detector: Detector) -> str:
    """Override with the effects that were known before, and behind them those that were found."""
    return effects_override(
        verdict.settings,
        verdict.setup,
        verdict.verdict,
        known=dict(sorted(choice.effects.items())),
        detector=detector.name,
    )
