"""A small task on the package's own storage classes: what the header of a raw frame says, as JSON."""

import os
import signal
from pathlib import Path
from typing import Any

import lsst.pex.config as pex_config
import lsst.pipe.base as pipe_base
from lsst.pipe.base import connectionTypes

import lsst.fringe_sim.middleware  # storage classes  # noqa: F401


class HeaderConnections(pipe_base.PipelineTaskConnections, dimensions=("instrument", "exposure", "detector")):
    raw = connectionTypes.Input(
        doc="raw frame",
        name="raw.metadata",
        storageClass="RawMetadata",
        dimensions=("instrument", "exposure", "detector"),
    )
    header = connectionTypes.Output(
        doc="its header",
        name="toyHeader",
        storageClass="FringeJson",
        dimensions=("instrument", "exposure", "detector"),
    )


class HeaderConfig(pipe_base.PipelineTaskConfig, pipelineConnections=HeaderConnections):
    refused = pex_config.Field[str](doc="sensor at which the task fails", default="")
    killed = pex_config.Field[str](doc="sensor at which the process dies ...", default="")
    killed_while = pex_config.Field[str](doc="... as long as this file is there", default="")


class HeaderTask(pipe_base.PipelineTask):
    ConfigClass = HeaderConfig
    _DefaultName = "toyHeader"

    def run(self, raw: Any) -> pipe_base.Struct:
        if raw.serial == self.config.refused:
            raise RuntimeError(f"refused: {raw.serial}")
        if raw.serial == self.config.killed and Path(self.config.killed_while).exists():
            os.kill(os.getpid(), signal.SIGKILL)
        return pipe_base.Struct(header={"wavelength_nm": raw.wavelength_nm, "serial": raw.serial})
