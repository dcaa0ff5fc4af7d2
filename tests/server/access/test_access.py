"""Access over real sockets: streams, the client's token, and what leads out of the folder."""

from __future__ import annotations

import io
import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

import lodestream as ls
from lodestream.errors import RemoteError
from lodestream.protocol.handshake import to_address
from lodestream.protocol.messages import CODES, End, Error, Open, Opened, Stop
from lodestream.protocol.wire import serialize
from lodestream_client import Client
from lodestream_server import running_server
from lodestream_server.access.tokens import SCOPES, TokenFile
from lodestream_server.operation.settings import Settings
from lodestream_server.routes import streams
from tests.data_folder import below
from tests.patience import PATIENCE
from tests.server.helpers import Keys, Raw, closed, eventually, hills, in_time, kept, npy, problem, push, raw_stream


@dataclass
class Served:
    """A server with tokens and one surface."""

    url: str
    surface: str
    keys: Keys

    def __post_init__(self) -> None:
        self.path = self.surface.removeprefix(self.url)


@pytest.fixture(scope="module")
def served(keys: Keys) -> Iterator[Served]:
    # Patient with those who have all and do not say bye.
    with running_server(keys.folder, workers=1, bye_seconds=PATIENCE) as url:
        with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE, headers=keys.header("write")) as http:
            made = push(http, npy(hills(30, 20)))
        yield Served(url, url + made["url"], keys)


@pytest.fixture(scope="module")
def http(served: Served) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=served.url, trust_env=False, timeout=PATIENCE) as client:
        yield client


def refused(stream: Raw) -> str:
    """The code of the error that comes, once the close code fits it."""
    said = stream.receive()
    assert isinstance(said, Error)
    with pytest.raises(ConnectionClosed) as over:
        stream.receive()
    assert over.value.rcvd is not None
    assert over.value.rcvd.code == CODES[said.code].close
    assert over.value.rcvd.reason.startswith(said.code)
    return said.code


def test_a_token_goes_with_the_handshake(served: Served) -> None:
    for scope in SCOPES:
        with raw_stream(served.surface, additional_headers=served.keys.header(scope)) as stream:
            stream.send(Open())
            assert isinstance(stream.until_end()[0], Opened)


def test_a_token_that_is_not_good_is_refused_at_the_handshake(served: Served) -> None:
    for name in ("wrong", "revoked", "expired"):
        with (
            pytest.raises(InvalidStatus) as caught,
            raw_stream(served.surface, additional_headers=served.keys.header(name)),
        ):
            pass
        assert caught.value.response.status_code == 401
        assert json.loads(caught.value.response.body or b"")["code"] == "bad-token"


@pytest.mark.parametrize("origin", ["https://example.org", "null", "http://localhost:1"])
def test_the_page_of_another_site_opens_no_stream(served: Served, http: httpx.Client, origin: str) -> None:
    for headers in ({}, served.keys.header("admin")):
        with (
            pytest.raises(InvalidStatus) as caught,
            raw_stream(served.surface, additional_headers=headers, origin=origin),
        ):
            pass
        assert caught.value.response.status_code == 403
        assert json.loads(caught.value.response.body or b"")["code"] == "foreign-origin"
    with raw_stream(served.surface, origin=served.url) as stream:
        stream.send(Open(token=served.keys.tokens["read"]))
        assert isinstance(stream.until_end()[0], Opened)


def test_a_token_in_open_does_what_a_header_would(served: Served) -> None:
    for scope in SCOPES:
        with raw_stream(served.surface) as stream:
            stream.send(Open(token=served.keys.tokens[scope]))
            assert isinstance(stream.until_end()[0], Opened)


def opening(message: Open, **options: Any) -> Any:
    return {"query": f"?{to_address(serialize(message))}", **options}


