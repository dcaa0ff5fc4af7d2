"""HTTP requests to a server, without I/O.

Each function here is a generator. It yields a `Call` and is sent the answer, or yields a `Pause` and is resumed after
it; its return value is the result. `AsyncClient` carries them out.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias

from lodestream.errors import (
    CorruptStreamError,
    LodestreamError,
    NotFoundError,
    OptionError,
    RemoteError,
    RemoteProtocolError,
)
from lodestream.target import Target

from . import addresses, problems, resuming
from .answers import LONGEST_ANSWER, Answer, check_figures, parse
from .bodies import Body
from .calls import Aside, Call, Flow
from .states import ENDS, STATES

__all__ = [
    "Description",
    "Identity",
    "Progress",
    "delete",
    "describe",
    "describe_file",
    "fetch_range",
    "formats_read",
    "identify",
    "identity_of_file",
    "list_names",
    "list_surfaces",
    "locate",
    "name_to_change",
    "published_surfaces",
    "retry",
    "upload",
]

#: Called as ``progress(stage, fraction)``; the stages are ``encoding``, ``sending`` and ``building``.
Progress: TypeAlias = Callable[[str, float], None]

# For how many seconds the server may wait for the end of a build before it answers: less where progress is shown.
_WAIT, _WAIT_WITH_PROGRESS = "20", "1"

# What a container is called becomes the name of a file.
_CONTAINER = re.compile(r"[0-9a-f]{64}")
_TAG = re.compile('"([0-9a-f]{64})"')
_LENGTH = re.compile(r"[0-9]{1,18}")
_LARGEST_FILE = 2**62

# Of all the pages of a list together.
_LONGEST_LIST = 64 * 1024 * 1024
_MOST_PAGES = 10_000

# Of a published page, in an error.
_NAMES_TOLD = 20

_MOVED = (301, 302, 303, 307, 308)


@dataclass(frozen=True)
class Identity:
    """Identifies a container, so that stored data of it can be found again.

    Attributes
    ----------
    name : str or None
        A name in hexadecimal digits; None if the server does not distinguish versions of the file.
    container_sha256 : str or None
        SHA-256 of the container, if the server gives it.
    size : int or None
        Bytes of the container.

    Examples
    --------
    >>> from lodestream_client import Client
    >>> client = Client("http://127.0.0.1:8000")
    >>> identity = client.identify(client.upload("terrain.npy").id)
    >>> identity.name == identity.container_sha256, identity.size > 6000
    (True, True)
    """

    name: str | None
    container_sha256: str | None
    size: int | None


@dataclass(frozen=True)
class Description:
    """A server's description of one surface.

    Attributes
    ----------
    url : str
        The surface's URL.
    id : str
        Id of the surface on its server, as `Client.connect` and `Client.delete` take it.
    state : str
        ``queued``, ``building``, ``ready``; ``failed``: the reader rejected the file; ``waiting``: it could not be
        built for a reason on the server. For the last two see `retry`.
    details : mapping
        The complete description, by the server's keys: build progress, or what ``info --json`` prints.

    Examples
    --------
    >>> from lodestream_client import Client
    >>> description = Client("http://127.0.0.1:8000").upload("terrain.npy")
    >>> description.ready, description.details["shape"]
    (True, [97, 70])
    """

    url: str
    id: str
    state: str
    details: Mapping[str, Any] = field(repr=False)

    @property
    def ready(self) -> bool:
        """Whether the surface can be streamed."""
        return self.state == "ready"


def name_to_change(url: str, name: str | None, *, replace: bool, wait: bool) -> str | None:
    """Return the URL of the name that an upload is to make lead to its surface; None if it is to change none.

    Raises
    ------
    OptionError
        If there is no name, it cannot be one that stays, or nobody waits until the surface is ready.
    """
    if not replace:
        return None
    if name is None or not wait:
        raise OptionError("expected a name, and to wait until the surface is ready, with replace")
    return addresses.name_url(url, name)


def upload(
    url: str,
    parameters: Mapping[str, str | list[str]],
    body: Body,
    wait: bool,
    progress: Progress | None,
    name: str | None = None,
) -> Flow[Description]:
    """Send files, and wait until their surface is ready; then make the name with the URL `name` lead to it.

    Whether the caller may do that is asked before, since an upload that no name leads to takes room on the server.
    """
    if name is not None:
        _refuse((yield Call("PUT", name, json={"surface": None})), name)
    surface = yield from _sent(url, parameters, body)
    surface = yield from _followed(surface, wait, progress)
    if name is not None:
        try:
            _refuse((yield Call("PUT", name, json={"surface": surface.id})), name)
        except LodestreamError as error:
            error.args = (f"{error}; the surface is stored, as {surface.url}", *error.args[1:])
            raise
    return surface


def _sent(url: str, parameters: Mapping[str, str | list[str]], body: Body) -> Flow[Description]:
    """Send files: a large one so that it goes on after a lost connection, and a small one so if it has lost one."""
    named, alone = _named(parameters, body), len(body.files) == 1
    if alone and body.size >= resuming.LEAST and (surface := (yield from _in_parts(url, named, body))) is not None:
        return surface
    collection = addresses.surfaces_url(url)
    try:
        answer = yield Call("POST", collection, named, body=body)
    except LodestreamError as error:
        lost = problems.passes(error) and not isinstance(error, RemoteError)
        if not lost or not alone or body.left == body.size or body.size >= resuming.LEAST:
            raise
        # Or it was refused: a server may cut such a connection before its answer is read. What begins an upload has no
        # body, so that it is told then.
        body.go_to(0)
        surface = yield from _in_parts(url, named, body)
        if surface is None:
            raise
        return surface
    return _described(_checked(answer, collection), _location(answer, collection))


def _in_parts(url: str, named: Mapping[str, str | list[str]], body: Body) -> Flow[Description | None]:
    """Send the one file so that it goes on after a lost connection; return None where the server cannot do that."""
    yield Aside(body.hash)
    uploads = addresses.uploads_url(url)
    begin = partial(_begun, uploads, named, body)
    address = yield from begin()
    if address is None:
        return None
    surface = yield from resuming.completed(uploads, address, body, begin)
    return _described(_checked((yield from resuming.answered(surface)), surface), surface)


def _begun(uploads: str, named: Mapping[str, str | list[str]], body: Body) -> Flow[str | None]:
    """Begin an upload in parts, and return its address; None if the server knows no such uploads."""
    answer = yield Call("POST", uploads, named, headers=resuming.beginning(body))
    return None if answer is None or resuming.is_absent(answer) else _location(answer, uploads)


def formats_read(url: str) -> Flow[frozenset[str] | None]:
    """Return the formats that a server reads; None if it does not tell, and then refuses the upload if it must."""
    # Not of another server: the upload that this is for follows no redirect either.
    answer = yield Call("GET", addresses.formats_url(url), redirected=False)
    if answer is None or answer.status != 200:
        return None
    try:
        names = parse(answer.content).get("formats")
    except ValueError:
        return None
    return frozenset(map(str, names)) if isinstance(names, list) else None


def retry(url: str, wait: bool, progress: Progress | None) -> Flow[Description]:
    """Ask for another build of a surface, and wait until it is ready."""
    address = addresses.surface_url(url)
    answer = yield Call("POST", f"{address}/retry")
    surface = _described(_checked(answer, address), address)
    return (yield from _followed(surface, wait, progress))


def _followed(surface: Description, wait: bool, progress: Progress | None) -> Flow[Description]:
    """Wait until a surface is ready, or will not become ready by itself."""
    seconds = {"wait": _WAIT if progress is None else _WAIT_WITH_PROGRESS}
    while wait and not surface.ready:
        if surface.state in ENDS:
            reason = str(_reason(surface.details))
            if surface.state != "failed":
                reason = f"{surface.url} is {surface.state}: {reason}"
            raise RemoteError(surface.state, reason)
        if progress is not None:
            progress("building", _fraction(surface.details))
        answer = yield from resuming.answered(surface.url, seconds)
        surface = _described(_checked(answer, surface.url), surface.url)
    return surface


def _named(parameters: Mapping[str, str | list[str]], body: Body) -> Mapping[str, str | list[str]]:
    # A form names its files itself; a raw body has no other place for the name than the query.
    name = body.files[0][0] if len(body.files) == 1 else ""
    return {**parameters, "filename": name} if name else parameters


def list_surfaces(url: str) -> Flow[tuple[Description, ...]]:
    """Return all surfaces of a server, page by page.

    Raises
    ------
    RemoteProtocolError
        If there are too many pages, one of another server, or one that is no list.
    """
    entries = yield from _listed(url, addresses.surfaces_url(url), "surfaces")
    return tuple(_described(entry, _own_address(entry, page)) for entry, page in entries)


def list_names(url: str) -> Flow[tuple[Mapping[str, Any], ...]]:
    """Return what a server tells of all its names, page by page; addresses are complete.

    Raises
    ------
    RemoteProtocolError
        If there are too many pages, one of another server, or one that is no list of names.
    """
    entries = yield from _listed(url, addresses.names_url(url), "names")
    return tuple(_named_entry(entry, page) for entry, page in entries)


def _listed(url: str, first: str, what: str) -> Flow[list[tuple[Mapping[str, Any], str]]]:
    """Return the entries of a list of a server, each with the URL of the page that it stands on."""
    page: str | None = first
    found: list[tuple[Mapping[str, Any], str]] = []
    seen = set[str]()
    left = _LONGEST_LIST
    while page is not None and page not in seen:
        seen.add(page)
        if len(seen) > _MOST_PAGES or not addresses.same_origin(page, url):
            raise RemoteProtocolError(f"expected at most {_MOST_PAGES} pages of {addresses.origin(url)}, got {page}")
        answer = yield Call("GET", page, most=min(left, LONGEST_ANSWER))
        document = _checked(answer, page)
        left -= len(answer.content) if answer is not None else 0
        entries = document.get(what)
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise RemoteProtocolError(f"expected a list of {what} from {page}, got something else")
        found += [(entry, page) for entry in entries]
        following = document.get("next")
        page = addresses.resolved(page, following) if isinstance(following, str) and following else None
    return found


def _named_entry(entry: Mapping[str, Any], page: str) -> Mapping[str, Any]:
    """Return what a list tells of a name, with the complete addresses of it and of the surface to which it leads."""
    name, url, surface = (entry.get(key) for key in ("name", "url", "surface"))
    if not isinstance(name, str) or not isinstance(url, str) or not isinstance(surface, str | None):
        raise RemoteProtocolError(f"expected a name and where it leads from {page}, got {dict(entry)!a:.200}")
    leads = None if surface is None else addresses.resolved(page, surface)
    return {**entry, "url": addresses.resolved(page, url), "surface": leads}


def describe(url: str) -> Flow[Description]:
    """Return the state and the description of one surface, or of the one to which a name leads now."""
    address = addresses.served_url(url)
    document = _checked((yield Call("GET", address)), address)
    if not addresses.is_surface(address):
        address = _own_address(document, address)
        if not addresses.is_surface(address) or not addresses.same_origin(address, url):
            raise RemoteProtocolError(f"expected a surface on {addresses.origin(url)}, got {address!a:.300}")
    return _described(document, address)


def describe_file(url: str, max_vertices: int | None = None) -> Flow[Mapping[str, Any]]:
    """Return the description of a container file on any web server."""
    from lodestream.container import describe
    from lodestream.transfer.range_download import RangeDownload
    from lodestream.transfer.receiver_state import ReceiverState

    url = yield from locate(url)
    # Of the coarsest level nothing needs to come before the index.
    reception = ReceiverState(Target(level=0), max_vertices=max_vertices)
    download = RangeDownload(reception)
    while reception.index is None:
        request, _ = download.request()
        if request is not None and reception.index is None:
            call = Call("GET", url, headers=request.headers, partial=True, most=request.length)
            answer = _refuse((yield call), url)
            download.answer(answer.status, answer.headers)
            download.receive(answer.content)
            download.finish()
    return describe(reception.index, channels=True)


def identify(url: str) -> Flow[Identity]:
    """Return the identity of a surface's container, or of a file.

    Raises
    ------
    RemoteError
        With the code ``not-ready`` if the surface cannot be streamed now.
    RemoteProtocolError
        If the server does not tell the container's SHA-256 and size.
    """
    url = yield from locate(url)
    if addresses.is_surface(url):
        surface = yield from describe(url)
        container, size = surface.details.get("container_sha256"), surface.details.get("bytes")
        if not surface.ready or not isinstance(container, str) or not isinstance(size, int):
            raise RemoteError("not-ready", f"expected {url} to be ready, got {surface.state}")
        if not _CONTAINER.fullmatch(container) or size is True or not 0 < size <= _LARGEST_FILE:
            raise RemoteProtocolError(
                f"expected the SHA-256 and size of a container from {url}, got {container!a:.80} and {size!r:.80}"
            )
        return Identity(container, container, size)
    answer = _refuse((yield Call("HEAD", url, headers={"Accept-Encoding": "identity"})), url)
    version = answer.headers.get("etag") or answer.headers.get("last-modified")
    length = answer.headers.get("content-length", "")
    return identity_of_file(url, version, int(length) if _LENGTH.fullmatch(length) else None)


def identity_of_file(url: str, version: str | None, size: int | None) -> Identity:
    """Return the identity of a container file; `version` is its entity tag or date."""
    if version is None or size is None:
        return Identity(None, None, None)
    return Identity(hashlib.sha256(f"{url}\n{version}\n{size}".encode()).hexdigest(), None, size)


def locate(url: str) -> Flow[str]:
    """Return the URL of the surface or container to which a name leads now; any other URL as it is.

    Raises
    ------
    NotFoundError
        If there is no such page or server, or no such name on it.
    RemoteProtocolError
        If the answer cannot be read, or leads to another host.
    """
    if not addresses.is_named(url):
        return url
    place = addresses.published_name(url)
    if place is None:
        return (yield from describe(url)).url
    page, name = place
    surfaces = yield from published_surfaces(url)
    entry = next((entry for entry in surfaces if entry["name"] == name), None)
    if entry is None:
        names = ", ".join(f"{entry['name']!a:.100}" for entry in surfaces[:_NAMES_TOLD])
        raise NotFoundError(f"expected a name that is published at {page}, got {name!a:.300}; there are: {names}")
    container = addresses.resolved(page, entry["src"])
    if not addresses.same_origin(container, page) or "#" in container:
        raise RemoteProtocolError(f"expected a container on {addresses.origin(page)}, got {container!a:.300}")
    return container


def published_surfaces(url: str) -> Flow[Sequence[Mapping[str, Any]]]:
    """Return the entries of the list of a published page; each has a ``name`` and a ``src``.

    Raises
    ------
    NotFoundError
        If there is no list.
    RemoteProtocolError
        If it cannot be read.
    """
    page, _ = addresses.published_name(url) or (addresses.resolved(url, "view.json"), "")
    document = _checked((yield Call("GET", page)), page)
    surfaces = document.get("surfaces")
    if not isinstance(surfaces, list) or not all(map(_is_entry, surfaces)):
        raise RemoteProtocolError(f"expected the surfaces of a published page from {page}, got something else")
    return surfaces


def _is_entry(entry: Any) -> bool:
    return isinstance(entry, dict) and all(isinstance(entry.get(key), str) for key in ("name", "src"))


def delete(url: str) -> Flow[None]:
    """Delete one surface from its server, or a name."""
    address = addresses.served_url(url)
    answer = yield Call("DELETE", address)
    _refuse(answer, address)


def fetch_range(url: str, offset: int, length: int, identity: Identity | None = None) -> Flow[bytes]:
    """Return the bytes ``offset`` to ``offset + length`` of a surface's container, or of a container file.

    With an identity, the answer must be of the same container, as far as it tells.

    Raises
    ------
    RemoteError
        With the code ``other-container`` if there is another one now.
    RemoteProtocolError
        If the server does not support Range.
    CorruptStreamError
        If there are fewer bytes.
    """
    address = addresses.container_url((yield from locate(url)))
    headers = {"Range": f"bytes={offset}-{offset + length - 1}", "Accept-Encoding": "identity"}
    response = _refuse((yield Call("GET", address, headers=headers, partial=True, most=length)), address)
    if response.status != 206:
        raise RemoteProtocolError(
            f"expected a range of the container from {address}, got all of it: Range is not supported"
        )
    if identity is not None and not _is_of(response, url, identity):
        raise RemoteError("other-container", f"expected the container that {url} had before, got another")
    if len(response.content) != length:
        raise CorruptStreamError(f"expected {length} bytes of the container, got {len(response.content)}", offset)
    return response.content


def _is_of(answer: Answer, url: str, identity: Identity) -> bool:
    """Return whether a part of a file belongs to the container with this identity."""
    version = answer.headers.get("etag") or answer.headers.get("last-modified")
    size = answer.headers.get("content-range", "").rpartition("/")[2]
    if _LENGTH.fullmatch(size) and int(size) != identity.size:
        return False
    if version is None:
        return True
    if identity.container_sha256 is None:
        return identity_of_file(url, version, identity.size) == identity
    tag = _TAG.fullmatch(version)  # a proxy may have put its own in the place of the server's
    return tag is None or tag[1] == identity.container_sha256


def _refuse(answer: Answer | None, url: str) -> Answer:
    if answer is None:
        raise AssertionError("a call was resumed without its answer")
    if answer.status in _MOVED and (location := answer.headers.get("location")):
        place = addresses.counterpart(url, url, addresses.resolved(url, location))
        raise RemoteProtocolError(
            f"{url} redirects a request that changes something, which is not followed; use {place}"
        )
    if not 200 <= answer.status < 300:
        error = problems.from_response(answer.status, answer.reason, answer.content, url)
        error.args = (f"{error}{answer.withheld}", *error.args[1:])
        raise error
    return answer


def _checked(answer: Answer | None, url: str) -> Mapping[str, Any]:
    response = _refuse(answer, url)
    try:
        return parse(response.content)
    except ValueError:
        kind = response.headers.get("content-type", "nothing")
    raise RemoteProtocolError(f"expected a JSON object from {url}, got {kind}: is this a Lodestream server?")


def _location(answer: Answer | None, collection: str) -> str:
    response = _refuse(answer, collection)
    location = response.headers.get("location", "")
    if not location:
        raise RemoteProtocolError(f"expected the new surface's Location from {collection}, got none")
    return addresses.made_url(collection, location)


def _own_address(entry: Mapping[str, Any], page: str) -> str:
    location = entry.get("url") or f"{page.partition('?')[0]}/{entry.get('id')}"
    return addresses.resolved(page, str(location))


def _described(document: Mapping[str, Any], url: str) -> Description:
    state, name = document.get("state"), document.get("id")
    if state not in STATES or not isinstance(name, str):
        raise RemoteProtocolError(
            f"expected a surface's id and state from {url}, got id {name!a:.80} and state {state!a:.80}"
        )
    check_figures(document, url)
    return Description(url, name, state, document)


def _reason(details: Mapping[str, Any]) -> object:
    return details.get("reason") or "the surface could not be built, and the server does not say why"


def _fraction(details: Mapping[str, Any]) -> float:
    progress = details.get("progress")
    return float(progress) if isinstance(progress, int | float) else 0.0
