"""Each setting is shared, and leaves a share to others, or is not shared, for a reason."""

from __future__ import annotations

import asyncio
import itertools
import shutil
from collections import Counter
from collections.abc import Callable
from contextlib import AsyncExitStack, ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lodestream import encode
from lodestream.protocol.messages import BASE_CREDIT
from lodestream.stores import Folder
from lodestream_server import Settings
from lodestream_server.access.access import Caller
from lodestream_server.access.limits import Limits
from lodestream_server.access.turns import Turns
from lodestream_server.builds.level_files import Key, LevelFiles
from lodestream_server.builds.level_maker import LevelMaker
from lodestream_server.problems import FullError, TooManyError
from lodestream_server.store.containers import Containers, OpenContainer, index_memory
from lodestream_server.store.surfaces import Surfaces
from tests.server.access.test_limits import ANNA, BERT, CARL, Disk, request
from tests.server.helpers import PATIENCE, hills
from tests.server.store.world import upload

# Containers and processes of levels that are not made.
nothing: Any = None
here: Any = SimpleNamespace(is_here=lambda _: True)  # containers that are files of this machine

#: Settings that are not shared, and why.
NOT_SHARED = {
    "host": "an address",
    "port": "an address",
    "data": "a path or an address",
    "read_only": "a switch",
    "scratch": "a path",
    "root_path": "a path",
    "trusted_proxies": "addresses",
    "insecure": "a switch",
    "unconfined": "a switch",
    "token_file": "a path",
    "public_reads": "a switch",
    "origins": "addresses",
    "formats": "a list of words",
    "keep_replaced_days": "a time; what it keeps counts as its owner's (max_surfaces, owner_bytes)",
    "log_format": "a word",
    "log_level": "a word",
    "log_reads": "a switch",
    "dask": "an address; builds go there in their turns (workers)",
    "upload_bytes": "of one upload",
    "upload_files": "of one upload",
    "partial_seconds": "a time; what it keeps counts as its owner's (max_partial_uploads, owner_bytes)",
    "max_vertices": "of one surface",
    "cache_bytes": "disk space for what can be fetched again; whoever reads gets its turn, and what is read stays",
    "keep_free": "disk space that nobody gets; the rest is shared (owner_bytes)",
    "threads": "of one build",
    "memory": "each build has its part of it (build_memory), whoever asked for it",
    "build_memory": "of one build",
    "build_seconds": "of one build",
    "level_memory": "of one process; levels are made in turns (max_level_requests)",
    "level_seconds": "of one level",
    "max_connections": "of all; a proxy limits those of an address (docs/operating.md)",
    "idle_seconds": "of one connection",
    "least_rate": "of one connection",
    "head_seconds": "of one connection",
    "bye_seconds": "of one connection",
    "lease_seconds": "of this server",
    "look_seconds": "of this server",
    "list_seconds": "of this server",
}


