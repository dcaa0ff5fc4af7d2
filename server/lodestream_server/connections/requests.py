"""HTTP requests as h11 reads them: whose length is told in two ways, and how much of a body is still to come."""

from __future__ import annotations

from typing import Any

import h11

__all__ = ["MOST_HEAD", "MOST_REST", "Requests"]

#: How long the head of a request may be, in bytes; the trailers and extensions of chunks alike.
MOST_HEAD = 16 * 1024

#: How many bytes of a request are read after it was answered.
MOST_REST = 64 * 1024


class Requests(h11.Connection):
    """The server's side of HTTP/1.1.

    Attributes
    ----------
    wrong : str
        What is wrong with the request, if `next_event` has raised an error.
    only_head : bool
        Whether the last request has the method HEAD.
    """

    def __init__(self) -> None:
        super().__init__(h11.SERVER, MOST_HEAD)
        self.wrong = "This is no valid HTTP/1.1 request"
        self.only_head = False
        self._whole = False
        self._to_come = 0

    @property
    def remaining(self) -> int:
        """Bytes of the body that are still to come, if its length was announced."""
        return self._to_come if self._whole else 0

    def next_event(self) -> Any:
        """Return the next event, as h11's connection does.

        Raises
        ------
        h11.RemoteProtocolError
            Also if the length of a body is told in two ways.
        """
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._begin(event)
        elif isinstance(event, h11.Data):
            self._to_come -= len(event.data)
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
        return self._whole and self._to_come <= MOST_REST

    def _begin(self, request: h11.Request) -> None:
        headers = dict(request.headers)
        self.only_head = request.method == b"HEAD"
        self._whole = b"transfer-encoding" not in headers
        self._to_come = int(headers.get(b"content-length", b"0"))
        # RFC 9112, 6.1 and 6.3: a proxy in front may take the other of the two lengths, and what it takes for a body
        # is the next request here, or the other way round.
        if not self._whole and b"content-length" in headers:
            self._refuse("The request has both Content-Length and Transfer-Encoding")
        if not self._whole and request.http_version < b"1.1":
            self._refuse("The request has Transfer-Encoding, which HTTP/1.0 does not know")

    def _refuse(self, wrong: str) -> None:
        self.wrong = wrong
        raise h11.RemoteProtocolError(wrong)
