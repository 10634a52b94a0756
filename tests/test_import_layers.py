"""Who may import whom: the table of doc/architecture.md, enforced by parsing the imports."""

import ast
import re
from pathlib import Path

import pytest

import lsst.fringe_sim

PACKAGE = Path(lsst.fringe_sim.__file__).parent
ROOT = "lsst.fringe_sim"
TABLE = Path(__file__).resolve().parents[1] / "doc" / "architecture.md"
ORDER = tuple(re.findall(r"`(errors < [^`]*)`", TABLE.read_text(encoding="utf-8"))[0].split(" < "))
ALLOWED: dict[str, set[str]] = {room: set(ORDER[: i + 1]) for i, room in enumerate(ORDER)}
UNKNOWN_TO_THE_MOCK = {"lazy", "style", "notebook", "fits_gate", "optics", "products", "model", "algorithms"}
ALLOWED["mock"] = set(ORDER) - UNKNOWN_TO_THE_MOCK | {"mock"}
ALLOWED["middleware"] = {
    "errors",
    "deprecation",
    "files",
    "resources",
    "instrument",
    "products",
    "middleware",
}
ALLOWED["tasks"] = set(ORDER) | {"middleware", "tasks"}
ALLOWED["paper"] = set(ORDER) | {"mock", "paper"}
ALLOWED["report"] = set(ORDER) - {"lazy", "notebook", "fits_gate", "effects"} | {"paper", "report"}
ALLOWED["challenge"] = set(ORDER) | {"mock", "report", "challenge"}
ALLOWED["cli"] = set(ORDER) | {"mock", "middleware", "tasks", "paper", "report", "challenge", "cli"}
ALLOWED["__main__"] = {"cli"}


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> set[str]:
    """Rooms of this package that a module imports, at any depth of nesting."""
    module = [ROOT, *path.relative_to(PACKAGE).with_suffix("").parts]
    if module[-1] == "__init__":
        module.pop()
        package = module
    else:
        package = module[:-1]
    base = ".".join(package).split(".")
    rooms: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            prefix = base[: len(base) - node.level + 1] if node.level else []
            start = ".".join([*prefix, *([node.module] if node.module else [])])
            names = [start, *(f"{start}.{alias.name}" for alias in node.names)]
        for name in names:
            if name.startswith(ROOT + "."):
                rooms.add(name.removeprefix(ROOT + ".").split(".")[0])
    return rooms & (set(ALLOWED) | {"errors", "files", "resources"})


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_imports_downward_only(path: Path) -> None:
    room = room_of(path)
    if room in ("config", "bps"):
        pytest.skip("configuration, not a module")
    assert room in ALLOWED, f"{room} has no place in the table"
    forbidden = imported_rooms(path) - ALLOWED[room]
    assert not forbidden, f"{room} may not import {sorted(forbidden)}"


def test_the_parser_sees_a_forbidden_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The law would notice: a relative and an absolute import of mock are both found."""
    fake = tmp_path / "algorithms" / "x.py"
    fake.parent.mkdir()
    monkeypatch.setattr(f"{__name__}.PACKAGE", tmp_path)
    for text in (
        "from ..mock.thickness import e2v_321",
        "import lsst.fringe_sim.mock",
        "from .. import mock",
    ):
        fake.write_text(text)
        assert "mock" in imported_rooms(fake), text
