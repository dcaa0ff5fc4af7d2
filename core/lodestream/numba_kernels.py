"""The decorators behind every compiled loop."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import caching

__all__ = ["bare_kernel", "cache_folders", "inlined", "keep_no_more", "kernel", "strict_kernel", "unkept"]

_log = logging.getLogger(__name__)

#: numba's option to do without its run time, which makes arrays and counts references to them.
_UNCOUNTED: dict[str, Any] = {"_nrt": False}

_Function = TypeVar("_Function", bound=Callable[..., object])

_loops: list[Any] = []  # those that are kept on disk

_UNKEPT = (
    "Lodestream compiles its kernels anew in every process, which takes a minute or more: no folder in which they "
    "could be kept can be written; NUMBA_CACHE_DIR names one"
)
_kept = True


def unkept() -> str | None:
    """Why compiled kernels are not kept on disk, in a line; None where they are, or none was made yet."""
    return None if _kept else _UNKEPT


def _compiled(function: _Function, **options: Any) -> _Function:
    try:
        loop: Any = numba.njit(cache=True, nogil=True, **options)(function)
    except RuntimeError as error:
        if "no locator available" not in str(error):  # numba's words for want of a folder that can be written
            raise
    else:
        _loops.append(loop)
        return cast(_Function, loop)
    global _kept
    if _kept:
        _log.warning(_UNKEPT)
    _kept = False
    return cast(_Function, numba.njit(nogil=True, **options)(function))


def kernel(function: _Function) -> _Function:
    """Compile a plain loop at its first call, keep the machine code on disk, and run it without the interpreter's lock.

    Where no folder for it can be written, a warning is logged, and each process compiles for itself.

    Multiplications and additions may be fused: kernels either compute with integers that float64 holds exactly, where
    fusing changes nothing, or state the tolerance that they need.
    """
    return _compiled(function, fastmath={"contract"})


def bare_kernel(function: _Function) -> _Function:
    """Compile a loop like `kernel` that makes no array, and does not count references to those that it is given.

    Whoever calls it holds them. Where a loop calls others or takes views for a few samples at a time, counting would
    cost as much as the work.
    """
    return _compiled(function, fastmath={"contract"}, **_UNCOUNTED)


def inlined(function: _Function) -> _Function:
    """A part of a kernel that is compiled into each place that calls it: a call would cost more than the work.

    It makes no array and counts no references, see `bare_kernel`.
    """
    return cast(_Function, numba.njit(nogil=True, fastmath={"contract"}, forceinline=True, **_UNCOUNTED)(function))


def strict_kernel(function: _Function) -> _Function:
    """Compile a plain loop like `kernel`, but round after every operation: float64 results are those of numpy."""
    return _compiled(function)


def cache_folders() -> set[Path]:
    """Where the machine code of the loops is kept that are defined so far."""
    return {Path(loop.stats.cache_path) for loop in _loops}


def keep_no_more() -> None:
    """From now on compile what is not on the disk for this process alone, which may not write there.

    What is kept there is loaded by other processes, which trust it.
    """
    cache: Any = caching.Cache
    cache.save_overload = lambda *_: None
