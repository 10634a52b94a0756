"""Compiled functions give the same bits in the process that compiles them and in every later one.

Where a compiled function calls another, the machine code of the second is there twice: on its own, and inside
the first, where it was optimized once more. With relaxed arithmetic the two may round differently, and which one is
called depends on whether the process has compiled them or found them in the cache. A function in the cache that may
be rounded freely must therefore be a part of whatever calls it.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

import lsst.fringe_sim
from lsst.fringe_sim.compiled import one_blas_thread, subkernel

OF_TWO_TYPES = {
    f"lsst.fringe_sim.{name}._frame_kernel" for name in ("model.response_table", "algorithms.field_response")
}
"""Maps are float32 in files and float64 from a simulation; converting a full sensor takes as long as its frame."""

PACKAGE = Path(lsst.fringe_sim.__file__).parent


def compiled(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef, str, set[str]]]:
    """Every function of a module that is compiled, the name of its decorator, and its options."""
    for node in tree.body:
        for decorator in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
            call = decorator.func if isinstance(decorator, ast.Call) else decorator
            name = ast.unparse(call).rpartition(".")[2]
            if name in ("njit", "jit", "vectorize", "guvectorize", "kernel", "subkernel"):
                options = decorator.keywords if isinstance(decorator, ast.Call) else []
                assert isinstance(node, ast.FunctionDef)
                yield node, name, {str(item.arg) for item in options}


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


def in_compiled_functions(trees: dict[Path, ast.Module]) -> set[tuple[str, str]]:
    """Last word of the module, and name, of all that compiled functions call."""
    used: set[tuple[str, str]] = set()
    for path, tree in trees.items():
        names = {name for function, _, _ in compiled(tree) for name in called(function)}
        used |= {(path.stem, name) for name in names}
        used |= {(module, name) for module, name in imported(tree) if name in names}
    return used


def test_freely_rounded_functions_are_parts_of_their_callers() -> None:
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    used = in_compiled_functions(trees)
    assert len(used) > 50
    offenders = [
        f"{path.relative_to(PACKAGE)}: {function.name}"
        for path, tree in trees.items()
        for function, decorator, options in compiled(tree)
        if (path.stem, function.name) in used
        and (
            (decorator == "kernel" and "relaxed" in options)
            or ({"fastmath", "cache"} <= options and not {"inline", "forceinline"} & options)
        )
    ]
    assert offenders == []


def test_a_relaxed_subkernel_is_put_into_what_calls_it() -> None:
    for options in ({"relaxed": True}, {"relaxed": True, "expand": True}):
        compiled_with = subkernel(lambda x: x, **options).targetoptions
        assert compiled_with["fastmath"]
        assert compiled_with.get("forceinline") or compiled_with.get("inline") == "always"
        assert compiled_with["no_cpython_wrapper"]
        assert compiled_with["no_cfunc_wrapper"]


def test_every_function_is_compiled_once() -> None:
    """One version of each: another costs seconds of everybody's first command."""
    script = (
        "import gc\n"
        "from numba.core.dispatcher import Dispatcher\n"
        "from lsst.fringe_sim.algorithms.warm_up import FIRST\n"
        "for work in FIRST.values():\n"
        "    work()\n"
        "for item in gc.get_objects():\n"
        "    if isinstance(item, Dispatcher) and item.py_func.__module__.startswith('lsst.fringe_sim'):\n"
        "        assert item.targetoptions['nogil'], item  # or threads would wait for each other\n"
        "        assert item.targetoptions['error_model'] == 'numpy', item  # a division by 0 is no exception\n"
        "        print(item.py_func.__module__, item.py_func.__name__, len(item.overloads))\n"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    versions = {
        f"{module}.{name}": int(number) for module, name, number in map(str.split, shown.splitlines())
    }
    assert sum(number > 0 for number in versions.values()) > 10
    assert {name for name, number in versions.items() if number > 1} <= OF_TWO_TYPES


def test_one_thread_of_the_linear_algebra() -> None:
    @one_blas_thread
    def threads(size: int) -> set[int]:
        np.eye(size) @ np.eye(size)
        return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}

    with threadpool_limits(limits=2, user_api="blas"):
        assert threads(3) <= {1}
