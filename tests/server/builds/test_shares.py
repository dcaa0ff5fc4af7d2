"""Over real sockets: an offender at each bound, and an honest caller beside it who does not notice."""

from __future__ import annotations

import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

import lodestream as ls
from lodestream.protocol.connection import State
from lodestream.protocol.messages import MAX_HELD, End, Open, Opened, Stop
from lodestream.protocol.wire import parse, serialize
from lodestream.transfer.sender import Sender
from lodestream_server import running_server
from lodestream_server.access.access import key_of
from lodestream_server.access.tokens import TokenFile
from lodestream_server.access.turns import Place, Turns
from lodestream_server.builds import builder, worker
from lodestream_server.routes import streams
from lodestream_server.store.index import LEAST, Surface
from lodestream_server.store.surfaces import Surfaces
from tests.server.access.test_limits import ANNA, Disk
from tests.server.builds import slow
from tests.server.helpers import PATIENCE, Raw, data_of, eventually, hills, npy, problem, push, raw_stream, settled


class Town:
    """A server with two tokens."""

    def __init__(self, url: str, data: Path, tokens: dict[str, str]) -> None:
        self.url = url
        self.data = data
        self.tokens = tokens

    def header(self, name: str) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.tokens[name]}"}

    def client(self, name: str) -> httpx.Client:
        return httpx.Client(base_url=self.url, trust_env=False, timeout=PATIENCE, headers=self.header(name))

    def begin(self, name: str, length: int, body: bytes = b"xxxxxx") -> socket.socket:
        """An upload that says how large it is, and of which no more comes than this."""
        address = urlsplit(self.url)
        made = socket.create_connection((address.hostname, address.port), timeout=PATIENCE)
        made.sendall(
            f"POST /v1/surfaces HTTP/1.1\r\nHost: {address.netloc}\r\nAuthorization: Bearer {self.tokens[name]}\r\n"
            f"Content-Length: {length}\r\nConnection: close\r\n\r\n".encode()
            + body
        )
        return made

    def begun(self, count: int) -> None:
        eventually(
            lambda: len(list((self.data / "scratch" / "incoming").glob("*/0"))) == count or None, "the uploads to begin"
        )

    def await_builds(self) -> None:
        """Wait until no build counts any more: a surface has failed a moment before its build is over."""
        with self.client("operator") as http:
            eventually(lambda: "lodestream_builds_pending 0.0" in http.get("/metrics").text, "the builds to be over")


@pytest.fixture
def town(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Town]:
    file = TokenFile(tmp_path / "tokens.json")
    tokens = {name: file.create(name, ("write",))[0] for name in ("good", "bad", "other")}
    settings = getattr(request, "param", {})
    data = tmp_path / "data"
    with running_server(data, workers=1, token_file=file.path, **settings) as url:
        yield Town(url, data, tokens)


def refusal(made: socket.socket) -> bytes:
    answer = b""
    while piece := made.recv(65536):
        answer += piece
    return answer


@pytest.mark.parametrize("town", [{"max_uploads": 8}], indirect=True)
def test_uploads_that_do_not_come_leave_room_for_others(town: Town) -> None:
    with ExitStack() as held, town.client("good") as good:
        for _ in range(4):
            held.enter_context(town.begin("bad", 1000))
        town.begun(4)
        answer = refusal(held.enter_context(town.begin("bad", 1000)))
        assert answer.startswith(b"HTTP/1.1 429 ")
        assert b"retry-after: " in answer.lower()
        assert b"bad may have no more" in answer
        assert push(good, npy(hills()))["state"] == "ready"


