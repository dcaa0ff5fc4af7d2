"""Uploads that go on after lost connections: every order of answers without I/O, and over links that break."""

from __future__ import annotations

import hashlib
import io
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import TypeVar
from urllib.parse import urlsplit

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.errors import InputError, LodestreamError, NotFoundError, RemoteProtocolError, TooLargeError
from lodestream_client import Client
from lodestream_client.errors import SilenceError, UnreachableError
from lodestream_client.requests import problems, resuming
from lodestream_client.requests.answers import Answer
from lodestream_client.requests.bodies import Body
from lodestream_client.requests.calls import Call, Flow, Pause
from lodestream_server import running_server
from tests.links import Fault, linked
from tests.server.programs import Server

T = TypeVar("T")

UPLOADS = "http://host/v1/uploads"
ADDRESS = f"{UPLOADS}/0"
DATA = bytes(range(100))


def body(data: bytes = DATA, told: list[float] | None = None) -> Body:
    return Body([("a.npy", io.BytesIO(data))], None if told is None else told.append)


class Other:
    """The other end of an upload, which does what a test says and keeps what it was sent."""

    def __init__(self) -> None:
        self.has = b""
        self.calls: list[str] = []
        self.paused: list[float] = []

    def answer(self, call: Call, take: int | None = None) -> Answer:
        """Answer as a server does that takes only so many bytes of what is sent."""
        self.calls.append(call.method)
        if call.method == "POST":
            self.has = b""
            return Answer(201, "Created", {"location": ADDRESS})
        if call.method == "PATCH":
            assert call.body is not None
            if int(call.headers["Upload-Offset"]) != len(self.has):
                return Answer(409, "Conflict", {"upload-offset": str(len(self.has))})
            self.has += b"".join(call.body.chunks())[:take]
        place = {"location": "/v1/surfaces/1"} if len(self.has) == len(DATA) else {}
        return Answer(204, "No Content", {"upload-offset": str(len(self.has)), **place})

    def run(self, sent: Body, respond: Callable[[Call], Answer]) -> str:
        """Carry out an upload; `respond` answers, or raises what the client sees."""
        return carried_out(resuming.completed(UPLOADS, ADDRESS, sent, _begun), respond, self.paused)


def carried_out(flow: Flow[T], respond: Callable[[Call], Answer], paused: list[float]) -> T:
    """Carry out requests; `respond` answers, or raises what the client sees."""
    step = next(flow)
    try:
        while True:
            if isinstance(step, Pause):
                paused.append(step.seconds)
                step = flow.send(None)
                continue
            assert isinstance(step, Call)
            try:
                answer = respond(step)
            except LodestreamError as error:
                step = flow.throw(error)
            else:
                step = flow.send(answer)
    except StopIteration as end:
        result: T = end.value
        return result


def _begun() -> Flow[str | None]:
    answer = yield Call("POST", UPLOADS)
    assert answer is not None
    if answer.status != 201:
        raise problems.from_response(answer.status, answer.reason, answer.content, UPLOADS)
    return answer.headers["location"]


def test_an_upload_without_faults_is_one_request() -> None:
    server, told = Other(), list[float]()
    assert server.run(body(told=told), server.answer) == "http://host/v1/surfaces/1"
    assert (server.calls, server.has, server.paused, told[-1]) == (["PATCH"], DATA, [], 1.0)


FAULTS = st.one_of(
    st.tuples(st.sampled_from(["before", "after"]), st.integers(0, 100)),
    st.tuples(st.just("status"), st.sampled_from([408, 409, 423, 429, 500, 502, 503, 504])),
)


@given(faults=st.lists(FAULTS, max_size=8))
def test_it_ends_with_all_bytes_whatever_happened_before(faults: list[tuple[str, int]]) -> None:
    server, coming = Other(), iter(faults)

    def respond(call: Call) -> Answer:
        fault, value = next(coming, ("none", 0))
        if fault == "status":
            return Answer(value, "", {"retry-after": "2"})
        if fault == "before":
            raise UnreachableError("no connection")
        answer = server.answer(call, value if fault == "after" else None)
        if fault == "after":
            raise UnreachableError("no connection")
        return answer

    assert server.run(body(), respond) == "http://host/v1/surfaces/1"
    assert server.has == DATA
    assert all(0 <= seconds <= 30 for seconds in server.paused)
    assert len(server.paused) == len(faults)


