"""Which quick tests execute which lines of the package: a plug-in of pytest writes it down, `Touched` reads it.

The plug-in works where ``COVERAGE_PROCESS_START`` names the settings that `settings` has written, and needs the
package coverage. What a fixture of many tests executes counts for each of them, and so does what a process executes
that a test has started with its own environment.
"""

from __future__ import annotations

import json
import os
import time
from collections import defaultdict
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any

import pytest

SETTINGS = """[run]
parallel = true
data_file = {folder}/data/lines
include = */{package}/*
context = ${{TOUCHED_BY-}}
disable_warnings = no-data-collected, module-not-measured, couldnt-parse, no-sysmon, no-ctracer
"""
OF_FIXTURE = "fixture "


def settings(folder: Path, package: Path) -> dict[str, str]:
    """Environment in which a run of pytest records into a folder."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    file = folder / "settings.ini"
    file.write_text(SETTINGS.format(folder=folder, package=package.as_posix()))
    into = folder / "data" / f"tests-{time.time_ns()}"
    return {"COVERAGE_PROCESS_START": str(file), "TOUCHED_INTO": str(into)}


class _Clock:
    """What is being executed, and how much processor time everything took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.fixtures: dict[str, list[str]] = {}
        self.passed: set[str] = set()
        self.now, self.since = "", _processor_s()

    def switch(self, name: str) -> str:
        """Count for ``name`` from here on; what was counted for before."""
        import coverage

        before, moment = self.now, _processor_s()
        self.seconds[before] += moment - self.since
        self.now, self.since = name, moment
        os.environ["TOUCHED_BY"] = name
        running = coverage.Coverage.current()
        if running is not None:
            running.switch_context(name)
        return before


def _processor_s() -> float:
    """Processor time of this process and of those that it has waited for [s], whatever else the machine does."""
    return sum(os.times()[:4])


_clock = _Clock()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Count lines and time for a test."""
    known: dict[str, Any] = item._fixtureinfo.name2fixturedefs  # type: ignore[attr-defined]
    _clock.fixtures[item.nodeid] = [
        _of_fixture(made) for several in known.values() for made in several if made.scope != "function"
    ]
    before = _clock.switch(item.nodeid)
    try:
        return (yield)
    finally:
        _clock.switch(before)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any) -> Generator[None, Any, Any]:
    """Count for a fixture what it prepares for several tests."""
    if fixturedef.scope == "function":
        return (yield)
    before = _clock.switch(_of_fixture(fixturedef))
    try:
        return (yield)
    finally:
        _clock.switch(before)


def _of_fixture(made: Any) -> str:
    return f"{OF_FIXTURE}{made.baseid}::{made.argname}"


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Keep what has passed."""
    if report.when == "call" and report.passed:
        _clock.passed.add(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write down what this process has run."""
    if _clock.fixtures:
        _clock.switch("")
        told = {"seconds": _clock.seconds, "fixtures": _clock.fixtures, "passed": sorted(_clock.passed)}
        Path(f"{os.environ['TOUCHED_INTO']}-{os.getpid()}.json").write_text(json.dumps(told))


class Touched:
    """What was recorded into a folder."""

    def __init__(self, folder: Path) -> None:
        import coverage

        for file in folder.glob("data/lines.*"):
            part = coverage.CoverageData(str(file))
            part.read()
            self._all(folder).update(part)
            file.unlink()
        self.data = self._all(folder)
        self.seconds: dict[str, float] = {}
        self.fixtures: dict[str, list[str]] = {}
        runs: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for file in sorted(folder.glob("data/tests-*.json")):
            runs[file.stem.split("-")[1]].append(json.loads(file.read_text()))
        for told in runs.values():
            new = {test.partition("::")[0] for part in told for test in part["fixtures"]}
            kept = {test: made for test, made in self.fixtures.items() if test.partition("::")[0] not in new}
            for part in told:
                self.seconds |= part["seconds"]
                kept |= {test: part["fixtures"][test] for test in part["passed"]}
            self.fixtures = kept

    @staticmethod
    def _all(folder: Path) -> Any:
        import coverage

        data = coverage.CoverageData(str(folder / "lines"))
        data.read()
        return data

    def lines(self, path: Path) -> dict[int, set[str]]:
        """Tests that passed and execute a line, of each line of a file; all of the file if an import executes it."""
        users: dict[str, set[str]] = defaultdict(set)
        for test, made in self.fixtures.items():
            for name in (test, *made):
                users[name].add(test)
        found: dict[int, set[str]] = defaultdict(set)
        imported: set[int] = set()
        for measured in self.data.measured_files():
            if measured.endswith(f"/{path.as_posix()}"):
                for line, contexts in self.data.contexts_by_lineno(measured).items():
                    names = {context.strip("|") for context in contexts}
                    found[line].update(*(users[name] for name in names))
                    if "" in names:
                        imported.add(line)
        every = set().union(*found.values())
        return {line: every if line in imported else tests for line, tests in found.items()}

    def in_order(self, tests: Iterable[str], most_seconds: float) -> list[str]:
        """The cheapest tests, as many as fit into a time together."""
        taken: list[str] = []
        ready: set[str] = set()
        spent = 0.0
        for test in sorted(tests, key=self._alone):
            new = {made for made in self.fixtures[test] if made not in ready}
            cost = self.seconds.get(test, 0.0) + sum(self.seconds.get(made, 0.0) for made in new)
            if spent + cost <= most_seconds:
                taken.append(test)
                spent += cost
                ready |= new
        return taken

    def _alone(self, test: str) -> float:
        return sum(self.seconds.get(name, 0.0) for name in (test, *self.fixtures[test]))
