"""Break the package in small ways, one at a time, and count how many of them the quick tests notice.

usage: python scripts/breakages.py [--number 40] [--seed 1] [--room ROOM] [--workers 2] [--keep FOLDER --record] ...

A breakage is one operator, constant or comparison inside the body of a function. They are drawn over all rooms of the
package in turn, so that a small room counts as much as a large one. Work is done in a copy of the files of the
checkout that git knows; the checkout itself is only read. The tests of the broken room run first, then the others.
The status is 1 if a smaller part than ``--least`` was noticed, and 2 if the tests fail with nothing broken.

All quick tests run for every breakage, unless ``--record`` has written down which tests execute which lines (with the
package coverage) into a folder that ``--keep`` names. Then only those run that execute the broken statement, the
cheapest first and no more than ``--most-seconds`` of them. What no test notices is shown to mypy, which is part of
``make test`` as well.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import hashlib
import itertools
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from touched import Touched, settings

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path("python/lsst/fringe_sim")
ROOMS_OF_THEIR_OWN = ("algorithms/discovery", "algorithms/thickness_fit")
MOST_SECONDS = 3600
"""A run of the tests that takes longer has noticed something: it hangs."""

NOTHING: Mapping[str, str] = MappingProxyType({})
UNSEEN = re.compile(r"\b(kernel|subkernel|njit|cache|lru_cache|cached_property)\b")
"""Decorators of functions whose lines are not seen, or only the first time."""

OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: (r"\+", "-"),
    ast.Sub: (r"-", "+"),
    ast.Mult: (r"\*", "/"),
    ast.Div: (r"/", "*"),
    ast.FloorDiv: (r"//", "+"),
    ast.Mod: (r"%", "+"),
    ast.Pow: (r"\*\*", "*"),
    ast.BitAnd: (r"&", "|"),
    ast.BitOr: (r"\|", "&"),
    ast.And: (r"\band\b", "or"),
    ast.Or: (r"\bor\b", "and"),
    ast.Lt: (r"<", ">="),
    ast.LtE: (r"<=", ">"),
    ast.Gt: (r">", "<="),
    ast.GtE: (r">=", "<"),
    ast.Eq: (r"==", "!="),
    ast.NotEq: (r"!=", "=="),
    ast.Is: (r"\bis\b", "is not"),
    ast.IsNot: (r"\bis\s+not\b", "is"),
    ast.In: (r"\bin\b", "not in"),
    ast.NotIn: (r"\bnot\s+in\b", "in"),
}
"""How an operator is written, and what stands in its place; a comparison is turned round."""


@dataclass(frozen=True)
class Breakage:
    """Bytes ``begin`` to ``end`` of a file, of which ``source`` was read when it was drawn, replaced by ``new``."""

    path: Path
    source: bytes
    begin: int
    end: int
    new: bytes

    @property
    def broken(self) -> bytes:
        """The source with the breakage."""
        return self.source[: self.begin] + self.new + self.source[self.end :]

    @property
    def line(self) -> int:
        """Line of the file, counted from one."""
        return self.source[: self.begin].count(b"\n") + 1


def breakages(path: Path) -> list[Breakage]:
    """All that can be broken in the bodies of the functions of a file, given relative to the checkout."""
    source = (ROOT / path).read_bytes()
    lines = [0]
    for line in source.splitlines(keepends=True):
        lines.append(lines[-1] + len(line))
    tree = ast.parse(source)
    found = {}
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                for begin, end, new in _of_node(statement, source, lines):
                    found[begin, end] = Breakage(path, source, begin, end, new)
    return list(found.values())


def _is_other_code(breakage: Breakage) -> bool:
    try:
        return ast.dump(ast.parse(breakage.broken)) != ast.dump(ast.parse(breakage.source))
    except SyntaxError:
        return False


def _of_node(node: ast.AST, source: bytes, lines: list[int]) -> Iterator[tuple[int, int, bytes]]:
    """Places below a node and what stands there instead; no annotations, decorators, defaults, or text.

    Whether ``zip`` is strict is left alone, too: it changes nothing as long as what it takes is of one length.
    """
    if isinstance(node, ast.JoinedStr | ast.FunctionDef | ast.ClassDef):
        return  # inner functions have their own turn

    def at(line: int | None, column: int | None) -> int:
        return lines[(line or 1) - 1] + (column or 0)

    def between(left: ast.expr, operator: ast.AST, right: ast.expr) -> Iterator[tuple[int, int, bytes]]:
        begin, end = at(left.end_lineno, left.end_col_offset), at(right.lineno, right.col_offset)
        if type(operator) in OPERATORS:
            pattern, new = OPERATORS[type(operator)]
            place = re.search(pattern.encode(), re.sub(rb"#[^\n]*", _blank, source[begin:end]))
            if place:
                yield begin + place.start(), begin + place.end(), new.encode()

    match node:
        case ast.BinOp(left=left, op=op, right=right):
            yield from between(left, op, right)
        case ast.AugAssign(target=left, op=op, value=right):
            yield from between(left, op, right)
        case ast.BoolOp(op=op, values=values):
            for left, right in itertools.pairwise(values):
                yield from between(left, op, right)
        case ast.Compare(left=first, ops=ops, comparators=rest):
            for left, op, right in zip([first, *rest], ops, rest, strict=False):
                yield from between(left, op, right)
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield at(node.lineno, node.col_offset), at(operand.lineno, operand.col_offset), b""
        case ast.Constant(value=bool() | int() | float() as value):
            new = not value if isinstance(value, bool) else value + 1 if not value else 2 * value
            yield (
                at(node.lineno, node.col_offset),
                at(node.end_lineno, node.end_col_offset),
                repr(new).encode(),
            )
    for name, child in ast.iter_fields(node):
        for part in child if isinstance(child, list) else [child]:
            strict = isinstance(part, ast.keyword) and part.arg == "strict"
            if isinstance(part, ast.AST) and name != "annotation" and not strict:
                yield from _of_node(part, source, lines)


def _blank(comment: re.Match[bytes]) -> bytes:
    return b" " * len(comment.group())


def room_of(path: Path) -> str:
    """Room of the package that a file is in."""
    inner = path.relative_to(PACKAGE).parent.as_posix()
    for room in ROOMS_OF_THEIR_OWN:
        if inner.startswith(room):
            return room
    return inner.split("/")[0]


def tests_of(room: str, root: Path) -> list[str]:
    """Tests that belong to a room."""
    if room == ".":
        return sorted(path.relative_to(root).as_posix() for path in (root / "tests").glob("test_*.py"))
    own = [part for part in (f"tests/{room}", f"tests/{room.split('/')[0]}") if (root / part).is_dir()]
    return own[:1] or ["tests"]


def draw(number: int, seed: int, files: list[Path], only: Sequence[str] = ()) -> list[Breakage]:
    """Breakages of all rooms in turn, or of some."""
    chance = random.Random(seed)
    rooms: dict[str, list[Breakage]] = defaultdict(list)
    for path in files:
        if not only or room_of(path) in only:
            rooms[room_of(path)].extend(breakages(path))
    order = [room for room in sorted(rooms) if rooms[room]]
    chance.shuffle(order)
    drawn: list[Breakage] = []
    while len(drawn) < number:
        one = chance.choice(rooms[order[len(drawn) % len(order)]])
        if _is_other_code(one):
            drawn.append(one)
    return drawn


class Copy:
    """A copy of the checkout that may be broken, with compiled functions and, once recorded, the map of its tests."""

    def __init__(self, root: Path, workers: int) -> None:
        self.root, self.workers = root / "checkout", workers
        self.cache, self.map = root / "numba", root / "map"
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
        self.files = [Path(name) for name in listed.decode().split("\0") if name]
        for name in self.files:
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            if (self.root / name).is_symlink():
                (self.root / name).unlink()
            shutil.copy2(ROOT / name, self.root / name, follow_symlinks=False)

    def digests(self) -> dict[str, str]:
        """What the files of the package and those of the tests hold; helpers of the tests may change."""
        kept = [name for name in self.files if name.suffix == ".py" and name.is_relative_to(PACKAGE)]
        kept += [name for name in self.files if name.parts[0] == "tests" and name.match("test_*.py")]
        return {str(name): hashlib.sha256((self.root / name).read_bytes()).hexdigest() for name in kept}

    def record(self) -> None:
        """Write down which tests execute which lines: of all tests, or of changed files of tests alone."""
        known, now = self._recorded(), self.digests()
        changed = [name for name in now if known.get(name) != now[name]]
        if not known or any(name.startswith(str(PACKAGE)) for name in changed):
            shutil.rmtree(self.map, ignore_errors=True)
            changed = ["tests"]
        if changed:
            self.notices(changed, self.cache, ["-p", "touched"], settings(self.map, PACKAGE))
            (self.map / "digests.json").write_text(json.dumps(now))

    def touched(self) -> Touched | None:
        """The map, if it is of these files."""
        known, now = self._recorded(), self.digests()
        return Touched(self.map) if all(known.get(name) == now[name] for name in now) else None

    def _recorded(self) -> dict[str, str]:
        file = self.map / "digests.json"
        return dict(json.loads(file.read_text())) if file.exists() else {}

    def notices(
        self,
        tests: list[str],
        cache: Path,
        options: Sequence[str] = ("-x",),
        also: Mapping[str, str] = NOTHING,
    ) -> str:
        """The first line that says what failed; empty if all passed."""
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", *options]
        if self.workers > 1:
            command += ["-n", str(self.workers), "--dist", "worksteal"]
        environment = {
            "PYTHONPATH": f"{self.root / 'python'}:{self.root / 'scripts'}",
            "NUMBA_CACHE_DIR": str(cache),
            "OMP_WAIT_POLICY": "passive",
            "OPENBLAS_NUM_THREADS": "1",
            "FRINGE_SIM_SHARED": os.environ.get("FRINGE_SIM_SHARED", str(ROOT.parent / "shared")),
        }
        asked = self.root.parent / "tests.txt"
        asked.write_text("\n".join(tests))
        try:
            done = subprocess.run(
                [*command, f"@{asked}"],
                cwd=self.root,
                env={**os.environ, **environment, **also},
                capture_output=True,
                text=True,
                check=False,
                timeout=MOST_SECONDS,
            )
        except subprocess.TimeoutExpired:
            return "takes too long"
        if done.returncode in (0, 5):
            return ""
        said = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return said[0] if said else (done.stdout + done.stderr).strip().splitlines()[-1]

    def types(self) -> str:
        """The first line that says which types do not fit; empty if all do."""
        done = subprocess.run(
            [sys.executable, "-m", "mypy"], cwd=self.root, capture_output=True, text=True, check=False
        )
        return done.stdout.splitlines()[0] if done.returncode else ""

    def trial(self, breakage: Breakage, runs: list[list[str]], users: list[Function]) -> str:
        """What notices a breakage, of several runs of tests in turn; empty if nothing does.

        ``users``: functions whose compiled code may have taken in the broken one, and would hide the fault if kept.
        """
        path = self.root / breakage.path
        written = path.stat()
        path.write_bytes(breakage.broken)
        cache = self.root.parent / "numba of the broken"
        shutil.rmtree(cache, ignore_errors=True)
        shutil.copytree(self.cache, cache)
        for function in users:
            for kept in cache.glob(f"*/{function.path.stem}.*{function.name}-*"):
                kept.unlink()
        try:
            noticed = next(filter(None, (self.notices(tests, cache) for tests in runs if tests)), "")
            return noticed or self.types()
        finally:
            path.write_bytes(breakage.source)
            os.utime(path, ns=(written.st_atime_ns, written.st_mtime_ns))  # the cache stays good


@dataclass(frozen=True)
class Function:
    """A function of the package, the names that its body uses, and whether its lines are seen whenever it is used."""

    path: Path
    name: str
    first: int
    last: int
    names: frozenset[str]
    unseen: bool


def functions_of(path: Path) -> Iterator[Function]:
    """All functions of a file, methods and inner functions among them."""
    for node in ast.walk(ast.parse((ROOT / path).read_bytes())):
        if isinstance(node, ast.FunctionDef):
            used = [part for statement in node.body for part in ast.walk(statement)]
            names = {part.id if isinstance(part, ast.Name) else part.attr for part in used if _is_name(part)}
            unseen = any(UNSEEN.search(ast.unparse(one)) for one in node.decorator_list)
            yield Function(
                path, node.name, node.body[0].lineno, node.end_lineno or 0, frozenset(names), unseen
            )


def _is_name(node: ast.AST) -> bool:
    return isinstance(node, ast.Name | ast.Attribute)


class Noticing:
    """Which tests can notice a breakage: those that execute it, if a map says which, and otherwise all."""

    def __init__(self, touched: Touched | None, files: list[Path], most_seconds: float) -> None:
        self.touched, self.most_seconds = touched, most_seconds
        self.functions = [function for path in files for function in functions_of(path)]

    def runs(self, breakage: Breakage) -> list[list[str]]:
        """Tests of the broken room and then the others; with a map each in the order of their cost."""
        own = tests_of(room_of(breakage.path), ROOT)
        if self.touched is None:
            return [own, ["tests", *(f"--ignore={part}" for part in own)]]
        tests = self._of_lines(breakage.path, *statement_of(breakage))
        for function in self.users(breakage):
            tests |= self._of_lines(function.path, function.first, function.last)
        near = {test for test in tests if test.startswith(tuple(own))}
        return [self.touched.in_order(part, self.most_seconds) for part in (near, tests - near)]

    def users(self, breakage: Breakage) -> list[Function]:
        """What uses the broken function without a trace, as one of both is compiled or remembers results."""
        around = [f for f in self.functions if f.path == breakage.path and f.first <= breakage.line <= f.last]
        found, left = [], [max(around, key=lambda function: function.first)]
        while left:
            used = left.pop()
            for function in self.functions:
                if used.name in function.names and (used.unseen or function.unseen) and function not in found:
                    found.append(function)
                    left.append(function)
        return found

    def _of_lines(self, path: Path, first: int, last: int) -> set[str]:
        known = self.touched.lines(path) if self.touched else {}
        return {test for line, tests in known.items() if first <= line <= last for test in tests}


def statement_of(breakage: Breakage) -> tuple[int, int]:
    """First and last line of the innermost statement around a breakage, without the statements inside it."""
    spans = []
    for node in ast.walk(ast.parse(breakage.source)):
        if isinstance(node, ast.stmt) and node.lineno <= breakage.line <= (node.end_lineno or node.lineno):
            inside = [part.lineno for part in getattr(node, "body", [])]
            spans.append(
                (node.lineno, max(node.lineno, min([node.end_lineno or 0, *(i - 1 for i in inside)])))
            )
    return max(spans)


def difference(breakage: Breakage) -> str:
    """The breakage as a patch."""
    texts = (breakage.source, breakage.broken)
    before, after = (text.decode().splitlines(keepends=True) for text in texts)
    return "".join(difflib.unified_diff(before, after, str(breakage.path), str(breakage.path), n=2))


def main() -> int:
    """Draw, try, and say what was not noticed."""
    options = _arguments()
    with contextlib.ExitStack() as stack:
        work = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="breakages-")))
        copy = Copy(work.resolve(), options.workers)
        if options.record:
            copy.record()
        of_package = [name for name in copy.files if name.suffix == ".py" and name.is_relative_to(PACKAGE)]
        drawn = draw(options.number, options.seed, of_package, options.room)
        if options.list:
            print("\n".join(map(difference, drawn)))
            return 0
        touched = copy.touched()
        failed = copy.types() or ("" if touched else copy.notices(["tests"], copy.cache))
        if failed:
            print(f"with nothing broken: {failed}", file=sys.stderr)
            return 2
        noticing = Noticing(touched, of_package, options.most_seconds)
        noticed = [_try(copy, item, noticing) for item in drawn]
        idle = {
            test for test in map(test_of, noticed) if test and touched and copy.notices([test], copy.cache)
        }
    for test in sorted(idle):
        print(f"fails with nothing broken, so that what it alone noticed has survived: {test}")
    survivors = [item for item, said in zip(drawn, noticed, strict=True) if not said or test_of(said) in idle]
    for item in survivors:
        print("\n" + difference(item))
    caught = len(drawn) - len(survivors)
    print(f"{caught} of {len(drawn)} breakages of seed {options.seed} were noticed")
    return 0 if caught >= options.least * len(drawn) else 1


def _try(copy: Copy, item: Breakage, noticing: Noticing) -> str:
    """What notices a breakage, which is printed."""
    started, runs = time.monotonic(), noticing.runs(item)
    noticed = copy.trial(item, runs, noticing.users(item))
    taken, asked = time.monotonic() - started, sum(map(len, runs)) if noticing.touched else "all"
    said = "caught" if noticed else "SURVIVED"
    print(f"{said}  {item.path}:{item.line}  {taken:.0f} s, {asked} tests  {noticed}", flush=True)
    return noticed


def test_of(said: str) -> str:
    """Name of the test that failed, in a line of pytest."""
    found = re.match(r"(?:FAILED|ERROR) (tests/\S+\.py::.+?)(?: - |$)", said)
    return found[1] if found else ""


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--number", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--room", action="append", default=[], help="only this room; may be repeated")
    parser.add_argument("--workers", type=int, default=2, help="processes of pytest")
    parser.add_argument("--least", type=float, default=0.9, help="smallest part that must be noticed")
    parser.add_argument("--list", action="store_true", help="only show what would be broken")
    parser.add_argument(
        "--keep", type=Path, help="folder of the copy, of its compiled functions and of the map"
    )
    parser.add_argument(
        "--record", action="store_true", help="record the map, or what has changed of it, first"
    )
    parser.add_argument(
        "--most-seconds",
        type=float,
        default=60,
        help="of the tests of the room, and of the others, with a map",
    )
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
