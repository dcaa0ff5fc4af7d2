"""What one caller may have beside others: uploads, builds, promises, and bytes on the disk."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest

from lodestream_server.access.limits import Limits
from lodestream_server.operation.settings import Settings
from lodestream_server.problems import BusyError, FullError, TooManyError
from lodestream_server.store.index import LEAST, Index, Surface
from lodestream_server.store.layout import Manifest
from lodestream_server.store.partial_uploads import Declared, PartialUploads
from tests.server.access.test_limits import ANNA, BERT, CARL, Disk, limits, read, request
from tests.server.helpers import PATIENCE


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    size = {"free": 1000}
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Disk(100_000, 0, size["free"]))
    return size


@pytest.mark.parametrize(("most", "shares"), [(1, (1, 0, 0)), (2, (1, 1, 0)), (8, (4, 2, 1)), (64, (32, 16, 8))])
def test_of_uploads_each_caller_leaves_some_to_the_next(tmp_path: Path, most: int, shares: tuple[int, ...]) -> None:
    made = limits(tmp_path, alone=False, max_uploads=most)

    async def together() -> None:
        async with asyncio.timeout(PATIENCE):
            async with asyncio.TaskGroup() as group:
                done = asyncio.Event()

                async def hold(caller: Any, entered: asyncio.Future[None]) -> None:
                    try:
                        async with made.upload(request(b"x"), caller):
                            entered.set_result(None)
                            await done.wait()
                    except (TooManyError, BusyError) as error:
                        entered.set_exception(error)

                async def take(caller: Any) -> None:
                    entered = asyncio.get_running_loop().create_future()
                    group.create_task(hold(caller, entered))
                    await entered

                left = most
                for caller, share in zip((ANNA, BERT, CARL), shares, strict=True):
                    for _ in range(share):
                        await take(caller)
                    left -= share
                    kind = TooManyError if left else BusyError
                    with pytest.raises(
                        kind, match=f"{caller.name} may have no more uploads" if left else f"at most {most} uploads"
                    ):
                        await take(caller)
                done.set()
        assert (made._uploads._total, made._clocks) == (0, {})
        assert not made._promised
        assert not made._taken

    asyncio.run(together())


def test_builds_of_one_caller_leave_some_to_the_others(tmp_path: Path) -> None:
    def made(builds: int, own: int, alone: bool = False) -> Any:
        return limits(tmp_path, builds=builds, own=own, alone=alone, max_builds=10)

    asyncio.run(read(made(4, 4), request(b"x")))
    with pytest.raises(TooManyError, match="anna may have no more pending builds"):
        asyncio.run(read(made(5, 5), request(b"x")))
    asyncio.run(read(made(5, 5), request(b"x"), BERT))
    asyncio.run(read(made(9, 9, alone=True), request(b"x")))
    with pytest.raises(BusyError, match="This server has at most 10 pending builds"):
        asyncio.run(read(made(10, 0), request(b"x")))


def test_promises_are_counted_for_whoever_makes_them(tmp_path: Path, disk: dict[str, int]) -> None:
    made = limits(tmp_path, keep_free=0, owner_bytes=10**6)

    async def together() -> None:
        async with ExitStackOf(made) as held:
            await held.begin(ANNA, 1000)
            with pytest.raises(FullError, match="all uploads of anna"):
                await read(made, request(b"", length=1))
            # Nothing of it has come: there is room for the others, and for as much.
            assert await read(made, request(b"y" * 900, length=900), BERT) == b"y" * 900
            disk["free"] = 500
            with pytest.raises(FullError, match="of bert"):
                await read(made, request(b"", length=501), BERT)
            assert await read(made, request(b"y", length=500), BERT) == b"y"

    asyncio.run(together())


class ExitStackOf:
    """Uploads that have begun and go on until the end."""

    def __init__(self, made: Any) -> None:
        self._made = made
        self._held: list[Any] = []

    async def __aenter__(self) -> ExitStackOf:
        return self

    async def begin(self, caller: Any, length: int) -> Any:
        upload = self._made.upload(request(b"x" * 6, b"", length=length), caller)
        watched = await upload.__aenter__()
        self._held.append(upload)
        return watched

    async def __aexit__(self, *error: object) -> None:
        for upload in reversed(self._held):
            await upload.__aexit__(None, None, None)


@pytest.mark.parametrize(
    ("kept", "length", "fits"), [(0, 500, True), (0, 501, False), (400, 300, True), (400, 301, False)]
)
def test_an_owner_keeps_as_much_as_stays_free(
    tmp_path: Path, disk: dict[str, int], kept: int, length: int, fits: bool
) -> None:
    made = limits(tmp_path, kept=kept, alone=False, keep_free=0)
    if fits:
        asyncio.run(read(made, request(b"x", length=length)))
        return
    with pytest.raises(FullError, match="anna may have no more bytes of surfaces than are left for others"):
        asyncio.run(read(made, request(b"x", length=length)))
    asyncio.run(read(made, request(b"x", length=500), BERT))
    asyncio.run(read(limits(tmp_path, kept=kept, alone=True, keep_free=0), request(b"x", length=length)))


def test_the_share_of_an_owner_may_be_chosen(tmp_path: Path, disk: dict[str, int]) -> None:
    for alone in (False, True):
        made = limits(tmp_path, kept=90, alone=alone, keep_free=0, owner_bytes=100)
        asyncio.run(read(made, request(b"x", length=10)))
        with pytest.raises(FullError, match="anna may have at most 100 bytes of surfaces, and has 90 and 11 more"):
            asyncio.run(read(made, request(b"x", length=11)))
        asyncio.run(read(made, request(b"x", length=100), BERT))


def test_an_upload_that_does_not_say_its_size_stops_at_its_owners_share(tmp_path: Path, disk: dict[str, int]) -> None:
    disk["free"] = 1 << 40
    made = limits(tmp_path, keep_free=0, owner_bytes=20 << 20)
    with pytest.raises(FullError, match="anna may have at most"):
        asyncio.run(read(made, request(*[bytes(1 << 24)] * 3)))
    # What was promised and taken for good stays good, whatever comes beside it.
    assert len(asyncio.run(read(made, request(bytes(1 << 24), b"x", length=(1 << 24) + 1), BERT))) == (1 << 24) + 1


def test_each_byte_of_a_part_counts_once(tmp_path: Path, disk: dict[str, int]) -> None:
    """As it is written, at the end of the part while its request goes on, and once there is the surface."""
    disk["free"] = 1 << 40
    stored = {"anna": 0}  # what the index counts

    async def together() -> None:
        uploads = PartialUploads(tmp_path / "partial", 8, 3600.0)
        made = Limits(
            Settings(data=tmp_path, keep_free=0, owner_bytes=1000),
            (tmp_path,),
            lambda _: (0, 0),
            lambda owner: uploads.kept(owner) + stored.get(owner or "", 0),
            lambda: True,
        )

        async def has(size: int) -> None:
            """Anna has so many bytes: what is left of her 1,000 may be taken, and not one more."""
            await read(made, request(b"", length=1000 - size))
            with pytest.raises(FullError, match=f"has {size} and {1001 - size} more"):
                await read(made, request(b"", length=1001 - size))

        upload = await uploads.create(Declared("anna", 900, (), None, None, ""))
        for offset, size in ((0, 600), (600, 300)):
            chunks = [bytes(size // 3)] * 3
            async with (
                upload.continued(offset),
                made.upload(request(*chunks, length=size), ANNA, is_part=True) as watched,
            ):

                async def blocks(arrived: int, watched: Any = watched) -> AsyncIterator[bytes]:
                    async for block in watched.stream():
                        if block:
                            yield block
                            arrived += len(block)
                            assert uploads.kept("anna") == arrived

                await upload.append(blocks(offset))
                await has(offset + size)
                if upload.is_complete:
                    stored["anna"] = 900
                    await upload.finish("surface")
                    await has(900)
            assert not made._taken

    asyncio.run(together())


@pytest.fixture
def index(tmp_path: Path) -> Iterator[Index]:
    index = Index(tmp_path / "index.sqlite", "tests")
    yield index
    index.close()


def surface(id_: str, owner: str | None, upload: str, container: str | None = None, size: int = 30) -> Surface:
    """A surface of an upload of 100 bytes."""
    it = Manifest(id_, None, owner, 1.0, ("a",), {}, upload, 100, "w")
    return Surface(it, "queued" if container is None else "ready", None, 0, container, size if container else None)


def test_what_is_kept_is_counted_once_for_each_owner(index: Index) -> None:
    def kept(*owners: str | None) -> list[int]:
        return [index.kept(owner) for owner in owners]

    index.put(surface("1", "anna", "up"))
    index.put(surface("2", "anna", "up", "c"))
    assert kept("anna", "bert", None) == [130 + 2 * LEAST, 0, 0]
    index.put(surface("3", "bert", "up", "c"))
    index.put(surface("4", None, "up"))
    assert kept("anna", "bert", None) == [130 + 2 * LEAST, 130 + LEAST, 100 + LEAST]
    index.put(surface("1", "anna", "up", "c"))
    index.drop("2")
    assert kept("anna") == [130 + LEAST]
    # A container that is lost, and built again, goes on to count: its place is taken again.
    index.put(replace(surface("1", "anna", "up", "c"), state="queued"))
    assert kept("anna") == [130 + LEAST]
    for id_ in "1234":
        index.drop(id_)
    assert kept("anna", "bert", None) == [0, 0, 0]


def test_what_is_kept_is_what_a_count_of_all_surfaces_gives(index: Index) -> None:
    random, known = Random(7), dict[str, Surface]()
    for _ in range(500):
        id_ = str(random.randrange(12))
        if random.random() < 0.3:
            index.drop(id_)
            known.pop(id_, None)
        else:
            number = random.randrange(4)
            container = random.choice([None, f"c{number}"])
            owner = random.choice(["anna", "bert", None])
            known[id_] = surface(id_, owner, random.choice("xy"), container, 10 + number)
            index.put(known[id_])
        for owner in ("anna", "bert", None):
            own = [each for each in known.values() if each.manifest.owner == owner]
            things = {each.manifest.upload: 100 for each in own}
            things |= {each.container: each.container_bytes or 0 for each in own if each.container is not None}
            assert index.kept(owner) == sum(things.values()) + LEAST * len(own)