def test_an_open_in_the_address_holds_no_token(
    served: Served, http: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    text = served.keys.tokens["read"]
    missing = served.url + "/v1/surfaces/" + "0" * 20
    header = served.keys.header("read")
    with caplog.at_level("DEBUG", "lodestream_server"):
        with raw_stream(served.surface, **opening(Open(), additional_headers=header)) as stream:
            assert isinstance(stream.until_end()[0], Opened)
        for address in (served.surface, missing):
            with raw_stream(address, **opening(Open())) as stream:
                assert refused(stream) == "no-token"
            for shown in (text, "x" * 1000):
                for headers in ({}, header):
                    with raw_stream(address, **opening(Open(token=shown), additional_headers=headers)) as stream:
                        assert refused(stream) == "bad-message"
        with raw_stream(missing, **opening(Open(), additional_headers=header)) as stream:
            assert refused(stream) == "not-found"
        with pytest.raises(InvalidStatus), raw_stream(served.surface, **opening(Open(), origin="null")):
            pass
        eventually(lambda: "stream ended" in caplog.messages, "the stream to be told of")
    told = [repr(vars(record)) for record in caplog.records]
    query = to_address(serialize(Open(token=text))) or text
    assert not any(text in line or query[-40:] in line or "open=" in line for line in told)


def test_without_a_token_nothing_is_told(served: Served) -> None:
    tokens = served.keys.tokens
    for address in (served.surface, served.url + "/v1/surfaces/" + "0" * 20):
        for shown, code in (
            (None, "no-token"),
            (tokens["revoked"], "bad-token"),
            (tokens["expired"], "bad-token"),
            ("x" * 1000, "bad-token"),
            ("", "bad-token"),
        ):
            with raw_stream(address) as stream:
                stream.send(Open(token=shown))
                assert refused(stream) == code
    with raw_stream(served.url + "/v1/surfaces/" + "0" * 20) as stream:
        stream.send(Open(token=tokens["read"]))
        assert refused(stream) == "not-found"


def test_a_first_message_that_is_none_is_refused(tmp_path: Path) -> None:
    TokenFile(tmp_path / "tokens.json").create("one", ("read",))
    with running_server(tmp_path, workers=1) as url:
        address = url + "/v1/surfaces/" + "0" * 20
        with raw_stream(address) as stream:
            stream.socket.send("open, please")
            assert refused(stream) == "bad-message"
    with running_server(tmp_path, workers=1, head_seconds=0.2) as url:
        # Somebody who has shown nothing is not waited for as long as a client is.
        assert in_time(url + "/v1/surfaces/" + "0" * 20, refused) == "idle"


def test_the_streams_of_a_token_end_with_it(
    served: Served, http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = Settings().look_seconds  # of a server that shares a bucket
    assert looked + streams._TOKEN_SECONDS + streams._CLOSE_SECONDS < 10, "what is promised"
    monkeypatch.setattr(streams, "_TOKEN_SECONDS", 0.3)
    file = TokenFile(served.keys.folder / "tokens.json")
    tokens = {
        name: file.create(name, ("read",), days)[0]
        for name, days in (("leaving", None), ("staying", None), ("short", 1))
    }
    header = {name: {"authorization": f"Bearer {token}"} for name, token in tokens.items()}
    with ExitStack() as held:

        def begun(message: Open, **options: Any) -> Raw:
            stream = held.enter_context(raw_stream(served.surface, **options))
            if "query" not in options:
                stream.send(message)
            assert isinstance(stream.receive(), Opened)
            return stream

        def of(name: str) -> list[Raw]:
            return [
                begun(Open(credit=1), additional_headers=header[name]),
                begun(Open(credit=1, token=tokens[name])),
                begun(Open(credit=1), **opening(Open(credit=1), additional_headers=header[name])),
                # All is sent, and the client does not say bye.
                begun(Open(), additional_headers=header[name]),
            ]

        short, leaving, staying = (of(name) for name in ("short", "leaving", "staying"))
        expire_soon(file.path, "short")
        file.revoke("leaving")
        file.create("leaving", ("read",))  # another token, whatever it is called
        for stream in (*leaving, *short):
            assert last_error(stream) == "bad-token"
        for name in ("leaving", "short"):
            with raw_stream(served.surface) as stream:
                stream.send(Open(token=tokens[name]))
                assert refused(stream) == "bad-token"
        for stream in staying[:3]:
            stream.send(Stop())
            assert stream.until_end()[-1] == End("stopped")
        assert staying[3].until_end()[-1] == End("complete")
    line, admin = 'lodestream_streams_total{result="bad-token"} 8.0', served.keys.header("admin")
    eventually(lambda: line in http.get("/metrics", headers=admin).text, "the streams to be counted")


def expire_soon(path: Path, name: str) -> None:
    """Let the time of a token be over in a second; the file is replaced, since the server reads it at any moment."""
    document = json.loads(path.read_text())
    (token,) = (token for token in document["tokens"] if token["name"] == name)
    token["expires"] = (datetime.now(UTC) + timedelta(seconds=1)).isoformat()
    new = path.with_name("new")
    new.write_bytes(json.dumps(document).encode())
    new.replace(path)


def last_error(stream: Raw) -> str:
    """The code of the error that ends a stream, once the close code fits it."""
    event = stream.receive()
    while not isinstance(event, Error):
        event = stream.receive()
    closed(stream, CODES[event.code].close)
    return event.code


def test_without_tokens_a_stream_with_a_forged_host_needs_one(server: str) -> None:
    address = urlsplit(server)
    connection = socket.create_connection((address.hostname, address.port), timeout=PATIENCE)
    with raw_stream(f"http://example.org:{address.port}/v1/surfaces/{'0' * 20}", sock=connection) as stream:
        stream.send(Open())
        assert refused(stream) == "no-token"


@pytest.mark.parametrize("name", ["X-Forwarded-For", "Forwarded"])
def test_without_tokens_a_stream_through_a_proxy_needs_one(server: str, name: str) -> None:
    address = server + "/v1/surfaces/" + "0" * 20
    with raw_stream(address, additional_headers={name: "127.0.0.1"}) as stream:
        stream.send(Open())
        assert refused(stream) == "no-token"
    with raw_stream(address) as stream:
        assert refused(stream) == "not-found"


def test_the_client_sends_its_token_everywhere(served: Served, tmp_path: Path) -> None:
    read, write = served.keys.tokens["read"], served.keys.tokens["write"]
    points = hills(12, 9, seed=3)
    with pytest.raises(RemoteError, match="the scope write"):
        Client(served.url, token=read).upload(io.BytesIO(npy(points)))
    made = Client(served.url, token=write).upload(io.BytesIO(npy(points)))
    assert Client(made.url, token=read).get(made.url).ready
    assert made.url in {surface.url for surface in Client(served.url, token=read).list()}

    def whole(token: str | None) -> Any:
        with Client(made.url, token=token).connect(made.url) as stream:
            for _ in stream:
                pass
            return stream.decoder.surface().points

    assert np.array_equal(whole(read), points)
    assert len(Client(made.url, token=read).fetch_range(made.url, 0, 10)) == 10
    for call in (
        lambda token: Client(made.url, token=token).get(made.url),
        lambda token: Client(served.url, token=token).list(),
        lambda token: Client(made.url, token=token).fetch_range(made.url, 0, 10),
        lambda token: Client(made.url, token=token).delete(made.url),
        whole,
    ):
        for token, code in ((None, "no-token"), (served.keys.tokens["wrong"], "bad-token")):
            with pytest.raises(RemoteError) as caught:
                call(token)
            assert caught.value.code == code
    with pytest.raises(RemoteError) as caught:
        Client(made.url, token=read).delete(made.url)
    assert caught.value.code == "small-scope"
    Client(made.url, token=write).delete(made.url)
    with pytest.raises(ls.LodestreamError):
        Client(made.url, token=read).get(made.url)


def test_a_body_that_may_not_come_is_not_stored(served: Served, http: httpx.Client) -> None:
    assert kept(served.keys.folder, "scratch/incoming") == []
    answer = http.post("/v1/surfaces", content=b"x" * 3_000_000, headers=served.keys.header("read"))
    assert problem(answer) == (403, "small-scope")
    assert kept(served.keys.folder, "scratch/incoming") == []
    # The connection is good for the next request.
    assert http.get("/v1/surfaces", headers=served.keys.header("read")).status_code == 200


def test_a_shared_cache_keeps_only_what_everybody_may_read(served: Served, http: httpx.Client) -> None:
    answer = http.get(f"{served.path}/container", headers=served.keys.header("read"), follow_redirects=True)
    assert "private" in answer.headers["cache-control"]


@pytest.mark.parametrize(
    "path",
    [
        "/v1/surfaces/..%2f..%2ftokens.json",
        "/v1/surfaces/../../tokens.json",
        "/v1/surfaces/%2e%2e/tokens.json",
        "/v1/surfaces/..\\..\\tokens.json",
        "/v1/surfaces/x%00y",
        "/v1/surfaces/" + "a" * 4000,
        "/v1/containers/..%2ftokens.lode",
        "/v1/containers/..%2f..%2f..%2f..%2fetc%2fpasswd.lode",
        "/v1/containers/" + "%2e" * 64 + ".lode",
        "/v1/containers/" + "%F0%9D%9F%98" * 64 + ".lode",
        "/v1/surfaces/%ff%fe/levels/0",
        "/v1/surfaces/../../../etc/passwd",
        "/docs/../tokens.json",
    ],
)
@pytest.mark.parametrize("method", ["GET", "DELETE"])
def test_no_path_leads_out_of_the_folder(served: Served, method: str, path: str) -> None:
    address = urlsplit(served.url)
    with socket.create_connection((address.hostname, address.port), timeout=PATIENCE) as connection:
        token = served.keys.tokens["admin"]
        connection.sendall(
            f"{method} {path} HTTP/1.1\r\nHost: {address.netloc}\r\nAuthorization: Bearer {token}\r\n"
            "Connection: close\r\n\r\n".encode()
        )
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
    assert answer.split(b" ")[1] in (b"400", b"404", b"405")
    assert b"sha256" not in answer
    assert b"root:" not in answer
    assert (served.keys.folder / "tokens.json").exists()


@pytest.mark.parametrize("name", ["../../evil.npy", "/etc/evil.npy", "..\\evil.npy", "a\0b.npy", "\u202egpj.npy", "."])
def test_no_name_leads_out_of_the_folder(served: Served, http: httpx.Client, name: str) -> None:
    headers = served.keys.header("write")
    made = http.post("/v1/surfaces", content=npy(hills(5, 4)), params={"filename": name, "name": name}, headers=headers)
    assert made.status_code in (200, 202)
    shown = [made.json()["name"] or "", *made.json()["filenames"]]
    assert all("/" not in text and "\\" not in text and text.isprintable() for text in shown)
    assert not [path for path in below(served.keys.folder.parent) if path.name.startswith("evil")]
