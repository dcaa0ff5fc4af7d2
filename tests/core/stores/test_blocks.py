from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from lodestream.stores import StoreError
from lodestream.stores.blocks import BLOCK, Blocks, Extent

SIZE = 10 * BLOCK + 1000
DATA = random.Random(1).randbytes(SIZE)
WHOLE = Extent("a", SIZE)


class Source:
    """An object, and what was asked of it."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []
        self.fail = 0
        self.shorter = 0
        self.gate = threading.Event()
        self.gate.set()
        self._lock = threading.Lock()

    def fetch(self, name: str, offset: int, length: int) -> bytes:
        with self._lock:
            self.asked.append((offset, length))
            failing, self.fail = self.fail > 0, max(0, self.fail - 1)
        self.gate.wait()
        if failing:
            raise StoreError("lost")
        return DATA[offset : offset + length - self.shorter]


@pytest.fixture
def pool() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(4) as pool:
        yield pool


def settled(pool: ThreadPoolExecutor) -> None:
    """Wait until all that was asked for ahead has come."""
    together = threading.Barrier(5)
    for _ in range(4):
        pool.submit(together.wait)
    together.wait()


def test_any_part_of_an_object_is_read(pool: ThreadPoolExecutor) -> None:
    source, numbers = Source(), random.Random(2)
    blocks = Blocks(source.fetch, pool, most=3 * BLOCK)
    for _ in range(300):
        offset, length = numbers.randrange(SIZE + 100), numbers.choice([0, 1, 1000, BLOCK, 3 * BLOCK, SIZE])
        assert blocks.read(WHOLE, offset, length) == DATA[offset : offset + length]
        at_once = blocks.read_at_once(WHOLE, offset, length)
        assert at_once in (None, DATA[offset : offset + length])
        assert at_once is None or len(at_once) == length


def test_a_stream_of_slices_asks_for_each_block_once_and_in_advance(pool: ThreadPoolExecutor) -> None:
    source = Source()
    blocks = Blocks(source.fetch, pool)
    assert blocks.read(WHOLE, 0, 100) == DATA[:100]
    settled(pool)
    assert sorted(source.asked) == [(0, BLOCK), (BLOCK, BLOCK)]
    for offset in range(0, SIZE, 16 << 10):
        blocks.read(WHOLE, offset, 16 << 10)
    settled(pool)
    one, two = [(0, BLOCK), (BLOCK, BLOCK)], range(2 * BLOCK, SIZE, 2 * BLOCK)
    assert sorted(source.asked) == [*one, *((offset, min(2 * BLOCK, SIZE - offset)) for offset in two)]


def test_neighbours_are_asked_for_together(pool: ThreadPoolExecutor) -> None:
    source = Source()
    blocks = Blocks(source.fetch, pool)
    assert blocks.read(WHOLE, 10, SIZE) == DATA[10:]
    assert sorted(source.asked) == [(0, 8 * BLOCK), (8 * BLOCK, SIZE - 8 * BLOCK)]


def test_what_is_there_is_not_asked_for_again(pool: ThreadPoolExecutor) -> None:
    source = Source()
    blocks = Blocks(source.fetch, pool)
    blocks.read(WHOLE, 3 * BLOCK, 1)
    settled(pool)
    blocks.read(WHOLE, 0, SIZE)
    assert sorted(source.asked)[:2] == [(0, 3 * BLOCK), (3 * BLOCK, BLOCK)]
    assert sum(length for _, length in source.asked) == SIZE


def test_many_readers_wait_for_one_request(pool: ThreadPoolExecutor) -> None:
    source = Source()
    source.gate.clear()
    blocks = Blocks(source.fetch, pool)
    with ThreadPoolExecutor(8) as readers:
        reads = [readers.submit(blocks.read, WHOLE, 100, 1000) for _ in range(50)]
        source.gate.set()
        assert {read.result() for read in reads} == {DATA[100:1100]}
    settled(pool)
    assert sorted(source.asked) == [(0, BLOCK), (BLOCK, BLOCK)]


def test_a_failure_is_told_and_may_pass(pool: ThreadPoolExecutor) -> None:
    source = Source()
    blocks = Blocks(source.fetch, pool)
    source.fail = 2  # of the block and of the one ahead
    with pytest.raises(StoreError, match="lost"):
        blocks.read(WHOLE, 0, 10)
    settled(pool)
    assert blocks.read_at_once(WHOLE, 0, 10) is None
    assert blocks.read(WHOLE, 0, 10) == DATA[:10]


def test_an_object_that_is_shorter_than_was_said_is_an_error(pool: ThreadPoolExecutor) -> None:
    source = Source()
    source.shorter = 5
    with pytest.raises(StoreError, match=r"a: expected 262,144 bytes at byte 0, got 262,139"):
        Blocks(source.fetch, pool).read(WHOLE, 0, 10)


def test_an_interrupted_reader_leaves_nobody_waiting(pool: ThreadPoolExecutor) -> None:
    def interrupted(*_: object) -> bytes:
        raise KeyboardInterrupt

    blocks = Blocks(interrupted, pool)
    last = SIZE - 1  # no block behind it
    with pytest.raises(KeyboardInterrupt):
        blocks.read(WHOLE, last, 1)
    assert blocks.read_at_once(WHOLE, last, 1) is None
    with pytest.raises(KeyboardInterrupt):
        blocks.read(WHOLE, last, 1)


def test_memory_is_bounded(pool: ThreadPoolExecutor) -> None:
    source = Source()
    blocks = Blocks(source.fetch, pool, most=4 * BLOCK)
    for name in "abcdef":
        blocks.read(Extent(name, SIZE), 0, BLOCK)
        settled(pool)
    kept = [number for name in "abcdef" for number in range(11) if at_once(blocks, name, number)]
    assert len(kept) == 4
    assert at_once(blocks, "f", 0)
    assert not at_once(blocks, "a", 0)


def at_once(blocks: Blocks, name: str, number: int) -> bool:
    return blocks.read_at_once(Extent(name, SIZE), number * BLOCK, 1) is not None


def test_after_the_program_has_ended_its_pool_reads_go_on() -> None:
    ended = ThreadPoolExecutor(1)
    ended.shutdown()
    assert Blocks(Source().fetch, ended).read(WHOLE, 0, SIZE) == DATA
