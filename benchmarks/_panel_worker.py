"""Search single cases of the panel, each in a child that is stopped when its processor time is used up.

Reads one line of JSON for each case and answers with one; modules are imported once, before any child is made.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
import traceback
from types import FrameType
from typing import Any

from lsst.fringe_sim.algorithms.discovery import Verdict, discover

from ._panel_cases import PanelCase, checksum, read_cases

try:
    from lsst.fringe_sim.algorithms.evaluations import EvaluationCount, count_evaluations
except ImportError:  # a version that does not count, or does it elsewhere
    count_evaluations = None  # type: ignore[assignment]

GRACE_S = 20
"""Processor time after the cap at which a child that does not hear is ended by the system [s]."""


class OutOfTimeError(BaseException):
    """The processor time of the case is used up; no handler of errors may swallow it."""


def main() -> None:
    cases = {case.case: case for case in read_cases()}
    for line in sys.stdin:
        job = json.loads(line)
        print(_in_child(cases[job["case"]], job["fresh"], job["cap_s"]), flush=True)


def _in_child(case: PanelCase, fresh: int | None, cap_s: float) -> str:
    """Answer of a child, or that it was ended."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        os.close(reading)
        try:
            with os.fdopen(writing, "w") as out:
                out.write(json.dumps(_searched(case, fresh, cap_s)))
        except BaseException:  # the child must not go on as the parent
            traceback.print_exc()
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as source:
        text = source.read()
    os.waitpid(pid, 0)
    return text or json.dumps(
        {"verdict": "ended", "names": [], "evaluations": -1, "processor_s": cap_s + GRACE_S}
    )


def _searched(case: PanelCase, fresh: int | None, cap_s: float) -> dict[str, Any]:
    data, search, factor = case.streams(fresh)
    cube, model = case.cube(data, factor), case.model()
    answer: dict[str, Any] = {"checksum": checksum(cube), "names": []}
    count = count_evaluations() if count_evaluations is not None else None
    counted: EvaluationCount | None = count.__enter__() if count is not None else None
    began = time.process_time()
    _limit(cap_s, began)
    try:
        answer.update(_told(discover(cube, model, rng=search)))
    except OutOfTimeError:
        answer["verdict"] = "timed out"
    except Exception as error:  # one case that fails must not end the panel
        # Raised while compiled code is loaded, the end of the time comes out as another error.
        late = time.process_time() - began >= cap_s
        answer.update(verdict="timed out" if late else "failed", error=f"{type(error).__name__}: {error}")
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    answer["processor_s"] = round(time.process_time() - began, 1)
    answer["evaluations"] = -1 if counted is None else counted.number
    return answer


def _limit(cap_s: float, used_s: float) -> None:
    """Raise in this process when so much more processor time has passed; end it when it does not hear."""

    def out_of_time(number: int, frame: FrameType | None) -> None:
        raise OutOfTimeError

    signal.signal(signal.SIGPROF, out_of_time)
    # Again and again: what is raised inside a callback of the garbage collector is lost.
    signal.setitimer(signal.ITIMER_PROF, cap_s, 0.5)
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (int(used_s + cap_s) + GRACE_S, hard))


def _told(verdict: Verdict) -> dict[str, Any]:
    """What is judged: every name with those of its class, and what it is said to be like."""
    return {
        "verdict": verdict.verdict,
        "names": [[effect.name, *effect.ambiguous_with] for effect in verdict.effects],
        "like": list(verdict.unexplained.get("like", ())),
    }


if __name__ == "__main__":
    main()
