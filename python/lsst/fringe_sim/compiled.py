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

import functools
import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np
from numba.core import caching
from numpy.typing import ArrayLike, DTypeLike, NDArray
from threadpoolctl import threadpool_limits

_P = ParamSpec("_P")
_T = TypeVar("_T")

_LOG = logging.getLogger(__name__)

_RELAXED = {"reassoc", "contract", "arcp", "nsz"}  # Freedom of rounding; NaN and infinity keep their meaning


def kernel(
    function: Callable[..., Any] | None = None, *, relaxed: bool | set[str] = False, parallel: bool = False
) -> Any:
    """Compile a function that Python calls.

    ``function``: numpy arrays and numbers in, and out.
    ``relaxed``: whether sums and products may be reordered and contracted, as vector instructions need; or
        which of the freedoms of rounding of LLVM.
    ``parallel``: whether its loops over ``prange`` run in threads of numba.
    """
    return _compiled(function, fastmath=_RELAXED if relaxed is True else relaxed, parallel=parallel)


def subkernel(
    function: Callable[..., Any] | None = None, *, relaxed: bool = False, expand: bool = False
) -> Any:
    """Compile a function that only compiled functions call.

    ``function``: as for `kernel`.
    ``relaxed``: as for `kernel`; the function is then always put into what calls it.
    ``expand``: put the source, not the machine code, into what calls it: dearer to compile, for innermost
        loops that are faster so.
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
    def decorate(inner: Callable[..., Any]) -> Any:
        try:
            made = numba.njit(cache=_keep[0], nogil=True, error_model="numpy", **options)(inner)
        except RuntimeError as error:
            if not _keep[0]:
                raise
            _keep[0] = False
            _LOG.warning(
                "compiled functions cannot be kept (%s); every process compiles them again, for a minute or so. "
                "Set NUMBA_CACHE_DIR to a folder that can be written.",
                error,
            )
            return decorate(inner)
        _work_without_cache(made, _kept_for_all(inner))
        return made

    return decorate if function is None else decorate(function)


_keep = [True]


def _kept_for_all(function: Callable[..., Any]) -> Any:
    """What ``NUMBA_CACHE_DIR`` keeps of a function, where it can be read and not written, as in an image.

    Numba itself looks only into folders that it can write. `None`: it does so here, or there is nothing.
    """
    folder = numba.config.CACHE_DIR
    if not folder or os.access(folder, os.W_OK):
        return None
    try:
        return _cache_for_all()(function)
    except RuntimeError:  # nothing of the package of this function
        return None


@functools.cache
def _cache_for_all() -> type:
    # Since 0.61 the name has no underscore.
    names = "UserProvidedCacheLocator", "_UserProvidedCacheLocator"
    provided = next(getattr(caching, name) for name in names if hasattr(caching, name))

    class Locator(provided):  # type: ignore[misc,valid-type]
        def ensure_cache_path(self) -> None:
            if not os.path.isdir(self.get_cache_path()):
                raise FileNotFoundError(self.get_cache_path())

    class Implementation(caching.CompileResultCacheImpl):
        _locator_classes = (Locator,)

    class Cache(caching.FunctionCache):
        _impl_class = Implementation

    return Cache


def _work_without_cache(dispatcher: Any, for_all: Any) -> None:
    """Let a function be compiled where what is kept of it cannot be written, on a full disk, or is damaged.

    Numba passes both errors on, and they would end the command that calls the function.
    ``for_all``: what is looked into first, and never written.
    """
    cache = getattr(dispatcher, "_cache", None)
    if cache is None:  # compilation is switched off
        return
    save, load = cache.save_overload, cache.load_overload

    def save_if_possible(signature: Any, data: Any) -> None:
        try:
            save(signature, data)
        except OSError as error:
            _say_once("compiled functions cannot be kept", error)

    def load_if_possible(signature: Any, context: Any) -> Any:
        try:
            found = None if for_all is None else for_all.load_overload(signature, context)
            return load(signature, context) if found is None else found
        except Exception as error:  # whatever unpickling half a file raises
            _say_once("a compiled function that was kept cannot be read", error)
            with suppress(OSError):
                cache.flush()  # it is kept anew
            return None

    cache.save_overload, cache.load_overload = save_if_possible, load_if_possible


def _say_once(what: str, error: Exception) -> None:
    if what not in _said:
        _said.add(what)
        reason = f"{type(error).__name__}: {error}"
        _LOG.warning("%s (%s); it is compiled anew, for a minute or so in each process.", what, reason)


_said: set[str] = set()


def contiguous(array: ArrayLike, dtype: DTypeLike | None = None) -> NDArray[Any]:
    """Array as kernels know it, so that each is compiled once: contiguous and writable; a copy if it has to be."""
    return np.require(array, dtype, ["C", "W"])


def processors() -> int:
    """Number of threads that compiled functions use by default: ``NUMBA_NUM_THREADS``, or what was set."""
    return int(_limit[0] or numba.config.NUMBA_NUM_THREADS)


def limit_threads(threads: int | None) -> None:
    """Set how many threads compiled functions use by default in this process; all again with `None`."""
    _limit[0] = threads


_limit: list[int | None] = [None]


def one_blas_thread(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Run a function with one thread in the matrix products of numpy and scipy.

    With more, sums are made in other parts and round otherwise, and a choice between two fits may hang on that.
    """

    @functools.wraps(function)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


def run_threaded(work: Callable[[int], object], count: int, threads: int | None = None) -> None:
    """Call ``work(i)`` for every ``i < count``; each call writes to its own place, so order does not matter.

    ``work``: releases the interpreter lock most of the time.
    ``count``: number of calls.
    ``threads``: number of threads; that of `processors` if not given.
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


def run_shares(work: Callable[[int, int], object], count: int, least: int) -> None:
    """Call ``work(first, last)`` on shares of ``range(count)`` in threads.

    ``work``: as for `run_threaded`; what it does for one item must not depend on the share.
    ``count``: number of items.
    ``least``: items of a share that are worth a thread.
    """
    shares = max(1, min(_SHARES * processors(), count // max(least, 1))) if processors() > 1 else 1
    edges = [share * count // shares for share in range(shares + 1)]
    run_threaded(lambda share: work(edges[share], edges[share + 1]), shares)


_SHARES = 4  # Shares per thread: some cost more than others
