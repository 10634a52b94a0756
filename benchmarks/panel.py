"""The panel: whether the search still works, case by case against a frozen baseline.

See "The panel" in doc/discovery_details.md for how to run and read it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import permutations, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from ._panel_cases import KINDS, PanelCase, read_cases

ROOT = Path(__file__).resolve().parents[1]
BASELINE = Path(__file__).with_name("panel_baseline.ecsv")

CAP_S = 120.0
"""Processor time of one case [s]."""

MOST_NET_LOST = 2
"""Cases by which those that got worse may outnumber those that got better."""

MOST_TIMED_OUT = 0.1
"""Part of the cases that may time out."""

QUICK = (
    "null-mock", "null-foreign", "null-foreign-more-noise", "one-mock-bandwidth", "one-mock-vignetting",
    "one-foreign-gain", "one-foreign-gradient", "one-foreign-insulation", "two-foreign-bandwidth-gain",
    "outsider-mock-columns", "outsider-foreign-patch", "near-foreign-more-trailing",
)  # fmt: skip
"""Cases of `--quick`."""

RANKS = {"right": 2, "class": 2, "unexplained": 1, "missed": 1, "timed out": 1, "failed": 0, "wrong": 0}
"""Outcomes, the higher the better; between equal ranks nothing is lost or won."""

COLUMNS = (
    "case",
    "kind",
    "truth",
    "verdict",
    "names",
    "outcome",
    "evaluations",
    "processor_s",
    "checksum",
    "version",
)


@dataclass(frozen=True)
class PanelResult:
    """What became of a case; names of one class are joined by ~, effects by +.

    ``evaluations`` is -1 where they were not counted, ``checksum`` empty where the data were not told.
    """

    case: str
    kind: str
    truth: str
    verdict: str
    names: str
    outcome: str
    evaluations: int
    processor_s: float
    checksum: str
    version: str

    @property
    def rank(self) -> int:
        """See `RANKS`."""
        return RANKS[self.outcome]


def judge(
    kind: str, truth: Iterable[str], verdict: str, classes: Sequence[Sequence[str]], like: Iterable[str] = ()
) -> str:
    """Outcome of a case from its truth and the verdict.

    Parameters
    ----------
    kind : `str`
        One of `KINDS`.
    truth : iterable of `str`
        What is hidden.
    verdict : `str`
        That of the search, or what ended it.
    classes : sequence of sequence of `str`
        Every name with those that are in its class, the name first.
    like : iterable of `str`, optional
        What a cause outside the catalogue is said to resemble.
    """
    hidden = tuple(truth)
    if verdict in ("timed out", "ended"):
        return "timed out"
    if verdict == "failed":
        return "failed"
    if kind == "null":
        return {"no_discrepancy": "right", "unexplained": "unexplained"}.get(verdict, "wrong")
    if verdict == "no_discrepancy":
        return "missed"
    if kind in ("outsider", "neighbour"):
        return (
            "right" if verdict in ("unexplained", "like") or (kind == "neighbour" and any(like)) else "wrong"
        )
    if verdict == "unexplained":
        return "unexplained"
    if sorted(names[0] for names in classes) == sorted(hidden):
        return "right"
    matched = len(classes) == len(hidden) and any(
        all(name in names for name, names in zip(order, classes, strict=True))
        for order in permutations(hidden)
    )
    return "class" if matched else "wrong"


def compare(results: Sequence[PanelResult], before: Mapping[str, PanelResult]) -> tuple[list[str], int]:
    """Lines that tell every case that got worse or better, and by how many the worse outnumber the better."""
    lines, net = [], 0
    for result in results:
        old = before.get(result.case)
        if old is None:
            continue
        if old.checksum and result.checksum and old.checksum != result.checksum:
            lines.append(f"drawn differently from {old.version}: {result.case}")
        if result.rank == old.rank:
            continue
        word, step = ("lost", 1) if result.rank < old.rank else ("won", -1)
        net += step
        lines.append(
            f"{word}: {result.case} ({result.truth or 'nothing'}) is {result.outcome} "
            f"({result.names or result.verdict}) and was {old.outcome} ({old.names or old.verdict})"
        )
    return sorted(lines), net


def verdict_of(results: Sequence[PanelResult], net: int) -> tuple[list[str], bool]:
    """What is said of the whole panel, and whether it has failed."""
    late = sum(result.outcome == "timed out" for result in results)
    too_late = late > MOST_TIMED_OUT * len(results)
    said = [
        f"net loss {net} (at most {MOST_NET_LOST})",
        f"timed out {late} of {len(results)} (at most {MOST_TIMED_OUT:.0%})",
    ]
    return said, net > MOST_NET_LOST or too_late


def summary(results: Sequence[PanelResult]) -> list[str]:
    """Outcomes of each kind, and what they cost, as a Markdown table."""
    outcomes = list(RANKS)
    lines = [
        f"| kind | {' | '.join(outcomes)} | evaluations | processor |",
        "|---" * (len(outcomes) + 3) + "|",
    ]
    for kind in (*KINDS, "all"):
        own = [result for result in results if kind in (result.kind, "all")]
        if own:
            counts = Counter(result.outcome for result in own)
            numbers = " | ".join(str(counts[outcome] or "") for outcome in outcomes)
            asked = statistics.median(result.evaluations for result in own)
            spent = statistics.median(result.processor_s for result in own)
            lines.append(f"| {kind}, {len(own)} | {numbers} | {asked:.0f} | {spent:.0f} s |")
    return lines


def read_results(path: Path) -> dict[str, PanelResult]:
    """Results of a file by case."""
    table = Table.read(path, format="ascii.ecsv")
    rows = ({name: row[name] for name in COLUMNS} for row in table.filled(""))
    plain = (
        {name: getattr(value, "item", lambda v=value: v)() for name, value in row.items()} for row in rows
    )
    return {row["case"]: PanelResult(**row) for row in plain}


def write_results(path: Path, results: Iterable[PanelResult]) -> None:
    """Write results, in the order given."""
    rows = [[getattr(result, name) for name in COLUMNS] for result in results]
    table = Table(rows=rows, names=COLUMNS)
    table.meta["cap_s"] = CAP_S
    table.write(path, format="ascii.ecsv", overwrite=True)


class _Worker:
    """A process that searches cases with the code of one checkout."""

    def __init__(self, checkout: Path) -> None:
        places = [str(checkout / "python"), str(ROOT)]
        threads = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment = {**os.environ, **threads, "PYTHONPATH": os.pathsep.join(places)}
        command = [sys.executable, "-m", "benchmarks._panel_worker"]
        self.process = subprocess.Popen(
            command, cwd=ROOT, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def search(self, case: PanelCase, fresh: int | None) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        job = {"case": case.case, "fresh": fresh, "cap_s": CAP_S}
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


def run_cases(
    cases: Sequence[PanelCase],
    *,
    checkout: Path = ROOT,
    version: str = "",
    fresh: int | None = None,
    jobs: int = 1,
    progress: Callable[[PanelResult], None] | None = None,
) -> list[PanelResult]:
    """Search cases with the code of a checkout.

    Parameters
    ----------
    cases : sequence of `PanelCase`
        What to search.
    checkout : `pathlib.Path`, optional
        Folder with ``python/lsst/fringe_sim``.
    version : `str`, optional
        What the results say of it.
    fresh : `int`, optional
        Seed of a fresh draw of every case; without it they are those of the list.
    jobs : `int`, optional
        Cases that run at the same time.
    progress : callable, optional
        Called with every result.
    """
    own, telling = threading.local(), threading.Lock()
    workers: list[_Worker] = []

    def search(case: PanelCase) -> PanelResult:
        if not hasattr(own, "worker"):
            own.worker = _Worker(checkout)
            workers.append(own.worker)
        result = _result(case, own.worker.search(case, fresh), version)
        if progress is not None:
            with telling:
                progress(result)
        return result

    try:
        with ThreadPoolExecutor(jobs) as pool:
            return list(pool.map(search, cases))
    finally:
        for worker in workers:
            worker.close()


def _result(case: PanelCase, answer: Mapping[str, Any], version: str) -> PanelResult:
    if answer["verdict"] == "failed":
        print(f"{case.case}: {answer['error']}", file=sys.stderr)
    names = "+".join("~".join(group) for group in answer["names"])
    outcome = judge(case.kind, case.truth, answer["verdict"], answer["names"], answer.get("like", ()))
    return PanelResult(
        case.case, case.kind, "+".join(case.truth), answer["verdict"], names, outcome, answer["evaluations"],
        answer["processor_s"], answer.get("checksum", ""), version,
    )  # fmt: skip


def mixed(cases: Sequence[PanelCase]) -> list[PanelCase]:
    """All kinds in turn: what is stopped early has seen some of each."""
    groups = [[case for case in cases if case.kind == kind] for kind in KINDS]
    return [case for turn in zip_longest(*groups) for case in turn if case is not None]


def version_of(checkout: Path) -> str:
    """Commit that last changed the package of a checkout; ``+`` if it has changed since."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(checkout), *arguments, "--", "python"]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    return (git("log", "-1", "--format=%h", "--abbrev=7") or "unknown") + "+" * bool(
        git("status", "--porcelain")
    )


