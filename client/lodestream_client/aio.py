"""Streams and surfaces of a server, for asyncio.

`lodestream_client` exports these names; `lodestream_client.sync` has the same for programs without an event loop. The
event loop only takes bytes apart, at most 64 KiB at a time. Values are decoded where they are asked for: use ``await
asyncio.to_thread(view.surface)`` for a large surface, and ``asyncio.to_thread(stream.decoder.view)`` for its end, which
is verified when it is first asked for.

Examples
--------
>>> async with connect("http://localhost:8000/v1/surfaces/0123456789abcdef0123") as stream:  # doctest: +SKIP
...     async for view in stream:
...         print(view.bytes, view.rms)
...     print(stream.ended)
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

from lodestream.target import Tolerance

from .requests import api, calls, problems
from .requests.answers import Answer, Head, Incoming
from .requests.api import Description, Identity, Progress
from .requests.bodies import Asked, Body, Closure, Parcel, Source, are_files, check_asked, opened, prepared
from .requests.calls import Flow
from .stream.aio_stream import Stream
from .stream.options import ConnectKeywords, ConnectOptions

if TYPE_CHECKING:
    from lodestream.errors import LodestreamError
    from lodestream.quality import Effort

__all__ = [
    "Stream",
    "connect",
    "delete",
    "describe",
    "describe_file",
    "fetch_range",
    "identify",
    "list_names",
    "list_surfaces",
    "locate",
    "retry",
    "upload",
]

T = TypeVar("T")


def connect(url: str, **options: Unpack[ConnectKeywords]) -> Stream:
    """Receive a surface; to be entered with ``async with``.

    Parameters and errors are those of `lodestream_client.sync.connect`. The connection is opened, and errors of the
    server are raised, on entering.

    Examples
    --------
    >>> import asyncio, lodestream, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> async def receive():
    ...     async with lodestream_client.connect(url, target=lodestream.Target(level=3)) as stream:
    ...         views = [view async for view in stream]
    ...     return stream.ended, views[-1].points_at(3).shape
    >>> asyncio.run(receive())
    ('level', (7, 6))
    """
    return Stream(url, ConnectOptions(**options))


async def upload(
    url: str,
    *sources: Source,
    precision: Tolerance | float | str | None = None,
    rms: Tolerance | float | str | None = None,
    closed: Closure = "auto",
    name: str | None = None,
    options: Mapping[str, str | Sequence[str]] | None = None,
    wait: bool = True,
    progress: Progress | None = None,
    token: str | None = None,
    attribute_precision: Mapping[str, Tolerance | float | str] | None = None,
    filename: str | None = None,
    nodata: float | str | None = None,
    local: bool = False,
    effort: Effort = "default",
    replace: bool = False,
) -> Description:
    """Upload a surface; parameters, results and errors are those of `lodestream_client.sync.upload`.

    A surface in memory is encoded in a thread, and files are read in threads; `progress` is called from there.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy", precision=0.01)).state
    'ready'
    """
    asked = Asked(precision, rms, closed, name, options or {}, attribute_precision or {}, filename, nodata, effort)
    check_asked(asked)
    stays = api.name_to_change(url, name, replace=replace, wait=wait)
    ask = not local and are_files(sources)
    read_there = await _run(api.formats_read(url), url, token) if ask else None
    parcel = await _prepared(sources, asked, progress, read_there, local)
    sent = None if progress is None else (lambda fraction: progress("sending", fraction))
    with opened(parcel, sent) as body:
        return await _run(api.upload(url, parcel.parameters, body, wait, progress, stays), url, token)


async def retry(
    url: str, *, wait: bool = True, progress: Progress | None = None, token: str | None = None
) -> Description:
    """Ask the server to build a surface again that waits or has failed; see `lodestream_client.sync.retry`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> asyncio.run(lodestream_client.retry(url)).state  # nothing to do: it is ready
    'ready'
    """
    return await _run(api.retry(url, wait, progress), url, token)


async def list_surfaces(url: str, *, token: str | None = None) -> tuple[Description, ...]:
    """Return all surfaces of a server; also exported as ``list``; errors as in `lodestream_client.sync`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> surfaces = asyncio.run(lodestream_client.list("http://127.0.0.1:8000"))
    >>> url in [description.url for description in surfaces]
    True
    """
    return await _run(api.list_surfaces(url), url, token)


async def list_names(url: str, *, token: str | None = None) -> tuple[Mapping[str, Any], ...]:
    """Return all names of a server; see `lodestream_client.sync.list_names`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> names = asyncio.run(lodestream_client.list_names("http://127.0.0.1:8000"))
    >>> all(set(it) >= {"name", "url", "surface"} for it in names)
    True
    """
    return await _run(api.list_names(url), url, token)


async def describe(url: str, *, token: str | None = None) -> Description:
    """Return the state and the description of one surface; errors as in `lodestream_client.sync`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> asyncio.run(lodestream_client.describe(url)).details["shape"]
    [97, 70]
    """
    return await _run(api.describe(url), url, token)


async def describe_file(url: str, *, token: str | None = None, max_vertices: int | None = None) -> Mapping[str, Any]:
    """Return the description of a container file on any web server, as ``lodestream info --json`` prints it.

    `max_vertices` limits the memory of the container's tables, see `connect`. Errors as in `lodestream_client.sync`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> asyncio.run(lodestream_client.describe_file(f"{url}/container"))["shape"]  # or of any web server
    [97, 70]
    """
    return await _run(api.describe_file(url, max_vertices), url, token)


async def identify(url: str, *, token: str | None = None) -> Identity:
    """Return the identity of a surface's container, or of a container file; errors as in `lodestream_client.sync`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> len(asyncio.run(lodestream_client.identify(url)).container_sha256)
    64
    """
    return await _run(api.identify(url), url, token)


async def delete(url: str, *, token: str | None = None) -> None:
    """Delete a surface from its server, or a name; errors as in `lodestream_client.sync`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> description = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy", name="for a while"))
    >>> asyncio.run(lodestream_client.delete(description.url))
    """
    await _run(api.delete(url), url, token)


async def locate(url: str, *, token: str | None = None) -> str:
    """Return the URL of the surface or container to which a name leads; see `lodestream_client.sync.locate`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> asyncio.run(lodestream_client.locate(url)) == url
    True
    """
    return await _run(api.locate(url), url, token)


async def fetch_range(
    url: str, offset: int, length: int, *, token: str | None = None, timeout: float = calls.TIMEOUT
) -> bytes:
    """Fetch bytes of a surface's container over HTTP; see `lodestream_client.sync.fetch_range`.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> url = asyncio.run(lodestream_client.upload("http://127.0.0.1:8000", "terrain.npy")).url
    >>> asyncio.run(lodestream_client.fetch_range(url, 1, 4))
    b'LODE'
    """
    return await _run(api.fetch_range(url, offset, length), url, token, timeout)


class _GivenUpError(Exception):
    """The upload was cancelled, so that the encoder must end."""


async def _prepared(
    sources: Sequence[Source], asked: Asked, progress: Progress | None, read_there: frozenset[str] | None, local: bool
) -> Parcel:
    given_up = threading.Event()

    def report(stage: str, fraction: float) -> None:
        if given_up.is_set():
            raise _GivenUpError  # a thread cannot be ended from outside, and a program waits for it at its end
        if progress is not None:
            progress(stage, fraction)

    try:
        return await asyncio.to_thread(prepared, sources, asked, report, read_there, local)
    except asyncio.CancelledError:
        given_up.set()
        raise


async def _run(flow: Flow[T], url: str, token: str | None, timeout: float = calls.TIMEOUT) -> T:
    import httpx

    answer: Answer | None = None
    failure: LodestreamError | None = None
    async with httpx.AsyncClient(**calls.client_options(url, timeout, asynchronous=True)) as client:
        while True:
            try:
                step = flow.send(answer) if failure is None else flow.throw(failure)
            except StopIteration as end:
                result: T = end.value
                return result
            if isinstance(step, calls.Pause):
                await asyncio.sleep(step.seconds)
                answer = None
                continue
            content = _chunks(step.body) if step.body is not None and len(step.body.files) == 1 else None
            try:
                async with client.stream(content=content, **calls.request_options(step, url, token)) as response:
                    incoming = Incoming(Head.of(response), step.most, step.url, url, token)
                    if not (step.partial and response.status_code == 200):
                        async for chunk in response.aiter_raw():
                            if not incoming.take(chunk):
                                break
                answer = incoming.answer()
            except httpx.HTTPError as error:
                failure = problems.from_connection(error, url)
                failure.__cause__ = error


async def _chunks(body: Body) -> AsyncIterator[bytes]:
    chunks: Iterator[bytes] = body.chunks()
    while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
        yield chunk
