"""Uploads in parts: tus 1.0.0, over real sockets that break."""

from __future__ import annotations

import base64
import hashlib
import io
import itertools
import os
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from tusclient.client import TusClient

from lodestream_server import running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.store import partial_uploads, surfaces
from tests.examples import every
from tests.links import Fault, linked
from tests.server.helpers import PATIENCE, eventually, hills, kept, listed, npy, problem, settled
from tests.server.programs import Server

TUS = {"tus-resumable": "1.0.0"}
PARTIAL = "scratch/partial"


def client(url: str) -> httpx.Client:
    return httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE)


def said(**values: str) -> str:
    return ",".join(f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in values.items())


def began(http: httpx.Client, length: int, metadata: str = "", **query: str) -> httpx.Response:
    headers = {**TUS, "upload-length": str(length), **({"upload-metadata": metadata} if metadata else {})}
    return http.post("/v1/uploads", headers=headers, params=query)


def begun(http: httpx.Client, length: int, metadata: str = "", **query: str) -> str:
    answer = began(http, length, metadata, **query)
    assert answer.status_code == 201, answer.text
    assert answer.headers["tus-resumable"] == "1.0.0"
    return answer.headers["location"]


def part(
    http: httpx.Client, address: str, offset: int, data: bytes | Iterator[bytes], **headers: str
) -> httpx.Response:
    said = {**TUS, "upload-offset": str(offset), "content-type": "application/offset+octet-stream", **headers}
    return http.patch(address, headers=said, content=data)


def offset(http: httpx.Client, address: str) -> int:
    answer = http.head(address, headers=TUS)
    assert answer.status_code == 200
    assert answer.headers["cache-control"] == "no-store"
    return int(answer.headers["upload-offset"])


@contextmanager
def half_sent(url: str, address: str, offset: int, data: bytes, length: int) -> Iterator[socket.socket]:
    """A request that has sent some of the bytes that it announced."""
    place = urlsplit(url)
    head = (
        f"PATCH {address} HTTP/1.1\r\nHost: {place.netloc}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: {offset}\r\n"
        f"Content-Type: application/offset+octet-stream\r\nContent-Length: {length}\r\n\r\n"
    )
    with socket.create_connection((place.hostname or "", place.port or 0), timeout=PATIENCE) as connection:
        connection.sendall(head.encode() + data)
        yield connection


def test_parts_become_the_surface_that_the_whole_becomes(http: httpx.Client, data: Path) -> None:
    body = npy(hills(seed=70))
    metadata = said(filename="hills.npy", sha256=hashlib.sha256(body).hexdigest())
    address = begun(http, len(body), metadata, precision="0.5", name="Hills")
    first = part(http, address, 0, body[:1000])
    assert (first.status_code, first.headers["upload-offset"], "location" in first.headers) == (204, "1000", False)
    assert first.headers["upload-expires"].endswith("GMT")
    looked = http.head(address, headers=TUS)
    assert (looked.headers["upload-length"], looked.headers["upload-metadata"]) == (str(len(body)), metadata)
    last = part(http, address, 1000, iter([body[1000:3000], body[3000:]]))
    assert (last.status_code, last.headers["upload-offset"]) == (204, str(len(body)))
    location = last.headers["location"]
    surface = settled(http, location)
    assert (surface["state"], surface["filenames"]) == ("ready", ["hills.npy"])
    again = http.post("/v1/surfaces", content=body, params={"precision": "0.5", "name": "Hills"})
    assert (again.status_code, again.headers["location"]) == (200, location)
    # Whoever has lost the last answer finds the surface; nothing but that is kept.
    for answer in (http.head(address, headers=TUS), part(http, address, len(body), b"")):
        assert (answer.headers["upload-offset"], answer.headers["location"]) == (str(len(body)), location)
        assert "upload-expires" not in answer.headers
    assert kept(data, f"{PARTIAL}/{address.rpartition('/')[2]}") == ["upload.json"]
    assert kept(data, "scratch/incoming") == []
    assert http.delete(address, headers=TUS).status_code == 204
    assert http.head(address, headers=TUS).status_code == 404
    assert http.get(location).status_code == 200


def test_what_is_offered_is_said(http: httpx.Client) -> None:
    answer = http.options("/v1/uploads")
    assert answer.status_code == 204
    assert answer.headers["tus-version"] == answer.headers["tus-resumable"] == "1.0.0"
    assert answer.headers["tus-extension"] == "creation,expiration,termination"
    assert answer.headers["tus-max-size"] == str(1 << 20)


