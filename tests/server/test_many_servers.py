"""One server that writes to a bucket, others that wait for that, and others that only read."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus

from lodestream import Target
from lodestream.errors import InputError, LodestreamError
from lodestream.protocol.messages import Error, Open, Opened
from lodestream.stores import ConflictError, StoreError, open_store
from lodestream_client.program import main
from lodestream_server import following, running_server
from lodestream_server.access.tokens import TokenObject, Tokens
from lodestream_server.builds import worker
from lodestream_server.connections import connections
from lodestream_server.routes import streams
from lodestream_server.store.lease import Lease
from lodestream_server.store.surfaces import Surfaces
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.helpers import closed, data_of, eventually, hills, npy, problem, push, raw_stream, settled
from tests.stores.emulators import ministack, s3
from tests.stores.memory import memory

__all__ = ["memory", "ministack", "s3"]

#: A busy machine may stop a server for a few seconds, and it has its lease still.
LEASE, LOOK = 9.0, 0.2


@dataclass
class Site:
    """Servers of one bucket."""

    address: str
    folder: Path
    stack: ExitStack

    def start(self, name: str, **settings: Any) -> httpx.Client:
        """Start one; what it does again and again, it does often."""
        usual = {"workers": 1, "lease_seconds": LEASE, "look_seconds": LOOK, "scratch": self.folder / name}
        usual["list_seconds"] = 3600.0  # what is seen is seen by looks
        url = self.stack.enter_context(running_server(self.address, **(usual | settings)))
        return self.stack.enter_context(httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE))


@pytest.fixture
def site(memory: str, tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as stack:
        yield Site(memory, tmp_path, stack)


def role(http: httpx.Client) -> str:
    return str(http.get("/readyz").json()["role"])


def writer(site: Site, name: str = "writer", **settings: Any) -> httpx.Client:
    http = site.start(name, **settings)
    eventually(lambda: role(http) == "writer", "the server to write")
    return http


def states(http: httpx.Client) -> dict[str, str]:
    return {it["id"]: it["state"] for it in http.get("/v1/surfaces").json()["surfaces"]}


def within(seconds: float, look: Callable[[], object], what: str) -> None:
    """As `eventually`, by a clock that a busy machine does not stop: so there is room above what is promised."""
    begun = time.monotonic()
    eventually(look, what)
    assert time.monotonic() - begun < seconds, what


def test_a_reader_serves_what_the_writer_built_and_changes_nothing(
    site: Site, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    first = writer(site)
    reader = site.start("reader", read_only=True)
    assert "this server only reads, from s3://memory/data" in caplog.text
    assert role(reader) == "reader"
    uploaded = push(first, npy(hills()))
    assert uploaded["state"] == "ready"
    eventually(lambda: states(reader) == {uploaded["id"]: "ready"}, "the reader to see it")
    location = f"/v1/surfaces/{uploaded['id']}"
    container = f"/v1/containers/{uploaded['container_sha256']}.lode"
    whole = first.get(container)
    assert whole.status_code == 200
    assert reader.get(container).content == whole.content
    assert reader.head(container).headers["content-length"] == str(len(whole.content))
    part = reader.get(container, headers={"range": "bytes=10-99"})
    assert (part.status_code, part.content) == (206, whole.content[10:100])
    assert part.headers["content-range"] == f"bytes 10-99/{len(whole.content)}"
    assert reader.get(container, headers={"range": "bytes=-7"}).content == whole.content[-7:]
    assert reader.get(container, headers={"range": f"bytes={len(whole.content)}-"}).status_code == 416
    assert reader.get(f"{location}/levels/0?format=npy").status_code == 200
    writes = ("POST", "/v1/surfaces"), ("DELETE", location), ("POST", f"{location}/retry"), ("PUT", "/v1/names/a")
    for method, path in writes:
        assert problem(reader.request(method, path, content=b"")) == (403, "read-only")
    first.delete(location).raise_for_status()
    eventually(lambda: states(reader) == {}, "the reader to see that it is gone")
    assert reader.get(location).status_code == 404


def test_an_upload_that_is_for_another_server_is_no_abuse(
    site: Site, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "_REST_SECONDS", 0.3)
    first = writer(site)
    reader = site.start("reader", read_only=True)
    for http, path, status, cuts in ((reader, "/v1/surfaces", 403, 0), (first, "/v1/nothing", 404, 1)):
        place = http.base_url
        with socket.create_connection((place.host, place.port or 0), PATIENCE) as connection:
            head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {10 << 20}\r\n\r\n"
            connection.sendall(head.encode())
            assert connection.recv(1 << 16).startswith(f"HTTP/1.1 {status}".encode())
            with suppress(OSError):  # it is cut at some time
                while True:
                    connection.sendall(bytes(1 << 16))
        assert caplog.text.count("connection cut: refused-body") == cuts


def test_only_the_writer_says_that_there_is_no_such_upload(site: Site) -> None:
    """A client that is told so begins again."""
    servers = {"writer": writer(site), "waiting": site.start("waiting"), "reader": site.start("reader", read_only=True)}
    headers = {"tus-resumable": "1.0.0", "upload-length": "1000"}
    begun = servers["writer"].post("/v1/uploads", headers=headers).headers["location"]
    for path, at_writer in ((begun, 200), (f"/v1/uploads/{'0' * 32}", 404)):
        statuses = {name: http.head(path, headers=headers).status_code for name, http in servers.items()}
        assert statuses == {"writer": at_writer, "waiting": 503, "reader": 403}


@pytest.fixture
def gets(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The paths of objects that are read from a bucket, at each request."""
    import obstore

    found: list[str] = []

    def count(request: Callable[..., Any], store: Any, path: str, **named: Any) -> Any:
        found.append(path)
        return request(store, path, **named)

    for name in ("get", "get_range", "head"):
        monkeypatch.setattr(obstore, name, partial(count, getattr(obstore, name)))
    return found


