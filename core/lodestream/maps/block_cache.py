"""Decoded blocks of heights, at most so many bytes of them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError

__all__ = ["BlockCache"]


class BlockCache:
    """Arrays by key; those that were used least recently leave first. Several fields and threads may share one.

    Parameters
    ----------
    max_bytes : int
        Of all arrays together. A larger array is handed on and not kept.

    Raises
    ------
    OptionError
        If it is negative.

    Examples
    --------
    >>> import numpy
    >>> from lodestream.maps import BlockCache
    >>> cache = BlockCache(1000)
    >>> cache.get("a", lambda: numpy.zeros(100)).shape, cache.bytes
    ((100,), 800)
    >>> cache.get("b", lambda: numpy.zeros(100)).shape, cache.bytes
    ((100,), 800)
    """

    def __init__(self, max_bytes: int = 64 << 20) -> None:
        if max_bytes < 0:
            raise OptionError(f"expected a cache of 0 bytes or more, got {max_bytes}")
        self.max_bytes = max_bytes
        self._kept: OrderedDict[Hashable, NDArray[Any]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """What the arrays take now."""
        return self._bytes

    def get(self, key: Hashable, make: Callable[[], NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the array of a key, of any shape; `make` makes it where it is not kept. It must not be changed.

        Two threads that ask for the same at once may both make it: nobody waits for another's work.
        """
        with self._lock:
            if (found := self._kept.get(key)) is not None:
                self._kept.move_to_end(key)
                return found
        made = make()
        with self._lock:
            if made.nbytes <= self.max_bytes and key not in self._kept:
                self._kept[key] = made
                self._bytes += made.nbytes
                while self._bytes > self.max_bytes:
                    self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return made
