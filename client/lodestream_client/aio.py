"""Streams and surfaces of a server, for asyncio.

`lodestream_client` exports these names; `lodestream_client.sync` has the same without an event loop. Bytes are decoded
in the event loop, at most 64 KiB at a time.

Examples
--------
>>> async with connect("http://localhost:8000/v1/surfaces/0123456789abcdef0123") as stream:  # doctest: +SKIP
...     async for view in stream:
...         print(view.bytes, view.rms)
...     print(stream.ended)
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator, Mapping
from typing import Any, TypeVar

from lodestream.target import Tolerance

from . import problems, requests
from .aio_stream import Stream, connect
from .bodies import Body, Closure, Source, opened, surface_parameters
from .requests import Description, Flow, Identity, Progress

__all__ = [
    "Stream",
    "connect",
    "delete",
    "describe",
    "describe_file",
    "fetch_range",
    "identify",
    "list_surfaces",
    "upload",
]

T = TypeVar("T")


async def upload(
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
    """Upload a surface; parameters, results and errors are those of `lodestream_client.sync.upload`."""
    parameters = surface_parameters(sources, precision, rms, closed, name, options, attribute_precision)
    sent = None if progress is None else (lambda fraction: progress("sending", fraction))
    with opened(sources, sent) as body:
        return await _run(requests.upload(url, parameters, body, wait, progress), url, token)


async def list_surfaces(url: str, *, token: str | None = None) -> tuple[Description, ...]:
    """All surfaces of a server; exported as ``list`` too."""
    return await _run(requests.list_surfaces(url), url, token)


async def describe(url: str, *, token: str | None = None) -> Description:
    """State and figures of one surface."""
    return await _run(requests.describe(url), url, token)


async def describe_file(url: str, *, token: str | None = None) -> Mapping[str, Any]:
    """Figures of a container that some web server holds as a file: what ``lodestream info --json`` prints."""
    return await _run(requests.describe_file(url), url, token)


async def identify(url: str, *, token: str | None = None) -> Identity:
    """What a surface's container, or a container's file, is known by."""
    return await _run(requests.identify(url), url, token)


async def delete(url: str, *, token: str | None = None) -> None:
    """Remove a surface from its server."""
    await _run(requests.delete(url), url, token)


async def fetch_range(url: str, offset: int, length: int, *, token: str | None = None) -> bytes:
    """Bytes of a surface's container, over HTTP."""
    return await _run(requests.fetch_range(url, offset, length), url, token)


async def _run(flow: Flow[T], url: str, token: str | None) -> T:
    import httpx

    answer: httpx.Response | None = None
    async with httpx.AsyncClient(**requests.client_options(url)) as client:
        while True:
            try:
                step = flow.send(answer)
            except StopIteration as end:
                result: T = end.value
                return result
            if isinstance(step, requests.Pause):
                await asyncio.sleep(step.seconds)
                answer = None
                continue
            content = _chunks(step.body) if step.body is not None and len(step.body.files) == 1 else None
            try:
                async with client.stream(content=content, **requests.request_options(step, url, token)) as answer:
                    if not (step.partial and answer.status_code == 200):
                        await answer.aread()
            except httpx.HTTPError as error:
                raise problems.from_connection(error, url) from error


async def _chunks(body: Body) -> AsyncIterator[bytes]:
    chunks: Iterator[bytes] = body.chunks()
    while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
        yield chunk
