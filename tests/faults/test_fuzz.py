"""New spoiled files and settings in every run of the tests; as many as the processor makes of its time."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SECONDS = 60
LEAST = 250  # Cases: one round. A minute of processor time is good for a thousand and more.
QUICK = 300  # Cases in every quick run


def fuzz(*arguments: object) -> int:
    """Cases that were tried, in a process of its own, which may limit memory and watch every file that is opened."""
    program = Path(__file__).with_name("fuzz.py")
    done = subprocess.run(
        [sys.executable, str(program), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    # With the seeds: a failing target is run again with --only NAME --seed SEED, or from the corpus.
    print(done.stdout)
    assert done.returncode == 0, done.stdout[-8000:]
    total = re.search(r"^(\d+) cases, slowest", done.stdout, re.MULTILINE)
    assert total is not None
    return int(total[1])


def test_what_failed_once_and_cheap_fresh_cases() -> None:
    assert fuzz("--cases", QUICK, "--quick") >= QUICK


@pytest.mark.slow
def test_fresh_cases() -> None:
    assert fuzz("--seconds", SECONDS) >= LEAST
