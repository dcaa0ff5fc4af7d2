from __future__ import annotations

import asyncio
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import LodestreamError
from lodestream_client import AsyncClient, AsyncStream, Client
from tests.links import Fault, Link, linked
from tests.patience import PATIENCE

from ..asked import asked

Terrain = NDArray[np.float32]


def rms(points: Terrain, terrain: Terrain) -> float:
    return float(np.sqrt(np.mean((points.astype(float) - terrain) ** 2)))


def test_a_stream_ends_with_the_original(surface: str, terrain: Terrain) -> None:
    with Client(surface).connect(surface) as stream:
        views = list(stream)
    assert stream.ended == "complete"
    assert views[-1].complete
    assert np.array_equal(views[-1].points, terrain)
    assert stream.decoder.metadata is not None
    assert stream.decoder.metadata["name"] == "terrain"


def test_every_view_has_the_error_that_it_tells(surface: str, terrain: Terrain) -> None:
    with Client(surface).connect(surface) as stream:
        found = [(view.rms, rms(view.points, terrain)) for view in stream]
    assert len(found) > 10
    for told, measured in found:
        assert told == pytest.approx(measured, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("target", "ended"),
    [
        (ls.Target(until_rms=ls.Tolerance(1e-2, relative=True)), "rms"),
        (ls.Target(until_max=ls.Tolerance(20.0)), "max"),
        (ls.Target(max_bytes=1500), "bytes"),
        (ls.Target(level=3), "level"),
        (ls.Target(max_bytes=3000, order="level"), "bytes"),
    ],
)
def test_limits(surface: str, target: ls.Target, ended: str) -> None:
    with Client(surface).connect(surface, target=target) as stream:
        views = list(stream)
    assert stream.ended == ended
    assert stream.decoder.bytes == views[-1].bytes
    assert target.max_bytes is None or views[-1].bytes <= target.max_bytes
    assert target.until_max is None or views[-1].max_error <= 20.0
    assert target.level is None or views[-1].points_at(3).shape == stream.decoder.points_at(3).shape
    assert stream.decoder.metadata is not None, "an early stop that the plan knows brings the metadata"


def test_stop_takes_effect_at_once(surface: str) -> None:
    seen = 0
    with Client(surface).connect(surface, window=1024) as stream:
        for _ in stream:
            seen += 1
            if seen == 3:
                stream.stop()
        header = stream.header
    assert seen == 3
    assert stream.ended == "stopped"
    assert header is not None
    assert stream.wire_bytes < header.size / 2


def test_leaving_the_block_stops(surface: str) -> None:
    with Client(surface).connect(surface, window=1024) as stream:
        first = next(stream)
    assert stream.ended == "stopped"
    assert first.number == 0
    with pytest.raises(StopIteration):
        next(stream)


def test_an_exception_inside_the_block_is_not_hidden(surface: str) -> None:
    stream = Client(surface).connect(surface, window=1024)

    def fail() -> None:
        with stream:
            next(stream)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert stream.ended == "stopped"


def test_stop_from_another_thread(surface: str) -> None:
    with Client(surface).connect(surface, window=1024, limit_rate=2000.0) as stream:
        next(stream)
        thread = threading.Thread(target=stream.stop)
        thread.start()
        list(stream)
        thread.join()
    assert stream.ended == "stopped"
    assert stream.header is not None
    assert stream.wire_bytes < stream.header.size / 2


@pytest.mark.usefixtures("paced")
def test_seconds(surface: str) -> None:
    with Client(surface).connect(surface, target=ls.Target(seconds=1.0), limit_rate=4000.0) as stream:
        views = list(stream)
    assert stream.ended == "seconds"
    assert views
    assert not views[-1].complete


def test_a_limited_rate_limits_what_is_under_way(surface: str) -> None:
    with Client(surface).connect(surface, target=ls.Target(max_bytes=1500), limit_rate=8000.0) as stream:
        views = list(stream)
    assert stream.ended == "bytes"
    assert views[-1].bytes <= 1500


def test_streams_for_asyncio(surface: str, terrain: Terrain) -> None:
    async def whole() -> tuple[list[ls.View], AsyncStream]:
        async with AsyncClient(surface) as client, client.connect(surface) as stream:
            views = [view async for view in stream]
        return views, stream

    views, stream = asyncio.run(whole())
    assert stream.ended == "complete"
    assert np.array_equal(views[-1].points, terrain)