def test_it_gives_up_when_it_comes_no_further() -> None:
    server, asked = Other(), list[str]()

    def silent(call: Call) -> Answer:
        asked.append(call.method)
        raise UnreachableError("no connection to host")

    with pytest.raises(UnreachableError, match="no connection to host"):
        server.run(body(), silent)
    assert asked == ["PATCH"] + ["HEAD"] * 11
    assert 11 < sum(server.paused) + 11 < 180
    for answer in (Answer(204, "", {"upload-offset": "0"}), Answer(409, "", {"upload-offset": "0"})):
        with pytest.raises(RemoteProtocolError):
            server.run(body(), partial(_always, answer))


@pytest.mark.parametrize("status", [404, 410])
def test_an_upload_that_the_server_has_lost_begins_again(status: int) -> None:
    """As at a server that has taken the place of the one where it began, and is not ready at once."""
    server, asked = Other(), list[str]()

    def respond(call: Call) -> Answer:
        asked.append(call.method)
        if len(asked) == 1:
            server.answer(call, 40)
            raise UnreachableError("no connection")
        if len(asked) < 5:
            return Answer(503 if call.method == "POST" else status, "", {})
        return server.answer(call)

    assert server.run(body(), respond) == "http://host/v1/surfaces/1"
    assert server.has == DATA
    assert asked == ["PATCH", "HEAD", "POST", "POST", "POST", "PATCH"]


def test_an_upload_that_is_lost_again_and_again_is_given_up() -> None:
    server, asked = Other(), list[str]()

    def respond(call: Call) -> Answer:
        asked.append(call.method)
        if call.method == "PATCH" and server.calls.count("PATCH") % 2:
            return Answer(404, "Not Found", {}, b'{"code": "not-found", "detail": "No upload 0 on this server"}')
        return server.answer(call, 40)

    server.calls.append("PATCH")
    with pytest.raises(NotFoundError, match="No upload 0"):
        server.run(body(), respond)
    assert asked.count("POST") == 3


READY = Answer(200, "OK", {}, b'{"state": "ready"}')
REFUSED = Answer(403, "Forbidden", {}, b'{"code": "forbidden", "detail": "no"}')


@pytest.mark.parametrize("last", [READY, REFUSED])
def test_a_surface_that_is_stored_is_asked_for_until_there_is_an_answer(last: Answer) -> None:
    lost = UnreachableError("no connection")
    coming = iter((lost, Answer(503, "", {"retry-after": "7"}), SilenceError("nothing"), Answer(502, "", {}), last))
    asked, paused = list[Call](), list[float]()

    def respond(call: Call) -> Answer:
        asked.append(call)
        answer = next(coming)
        if isinstance(answer, LodestreamError):
            raise answer
        return answer

    surface = "http://host/v1/surfaces/1"
    assert carried_out(resuming.answered(surface, {"wait": "20"}), respond, paused) is last
    assert asked == [Call("GET", surface, {"wait": "20"})] * 5
    assert (len(paused), paused[1]) == (4, 7)


def test_what_does_not_answer_is_given_up() -> None:
    asked, paused = list[Call](), list[float]()

    def silent(call: Call) -> Answer:
        asked.append(call)
        raise UnreachableError("no connection to host")

    with pytest.raises(UnreachableError, match="no connection to host"):
        carried_out(resuming.answered("http://host/v1/surfaces/1"), silent, paused)
    assert (len(asked), len(paused)) == (12, 11)
    busy = Answer(503, "", {})
    assert carried_out(resuming.answered("http://host/v1/surfaces/1"), partial(_always, busy), paused) is busy


