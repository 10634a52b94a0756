"""From the observed frames of a sensor to the templates that remove their fringes."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from typing import Any

from lsst.pex.config import Config, Field
from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms.correction import AMPLIFIERS_UNKNOWN, AmplifierGrid
from ..algorithms.correction.empirical import TemplateOptions
from ..algorithms.observed_frames import make_templates
from ..products import ObservedFrame
from .quantum import (
    SENSOR_EXPOSURE,
    SENSOR_FILTER,
    OrderedConnections,
    by_exposure,
    common_header,
    data_id_of,
    run_datetime,
    sensor_of,
    unusable,
)

LEAST_FRAMES = 3


class ObservedFringeConnections(OrderedConnections, dimensions=SENSOR_FILTER):
    """The frames of a sensor in a filter in, its templates out."""

    frames = Input(
        "post_isr_image",
        "ObservedFrame",
        "Frames after the removal of the instrument's signature, with their fringes.",
        dimensions=SENSOR_EXPOSURE,
        multiple=True,
        minimum=LEAST_FRAMES,
        deferLoad=True,
    )
    templates = Output(
        "fringeTemplates",
        "FringeTemplates",
        "Fringe templates with variance and coverage.",
        dimensions=SENSOR_FILTER,
        isCalibration=True,
    )
    ORDERED = ("frames", by_exposure)


class BackgroundConfig(Config):
    """What is fitted beside the fringes."""

    background_px = Field[float](
        default=256.0,
        doc="Distance between the knots of the smooth background [px].",
        check=lambda value: value >= 8.0,
    )
    amplifier_columns = Field[int](
        optional=True,
        doc="Amplifiers beside each other; where neither number is given, a frame tells whether their levels differ.",
        check=lambda n: n > 0,
    )
    amplifier_rows = Field[int](optional=True, doc="Amplifiers on top of each other.", check=lambda n: n > 0)

    @property
    def grid(self) -> AmplifierGrid:
        """Amplifiers with levels of their own."""
        rows, columns = self.amplifier_rows, self.amplifier_columns
        if rows is None and columns is None:
            return AMPLIFIERS_UNKNOWN
        return AmplifierGrid(rows or 1, columns or 1)


class ObservedFringeConfig(
    BackgroundConfig, base.PipelineTaskConfig, pipelineConnections=ObservedFringeConnections
):
    """Configuration of `ObservedFringeTask`."""

    components = Field[int](
        optional=True, doc="Number of templates; by default as many as predict other frames."
    )
    least_frames = Field[int](default=LEAST_FRAMES, doc="Frames that must see a pixel.")


class ObservedFringeTask(base.PipelineTask):
    """Find the fringes that the frames of a sensor share."""

    ConfigClass = ObservedFringeConfig
    config: ObservedFringeConfig
    _DefaultName = "observedFringe"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read the frames one by one, decompose, store."""
        data_id = data_id_of(butlerQC)
        detector = sensor_of(data_id)
        loaders = [butlerQC.get(ref).get for ref in inputRefs.frames]
        last = max(ref.dataId.records["exposure"].timespan.end for ref in inputRefs.frames)
        moment: datetime.datetime = last.utc.to_datetime()
        created = run_datetime(outputRefs.templates.run, moment)
        with unusable(f"{detector.name}, {data_id['physical_filter']}"):
            result = self.run(loaders, created)
        butlerQC.put(result, outputRefs)

    def run(self, frames: Sequence[Callable[[], ObservedFrame]], creation_datetime: str) -> base.Struct:
        """Make the templates of one sensor in one filter.

        Parameters
        ----------
        frames : sequence of callables
            Each returns a frame; they are asked several times, one at a time.
        creation_datetime : `str`
            When the calibration is made, ``YYYY-MM-DDThh:mm:ss``.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``templates``, a `FringeTemplates`.

        Raises
        ------
        InputError
            Too few frames, or frames that do not belong together.
        UndeterminedError
            The frames do not decide a template.
        """
        options = TemplateOptions(
            self.config.components,
            least_frames=self.config.least_frames,
            spacing_px=self.config.background_px,
            amplifiers=self.config.grid,
        )
        made = make_templates(frames, creation_datetime, options, metadata=common_header(self.config))
        self.log.info(
            "%s in %s: %d templates from %d frames",
            *(made.detector, made.physical_filter, len(made.patterns), len(frames)),
        )
        return base.Struct(templates=made)
