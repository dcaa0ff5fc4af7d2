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
from .bodies import Closure, Source, opened, surface_parameters
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
    *sources : str, path, binary file, bytes or Surface
        One file, or several that make one surface; one that is open; the bytes of one; a surface in memory.
    precision : Tolerance, float, str or None
        Greatest error of the complete surface; None for a lossless one.
    rms : Tolerance, float, str or None
        Make the shortest stream whose root mean square error is at most this, instead; excludes `precision`.
    closed : "auto", "none", "rows", "cols" or "both"
        Which axes of the grid wrap.
    name : str or None
        Name of the surface.
    options : mapping of str to str
        Options of the file's format.
    wait : bool
        Whether to wait until it is ready to be streamed.
    progress : callable or None
        Called as ``progress(stage, fraction)``, with the stages ``sending`` and ``building``.
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
        When an option has a value that it does not take, or both `precision` and `rms` are given.
    InputError, TooLargeError
        When the server cannot use the file, or will not take one so large.
    RemoteError
        When building failed, with code ``failed``, or the server refused.
    UnreachableError
        When there is no connection.
    """
    parameters = surface_parameters(sources, precision, rms, closed, name, options, attribute_precision)
    sent = None if progress is None else (lambda fraction: progress("sending", fraction))
    with opened(sources, sent) as body:
        return _run(requests.upload(url, parameters, body, wait, progress), url, token)


def list_surfaces(url: str, *, token: str | None = None) -> tuple[Description, ...]:
    """All surfaces of a server; exported as ``list`` too."""
    return _run(requests.list_surfaces(url), url, token)


def describe(url: str, *, token: str | None = None) -> Description:
    """State and figures of one surface."""
    return _run(requests.describe(url), url, token)


def describe_file(url: str, *, token: str | None = None) -> Mapping[str, Any]:
    """Figures of a container that some web server holds as a file: what ``lodestream info --json`` prints."""
    return _run(requests.describe_file(url), url, token)


def identify(url: str, *, token: str | None = None) -> Identity:
    """What a surface's container, or a container's file, is known by."""
    return _run(requests.identify(url), url, token)


def delete(url: str, *, token: str | None = None) -> None:
    """Remove a surface from its server."""
    _run(requests.delete(url), url, token)


def fetch_range(url: str, offset: int, length: int, *, token: str | None = None) -> bytes:
    """Bytes of a surface's container, over HTTP."""
    return _run(requests.fetch_range(url, offset, length), url, token)


def _run(flow: Flow[T], url: str, token: str | None) -> T:
    import httpx

    answer: httpx.Response | None = None
    with httpx.Client(**requests.client_options(url)) as client:
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
                with client.stream(content=content, **requests.request_options(step, url, token)) as answer:
                    if not (step.partial and answer.status_code == 200):
                        answer.read()
            except httpx.HTTPError as error:
                raise problems.from_connection(error, url) from error


list = list_surfaces