def test_a_link_that_breaks_while_a_surface_is_built_does_not_matter(
    server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resuming, "_FIRST_PAUSE", 0.001)
    breaks = [3]

    def fault(number: int) -> Fault:
        if began and breaks[0]:
            breaks[0] -= 1
            return Fault(cut_down=50, reset=True)
        return Fault()

    began = list[float]()

    def progress(stage: str, fraction: float) -> None:
        if stage == "building" and not began:
            began.append(fraction)
            link.cut()
            while link.open:
                time.sleep(0.001)

    with linked(server, fault) as link, Client(link.url) as client:
        assert client.upload(ls.Surface(np.random.default_rng(11).normal(size=(300, 300))), progress=progress).ready
    assert breaks == [0]


def _always(answer: Answer, call: Call) -> Answer:
    return answer


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        (Answer(422, "", {}, b'{"code": "bad-input", "detail": "other bytes"}'), InputError, "other bytes"),
        (Answer(507, "", {}, b'{"code": "full", "detail": "full"}'), LodestreamError, "full"),
        (Answer(204, "", {}), RemoteProtocolError, "how far"),
        (Answer(204, "", {"upload-offset": "101"}), RemoteProtocolError, "how far"),
        (Answer(204, "", {"upload-offset": "-1"}), RemoteProtocolError, "how far"),
        (Answer(204, "", {"location": "http://other/v1/surfaces/1"}), RemoteProtocolError, "an address on http://host"),
    ],
)
def test_what_is_final_is_told_at_once(answer: Answer, error: type[LodestreamError], words: str) -> None:
    server, asked = Other(), list[str]()

    def respond(call: Call) -> Answer:
        asked.append(call.method)
        return answer

    with pytest.raises(error, match=words):
        server.run(body(), respond)
    assert asked == ["PATCH"]


def test_an_upload_elsewhere_is_not_sent() -> None:
    with pytest.raises(RemoteProtocolError, match="expected an address on http://host"):
        next(resuming.completed(UPLOADS, "http://other/v1/uploads/0", body(), _begun))


def test_the_beginning_says_what_comes() -> None:
    sent = body()
    sent.hash()
    assert sent.sha256 == hashlib.sha256(DATA).hexdigest()
    assert sent.left == len(DATA)
    assert resuming.beginning(sent)["Upload-Length"] == "100"


@pytest.mark.parametrize("seed", range(3))
def test_uploads_arrive_over_links_that_break(seed: int, server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resuming, "LEAST", 1000)
    monkeypatch.setattr(resuming, "_FIRST_PAUSE", 0.001)
    random = Random(seed)
    heights = np.random.default_rng(seed).normal(size=(300, 200 + seed)).astype(np.float32)
    file = io.BytesIO()
    np.save(file, heights)
    size = len(file.getvalue())
    # The request that begins the upload takes one connection, which the next one may keep.
    cuts = [2000 + random.randrange(size), *(random.randrange(size) for _ in range(3))]

    def fault(number: int) -> Fault:
        return Fault(cut_up=cuts[number], reset=random.random() < 0.5) if number < len(cuts) else Fault()

    told = list[tuple[str, float]]()
    with linked(server, fault) as link:
        with Client(link.url) as client:
            surface = client.upload(
                file.getvalue(), filename="a.npy", progress=lambda *what: told.append(what), wait=False
            )
        assert link.connections > 1
    client = Client(server)
    ready = client.upload(file.getvalue(), filename="a.npy")
    assert (ready.id, ready.details["filenames"]) == (surface.id, ["a.npy"])
    assert ("sending", 1.0) in told
    with client.connect(ready.id) as stream:
        *_, last = stream
    assert np.array_equal(last.points, heights)


def test_a_small_upload_goes_on_after_lost_connections(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resuming, "_FIRST_PAUSE", 0.001)
    file = io.BytesIO()
    np.save(file, np.random.default_rng(7).normal(size=(120, 90)))

    def upload(broken: int) -> tuple[int, str]:
        """Return the number of connections that an upload takes if so many of them break, and its surface."""
        with linked(server, lambda number: Fault(cut_up=20_000, reset=True) if number < broken else Fault()) as link:
            with Client(link.url) as client:
                surface = client.upload(file.getvalue(), filename="a.npy", wait=False)
            return link.connections, surface.id

    made = [upload(broken) for broken in range(4)]
    assert [connections for connections, _ in made] == [1, 2, 3, 4]
    assert len({surface for _, surface in made}) == 1


