"""What is imported is declared, and what scripts import is there."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import lsst.fringe_sim

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE = Path(lsst.fringe_sim.__file__).parent
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def imports(tree: ast.AST, inside: bool = False) -> Iterator[tuple[str, bool]]:
    """Modules that are imported, and whether in a function or for types only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, inside) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            # A module without anything of its own gives modules: `from lsst.pipe import base`.
            yield from ((f"{node.module}.{alias.name}", inside) for alias in node.names)
        types_only = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        later = inside or types_only or isinstance(node, ast.FunctionDef)
        yield from imports(node, later)


def distribution(module: str) -> str:
    """Distribution that holds a module, in the spelling of `plain`."""
    parts = module.split(".")
    if parts[0] == "mpl_toolkits":
        return "matplotlib"
    if parts[0] == "lsst":
        return "-".join(parts[: 3 if parts[1] in ("ctrl", "daf", "pex", "pipe") else 2])
    return plain(_distributions().get(parts[0], [parts[0]])[0])


@cache
def _distributions() -> dict[str, list[str]]:
    return dict(packages_distributions())


def plain(requirement: str) -> str:
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-").replace(".", "-")


def test_every_import_of_the_package_is_declared() -> None:
    always = {plain(name) for name in PROJECT["dependencies"]}
    extras = {plain(name) for group in PROJECT["optional-dependencies"].values() for name in group}
    found = {
        (distribution(module), later)
        for path in PACKAGE.rglob("*.py")
        for module, later in imports(ast.parse(path.read_text(encoding="utf-8")))
        if module.partition(".")[0] not in sys.stdlib_module_names
    }
    assert ("numpy", False) in found
    missing = {name for name, later in found if name not in (always | extras if later else always)}
    assert missing == {"lsst-afw"}  # a part of the stack of Rubin that no package index has


@pytest.mark.parametrize("path", sorted((CHECKOUT / "scripts").glob("*.py")), ids=lambda path: path.name)
def test_a_script_finds_what_it_imports(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(path.parent))
    spec = importlib.util.spec_from_file_location(f"script_{path.stem}", path)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)  # type: ignore[union-attr]
    finally:
        del sys.modules[spec.name]