def main(arguments: Sequence[str]) -> int:
    """Run the panel; the exit code says whether it has failed."""
    chosen = _parser().parse_args(arguments)
    cases = mixed(read_cases())
    if chosen.quick:
        cases = [case for case in cases if case.case in QUICK]
    if chosen.cases:
        cases = [case for case in cases if any(part in case.case for part in chosen.cases)]
    fresh = None
    if chosen.fresh or chosen.seed is not None:
        fresh = int(np.random.default_rng().integers(2**31)) if chosen.seed is None else chosen.seed
        print(f"fresh draws of seed {fresh}", flush=True)
    version = chosen.version or version_of(ROOT)
    results = _kept_up(cases, chosen.results, version, fresh, chosen.jobs)
    print("\n".join(["", *summary(results), ""]))
    before = {} if fresh is not None or not BASELINE.exists() else read_results(BASELINE)
    if chosen.against is not None:
        before = _beside(cases, results, chosen.against, fresh, chosen.jobs)
    if chosen.record is not None:
        write_results(chosen.record, results)
    lines, net = compare(results, before)
    said, failed = verdict_of(results, net)
    print("\n".join([*lines, *said, f"compared with an earlier result: {len(_shared(results, before))}"]))
    return int(failed)


def _shared(
    results: Sequence[PanelResult], before: Mapping[str, PanelResult]
) -> list[tuple[PanelResult, PanelResult]]:
    return [(result, before[result.case]) for result in results if result.case in before]


