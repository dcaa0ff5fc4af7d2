"""The one decorator behind every compiled loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

__all__ = ["inlined", "kernel", "strict_kernel"]

_Function = TypeVar("_Function", bound=Callable[..., object])


def kernel(function: _Function) -> _Function:
    """Compile a plain loop at its first call, keep the machine code on disk, and run it without the interpreter's lock.

    Multiplications and additions may be fused: kernels either compute with integers that float64 holds exactly, where
    fusing changes nothing, or state the tolerance that they need.
    """
    return cast(_Function, numba.njit(cache=True, nogil=True, fastmath={"contract"})(function))


def inlined(function: _Function) -> _Function:
    """A part of a kernel that is compiled into each place that calls it: a call would cost more than the work."""
    return cast(_Function, numba.njit(nogil=True, fastmath={"contract"}, forceinline=True)(function))


def strict_kernel(function: _Function) -> _Function:
    """Compile a plain loop like `kernel`, but round after every operation: float64 results are those of numpy."""
    return cast(_Function, numba.njit(cache=True, nogil=True)(function))
