"""SIGKILL at random moments of `pipetask run`, resumed until it is done; how often, and what was lost.

    python tests/faults/kill_and_resume.py --kills 50

prints one line for each kill and a summary at the end. A fault of the package ends it with an assertion. The seed is
drawn anew unless one is given, and printed.
"""

import argparse
import re
import secrets
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

from fault_chain import OUT, QUANTA, Chain, Ended, make_template

DONE = re.compile(r"Executed (\d+) quanta successfully, 0 failed and 0 remain")
NOTHING_LEFT = "QuantumGraph contains no quanta"

FILES = 30  # Files that a run writes, about
WHOLE = 4  # One chain of so many is the whole one
IN_A_ROW = 4  # Most kills before a chain is left in peace


@dataclass(frozen=True)
class Way:
    """What is run, and how it is resumed."""

    # Resume in the run that was cut off (``--extend-run``), else in a new one (``--skip-existing-in``)
    extend: bool
    whole: bool  # The whole chain, else biases and flats, which write more files in a shorter time

    @property
    def quanta(self) -> int:
        """Number of quanta."""
        return QUANTA if self.whole else QUANTA - 1

    @property
    def subset(self) -> str:
        """Part of the pipeline."""
        return "" if self.whole else "#fringeBias,isrFlatPrep"


@dataclass
class Report:
    """What happened."""

    kills: int = 0
    chains: int = 0
    whole: int = 0
    """Kills of the whole chain; the others were of the preparation of the flats alone."""
    journals: int = 0
    """Kills in the middle of a transaction of the registry."""
    visible_at_kill: list[int] = field(default_factory=list)


def kill_and_resume(
    new_chain: Callable[[], Chain],
    reference: dict[str, str],
    seconds: Mapping[bool, float],
    kills: int,
    rng: np.random.Generator,
    say: Callable[[str], None] = lambda line: None,
) -> Report:
    """Kill runs at random moments, up to so many times, and let each chain come to its end."""
    report = Report()
    while report.kills < kills:
        chain = new_chain()
        report.chains += 1
        way = Way(extend=bool(rng.integers(2)), whole=bool(rng.integers(WHOLE) == 0))
        before = chain.visible()
        for _ in range(int(rng.integers(1, IN_A_ROW + 1))):
            moment = draw_moment(rng, seconds[way.whole])
            ended = run_again(chain, way, **moment)
            if ended.code >= 0:
                break
            report.kills += 1
            before = check(chain, before, f"killed {moment}")
            report.visible_at_kill.append(len(before))
            report.whole += way.whole
            say(f"kill {report.kills:3d} {moment}: {len(before)} datasets of finished quanta; {way}")
        finish(chain, way, reference, before)
        report.journals += chain.journals
    return report


def draw_moment(rng: np.random.Generator, seconds: float) -> dict[str, Any]:
    """A moment of the whole run, or one around the writing of a file: most files are written in a short time."""
    if rng.integers(2):
        return {"kill_after": round(float(rng.uniform(0.0, 1.1 * seconds)), 3)}
    return {
        "kill_at_file": int(rng.integers(1, FILES)),
        "kill_after": round(float(rng.uniform(0.0, 0.03)), 4),
    }


def run_again(chain: Chain, way: Way, **moment: Any) -> Ended:
    """Start or resume, in a new run or in the one that was cut off."""
    if way.extend and chain.has_collection(OUT):
        options = ("--extend-run", "--skip-existing", "--clobber-outputs")
        return chain.run(*options, resume=False, subset=way.subset, **moment)
    return chain.run(subset=way.subset, **moment)


def check(chain: Chain, before: dict[str, str], what: str) -> dict[str, str]:
    """Everything that is shown can be read, and what was there before is as it was."""
    now = chain.visible()
    lost = set(before) - set(now)
    changed = {key for key in set(before) & set(now) if before[key] != now[key]}
    if lost or changed:
        raise AssertionError(f"{what}: {len(lost)} datasets lost, {len(changed)} changed")
    return now


def finish(chain: Chain, way: Way, reference: dict[str, str], before: dict[str, str]) -> None:
    """Let the chain run to its end: only what is missing, and the same in the end."""
    complete = chain.complete_quanta()
    ended = run_again(chain, way)
    executed = DONE.search(ended.text)
    if complete == way.quanta:
        if NOTHING_LEFT not in ended.text:
            raise AssertionError(f"nothing was left, but:\n{ended.text[-2000:]}")
    elif ended.code != 0 or executed is None:
        raise AssertionError(f"the resumed run ended with {ended.code}:\n{ended.text[-4000:]}")
    elif int(executed[1]) != way.quanta - complete:
        raise AssertionError(f"{executed[1]} quanta ran, {way.quanta - complete} were missing")
    check(chain, before, "resumed to the end")
    if chain.results() != {
        name: digest for name, digest in reference.items() if way.whole or "epoxy" not in name
    }:
        raise AssertionError("the end differs from that of an undisturbed run")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=None, help="by default a new one")
    arguments = parser.parse_args()
    seed = secrets.randbits(63) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        template = make_template(root / "template")

        def new_chain() -> Chain:
            return Chain(template, Path(tempfile.mkdtemp(dir=root)))

        undisturbed = new_chain()
        first = undisturbed.run()
        if first.code != 0:
            raise AssertionError(f"the undisturbed run ended with {first.code}:\n{first.text[-4000:]}")
        reference = undisturbed.results()
        part = new_chain().run(subset=Way(False, False).subset)
        again = new_chain()
        ended = again.run()
        if ended.code != 0 or again.results() != reference:
            differing = sorted(set(reference.items()) ^ set(again.results().items()))
            raise AssertionError(f"two undisturbed runs differ in {differing}:\n{ended.text[-2000:]}")
        seconds = {True: ended.seconds, False: part.seconds}
        print(f"undisturbed: {seconds} s, {len(reference)} products", flush=True)
        rng = np.random.default_rng(seed)
        report = kill_and_resume(
            new_chain, reference, seconds, arguments.kills, rng, lambda line: print(line, flush=True)
        )
    seen = report.visible_at_kill
    print(
        f"{report.kills} kills in {report.chains} chains ({report.whole} of the whole chain), {report.journals} in a "
        "transaction of the registry, "
        f"{min(seen)} to {max(seen)} datasets of finished quanta there at the kill; "
        "nothing lost, no earlier output changed, every end identical to that of an undisturbed run"
    )


if __name__ == "__main__":
    main()