def _beside(
    cases: Sequence[PanelCase], results: Sequence[PanelResult], checkout: Path, fresh: int | None, jobs: int
) -> dict[str, PanelResult]:
    """Results of another checkout in the same run, and what this one costs beside it."""
    print(f"the same with {checkout}", flush=True)
    others = run_cases(
        cases,
        checkout=checkout.resolve(),
        version=version_of(checkout),
        fresh=fresh,
        jobs=jobs,
        progress=_tell,
    )
    print("\n".join(["", *summary(others), ""]))
    before = {result.case: result for result in others}
    ratios = [new.processor_s / max(old.processor_s, 0.1) for new, old in _shared(results, before)]
    print(f"processor time: median of the ratios {statistics.median(ratios):.2f}")
    return before


def _kept_up(
    cases: Sequence[PanelCase], path: Path | None, version: str, fresh: int | None, jobs: int
) -> list[PanelResult]:
    """Results of all cases; those that a file has are not run again, and every new one is added to it at once."""
    ready: dict[str, PanelResult] = {}
    if path is not None and path.exists():
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        ready = {row["case"]: PanelResult(**row) for row in rows if row["version"] == version}

    def progress(result: PanelResult) -> None:
        _tell(result)
        if path is not None:
            with path.open("a") as out:
                out.write(json.dumps(vars(result)) + "\n")

    waiting = [case for case in cases if case.case not in ready]
    new = run_cases(waiting, version=version, fresh=fresh, jobs=jobs, progress=progress)
    ready.update({result.case: result for result in new})
    return [ready[case.case] for case in cases]


def _tell(result: PanelResult) -> None:
    print(
        f"{result.case}: {result.outcome} ({result.names or result.verdict}), "
        f"{result.evaluations} evaluations, {result.processor_s:.0f} s",
        flush=True,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks panel", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"{len(QUICK)} of the cases")
    parser.add_argument(
        "--fresh", action="store_true", help="another list, drawn now: other sensors, noise and sizes"
    )
    parser.add_argument(
        "--seed", type=int, help="seed of the fresh draws (implies --fresh); drawn by default"
    )
    parser.add_argument("--jobs", type=int, default=1, help="cases that run at the same time (default: 1)")
    parser.add_argument(
        "--against", type=Path, metavar="CHECKOUT", help="run that version too, and compare with it"
    )
    parser.add_argument(
        "--results", type=Path, metavar="FILE", help="file of results to go on from (JSON lines)"
    )
    parser.add_argument(
        "--record", type=Path, metavar="FILE", help="write results in the layout of the baseline"
    )
    parser.add_argument("--version", default="", help="what to call this version (default: its commit)")
    parser.add_argument(
        "cases", nargs="*", metavar="PART", help="only cases whose name has one of these parts"
    )
    return parser
