"""Levels as files: made in a process of their own, kept in bounded room, for as long as somebody waits for them."""

from __future__ import annotations

import asyncio
import io
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import anyio
import httpx
import numpy as np
import pytest
from fastapi import Request
from numpy.typing import NDArray

from lodestream import Block, Surface, encode
from lodestream_server import running, running_server
from lodestream_server.access.access import key_of
from lodestream_server.access.tokens import TokenFile
from lodestream_server.builds import level_maker, worker
from lodestream_server.builds.answers import Refusal
from lodestream_server.builds.level_files import Key, LevelFiles
from lodestream_server.builds.level_maker import LevelMaker
from lodestream_server.builds.levels import LevelJob, MadeLevel, make_level
from lodestream_server.builds.processes import Call, ForkServer
from lodestream_server.builds.runner import Runner
from lodestream_server.routes.sending import while_there
from tests.data_folder import below, remove_scratch
from tests.server.access.test_limits import ANNA, limits
from tests.server.builds import slow
from tests.server.builds.test_confinement import needs_landlock
from tests.server.connections import hostile
from tests.server.helpers import PATIENCE, eventually, hills, kept, npy, problem, push
from tests.server.programs import alive, server


@contextmanager
def client(url: str, token: str | None = None) -> Iterator[httpx.Client]:
    headers = {} if token is None else {"authorization": f"Bearer {token}"}
    with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE, headers=headers) as http:
        yield http


@contextmanager
def asking(url: str, path: str, token: str | None = None) -> Iterator[socket.socket]:
    """A client that asks for a level and reads nothing of the answer."""
    address = urlsplit(url)
    with socket.socket() as made:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        made.settimeout(PATIENCE)
        made.connect((address.hostname, address.port))
        line = "" if token is None else f"Authorization: Bearer {token}\r\n"
        made.sendall(f"GET {path} HTTP/1.1\r\nHost: {address.netloc}\r\n{line}\r\n".encode())
        yield made


def _answer_to(url: str, path: str) -> httpx.Response:
    with client(url) as http:
        return http.get(path)


def plain(rows: int, columns: int, height: int = 1) -> NDArray[np.float32]:
    """Heights that are encoded in no time, for files of levels that are as long as others."""
    return np.full((rows, columns), height, np.float32)


def finest(surface: dict[str, Any]) -> str:
    return f"{surface['url']}/levels/{len(surface['levels']) - 1}"


def begun(data: Path) -> list[tuple[int, int]]:
    """Process and level of each level that `slow.make_coarsest` began to make."""
    path = data / "begun"
    lines = path.read_text().splitlines() if path.exists() else []
    return [(int(line.split()[0]), int(line.split()[1])) for line in lines]


def on_disk(data: Path) -> int:
    """Bytes of the levels on the disk."""
    total = 0
    for path in below(data / "scratch" / "levels"):
        try:
            total += path.stat().st_size if path.is_file() else 0
        except FileNotFoundError:
            continue
    return total


@pytest.fixture
def slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Levels other than the coarsest are made when the file ``go`` is there."""
    monkeypatch.setattr(level_maker, "make_level", slow.make_coarsest)
    monkeypatch.setattr(level_maker, "_allowed", slow.allow_levels_more)


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The levels for which somebody waits, as they came; when ``two`` comes, levels are made."""
    levels: list[int] = []
    job = Runner.job

    def noted(self: Runner[Key, Any], key: Key, caller: str, *rest: Any) -> Any:
        if isinstance(key, Key):
            levels.append(key.level)
        if isinstance(key, Key) and caller == key_of("two"):
            (tmp_path / "go").touch()
        return job(self, key, caller, *rest)

    monkeypatch.setattr(Runner, "job", noted)
    return levels


# What the server holds.


