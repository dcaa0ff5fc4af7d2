"""Streams and surfaces of a server, for programs without an event loop.

The names are those of `lodestream_client`; here the functions block.

Examples
--------
>>> with connect("http://localhost:8000/v1/surfaces/0123456789abcdef0123") as stream:  # doctest: +SKIP
...     for view in stream:
...         print(view.bytes, view.rms)
...     print(stream.ended)
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

from lodestream.target import Tolerance

from .requests import api, calls, problems
from .requests.answers import Answer, Head, Incoming
from .requests.api import Description, Identity, Progress
from .requests.bodies import Asked, Closure, Source, are_files, check_asked, opened, prepared
from .requests.calls import Flow
from .stream.options import ConnectKeywords, ConnectOptions
from .stream.sync_stream import Stream

if TYPE_CHECKING:
    import httpx

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
    "list",
    "list_names",
    "list_surfaces",
    "locate",
    "retry",
    "upload",
]

T = TypeVar("T")


def connect(url: str, **options: Unpack[ConnectKeywords]) -> Stream:
    """Receive a surface.

    If the connection breaks, the stream reconnects by itself; data that have arrived are not sent again.

    Parameters
    ----------
    url : str
        URL of the surface, ``http(s)://HOST/v1/surfaces/ID``; of a name that leads to one,
        ``http(s)://HOST/v1/names/NAME``; or of a container file on any web server.
    **options
        The following, by keyword; see `ConnectOptions`.
    target : Target or None
        What to receive, where to stop, and in which order; None: the whole surface.
    token : str or None
        Token, if the server needs one.
    transport : "auto", "ws" or "http", default "auto"
        WebSocket, or HTTP Range requests; ``auto``: WebSocket, or HTTP Range if WebSockets do not get through.
    silence : float, default 30
        Seconds without data after which a connection counts as lost. If it is not replaced, `SilenceError` is raised.
    deadline : float, default 60
        Seconds without data for which the client tries to reconnect before it raises the error; 0: never reconnect.
    close_timeout : float, default 5
        Seconds that closing may take.
    limit_rate : float or None
        Receive at most so many bytes a second.
    window : int or None
        Bytes that may be in flight, and that may still arrive after `Stream.stop`. None: as `limit_rate` needs, or as
        measured.
    store : Store or None
        Storage for received data; data that it has are not requested.
    container, size : str or None, int or None
        SHA-256 and size of the container whose data the store has.
    progress : callable or None
        Called as ``progress(received, planned)`` with bytes of the surface, whenever data arrive; ``planned`` is None
        until it is known.
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
    TooLargeError
        If the surface needs more memory than allowed.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> with sync.connect(url, target=lodestream.Target(level=3)) as stream:
    ...     *_, view = stream
    >>> stream.ended, view.points_at(3).shape
    ('level', (7, 6))
    """
    return Stream(url, ConnectOptions(**options))


def upload(
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
    """Upload a surface.

    Parameters
    ----------
    url : str
        URL of the server.
    *sources : str, path, binary file, bytes, Surface or array
        One file, or several that make one surface: each as a name, an open file, or its bytes. Or a surface in memory,
        anything that `lodestream.encode` takes: it is encoded here, and the server keeps the container unchanged. A
        container file is kept unchanged too; no option but a name is allowed for it.
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
    token : str or None
        Token, if the server needs one.
    attribute_precision : mapping of str to Tolerance, float or str, or None
        Maximum error of attributes, by name; the others are lossless.
    filename : str or None
        Name of the first file. Its suffix decides the format if the content does not (``N37W122.hgt``). None: the
        file's own name; an open file and bytes have none.
    nodata : float, str or None
        A value, or "nan", that marks holes in addition to those that the file declares, see `lodestream.read`.
    local : bool
        Encode all files here and send containers. Files of a format that the server does not read are always encoded
        here, with a `FormatWarning`.
    effort : "fast", "default" or "small"
        What the encoding takes, see `lodestream.encode`; values do not depend on it.
    replace : bool
        Once the surface is ready, make the server's name `name` lead to it: ``http(s)://HOST/v1/names/NAME`` stays its
        URL. The server deletes the surface that the name led to before, a set time later.

    Returns
    -------
    Description
        With the surface's URL as ``url``.

    Raises
    ------
    OptionError
        If an option has an invalid value or is not allowed for such a source, both `precision` and `rms` are given, or
        `replace` without `wait` or without a name of at most 100 letters, digits and ``._-``.
    InputError, TooLargeError
        If a source has another type or cannot be encoded, or the server cannot read the file or finds it too large.
    RemoteError
        If the server refuses, or the surface does not become ready. The code is ``failed`` if the file cannot be built,
        and ``waiting`` if the reason is on the server: it keeps the upload, see `retry`.
    UnreachableError
        If there is no connection.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> import lodestream
    >>> sync.upload("http://127.0.0.1:8000", "terrain.npy", name="hills").state
    'ready'
    >>> surface = lodestream.Surface([[1.0, 2.0], [3.0, 4.0]], metadata={"unit": "m"})
    >>> sync.upload("http://127.0.0.1:8000", surface, precision=0.01).details["shape"]
    [2, 2]
    """
    asked = Asked(precision, rms, closed, name, options or {}, attribute_precision or {}, filename, nodata, effort)
    check_asked(asked)
    stays = api.name_to_change(url, name, replace=replace, wait=wait)
    ask = not local and are_files(sources)
    read_there = _run(api.formats_read(url), url, token) if ask else None
    parcel = prepared(sources, asked, progress, read_there, local)
    sent = None if progress is None else (lambda fraction: progress("sending", fraction))
    with opened(parcel, sent) as body:
        return _run(api.upload(url, parcel.parameters, body, wait, progress, stays), url, token)


def retry(url: str, *, wait: bool = True, progress: Progress | None = None, token: str | None = None) -> Description:
    """Ask the server to build a surface again that is waiting or has failed.

    Parameters
    ----------
    url : str
        URL of the surface.
    wait : bool
        Whether to wait until the surface is ready to be streamed.
    progress : callable or None
        Called as ``progress("building", fraction)``.
    token : str or None
        Token, if the server needs one.

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
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> sync.retry(url).state  # nothing to do: it is ready
    'ready'
    """
    return _run(api.retry(url, wait, progress), url, token)


def list_surfaces(url: str, *, token: str | None = None) -> tuple[Description, ...]:
    """Return all surfaces of a server; also exported as ``list``.

    Raises
    ------
    NotFoundError, RemoteError, RemoteProtocolError
        If the server refuses, or is not a Lodestream server.
    UnreachableError
        If there is no connection.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> url in [description.url for description in sync.list("http://127.0.0.1:8000")]
    True
    """
    return _run(api.list_surfaces(url), url, token)


def list_names(url: str, *, token: str | None = None) -> tuple[Mapping[str, Any], ...]:
    """Return all names of a server.

    Each has ``name``, ``url``, ``surface`` (the URL of the surface to which it leads; None: the server cannot read it),
    ``changed`` (when it came to lead there) and, if the server tells it, ``owner``.

    Raises
    ------
    NotFoundError, RemoteError, RemoteProtocolError
        If the server refuses, or is not a Lodestream server.
    UnreachableError
        If there is no connection.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy", name="terrain", replace=True).url
    >>> [it["surface"] == url for it in sync.list_names("http://127.0.0.1:8000") if it["name"] == "terrain"]
    [True]
    """
    return _run(api.list_names(url), url, token)


def describe(url: str, *, token: str | None = None) -> Description:
    """Return the state and the description of one surface, or of the one to which a name of a server leads now.

    Raises
    ------
    NotFoundError, RemoteError, RemoteProtocolError
        If there is no such surface, the server refuses, or is not a Lodestream server.
    UnreachableError
        If there is no connection.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> sync.describe(url).details["shape"]
    [97, 70]
    """
    return _run(api.describe(url), url, token)


def describe_file(url: str, *, token: str | None = None, max_vertices: int | None = None) -> Mapping[str, Any]:
    """Return the description of a container file on any web server, as ``lodestream info --json`` prints it.

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
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> sync.describe_file(f"{url}/container")["shape"]  # or of any web server
    [97, 70]
    """
    return _run(api.describe_file(url, max_vertices), url, token)


def identify(url: str, *, token: str | None = None) -> Identity:
    """Return the identity of a surface's container, or of a container file.

    Raises
    ------
    NotFoundError, RemoteError, RemoteProtocolError
        If there is no such surface or file, or the server refuses; the code ``not-ready``: it cannot be streamed now.
    UnreachableError
        If there is no connection.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> len(sync.identify(url).container_sha256)
    64
    """
    return _run(api.identify(url), url, token)


def locate(url: str, *, token: str | None = None) -> str:
    """Return the URL of the surface or container to which a name leads now; any other URL as it is.

    A name is on a server (``HOST/v1/names/NAME``) or on a published page (``PAGE#NAME``). `connect` does this itself. A
    program that makes several requests makes them of one container this way, whatever the name leads to meanwhile.

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
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> sync.locate(url) == url  # it is no name
    True
    """
    return _run(api.locate(url), url, token)


def delete(url: str, *, token: str | None = None) -> None:
    """Delete a surface from its server; or a name, whose surfaces stay.

    Raises
    ------
    NotFoundError, RemoteError, RemoteProtocolError
        If there is no such surface, or the server refuses.
    UnreachableError
        If there is no connection.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy", name="for a while").url
    >>> sync.delete(url)
    """
    _run(api.delete(url), url, token)


def fetch_range(
    url: str, offset: int, length: int, *, token: str | None = None, timeout: float = calls.TIMEOUT
) -> bytes:
    """Fetch bytes of a surface's container over HTTP.

    Parameters
    ----------
    url : str
        URL of the surface, or of a container file.
    offset, length : int
        The bytes ``offset`` to ``offset + length``.
    token : str or None
        Token, if the server needs one.
    timeout : float
        Seconds for connecting and for each wait.

    Raises
    ------
    NotFoundError, RemoteError, RemoteProtocolError
        If the server refuses, or does not support Range.
    CorruptStreamError
        If there are fewer bytes.
    UnreachableError
        If there is no connection.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> sync.fetch_range(url, 1, 4)
    b'LODE'
    """
    return _run(api.fetch_range(url, offset, length), url, token, timeout)


def _run(flow: Flow[T], url: str, token: str | None, timeout: float = calls.TIMEOUT) -> T:
    import httpx

    with httpx.Client(**calls.client_options(url, timeout)) as client:
        return run(client, flow, url, token)


def run(client: httpx.Client, flow: Flow[T], url: str, token: str | None) -> T:
    """Carry out the calls of a flow of `requests.api` on an existing client, and return the flow's result.

    Raises
    ------
    LodestreamError
        Whatever the flow raises.
    UnreachableError
        If there is no connection.
    """
    import httpx

    answer: Answer | None = None
    failure: LodestreamError | None = None
    while True:
        try:
            step = flow.send(answer) if failure is None else flow.throw(failure)
        except StopIteration as end:
            result: T = end.value
            return result
        if isinstance(step, calls.Pause):
            time.sleep(step.seconds)
            answer = None
            continue
        content = step.body.chunks() if step.body is not None and len(step.body.files) == 1 else None
        try:
            with client.stream(content=content, **calls.request_options(step, url, token)) as response:
                incoming = Incoming(Head.of(response), step.most, step.url, url, token)
                if not (step.partial and response.status_code == 200):
                    for chunk in response.iter_raw():
                        if not incoming.take(chunk):
                            break
            answer = incoming.answer()
        except httpx.HTTPError as error:
            failure = problems.from_connection(error, url)
            failure.__cause__ = error


list = list_surfaces