@pytest.mark.parametrize(
    ("length", "headers", "query", "expected"),
    [
        ("0", {}, {}, (422, "bad-option")),
        ("-1", {}, {}, (422, "bad-option")),
        ("1" * 30, {}, {}, (422, "bad-option")),
        (str((1 << 20) + 1), {}, {}, (413, "too-large")),
        ("9" * 18, {}, {}, (413, "too-large")),
        ("9", {"tus-resumable": "0.2.2"}, {}, (412, "wrong-version")),
        ("9", {"upload-metadata": "sha256 " + "0" * 64}, {}, (422, "bad-option")),
        ("9", {"upload-metadata": "filename ,filename eA=="}, {}, (422, "bad-option")),
        ("9", {"upload-metadata": "filename %%%"}, {}, (422, "bad-option")),
        ("9", {"upload-metadata": "filename /w=="}, {}, (422, "bad-option")),
        ("9", {"upload-metadata": said(precision="0.5")}, {}, (422, "bad-option")),
        ("9", {"upload-metadata": said(filename="x" * 4000)}, {}, (422, "bad-option")),
        ("9", {}, {"precision": "nothing"}, (422, "bad-option")),
        ("9", {}, {"presicion": "0.5"}, (422, "bad-option")),
        ("9", {}, {"array": "x" * 4000}, (422, "bad-input")),
    ],
)
def test_a_beginning_that_cannot_end_well_is_refused(
    http: httpx.Client,
    data: Path,
    length: str,
    headers: dict[str, str],
    query: dict[str, str],
    expected: tuple[int, str],
) -> None:
    before = kept(data, PARTIAL)
    answer = http.post("/v1/uploads", headers={**TUS, "upload-length": length, **headers}, params=query)
    assert problem(answer) == expected
    assert answer.headers["tus-resumable"] == "1.0.0"
    assert kept(data, PARTIAL) == before


def test_a_length_that_is_missing_is_told(http: httpx.Client) -> None:
    detail = http.post("/v1/uploads", headers=TUS).json()["detail"]
    assert detail == "The header Upload-Length is missing: it is a number of bytes"


def test_a_part_that_is_not_the_next_one_is_refused(http: httpx.Client) -> None:
    body = npy(hills(seed=71))
    address = begun(http, len(body))
    assert part(http, address, 0, body[:500]).status_code == 204
    for wrong in (0, 499, 501, len(body), 10**17):
        answer = part(http, address, wrong, b"x")
        assert problem(answer) == (409, "wrong-offset")
        assert answer.headers["upload-offset"] == "500"
    assert problem(part(http, address, 500, b"x", **{"upload-offset": "five"})) == (422, "bad-option")
    assert problem(part(http, address, 500, b"x", **{"content-type": "text/plain"})) == (415, "wrong-type")
    assert problem(part(http, address, 500, b"x", **{"tus-resumable": "2.0.0"})) == (412, "wrong-version")
    assert problem(part(http, address, 500, bytes(len(body)))) == (413, "too-large")
    assert offset(http, address) == 500
    # Of a length that nobody has announced, nothing beyond the end is kept.
    assert problem(part(http, address, 500, iter([body[500:], b"more"]))) == (413, "too-large")
    left = offset(http, address)
    assert part(http, address, left, body[left:]).status_code == 204
    assert problem(part(http, address, len(body) + 1, b"x")) == (409, "wrong-offset")
    assert problem(part(http, "/v1/uploads/" + "0" * 32, 0, b"x")) == (404, "not-found")


def test_what_cannot_become_a_surface_is_gone(http: httpx.Client, data: Path) -> None:
    body, before = npy(hills(seed=72)), listed(http)
    others = kept(data, PARTIAL)
    other = begun(http, len(body), said(sha256="0" * 64))
    answer = part(http, other, 0, body)
    assert problem(answer) == (422, "bad-input")
    assert hashlib.sha256(body).hexdigest() in answer.json()["detail"]
    unknown = begun(http, 3)
    assert problem(part(http, unknown, 0, b"\0\1\2")) == (422, "bad-file")
    option = begun(http, len(body), array="high")
    assert problem(part(http, option, 0, body)) == (422, "bad-option")
    for address in (other, unknown, option):
        assert http.head(address, headers=TUS).status_code == 404
    assert (kept(data, PARTIAL), kept(data, "scratch/incoming"), listed(http)) == (others, [], before)