@pytest.mark.long
def test_the_server_keeps_no_memory_of_levels(tmp_path: Path) -> None:
    with server(tmp_path / "data") as running, running.client() as http:
        surface = push(http, npy(plain(900, 1000).astype(np.float64)))
        before = running.look().resident
        for level in (len(surface["levels"]) - 1, len(surface["levels"]) - 2):
            for name in ("npy", "ply"):
                assert http.get(f"{surface['url']}/levels/{level}?format={name}").status_code == 200
        assert running.look().resident < before + (24 << 20)


def test_slow_readers_hold_no_more_of_the_disk_than_there_is_for_levels(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    tokens = [file.create(f"reader{number}", ("write",))[0] for number in range(4)]
    most = 16 << 20
    with running_server(tmp_path, workers=1, level_disk=most) as url, client(url, tokens[0]) as http:
        surfaces = [push(http, npy(plain(800, 1000, height))) for height in range(6)]  # 3.2 MB each
        with ExitStack() as held:
            readers = zip(surfaces, (tokens[0], *tokens[0:2], *tokens[1:]), strict=False)
            for count, (surface, token) in enumerate(readers, 1):
                held.enter_context(asking(url, finest(surface), token))
                # The first client's two are made before the files of others leave no room for them.
                eventually(partial(so_many_files, tmp_path, min(count, 3)), "files to be made")
            # Two of the first: more bytes than one client may hold. So its third is refused.
            refused = eventually(lambda: _refused(http, finest(surfaces[5])), "too many bytes for one client")
            assert problem(refused) == (429, "too-many")
            for token in tokens[2:]:
                with client(url, token) as other:
                    assert other.get(finest(surfaces[5]) + "?format=ply").status_code in (200, 413, 503)
            assert on_disk(tmp_path) <= most
        # Once they have gone there is room.
        with client(url, tokens[3]) as other:
            taken = eventually(lambda: _taken(other, finest(surfaces[5])), "room after the slow readers")
            assert np.array_equal(np.load(io.BytesIO(taken.content)), plain(800, 1000, 5))
        assert on_disk(tmp_path) <= most


def so_many_files(data: Path, count: int) -> bool:
    return len(list((data / "scratch" / "levels").glob("*.level"))) >= count


def _refused(http: httpx.Client, path: str) -> httpx.Response | None:
    answer = http.get(path)
    return answer if answer.status_code == 429 else None


def _taken(http: httpx.Client, path: str) -> httpx.Response | None:
    answer = http.get(path)
    return answer if answer.status_code == 200 else None


def test_nothing_is_left_of_levels(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    with running_server(tmp_path / "data", workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        assert http.get(finest(surface)).status_code == 200
        (path,) = (tmp_path / "data" / "scratch" / "levels").iterdir()
        assert path.name.startswith(f"{surface['container_sha256']}-{len(surface['levels']) - 1}-npy")
        twin = push(http, npy(hills()), name="twin")
        assert twin["container_sha256"] != surface["container_sha256"] or twin["id"] != surface["id"]
        http.delete(surface["url"]).raise_for_status()
        if twin["container_sha256"] == surface["container_sha256"]:
            assert path.exists()
            http.delete(twin["url"]).raise_for_status()
        # Whoever has read it to its end may not have given it back yet.
        eventually(lambda: not path.exists(), "the file to be removed")
        assert http.get(finest(surface)).status_code == 404
        http.get(finest(push(http, npy(hills(seed=3))))).raise_for_status()
    assert not (tmp_path / "data" / "scratch" / "levels").exists()


# The queue.


def test_whoever_goes_leaves_the_queue_and_the_process(tmp_path: Path, slowly: None, line: list[int]) -> None:
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        surface, other = push(http, npy(hills())), push(http, npy(hills(seed=2)))
        with ExitStack() as held:
            for count, name in enumerate(("npy", "ply", "obj"), 1):  # which go the other way round
                held.enter_context(asking(url, f"{finest(surface)}?format={name}"))
                eventually(lambda count=count: len(line) == count, "it to wait for a level")  # type: ignore[misc]
            ((process, _),) = eventually(lambda: begun(tmp_path), "a level to begin")
            assert alive(process)
        assert http.get(f"{other['url']}/levels/0").status_code == 200
        assert [level for _, level in begun(tmp_path)][1:] == [0]  # the other two were never begun
        assert not alive(process)
        eventually(lambda: len(kept(tmp_path, "scratch/levels")) == 1, "nothing to be left of the others")


def test_whoever_waits_when_the_server_ends_is_told_to_ask_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slowly: None, line: list[int]
) -> None:
    # As if it took longer than a server that is told to end waits for requests.
    monkeypatch.setattr(running, "_GRACEFUL_SECONDS", 0.2)
    with ThreadPoolExecutor(3) as threads:
        with running_server(tmp_path, workers=1) as url, client(url) as http:
            surface = push(http, npy(hills()))
            asked = [threads.submit(_answer_to, url, f"{finest(surface)}?format={name}") for name in ("npy", "ply")]
            asked.append(threads.submit(_answer_to, url, finest(surface)))
            eventually(lambda: len(line) == 3, "all to wait for a level")
            ((process, _),) = eventually(lambda: begun(tmp_path), "a level to begin")
        answers = [answer.result() for answer in asked]
    assert not alive(process)
    for answer in answers:
        assert problem(answer) == (503, "restarting")
        assert answer.headers["retry-after"] == "5"
        assert answer.headers["x-request-id"]


def test_many_who_ask_for_the_same_share_one_decoding(tmp_path: Path, slowly: None, line: list[int]) -> None:
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        answers: list[httpx.Response] = []

        def ask() -> None:
            with client(url) as own:
                answers.append(own.get(finest(surface)))

        threads = [threading.Thread(target=ask) for _ in range(6)]
        with asking(url, finest(surface)):  # who goes while others wait disturbs nobody
            for thread in threads:
                thread.start()
            eventually(lambda: len(line) == 7, "all to wait for the level")
            eventually(lambda: begun(tmp_path), "the level to begin")
        (tmp_path / "go").touch()
        for thread in threads:
            thread.join(PATIENCE)
        assert [answer.status_code for answer in answers] == [200] * 6
        assert {answer.content for answer in answers} == {npy(hills())}
        assert http.get(finest(surface)).content == npy(hills())
        assert len(begun(tmp_path)) == 1


def test_one_client_waits_for_so_many_and_all_for_so_many(tmp_path: Path, slowly: None, line: list[int]) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    one, two, three = (file.create(name, ("write",))[0] for name in ("anna", "bert", "carl"))
    with (
        running_server(tmp_path, workers=1, max_level_requests=3) as url,
        client(url, one) as http,
        client(url, two) as other,
    ):
        surface = push(http, npy(hills()))
        with ExitStack() as held:
            for count, name in enumerate(("npy", "ply"), 1):
                held.enter_context(asking(url, f"{finest(surface)}?format={name}", one))
                eventually(lambda count=count: len(line) == count, "it to wait for a level")  # type: ignore[misc]
            eventually(lambda: begun(tmp_path), "a level to begin")
            refused = http.get(finest(surface))
            assert problem(refused) == (429, "too-many")
            assert refused.headers["retry-after"].isdecimal()
            held.enter_context(asking(url, f"{surface['url']}/levels/0?format=obj", two))

            eventually(lambda: len(line) == 3, "the queue to be full")
            with client(url, three) as third:
                assert problem(third.get(f"{surface['url']}/levels/0")) == (503, "busy")
        # All have gone: nothing counts any more.
        assert eventually(lambda: _taken(other, f"{surface['url']}/levels/0"), "a turn").status_code == 200


@pytest.mark.parametrize("also", [(), (0,)], ids=["for itself", "for both"])
def test_a_level_is_made_in_the_turn_of_either_who_waits_for_it(
    tmp_path: Path, slowly: None, line: list[int], also: tuple[int, ...]
) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    one, two = (file.create(name, ("write",))[0] for name in ("one", "two"))
    with running_server(tmp_path, workers=1) as url, client(url, one) as http, client(url, two) as other:
        surface = push(http, npy(hills(90, 80)))
        finest_level = len(surface["levels"]) - 1
        assert finest_level >= 5
        asked = [*range(finest_level, finest_level - 5, -1), *also]
        with ExitStack() as held:
            for count, level in enumerate(asked, 1):
                held.enter_context(asking(url, f"{surface['url']}/levels/{level}", one))
                eventually(lambda count=count: len(line) == count, "the level to be in the queue")  # type: ignore[misc]
            assert other.get(f"{surface['url']}/levels/0").status_code == 200
            order = [level for _, level in eventually(lambda: _so_many(tmp_path, 6), "all to be made")]
        assert line == [*asked, 0]
        assert sorted(order) == sorted({*asked, 0})
        assert order[0] == finest_level
        assert order.index(0) <= 2


def _so_many(data: Path, count: int) -> list[tuple[int, int]] | None:
    found = begun(data)
    return found if len(found) >= count else None


def test_builds_are_in_nobodys_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        monkeypatch.setattr(worker, "build", slow.wait)
        waiting = [http.post("/v1/surfaces", content=npy(hills(seed=seed))) for seed in range(2, 5)]
        assert http.get(finest(surface)).content == npy(hills())
        states = [http.get(answer.headers["location"]).json()["state"] for answer in waiting]
        assert set(states) <= {"queued", "building"}


# Limits.


def test_a_file_that_would_be_too_long_is_not_made(tmp_path: Path) -> None:
    with running_server(tmp_path, workers=1, level_disk=2 << 20) as url, client(url) as http:
        surface = push(http, npy(plain(500, 400)))
        for name in ("npy", "obj", "ply"):
            answer = http.get(finest(surface), params={"format": name})
            assert problem(answer) == (413, "too-large")
            assert f"more than {1 << 19} bytes, a quarter of" in answer.json()["detail"]
            assert "(level_disk)" in answer.json()["detail"]
            assert http.get(f"{surface['url']}/levels/2", params={"format": name}).status_code == 200
            assert on_disk(tmp_path) < 1 << 19


def test_a_format_that_is_written_beside_is_bounded_too(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    with running_server(tmp_path, workers=1, level_disk=2 << 20) as url, client(url) as http:
        surface = push(http, npy(np.random.default_rng(1).normal(size=(450, 450)).astype(np.float32)))
        assert problem(http.get(finest(surface), params={"format": "geotiff"})) == (413, "too-large")
        assert on_disk(tmp_path) == 0


def test_a_level_that_takes_too_much_is_refused_and_the_next_one_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        running_server(tmp_path, workers=1, level_memory=256 << 20, level_seconds=PATIENCE) as url,
        client(url) as http,
    ):
        surface = push(http, npy(hills()))
        for function, expected in ((slow.hoard_level, (413, "too-large")), (slow.raise_full, (507, "full"))):
            monkeypatch.setattr(level_maker, "make_level", function)
            assert problem(http.get(finest(surface))) == expected
            assert on_disk(tmp_path) == 0
        monkeypatch.setattr(level_maker, "make_level", slow.kill_level_once)
        monkeypatch.setattr(level_maker, "_allowed", slow.allow_levels_more)
        assert http.get(finest(surface)).content == npy(hills())


@pytest.mark.parametrize("own", [True, False])
def test_a_level_that_memory_is_too_little_for_names_the_limit_and_its_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: bool
) -> None:
    settings: dict[str, Any] = {"level_memory": 256 << 20} if own else {}
    with running_server(tmp_path, workers=1, memory=512 << 20, **settings) as url, client(url) as http:
        surface = push(http, npy(hills()))
        for function in (slow.refuse_large_level, slow.lack_memory_for_level):
            monkeypatch.setattr(level_maker, "make_level", function)
            answer = http.get(finest(surface))
            assert problem(answer) == (413, "too-large")
            assert answer.json()["title"] == "The request, or what it asks for, is too large"
            words = (
                "256 MiB of memory (level_memory)"
                if own
                else "1024 MiB of memory (half of LODESTREAM_MEMORY, but at least 1024 MiB)"
            )
            detail = answer.json()["detail"]
            assert detail.startswith(f"The level needs more than {words}")
            assert "ask for a coarser level" in detail
            assert "max_vertices" not in detail
            assert "bytes" not in detail


@needs_landlock
def test_a_container_may_be_built_again_while_a_level_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(level_maker, "make_level", slow.make_when_told)

    def begin() -> Path:
        return eventually(lambda: next((tmp_path / "scratch" / "levels").glob("*/begun"), None), "a process to begin")

    with running_server(tmp_path, workers=1) as url, client(url) as http, ThreadPoolExecutor(1) as other:
        surface = push(http, npy(hills()))
        container = tmp_path / "containers" / f"{surface['container_sha256']}.lode"
        answer = other.submit(http.get, finest(surface))
        begun = begin()
        # The same bytes in another file: the process may read only the one that there was.
        shutil.copy(container, tmp_path / "copy")
        (tmp_path / "copy").replace(container)
        begun.with_name("go").touch()
        eventually(lambda: not begun.exists(), "the process to go on")
        begin().with_name("go").touch()
        assert answer.result(PATIENCE).content == npy(hills())


def test_no_word_of_its_process_is_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        for function in (hostile.forge_level, hostile.forge_level_link, hostile.say_garbage_of_level):
            monkeypatch.setattr(level_maker, "make_level", function)
            assert problem(http.get(finest(surface))) == (503, "busy")
            assert on_disk(tmp_path) == 0
        monkeypatch.setattr(level_maker, "make_level", make_level)
        assert http.get(finest(surface)).content == npy(hills())


def test_a_level_that_takes_too_long_is_refused(tmp_path: Path, slowly: None) -> None:
    with running_server(tmp_path, workers=1, level_seconds=0.5) as url, client(url) as http:
        surface = push(http, npy(hills()))
        answer = http.get(finest(surface))
        assert problem(answer) == (413, "too-large")
        assert "0.5 s" in answer.json()["detail"]


def test_each_level_has_a_process_that_ends_with_it(tmp_path: Path, slowly: None) -> None:
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        for name in ("ply", "npy"):
            assert http.get(f"{surface['url']}/levels/0?format={name}").status_code == 200
            eventually(partial(_ended, begun(tmp_path)[-1][0]), "the process to end")
        assert len({process for process, _ in begun(tmp_path)}) == 2


def _ended(process: int) -> bool:
    return not alive(process)


# The room, without a server.


def files(folder: Path, most: int, free: int = 1 << 40) -> LevelFiles:
    async def room() -> int:
        return free - sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())

    return LevelFiles(folder, most, room)


