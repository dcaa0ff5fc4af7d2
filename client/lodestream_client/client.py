"""The client of a server, for programs without an event loop."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import partial
from queue import SimpleQueue
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

from lodestream.target import Tolerance

from . import loop_thread
from .async_client import AsyncClient
from .requests import api, calls
from .requests.api import Description, Identity, Progress
from .requests.bodies import Asked, Closure, Source, are_files, check_asked, prepared

if TYPE_CHECKING:
    from lodestream.quality import Effort

    from .stream.blocking_stream import Stream
    from .stream.options import ConnectKeywords

__all__ = ["Client"]

T = TypeVar("T")


class Client:
    """A client of a server, which keeps its connections and the token.

    It is a context manager; leaving it closes its connections, as does the garbage collector. Any number of threads may
    use one. It works where an event loop runs, too, as in a notebook, and in a process that was forked: the requests
    are made on a loop in a thread of its own, one for all clients of a process. Whatever is given to be called
    (``progress``, ``sink``) is called in the caller's thread.

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
    >>> from lodestream_client import Client
    >>> with Client("http://127.0.0.1:8000") as client:
    ...     surface = client.upload("terrain.npy")
    ...     with client.connect(surface.id) as stream:
    ...         *_, view = stream
    >>> stream.ended, view.points.shape
    ('complete', (97, 70))
    """

    def __init__(self, url: str, *, token: str | None = None) -> None:
        self._async = AsyncClient(url, token=token)
        self.url = self._async.url
        weakref.finalize(self, loop_thread.release, self._async).atexit = False

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.url!r})"

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections that are kept for further requests. A request opens another one."""
        self._run(self._async.close)
        loop_thread.release(self._async)

    def connect(self, source: str, **options: Unpack[ConnectKeywords]) -> Stream:
        """Receive a surface.

        If the connection breaks, the stream reconnects by itself; data that have arrived are not sent again.

        Parameters
        ----------
        source : str
            Id of a surface; or a URL: of a surface, ``http(s)://HOST/v1/surfaces/ID``; of a name that leads to one,
            ``http(s)://HOST/v1/names/NAME``; or of a container file on any web server.
        **options
            The following, by keyword; see `ConnectOptions`.
        target : Target or None
            What to receive, where to stop, and in which order; None: the whole surface.
        transport : "auto", "ws" or "http", default "auto"
            WebSocket, or HTTP Range requests; ``auto``: WebSocket, or HTTP Range if WebSockets do not get through.
        silence : float, default 30
            Seconds without data after which a connection counts as lost. If it is not replaced, `SilenceError` is
            raised.
        deadline : float, default 60
            Seconds without data for which the client tries to reconnect before it raises the error; 0: never reconnect.
        close_timeout : float, default 5
            Seconds that closing may take.
        limit_rate : float or None
            Receive at most so many bytes a second.
        window : int or None
            Bytes that may be in flight, and that may still arrive after `Stream.stop`. None: as `limit_rate` needs, or
            as measured.
        store : Store or None
            Storage for received data; data that it has are not requested.
        container, size : str or None, int or None
            SHA-256 and size of the container whose data the store has.
        progress : callable or None
            Called as ``progress(received, planned)`` with bytes of the surface, whenever data arrive; ``planned`` is
            None until it is known.
        sink : callable or None
            Called as ``sink(offset, data)`` with new bytes of the container as they arrive, before they are decoded;
            `Stream.identity` identifies the container.
        max_vertices : int or None
            Limit on the memory of the surface, checked with its header before memory is allocated: 128 bytes for each
            vertex, plus 16 MiB. None: what fits the memory available to this process.

        Returns
        -------
        Stream

        Raises
        ------
        UnreachableError
            If there is no connection.
        NotFoundError, RemoteError, RemoteProtocolError
            If the server refuses, or is not a Lodestream server.
        OptionError
            If there is no such option, or its value is not allowed.
        TooLargeError
            If the surface needs more memory than allowed.

        Examples
        --------
        >>> import lodestream, lodestream_client
        >>> client = lodestream_client.Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> with client.connect(surface.id, target=lodestream.Target(level=3)) as stream:
        ...     *_, view = stream
        >>> stream.ended, view.points_at(3).shape
        ('level', (7, 6))
        """
        from .stream.blocking_stream import Stream  # with what decodes: other requests need none of it

        url = self._async.place(source)
        loop_thread.current().hold(self._async)
        return Stream(url, self._async.options_for(url, options), self._async.requests_to(url), self)

    def upload(
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
        """Upload a surface.

        Parameters
        ----------
        *sources : str, path, binary file, bytes, Surface or array
            One file, or several that make one surface: each as a name, an open file, or its bytes. Or a surface in
            memory, anything that `lodestream.encode` takes: it is encoded here, and the server keeps the container
            unchanged. A container file is kept unchanged too; no option but a name is allowed for it.
        precision : Tolerance, float, str or None
            Maximum error of the complete surface; None: lossless.
        rms : Tolerance, float, str or None
            Encode for one root mean square error instead, see `lodestream.encode`; excludes `precision`.
        closed : "auto", "none", "rows", "cols" or "both"
            Closed axes of the grid; auto: as the file or the surface in memory says.
        name : str or None
            Name of the surface.
        options : mapping of str to str or list of str
            Options of the file's format, such as ``{"attributes": ["speed", "kind"]}``.
        wait : bool
            Whether to wait until the surface is ready to be streamed.
        progress : callable or None
            Called as ``progress(stage, fraction)`` with the stages ``remeshing`` and ``encoding`` (if the file
            is encoded here), ``sending`` and ``building``.
        attribute_precision : mapping of str to Tolerance, float or str, or None
            Maximum error of attributes, by name; the others are lossless.
        filename : str or None
            Name of the first file. Its suffix decides the format if the content does not (``N37W122.hgt``). None: the
            file's own name; an open file and bytes have none.
        nodata : float, str or None
            A value, or "nan", that marks holes in addition to those that the file declares, see `lodestream.read`.
        local : bool
            Encode all files here and send containers. Files of a format that the server does not read are always
            encoded here, with a `FormatWarning`.
        effort : "fast", "default" or "small"
            What the encoding takes, see `lodestream.encode`; values do not depend on it.
        replace : bool
            Once the surface is ready, make the server's name `name` lead to it: ``http(s)://HOST/v1/names/NAME`` stays
            its URL. The server deletes the surface that the name led to before, a set time later.

        Returns
        -------
        Description
            With the surface's URL as ``url``.

        Raises
        ------
        OptionError
            If an option has an invalid value or is not allowed for such a source, both `precision` and `rms` are given,
            or `replace` without `wait` or without a name of at most 100 letters, digits and ``._-``.
        InputError, TooLargeError
            If a source has another type or cannot be encoded, or the server cannot read the file or finds it too large.
        RemoteError
            If the server refuses, or the surface does not become ready. The code is ``failed`` if the file cannot be
            built, and ``waiting`` if the reason is on the server: it keeps the upload, see `retry`.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> import lodestream, lodestream_client
        >>> client = lodestream_client.Client("http://127.0.0.1:8000")
        >>> client.upload("terrain.npy", name="hills").state
        'ready'
        >>> surface = lodestream.Surface([[1.0, 2.0], [3.0, 4.0]], metadata={"unit": "m"})
        >>> client.upload(surface, precision=0.01).details["shape"]
        [2, 2]
        """
        asked = Asked(precision, rms, closed, name, options or {}, attribute_precision or {}, filename, nodata, effort)
        check_asked(asked)
        stays = api.name_to_change(self.url, name, replace=replace, wait=wait)
        read_there = self._run(self._async.formats_read) if not local and are_files(sources) else None
        parcel = prepared(sources, asked, progress, read_there, local)
        return self._told(progress, lambda told: self._async.send(parcel, wait, told, stays))

    def retry(self, source: str, *, wait: bool = True, progress: Progress | None = None) -> Description:
        """Ask the server to build a surface again that is waiting or has failed.

        Parameters
        ----------
        source : str
            Id or URL of the surface.
        wait : bool
            Whether to wait until the surface is ready to be streamed.
        progress : callable or None
            Called as ``progress("building", fraction)``.

        Returns
        -------
        Description

        Raises
        ------
        NotFoundError
            If there is no such surface.
        RemoteError
            If the server refuses, or the surface does not become ready: code ``failed`` or ``waiting``.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> client.retry(surface.id).state  # nothing to do: it is ready
        'ready'
        """
        return self._told(progress, lambda told: self._async.retry(source, wait=wait, progress=told))

    def list(self) -> tuple[Description, ...]:
        """Return all surfaces of the server.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If the server refuses, or is not a Lodestream server.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> surface.id in [description.id for description in client.list()]
        True
        """
        return self._run(self._async.list)

    def list_names(self) -> tuple[Mapping[str, Any], ...]:
        """Return all names of the server.

        Each has ``name``, ``url``, ``surface`` (the URL of the surface to which it leads; None: the server cannot read
        it), ``changed`` (when it came to lead there) and, if the server tells it, ``owner``.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If the server refuses, or is not a Lodestream server.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy", name="terrain", replace=True)
        >>> [it["surface"] == surface.url for it in client.list_names() if it["name"] == "terrain"]
        [True]
        """
        return self._run(self._async.list_names)

    def list_published(self, url: str) -> Sequence[Mapping[str, Any]]:
        """Return what ``lodestream publish`` has put on the page at a URL.

        Each has ``name`` and ``src``, the URL of the container, which may be relative to the page's.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If there is no such page, the host refuses, or what it sends is no list.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> page = "https://example.org/surfaces/"
        >>> [surface["name"] for surface in Client(page).list_published(page)]  # doctest: +SKIP
        ['relief', 'tower']
        """
        return self._run(partial(self._async.list_published, url))

    def get(self, source: str) -> Description:
        """Return the state and the description of one surface, or of the one to which a name of a server leads now.

        `source` is the id of a surface, or the URL of a surface or a name.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If there is no such surface, the server refuses, or is not a Lodestream server.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> client.get(surface.id).details["shape"]
        [97, 70]
        """
        return self._run(partial(self._async.get, source))

    def describe_file(self, url: str, *, max_vertices: int | None = None) -> Mapping[str, Any]:
        """Return the description of a container file on any web server, as ``lodestream info --json`` prints it.

        `lodestream.open` gives the same as ``info``, but refuses hosts that do not tell the length and the version
        (``ETag`` or ``Last-Modified``) of a file, whose values might change between two reads. These are taken here.
        `max_vertices` limits the memory of the container's tables, see `connect`.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If the server refuses, or does not support Range.
        CorruptStreamError, TruncatedStreamError, UnsupportedVersionError, TooLargeError
            If the file is not a container that can be read.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> client.describe_file(f"{surface.url}/container")["shape"]  # or of any web server
        [97, 70]
        """
        return self._run(partial(self._async.describe_file, url, max_vertices=max_vertices))

    def identify(self, source: str) -> Identity:
        """Return the identity of a surface's container, or of a container file: by an id or a URL.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If there is no such surface or file, or the server refuses; the code ``not-ready``: it cannot be streamed
            now.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> len(client.identify(surface.id).container_sha256)
        64
        """
        return self._run(partial(self._async.identify, source))

    def locate(self, source: str) -> str:
        """Return the URL of the surface or container to which a name leads now; any other URL as it is.

        A name is on a server (``HOST/v1/names/NAME``) or on a published page (``PAGE#NAME``). `connect` does this
        itself. A program that makes several requests makes them of one container this way, whatever the name leads to
        meanwhile.

        Raises
        ------
        NotFoundError
            If there is no such server or page, or no such name on it.
        RemoteError, RemoteProtocolError
            If the host refuses, or its answer cannot be read.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> client.locate(surface.url) == surface.url  # it is no name
        True
        """
        return self._run(partial(self._async.locate, source))

    def delete(self, source: str) -> None:
        """Delete a surface from its server, by its id or URL; or a name, by its URL, whose surfaces stay.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If there is no such surface, or the server refuses.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy", name="for a while")
        >>> client.delete(surface.id)
        """
        self._run(partial(self._async.delete, source))

    def fetch_range(
        self,
        source: str,
        offset: int,
        length: int,
        *,
        identity: Identity | None = None,
        timeout: float = calls.TIMEOUT,
    ) -> bytes:
        """Fetch bytes of a surface's container over HTTP.

        Parameters
        ----------
        source : str
            Id or URL of the surface, or URL of a container file.
        offset, length : int
            The bytes ``offset`` to ``offset + length``.
        identity : Identity or None
            Of the container that it must still be.
        timeout : float
            Seconds for connecting and for each wait.

        Raises
        ------
        NotFoundError, RemoteError, RemoteProtocolError
            If the server refuses, does not support Range, or has another container: with the code ``other-container``.
        CorruptStreamError
            If there are fewer bytes.
        UnreachableError
            If there is no connection.

        Examples
        --------
        >>> from lodestream_client import Client
        >>> client = Client("http://127.0.0.1:8000")
        >>> surface = client.upload("terrain.npy")
        >>> client.fetch_range(surface.id, 1, 4)
        b'LODE'
        """
        return self._run(partial(self._async.fetch_range, source, offset, length, identity=identity, timeout=timeout))

    def _run(self, work: loop_thread.Work[T], calls: loop_thread.Calls | None = None) -> T:
        loop = loop_thread.current()
        loop.hold(self._async)
        return loop.run(work, calls)

    def _told(self, progress: Progress | None, work: Callable[[Progress | None], Coroutine[Any, Any, T]]) -> T:
        """Carry out work that tells its progress, which is called in this thread."""
        calls: loop_thread.Calls = SimpleQueue()
        told = None if progress is None else loop_thread.relayed(progress, calls)
        return self._run(partial(work, told), calls)
