"""Both ends of a stream without I/O, joined by queues."""

from __future__ import annotations

import hashlib
from collections import deque
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

import lodestream as ls
from lodestream.container import ByteRange, Index, read_index
from lodestream.decoding.decoder import View
from lodestream.protocol.messages import BASE_CREDIT, MAX_MESSAGE, Open, Segments
from lodestream.protocol.wire import parse, serialize
from lodestream.transfer.download import Download, Ended
from lodestream.transfer.receiver_state import ReceiverState
from lodestream.transfer.sender import Sender

__all__ = ["Link", "container", "index", "without_decodes"]

SHAPE = (61, 47)


@cache
def container() -> bytes:
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    heights = 100 * np.sin(rows / 9) * np.cos(columns / 7) + np.random.default_rng(1).normal(size=SHAPE)
    return ls.encode(ls.Surface(heights.astype(np.float32), metadata={"name": "hills"}))


@cache
def index() -> Index:
    data = container()
    return read_index(lambda offset, length: data[offset : offset + length], len(data))


def without_decodes(message: bytes) -> bytes:
    """The same message as a client of an earlier release sends it, or a server of one understands it."""
    event = parse(message)
    return serialize(replace(event, decodes=None)) if isinstance(event, Open) else message


@dataclass
class Link:
    """A client and a server, and what is under way between them; without ``decodes`` one of an earlier release."""

    target: ls.Target = field(default_factory=ls.Target)
    window: int = BASE_CREDIT
    now: float = 0.0
    reception: ReceiverState | None = None
    decodes: bool = True

    def __post_init__(self) -> None:
        self.client = Download(self.target, window=self.window, reception=self.reception)
        self.server = Sender(index(), hashlib.sha256(container()).hexdigest())
        self.to_server: deque[bytes] = deque()
        self.to_client: deque[bytes] = deque()
        self.events: list[View | Ended] = []
        self.data_after_stop = 0
        self.stopped = False
        self.flush()

    def flush(self) -> None:
        self.to_server.extend(self.client.data_to_send())

    def serve(self) -> bool:
        """One step of the server; whether there was anything to do."""
        message = self.server.next_message()
        if message is not None:
            assert len(message) <= MAX_MESSAGE
            self.to_client.append(message)
            return True
        wanted = self.server.wanted()
        if wanted is None:
            return False
        self.server.provide(wanted, container()[wanted.offset : wanted.end])
        return True

    def hear(self) -> None:
        message = self.to_server.popleft()
        self.server.receive(message if self.decodes else without_decodes(message))

    def take(self) -> None:
        message = self.to_client.popleft()
        event = parse(message)
        if self.stopped and isinstance(event, Segments):
            self.data_after_stop += len(event.data)
        self.events += self.client.receive(message)
        self.flush()

    def stop(self) -> None:
        self.client.stop()
        self.stopped = True
        self.flush()

    def run(self) -> None:
        """Deliver everything, in turns, until nothing is left to do."""
        while self.serve() or self.to_server or self.to_client:
            if self.to_server:
                self.hear()
            if self.to_client:
                self.take()

    def wanted(self) -> ByteRange:
        """The next slice that the server wants to read."""
        while (wanted := self.server.wanted()) is None:
            assert self.serve()
        return wanted

    @property
    def in_flight(self) -> int:
        events = (parse(message) for message in self.to_client)
        return sum(len(event.data) for event in events if isinstance(event, Segments))

    @property
    def views(self) -> list[View]:
        return [event for event in self.events if isinstance(event, View)]