def put(made: LevelFiles, number: int, size: int, *, kept: bool = True, container: str = "a" * 64) -> Any:
    key = Key(container, number, "npy")
    folder = made.new_folder(key)
    folder.mkdir(parents=True)
    (folder / "level").write_bytes(bytes(size))
    lease = made.add(key, folder / "level", size, kept=kept)
    folder.rmdir()
    return lease


def numbers(made: LevelFiles) -> set[int]:
    found = {number: made.lend(Key("a" * 64, number, "npy")) for number in range(9)}
    for lease in found.values():
        if lease is not None:
            lease.release()
    return {number for number, lease in found.items() if lease is not None}


def test_those_asked_for_last_are_kept(tmp_path: Path) -> None:
    made = files(tmp_path, 1000)
    for number in range(4):
        put(made, number, 200).release()
    assert made.size == 800
    first = made.lend(Key("a" * 64, 0, "npy"))
    assert first is not None
    first.release()
    assert asyncio.run(made.make_room()) == 250
    assert numbers(made) == {0, 3}
    assert len(list(tmp_path.iterdir())) == 2


def test_what_is_read_stays_and_leaves_less_room(tmp_path: Path) -> None:
    made = files(tmp_path, 1000)
    leases = [put(made, number, 200) for number in range(4)]
    assert asyncio.run(made.make_room()) == 100
    assert numbers(made) == {0, 1, 2, 3}
    second = leases[0].again()
    leases[0].release()
    leases[0].release()
    assert asyncio.run(made.make_room()) == 100
    second.release()
    assert asyncio.run(made.make_room()) == 200
    assert numbers(made) == {1, 2, 3}