def test_stop_for_asyncio(surface: str, terrain: Terrain) -> None:
    async def some() -> tuple[ls.View, AsyncStream]:
        async with AsyncClient(surface) as client, client.connect(surface, window=1024) as stream:
            async for view in stream:
                if view.rms < 20.0:
                    await stream.stop()
                    last = view
        return last, stream

    view, stream = asyncio.run(some())
    assert stream.ended == "stopped"
    assert view.rms == pytest.approx(rms(view.points, terrain), rel=1e-6)


def test_leaving_early_and_seconds_for_asyncio(surface: str) -> None:
    async def early() -> str | None:
        async with AsyncClient(surface) as client, client.connect(surface, window=1024) as stream:
            async for _ in stream:
                break
        return stream.ended

    async def late() -> str | None:
        async with (
            AsyncClient(surface) as client,
            client.connect(surface, target=ls.Target(seconds=0.3), limit_rate=4000.0) as stream,
        ):
            async for _ in stream:
                pass
        return stream.ended

    assert asyncio.run(early()) == "stopped"
    assert asyncio.run(late()) == "seconds"


def test_a_cancelled_stream_closes_its_connection(surface: str) -> None:
    async def cancelled() -> AsyncStream:
        stream = AsyncClient(surface).connect(surface, limit_rate=1000.0)

        async def follow() -> None:
            async with stream:
                async for _ in stream:
                    started.set()

        started = asyncio.Event()
        task = asyncio.create_task(follow())
        await started.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return stream

    stream = asyncio.run(cancelled())
    assert stream.ended == "stopped"


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_an_iteration_that_is_cancelled_may_be_continued(surface: str, terrain: Terrain, transport: Any) -> None:
    async def impatient() -> tuple[list[ls.View], AsyncStream, int]:
        views, cancelled = [], 0
        async with (
            AsyncClient(surface) as client,
            client.connect(surface, transport=transport, window=1024, limit_rate=100_000.0) as stream,
        ):
            while stream.ended is None:
                try:
                    async with asyncio.timeout(0.02):
                        views.append(await anext(stream))
                except TimeoutError:
                    cancelled += 1
                except StopAsyncIteration:
                    break
        return views, stream, cancelled

    views, stream, cancelled = asyncio.run(impatient())
    assert cancelled > 0
    assert stream.ended == "complete"
    assert np.array_equal(views[-1].points, terrain)


def test_upload_tells_progress_and_list_and_delete_follow(server: str, terrain_file: Path) -> None:
    stages: list[tuple[str, float]] = []
    surface = Client(server).upload(
        terrain_file, precision="0.1%", name="Hills", progress=lambda *stage: stages.append(stage)
    )
    assert surface.ready
    assert surface.details["exact"] is False
    assert ("sending", 1.0) in stages
    assert [it.details["name"] for it in Client(server).list() if it.url == surface.url] == ["Hills"]
    assert Client(surface.url).get(surface.url).details["levels"]
    Client(surface.url).delete(surface.url)
    assert surface.url not in [it.url for it in Client(server).list()]
    with pytest.raises(ls.NotFoundError):
        Client(surface.url).get(surface.url)


def test_upload_of_bytes_and_of_a_surface(server: str, terrain_file: Path) -> None:
    points = np.random.default_rng(3).normal(size=(8, 12, 3))
    surface = Client(server).upload(ls.Surface(points, (True, True), metadata={"name": "Ring"}))
    assert surface.details["closed"] == [True, True]
    assert surface.details["name"] == "Ring"
    assert Client(server).upload(terrain_file.read_bytes()).ready


def test_upload_for_asyncio(server: str, terrain_file: Path) -> None:
    async def everything() -> tuple[bool, bool]:
        async with AsyncClient(server) as client:
            surface = await client.upload(terrain_file, precision=2.0)
            there = surface.url in [it.url for it in await client.list()]
            await client.delete(surface.id)
            return there, surface.url in [it.url for it in await client.list()]

    assert asyncio.run(everything()) == (True, False)


def test_uploads_for_a_root_mean_square_error(server: str, terrain_file: Path) -> None:
    wanted = 0.01 * float(np.ptp(np.load(terrain_file).astype(float)))
    surface = Client(server).upload(terrain_file, rms="1%")
    assert surface.details["exact"] is False
    assert 0 < surface.details["layers"][-1]["rms"] <= wanted
    again = asyncio.run(asked(server, lambda it: it.upload(terrain_file, rms=ls.Tolerance(0.01, relative=True))))
    assert again.url == surface.url
    assert again.details["options"] == {"rms": "1%"}


