"""A proxy before an emulator of a bucket: it loses answers, closes connections, refuses, hangs or drops conditions."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Literal

__all__ = ["Fault", "FaultProxy", "fault_proxy"]

Kind = Literal["lost", "closed", "cut", "hung", "409", "503", "stripped", "slow"]

_REFUSED = {
    "409": b"HTTP/1.1 409 Conflict\r\nContent-Length: %d\r\n\r\n%s",
    "503": b"HTTP/1.1 503 Slow Down\r\nContent-Length: %d\r\n\r\n%s",
}
_CODES = {"409": b"ConditionalRequestConflict", "503": b"SlowDown"}
_CONDITIONS = re.compile(rb"\r\n(?:if-none-match|if-match):[^\r]*", re.IGNORECASE)
_LIMIT = 1 << 26


@dataclass
class Fault:
    """What goes wrong.

    Attributes
    ----------
    kind : str
        ``lost``: the request is carried out, and the answer is 503. ``closed``: it is carried out, and the connection
        closed. ``cut``: half of the body of the answer comes, then the connection is closed. ``hung``: it is carried
        out, and no answer comes. ``409``, ``503``: it is not carried out. ``stripped``: it is without its conditions.
        ``slow``: it waits a while.
    times : int
        How many requests it happens to.
    where : str
        A pattern of the method and target of these requests.
    """

    kind: Kind
    times: int = 1_000_000
    where: str = "PUT"


class FaultProxy:
    """A proxy on a port of this machine.

    Attributes
    ----------
    port : int
    faults : list of Fault
        Those to come.
    seen : list of str
        Method and target of each request.
    delay : float
        Seconds that each request waits.
    """

    def __init__(self, behind: int) -> None:
        self.port = 0
        self.faults: list[Fault] = []
        self.seen: list[str] = []
        self.delay = 0.0
        self._behind = behind

    async def serve(self, ready: threading.Event) -> None:
        """Serve until it is cancelled."""
        server = await asyncio.start_server(self._connection, "127.0.0.1", 0, limit=_LIMIT)
        self.port = server.sockets[0].getsockname()[1]
        ready.set()
        try:
            await asyncio.Event().wait()  # a run may take more than an hour
        finally:
            server.close()

    async def _connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        upstream: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        try:
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                first = head.partition(b" HTTP/")[0].decode()
                body = await _body(reader, head)
                self.seen.append(first)
                kind = self._next(first)
                await asyncio.sleep(self.delay + (0.3 if kind == "slow" else 0))
                if kind in _REFUSED:
                    writer.write(_refusal(kind))
                    continue
                if kind == "stripped":
                    head = _CONDITIONS.sub(b"", head)
                if upstream is None:
                    upstream = await asyncio.open_connection("127.0.0.1", self._behind, limit=_LIMIT)
                upstream[1].write(head + body)
                answer = await upstream[0].readuntil(b"\r\n\r\n")
                no_body = first.startswith("HEAD ") or answer.split(b" ", 2)[1] in (b"204", b"304")
                content = b"" if no_body else await _body(upstream[0], answer)
                if kind == "hung":
                    await asyncio.sleep(3600)
                if kind == "lost":
                    writer.write(_refusal("503"))
                elif kind == "closed":
                    return
                elif kind == "cut":
                    writer.write(answer + content[: len(content) // 2])
                    await writer.drain()
                    return
                else:
                    writer.write(answer + content)
                if b"\r\nconnection: close" in answer.lower():
                    return
        except (asyncio.IncompleteReadError, ConnectionError):
            return
        except asyncio.CancelledError:  # the proxy ends, and its loop before what is left could be sent
            for each in (writer, *(upstream[1:] if upstream else ())):
                each.transport.abort()
        finally:
            for each in (writer, *(upstream[1:] if upstream else ())):
                each.close()

    def _next(self, first: str) -> str:
        for fault in self.faults:
            if fault.times > 0 and re.match(fault.where, first):
                fault.times -= 1
                return fault.kind
        return ""


def _refusal(kind: str) -> bytes:
    body = b"<Error><Code>%s</Code><Message>again</Message></Error>" % _CODES[kind]
    return _REFUSED[kind] % (len(body), body)


async def _body(reader: asyncio.StreamReader, head: bytes) -> bytes:
    length = re.search(rb"\r\ncontent-length: *(\d+)", head, re.IGNORECASE)
    if length:
        return await reader.readexactly(int(length[1]))
    body = b""
    if re.search(rb"\r\ntransfer-encoding: *chunked", head, re.IGNORECASE):
        while not body.endswith(b"0\r\n\r\n"):
            size = await reader.readuntil(b"\r\n")
            body += size + await reader.readexactly(int(size, 16) + 2)
    return body


@contextmanager
def fault_proxy(behind: int) -> Iterator[FaultProxy]:
    """Run a proxy before a port of this machine, in a thread, for the length of a block."""
    proxy, ready, loop = FaultProxy(behind), threading.Event(), asyncio.new_event_loop()
    serving: list[asyncio.Task[None]] = []

    async def main() -> None:
        serving.append(asyncio.ensure_future(proxy.serve(ready)))
        with suppress(asyncio.CancelledError):
            await serving[0]
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    thread = threading.Thread(target=loop.run_until_complete, args=(main(),))
    thread.start()
    try:
        ready.wait()
        yield proxy
    finally:
        loop.call_soon_threadsafe(serving[0].cancel)
        thread.join()
        loop.close()