def test_what_is_to_stay_free_stays_free(tmp_path: Path) -> None:
    made = files(tmp_path, 1000, free=500)
    put(made, 0, 200).release()
    assert asyncio.run(made.make_room()) == 250
    assert numbers(made) == set()
    kept = put(made, 1, 200)
    assert asyncio.run(made.make_room()) == 150
    kept.release()


def test_files_of_a_container_that_is_gone_go_with_their_readers(tmp_path: Path) -> None:
    made = files(tmp_path, 1000)
    put(made, 0, 200).release()
    read, late = put(made, 1, 200), put(made, 2, 200, kept=False)
    made.forget("a" * 64)
    assert (numbers(made), made.size, len(list(tmp_path.iterdir()))) == (set(), 400, 2)
    again = read.again()
    for lease in (read, late, again):
        assert lease.path.exists()
        lease.release()
    assert (made.size, list(tmp_path.iterdir())) == (0, [])


def test_a_container_may_go_while_room_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = files(tmp_path, 1000)
    for number in range(2):
        put(made, number, 200, container="b" * 64).release()
    for number in range(3):
        put(made, number, 200).release()

    async def gone_meanwhile(function: Callable[[], None]) -> None:
        function()
        made.forget("b" * 64)

    monkeypatch.setattr(asyncio, "to_thread", gone_meanwhile)
    assert asyncio.run(made.make_room()) == 250
    assert numbers(made) == {1, 2}
    assert len(list(tmp_path.iterdir())) == 2


