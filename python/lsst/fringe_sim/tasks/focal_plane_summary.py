"""The forecasts of all sensors in one table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from astropy.table import Table

from lsst.pipe import base
from lsst.pipe.base.connectionTypes import Input, Output

from ..algorithms.focal_plane import summary_table
from .quantum import SENSOR, OrderedConnections, common_header, unusable


class FocalPlaneSummaryConnections(OrderedConnections, dimensions=("instrument",)):
    """Forecasts of sensors in, one table out."""

    forecasts = Input(
        "fringeForecast", "AstropyTable", "Forecasts of single sensors.", dimensions=SENSOR, multiple=True
    )
    summary = Output("focalPlaneForecast", "AstropyTable", "One row per sensor.", dimensions=("instrument",))

    ORDERED = ("forecasts", lambda ref: ref.dataId["detector"])


class FocalPlaneSummaryConfig(base.PipelineTaskConfig, pipelineConnections=FocalPlaneSummaryConnections):
    """Configuration of `FocalPlaneSummaryTask`."""


class FocalPlaneSummaryTask(base.PipelineTask):
    """Gather the forecasts of a focal plane."""

    ConfigClass = FocalPlaneSummaryConfig
    config: FocalPlaneSummaryConfig
    _DefaultName = "focalPlaneSummary"

    def runQuantum(self, butlerQC: base.QuantumContext, inputRefs: Any, outputRefs: Any) -> None:
        """Read, gather, store."""
        with unusable("focal plane"):
            result = self.run(butlerQC.get(inputRefs.forecasts))
        butlerQC.put(result, outputRefs)

    def run(self, forecasts: Sequence[Table]) -> base.Struct:
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
        return base.Struct(summary=summary)