def test_a_client_that_knows_only_post_may_continue(http: httpx.Client) -> None:
    body = npy(hills(seed=73))
    address = begun(http, len(body))
    headers = {**TUS, "x-http-method-override": "PATCH", "upload-offset": "0"}
    headers["content-type"] = "application/offset+octet-stream"
    answer = http.post(address, headers=headers, content=body[:10])
    assert (answer.status_code, answer.headers["upload-offset"]) == (204, "10")
    looked = http.post(address, headers={**TUS, "x-http-method-override": "HEAD"})
    assert looked.headers["upload-offset"] == "10"
    assert problem(http.post(address, headers=TUS)) == (422, "bad-option")
    gone = http.post(address, headers={**TUS, "x-http-method-override": "DELETE"})
    assert (gone.status_code, http.head(address, headers=TUS).status_code) == (204, 404)


def test_what_was_written_before_a_connection_broke_is_kept(http: httpx.Client, server: str, data: Path) -> None:
    body = npy(hills(220, 230, seed=74))
    address, reached = begun(http, len(body)), 0
    file = data / PARTIAL / address.rpartition("/")[2] / "0"
    while reached < 100_000:
        with half_sent(server, address, reached, body[reached : reached + 70_000], len(body) - reached):
            eventually(partial(_is_longer, file, reached), "the first block to be written")
        eventually(lambda: _free(http, address), "the end of the request")
        assert reached + 65_536 <= offset(http, address) <= reached + 70_000
        reached = offset(http, address)
    location = part(http, address, reached, body[reached:]).headers["location"]
    assert settled(http, location)["state"] == "ready"


def _is_longer(file: Path, size: int) -> bool:
    return file.stat().st_size > size


def test_whoever_asks_ends_a_request_that_is_lost(http: httpx.Client, server: str, data: Path) -> None:
    body = npy(hills(seed=75))
    address = begun(http, len(body))
    with half_sent(server, address, 0, body[:700], len(body)) as lost:
        eventually(lambda: not _free(http, address), "the request to begin")
        assert problem(part(http, address, 0, body)) == (423, "locked")
        reached = offset(http, address)
        assert reached <= 700
        assert lost.recv(65536).startswith(b"HTTP/1.1 423 ")
        assert part(http, address, reached, body[reached:]).status_code == 204
    dropped = begun(http, len(body))
    with half_sent(server, dropped, 0, body[:700], len(body)) as lost:
        eventually(lambda: not _free(http, dropped), "the request to begin")
        assert http.delete(dropped, headers=TUS).status_code == 204
        assert lost.recv(65536).startswith(b"HTTP/1.1 423 ")
    assert not (data / PARTIAL / dropped.rpartition("/")[2]).exists()


def _free(http: httpx.Client, address: str) -> bool:
    """Whether nobody sends an upload; a part at a wrong place changes nothing."""
    return part(http, address, 10**9, b"").status_code == 409


def test_of_several_that_send_the_same_part_one_wins(http: httpx.Client) -> None:
    body = npy(hills(seed=76))
    address = begun(http, len(body))
    with ThreadPoolExecutor(8) as pool:
        statuses = list(pool.map(lambda _: part(http, address, 0, body[:2000]).status_code, range(8)))
    assert statuses.count(204) == 1
    assert set(statuses) <= {204, 409, 423}
    assert offset(http, address) == 2000
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: part(http, address, 2000, body[2000:]), range(8)))
    assert [answer.status_code for answer in answers].count(204) == 1
    assert offset(http, address) == len(body)