def test_an_upload_has_one_error_at_most() -> None:
    nowhere = "http://127.0.0.1:1"  # refused before anything is sent
    with pytest.raises(ls.OptionError, match="not both"):
        Client(nowhere).upload(b"", precision=1.0, rms=1.0)
    with pytest.raises(ls.OptionError, match="not both"):
        asyncio.run(asked(nowhere, lambda it: it.upload(b"", precision="1", rms="1")))
    with pytest.raises(ls.OptionError, match="not an error bound"):
        Client(nowhere).upload(b"", rms="much")
    with pytest.raises(ls.OptionError, match="rms is not an option of a format"):
        Client(nowhere).upload(b"", options={"rms": "1"})


def test_a_bad_upload_is_the_core_s_error(server: str) -> None:
    with pytest.raises(ls.FormatError, match="not a file of a format that is read"):
        Client(server).upload(b"not a surface")
    with pytest.raises(ls.OptionError, match="nonsense"):
        Client(server).upload(ls.Surface(np.eye(5)), options={"nonsense": "1"})


def test_no_such_surface(server: str) -> None:
    with (
        pytest.raises(ls.NotFoundError, match=r"^No surface '0123456789abcdef0123' on this server$"),
        Client(f"{server}/v1/surfaces/0123456789abcdef0123").connect(
            f"{server}/v1/surfaces/0123456789abcdef0123"
        ) as stream,
    ):
        next(stream)


def test_a_level_that_does_not_exist(surface: str) -> None:
    with (
        pytest.raises(ls.OptionError, match="expected a level of 0 to"),
        Client(surface).connect(surface, target=ls.Target(level=99)) as stream,
    ):
        next(stream)


def test_the_client_of_the_manual_works(surface: str, terrain: Terrain) -> None:
    page = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text()
    code = page.partition("## A client in Python")[2].partition("```python\n")[2].partition("```")[0]
    host, _, name = surface.removeprefix("http://").partition("/v1/surfaces/")
    names: dict[str, Any] = {"host": host, "id": name}
    exec(compile(code.replace("max_bytes=20_000", "max_bytes=9_000"), "docs/protocol.md", "exec"), names)
    assert names["reception"].ended == "bytes"
    assert names["surface"].points.shape == terrain.shape
    assert names["reception"].decoder.rms == pytest.approx(rms(names["surface"].points, terrain), rel=1e-6)


def come(link: Link, count: int) -> None:
    """Wait until so many bytes have come over a link."""
    end = time.monotonic() + PATIENCE
    while link.down < count:
        assert time.monotonic() < end
        time.sleep(0.005)


#: Bytes of the end of a connection, for which nobody waits.
CLOSING = 100


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_the_latest_view_is_that_of_all_that_has_come(surface: str, terrain: Terrain, transport: Any) -> None:
    with linked(surface, Fault()) as link:
        with Client(link.url).connect(link.url, transport=transport, window=1 << 18) as stream:
            everything = len(list(stream))
        first = link.down
        with Client(link.url).connect(link.url, transport=transport, window=1 << 18) as stream:
            views = []
            for view in stream.latest():
                views.append(view)
                come(link, 2 * first - CLOSING)
    assert stream.ended == "complete"
    assert np.array_equal(views[-1].points, terrain)
    assert [view.bytes for view in views] == sorted({view.bytes for view in views})
    assert len(views) <= everything / 3


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_the_latest_view_is_awaited_too(surface: str, terrain: Terrain, transport: Any) -> None:
    async def follow(link: Link) -> list[Any]:
        async with (
            AsyncClient(link.url) as client,
            client.connect(link.url, transport=transport, window=1 << 18) as stream,
        ):
            views = []
            async for view in stream.latest():
                views.append(view)
                come(link, 2 * first - CLOSING)
        assert stream.ended == "complete"
        return views

    with linked(surface, Fault()) as link:
        with Client(link.url).connect(link.url, transport=transport, window=1 << 18) as stream:
            list(stream)
        first = link.down
        views = asyncio.run(follow(link))
    assert np.array_equal(views[-1].points, terrain)
    assert len(views) <= 10


def test_what_came_before_an_error_is_seen_before_it(surface: str) -> None:
    with (
        linked(surface, Fault(cut_down=4000)) as link,
        Client(link.url).connect(link.url, transport="ws", deadline=0.0) as stream,
    ):
        views = []

        def draw() -> None:
            for view in stream.latest():
                views.append(view)
                come(link, 4000)

        with pytest.raises(LodestreamError):
            draw()
    assert stream.ended == "truncated"
    assert views[-1].bytes == stream.decoder.view().bytes
