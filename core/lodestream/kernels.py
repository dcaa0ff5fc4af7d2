"""The decorators behind every compiled loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

__all__ = ["bare_kernel", "inlined", "kernel", "strict_kernel"]

#: numba's option to do without its run time, which makes arrays and counts references to them.
_UNCOUNTED: dict[str, Any] = {"_nrt": False}

_Function = TypeVar("_Function", bound=Callable[..., object])


def kernel(function: _Function) -> _Function:
    """Compile a plain loop at its first call, keep the machine code on disk, and run it without the interpreter's lock.

    Multiplications and additions may be fused: kernels either compute with integers that float64 holds exactly, where
    fusing changes nothing, or state the tolerance that they need.
    """
    return cast(_Function, numba.njit(cache=True, nogil=True, fastmath={"contract"})(function))


def bare_kernel(function: _Function) -> _Function:
    """Compile a loop like `kernel` that makes no array, and does not count references to those that it is given.

    Whoever calls it holds them. Where a loop calls others or takes views for a few samples at a time, counting would
    cost as much as the work.
    """
    return cast(_Function, numba.njit(cache=True, nogil=True, fastmath={"contract"}, **_UNCOUNTED)(function))


def inlined(function: _Function) -> _Function:
    """A part of a kernel that is compiled into each place that calls it: a call would cost more than the work.

    It makes no array and counts no references, see `bare_kernel`.
    """
    return cast(_Function, numba.njit(nogil=True, fastmath={"contract"}, forceinline=True, **_UNCOUNTED)(function))


def strict_kernel(function: _Function) -> _Function:
    """Compile a plain loop like `kernel`, but round after every operation: float64 results are those of numpy."""
    return cast(_Function, numba.njit(cache=True, nogil=True)(function))
