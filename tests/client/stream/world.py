"""A server, a link and a clock without sockets: carries out the effects of a stream's core by a script."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Literal, TypeAlias
from unittest.mock import patch
from urllib.parse import parse_qs, urlsplit

import httpx
import numpy as np
from websockets.exceptions import ConnectionClosedError

import lodestream as ls
from lodestream.container import Index, read_index
from lodestream.decoding.view import View
from lodestream.protocol.handshake import from_address
from lodestream.protocol.messages import SUBPROTOCOL, Event
from lodestream.target import Region
from lodestream.transfer.sender import Sender
from lodestream_client.requests.answers import Head
from lodestream_client.stream.core import Core
from lodestream_client.stream.effects import (
    Ahead,
    Dial,
    DialError,
    Dialled,
    Effect,
    Get,
    HangUp,
    Hear,
    Read,
    Send,
    Wait,
)
from lodestream_client.stream.known_windows import KnownWindows
from lodestream_client.stream.options import ConnectOptions
from lodestream_client.stream.session import Session

__all__ = ["NEAR", "STEP", "URL", "Act", "World", "container", "heights"]

URL = "http://one/v1/surfaces/ab"
NEAR: Region = ((0, 24), (0, 30))

#: What happens instead of an effect (break, silence, cancel), or just before it.
Act: TypeAlias = Literal["break", "silence", "cancel", "stop", "focus", "close"]

_CHUNK = 700  # bytes of an answer that come at once
#: Seconds that an effect takes.
STEP = 0.01


@cache
def heights() -> Any:
    rows, columns = np.mgrid[:121, :94]
    noise = np.random.default_rng(1).normal(size=rows.shape)
    return (100 * np.sin(rows / 9) * np.cos(columns / 7) + noise).astype(np.float32)


@cache
def container() -> bytes:
    return ls.encode(ls.Surface(heights(), metadata={"name": "hills"}))


@cache
def index() -> Index:
    data = container()
    return read_index(lambda offset, length: data[offset : offset + length], len(data))


class World:
    """Carries out effects, and keeps a list of them.

    Parameters
    ----------
    acts : mapping of int to Act
        What happens at an effect, by its number.
    windows : KnownWindows or None
        What other streams have found; None: nothing.
    """

    def __init__(
        self,
        acts: Mapping[int, Act] | None = None,
        url: str = URL,
        windows: KnownWindows | None = None,
        **options: Any,
    ) -> None:
        self.now = 0.0
        self.effects: list[Effect] = []
        self.sent: list[Event] = []
        self.views: list[View] = []
        self.stopped_at: int | None = None
        self.session = Session(
            url, ConnectOptions(**options), lambda: self.now, KnownWindows() if windows is None else windows
        )
        self.core = Core(self.session)
        self.acts = acts or {}
        self.ahead: Get | None = None
        self.in_vain = 0  # requests made ahead whose answers nobody wanted
        self._server: Sender | None = None
        self._body: Iterator[bytes] | None = None
        self._seconds = 0.0  # of the last request, also for each step of its answer

    def run(self) -> World:
        """Follow the stream to its end."""
        with patch("random.uniform", lambda least, most: most / 2):
            while (effect := self.core.effect) is not None:
                self.step(effect)
                while (view := self.core.next_view()) is not None:
                    if self.session.transports.transport == "ws":
                        assert self.session.messages() == [], "credit does not wait for whoever looks at a view"
                    self.views.append(view)
        return self

    def step(self, effect: Effect) -> None:
        act = self.acts.get(len(self.effects))
        self.effects.append(effect)
        assert len(self.effects) < 20_000, "the stream does not end"
        if act == "cancel":
            self.now += STEP
            return
        if act in ("stop", "close"):
            self.stopped_at = len(self.effects)
            (self.session.stop if act == "stop" else self.session.close)()
        if act == "focus":
            self.session.focus(NEAR)
        try:
            result = self.broken(effect) if act == "break" else self.silent(effect) if act == "silence" else None
            result = self.perform(effect) if act not in ("break", "silence") else result
        except Exception as error:
            self.core.failed(error)
        else:
            self.core.done(result)

    def broken(self, effect: Effect) -> Any:
        """The same effect where the link breaks."""
        if isinstance(effect, Dial | Hear | Get | Read):
            self._server = self._body = None
        if isinstance(effect, Dial):
            raise DialError(effect.url) from ConnectionRefusedError("refused")
        if isinstance(effect, Hear):
            raise ConnectionClosedError(None, None)
        if isinstance(effect, Get):
            raise httpx.ConnectError("refused")
        if isinstance(effect, Read):
            raise httpx.ReadError("cut")
        return self.perform(effect)

    def silent(self, effect: Effect) -> Any:
        """The same effect where nothing comes in time."""
        if isinstance(effect, Get):
            self._seconds = effect.seconds
        if isinstance(effect, Dial):
            self.now += effect.seconds
        if isinstance(effect, Get | Read):
            self.now += self._seconds
        if isinstance(effect, Hear):
            self.now = max(self.now, effect.until)
        if isinstance(effect, Dial):
            raise DialError(effect.url) from TimeoutError("timed out")
        if isinstance(effect, Hear):
            return None
        if isinstance(effect, Get):
            raise httpx.ConnectTimeout("timed out")
        if isinstance(effect, Read):
            raise httpx.ReadTimeout("timed out")
        return self.perform(effect)

    def perform(self, effect: Effect) -> Any:
        self.now += STEP
        match effect:
            case Dial(url):
                assert self._server is None, "one WebSocket at a time"
                self._server = Sender(index(), hashlib.sha256(container()).hexdigest())
                self._server.receive(from_address(parse_qs(urlsplit(url).query)["open"][0]))
                return Dialled(SUBPROTOCOL, url)
            case Hear(until):
                return self._message(until)
            case Send():
                for message in self.session.messages():
                    if self._server is not None:
                        self.sent.append(self._server.receive(message))
                return None
            case Get(_, headers, seconds):
                self._seconds = seconds
                self.in_vain += self.ahead is not None and not self.ahead.asks_as(effect)
                self.ahead = None
                return self._answer(headers)
            case Ahead(get):
                self.ahead = get
                return None
            case Read():
                assert self._body is not None, "only an answer is read"
                return next(self._body, b"")
            case Wait(until):
                self.now = self.now if self.session.stopped else max(self.now, until)
                return None
            case HangUp():
                self._server = self._body = self.ahead = None
                return None

    def _message(self, until: float) -> bytes | None:
        assert self._server is not None, "only an open WebSocket is heard"
        while (message := self._server.next_message()) is None:
            wanted = self._server.wanted()
            if wanted is None:
                self.now = max(self.now, until)
                return None
            self._server.provide(wanted, container()[wanted.offset : wanted.end])
        return message

    def _answer(self, headers: Mapping[str, str]) -> Head:
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", headers["Range"])
        assert found is not None
        data = container()
        first, last = int(found[1]), min(int(found[2]), len(data) - 1)
        body = data[first : last + 1]
        self._body = iter([body[at : at + _CHUNK] for at in range(0, len(body), _CHUNK)])
        told = {"etag": '"1"', "content-range": f"bytes {first}-{last}/{len(data)}"}
        return Head(206, "Partial Content", told, "http://one/ab.lode")