def test_a_refusal_is_told_though_the_connection_was_cut_while_the_file_was_sent(tmp_path: Path) -> None:
    """A file that fills what the system keeps of a connection whose other end does not read, and is no large one."""
    with (
        running_server(tmp_path / "data", workers=1, upload_bytes=1000) as url,
        pytest.raises(TooLargeError, match="may have 1000"),
    ):
        Client(url).upload(bytes(resuming.LEAST - 1), filename="a.npy")


def test_a_server_without_such_uploads_gets_them_in_one(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resuming, "LEAST", 1000)
    monkeypatch.setattr("lodestream_client.requests.addresses._UPLOADS", "/v1/names")  # answered 405
    heights = np.random.default_rng(9).normal(size=(30, 20))
    assert Client(server).upload(ls.Surface(heights)).ready


def test_where_no_server_is_the_first_answer_is_told(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the whole file is sent, which a server that has answered would not read."""
    monkeypatch.setattr(resuming, "LEAST", 1000)
    with pytest.raises(NotFoundError, match="No such address on this server: '/maps/v1/uploads'"):
        Client(f"{server}/maps").upload(ls.Surface(np.random.default_rng(9).normal(size=(30, 20))))


def test_an_upload_begins_again_where_its_parts_are_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where another server takes over, which has no scratch folder of the one before."""
    monkeypatch.setattr(resuming, "LEAST", 1000)
    monkeypatch.setattr(resuming, "_LONGEST_PAUSE", 0.5)
    monkeypatch.setattr(resuming, "_ATTEMPTS", 200)
    file = io.BytesIO()
    np.save(file, np.random.default_rng(6).normal(size=(1000, 1000)).astype(np.float32))
    running, lost = Server(tmp_path / "data"), False
    port = urlsplit(running.url).port

    def sent(stage: str, fraction: float) -> None:
        nonlocal running, lost
        if stage == "sending" and fraction > 0.5 and not lost:
            lost = True
            running.kill()
            shutil.rmtree(tmp_path / "data" / "scratch")
            running = Server(tmp_path / "data", port=port)

    try:
        surface = Client(running.url).upload(file.getvalue(), filename="a.npy", progress=sent, wait=False)
        assert lost
        with running.client() as http:
            assert http.get(surface.url).json()["upload_bytes"] == len(file.getvalue())
            assert len(http.get("/v1/surfaces").json()["surfaces"]) == 1
    finally:
        running.kill()
    (upload,) = (tmp_path / "data" / "uploads").iterdir()
    assert (upload / "0").read_bytes() == file.getvalue()


@pytest.mark.long
def test_an_upload_outlives_servers_that_are_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resuming, "LEAST", 1000)
    monkeypatch.setattr(resuming, "_LONGEST_PAUSE", 0.5)
    monkeypatch.setattr(resuming, "_ATTEMPTS", 200)
    heights = np.random.default_rng(5).normal(size=(1000, 1000)).astype(np.float32)
    file = io.BytesIO()
    np.save(file, heights)
    running, killed = Server(tmp_path / "data"), 0
    port = urlsplit(running.url).port

    def sent(stage: str, fraction: float) -> None:
        nonlocal running, killed
        if stage == "sending" and fraction > 0.3 * (killed + 1) and killed < 2:
            running.kill()
            killed += 1
            running = Server(tmp_path / "data", port=port)

    try:
        surface = Client(running.url).upload(file.getvalue(), filename="a.npy", progress=sent, wait=False)
        assert killed == 2
        with running.client() as http:
            told = http.get(surface.url).json()
            assert (told["upload_bytes"], told["filenames"]) == (len(file.getvalue()), ["a.npy"])
            assert len(http.get("/v1/surfaces").json()["surfaces"]) == 1
    finally:
        running.kill()
    (upload,) = (tmp_path / "data" / "uploads").iterdir()
    assert (upload / "0").read_bytes() == file.getvalue()
