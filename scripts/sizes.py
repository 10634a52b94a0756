"""Size of every room: what a reader must read, beside another revision if one is named.

python scripts/sizes.py [--of REV] [--against REV] [--long] [--abilities]
"""

import argparse
import ast
import io
import re
import subprocess
import tarfile
from collections import defaultdict
from dataclasses import dataclass, fields
from pathlib import Path, PurePosixPath

TOP = Path(__file__).parents[1]
PACKAGE = PurePosixPath("python/lsst/fringe_sim")
SEARCH = "algorithms/discovery"
LONG_BODY, MANY_ARGUMENTS, MANY_IN_A_KERNEL, LONG_MODULE = 40, 8, 12, 450
# Our two decorators, and those of numba.
COMPILED = {"kernel", "subkernel", "njit", "jit", "vectorize", "guvectorize"}
# Abilities by the files that brought them; a new file that no pattern names holds what others did before.
ABILITIES = {
    "correction of observed frames, templates from them, sky shift (44)": (
        r"/correction|cli/correct|observed_|/coadd_sources|fit_sky|sky_shift|map_(on_sky|from_range)|range_|"
        r"night_(sums|levels)|templates|afw_background|image_archive|visit|sky_of_maps|smooth_field|sky_frames"
    ),
    "evidence of all public data; diffuse gate side, OH by levels, beam by field (43)": (
        r"evidence|continua|oh_levels|optics/diffuse|laboratory_shift|beam_field|mock/silicon_tables|ray_bundle|"
        r"sky_model_error|flat_spectrum"
    ),
    "demo, arrays and notebooks, sensors from YAML, spectra, compiling beforehand (46)": (
        r"notebook|demo_|plain_flats|galsim_config|model/spectrum|descriptions|deprecation|warm_up|cli/compile|"
        r"cli/command|bad_files|stated_facts|source_figure"
    ),
    "thickness fit under misfit, its forecast and its words (41)": (
        r"thickness_fit/(?!silicon|bands|solver)|flat_fit|flat_conditions"
    ),
    "one likelihood outside the search; learned effects (45)": r"/inference/|learned",
    "checks of what comes from outside (42)": r"raw_checks|raw_times|same_light|flat_exposures|file_keywords",
}
FunctionNode = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class Size:
    """Counts of one room; two add up."""

    lines: int = 0
    statements: int = 0
    docstrings: int = 0
    compiled: int = 0
    long: int = 0
    wide: int = 0
    modules: int = 0

    def __add__(self, other: "Size") -> "Size":
        return Size(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))


TITLES = {
    "lines": "lines",
    "statements": "statements",
    "docstrings": "lines of docstrings",
    "compiled": "compiled",
    "long": f"bodies > {LONG_BODY}",
    "wide": f"arguments > {MANY_ARGUMENTS} (compiled > {MANY_IN_A_KERNEL})",
    "modules": f"modules > {LONG_MODULE}",
}


def counted(path: str) -> bool:
    """Whether a file is code to read; spoilt input that the faults are made of is not."""
    return path.endswith(".py") and "corpus" not in PurePosixPath(path).parts


def sources(revision: str | None) -> dict[PurePosixPath, str]:
    """Python files of package and tests, by path, of a revision or of the work tree."""
    command = ["git", "-C", str(TOP)]
    if revision is None:
        listed = subprocess.run(
            [*command, "ls-files", "python", "tests"], check=True, capture_output=True, text=True
        )
        paths = [path for path in listed.stdout.split("\n") if counted(path) and (TOP / path).exists()]
        return {PurePosixPath(path): (TOP / path).read_text() for path in paths}
    packed = subprocess.run(
        [*command, "archive", revision, "python", "tests"], check=True, capture_output=True
    )
    found = {}
    with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
        for member in archive:
            if member.isfile() and counted(member.name):
                found[PurePosixPath(member.name)] = archive.extractfile(member).read().decode()
    return found


def room_of(path: PurePosixPath) -> str:
    """Name of the room of a file, as the table has it."""
    if path.parts[0] == "tests":
        return "tests"
    inside = path.relative_to(PACKAGE).parts if path.is_relative_to(PACKAGE) else ("",)
    if len(inside) < 2:
        return "root"
    return "/".join(inside[:-1]) if inside[0] == "algorithms" else inside[0]


def docstring_lines(tree: ast.AST) -> int:
    """Lines of the docstrings of a module, its classes and functions."""
    total = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | FunctionNode) and ast.get_docstring(node) is not None:
            total += node.body[0].end_lineno - node.body[0].lineno + 1
    return total


