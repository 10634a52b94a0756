"""HTCondor as a batch service, for environments made from a package index.

Needs the package ``lsst-ctrl-bps-htcondor``; nothing else of this package imports this module.
"""

from __future__ import annotations

from typing import Any

from lsst.ctrl.bps.htcondor import HTCondorService

from .bps_environment import accept_resources, point_to_this_environment


class FringeHTCondorService(HTCondorService):
    """HTCondor without Rubin's own installation; see `bps_environment`."""

    def __init__(self, config: Any) -> None:
        point_to_this_environment()
        accept_resources()
        super().__init__(config)
