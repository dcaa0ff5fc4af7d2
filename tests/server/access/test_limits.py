"""How much is taken at the same time, and what whoever comes after that is told."""

from __future__ import annotations

import asyncio
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import httpx
import pytest
from fastapi import Request
from websockets.exceptions import ConnectionClosed

from lodestream.protocol.messages import BASE_CREDIT, MAX_CREDIT, Error, Open, Opened
from lodestream_server import Settings, running_server
from lodestream_server.access.access import Caller
from lodestream_server.access.limits import Limits
from lodestream_server.access.tokens import TokenFile
from lodestream_server.operation import least_rate
from lodestream_server.problems import BusyError, FullError, SlowUploadError, TooManyError
from lodestream_server.store import durable
from tests.data_folder import below
from tests.server.helpers import PATIENCE, Raw, eventually, hills, kept, npy, push, raw_stream
from tests.server.store.disks import FullDisk


class Disk(NamedTuple):
    total: int
    used: int
    free: int


ANNA, BERT, CARL, DORA = (Caller(f"token {name}", name, name) for name in ("anna", "bert", "carl", "dora"))


def limits(
    folder: Path,
    surfaces: int = 0,
    of_anna: int = 0,
    builds: int = 0,
    own: int = 0,
    kept: int = 0,
    alone: bool = True,
    **settings: Any,
) -> Limits:
    """Of which ``of_anna`` surfaces, ``own`` builds and ``kept`` bytes on the disk are Anna's."""
    made = Limits(
        Settings(data=folder, **settings),
        (folder,),
        lambda owner: (surfaces, of_anna if owner == ANNA.owner else 0),
        lambda owner: kept if owner == ANNA.owner else 0,
        lambda: alone,
    )
    made.builds.add(ANNA.key, own)
    made.builds.add(BERT.key, builds - own)
    return made


def request(*chunks: bytes, length: int | str | None = None) -> Request:
    headers = [] if length is None else [(b"content-length", str(length).encode())]
    messages = [
        {"type": "http.request", "body": chunk, "more_body": number + 1 < len(chunks)}
        for number, chunk in enumerate(chunks)
    ]

    async def receive() -> Any:
        return messages.pop(0)

    return Request({"type": "http", "method": "POST", "headers": headers}, receive)


async def read(made: Limits, asked: Request, caller: Caller = ANNA) -> bytes:
    async with made.upload(asked, caller) as watched:
        return b"".join([chunk async for chunk in watched.stream()])


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    size = {"free": 1000, "total": 100_000}
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Disk(size["total"], 0, size["free"]))
    return size


def test_the_body_that_is_watched_is_the_body(tmp_path: Path, disk: dict[str, int]) -> None:
    made = limits(tmp_path, keep_free=0)
    assert asyncio.run(read(made, request(b"one", b"two", b"", length=6))) == b"onetwo"


@pytest.mark.parametrize(("length", "fits"), [(400, True), (500, True), (501, False), (10**17, False)])
def test_what_is_to_stay_free_stays_free(tmp_path: Path, disk: dict[str, int], length: int, fits: bool) -> None:
    made = limits(tmp_path, keep_free=500, upload_bytes=10**18)
    if fits:
        asyncio.run(read(made, request(b"x", length=length)))
    else:
        with pytest.raises(FullError, match="500 bytes"):
            asyncio.run(read(made, request(b"x", length=length)))


def test_of_two_disks_the_fuller_one_has_the_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = {tmp_path: 900, tmp_path / "scratch": 700}
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Disk(100_000, 0, free[path]))
    for folders in (list(free), list(free)[::-1]):
        made = Limits(Settings(keep_free=500), folders, lambda _: (0, 0), lambda _: 0, lambda: True)
        assert asyncio.run(made.room()) == 200


def test_a_twentieth_of_a_small_disk_stays_free_if_nothing_is_said(tmp_path: Path, disk: dict[str, int]) -> None:
    disk["total"] = 20_000
    asyncio.run(read(limits(tmp_path), request(b"", length=0)))
    disk["free"] = 999
    with pytest.raises(FullError):
        asyncio.run(read(limits(tmp_path), request(b"", length=0)))


