"""Streams and surfaces of a server, for programs without an event loop.

The names are those of `lodestream_client`; here they block.

Examples
--------
>>> with connect("http://localhost:8000/v1/surfaces/0123456789abcdef0123") as stream:  # doctest: +SKIP
...     for view in stream:
...         print(view.bytes, view.rms)
...     print(stream.ended)
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, TypeVar

from lodestream.target import Tolerance

from . import problems, requests
from .answers import Answer, Incoming
from .bodies import Asked, Closure, Source, opened, prepared
from .requests import Description, Flow, Identity, Progress
from .sync_stream import Stream, connect

__all__ = [
    "Stream",
    "connect",
    "delete",
    "describe",
    "describe_file",
    "fetch_range",
    "identify",
    "list",
    "list_surfaces",
    "retry",
    "upload",
]

T = TypeVar("T")


def upload(
    url: str,
    *sources: Source,
    precision: Tolerance | float | str | None = None,
    rms: Tolerance | float | str | None = None,
    closed: Closure = "auto",
    name: str | None = None,
    options: Mapping[str, str] | None = None,
    wait: bool = True,
    progress: Progress | None = None,
    token: str | None = None,
    attribute_precision: Mapping[str, Tolerance | float | str] | None = None,
) -> Description:
    """Upload a surface.

    Parameters
    ----------
    url : str
        The server's address.
    *sources : str, path, binary file, bytes, Surface or array
        One file, or several that make one surface; one that is open; the bytes of one. Or a surface in memory, whatever
        `lodestream.encode` takes: it is encoded here, and the server keeps the container as it is. So it does with a
        file that is a container, for which there is no option but a name.
    precision : Tolerance, float, str or None
        Greatest error of the complete surface; None for a lossless one.
    rms : Tolerance, float, str or None
        Make the shortest stream whose root mean square error is at most this, instead; excludes `precision`.
    closed : "auto", "none", "rows", "cols" or "both"
        Which axes of the grid wrap; auto leaves it to the file, or to the surface in memory.
    name : str or None
        Name of the surface.
    options : mapping of str to str
        Options of the file's format.
    wait : bool
        Whether to wait until it is ready to be streamed.
    progress : callable or None
        Called as ``progress(stage, fraction)``, with the stages ``encoding`` (of a surface in memory), ``sending`` and
        ``building``.
    token : str or None
        What the server asks for, if it does.
    attribute_precision : mapping of str to Tolerance, float or str, or None
        Greatest error of attributes, by their names; the others are lossless.

    Returns
    -------
    Description
        With the surface's address as ``url``.

    Raises
    ------
    OptionError
        When an option has a value that it does not take, has no place beside such a source, or both `precision` and
        `rms` are given.
    InputError, TooLargeError
        When a source is none of these or cannot be encoded, the server cannot use the file, or will not take one so
        large.
    RemoteError
        When the surface does not become ready, or the server refused. The code is ``failed`` where it cannot be built,
        and ``waiting`` or ``missing`` where that is the server's trouble: what was uploaded is kept, see `retry`.
    UnreachableError
        When there is no connection.
    """
    asked = Asked(precision, rms, closed, name, options or {}, attribute_precision or {})
    parcel = prepared(sources, asked, progress)
    sent = None if progress is None else (lambda fraction: progress("sending", fraction))
    with opened(parcel, sent) as body:
        return _run(requests.upload(url, parcel.parameters, body, wait, progress), url, token)


def retry(url: str, *, wait: bool = True, progress: Progress | None = None, token: str | None = None) -> Description:
    """Have a surface built again that waits, since its build could not be made, that failed or is missing.

    Parameters
    ----------
    url : str
        The surface's address.
    wait : bool
        Whether to wait until it is ready to be streamed.
    progress : callable or None
        Called as ``progress("building", fraction)``.
    token : str or None
        What the server asks for, if it does.

    Returns
    -------
    Description

    Raises
    ------
    NotFoundError
        When there is no such surface.
    RemoteError
        When the server refuses, or the surface does not become ready: code ``failed``, ``waiting`` or ``missing``.
    UnreachableError
        When there is no connection.
    """
    return _run(requests.retry(url, wait, progress), url, token)


def list_surfaces(url: str, *, token: str | None = None) -> tuple[Description, ...]:
    """All surfaces of a server; exported as ``list`` too."""
    return _run(requests.list_surfaces(url), url, token)


def describe(url: str, *, token: str | None = None) -> Description:
    """State and figures of one surface."""
    return _run(requests.describe(url), url, token)


def describe_file(url: str, *, token: str | None = None, max_vertices: int | None = None) -> Mapping[str, Any]:
    """Figures of a container that some web server holds as a file: what ``lodestream info --json`` prints.

    What a surface of `max_vertices` takes is what the container's tables may, see `connect`.
    """
    return _run(requests.describe_file(url, max_vertices), url, token)


def identify(url: str, *, token: str | None = None) -> Identity:
    """What a surface's container, or a container's file, is known by."""
    return _run(requests.identify(url), url, token)


def delete(url: str, *, token: str | None = None) -> None:
    """Remove a surface from its server."""
    _run(requests.delete(url), url, token)


def fetch_range(
    url: str, offset: int, length: int, *, token: str | None = None, timeout: float = requests.TIMEOUT
) -> bytes:
    """Bytes of a surface's container, over HTTP; `timeout` is in seconds, for connecting and for each wait after it."""
    return _run(requests.fetch_range(url, offset, length), url, token, timeout)


def _run(flow: Flow[T], url: str, token: str | None, timeout: float = requests.TIMEOUT) -> T:
    import httpx

    answer: Answer | None = None
    with httpx.Client(**requests.client_options(url, timeout)) as client:
        while True:
            try:
                step = flow.send(answer)
            except StopIteration as end:
                result: T = end.value
                return result
            if isinstance(step, requests.Pause):
                time.sleep(step.seconds)
                answer = None
                continue
            content = step.body.chunks() if step.body is not None and len(step.body.files) == 1 else None
            try:
                with client.stream(content=content, **requests.request_options(step, url, token)) as response:
                    incoming = Incoming(response, step.most, step.url, url, token)
                    if not (step.partial and response.status_code == 200):
                        for piece in response.iter_raw():
                            if not incoming.take(piece):
                                break
                answer = incoming.answer()
            except httpx.HTTPError as error:
                raise problems.from_connection(error, url) from error


list = list_surfaces
