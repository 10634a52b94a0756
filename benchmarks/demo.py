"""How often the search of `fringe-sim demo` is right: its flats and its search for many seeds, no repository."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lsst.fringe_sim.algorithms.discovery import SearchOptions, Verdict, discover
from lsst.fringe_sim.algorithms.flat_prep_options import FlatPrepOptions
from lsst.fringe_sim.challenge.demo_case import CELLS, DemoCase, found_words
from lsst.fringe_sim.cli.demo_truth import DemoTruth
from lsst.fringe_sim.cli.lab_frames import find_series
from lsst.fringe_sim.instrument.setup import Setup

SETUP = "ts8_e2v"
RIGHT = ("right", "right class")


@dataclass(frozen=True)
class DemoResult:
    """What became of a seed."""

    case: DemoCase
    verdict: Verdict
    processor_s: float

    @property
    def judgement(self) -> str:
        """As on the page of the demo."""
        return found_words(self.case, self.verdict)

    def line(self) -> str:
        """A row of the table."""
        found = " + ".join("~".join((e.name, *e.ambiguous_with)) for e in self.verdict.effects)
        cells = (
            self.case.seed,
            " + ".join(self.case.names),
            self.verdict.verdict,
            found,
            self.judgement,
            f"{self.processor_s:.0f}",
        )
        return f"| {' | '.join(map(str, cells))} |"


def main(arguments: Sequence[str]) -> int:
    """Run seeds and print a row for each, then the counts."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks demo", description=__doc__)
    parser.add_argument("--seeds", type=int, default=50, help="how many (default: 50)")
    parser.add_argument("--first", type=int, default=1, help="the first of them (default: 1)")
    parser.add_argument(
        "--side", type=int, default=1024, help="rows and columns (default: those of the demo)"
    )
    chosen = parser.parse_args(arguments)
    print(
        "| seed | hidden | verdict | found | judgement | processor [s] |\n|--:|---|---|---|---|--:|",
        flush=True,
    )
    results = []
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        results.append(searched(seed, (chosen.side, chosen.side)))
        print(results[-1].line(), flush=True)
    counts = Counter(result.judgement for result in results)
    right = sum(counts[word] for word in RIGHT)
    print(f"\nright or in the class: {right} of {len(results)} ({dict(counts)})")
    return 0


def searched(seed: int, shape: tuple[int, int]) -> DemoResult:
    """Hide, expose, prepare and search, as the demo does."""
    setup = Setup.from_name(SETUP)
    with tempfile.TemporaryDirectory() as folder:
        truth = DemoTruth(Path(folder) / "sealed", seed, shape)
        truth.write_flats(Path(folder) / "raws")
        series = find_series((f"{folder}/raws",), skip_bad=False)
        cube = series.read(setup, FlatPrepOptions(smoothing_sigma_px=0.0), lambda: None)
        case = truth.case()
    begun = time.process_time()
    verdict = discover(cube, setup, rng=np.random.default_rng(seed), options=SearchOptions(most_cells=CELLS))
    return DemoResult(case, verdict, time.process_time() - begun)
