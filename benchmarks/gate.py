"""The gate: sensors that no version has seen, drawn by one seed after the last change of the code.

``python -m benchmarks gate --seed N --nulls 30 --singles 30 --pairs 20 --minutes 10`` searches them in turn, as many
as the processor time allows, and prints every outcome as soon as it is known. Noise is stated wrongly by up to 20 %.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, zip_longest

import numpy as np

from lsst.fringe_sim.algorithms.discovery import discover

from ._panel_cases import PanelCase, read_cases
from .panel import judge

MOST_WRONG = 0.2
"""Part by which the stated noise is wrong at most."""


def drawn(kind: str, number: int, rng: np.random.Generator) -> Iterator[PanelCase]:
    """Cases of one kind of the panel in a random order, each with noise that is not the stated one."""
    own = [case for case in read_cases() if case.kind == kind]
    for index in chain.from_iterable(rng.permutation(len(own)) for _ in range(number)):
        noise = float(rng.uniform(1.0 - MOST_WRONG, 1.0 + MOST_WRONG))
        case = own[index]
        if case.source == "mock":
            yield replace(case, noise=noise**2)
        else:
            yield replace(case, charge={**case.charge, "noise": noise})


def main(arguments: Sequence[str] | None = None) -> None:
    """Search and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--minutes", type=float, default=10.0, help="processor time")
    for kind, number in (("null", 30), ("single", 30), ("pair", 20)):
        parser.add_argument(f"--{kind}s", type=int, default=number)
    chosen = parser.parse_args(arguments)
    rng, begun = np.random.default_rng(chosen.seed), time.process_time()
    numbers = {kind: getattr(chosen, f"{kind}s") for kind in ("null", "single", "pair")}
    queues = [
        [case for case, _ in zip(drawn(kind, number, rng), range(number), strict=False)]
        for kind, number in numbers.items()
    ]
    counts: Counter[tuple[str, str]] = Counter()
    for case in (case for row in zip_longest(*queues) for case in row if case is not None):
        if time.process_time() - begun > 60.0 * chosen.minutes:
            break
        outcome = searched(case, int(rng.integers(2**31)))
        counts[case.kind, outcome] += 1
    print(", ".join(f"{kind} {outcome}: {n}" for (kind, outcome), n in sorted(counts.items())))


def searched(case: PanelCase, fresh: int) -> str:
    """Outcome of a case, which is printed with what it took."""
    data, search, factor = case.streams(fresh)
    cube, now = case.cube(data, factor), time.process_time()
    verdict = discover(cube, case.model(), rng=search)
    classes = [[effect.name, *effect.ambiguous_with] for effect in verdict.effects]
    outcome = judge(case.kind, case.truth, verdict.verdict, classes)
    names = "+".join("~".join(names) for names in classes) or verdict.verdict
    print(f"{case.case} {fresh} {factor:.2f} {outcome} {names} {time.process_time() - now:.1f} s", flush=True)
    return outcome


if __name__ == "__main__":
    main()
