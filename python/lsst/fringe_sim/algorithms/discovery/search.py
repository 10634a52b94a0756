"""The search of flats: checks, a budget of time, and the search of any exposures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from ...effects import Effect, known_effects
from ...model import FringeModel, Setup
from ...products.fringe_cube import FringeCube
from ...products.sky_frame import refuse_noiseless
from ..evaluations import OutOfTimeError, time_limit
from ..exposures import Exposures
from .checks import check_setup, why_too_poor
from .options import SearchOptions
from .verdict import Gap, Verdict, Where
from .verdict_words import METRIC
from .whole_search import WholeSearch

Report = Callable[[str], None]

FOR_JUDGEMENT = 0.2
"""Part of a time budget that is kept for the judgement of the best answer on the data held out."""


def discover(
    cube: FringeCube,
    setup: str | Setup | FringeModel,
    effects: Sequence[Effect] | None = None,
    *,
    rng: np.random.Generator,
    options: SearchOptions | None = None,
    report: Report | None = None,
) -> Verdict:
    """Find out whether flats and model disagree beyond noise, and which effect of a catalogue is the reason.

    Parameters
    ----------
    cube : `FringeCube`
        Flats of one sensor.
    setup : `str`, `Setup` or `FringeModel`
        What is known of sensor and light; a model may hold effects that are known already.
    effects : sequence of `Effect`, optional
        The catalogue; `known_effects` by default.
    rng : `numpy.random.Generator`
        Decides which parts of the sensor are held out; nothing else is random.
    options : `SearchOptions`, optional
        Thresholds and sizes.
    report : callable, optional
        Called with a line of text at every stage.

    Returns
    -------
    verdict : `Verdict`

    Raises
    ------
    InputError
        The flats are simulated without noise; the set-up contradicts them (temperature, bandpass), or is not one of
        a laboratory.
    """
    model = setup if isinstance(setup, FringeModel) else FringeModel.from_setup(setup)
    refuse_noiseless(cube.metadata, cube.detector or None)
    check_setup(cube, model)
    known = {item.effect.name for item in model.effects}
    # Flats do not see the spectrum of the night sky, nor the sensor at the telescope.
    own = [
        effect
        for effect in known_effects(effects)
        if not (effect.sky_only or effect.learned) or effect.name in known
    ]
    verdict = search_exposures(cube, model, own, rng, options, report)
    return replace(verdict, known=model.effect_settings)


def search_exposures(
    cube: FringeCube,
    model: FringeModel,
    effects: Sequence[Effect],
    rng: np.random.Generator,
    options: SearchOptions | None,
    report: Report | None,
    exposures: Exposures | None = None,
) -> Verdict:
    """Search any exposures whose light is known; parameters as of `discover`, which is for flats."""
    chosen = options or SearchOptions()
    say = report or (lambda text: None)
    # Many small matrices: threads of the linear algebra would wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        poor = why_too_poor(cube, model)
        if poor:
            return _no_answer(model, poor, cube)
        begun, budget = time.monotonic(), chosen.time_budget_s
        search: WholeSearch | None = None
        try:
            with time_limit(begun + (1.0 - FOR_JUDGEMENT) * budget):
                search = WholeSearch(cube, model, effects, rng, chosen, say, exposures)
                return search.run()
        except OutOfTimeError:
            say(f"the search is stopped: {budget:g} s were given")
            stopped = search.best_so_far(begun + budget) if search is not None else None
            reason = f"{budget:g} s did not suffice to fit the unchanged model"
            return stopped or replace(_no_answer(model, reason, cube, too_poor=False), complete=False)


def _no_answer(model: FringeModel, reason: str, cube: FringeCube, *, too_poor: bool = True) -> Verdict:
    nan = math.nan
    unexplained = {"reason": reason, "too_poor": too_poor}
    return Verdict(
        "unexplained", (), Where(), Gap(METRIC, nan, nan, nan, nan, nan), (), unexplained,
        model.setup.name, nan, data={"shape": list(cube.shape)},
    )  # fmt: skip
