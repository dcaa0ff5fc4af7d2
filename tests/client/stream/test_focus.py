"""The focus of a stream over real sockets, by either transport, while the link breaks."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from random import Random

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import OptionError
from lodestream.target import Region
from lodestream.transfer.receiver_state import MemoryStore
from lodestream_client import AsyncClient, AsyncStream, Client, Stream
from lodestream_client.stream import reconnecting
from tests.links import Fault, linked
from tests.patience import PATIENCE

NEAR: Region = ((0, 50), (0, 60))
FAR: Region = ((350, 420), (350, 400))
Heights = NDArray[np.int16]


@pytest.fixture(autouse=True)
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconnecting, "_FIRST_PAUSE", 0.002)
    monkeypatch.setattr(reconnecting, "_LONGEST_PAUSE", 0.05)


@pytest.fixture(scope="module")
def heights() -> Heights:
    rows, columns = np.mgrid[:420, :400]
    noise = np.random.default_rng(3).normal(size=rows.shape)
    made: Heights = np.rint(3000 * np.sin(rows / 80) * np.cos(columns / 60) + 20 * noise).astype(np.int16)
    return made


@pytest.fixture(scope="module")
def surface(server: str, heights: Heights) -> str:
    return Client(server).upload(ls.Surface(heights)).url


def container(surface: str) -> bytes:
    return httpx.get(f"{surface}/container", follow_redirects=True, timeout=PATIENCE).content


def check(stream: Stream | AsyncStream, surface: str, heights: Heights) -> None:
    assert stream.ended == "complete"
    assert np.array_equal(stream.decoder.surface().points, heights)
    assert stream.received == stream.planned == stream.decoder.bytes
    # All of the container, but for the footer: nothing twice.
    assert stream.data_bytes <= len(container(surface))


def near_first(views: list[ls.View], region: Region, heights: Heights) -> float:
    """The share of the bytes after which the window of a region is exact."""
    place = tuple(slice(*span) for span in region)
    first = next(view for view in views if np.array_equal(view.window(region).points, heights[place]))
    return first.bytes / views[-1].bytes


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_what_is_looked_at_comes_first(surface: str, heights: Heights, transport: reconnecting.Transport) -> None:
    with Client(surface).connect(surface, transport=transport) as plain:
        assert near_first(list(plain), NEAR, heights) > 0.8
    with Client(surface).connect(surface, transport=transport, window=4096) as stream:
        stream.focus(NEAR)
        views = list(stream)
    check(stream, surface, heights)
    # A request that is under way is read on where little of it is left.
    assert near_first(views, NEAR, heights) < (0.7 if transport == "ws" else 0.85)


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_what_is_looked_at_comes_first_for_asyncio(
    surface: str, heights: Heights, transport: reconnecting.Transport
) -> None:
    async def run() -> tuple[AsyncStream, list[ls.View]]:
        async with AsyncClient(surface) as client, client.connect(surface, transport=transport, window=4096) as stream:
            views = [await anext(stream)]
            await stream.focus(FAR)
            views += [view async for view in stream]
        return stream, views

    stream, views = asyncio.run(run())
    check(stream, surface, heights)
    assert near_first(views, FAR, heights) < (0.7 if transport == "ws" else 0.85)


@pytest.mark.parametrize("transport", ["ws", "http"])
@pytest.mark.parametrize("seed", range(4))
def test_looking_here_and_there_over_a_link_that_breaks(
    surface: str, heights: Heights, transport: reconnecting.Transport, seed: int
) -> None:
    random = Random(seed)
    lengths = [random.randrange(3000, 60_000) for _ in range(6)]

    def fault(number: int) -> Fault:
        return Fault(cut_down=lengths[number]) if number < len(lengths) else Fault()

    with linked(surface, fault) as link, Client(link.url).connect(link.url, transport=transport, window=4096) as stream:
        for number, _ in enumerate(stream):
            if number % 3 == 0:
                stream.focus(random.choice([NEAR, FAR, None]))
        check(stream, surface, heights)
        assert stream.connections > 3
        assert stream._reception.data_bytes == stream._reception.cached.total


def test_looking_elsewhere_from_another_thread(surface: str, heights: Heights) -> None:
    with Client(surface).connect(surface, window=4096) as stream:
        over = threading.Event()

        def look() -> None:
            for number in range(200):
                stream.focus([NEAR, FAR, None][number % 3])
                if over.wait(0.002):
                    return

        other = threading.Thread(target=look)
        other.start()
        views = list(stream)
        over.set()
        other.join()
        assert views[-1].complete
        check(stream, surface, heights)


def test_what_is_kept_on_disk_is_not_sent_again(surface: str, heights: Heights) -> None:
    class Kept(MemoryStore):
        def used(self, offset: int, length: int) -> None:
            """Forget nothing."""

    store, known = Kept(), Client(surface).identify(surface)
    assert known.size is not None
    with Client(surface).connect(
        surface, window=4096, store=store, container=known.container_sha256, size=known.size
    ) as first:
        for view in first:
            first.focus(FAR)
            if view.number > 9:
                break
    held = store.ranges.total
    assert 0 < held < known.size / 2
    with Client(surface).connect(
        surface, window=4096, store=store, container=known.container_sha256, size=known.size
    ) as second:
        second.focus(NEAR)
        for _ in second:
            pass
        check(second, surface, heights)
        assert second.data_bytes + held == second._reception.cached.total


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_a_region_that_is_not_there(surface: str, transport: reconnecting.Transport) -> None:
    with Client(surface).connect(surface, transport=transport, window=4096) as stream:
        next(stream)
        with pytest.raises(OptionError, match="expected rows within 0:420"):
            stream.focus(((0, 421), (0, 1)))
        assert next(stream)


def test_a_surface_of_several_blocks_has_no_regions(server: str, tmp_path: Path) -> None:
    sheet = np.random.default_rng(1).normal(size=(30, 30, 3))
    ls.write(ls.Surface(blocks=[ls.Block(sheet), ls.Block(sheet + 9)]), tmp_path / "sheets.obj")
    blocks = Client(server).upload(tmp_path / "sheets.obj").url
    with Client(blocks).connect(blocks, window=500) as stream:
        next(stream)
        with pytest.raises(OptionError, match="expected a surface of one block for a region, got 2 blocks"):
            stream.focus(NEAR)