def body_lines(function: FunctionNode) -> int:
    """Lines of the body of a function without its docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def arguments(function: FunctionNode) -> int:
    """Arguments of a function without self and cls."""
    names = function.args.posonlyargs + function.args.args + function.args.kwonlyargs
    return sum(one.arg not in ("self", "cls") for one in names)


def decorator_names(function: FunctionNode) -> set[str]:
    """Last parts of the names of the decorators of a function."""
    called = [one.func if isinstance(one, ast.Call) else one for one in function.decorator_list]
    return {one.attr if isinstance(one, ast.Attribute) else getattr(one, "id", "") for one in called}


def measure(text: str) -> tuple[Size, list[tuple[int, int, str]]]:
    """Size of one file, and (lines of the body, arguments, name) of its functions that are long or wide."""
    tree = ast.parse(text)
    size = Size(
        lines=text.count("\n"),
        statements=sum(isinstance(node, ast.stmt) for node in ast.walk(tree)),
        docstrings=docstring_lines(tree),
        modules=int(text.count("\n") > LONG_MODULE),
    )
    notable = []
    for node in ast.walk(tree):
        if not isinstance(node, FunctionNode):
            continue
        names = decorator_names(node)
        long, count = body_lines(node), arguments(node)
        # The arguments of a command are its options.
        most = MANY_IN_A_KERNEL if names & COMPILED else MANY_ARGUMENTS
        wide = count > most and not names & {"command", "option", "argument"}
        size += Size(compiled=int(bool(names & COMPILED)), long=int(long > LONG_BODY), wide=int(wide))
        if long > LONG_BODY or wide:
            notable.append((long, count, node.name))
    return size, notable


def per_room(revision: str | None, long: bool = False) -> dict[str, Size]:
    """Size of every room of a revision (default: the work tree); ``long`` prints what is long or wide."""
    rooms: dict[str, Size] = defaultdict(Size)
    for path, text in sources(revision).items():
        size, notable = measure(text)
        rooms[room_of(path)] += size
        if long and path.parts[0] == "python":
            if size.modules:
                print(f"{path}: {size.lines} lines")
            for body, count, name in sorted(notable, reverse=True):
                print(f"{path}: {name}: body of {body} lines, {count} arguments")
    return rooms


def table(now: dict[str, Size], before: dict[str, Size] | None) -> str:
    """Markdown table, one row a room, each number as "before → now" where it changed."""

    def row(name: str, of: list[str]) -> str:
        new = sum((now.get(room, Size()) for room in of), Size())
        old = sum((before.get(room, Size()) for room in of), Size()) if before is not None else new
        cells = []
        for one in TITLES:
            then, today = getattr(old, one), getattr(new, one)
            cells.append(f"{today:,}" if then == today else f"{then:,} → {today:,}")
        return f"| {name} | " + " | ".join(cells) + " |"

    rooms = sorted(set(now) | set(before or {}))
    package = [room for room in rooms if room != "tests"]
    search = [room for room in package if room.startswith(SEARCH)]
    lines = ["| room | " + " | ".join(TITLES.values()) + " |", "|---|" + "--:|" * len(TITLES)]
    lines += [row(room, [room]) for room in package]
    lines.append(row("**package without the search**", [room for room in package if room not in search]))
    lines.append(row("**package**", package))
    lines.append(row("**tests**", ["tests"]))
    return "\n".join(lines)


def abilities(now: str | None, before: str) -> str:
    """Markdown table of the lines, outside the search, of files that are not in an older revision."""
    command = ["git", "-C", str(TOP), "diff", "-M30%", "--diff-filter=A", "--name-only", before]
    command += [now] if now else []
    listed = subprocess.run([*command, "--", "python"], check=True, capture_output=True, text=True).stdout
    texts = {str(path): text for path, text in sources(now).items() if not room_of(path).startswith(SEARCH)}
    added = {path: texts[path].count("\n") for path in listed.split() if path in texts}
    whole = sum(text.count("\n") for path, text in texts.items() if path.startswith("python"))
    rows, left = [("package without the search", whole)], dict(added)
    for name, pattern in ABILITIES.items():
        rows.append((name, -sum(left.pop(path) for path in list(left) if re.search(pattern, path))))
    rows.append(("**at the same abilities, at most**", sum(number for _, number in rows)))
    rows.append(("of these in new files", sum(left.values())))
    return "\n".join(
        ["| what | lines |", "|---|--:|", *(f"| {name} | {number:,} |" for name, number in rows)]
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--of", metavar="REV", help="revision to measure (default: the work tree)")
    parser.add_argument("--against", metavar="REV", help="revision to compare with")
    parser.add_argument("--long", action="store_true", help="name what is too long or too wide")
    parser.add_argument(
        "--abilities", action="store_true", help="what new files since --against hold, instead"
    )
    options = parser.parse_args()
    if options.abilities:
        print(abilities(options.of, options.against or parser.error("--abilities needs --against")))
        return
    now = per_room(options.of, options.long)
    print(table(now, per_room(options.against) if options.against else None))


if __name__ == "__main__":
    main()