class Stored:
    """Containers that are there, at least at first."""

    used = True

    def is_here(self, sha256: str) -> bool:
        return True

    @contextmanager
    def local(self, _: str) -> Iterator[Path]:
        yield Path("container")

    def is_used(self, _: str) -> bool:
        return self.used


async def write(call: Call) -> MadeLevel:
    """A process that makes the file of a level."""
    await asyncio.sleep(0)
    job: LevelJob = call.args[0]
    job.path.write_bytes(bytes(1000))
    await asyncio.sleep(0)
    return MadeLevel(1000)


@pytest.mark.parametrize("used", [True, False])
def test_the_file_of_a_container_that_was_deleted_meanwhile_goes_with_its_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, used: bool
) -> None:
    stored: Any = Stored()
    stored.used = used

    async def read() -> int:
        room = files(tmp_path / "levels", 1 << 20)
        room.folder.mkdir()
        there = limits(tmp_path)
        queue = LevelMaker(there._settings, stored, room, ForkServer(), there)
        monkeypatch.setattr(queue._runner, "call", write)
        loan = await queue.take(Key("a" * 64, 0, "npy"), ANNA)
        assert loan.path.stat().st_size == 1000
        await asyncio.sleep(0)
        loan.release()
        assert len(list(room.folder.iterdir())) == used
        return room.size

    assert asyncio.run(read()) == 1000 * used


