"""Parsl as a batch service, for environments made from a package index.

Two things differ from `lsst.ctrl.bps.parsl.ParslService`. It works without Rubin's own installation
(`bps_environment`). And a failed job is not passed over in silence: when all jobs have ended, `bps submit` and
`bps restart` name those that failed and exit with status 1.
"""

from __future__ import annotations

from typing import Any

import click

from lsst.ctrl.bps.parsl import ParslService
from lsst.ctrl.bps.parsl.workflow import ParslWorkflow

from .bps_environment import accept_resources, point_to_this_environment


def failed_jobs(workflow: Any) -> list[str]:
    """Names of the jobs of a workflow that ended with an error, or that had to wait for one that did."""
    return sorted(
        name
        for name, job in workflow.jobs.items()
        if job.future is not None and job.future.done() and job.future.exception() is not None
    )


class FringeParslService(ParslService):
    """Runs a workflow with Parsl, and says so if a part of it failed."""

    def __init__(self, config: Any) -> None:
        point_to_this_environment()
        accept_resources()
        super().__init__(config)

    def submit(self, workflow: Any, **kwargs: Any) -> None:
        """Run the workflow to its end."""
        super().submit(workflow, **kwargs)
        _complain_of_failures(workflow)

    def restart(self, out_prefix: str) -> tuple[str, str, str]:
        """Run what is left of a workflow, by its submit directory, that was interrupted or of which jobs failed."""
        workflow = ParslWorkflow.read(out_prefix)
        workflow.restart()
        workflow.run()
        _complain_of_failures(workflow)
        return workflow.name, workflow.name, ""


def _complain_of_failures(workflow: Any) -> None:
    failed = failed_jobs(workflow)
    if failed:
        started = sum(job.future is not None for job in workflow.jobs.values())
        raise click.ClickException(
            f"{len(failed)} of {started} jobs failed: {', '.join(failed[:8])}"
            f"{' …' if len(failed) > 8 else ''}; their logs are in {workflow.path}/logs, and "
            f"pipetask report REPO {workflow.path}/*.qg --force-v2 says which sensors are affected"
        )