def test_uploads_under_way_are_counted_until_they_are_on_the_disk(tmp_path: Path, disk: dict[str, int]) -> None:
    made = limits(tmp_path, keep_free=0)

    async def together() -> None:
        async with made.upload(request(b"x" * 300, b"", length=600), ANNA) as first:
            with pytest.raises(FullError):
                await read(made, request(b"", length=401))
            await anext(aiter(first.stream()))
            disk["free"] -= 300
            assert await read(made, request(b"y", length=400)) == b"y"
        assert await read(made, request(b"z", length=700)) == b"z"

    asyncio.run(together())


def test_an_upload_that_does_not_say_its_size_stops_at_the_mark(tmp_path: Path, disk: dict[str, int]) -> None:
    made = limits(tmp_path, keep_free=500)

    async def fill() -> None:
        async with made.upload(request(*[bytes(1 << 24)] * 3), ANNA) as watched:
            chunks = aiter(watched.stream())
            await anext(chunks)
            disk["free"] = 400
            with pytest.raises(FullError):
                await anext(chunks)

    asyncio.run(fill())


@pytest.mark.parametrize("length", ["x", "-1", "1_0", "", "9" * 30, "١٢"])
def test_a_size_that_is_none_promises_nothing(tmp_path: Path, disk: dict[str, int], length: str) -> None:
    assert asyncio.run(read(limits(tmp_path, keep_free=0), request(b"x", length=length))) == b"x"


def test_numbers_are_limits_too(tmp_path: Path) -> None:
    with pytest.raises(BusyError, match="at most 3 pending builds"):
        asyncio.run(read(limits(tmp_path, builds=3, max_builds=3), request(b"x")))
    with pytest.raises(FullError, match="at most 5 surfaces"):
        asyncio.run(read(limits(tmp_path, surfaces=5, max_surfaces=5), request(b"x")))

    async def together() -> None:
        made = limits(tmp_path, max_uploads=1)
        async with made.upload(request(b"x"), ANNA):
            with pytest.raises(BusyError, match="at most 1 uploads"):
                await read(made, request(b"x"))
        await read(made, request(b"x"))

    asyncio.run(together())