def test_whoever_goes_at_any_moment_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cancellation at each step of the event loop; a thread may begin late or not at all, and end unnoticed."""
    stored: Any = Stored()
    most = 1 << 20

    async def in_a_thread(function: Callable[..., Any], *args: Any) -> Any:
        await asyncio.sleep(0)
        result = function(*args)
        await asyncio.sleep(0)
        return result

    monkeypatch.setattr(asyncio, "to_thread", in_a_thread)

    async def go(step: int) -> bool:
        folder = tmp_path / str(step)
        room = files(folder / "levels", most)
        room.folder.mkdir(parents=True)
        for number in range(1, 4):  # of which some must go
            put(room, number, most // 4).release()
        there = limits(folder, alone=False)
        queue = LevelMaker(there._settings, stored, room, ForkServer(), there)
        monkeypatch.setattr(queue._runner, "call", write)
        asked = asyncio.create_task(queue.take(Key("a" * 64, 0, "npy"), ANNA))
        for _ in range(step):
            await asyncio.sleep(0)
        has_it = asked.done()
        asked.cancel()
        await asyncio.wait((asked,))
        for _ in range(100):
            await asyncio.sleep(0)
        if not asked.cancelled():
            asked.result().release()
        assert (room.lent, there.lent._total, there.levels._total) == (0, 0, 0)
        assert (queue._runner._jobs, queue._runner._turns._free) == ({}, 1)
        assert {path.stat().st_size for path in room.folder.iterdir()} <= {1000, most // 4}
        assert sum(path.stat().st_size for path in room.folder.iterdir()) == room.size
        return has_it

    step = 0
    while not asyncio.run(go(step)):
        step += 1
    assert step > 20


@pytest.mark.parametrize("again", [0, 1, 2, 3])
def test_a_request_that_is_cancelled_loses_no_loan(again: int) -> None:
    """Once, and a second time some steps later."""
    asked = Request({"type": "http", "headers": []}, receive=lambda: asyncio.sleep(PATIENCE, {"type": "http.request"}))

    async def ask(step: int) -> bool:
        lent, released, got = list[str](), list[str](), list[str]()

        async def work() -> str:
            for _ in range(3):
                await asyncio.sleep(0)
            lent.append("loan")
            return "loan"

        async def request() -> None:
            got.append(await while_there(asked, work(), released.append))

        task = asyncio.create_task(request())
        for _ in range(step):
            await asyncio.sleep(0)
        ended = task.done()
        task.cancel()
        for _ in range(again):
            await asyncio.sleep(0)
        task.cancel()
        await asyncio.wait((task,))
        for _ in range(20):
            await asyncio.sleep(0)
        assert lent == got + released
        return ended

    step = 0
    while not asyncio.run(ask(step)):
        step += 1
    assert step > 5


def test_the_process_makes_no_file_that_is_longer(tmp_path: Path) -> None:
    with running_server(tmp_path / "data", workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        container = tmp_path / "data" / "containers" / f"{surface['container_sha256']}.lode"
        level = len(surface["levels"]) - 1
        refused = make_level(LevelJob(container, level, "npy", _new(tmp_path / "a"), 1000, 1 << 28))
        assert isinstance(refused, Refusal)
        assert refused.kind == "FileTooLongError"
        made = make_level(LevelJob(container, level, "npy", _new(tmp_path / "b"), 10_000, 1 << 28))
        assert not isinstance(made, Refusal)
        assert (tmp_path / "b" / "level").read_bytes() == npy(hills())
        assert made.size == len(npy(hills()))


@pytest.mark.parametrize("format_name", ["npy", "geotiff", "cog", "netcdf"])
def test_a_level_larger_than_memory_is_made_by_bands_to_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format_name: str
) -> None:
    heights = np.rint(hills(700, 300)).astype(np.int16)
    mask = np.ones(heights.shape, bool)
    mask[40:90, 7:200] = False
    made = io.BytesIO()
    np.savez(made, points=heights, mask=mask)
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        surface = push(http, made.getvalue(), filename="a.npz")
        addresses = [f"{surface['url']}/levels/{level}" for level in (3, len(surface["levels"]) - 2)] + [
            finest(surface)
        ]
        whole = [http.get(address, params={"format": format_name}).raise_for_status() for address in addresses]
    monkeypatch.setattr(level_maker, "make_level", slow.make_level_by_bands)  # nothing is kept from server to server
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        for before, address in zip(whole, addresses, strict=True):
            banded = http.get(str(httpx.URL(address).path), params={"format": format_name}).raise_for_status()
            assert banded.content == before.content
            assert banded.headers["ETag"] == before.headers["ETag"]
        assert [path for path in below(tmp_path / "scratch" / "levels") if path.name == "values"] == []


@pytest.mark.parametrize("format_name", ["plot3d", "vtm"])
def test_a_level_of_several_blocks_is_made_block_by_block_to_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format_name: str
) -> None:
    heights = np.stack([*np.mgrid[0:96.0, 0:40.0], hills(96, 40)], axis=-1).astype(np.float32)
    heights[..., 0] += np.sin(heights[..., 1])
    blocks = [Block(heights[top : top + 13], mask=np.arange(13 * 40).reshape(13, 40) != 99) for top in range(0, 84, 12)]
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        told = push(http, encode(Surface(blocks=blocks)), filename="a.lode")
        whole = http.get(finest(told), params={"format": format_name}).raise_for_status()
    monkeypatch.setattr(level_maker, "make_level", slow.make_level_by_blocks)
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        banded = http.get(str(httpx.URL(finest(told)).path), params={"format": format_name}).raise_for_status()
        assert banded.content == whole.content


def test_values_in_files_count_for_the_room_of_a_level(tmp_path: Path) -> None:
    with running_server(tmp_path / "data", workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
    container = tmp_path / "data" / "containers" / f"{surface['container_sha256']}.lode"
    level, size = len(surface["levels"]) - 1, len(npy(hills()))
    for name, most in (("a", 40 * 30 * 4), ("b", 40 * 30 * 4 + size - 1)):
        refused = make_level(LevelJob(container, level, "npy", _new(tmp_path / name), most, 1 << 10))
        assert isinstance(refused, Refusal)
        assert refused.kind == "FileTooLongError"
    made = make_level(LevelJob(container, level, "npy", _new(tmp_path / "c"), 40 * 30 * 4 + size, 1 << 10))
    assert isinstance(made, MadeLevel)
    assert (tmp_path / "c" / "level").read_bytes() == npy(hills())


def _new(folder: Path) -> Path:
    folder.mkdir()
    return folder


def test_a_level_file_that_goes_before_it_is_opened_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opens = anyio.open_file
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        level = f"{push(http, npy(hills()))['url']}/levels/1"
        made = http.get(level).content

        async def late(*args: Any, **kwargs: Any) -> Any:
            monkeypatch.setattr(anyio, "open_file", opens)
            Path(args[0]).unlink()
            return await opens(*args, **kwargs)

        monkeypatch.setattr(anyio, "open_file", late)
        assert problem(http.get(level)) == (503, "busy")
        assert http.get(level).content == made


def test_a_level_that_fails_in_any_way_while_its_folder_is_removed_may_be_asked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(level_maker, "make_level", slow.lose_its_folder)
    monkeypatch.setattr(level_maker, "_allowed", slow.allow_levels_more)
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        assert problem(http.get(f"{surface['url']}/levels/1")) == (503, "busy")


def test_levels_of_a_scratch_folder_that_is_removed_are_made_again(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running_server(data, workers=1) as url, client(url) as http:
        surface = push(http, npy(hills()))
        level = f"{surface['url']}/levels/1"
        made = http.get(level)
        assert made.status_code == 200
        remove_scratch(data)

        def again() -> bool:
            answer = http.get(level)
            assert answer.status_code in (200, 503), answer.text
            return answer.status_code == 200 and answer.content == made.content

        assert eventually(again, "the level to be made again")
