"""Kernels over whole meshes, called for a batch at a time: between calls whoever waits can interrupt them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ..kernels import Kernel

__all__ = ["batches", "walk"]

#: Faces or steps of one call: some hundredths of a second where memory is read at random.
_AT_ONCE = 1 << 16


def batches(count: int) -> Iterator[slice]:
    """Divide so many faces into runs for one call each."""
    for first in range(0, count, _AT_ONCE):
        yield slice(first, min(first + _AT_ONCE, count))


def walk(kernel: Kernel, *arguments: Any) -> int:
    """Call a kernel until it is done; its arrays hold what it knows. Returns what it says then, which is not 0."""
    result = 0
    while not result:
        result = kernel(*arguments, _AT_ONCE)
    return result
