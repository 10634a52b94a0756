"""Compiled functions give the same bits in the process that compiles them and in every later one.

Where a compiled function calls another, the machine code of the second is there twice: on its own, and inside
the first, where it was optimized once more. With relaxed arithmetic the two may round differently, and which one is
called depends on whether the process has compiled them or found them in the cache. A function in the cache that may
be rounded freely must therefore be a part of whatever calls it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import lsst.fringe_sim

PACKAGE = Path(lsst.fringe_sim.__file__).parent


def compiled(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef, set[str]]]:
    """Every function of a module that is compiled with numba, and the names of the options."""
    for node in tree.body:
        for decorator in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
            call = decorator.func if isinstance(decorator, ast.Call) else decorator
            if ast.unparse(call) in ("numba.njit", "njit"):
                options = decorator.keywords if isinstance(decorator, ast.Call) else []
                assert isinstance(node, ast.FunctionDef)
                yield node, {str(item.arg) for item in options}


def called(function: ast.FunctionDef) -> set[str]:
    """Names that a function calls, but its own."""
    names = {
        node.func.id
        for node in ast.walk(function)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    return names - {function.name}


def imported(tree: ast.Module) -> set[tuple[str, str]]:
    """What a module has from others of this package: last word of the module, and name."""
    return {
        ((node.module or "").rpartition(".")[2], item.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.level
        for item in node.names
    }


def test_freely_rounded_functions_are_parts_of_their_callers() -> None:
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    used: set[tuple[str, str]] = set()
    for path, tree in trees.items():
        names = {name for function, _ in compiled(tree) for name in called(function)}
        used |= {(path.stem, name) for name in names}
        used |= {(module, name) for module, name in imported(tree) if name in names}
    assert len(used) > 50
    offenders = [
        f"{path.relative_to(PACKAGE)}: {function.name}"
        for path, tree in trees.items()
        for function, options in compiled(tree)
        if {"fastmath", "cache"} <= options
        and not {"inline", "forceinline"} & options
        and (path.stem, function.name) in used
    ]
    assert offenders == []
