"""The forecasts of all sensors in one table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from astropy.table import Table

from lsst.pipe.base import (
    PipelineTask,
    PipelineTaskConfig,
    PipelineTaskConnections,
    QuantumContext,
    Struct,
)
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms.focal_plane import summary_table
from .quantum import common_header, put_in_order, unusable

__all__ = ["FocalPlaneSummaryConfig", "FocalPlaneSummaryConnections", "FocalPlaneSummaryTask"]


class FocalPlaneSummaryConnections(PipelineTaskConnections, dimensions=("instrument",)):
    """Forecasts of sensors in, one table out."""

    forecasts = Input(
        doc="Forecasts of single sensors.",
        name="fringeForecast",
        storageClass="AstropyTable",
        dimensions=("instrument", "detector"),
        multiple=True,
    )
    summary = Output(
        doc="One row per sensor.",
        name="focalPlaneForecast",
        storageClass="AstropyTable",
        dimensions=("instrument",),
    )

    def adjustQuantum(self, inputs: Any, outputs: Any, label: str, data_id: Any) -> tuple[dict, dict]:
        """Put the sensors in the order of their numbers."""
        ordered = put_in_order(inputs, "forecasts", lambda ref: ref.dataId["detector"])
        super().adjustQuantum(inputs, outputs, label, data_id)
        return ordered, {}


class FocalPlaneSummaryConfig(PipelineTaskConfig, pipelineConnections=FocalPlaneSummaryConnections):
    """Configuration of `FocalPlaneSummaryTask`."""


class FocalPlaneSummaryTask(PipelineTask):
    """Gather the forecasts of a focal plane."""

    ConfigClass = FocalPlaneSummaryConfig
    config: FocalPlaneSummaryConfig
    _DefaultName = "focalPlaneSummary"

    def runQuantum(self, butlerQC: QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read, gather, store."""
        with unusable("focal plane"):
            result = self.run(butlerQC.get(inputRefs.forecasts))
        butlerQC.put(result, outputRefs)

    def run(self, forecasts: Sequence[Table]) -> Struct:
        """Gather forecasts.

        Parameters
        ----------
        forecasts : sequence of `astropy.table.Table`
            As `FringeForecastTask` makes them.

        Returns
        -------
        result : `~lsst.pipe.base.Struct`
            ``summary``, an `astropy.table.Table` with one row per sensor.
        """
        summary = summary_table([table.meta for table in forecasts])
        summary.meta.update(common_header(self.config))
        rms = np.asarray(summary["rms"])
        self.log.info("%d sensors: fringe rms %.4f to %.4f %%", len(summary), rms.min(), rms.max())
        return Struct(summary=summary)
