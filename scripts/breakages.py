"""Break the package in small ways, one at a time, and count how many of them the quick tests notice.

usage: python scripts/breakages.py [--number 40] [--seed 1] [--room-only] [--workers 2] [--least 0.9]

A breakage is one operator, constant or comparison inside the body of a function. They are drawn over all rooms of the
package in turn, so that a small room counts as much as a large one. Work is done in a copy of the files of the
checkout that git knows; the checkout itself is only read. The tests of the broken room run first, then the others.
The status is 1 if a smaller part than ``--least`` was noticed, and 2 if the tests fail with nothing broken.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import itertools
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path("python/lsst/fringe_sim")
ROOMS_OF_THEIR_OWN = ("algorithms/discovery", "algorithms/thickness_fit")
MOST_SECONDS = 3600
"""A run of the tests that takes longer has noticed something: it hangs."""

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
    """Places below a node and what stands there instead; no annotations, decorators, defaults, or text."""
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
            if isinstance(part, ast.AST) and name != "annotation":
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


def draw(number: int, seed: int, files: list[Path]) -> list[Breakage]:
    """Breakages of all rooms in turn."""
    chance = random.Random(seed)
    rooms: dict[str, list[Breakage]] = defaultdict(list)
    for path in files:
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
    """A copy of the checkout that may be broken."""

    def __init__(self, root: Path, workers: int) -> None:
        self.root, self.workers = root / "checkout", workers
        self.cache = root / "numba"
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
        self.files = [Path(name) for name in listed.decode().split("\0") if name]
        for name in self.files:
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, self.root / name, follow_symlinks=False)

    def notices(self, tests: list[str], cache: Path) -> str:
        """The first line that says what failed; empty if all passed."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow"]
        environment = {
            "PYTHONPATH": str(self.root / "python"),
            "NUMBA_CACHE_DIR": str(cache),
            "OMP_WAIT_POLICY": "passive",
            "OPENBLAS_NUM_THREADS": "1",
            "FRINGE_SIM_SHARED": os.environ.get("FRINGE_SIM_SHARED", str(ROOT.parent / "shared")),
        }
        try:
            done = subprocess.run(
                [*command, "-n", str(self.workers), *tests],
                cwd=self.root,
                env={**os.environ, **environment},
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

    def trial(self, breakage: Breakage, room_only: bool) -> str:
        """What notices a breakage; empty if nothing does."""
        path = self.root / breakage.path
        written = path.stat()
        path.write_bytes(breakage.broken)
        # A compiled function in another module keeps what it took in of this one: such a cache would hide the fault.
        compiled = re.search(rb"\b(njit|numba|kernel|subkernel|compiled)\b", breakage.source) is not None
        cache = Path(tempfile.mkdtemp(dir=self.root.parent)) if compiled else self.cache
        own = tests_of(room_of(breakage.path), self.root)
        try:
            noticed = self.notices(own, cache)
            if not noticed and not room_only:
                noticed = self.notices(["tests", *(f"--ignore={part}" for part in own)], cache)
        finally:
            path.write_bytes(breakage.source)
            os.utime(path, ns=(written.st_atime_ns, written.st_mtime_ns))  # the cache stays good
            if compiled:
                shutil.rmtree(cache)
        return noticed


def difference(breakage: Breakage) -> str:
    """The breakage as a patch."""
    texts = (breakage.source, breakage.broken)
    before, after = (text.decode().splitlines(keepends=True) for text in texts)
    return "".join(difflib.unified_diff(before, after, str(breakage.path), str(breakage.path), n=2))


def main() -> int:
    """Draw, try, and say what was not noticed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--number", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2, help="processes of pytest")
    parser.add_argument("--room-only", action="store_true", help="only the tests of the broken room")
    parser.add_argument("--least", type=float, default=0.9, help="smallest part that must be noticed")
    parser.add_argument("--list", action="store_true", help="only show what would be broken")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="breakages-") as work:
        copy = Copy(Path(work), options.workers)
        of_package = [name for name in copy.files if name.suffix == ".py" and name.is_relative_to(PACKAGE)]
        drawn = draw(options.number, options.seed, of_package)
        if options.list:
            print("\n".join(map(difference, drawn)))
            return 0
        rooms = {part for item in drawn for part in tests_of(room_of(item.path), copy.root)}
        failed = copy.notices(sorted(rooms) if options.room_only else ["tests"], copy.cache)
        if failed:
            print(f"with nothing broken: {failed}", file=sys.stderr)
            return 2
        survivors = []
        for item in drawn:
            started, noticed = time.monotonic(), copy.trial(item, options.room_only)
            if not noticed:
                survivors.append(item)
            taken = time.monotonic() - started
            print(
                f"{'caught' if noticed else 'SURVIVED'}  {item.path}:{item.line}  {taken:.0f} s  {noticed}",
                flush=True,
            )
    for item in survivors:
        print("\n" + difference(item))
    caught = len(drawn) - len(survivors)
    print(f"{caught} of {len(drawn)} breakages of seed {options.seed} were noticed")
    return 0 if caught >= options.least * len(drawn) else 1


if __name__ == "__main__":
    sys.exit(main())
