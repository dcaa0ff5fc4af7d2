"""Calls of kernels over whole meshes in batches, between which Python can handle an interrupt."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ..kernels import Kernel

__all__ = ["batches", "walk"]

#: Faces or steps of one call: some hundredths of a second where memory is read at random.
_STEPS_PER_CALL = 1 << 16


def batches(count: int) -> Iterator[slice]:
    """Divide ``count`` faces into slices for one call each."""
    for first in range(0, count, _STEPS_PER_CALL):
        yield slice(first, min(first + _STEPS_PER_CALL, count))


def walk(kernel: Kernel, *arguments: Any) -> int:
    """Call a kernel until it is done, and return its last result, which is not 0; its arrays hold the state."""
    result = 0
    while not result:
        result = kernel(*arguments, _STEPS_PER_CALL)
    return result
