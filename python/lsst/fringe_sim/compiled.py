"""Compiled functions: how they are declared, and the threads that call them.

Two decorators say who calls a function. A `kernel` is called from Python; a `subkernel` only by other compiled
functions, so that nothing is compiled which would let Python in. Both are kept in numba's cache, release the
interpreter lock and divide as numpy does, without a check for zero.

Where a compiled function calls another, the machine code of the second is there twice: on its own, and inside the
first, where it was optimized once more. With relaxed arithmetic the two may round differently, and which one is
called depends on whether the process has compiled them or found them in the cache. A relaxed `subkernel` is therefore
always put into what calls it, and no compiled function may call a relaxed `kernel`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba

__all__ = ["kernel", "processors", "run_threaded", "subkernel"]

_RELAXED = {"reassoc", "contract", "arcp", "nsz"}
"""Freedom of rounding; NaN and infinity keep their meaning."""


def kernel(function: Callable[..., Any] | None = None, *, relaxed: bool = False) -> Any:
    """Compile a function that Python calls.

    Parameters
    ----------
    function : callable, optional
        Numpy arrays and numbers in, and out.
    relaxed : `bool`, optional
        Whether sums and products may be reordered and contracted, as vector instructions need.
    """
    return _compiled(function, fastmath=_RELAXED if relaxed else False)


def subkernel(
    function: Callable[..., Any] | None = None, *, relaxed: bool = False, expand: bool = False
) -> Any:
    """Compile a function that only compiled functions call.

    Parameters
    ----------
    function : callable, optional
        As for `kernel`.
    relaxed : `bool`, optional
        As for `kernel`; the function is then always put into what calls it.
    expand : `bool`, optional
        Put the source, not the machine code, into what calls it: dearer to compile, for innermost loops that are
        faster so.
    """
    inside = {"inline": "always"} if expand else {"forceinline": True} if relaxed else {}
    return _compiled(
        function,
        fastmath=_RELAXED if relaxed else False,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        **inside,
    )


def _compiled(function: Callable[..., Any] | None, **options: Any) -> Any:
    decorate = numba.njit(cache=True, nogil=True, error_model="numpy", **options)
    return decorate if function is None else decorate(function)


def processors() -> int:
    """Number of threads that compiled functions use by default (``NUMBA_NUM_THREADS``)."""
    return int(numba.config.NUMBA_NUM_THREADS)


def run_threaded(work: Callable[[int], object], count: int, threads: int | None = None) -> None:
    """Call ``work(i)`` for every ``i < count``; each call writes to its own place, so order does not matter.

    Parameters
    ----------
    work : callable
        Releases the interpreter lock most of the time.
    count : `int`
        Number of calls.
    threads : `int`, optional
        Number of threads; that of `processors` if not given.
    """
    threads = min(processors() if threads is None else threads, count)
    if threads <= 1:
        for item in range(count):
            work(item)
        return
    # Interleaved shares: neighbouring strips cost about the same.
    with ThreadPoolExecutor(threads) as pool:
        for job in [pool.submit(_share, work, first, count, threads) for first in range(threads)]:
            job.result()


def _share(work: Callable[[int], object], first: int, count: int, threads: int) -> None:
    for item in range(first, count, threads):
        work(item)