def test_a_reader_that_has_not_followed_yet_looks_for_what_it_is_asked_for(site: Site, gets: list[str]) -> None:
    first = writer(site)
    readers = [site.start(name, read_only=True, look_seconds=3600.0) for name in ("a", "b", "c")]
    uploaded = push(first, npy(hills()))
    place = f"/v1/surfaces/{uploaded['id']}"
    first.put("/v1/names/hill", json={"surface": uploaded["id"]}).raise_for_status()
    assert [states(reader) for reader in readers] == [{}] * 3
    assert readers[0].get(place).json()["state"] == "ready"
    assert readers[1].get("/v1/names/hill/container").status_code == 200
    with raw_stream(f"{readers[2].base_url}{place}") as stream:
        stream.send(Open(Target(level=0), credit=1 << 20))
        assert data_of(stream.until_end())
    assert [states(reader) for reader in readers] == [{uploaded["id"]: "ready"}] * 3
    other = push(first, npy(hills(seed=2)))
    eventually(
        lambda: readers[0].get(f"/v1/containers/{other['container_sha256']}.lode").status_code == 200,
        "the writer to tell of its container",
    )
    first.delete("/v1/names/hill").raise_for_status()
    first.delete(place).raise_for_status()
    gets.clear()
    unknown = [f"/v1/containers/{number:064x}.lode" for number in range(16)]
    with ThreadPoolExecutor(8) as threads:
        assert set(threads.map(lambda path: readers[0].get(path).status_code, unknown)) == {404}
    assert 0 < gets.count("data/changes.json") < 16, "what the writer has told answers all of them"
    assert not any("containers/00" in path for path in gets)
    gets.clear()
    strange = [f"/v1/surfaces/{number:020x}" for number in range(100)]
    asked = [*strange, "/v1/surfaces/nothing", "/v1/names/nobody"]
    begun = time.monotonic()
    assert {readers[0].get(path).status_code for path in asked} == {404}
    seconds = int(time.monotonic() - begun) + 1
    assert 0 < sum("/surfaces/" in path for path in gets) <= 16 * seconds, "each costs a request"
    gets.clear()
    with ThreadPoolExecutor(8) as threads:
        assert set(threads.map(lambda path: readers[1].get(path).status_code, strange[:1] * 16)) == {404}
    assert 0 < len(gets) < 16, "who asks for the same has one look"


def test_what_a_reader_knows_costs_one_request_at_most(site: Site, gets: list[str]) -> None:
    first = writer(site, look_seconds=3600.0)
    reader = site.start("reader", read_only=True, look_seconds=3600.0)
    uploaded = push(first, npy(hills()))
    place = f"/v1/surfaces/{uploaded['id']}"
    first.put("/v1/names/hill", json={"surface": uploaded["id"]}).raise_for_status()

    def stream() -> None:
        with raw_stream(f"{reader.base_url}{place}") as opened:
            opened.send(Open(Target(), credit=1 << 20))
            assert data_of(opened.until_end()) > 1000

    known: dict[str, Callable[[], object]] = {path: partial(reader.get, path) for path in (place, "/v1/names/hill")}
    known |= {"/v1/surfaces": partial(states, reader), "stream": stream}
    for ask in known.values():
        ask()
        ask()
    eventually(lambda: list((site.folder / "reader").glob("lodestream/containers/*.lode")), "the container as a file")
    costs = {}
    for what, ask in known.items():
        gets.clear()
        ask()
        costs[what] = [path.removeprefix("data/") for path in gets if "writer.json" not in path]
    described = [f"built/{uploaded['id']}.json"]
    assert costs == {place: described, "/v1/names/hill": described, "/v1/surfaces": [], "stream": []}


