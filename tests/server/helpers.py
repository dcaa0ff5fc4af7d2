"""What the tests of the server share: small surfaces, raw streams, and waiting for what must happen, with an end."""

from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from lodestream.protocol.messages import MAX_MESSAGE, SUBPROTOCOL, Bye, End, Event, Segments
from lodestream.protocol.wire import parse, serialize
from tests.patience import PATIENCE as PATIENCE

T = TypeVar("T")


def hills(rows: int = 40, columns: int = 30, seed: int = 1) -> NDArray[np.float32]:
    """A small height field, another one for each seed."""
    r, c = np.mgrid[0:rows, 0:columns]
    noise = np.random.default_rng(seed).normal(size=(rows, columns))
    return np.asarray(50 * np.sin(r / 9 + seed) * np.cos(c / 7) + noise, np.float32)


def listed(http: httpx.Client) -> list[str]:
    """The ids of all surfaces: their states may go on changing while a test looks."""
    return [surface["id"] for surface in http.get("/v1/surfaces", params={"limit": 1000}).json()["surfaces"]]


def npy(array: NDArray[Any]) -> bytes:
    """The bytes of an NPY file."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def eventually(look: Callable[[], T | None], what: str) -> T:
    """The first true value that `look` gives; fails when there is none in time."""
    until, pause = time.monotonic() + PATIENCE, 0.01
    while time.monotonic() < until:
        value = look()
        if value:
            return value
        time.sleep(pause)
        pause = min(1.5 * pause, 0.05)  # looking is often a request, which takes a processor from what is waited for
    raise AssertionError(f"expected {what} within {PATIENCE:g} s")


def settled(http: httpx.Client, location: str) -> dict[str, Any]:
    """What the server says of a surface once it is ready or has failed."""

    def look() -> dict[str, Any] | None:
        surface: dict[str, Any] = http.get(location).raise_for_status().json()
        return surface if surface["state"] in ("ready", "failed", "waiting") else None

    return eventually(look, "the build to end")


def kept(data: Path, folder: str) -> list[str]:
    """The names in a folder of the data folder, which may not be there before the first of them or after the last."""
    with suppress(FileNotFoundError):
        return sorted(os.listdir(data / folder))
    return []


def upload_of(data: Path, surface: dict[str, Any]) -> Path:
    """The folder with the uploaded files of a surface."""
    return data / "uploads" / str(json.loads((data / "surfaces" / f"{surface['id']}.json").read_text())["upload"])


def push(http: httpx.Client, data: bytes, **query: str) -> dict[str, Any]:
    """Upload, and wait."""
    answer = http.post("/v1/surfaces", content=data, params=query)
    assert answer.status_code in (200, 202), answer.text
    return settled(http, answer.headers["location"])


class Raw:
    """A WebSocket that speaks messages and nothing else: no credit is granted, no bye is said unless a test does."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket

    def send(self, event: Event) -> None:
        self.socket.send(serialize(event))

    def receive(self) -> Event:
        message = self.socket.recv(timeout=PATIENCE, decode=False)
        assert len(message) <= MAX_MESSAGE
        return parse(message)

    def until_end(self) -> list[Event]:
        """Everything up to the end, which is answered."""
        events = [self.receive()]
        while not isinstance(events[-1], End):
            events.append(self.receive())
        self.send(Bye())
        return events


def data_of(events: list[Event]) -> int:
    """Bytes of the container in some messages."""
    return sum(len(event.data) for event in events if isinstance(event, Segments))


@contextmanager
def raw_stream(url: str, query: str = "", **options: Any) -> Iterator[Raw]:
    """A socket to the stream of the surface at a URL; it never gives up because a busy server is late."""
    usual = {"subprotocols": [SUBPROTOCOL], "max_size": MAX_MESSAGE, "compression": None, "proxy": None}
    options = {**usual, "open_timeout": PATIENCE, "ping_interval": None, **options}
    with connect(url.replace("http", "ws", 1) + "/stream" + query, **options) as socket:
        yield Raw(socket)


def in_time(url: str, look: Callable[[Raw], T], **options: Any) -> T:
    """What `look` gives of a stream to a server that waits for a head only shortly.

    On a busy machine the handshake itself may come too late, which says nothing of the stream: then comes another one.
    """

    def tried() -> T | None:
        with suppress(InvalidHandshake, EOFError, ConnectionError), raw_stream(url, **options) as stream:
            return look(stream)
        return None

    return eventually(tried, "a handshake that comes in time")


def closed(stream: Raw, code: int) -> str:
    """Wait for the close frame; its reason."""
    for _ in range(100_000):
        try:
            stream.receive()
        except ConnectionClosed as over:
            frame = over.rcvd
            break
    else:
        pytest.fail("the server goes on and on")
    assert frame is not None, "the connection broke without a close frame"
    assert frame.code == code
    return frame.reason


def problem(answer: httpx.Response) -> tuple[int, str]:
    """Status and code of an answer that is a problem document."""
    document = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    assert document["status"] == answer.status_code
    return answer.status_code, document["code"]


@dataclass
class Keys:
    """A folder with a token of each scope, and two that are good for nothing any more."""

    folder: Path
    tokens: dict[str, str]

    def header(self, name: str) -> dict[str, str]:
        return {"authorization": f"Bearer {self.tokens[name]}"}
