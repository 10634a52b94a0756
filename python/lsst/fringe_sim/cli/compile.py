"""``fringe-sim compile``: fill the cache of compiled functions before anybody waits for it."""

from __future__ import annotations

import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import click

from .command import command, option
from .progress import progress

PROCESSES = 2
SIMULATED = "simulated flats"


@command()
def compile(
    cpu: str = option(
        "Processor to compile for; 'generic' runs on any, somewhat slower.",
        "native",
        click.Choice(["native", "generic"]),
    ),
) -> None:
    """Compile what simulated flats, a fit, a sky and a search need, and keep it.

    The first command in a new environment compiles for half a minute; afterwards none does. The compiled functions
    lie beside the package, or in the folder that NUMBA_CACHE_DIR names; others may use that folder without writing
    it. A command finds those for a generic processor if NUMBA_CPU_NAME=generic is set where it runs.

    \b
    Examples:
      fringe-sim compile
      NUMBA_CACHE_DIR=/opt/numba fringe-sim compile --cpu generic
    """
    if cpu == "generic":
        os.environ["NUMBA_CPU_NAME"] = "generic"
    start = time.monotonic()
    # Processes, not threads: the compiler has a lock.
    with (
        progress("compiling", len(stages()[0]) + len(stages()[1])) as advance,
        ProcessPoolExecutor(PROCESSES, get_context("spawn")) as pool,
    ):
        for names in stages():
            for job in [pool.submit(_do, name) for name in names]:
                job.result()
                advance()
    click.echo(f"compiled in {time.monotonic() - start:.0f} s")


def stages() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of what is compiled at the same time, first and then."""
    from ..algorithms.warm_up import FIRST, THEN

    return (*FIRST, SIMULATED), tuple(THEN)


def _do(name: str) -> None:
    import logging
    import warnings

    from ..algorithms.warm_up import FIRST, THEN

    logging.getLogger().setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    {**FIRST, **THEN, SIMULATED: _simulated}[name]()


def _simulated() -> None:
    """Flats of `mock-flats`."""
    from tempfile import TemporaryDirectory

    import numpy as np

    from ..mock.raw_frames import write_mock_flats
    from ..mock.thickness import random_field

    with TemporaryDirectory() as folder:
        write_mock_flats(
            folder,
            setup="ts8_e2v",
            detector="E2V-CCD250-321",
            thickness_um=random_field((64, 64), np.random.default_rng()),
            wavelengths_nm=[950.0],
            rng=np.random.default_rng(),
            size="64x64",
            n_bias=1,
        )