def test_only_its_owner_may_continue_an_upload(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    anna, bert = (
        {"authorization": f"Bearer {file.create(name, (scope,))[0]}"}
        for name, scope in (("anna", "write"), ("bert", "admin"))
    )
    body = npy(hills(seed=77))
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        assert began(http, 9).status_code == 401
        http.headers.update(anna)
        address = begun(http, len(body))
        http.headers.update(bert)
        refused = [
            http.head(address, headers=TUS),
            part(http, address, 0, body),
            http.delete(address, headers=TUS),
            http.post(address, headers={**TUS, "x-http-method-override": "DELETE"}),
        ]
        assert [answer.status_code for answer in refused] == [404] * 4
        http.headers.update(anna)
        location = part(http, address, 0, body).headers["location"]
        assert http.get(location).json()["owner"] == "anna"


def test_how_many_there_may_be_is_bounded(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens.json")
    anna, bert = ({"authorization": f"Bearer {file.create(name, ('write',))[0]}"} for name in ("anna", "bert"))
    with (
        running_server(tmp_path, workers=1, max_partial_uploads=8) as url,
        client(url) as http,
    ):
        http.headers.update(anna)
        answers = [began(http, 10) for _ in range(20)]
        codes = [answer.status_code for answer in answers]
        assert codes == [201] * 4 + [507] * 16  # as much as is left for others
        assert problem(answers[-1]) == (507, "full")
        http.headers.update(bert)
        assert [began(http, 10).status_code for _ in range(3)] == [201, 201, 507]
        http.headers.update(anna)
        for answer in answers[:2]:
            assert http.delete(answer.headers["location"], headers=TUS).status_code == 204
        assert began(http, 10).status_code == 201
        assert len(kept(tmp_path, PARTIAL)) == 5


def test_what_is_under_way_counts_as_kept(tmp_path: Path) -> None:
    with (
        running_server(tmp_path, workers=1, owner_bytes=100_000) as url,
        client(url) as http,
    ):
        first, second = begun(http, 90_000), begun(http, 90_000)
        assert problem(began(http, 110_000)) == (507, "full")
        assert part(http, first, 0, bytes(60_000)).status_code == 204
        assert problem(began(http, 50_000)) == (507, "full")
        assert problem(part(http, second, 0, bytes(50_000))) == (507, "full")
        assert offset(http, second) == 0
        assert http.delete(first, headers=TUS).status_code == 204
        assert part(http, second, 0, bytes(50_000)).status_code == 204


def test_what_nobody_continues_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.time()
    monkeypatch.setattr(partial_uploads, "time", SimpleNamespace(time=lambda: now))
    monkeypatch.setattr("lodestream_server.upkeep._EXPIRE_SECONDS", 0.05)
    with (
        running_server(tmp_path, workers=1, partial_seconds=100.0) as url,
        client(url) as http,
    ):
        address = begun(http, 5000)
        now += 60.0
        assert part(http, address, 0, bytes(10)).status_code == 204
        now += 60.0
        assert part(http, address, 10, bytes(10)).status_code == 204
        now += 101.0
        eventually(lambda: kept(tmp_path, PARTIAL) == [], "the upload to be removed")
        assert part(http, address, 20, bytes(10)).status_code == 404


def test_an_upload_outlives_the_server(tmp_path: Path) -> None:
    body, settings = npy(hills(seed=78)), {"workers": 1}
    metadata = said(filename="hills.npy", sha256=hashlib.sha256(body).hexdigest())
    with running_server(tmp_path, **settings) as url, client(url) as http:
        half, done, whole = (begun(http, len(body), metadata, name=name) for name in ("a", "b", "c"))
        assert part(http, half, 0, body[:1234]).status_code == 204
        location = part(http, done, 0, body).headers["location"]
        assert part(http, whole, 0, body[:-1]).status_code == 204
    # What a server leaves that is killed behind the last byte, and before there is the surface.
    with (tmp_path / PARTIAL / whole.rpartition("/")[2] / "0").open("ab") as last:
        last.write(body[-1:])
    # And one in whose first moments it was killed.
    (tmp_path / PARTIAL / ("0" * 32)).mkdir()
    with running_server(tmp_path, **settings) as url, client(url) as http:
        assert http.head(done, headers=TUS).headers["location"] == location
        assert offset(http, half) == 1234
        assert part(http, half, 1234, body[1234:]).status_code == 204
        completed = http.head(whole, headers=TUS)
        assert completed.headers["upload-offset"] == str(len(body))
        named = {
            settled(http, address)["name"]
            for address in (location, completed.headers["location"], http.head(half, headers=TUS).headers["location"])
        }
        assert named == {"a", "b", "c"}
        assert len(kept(tmp_path, PARTIAL)) == 3


def test_a_store_that_fails_at_the_end_is_asked_again(
    http: httpx.Client, server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = npy(hills(seed=79))
    address = begun(http, len(body))
    with monkeypatch.context() as patched:
        patched.setattr(surfaces.Surfaces, "_created", _broken)
        assert problem(part(http, address, 0, body)) == (503, "busy")
        assert http.head(address, headers=TUS).status_code == 503
    found = http.head(address, headers=TUS)
    assert found.headers["upload-offset"] == str(len(body))
    surface = settled(http, found.headers["location"])
    assert surface["state"] == "ready"
    assert http.get(surface["url"] + "/container", follow_redirects=True).status_code == 200


def test_one_whose_scratch_folder_is_removed_is_missing_and_begins_again(tmp_path: Path) -> None:
    body = npy(hills(seed=83))
    with running_server(tmp_path, workers=1) as url, httpx.Client(base_url=url, trust_env=False) as http:
        half, whole = begun(http, len(body)), begun(http, len(body))
        assert part(http, half, 0, body[:100]).status_code == 204
        (tmp_path / "scratch").rename(tmp_path / "away")
        for address, at in ((half, 100), (whole, 0)):
            assert problem(part(http, address, at, body[at:])) == (404, "not-found")
            assert http.head(address, headers=TUS).status_code == 404

        def again() -> str | None:
            answer = began(http, len(body))
            assert answer.status_code in (201, 503), answer.text
            return str(answer.headers["location"]) if answer.status_code == 201 else None

        address = eventually(again, "another upload to begin")
        assert part(http, address, 0, body[:100]).status_code == 204

        def completed() -> str | None:
            at = http.head(address, headers=TUS)
            assert at.status_code in (200, 503)
            answer = part(http, address, int(at.headers.get("upload-offset", 100)), body[100:])
            assert answer.status_code in (204, 503), answer.text
            return str(answer.headers["location"]) if answer.status_code == 204 else None

        assert settled(http, eventually(completed, "the surface"))["state"] == "ready"


def _broken(*_: Any) -> Any:
    from lodestream.stores import StoreError

    raise StoreError("the disk says no")


def test_without_links_a_copy_is_made(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(path: Path, target: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    body = npy(hills(seed=80))
    monkeypatch.setattr(Path, "hardlink_to", no_links)
    address = begun(http, len(body))
    assert settled(http, part(http, address, 0, body).headers["location"])["state"] == "ready"


def test_another_client_of_tus_goes_on_after_a_break(
    http: httpx.Client, server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_PROXY", "*")
    body = npy(hills(150, 140, seed=81))
    cuts = [1_000_000, 20_000, 1_000_000, 25_000]

    def fault(number: int) -> Fault:
        return Fault(cut_up=cuts[number], reset=number % 2 == 0) if number < len(cuts) else Fault()

    with linked(server, fault) as link:
        client = TusClient(f"{link.url}/v1/uploads?name=Tus")
        uploader = client.uploader(
            file_stream=io.BytesIO(body),
            metadata={"filename": "hills.npy", "sha256": hashlib.sha256(body).hexdigest()},
            chunk_size=40_000,
            retries=5,
            retry_delay=0,
        )
        uploader.upload()
        assert link.connections > len(cuts)
    found = http.head(urlsplit(str(uploader.url)).path, headers=TUS)
    surface = settled(http, found.headers["location"])
    assert (surface["state"], surface["name"], surface["filenames"]) == ("ready", "Tus", ["hills.npy"])


@pytest.mark.long
def test_a_server_that_is_killed_has_all_that_it_told(tmp_path: Path) -> None:
    side = 300 // every(2)
    body, random = npy(hills(side, side, seed=82)), Random(82)
    metadata = said(sha256=hashlib.sha256(body).hexdigest())
    address, told, location = "", 0, ""
    for _ in range(30):
        server, last = Server(tmp_path / "data"), random.randrange(1, 10)
        killer = threading.Timer(random.uniform(0.0, 0.01), server.kill)
        try:
            with server.client() as http:
                if not address:
                    address = begun(http, len(body), metadata)
                for turn in itertools.count():
                    if turn == last:
                        killer.start()
                    looked = http.head(address, headers=TUS)
                    assert looked.status_code == 200
                    assert int(looked.headers["upload-offset"]) >= told
                    told = int(looked.headers["upload-offset"])
                    location = looked.headers.get("location", "")
                    if told < len(body):
                        more = random.randrange(1, 20_000)
                        answer = part(http, address, told, body[told : told + more])
                        assert answer.status_code == 204
                        told, location = int(answer.headers["upload-offset"]), answer.headers.get("location", "")
                    if location:
                        break
        except httpx.TransportError:
            pass
        finally:
            killer.cancel()
            server.kill()
        if location:
            break
    assert location
    with running_server(tmp_path / "data", workers=1) as url, client(url) as http:
        assert http.head(address, headers=TUS).headers["location"] == location
        assert settled(http, location)["state"] == "ready"
        assert len(listed(http)) == 1
    assert os.listdir(tmp_path / "data" / PARTIAL) == [address.rpartition("/")[2]]