class Slowly:
    """A body whose parts come after some seconds, on a loop whose time is told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.timers: list[tuple[float, Callable[[], None]]] = []
        monkeypatch.setattr(least_rate, "monotonic", lambda: self.now)

    def call_later(self, seconds: float, work: Callable[[], None]) -> Slowly:
        self.timers = [(self.now + seconds, work)]
        return self

    def cancel(self) -> None:
        self.timers = []

    def pass_by(self, seconds: float, *, held_up: bool) -> None:
        """Let time pass, with the timers that come due, or without them until the end."""
        until = self.now + seconds
        while not held_up and self.timers and self.timers[0][0] <= until:
            self.now, work = self.timers.pop()
            work()
        self.now = until
        if held_up and self.timers:
            self.timers.pop()[1]()


@pytest.mark.parametrize(
    ("rate", "size", "ends"), [(100, 1000, False), (100, 990, True), (0, 1, False), (0, 0, True), (10**9, 10**6, True)]
)
def test_an_upload_that_is_too_slow_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: int, size: int, ends: bool
) -> None:
    made, slowly = limits(tmp_path, idle_seconds=10, least_rate=rate), Slowly(monkeypatch)

    async def upload() -> int:
        body = request(*[bytes(size)] * 5, b"")
        receive = body.receive

        async def late() -> Any:
            slowly.pass_by(10.25, held_up=False)
            return await receive()

        body._receive = late
        monkeypatch.setattr(asyncio.get_running_loop(), "call_later", slowly.call_later)
        return len(await read(made, body))

    if ends:
        with pytest.raises(SlowUploadError, match=f"at least {rate} a second must"):
            asyncio.run(upload())
    else:
        assert asyncio.run(upload()) == 5 * size


@pytest.mark.parametrize("why", ["disk", "loop"])
def test_time_in_which_the_server_does_not_read_is_not_the_clients(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    """A disk that takes minutes for each part, and other work that holds the event loop up for as long."""
    made, slowly = limits(tmp_path, idle_seconds=10, least_rate=100), Slowly(monkeypatch)

    async def upload() -> int:
        body = request(*[bytes(10)] * 30, b"")
        receive = body.receive

        async def held_up() -> Any:
            if why == "loop":
                slowly.pass_by(100, held_up=True)
            return await receive()

        body._receive = held_up
        monkeypatch.setattr(asyncio.get_running_loop(), "call_later", slowly.call_later)
        came = 0
        async with made.upload(body, ANNA) as watched:
            async for part in watched.stream():
                came += len(part)
                if why == "disk":
                    slowly.pass_by(100, held_up=False)
        return came

    assert asyncio.run(upload()) == 300


def test_streams_in_all_and_of_one_client(tmp_path: Path) -> None:
    made = limits(tmp_path, alone=False, max_streams=3)
    with ExitStack() as held:
        held.enter_context(made.stream(ANNA))
        with made.stream(ANNA), pytest.raises(TooManyError, match="2, and 1 of 3 are left"), made.stream(ANNA):
            pass
        held.enter_context(made.stream(BERT))
        with pytest.raises(TooManyError, match="1, and 1 of 3 are left"), made.stream(BERT):
            pass
        held.enter_context(made.stream(CARL))
        for caller in (ANNA, DORA):
            with pytest.raises(BusyError, match="at most 3"), made.stream(caller):
                pass
    for _ in range(5):
        with made.stream(ANNA), made.stream(ANNA):
            pass


def test_streams_together_have_no_more_under_way_than_their_memory(tmp_path: Path) -> None:
    memory = 16 * MAX_CREDIT
    made = limits(tmp_path, stream_memory=memory)
    for _ in range(2):  # what a stream had is given back
        with ExitStack() as held:
            credits = [held.enter_context(made.stream(ANNA)) for _ in range(100)]
        assert credits[0] == MAX_CREDIT
        assert credits == sorted(credits, reverse=True)
        assert credits[-1] >= BASE_CREDIT
        assert memory / 2 < sum(credits) - 100 * BASE_CREDIT <= memory


def test_who_has_more_than_its_share_of_credit_gets_the_least(tmp_path: Path) -> None:
    made = limits(tmp_path, alone=False, stream_memory=4 * MAX_CREDIT, max_streams=1000)
    with ExitStack() as held:
        for caller in (ANNA, BERT):
            for _ in range(60):
                held.enter_context(made.stream(caller))
        # Half of it when nobody else was there.
        assert held.enter_context(made.stream(ANNA)) == BASE_CREDIT
    assert (made._credit._total, made.streams._total) == (0, 0)
    assert (made._credit._taken, made.streams._taken) == ({}, {})  # of those who are gone nothing is kept


def test_connections_without_a_token_yet_in_all_and_of_one_address(tmp_path: Path) -> None:
    made = limits(tmp_path, alone=False, max_streams=4)
    with ExitStack() as held:
        for caller in (ANNA, ANNA, BERT):
            held.enter_context(made.openings.take(caller))
        with pytest.raises(TooManyError, match="it has 2, and 1 of 4 are left"), made.openings.take(ANNA):
            pass
        held.enter_context(made.openings.take(CARL))
        with pytest.raises(BusyError, match="at most 4"), made.openings.take(DORA):
            pass
        for caller in (ANNA, ANNA, BERT, CARL):
            held.enter_context(made.stream(caller))
    for _ in range(5):
        with made.openings.take(ANNA), made.openings.take(ANNA):
            pass


# Over real sockets.


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("small")


@pytest.fixture(scope="module")
def small(folder: Path) -> Iterator[tuple[str, str, dict[str, str]]]:
    """A server with little room: its address, a surface, and tokens."""
    file = TokenFile(folder / "tokens.json")
    tokens = {name: file.create(name, ("write",))[0] for name in ("one", "two", "three", "four")}
    tokens["operator"] = file.create("operator", ("admin",))[0]
    with running_server(folder, workers=1, max_streams=4, max_surfaces=4, max_uploads=1, upload_bytes=1 << 20) as url:
        with client(url, tokens["one"]) as http:
            made = push(http, npy(hills(30, 20)))
        yield url, url + made["url"], tokens


@contextmanager
def client(url: str, token: str) -> Iterator[httpx.Client]:
    headers = {"authorization": f"Bearer {token}"}
    with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE, headers=headers) as http:
        yield http


def code_of(stream: Raw) -> tuple[str, int]:
    said = stream.receive()
    assert isinstance(said, Error)
    with pytest.raises(ConnectionClosed) as over:
        stream.receive()
    assert over.value.rcvd is not None
    return said.code, over.value.rcvd.code


def await_no_streams(small: tuple[str, str, dict[str, str]]) -> None:
    """Wait until the streams of tests before have ended at the server too."""
    with client(small[0], small[2]["operator"]) as http:
        eventually(lambda: "lodestream_streams_open 0.0" in http.get("/metrics").text, "the streams of before to end")


def test_a_stream_too_many_is_told_to_come_back(small: tuple[str, str, dict[str, str]]) -> None:
    _, surface, tokens = small
    await_no_streams(small)

    def opened(held: ExitStack, name: str) -> Raw:
        headers = {"Authorization": f"Bearer {tokens[name]}"}
        return held.enter_context(raw_stream(surface, additional_headers=headers))

    with ExitStack() as held:
        for name in ("one", "one", "two"):
            stream = opened(held, name)
            stream.send(Open(credit=0))
            assert isinstance(stream.receive(), Opened)
        assert code_of(opened(held, "one")) == ("too-many", 4429)
        stream = opened(held, "three")
        stream.send(Open(credit=0))
        assert isinstance(stream.receive(), Opened)
        assert code_of(opened(held, "four")) == ("busy", 4503)

    def free() -> bool:
        with ExitStack() as held:
            stream = opened(held, "one")
            stream.send(Open(credit=0))
            return isinstance(stream.receive(), Opened)

    assert eventually(free, "room after they are gone")


def test_who_shows_no_token_takes_no_stream_from_those_who_have_one(small: tuple[str, str, dict[str, str]]) -> None:
    _, surface, tokens = small
    await_no_streams(small)
    with ExitStack() as held:
        silent = [held.enter_context(raw_stream(surface)) for _ in range(2)]
        assert code_of(held.enter_context(raw_stream(surface))) == ("too-many", 4429)
        for name in ("one", "one", "two", "three"):
            headers = {"Authorization": f"Bearer {tokens[name]}"}
            stream = held.enter_context(raw_stream(surface, additional_headers=headers))
            stream.send(Open(credit=0))
            assert isinstance(stream.receive(), Opened)
        # However a token is shown, it has the streams of that token and no more.
        silent[0].send(Open(credit=0, token=tokens["one"]))
        assert code_of(silent[0]) == ("busy", 4503)


def test_streams_count_by_the_token_in_open(small: tuple[str, str, dict[str, str]]) -> None:
    _, surface, tokens = small

    def opened(held: ExitStack, name: str) -> Raw:
        stream = held.enter_context(raw_stream(surface))
        stream.send(Open(credit=0, token=tokens[name]))
        return stream

    def free() -> bool:
        with ExitStack() as held:
            return isinstance(opened(held, "one").receive(), Opened)

    eventually(free, "room after those who have shown no token")
    await_no_streams(small)
    with ExitStack() as held:
        for name in ("two", "two", "three"):
            assert isinstance(opened(held, name).receive(), Opened)
        assert code_of(opened(held, "two")) == ("too-many", 4429)
        assert isinstance(opened(held, "one").receive(), Opened)


def refused_at_once(url: str, token: str, length: int) -> bytes:
    """The answer to an upload that says its size and of which nothing comes."""
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port), timeout=PATIENCE) as asking:
        asking.sendall(
            f"POST /v1/surfaces HTTP/1.1\r\nHost: {address.netloc}\r\nAuthorization: Bearer {token}\r\n"
            f"Content-Length: {length}\r\nConnection: close\r\n\r\n".encode()
        )
        answer = b""
        while piece := asking.recv(65536):
            answer += piece
    return answer


def test_uploads_too_many_are_told_to_come_back(folder: Path, small: tuple[str, str, dict[str, str]]) -> None:
    url, _, tokens = small
    address = urlsplit(url)
    with (
        client(url, tokens["one"]) as http,
        socket.create_connection((address.hostname, address.port), timeout=PATIENCE) as slow,
    ):
        slow.sendall(
            f"POST /v1/surfaces HTTP/1.1\r\nHost: {address.netloc}\r\nAuthorization: Bearer {tokens['two']}\r\n"
            "Content-Length: 100000\r\n\r\nxxx".encode()
        )
        # Seen in the folder: whoever asked by another upload might be the one that is taken.
        eventually(lambda: list((folder / "scratch" / "incoming").glob("*/0")), "the slow upload to begin")
        answer = http.post("/v1/surfaces", content=npy(hills(6, 5)))
        assert answer.status_code == 503
        assert answer.headers["retry-after"].isdecimal()
        assert answer.json()["code"] == "busy"
    with client(url, tokens["one"]) as http:

        def taken() -> httpx.Response | None:
            answer = http.post("/v1/surfaces", content=npy(hills(6, 5)))
            return None if answer.status_code == 503 else answer

        assert eventually(taken, "room after the slow upload").status_code in (200, 202)
        full = http.post("/v1/surfaces", content=npy(hills(7, 5)))
        assert (full.status_code, full.json()["code"]) == (507, "full")
        assert "it has 2, and 2 of 4 are left" in full.json()["detail"]
        assert refused_at_once(url, tokens["one"], (1 << 20) + 1).startswith(b"HTTP/1.1 507 ")
        # What is there already needs no room; the same bytes with an option are another surface.
        body = npy(hills(6, 5))
        known = eventually(lambda: settled_upload(http, body), "the build to end")
        assert known.json()["state"] == "ready"
        assert http.post("/v1/surfaces", files={"file": ("a.npy", body)}).json() == known.json()
        chunked = http.post("/v1/surfaces", content=iter((body[:100], body[100:])))
        assert (chunked.status_code, chunked.json()) == (200, known.json())
        assert http.post("/v1/surfaces", content=body, params={"precision": "1"}).status_code == 507
        assert http.post("/v1/surfaces", content=npy(hills(6, 5, seed=9))).status_code == 507
        bad = http.post("/v1/surfaces", content=body, params={"colour": "1"})
        assert (bad.status_code, bad.json()["code"]) == (422, "bad-option")
        # Of what cannot be there, by its size, nothing is awaited.
        assert refused_at_once(url, tokens["one"], len(body) + 1).startswith(b"HTTP/1.1 507 ")
        assert kept(folder, "scratch/incoming") == []


def settled_upload(http: httpx.Client, body: bytes) -> httpx.Response | None:
    answer = http.post("/v1/surfaces", content=body)
    assert answer.status_code in (200, 202), answer.text
    return answer if answer.status_code == 200 else None


def test_a_server_without_room_says_so(tmp_path: Path) -> None:
    with (
        running_server(tmp_path, workers=1, keep_free=1 << 60) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        answer = http.post("/v1/surfaces", content=npy(hills()))
        assert (answer.status_code, answer.json()["code"]) == (507, "full")
        assert kept(tmp_path, "scratch/incoming") == []


def test_a_server_without_room_knows_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        running_server(tmp_path, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, npy(hills()))
        eventually(lambda: not kept(tmp_path, "scratch/work"), "the build's folder to be removed")
        before = {path: path.stat().st_mtime_ns for path in below(tmp_path) if path.is_file()}
        monkeypatch.setattr(shutil, "disk_usage", lambda path: Disk(1 << 40, 1 << 40, 0))
        monkeypatch.setattr(durable, "disk", FullDisk(0, lasting=True))
        again = http.post("/v1/surfaces", content=npy(hills()))
        assert (again.status_code, again.json()) == (200, made)
        assert again.headers["location"] == made["url"]
        for other in (npy(hills(seed=2)), npy(hills(9, 9))):
            answer = http.post("/v1/surfaces", content=other)
            assert (answer.status_code, answer.json()["code"]) == (507, "full")
        assert before == {path: path.stat().st_mtime_ns for path in below(tmp_path) if path.is_file()}


def test_levels_are_asked_for_by_so_many_at_a_time(tmp_path: Path) -> None:
    with (
        running_server(tmp_path, workers=1, max_level_requests=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, npy(hills(100, 100)))
        statuses: list[int] = []

        def ask() -> None:
            answer = httpx.get(
                f"{url}{made['url']}/levels/{len(made['levels']) - 1}", trust_env=False, timeout=PATIENCE
            )
            statuses.append(answer.status_code)

        threads = [threading.Thread(target=ask) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE)
        assert set(statuses) <= {200, 503}
        assert 200 in statuses
