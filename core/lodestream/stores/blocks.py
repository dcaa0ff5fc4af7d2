"""Reads of objects in buckets: in blocks, joined to few requests, some in advance, within bounded memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass

from .answers import check_process, wait_for
from .errors import StoreError

__all__ = ["BLOCK", "Blocks", "Extent"]

#: Bytes of a block.
BLOCK = 256 << 10
#: Blocks that one request asks for at most.
_JOINED = 8
#: Blocks of one read that are asked for at once.
_AT_ONCE = 16
#: Bytes of blocks that are kept: with what requests take beside them, 64 MiB of memory.
_KEPT = 60 << 20


@dataclass(frozen=True)
class Extent:
    """An object that never changes, and its bytes.

    Attributes
    ----------
    name : str
    size : int
    """

    name: str
    size: int

    def length(self, block: int) -> int:
        """Return the bytes of a block."""
        return min(BLOCK, self.size - block * BLOCK)


_Key = tuple[Extent, int]


class Blocks:
    """Blocks of objects in memory; who wants one that is on its way waits for it.

    A request costs a round trip, whatever it brings: by slices of a stream, a whole container takes twenty times as
    long. So a read asks for whole blocks, neighbours in one request, and for the block behind them; of one that goes on
    behind another for two. The least recently used blocks go first.

    Parameters
    ----------
    fetch : callable
        Reads bytes of an object, by name, offset and length; raises `StoreError`.
    pool : Executor
        Carries out requests beside the one for which a reader waits.
    most : int
        Bytes of blocks that are kept or on their way.
    """

    def __init__(self, fetch: Callable[[str, int, int], bytes], pool: Executor, most: int = _KEPT) -> None:
        self._fetch = fetch
        self._pool = pool
        self._most = most
        self._lock = threading.Lock()
        self._blocks: OrderedDict[_Key, Future[bytes]] = OrderedDict()
        self._bytes = 0

    def read(self, extent: Extent, offset: int, length: int) -> bytes:
        """Read bytes of an object; fewer where it ends.

        Raises
        ------
        StoreError
            If they cannot be read, or the object is shorter than was said; or in a process that was forked since.
        """
        check_process()
        end = min(offset + length, extent.size)
        pieces: list[bytes] = []
        while offset < end:
            first = offset // BLOCK
            behind = min(first + _AT_ONCE, -(-end // BLOCK))
            for number, block in enumerate(self._wanted(extent, first, behind), first):
                pieces.append(wait_for(block)[max(offset - number * BLOCK, 0) : end - number * BLOCK])
            offset = behind * BLOCK
        return b"".join(pieces)

    def read_at_once(self, extent: Extent, offset: int, length: int) -> bytes | None:
        """Read exactly so many bytes if they are in memory; otherwise return None.

        Raises
        ------
        StoreError
            In a process that was forked since.
        """
        check_process()
        if offset + length > extent.size:
            return None
        first, behind = offset // BLOCK, -(-(offset + length) // BLOCK)
        with self._lock:
            blocks = [self._blocks.get((extent, number)) for number in range(first, behind)]
        there = [block.result() for block in blocks if block and block.done() and not block.exception()]
        if len(there) < len(blocks):
            return None
        start = offset - first * BLOCK
        return b"".join(there)[start : start + length]

    def _wanted(self, extent: Extent, first: int, behind: int) -> list[Future[bytes]]:
        """Return the blocks from one to before another; what is not there is on its way, and so is the one behind."""
        with self._lock:
            missing = [number for number in range(first, behind) if (extent, number) not in self._blocks]
            ahead = self._ahead(extent, first, behind)
            for number in [*missing, *ahead]:
                self._blocks[extent, number] = Future()
                self._bytes += extent.length(number)
            wanted = [self._blocks[extent, number] for number in range(first, behind)]
            for number in range(first, behind):
                self._blocks.move_to_end((extent, number))
            runs = [*_runs(missing), *([ahead] if ahead else [])]
            requests = [[self._blocks[extent, number] for number in run] for run in runs]
            starts = [run[0] for run in runs]
            self._evict()
        # The first one here, where somebody waits for it; all others meanwhile.
        own = bool(missing)
        for start, blocks in list(zip(starts, requests, strict=True))[own:]:
            try:
                self._pool.submit(self._bring, extent, start, blocks)
            except RuntimeError:  # the program ends
                self._bring(extent, start, blocks)
        if own:
            self._bring(extent, starts[0], requests[0])
        return wanted

    def _ahead(self, extent: Extent, first: int, behind: int) -> list[int]:
        """Return the blocks to ask for in advance: one of whoever begins, two of whoever goes on."""
        most = behind + (2 if (extent, first - 1) in self._blocks else 1)
        if (extent, behind) in self._blocks:
            return []
        numbers = range(behind, min(most, -(-extent.size // BLOCK)))
        return [number for number in numbers if (extent, number) not in self._blocks]

    def _bring(self, extent: Extent, first: int, blocks: list[Future[bytes]]) -> None:
        """Fetch neighbours in one request; who waits for them is told if that fails, and it may be tried again."""
        start, length = first * BLOCK, sum(extent.length(first + number) for number in range(len(blocks)))
        try:
            data = self._fetch(extent.name, start, length)
            if len(data) != length:
                raise StoreError(f"{extent.name}: expected {length:,} bytes at byte {start:,}, got {len(data):,}")
        except BaseException as error:
            with self._lock:
                for number, block in enumerate(blocks, first):
                    if self._blocks.get((extent, number)) is block:
                        self._drop((extent, number))
            told = error if isinstance(error, StoreError) else StoreError(f"{extent.name}: reading was interrupted")
            for block in blocks:
                block.set_exception(told)
            if told is not error:
                raise
            return
        for number, block in enumerate(blocks):
            block.set_result(data[number * BLOCK : (number + 1) * BLOCK])

    def _evict(self) -> None:
        for key in [key for key, block in self._blocks.items() if block.done()]:
            if self._bytes <= self._most:
                return
            self._drop(key)

    def _drop(self, key: _Key) -> None:
        del self._blocks[key]
        self._bytes -= key[0].length(key[1])


def _runs(numbers: list[int]) -> Iterator[list[int]]:
    """Group ascending numbers into runs of neighbours, each of which one request may ask for."""
    run: list[int] = []
    for number in numbers:
        if run and (number != run[-1] + 1 or len(run) == _JOINED):
            yield run
            run = []
        run.append(number)
    if run:
        yield run
