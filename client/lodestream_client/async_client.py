"""The client of a server, for asyncio."""

from __future__ import annotations

import asyncio
import re
import threading
import weakref
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

from lodestream.errors import OptionError
from lodestream.target import Tolerance

from .requests import addresses, api, calls, problems
from .requests.answers import Answer, Head, Incoming
from .requests.api import Description, Identity, Progress
from .requests.bodies import Asked, Body, Closure, Parcel, Source, are_files, check_asked, opened, prepared
from .requests.calls import Flow

if TYPE_CHECKING:
    import httpx

    from lodestream.errors import LodestreamError
    from lodestream.quality import Effort

    from .stream.async_stream import AsyncStream
    from .stream.options import ConnectKeywords, ConnectOptions

__all__ = ["AsyncClient"]

T = TypeVar("T")

_TOKEN = re.compile("[!-~]*")


class AsyncClient:
    """A client of a server, as `Client` for asyncio: the same methods, as coroutines.

    It is an asynchronous context manager; leaving it closes its connections.

    Parameters
    ----------
    url : str
        URL of the server, or of a surface or name on it.
    token : str or None
        Token, if the server needs one; it is sent only to this server.

    Attributes
    ----------
    url : str
        URL of the server.

    Raises
    ------
    OptionError
        If this is not an ``http`` or ``https`` URL, or the token has spaces, line ends or other characters that no
        token has.

    Examples
    --------
    >>> import asyncio, lodestream, lodestream_client
    >>> async def receive():
    ...     async with lodestream_client.AsyncClient("http://127.0.0.1:8000") as client:
    ...         surface = await client.upload("terrain.npy")
    ...         async with client.connect(surface.id, target=lodestream.Target(level=3)) as stream:
    ...             views = [view async for view in stream]
    ...     return stream.ended, views[-1].points_at(3).shape
    >>> asyncio.run(receive())
    ('level', (7, 6))
    """

    def __init__(self, url: str, *, token: str | None = None) -> None:
        self.url = addresses.server_url(url)
        # Whoever reads a token from a file gets its line end too; what sends it would show it in an error.
        if token is not None and not _TOKEN.fullmatch(token):
            raise OptionError("expected a token without spaces, line ends and characters that are not ASCII")
        self._token = token
        # By loop, since a connection belongs to one; and by whether proxies are left out.
        self._kept: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, dict[bool, httpx.AsyncClient]] = (
            weakref.WeakKeyDictionary()
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.url!r})"

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections that are kept for further requests. A request opens another one."""
        for kept in self._kept.pop(asyncio.get_running_loop(), {}).values():
            await kept.aclose()

    def connect(self, source: str, **options: Unpack[ConnectKeywords]) -> AsyncStream:
        """Receive a surface; to be entered with ``async with``.

        Parameters and errors are those of `Client.connect`. The connection is opened, and errors of the server are
        raised, on entering.
        """
        from .stream.async_stream import AsyncStream  # with what decodes: other requests need none of it

        url = self.place(source)
        return AsyncStream(url, self.options_for(url, options), self.requests_to(url))

    async def upload(
        self,
        *sources: Source,
        precision: Tolerance | float | str | None = None,
        rms: Tolerance | float | str | None = None,
        closed: Closure = "auto",
        name: str | None = None,
        options: Mapping[str, str | Sequence[str]] | None = None,
        wait: bool = True,
        progress: Progress | None = None,
        attribute_precision: Mapping[str, Tolerance | float | str] | None = None,
        filename: str | None = None,
        nodata: float | str | None = None,
        local: bool = False,
        effort: Effort = "default",
        replace: bool = False,
    ) -> Description:
        """Upload a surface; parameters, results and errors are those of `Client.upload`.

        A surface in memory is encoded in a thread, and files are read in threads; `progress` is called from there.
        """
        asked = Asked(precision, rms, closed, name, options or {}, attribute_precision or {}, filename, nodata, effort)
        check_asked(asked)
        stays = api.name_to_change(self.url, name, replace=replace, wait=wait)
        read_there = await self.formats_read() if not local and are_files(sources) else None
        parcel = await _prepared(sources, asked, progress, read_there, local)
        return await self.send(parcel, wait, progress, stays)

    async def retry(self, source: str, *, wait: bool = True, progress: Progress | None = None) -> Description:
        """Ask the server to build a surface again that waits or has failed; see `Client.retry`."""
        url = self.place(source)
        return await self._run(api.retry(url, wait, progress), url)

    async def list(self) -> tuple[Description, ...]:
        """Return all surfaces of the server; errors as of `Client.list`."""
        return await self._run(api.list_surfaces(self.url), self.url)

    async def list_names(self) -> tuple[Mapping[str, Any], ...]:
        """Return all names of the server; see `Client.list_names`."""
        return await self._run(api.list_names(self.url), self.url)

    async def list_published(self, url: str) -> Sequence[Mapping[str, Any]]:
        """Return what is published on the page at a URL; see `Client.list_published`."""
        return await self._run(api.published_surfaces(url), url)

    async def get(self, source: str) -> Description:
        """Return the state and the description of one surface; see `Client.get`."""
        url = self.place(source)
        return await self._run(api.describe(url), url)

    async def describe_file(self, url: str, *, max_vertices: int | None = None) -> Mapping[str, Any]:
        """Return the description of a container file on any web server; see `Client.describe_file`."""
        return await self._run(api.describe_file(url, max_vertices), url)

    async def identify(self, source: str) -> Identity:
        """Return the identity of a surface's container, or of a container file; see `Client.identify`."""
        url = self.place(source)
        return await self._run(api.identify(url), url)

    async def locate(self, source: str) -> str:
        """Return the URL of the surface or container to which a name leads; see `Client.locate`."""
        url = self.place(source)
        return await self._run(api.locate(url), url)

    async def delete(self, source: str) -> None:
        """Delete a surface from its server, or a name; see `Client.delete`."""
        url = self.place(source)
        await self._run(api.delete(url), url)

    async def fetch_range(
        self,
        source: str,
        offset: int,
        length: int,
        *,
        identity: Identity | None = None,
        timeout: float = calls.TIMEOUT,
    ) -> bytes:
        """Fetch bytes of a surface's container over HTTP; see `Client.fetch_range`."""
        url = self.place(source)
        return await self._run(api.fetch_range(url, offset, length, identity), url, timeout)

    # What `Client` uses too.

    def place(self, source: str) -> str:
        """Return the URL of what is given by its id or by its URL.

        Raises
        ------
        OptionError
            If it is neither.
        """
        return addresses.place_url(self.url, source)

    async def formats_read(self) -> frozenset[str] | None:
        """Return the formats that the server reads; None: it does not say."""
        return await self._run(api.formats_read(self.url), self.url)

    async def send(self, parcel: Parcel, wait: bool, progress: Progress | None, name: str | None) -> Description:
        """Send what an upload has prepared; see `requests.api.upload`."""
        sent = None if progress is None else (lambda fraction: progress("sending", fraction))
        with opened(parcel, sent) as body:
            return await self._run(api.upload(self.url, parcel.parameters, body, wait, progress, name), self.url)

    def options_for(self, url: str, options: ConnectKeywords) -> ConnectOptions:
        """Return the options of a stream."""
        from .stream.options import ConnectOptions

        return ConnectOptions.of(options, self._token_for(url))

    def requests_to(self, url: str) -> Callable[[], httpx.AsyncClient]:
        """Return what returns, on the loop, the client of httpx that makes requests to a URL."""
        # No proxy of the environment comes between two programs on one machine.
        return partial(self._connections, addresses.is_loopback(url))

    def _connections(self, direct: bool) -> httpx.AsyncClient:
        import httpx

        kept = self._kept.setdefault(asyncio.get_running_loop(), {})
        if direct not in kept:
            kept[direct] = httpx.AsyncClient(**calls.client_options(self.url, direct=direct))
        return kept[direct]

    def _token_for(self, url: str) -> str | None:
        return self._token if addresses.same_origin(url, self.url) else None

    async def _run(self, flow: Flow[T], url: str, timeout: float | None = None) -> T:
        """Make the requests of a flow of `requests.api` about a URL, and return its result."""
        import httpx

        token, client = self._token_for(url), self.requests_to(url)()
        answer: Answer | None = None
        failure: LodestreamError | None = None
        while True:
            try:
                step = flow.send(answer) if failure is None else flow.throw(failure)
            except StopIteration as end:
                result: T = end.value
                return result
            if isinstance(step, calls.Pause):
                await asyncio.sleep(step.seconds)
                answer, failure = None, None
                continue
            if isinstance(step, calls.Aside):
                await asyncio.to_thread(step.work)
                answer, failure = None, None
                continue
            content = _chunks(step.body) if step.body is not None and len(step.body.files) == 1 else None
            request = calls.request_options(step, url, token)
            if timeout is not None:
                request["timeout"] = timeout
            try:
                async with client.stream(content=content, **request) as response:
                    incoming = Incoming(Head.of(response), step.most, step.url, url, token)
                    if not (step.partial and response.status_code == 200):
                        async for chunk in response.aiter_raw():
                            if not incoming.take(chunk):
                                break
                answer, failure = incoming.answer(), None
            except httpx.HTTPError as error:
                failure = problems.from_connection(error, url)
                failure.__cause__ = error


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


async def _chunks(body: Body) -> AsyncIterator[bytes]:
    chunks: Iterator[bytes] = body.chunks()
    while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
        yield chunk
