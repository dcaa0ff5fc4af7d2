"""Limits on the memory that decoding a container may take, computed from its header before memory is allocated.

A header of a few hundred bytes can announce a surface of billions of points. So the memory that it implies is added up
first:

- for each point of each block and for every channel, attributes included: what the coder keeps of a coefficient (7
  bytes; more in blocks of few rows or columns, because of the edges of their bands), an integer each in a
  reconstruction and in the next one (16 bytes), and the value twice; with masks 4 bytes more;
- for each tile of each channel, and for each block: 2 KiB.

A second budget of the same size counts what is read: every byte, and tables with the size they have after parsing.
Surfaces and views that the caller keeps are not counted, nor is memory for writing a file.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from functools import cached_property, lru_cache
from pathlib import Path

from ..errors import TooLargeError
from ..operating_system import memory_of_machine, memory_of_process

__all__ = ["BYTES_PER_VERTEX", "Capacity", "Extent", "default_memory", "memory_limit"]

#: What a vertex of a capacity stands for: three coordinates in float64 take somewhat less.
BYTES_PER_VERTEX = 128

# In any case: headers, metadata, the tables of small surfaces.
_LEAST = 16 * 1024 * 1024

# Of the memory that this process can have: the surface takes as much, and what is read of its container as well.
_SHARE = 0.4

_COEFFICIENT, _RECONSTRUCTION, _MASKS, _TABLE = 7, 16, 4, 2048
_EDGE = 12  # rows or columns

# The files of control groups take longer to read than the first view of a stream to decode, so they are read so often.
_SECONDS_OF_LIMITS = 5.0

#: Rows and columns of a grid, and the bytes of a number in each of its channels.
Extent = tuple[tuple[int, int], Iterable[int]]


class Capacity:
    """A memory limit for one container; it counts what has been read.

    Parameters
    ----------
    max_vertices : int or None
        Allows this many vertices and `BYTES_PER_VERTEX` bytes for each, plus 16 MiB. None: two fifths of the memory
        available to this process, see `memory_limit`.
    """

    def __init__(self, max_vertices: int | None = None) -> None:
        self.max_vertices = max_vertices
        self._read = 0

    @cached_property
    def bytes(self) -> int:
        """Bytes allowed for the surface, and again for what is read; at least `_LEAST`."""
        if self.max_vertices is None:
            return max(int(memory_limit() * _SHARE), _LEAST)
        return _LEAST + self.max_vertices * BYTES_PER_VERTEX

    def promise(self, vertices: int, grids: Iterable[Extent], *, masked: int, tables: int) -> None:
        """Refuse a surface that needs more memory than this.

        Parameters
        ----------
        vertices : int
            Vertices to be decoded.
        grids : iterable of ((rows, columns), bytes of a number in each channel)
            Grids to be decoded.
        masked : int
            Points for which masks are kept.
        tables : int
            Tiles of all channels, plus blocks.

        Raises
        ------
        TooLargeError
        """
        if self.max_vertices is not None and vertices > self.max_vertices:
            raise TooLargeError(f"expected at most {self.max_vertices:,} vertices (max_vertices), got {vertices:,}")
        needed = masked * _MASKS + tables * _TABLE
        for (rows, columns), sizes in grids:
            edges = (1 + _EDGE / rows) * (1 + _EDGE / columns)
            bytes_per_point = sum(_RECONSTRUCTION + 2 * size + _COEFFICIENT * edges for size in sizes)
            needed += int(rows * columns * bytes_per_point)
        if needed > _LEAST and needed > self.bytes:  # the limit of the machine takes files to read
            enough = -(-(needed - _LEAST) // BYTES_PER_VERTEX)
            raise TooLargeError(
                f"expected a surface that takes at most {_size(self.bytes)} to decode "
                f"({self._words}), got one of {vertices:,} vertices that takes {_size(needed)}; "
                f"max_vertices={max(enough, vertices)} allows it"
            )

    def take(self, count: int) -> None:
        """Count bytes that are read and kept, or that tables take after parsing.

        Raises
        ------
        TooLargeError
            If there are more than a surface of this size can have.
        """
        self._read += count
        if self._read > _LEAST and self._read > self.bytes:
            raise TooLargeError(
                f"expected a container whose data take at most {_size(self.bytes)} ({self._words}), got more"
            )

    @property
    def _words(self) -> str:
        if self.max_vertices is not None:
            return f"max_vertices={self.max_vertices}, at {BYTES_PER_VERTEX} bytes each"
        return f"{_SHARE:.0%} of the available memory"


def memory_limit() -> int:
    """Return the memory available to this process in bytes: the least limit of machine, control group and process.

    A change of a control group's limit is seen after five seconds.
    """
    groups = _group_limit(time.monotonic() // _SECONDS_OF_LIMITS)
    return min(filter(None, (memory_of_machine(), groups, *memory_of_process())), default=1 << 32)


def default_memory() -> int:
    """Return a quarter of the memory that this process may have, in bytes: what encoding or a check may take."""
    return memory_limit() // 4


@lru_cache(maxsize=1)
def _group_limit(period: float) -> int | None:
    """Return the least limit of the control groups in a period of time; None if there is none."""
    return min(_group_limits(), default=None)


def _group_limits(proc: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> Iterator[int]:
    """Yield the limits of the control groups of this process in bytes."""
    try:
        lines = proc.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            folder, name = root, "memory.max"
        elif "memory" in controllers.split(","):
            folder, name = root / "memory", "memory.limit_in_bytes"
        else:
            continue
        within = Path(path.lstrip("/"))
        for group in (within, *within.parents):
            try:
                text = (folder / group / name).read_text().strip()
            except OSError:
                continue
            if text.isdecimal():
                yield int(text)


def _size(count: int) -> str:
    """Format a size in MiB."""
    return f"{count / 2**20:,.0f} MiB"
