"""Uploads that go on after a lost connection: the requests of tus 1.0.0, without I/O."""

from __future__ import annotations

import base64
import random
from collections.abc import Callable, Mapping

from lodestream.errors import LodestreamError, NotFoundError, RemoteProtocolError

from . import addresses, problems
from .answers import Answer
from .bodies import Body
from .calls import Call, Flow, Pause

__all__ = ["LEAST", "answered", "beginning", "completed", "is_absent"]

#: Bytes from which on an upload is sent in this way: sending less again costs little more than asking does.
LEAST = 8 << 20

_VERSION = {"Tus-Resumable": "1.0.0"}
_TYPE = "application/offset+octet-stream"

# Requests in a row that bring the upload no further, and the seconds between two of them: at random within twice as
# long each time, so that clients that lost the same server do not come back all at once.
_ATTEMPTS = 12
_FIRST_PAUSE = 0.2
_LONGEST_PAUSE = 30.0

# Statuses of `_NoFurtherError`.
_ELSEWHERE = (409, 423)

# Statuses of servers that do not have the upload any more, and how often it begins again.
_LOST = (404, 410)
_LOSSES = 3

# Statuses of servers that know no such uploads.
_ABSENT = (404, 405)


def beginning(body: Body) -> Mapping[str, str]:
    """Return the headers of the request that begins the upload of a body, which has been hashed."""
    metadata = f"sha256 {base64.b64encode(body.sha256.encode()).decode()}"
    return {**_VERSION, "Upload-Length": str(body.size), "Upload-Metadata": metadata}


def is_absent(answer: Answer) -> bool:
    """Return whether a server knows no such uploads. Ours does, so its 404 says that the address is wrong."""
    return answer.status in _ABSENT and not problems.is_ours(answer.content)


def completed(uploads: str, address: str, body: Body, begin: Callable[[], Flow[str | None]]) -> Flow[str]:
    """Send a body to an upload at `address`, which has begun at `uploads`, and return the URL of its surface.

    After a lost connection, or an answer that may be another one soon, the server is asked how far it is, and the
    upload goes on there. If the server does not have it any more, such as one that has taken the place of another, it
    begins again, by `begin`, which returns its new address.

    Raises
    ------
    LodestreamError
        If the server refuses the upload, or it comes no further although it was tried again and again.
    """
    offset, asks, failures, losses = 0, False, 0, 0
    place: str | None = _own(address, uploads)
    while True:
        wait = 0.0
        try:
            if place is None:
                begun = yield from begin()
                if begun is None:
                    raise NotFoundError(f"{uploads} takes no upload in parts any more")
                place, offset, asks = _own(begun, uploads), 0, False
            answer = yield (_question(place) if asks else _part(place, body, offset))
            assert answer is not None
            wait = _asked(answer)
            if answer.status in _LOST and losses < _LOSSES:
                place, losses = None, losses + 1
                continue
            _refuse(answer, place)
            if location := answer.headers.get("location"):
                return _own(addresses.resolved(place, location), uploads)
            reached = _offset(answer, place, body.size)
            if reached == offset and not asks:
                raise _NoFurtherError(f"{place} took no more of the upload, and did not say why")
            failures = 0 if reached > offset else failures
            offset, asks = reached, False
        except LodestreamError as error:
            failures += 1
            if failures == _ATTEMPTS or not (problems.passes(error) or isinstance(error, _NoFurtherError)):
                raise
            yield _pause(failures, wait)
            asks = True


def answered(surface: str, parameters: Mapping[str, str | list[str]] | None = None) -> Flow[Answer]:
    """Ask for the surface of an upload, which is stored whatever becomes of the question, and return the answer.

    After a lost connection, or an answer that may be another one soon, it is asked for again.

    Raises
    ------
    LodestreamError
        If there is no answer although it was asked for again and again.
    """
    for failures in range(1, _ATTEMPTS):
        try:
            answer = yield Call("GET", surface, parameters or {})
            assert answer is not None
            if 200 <= answer.status < 300 or not problems.passes(_problem(answer, surface)):
                return answer
            wait = _asked(answer)
        except LodestreamError as error:
            if not problems.passes(error):
                raise
            wait = 0.0
        yield _pause(failures, wait)
    answer = yield Call("GET", surface, parameters or {})
    assert answer is not None
    return answer


def _pause(failures: int, asked: float) -> Pause:
    return Pause(max(asked, random.uniform(0.0, min(_FIRST_PAUSE * 2**failures, _LONGEST_PAUSE))))


class _NoFurtherError(RemoteProtocolError):
    """The server goes on elsewhere in the upload, still takes the request that was lost, or took nothing."""


def _own(address: str, uploads: str) -> str:
    if not addresses.same_origin(address, uploads):
        raise RemoteProtocolError(f"expected an address on {addresses.origin(uploads)}, got {address!a:.300}")
    return address


def _question(address: str) -> Call:
    return Call("HEAD", address, headers=_VERSION)


def _part(address: str, body: Body, offset: int) -> Call:
    body.go_to(offset)
    return Call("PATCH", address, headers={**_VERSION, "Upload-Offset": str(offset), "Content-Type": _TYPE}, body=body)


def _refuse(answer: Answer, address: str) -> None:
    if not 200 <= answer.status < 300:
        error = _problem(answer, address)
        raise _NoFurtherError(str(error)) if answer.status in _ELSEWHERE else error


def _problem(answer: Answer, address: str) -> LodestreamError:
    return problems.from_response(answer.status, answer.reason, answer.content, address)


def _asked(answer: Answer) -> float:
    """Return the seconds for which the server asks to wait."""
    text = answer.headers.get("retry-after", "")
    return min(float(text), _LONGEST_PAUSE) if text.isascii() and text.isdecimal() else 0.0


def _offset(answer: Answer, address: str, size: int) -> int:
    text = answer.headers.get("upload-offset", "")
    if not (text.isascii() and text.isdecimal() and len(text) < 19 and int(text) <= size):
        raise RemoteProtocolError(f"expected how far the upload is from {address}, got {text[:80]!a}")
    return int(text)