@pytest.mark.parametrize("town", [{"upload_bytes": 1 << 60}], indirect=True)
def test_promises_do_not_take_the_room_of_others(town: Town, monkeypatch: pytest.MonkeyPatch) -> None:
    free = 1 << 40  # whatever other programs do to the disk meanwhile
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Disk(free, 0, free))
    with ExitStack() as held, town.client("good") as good:
        for _ in range(20):
            held.enter_context(town.begin("bad", free // 50))
        town.begun(20)
        answer = refusal(held.enter_context(town.begin("bad", free // 4)))
        assert answer.startswith(b"HTTP/1.1 507 ")
        assert b"retry-after: " in answer.lower()
        assert b"bad may have no more" in answer
        # Others may promise as much as if nobody had promised anything, and their uploads go on.
        large = held.enter_context(town.begin("other", free // 3))
        town.begun(21)
        assert push(good, npy(hills()))["state"] == "ready"
        large.close()
    # One that cannot fit is refused before its body.
    with town.begin("good", 2 * free, b"") as impossible:
        assert refusal(impossible).startswith(b"HTTP/1.1 507 ")


@pytest.mark.parametrize("town", [{"owner_bytes": LEAST + 4000}], indirect=True)
def test_what_one_keeps_on_the_disk_leaves_room_for_others(town: Town) -> None:
    with town.client("bad") as bad, town.client("good") as good:
        made = push(bad, npy(hills(20, 20)))
        answer = bad.post("/v1/surfaces", content=npy(hills(20, 20, seed=2)))
        assert problem(answer) == (507, "full")
        assert f"bad may have at most {LEAST + 4000} bytes of surfaces" in answer.json()["detail"]
        assert answer.headers["retry-after"].isdecimal()
        assert push(bad, npy(hills(20, 20))) == made, "what is there already takes no room"
        assert push(good, npy(hills(20, 20)))["state"] == "ready"
        assert bad.delete(made["url"]).status_code == 204
        assert push(bad, npy(hills(20, 20, seed=2)))["state"] == "ready"


@pytest.mark.parametrize("town", [{"owner_bytes": 4 * LEAST + 8000}], indirect=True)
def test_containers_count_too_and_builds_wait_for_their_owners_room(
    town: Town, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    with town.client("bad") as bad, town.client("good") as good:
        theirs = []
        for seed in range(4):
            answer = bad.post("/v1/surfaces", content=npy(hills(18, 18, seed=seed)))
            assert answer.status_code == 202, answer.text
            theirs.append(answer.headers["location"])
        (town.data / "go").touch()

        def waits() -> list[str]:
            found = [bad.get(where).json() for where in theirs]
            return [entry["url"] for entry in found if "disk space of its owner" in (entry["reason"] or "")]

        left = eventually(waits, "builds that wait for room")
        assert push(good, npy(hills(18, 18, seed=9)))["state"] == "ready"
        assert {bad.get(where).json()["state"] for where in left} == {"queued"}
        for where in theirs:
            if where not in left:
                assert bad.delete(where).status_code == 204
        # Room that comes wakes them.
        assert settled(bad, left[0])["state"] == "ready"


@pytest.mark.parametrize("town", [{"max_builds": 40}], indirect=True)
@pytest.mark.long
def test_builds_of_one_caller_do_not_delay_those_of_another(town: Town, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    with town.client("bad") as bad, town.client("good") as good:
        theirs: list[str] = []
        while True:
            answer = bad.post("/v1/surfaces", content=npy(hills(6, 5, seed=len(theirs))))
            if answer.status_code != 202:
                break
            theirs.append(answer.headers["location"])
        assert problem(answer) == (429, "too-many")
        assert "bad may have no more pending builds" in answer.json()["detail"]
        assert len(theirs) == 20
        mine = good.post("/v1/surfaces", content=npy(hills())).headers["location"]
        monkeypatch.setattr(worker, "build", slow.listed)
        monkeypatch.setattr(builder, "_allowed", slow.allow_more)
        (town.data / "go").touch()
        assert settled(good, mine)["state"] == "ready"
        for where in theirs:
            assert settled(bad, where)["state"] == "ready"
        ended = (town.data / "order").read_text().split()
        assert ended.index(mine.rpartition("/")[2]) <= 1


def test_after_a_restart_builds_are_their_owners(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    file = TokenFile(tmp_path / "tokens.json")
    tokens = {name: file.create(name, ("write",))[0] for name in ("good", "bad")}
    data = tmp_path / "data"

    def posted(town: Town, name: str, seed: int) -> str:
        with town.client(name) as client:
            return str(client.post("/v1/surfaces", content=npy(hills(6, 5, seed=seed))).headers["location"])

    with running_server(data, workers=1, token_file=file.path) as url:
        town = Town(url, data, tokens)
        theirs = [posted(town, "bad", seed) for seed in range(5)]
        mine = posted(town, "good", 9)
    monkeypatch.setattr(worker, "build", slow.listed)
    monkeypatch.setattr(builder, "_allowed", slow.allow_more)
    (data / "go").touch()
    with running_server(data, workers=1, token_file=file.path) as url, Town(url, data, tokens).client("good") as http:
        for where in (*theirs, mine):
            assert settled(http, where)["state"] == "ready"
    order = (data / "order").read_text().split()
    assert order.index(mine.rpartition("/")[2]) <= 1


def test_asking_for_more_attempts_is_asking_for_builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    tokens = {name: file.create(name, ("write",))[0] for name in ("good", "bad")}
    tokens["operator"] = file.create("operator", ("admin",))[0]
    data = tmp_path / "data"
    with running_server(data, workers=1, token_file=file.path, max_builds=4) as url:
        town = Town(url, data, tokens)
        with town.client("bad") as bad, town.client("good") as good:
            failed = [push(bad, npy(hills(seed=seed))[:-1]) for seed in range(3)]
            assert {surface["state"] for surface in failed} == {"failed"}
            town.await_builds()
            monkeypatch.setattr(worker, "build", slow.wait)
            answers = [bad.post(f"{surface['url']}/retry") for surface in failed]
            assert [answer.status_code for answer in answers] == [202, 202, 429]
            assert problem(answers[2]) == (429, "too-many")
            assert good.post("/v1/surfaces", content=npy(hills())).status_code == 202
            (data / "go").touch()


def test_attempts_asked_for_at_the_same_time_are_counted_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    tokens = {name: file.create(name, (scope,))[0] for name, scope in (("bad", "write"), ("operator", "admin"))}
    data, refused, retry = tmp_path / "data", threading.Event(), Surfaces.retry

    def late(self: Surfaces, surface: str) -> Surface:
        refused.wait(PATIENCE)
        return retry(self, surface)

    with (
        running_server(data, workers=1, token_file=file.path, max_builds=4) as url,
        Town(url, data, tokens).client("bad") as bad,
        ThreadPoolExecutor(3) as threads,
    ):
        failed = [push(bad, npy(hills(seed=seed))[:-1]) for seed in range(3)]
        Town(url, data, tokens).await_builds()
        monkeypatch.setattr(Surfaces, "retry", late)
        asked = [threads.submit(bad.post, f"{surface['url']}/retry") for surface in failed]
        wait(asked, PATIENCE, FIRST_COMPLETED)
        refused.set()
        assert sorted(each.result().status_code for each in asked) == [202, 202, 429]


def test_keys_of_builds_are_keys_of_callers() -> None:
    assert key_of("anna") == ANNA.key
    assert key_of(None) != key_of("nobody")


# Plans.


def held_all_over(size: int) -> tuple[tuple[int, int], ...]:
    return tuple((number, 1) for number in range(0, min(2 * MAX_HELD, size - 1), 2))


def opened(stack: ExitStack, town: Town, name: str, surface: dict[str, Any], **values: Any) -> Raw:
    stream = stack.enter_context(raw_stream(town.url + surface["url"], additional_headers=town.header(name)))
    stream.send(Open(**values))
    return stream


def test_a_plan_that_takes_long_stops_nobody(town: Town, monkeypatch: pytest.MonkeyPatch) -> None:
    go, planning, short = threading.Event(), list[str](), 0

    def patient(work: Callable[..., Any]) -> Callable[..., Any]:
        def wait(self: Sender, *arguments: Any) -> Any:
            if len(arguments) and len(arguments[0]) > 6000:
                planning.append("short" if len(arguments[0]) < short else "open")
                assert go.wait(PATIENCE)
            elif self.state is State.ENDED and isinstance(parse(arguments[0]), Open):
                planning.append("again")
                assert go.wait(PATIENCE)
            return work(self, *arguments)

        return wait

    entering, enter = threading.Event(), Turns._enter

    async def noted(self: Turns, place: Place) -> str:
        if place.callers == [key_of("good")]:
            entering.set()
        return await enter(self, place)

    monkeypatch.setattr(Sender, "receive", patient(Sender.receive))
    monkeypatch.setattr(Turns, "_enter", noted)
    with ExitStack() as stack, town.client("good") as good:
        surface = push(good, npy(hills(100, 90)))
        crumbs: dict[str, Any] = {
            "held": held_all_over(surface["bytes"]),
            "container": surface["container_sha256"],
            "credit": 4,
        }
        fewer = {**crumbs, "held": crumbs["held"][:3000]}
        short = len(serialize(Open(**fewer))) + 1
        theirs = [opened(stack, town, "bad", surface, **crumbs) for _ in range(5)]

        def goes_on() -> None:
            assert good.get("/healthz").status_code == 200
            with ExitStack() as mine:
                events = opened(mine, town, "good", surface).until_end()
            assert isinstance(events[0], Opened)
            assert data_of(events) > surface["bytes"] // 2

        eventually(lambda: planning or None, "the first long plan")
        goes_on()
        assert planning == ["open"], "one at a time"
        # In the queue, an honest long plan is the next.
        entering.clear()
        mine = opened(stack, town, "good", surface, **fewer)
        assert entering.wait(PATIENCE)
        go.set()
        assert isinstance(mine.receive(), Opened)
        for stream in theirs:
            assert isinstance(stream.receive(), Opened)
        assert planning == ["open", "short", *["open"] * 4]
        go.clear()
        planning.clear()
        theirs[0].send(Stop())
        while not isinstance(theirs[0].receive(), End):
            pass
        theirs[0].send(Open(ls.Target(first=((0, 5), (0, 5))), credit=4))
        eventually(lambda: planning or None, "the plan that begins with a region")
        goes_on()
        assert planning == ["again"]
        go.set()


def test_a_plan_is_not_left_alone_with_the_sender(town: Town, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that goes while its plan is made: the plan ends before the stream does."""
    ended = list[str]()
    go, begun = threading.Event(), threading.Event()
    receive, close = Sender.receive, streams._Session.close

    def slowly(self: Sender, message: bytes) -> Any:
        if len(message) > 6000:
            begun.set()
            assert go.wait(PATIENCE)
            ended.append("plan")
        return receive(self, message)

    def closed(self: Any) -> None:
        ended.append("stream")
        close(self)

    monkeypatch.setattr(Sender, "receive", slowly)
    monkeypatch.setattr(streams._Session, "close", closed)
    with ExitStack() as stack, town.client("good") as good:
        surface = push(good, npy(hills(100, 90)))
        stream = opened(
            stack, town, "bad", surface, held=held_all_over(surface["bytes"]), container=surface["container_sha256"]
        )
        assert begun.wait(PATIENCE)
        stream.socket.close()
        threading.Timer(0.3, go.set).start()
        eventually(lambda: len(ended) == 2 or None, "the end of both")
        assert ended == ["plan", "stream"]
