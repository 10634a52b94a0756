"""The search for missing effects on sealed cases, and how well it did on them.

The search is given the frames of a case and the name of the set-up, never the truth; the oracle, which is told which
effects are in, shows what could be reached.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from functools import partial
from itertools import permutations
from multiprocessing import get_context

import numpy as np

from ..algorithms.discovery import SearchOptions, Verdict, discover
from ..compiled import limit_threads, processors
from ..effects import EFFECTS
from .oracle import Oracle, visibility
from .result import CASE_KINDS, VISIBLE, CaseResult, ChallengeResult
from .sealed_cases import SealedCase, draw_case


def run_challenge(
    counts: Mapping[str, int],
    seed: int,
    *,
    size: tuple[int, int] = (96, 96),
    only: Sequence[str] = (),
    setup: str = "ts8_e2v",
    known: Sequence[CaseResult] = (),
    jobs: int = 1,
    progress: Callable[[CaseResult], None] | None = None,
) -> ChallengeResult:
    """Draw cases, each with a stream of its own, search, and judge; ``known`` results are not made again."""
    ready = {(result.kind, result.number): result for result in known}
    wanted = [(kind, number) for number in range(max(counts.values(), default=0)) for kind in CASE_KINDS
              if number < counts.get(kind, 0)]  # fmt: skip
    work = partial(_run_case, seed=seed, size=size, only=tuple(only), setup=setup)
    for result in _results(work, [case for case in wanted if case not in ready], jobs):
        ready[result.kind, result.number] = result
        if progress is not None:
            progress(result)
    results = sorted((ready[case] for case in wanted), key=lambda r: (CASE_KINDS.index(r.kind), r.number))
    return ChallengeResult(seed, tuple(results), asdict(SearchOptions()))


def _results(
    work: Callable[[str, int], CaseResult], cases: Sequence[tuple[str, int]], jobs: int
) -> Iterator[CaseResult]:
    """Results as they come."""
    if jobs == 1 or len(cases) < 2:
        yield from (work(*case) for case in cases)
        return
    threads = max(1, processors() // jobs)
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), limit_threads, (threads,))
    try:
        for done in as_completed([pool.submit(work, *case) for case in cases]):
            yield done.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _run_case(
    kind: str, number: int, *, seed: int, size: tuple[int, int], only: Sequence[str], setup: str
) -> CaseResult:
    streams = np.random.default_rng([seed, CASE_KINDS.index(kind), number]).spawn(2)
    effects = only if kind in ("one", "two") else ()
    case = draw_case(kind, streams[0], size=size, only=effects, setup=setup)
    same_blocks = copy.deepcopy(streams[1])
    began = time.process_time()
    verdict = discover(case.cube, case.setup, rng=streams[1])
    seconds = time.process_time() - began
    return judge(case, verdict, number, seconds, _ask_oracle(case, same_blocks))


def _ask_oracle(case: SealedCase, rng: np.random.Generator) -> Oracle | None:
    """What is seen of the effects of a case, and the verdict of a search that is told which can be in.

    With the generator of the search it holds out the same blocks: in others the gap is another.
    """
    known = [effect for effect in EFFECTS if effect.name in case.names]
    if not known:
        return None
    trusting = replace(SearchOptions(), significance=1.0, least_probability=1e-6)
    verdict = discover(case.cube, case.setup, known, rng=rng, options=trusting)
    return Oracle(visibility(case, most_cells=trusting.most_cells), verdict)


def judge(
    case: SealedCase, verdict: Verdict, number: int, seconds: float, oracle: Oracle | None
) -> CaseResult:
    """Compare a verdict with the truth."""
    found = tuple(effect.name for effect in verdict.effects)
    visible = oracle.visibility.each if oracle else {}
    seen = [name for name in case.names if visible.get(name, 0.0) >= VISIBLE]
    wanted = {case.names} if len(case.names) < 2 else {case.names, tuple(seen)}
    right = case.kind in ("one", "two") and any(is_right(names, verdict) for names in wanted)
    exact = right and sorted(found) == sorted(case.names)
    pulls = {}
    if exact:
        for effect in verdict.effects:
            for name, parameter in effect.parameters.items():
                key = f"{effect.name}.{name}"
                if key in case.values and parameter.sigma > 0.0:
                    pulls[key] = (parameter.value - case.values[key]) / parameter.sigma
    strength, shrinkage = math.nan, math.nan
    if oracle is not None:
        strength, gap = oracle.visibility.all, oracle.verdict.gap
        whole = gap.heldout_before**2 - gap.heldout_after**2
        own = verdict.gap.heldout_before**2 - verdict.gap.heldout_after**2
        shrinkage = own / whole if whole > 0.0 else math.nan
    return CaseResult(
        number,
        case.kind,
        case.names,
        case.values,
        verdict.verdict,
        found,
        tuple(effect.ambiguous_with for effect in verdict.effects),
        right,
        exact,
        strength,
        min(visible.values(), default=math.nan),
        min((effect.probability for effect in verdict.effects), default=0.0),
        math.prod(e.probability * e.share for e in verdict.effects) if verdict.effects else 0.0,
        pulls,
        shrinkage,
        seconds,
    )


def is_right(names: Sequence[str], verdict: Verdict) -> bool:
    """Whether a search named all of these effects, each itself or by its class, and nothing else."""
    classes = [{effect.name, *effect.ambiguous_with} for effect in verdict.effects]
    return verdict.verdict == "named" and any(_matches(order, classes) for order in permutations(names))


def _matches(names: Sequence[str], classes: Sequence[set[str]]) -> bool:
    """Whether there is one class for each name, in this order, and no other."""
    return len(names) == len(classes) and all(n in group for n, group in zip(names, classes, strict=True))
