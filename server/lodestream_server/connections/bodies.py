"""HTTP request bodies, counted as h11 reads them: how much of a body is still to come, and what its chunks cost."""

from __future__ import annotations

from typing import Any, NamedTuple

import h11

from .cuts import Allowance

__all__ = ["MOST_REST", "CountedConnection", "Offence"]

#: How many bytes of a request are read after it was answered.
MOST_REST = 64 * 1024

# How long the head of a request may be.
_MOST_HEAD = 16 * 1024

# Chunks at once, and a second; beyond that each is to have, on the whole, this many bytes. A chunk costs as much as
# 2 KiB that come in a large one.
_CHUNKS = (500.0, 20.0)
_LEAST_CHUNK = 16

# What stands around chunks, extensions and trailers included, may be as much as what is in them, and this.
_FRAMING = 256 * 1024


class Offence(NamedTuple):
    """The code and the detail of the answer to a faulty request."""

    code: str
    detail: str


class CountedConnection(h11.Connection):
    """The server's side of HTTP/1.1, with counts of the bytes and chunks of each request.

    Attributes
    ----------
    chunks : int
        Number of chunks that have begun, of all requests.
    offence : Offence or None
        What is wrong with the framing of a body, once something is; `next_event` then raises.
    only_head : bool
        Whether the last request has the method HEAD.
    """

    def __init__(self) -> None:
        super().__init__(h11.SERVER, _MOST_HEAD)
        self.chunks = 0
        self._whole = False
        self.offence: Offence | None = None
        self.only_head = False
        self._allowed = Allowance(*_CHUNKS)
        self._promised = 0
        self._came = 0
        self._taken = 0

    @property
    def remaining(self) -> int:
        """Bytes of the body that are still to come, if its length was announced."""
        return self._promised - self._taken if self._whole else 0

    def receive_data(self, data: bytes) -> None:
        """Count and take bytes."""
        self._came += len(data)
        super().receive_data(data)

    def next_event(self) -> Any:
        """Return the next event, as h11's connection does.

        Raises
        ------
        h11.RemoteProtocolError
            Also if the length of a body is told in two ways, or its chunks are too small.
        """
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._begin(event)
        elif isinstance(event, h11.Data):
            self._take(event)
        return event

    def send(self, event: h11.Event) -> Any:
        """Send an event, as h11's connection does.

        ``Connection: close`` is added if much of the request has not arrived.
        """
        if type(event) is h11.Response and self.their_state is h11.SEND_BODY and not self._ends_soon():
            headers = [header for header in event.headers if header[0] != b"connection"] + [(b"connection", b"close")]
            event = h11.Response(status_code=event.status_code, headers=headers, reason=event.reason)
        return super().send(event)

    def _ends_soon(self) -> bool:
        return self._whole and self.remaining <= MOST_REST

    def _begin(self, request: h11.Request) -> None:
        headers = dict(request.headers)
        self.only_head = request.method == b"HEAD"
        self._whole = b"transfer-encoding" not in headers
        # RFC 9112, 6.1 and 6.3: a proxy in front may take the other of the two lengths, and what it takes for a body
        # is the next request here, or the other way round.
        if not self._whole and b"content-length" in headers:
            self._refuse("bad-request", "expected Content-Length or Transfer-Encoding in a request, got both")
        if not self._whole and request.http_version < b"1.1":
            self._refuse("bad-request", "expected Transfer-Encoding in HTTP/1.1 only, got it in HTTP/1.0")
        self._promised = int(headers.get(b"content-length", b"0"))
        self._came = self._taken = 0

    def _take(self, event: h11.Data) -> None:
        size = len(event.data)
        self._taken += size
        if self._whole:
            return
        self._allowed.earn(size / _LEAST_CHUNK)
        if event.chunk_start:
            self.chunks += 1
            if not self._allowed.take():
                self._refuse_chunks(f"chunks of at least {_LEAST_CHUNK} bytes on average, got smaller ones")
            if self._came > 2 * self._taken + _FRAMING:
                self._refuse_chunks(
                    f"less framing than data in a chunked body, got {self._came} bytes with {self._taken} bytes of data"
                )

    def _refuse_chunks(self, words: str) -> None:
        self._refuse("small-chunks", f"expected {words}; send larger chunks, or Content-Length")

    def _refuse(self, code: str, detail: str) -> None:
        self.offence = Offence(code, detail)
        raise h11.RemoteProtocolError(detail)