def test_a_reader_looks_whether_a_build_has_ended(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    first = writer(site)
    reader = site.start("reader", read_only=True, look_seconds=3600.0)
    location = first.post("/v1/surfaces", content=npy(hills())).headers["location"]
    assert reader.get(location).json()["state"] == "queued"
    assert problem(reader.get(f"{location}/container")) == (409, "not-ready")
    (site.folder / "writer" / "go").touch()
    settled(first, location)
    assert reader.get(f"{location}/container").status_code == 200


def test_a_reader_that_cannot_reach_the_bucket_does_not_say_that_there_is_nothing(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = writer(site)
    reader = site.start("reader", read_only=True, look_seconds=3600.0)
    uploaded = push(first, npy(hills()))

    def fail(*_: object) -> None:
        raise StoreError("the bucket does not answer")

    monkeypatch.setattr(Surfaces, "refresh", fail)
    assert problem(reader.get(uploaded["url"])) == (503, "busy")
    over = threading.Event()
    monkeypatch.setattr(following, "_PATIENCE", 0.1)
    monkeypatch.setattr(Surfaces, "refresh", lambda *_: over.wait(PATIENCE))
    try:
        assert problem(reader.get(f"/v1/surfaces/{'0' * 20}")) == (503, "busy")
    finally:
        over.set()


def test_a_reader_answers_whoever_waits_once_the_writer_has_built(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    first = writer(site)
    reader = site.start("reader", read_only=True)
    location = first.post("/v1/surfaces", content=npy(hills())).headers["location"]
    eventually(lambda: states(reader), "the reader to see it")
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(reader.get, location, params={"wait": "60"})
        time.sleep(LOOK)
        (site.folder / "writer" / "go").touch()
        settled(first, location)
        within(10.0, waiting.done, "the reader to answer")
        assert waiting.result().json()["state"] == "ready"


def test_a_container_that_the_bucket_has_lost_is_built_again_when_it_is_fetched(site: Site) -> None:
    http = writer(site)
    uploaded = push(http, npy(hills()))
    place = f"/v1/containers/{uploaded['container_sha256']}.lode"
    open_store(site.address).delete([place.removeprefix("/v1/")])
    assert problem(http.get(place)) == (503, "busy")
    assert settled(http, uploaded["url"])["state"] == "ready"
    assert len(http.get(place).content) == uploaded["bytes"]


def test_another_server_waits_says_for_whom_and_takes_over(site: Site) -> None:
    first = writer(site)
    uploaded = push(first, npy(hills()))
    second = site.start("second")
    eventually(lambda: second.get("/readyz").json().get("writer"), "the second one to know who writes")
    assert role(second) == "waiting"
    eventually(lambda: states(second) == {uploaded["id"]: "ready"}, "it to answer reads")
    refused = second.post("/v1/surfaces", content=npy(hills(seed=2)))
    assert problem(refused) == (503, "busy")
    assert refused.json()["detail"].endswith(") does; send it to that server")
    assert refused.headers["retry-after"] == "5"


def test_what_the_reader_of_a_folder_or_of_nothing_is_told(site: Site, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="in a bucket"):
        site.stack.enter_context(running_server(tmp_path / "data", read_only=True))
    with pytest.raises(
        InputError, match="expected the data of a server in s3://memory/data, got none: start one without --read-only"
    ):
        site.start("reader", read_only=True)
    open_store(site.address).create("view.json", b"{}")
    with pytest.raises(LodestreamError, match="published prefix"):
        site.start("writer")


def test_a_token_that_is_revoked_ends_at_every_reader_and_so_do_its_streams(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams, "_TOKEN_SECONDS", LOOK)
    tokens = TokenObject(open_store(site.address))
    text, _ = tokens.create("ann", ("write",))
    header = {"authorization": f"Bearer {text}"}
    first = writer(site)
    first.headers.update(header)
    uploaded = push(first, npy(hills(200, 200)))
    reader = site.start("reader", read_only=True)
    assert reader.get("/v1/surfaces").status_code == 401
    assert reader.get("/v1/surfaces", headers=header).status_code == 200
    assert problem(reader.post("/v1/surfaces", headers=header))[1] == "read-only"
    surface = f"{str(reader.base_url).rstrip('/')}/v1/surfaces/{uploaded['id']}"
    with raw_stream(surface, additional_headers=header) as stream:
        stream.send(Open(credit=1 << 13))
        assert isinstance(stream.receive(), Opened)
        tokens.revoke("ann")
        eventually(lambda: reader.get("/v1/surfaces", headers=header).status_code == 401, "it to be refused")
        while not isinstance(event := stream.receive(), Error):  # it has no credit, and waits
            pass
        assert event.code == "bad-token"
        closed(stream, 4401)
    with pytest.raises(InvalidStatus), raw_stream(surface, additional_headers=header):
        pass
    assert reader.get(f"{surface}/container", headers=header | {"range": "bytes=0-9"}).status_code == 401


def test_a_pull_that_is_cut_short_goes_on_at_another_server(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "cache"))
    first = writer(site)
    reader = site.start("reader", read_only=True)
    surface = hills(200, 200)
    uploaded = push(first, npy(surface))
    eventually(lambda: states(reader).get(uploaded["id"]) == "ready", "the reader to see it")
    out = tmp_path / "out.npy"
    urls = [str(http.base_url).rstrip("/") + f"/v1/surfaces/{uploaded['id']}" for http in (first, reader)]
    assert main(["pull", urls[0], str(out), "--resume", "--max-bytes", "20000"]) == 0
    capsys.readouterr()
    assert main(["pull", urls[1], str(out), "--resume", "--json"]) == 0
    told = capsys.readouterr()
    assert "are here from an earlier pull" in told.err
    figures = json.loads(told.out)
    assert figures["wire_bytes"] < figures["bytes"] - 15_000
    assert np.load(out).tobytes() == surface.tobytes()


def test_a_server_that_loses_its_lease_cuts_its_builds_short_and_goes_on_when_it_has_it_again(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    http = writer(site)
    location = http.post("/v1/surfaces", content=npy(hills())).headers["location"]
    eventually(lambda: http.get(location).json()["progress"] == 0.5, "the build to begin")
    store = open_store(site.address)
    other = Lease(store, PATIENCE)  # which nobody renews
    while not other.held:
        with suppress(ConflictError):  # it was renewed meanwhile
            other._tag = store.get("writer.json")[1]
            other._write(time.monotonic(), 99)
    eventually(lambda: role(http) == "waiting", "it to notice")
    eventually(lambda: http.get(location).json()["state"] == "queued", "the build to be cut short")
    assert problem(http.post("/v1/surfaces", content=npy(hills(seed=2)))) == (503, "busy")
    other.close()
    eventually(lambda: role(http) == "writer", "it to write again")
    (site.folder / "writer" / "go").touch()
    assert settled(http, location)["state"] == "ready"


def test_the_command_changes_the_tokens_in_a_bucket(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    data = ("--data", site.address)
    assert main(["token", "create", "ann", "--scope", "write", *data]) == 0
    told = capsys.readouterr()
    assert "its hash is in tokens.json in s3://memory/data" in told.err
    found = Tokens(TokenObject(open_store(site.address))).find(told.out.strip())
    assert found is not None
    assert (found.name, found.scopes) == ("ann", ("write",))
    assert main(["token", "create", "ben", *data]) == 0
    assert main(["token", "list", *data]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert main(["token", "revoke", "ann", *data]) == 0
    assert [token.name for token in TokenObject(open_store(site.address)).load()] == ["ben"]
    assert main(["token", "revoke", "ann", *data]) == 1
    assert "there are 'ben'" in capsys.readouterr().err


def test_tokens_that_two_change_at_once_are_told_and_not_lost(memory: str) -> None:
    first, second = TokenObject(open_store(memory)), TokenObject(open_store(memory))
    tokens = Tokens(first)
    assert not tokens.used
    text, _ = first.create("ann", ("read",))
    assert tokens.find(text) is not None

    def change() -> None:
        with second._change() as changed:
            first.create("ben", ("read",))
            changed.clear()

    with pytest.raises(ConflictError):
        change()
    assert [token.name for token in first.load()] == ["ann", "ben"]
    store = open_store(memory)
    store.replace("tokens.json", b"[]", store.get("tokens.json")[1])
    assert tokens.used
    first.look()
    assert tokens.find(text) is None, "nobody is let in by what cannot be read"