class Town:
    """Limits of a server, and the surfaces, builds and bytes that its callers have."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.settings = Settings(data=folder, keep_free=0, **settings)
        self.surfaces: Counter[str | None] = Counter()
        self.bytes: Counter[str | None] = Counter()
        self.limits = Limits(
            self.settings,
            (folder,),
            lambda owner: (self.surfaces.total(), self.surfaces[owner]),
            lambda owner: self.bytes[owner],
            lambda: False,
        )


def taken(take: Callable[[Caller], object], caller: Caller) -> int:
    """How many a caller gets before it is refused for what it has already."""
    for count in range(10_000):
        try:
            take(caller)
        except (TooManyError, FullError) as refusal:
            if "left for others" not in str(refusal):
                raise
            return count
    raise AssertionError("one caller takes everything")


def uploads(folder: Path) -> None:
    town = Town(folder, max_uploads=8)

    async def fill() -> list[int]:
        async with AsyncExitStack() as held:

            async def count(caller: Caller) -> int:
                for number in range(9):
                    try:
                        await held.enter_async_context(town.limits.upload(request(b""), caller))
                    except TooManyError:
                        return number
                raise AssertionError("one caller takes everything")

            return [await count(caller) for caller in (ANNA, BERT, CARL)]

    assert asyncio.run(fill()) == [4, 2, 1]


def surfaces(folder: Path) -> None:
    town = Town(folder, max_surfaces=8)

    async def upload(caller: Caller) -> None:
        async with town.limits.upload(request(b""), caller):
            pass
        town.surfaces[caller.owner] += 1

    def take(caller: Caller) -> None:
        asyncio.run(upload(caller))

    # A token of another name is another owner; one of the same name is not.
    assert [taken(take, caller) for caller in (ANNA, Caller("token x", "x", "anna"), BERT, CARL)] == [4, 0, 2, 1]
    # Those that are being uploaded count as well.
    town.surfaces.clear()
    town.surfaces["anna"] = 3

    async def two() -> None:
        async with town.limits.upload(request(b""), ANNA):
            await upload(ANNA)

    with pytest.raises(FullError, match="anna may have no more surfaces than are left for others"):
        asyncio.run(two())


def partial_uploads(folder: Path) -> None:
    town, there = Town(folder, max_partial_uploads=8), Counter[str | None]()

    def take(caller: Caller) -> None:
        town.limits.check_partial(caller, there.total(), there[caller.owner])
        there[caller.owner] += 1

    assert [taken(take, caller) for caller in (ANNA, BERT, CARL)] == [4, 2, 1]


def disk(folder: Path) -> None:
    town = Town(folder)
    free = 800

    def take(caller: Caller) -> None:
        nonlocal free
        asyncio.run(town.limits.check_owner(caller.owner))
        free -= 100
        town.bytes[caller.owner] += 100

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: Disk(1000, 0, free))
        for caller in (ANNA, BERT, CARL):
            assert taken(take, caller) >= 1
        assert free >= 0


def builds(folder: Path) -> None:
    town = Town(folder, max_builds=8)

    def take(caller: Caller) -> None:
        town.limits.builds.check(caller)
        town.limits.builds.add(caller.key)

    assert [taken(take, caller) for caller in (ANNA, BERT, CARL)] == [4, 2, 1]


def open_streams(folder: Path) -> None:
    town = Town(folder, max_streams=8)
    for places in (town.limits.stream, town.limits.openings.take):
        with ExitStack() as held:

            def take(caller: Caller, held: ExitStack = held, places: Any = places) -> None:
                held.enter_context(places(caller))

            assert [taken(take, caller) for caller in (ANNA, BERT, CARL)] == [4, 2, 1]


def memory_of_streams(folder: Path) -> None:
    memory = 64 << 20
    town = Town(folder, stream_memory=memory, max_streams=10_000)
    with ExitStack() as held:

        def credit(caller: Caller) -> int:
            return held.enter_context(town.limits.stream(caller)) - BASE_CREDIT

        of_anna = sum(credit(ANNA) for _ in range(1000))
        assert memory // 4 < of_anna <= memory // 2
        assert credit(BERT) >= memory // 32
        assert credit(CARL) >= memory // 64
        # Whoever has more than is left by now gets no more of it, and a stream all the same.
        for _ in range(1000):
            credit(BERT)
        assert credit(ANNA) == 0


def level_requests(folder: Path) -> None:
    town = Town(folder, max_level_requests=8)

    async def free() -> int:
        return 1 << 30

    async def fill() -> list[int]:
        queue = LevelMaker(town.settings, here, LevelFiles(folder / "levels", 1 << 20, free), nothing, town.limits)
        queue._runner._turns._free = 0  # nothing is made
        waiting: list[asyncio.Task[Any]] = []

        async def count(caller: Caller) -> int:
            for number in range(9):
                task = asyncio.create_task(queue.take(Key("a" * 64, len(waiting), "npy"), caller))
                await asyncio.sleep(0)
                if task.done():
                    assert isinstance(task.exception(), TooManyError)
                    return number
                waiting.append(task)
            raise AssertionError("one caller takes everything")

        counts = [await count(caller) for caller in (ANNA, BERT, CARL)]
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)
        return counts

    assert asyncio.run(fill()) == [4, 2, 1]


def tile_requests(folder: Path) -> None:
    town = Town(folder, max_tile_requests=8)
    with ExitStack() as held:

        def take(caller: Caller) -> None:
            held.enter_context(town.limits.tiles.take(caller))

        assert [taken(take, caller) for caller in (ANNA, BERT, CARL)] == [4, 2, 1]


def disk_of_levels(folder: Path) -> None:
    most = 4 << 20
    town = Town(folder)

    async def free() -> int:
        return 1 << 30

    async def fill() -> int:
        files = LevelFiles(folder / "levels", most, free)
        queue = LevelMaker(town.settings, here, files, nothing, town.limits)
        for number in range(1000):
            key = Key("a" * 64, number, "npy")
            work = files.new_folder(key)
            work.mkdir(parents=True)
            (work / "level").write_bytes(b"")
            files.add(key, work / "level", files.longest, kept=True).release()
            try:
                await queue.take(key, ANNA)
            except TooManyError:
                break
        return await files.make_room()

    assert asyncio.run(fill()) >= most // 8


def turns_of_builds(folder: Path) -> None:
    async def order() -> list[str]:
        turns, began = Turns(2, 600.0), list[str]()

        async def build(caller: Caller) -> None:
            async with turns.turn(caller.key):
                began.append(caller.name)
                await asyncio.sleep(0)

        async with asyncio.timeout(PATIENCE), asyncio.TaskGroup() as group:
            for caller in [*[ANNA] * 50, BERT]:
                group.create_task(build(caller))
        return began

    # As soon as one of those that run has ended.
    assert asyncio.run(order()).index("bert") <= 3


#: Settings that callers share, and what shows that one of them cannot take everything.
def test_memory_of_indexes_is_shared(tmp_path: Path) -> None:
    """An eighth of the machine's memory, which no setting says."""
    data = encode(hills(9, 8))
    names = [f"{number:064x}" for number in range(16)]
    surfaces = Surfaces(Folder(tmp_path / "data"), tmp_path / "index.sqlite")
    for number, name in enumerate(names):
        surfaces.accept(*upload(tmp_path, number))
        (tmp_path / name).write_bytes(data)
        surfaces.built(f"{number:020x}", tmp_path / name, name, {"levels": []})
    each = sum(index_memory(lambda offset, length: data[offset : offset + length], len(data)))
    containers, town = Containers(surfaces, 8 * each), Town(tmp_path)
    left, held = iter(names), dict[Caller, list[OpenContainer]]()

    def open_one(caller: Caller, name: str) -> None:
        share = partial(town.limits.check_index, caller)
        held.setdefault(caller, []).append(containers.open(name, caller.key, share))

    assert [taken(lambda caller: open_one(caller, next(left)), caller) for caller in (ANNA, BERT, CARL)] == [4, 2, 1]
    # What somebody has open already takes nothing more, and what is let go makes room.
    open_one(BERT, names[0])
    for opened in held.pop(ANNA):
        opened.close()
        opened.close()
    del opened
    assert taken(lambda caller: open_one(caller, next(left)), CARL) == 1
    for opened in itertools.chain.from_iterable(held.values()):
        opened.close()
    held.clear()
    assert containers._open == {}
    alone = Containers(surfaces, 8 * each)
    town.limits._indexes._alone = lambda: True
    several = [alone.open(name, ANNA.key, partial(town.limits.check_index, ANNA)) for name in names[:8]]
    for opened in several:
        opened.close()
    surfaces.close()


SHARED: dict[str, Callable[[Path], None]] = {
    "max_uploads": uploads,
    "max_surfaces": surfaces,
    "max_partial_uploads": partial_uploads,
    "owner_bytes": disk,
    "max_builds": builds,
    "max_streams": open_streams,
    "stream_memory": memory_of_streams,
    "max_level_requests": level_requests,
    "max_tile_requests": tile_requests,
    "level_disk": disk_of_levels,
    "workers": turns_of_builds,
}


def test_each_setting_is_shared_or_not_for_a_reason() -> None:
    assert SHARED.keys() | NOT_SHARED.keys() == Settings.model_fields.keys()
    assert not SHARED.keys() & NOT_SHARED.keys()


@pytest.mark.parametrize("name", SHARED)
def test_one_caller_cannot_take_all_of_it(name: str, tmp_path: Path) -> None:
    SHARED[name](tmp_path)


def test_builds_have_equal_parts_of_the_memory(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, workers=4, memory=8 << 30)
    assert settings.memory_of_build * settings.workers == 8 << 30
