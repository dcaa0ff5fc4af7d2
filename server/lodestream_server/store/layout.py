"""Where the server's data are in a store, and the small objects that say what there is.

::

    lodestream.json               version of this layout and identity of the data; created once
    uploads/<sha256>/<n>          the files of an upload, written once
    surfaces/<id>.json            the manifest; created if absent: it *is* the surface
    containers/<sha256>.lode      written once
    built/<id>.json               what became of the build: a container, or the reason of a final failure
    names/<name>.json             a name that stays: the surface that it leads to, and those that it led to of late

and, where several servers share a bucket, what they tell each other, none of which is the truth about a surface::

    writer.json                   the lease: which server writes
    changes.json                  what has changed of late
    tokens.json                   the hashes of tokens, see `access.tokens`; in a folder a file beside the store

Bytes come first, then the small object that refers to them; a delete goes the other way. What no small object refers to
is a *stray*: it is of no harm, and of no use after a day. A start moves and deletes nothing.

Each small object holds the id of its own write, which tells it from that of another writer (`lodestream.stores`). An
object ``built`` names the write of its manifest: after a delete and another upload of the same bytes it belongs to
nobody, and counts as absent. The last value of a small object is a checksum of what is before it: no other checksum
covers, say, the name of an owner.
"""

from __future__ import annotations

import json
import re
import secrets
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from lodestream.errors import InputError, LodestreamError
from lodestream.series import SERIES, place_of
from lodestream.stores import DeniedError, OversizedError, Store, Tag
from lodestream.stores.keys import is_key

__all__ = [
    "BUILT",
    "CHANGES",
    "CONTAINERS",
    "IDENTITY",
    "LONGEST_NAME",
    "MOST_CHANGES",
    "MOST_REASON",
    "MOST_TEXT",
    "NAME",
    "NAMES",
    "SURFACES",
    "UPLOADS",
    "WRITER",
    "Built",
    "Changes",
    "DamagedObjectError",
    "Identity",
    "Manifest",
    "Name",
    "Summary",
    "Writer",
    "built_key",
    "check_text",
    "container_key",
    "describe",
    "dump",
    "id_of",
    "kept_back",
    "manifest_key",
    "name_key",
    "name_of",
    "new_write",
    "parse",
    "read",
    "read_if",
    "sha256_of",
    "upload_key",
]

IDENTITY = "lodestream.json"
UPLOADS, SURFACES, CONTAINERS, BUILT, NAMES = "uploads/", "surfaces/", "containers/", "built/", "names/"

WRITER, CHANGES = "writer.json", "changes.json"

#: Changes of which it is told what has changed.
MOST_CHANGES = 1000

#: Bytes of text that a surface may have: its name, names of files and options; and the reason of a failure.
MOST_TEXT, MOST_REASON = 3072, 1024

VERSION = 1

#: A name that stays; and none that Windows keeps for itself.
NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}"

#: Characters of the name of a surface; every page of a list has it.
LONGEST_NAME = 255

# Of a description, what a list shows too.
_SHOWN = ("shape", "closed", "bytes")
_INFO = b', "info":\n'
_ID = re.compile(r"(?:surfaces|built)/([0-9a-f]{20})\.json")
_BYTES = re.compile(r"uploads/([0-9a-f]{64})/(?:0|[1-9][0-9]*)|containers/([0-9a-f]{64})\.lode")
_CHECK = re.compile(rb', "check": "([0-9a-f]{8})"\}\Z')
T = TypeVar("T")


class DamagedObjectError(LodestreamError):
    """A small object of the store cannot be read."""


@dataclass(frozen=True)
class Identity:
    """Version and identity of the data of a server."""

    version: int
    identity: str


@dataclass(frozen=True)
class Manifest:
    """What was uploaded.

    Attributes
    ----------
    id : str
        20 hexadecimal digits, made of the bytes and options of the upload, its name and its owner.
    name : str or None
    owner : str or None
        Name of the token that it was uploaded with; None without one.
    created : float
        Seconds since 1970.
    filenames : tuple of str
        Names of the uploaded files.
    options : mapping of str to str
        ``precision`` or ``rms``, ``precision=NAME`` of attributes, ``closed``, options of the format.
    upload : str
        SHA-256 over the files and their lengths.
    upload_bytes : int
    write : str
        Id of this write.

    Raises
    ------
    InputError
        If its texts are longer than `MOST_TEXT`.
    """

    id: str
    name: str | None
    owner: str | None
    created: float
    filenames: tuple[str, ...]
    options: dict[str, str]
    upload: str
    upload_bytes: int
    write: str

    def __post_init__(self) -> None:
        check_text(self.name, self.filenames, self.options)


def check_text(name: str | None, filenames: Sequence[str], options: Mapping[str, str]) -> None:
    """Check the length of the texts of a surface; InputError is raised if it is more than `MOST_TEXT`."""
    length = len(json.dumps([name, filenames, options], ensure_ascii=False).encode())
    if length > MOST_TEXT:
        raise InputError(
            f"Names and options of a surface may have {MOST_TEXT} bytes, and these have {length}: shorter names of "
            "files, or fewer files, will do"
        )


@dataclass(frozen=True)
class Summary:
    """What a list says of a container, and what requests need to know before it is opened.

    Attributes
    ----------
    name : str or None
        The name in its metadata, of at most `LONGEST_NAME` characters.
    levels : int
    shown : mapping
        ``shape``, ``closed``, ``bytes`` of the description, and the place in a series.
    thumbnail : str or None
        A PNG in Base64; None: there is nothing to be seen, or an earlier version has built the surface.
    """

    name: str | None = None
    levels: int = 0
    shown: dict[str, Any] = field(default_factory=dict)
    thumbnail: str | None = field(repr=False, default=None)


@dataclass(frozen=True)
class Built:
    """What became of the build of a surface.

    Attributes
    ----------
    manifest : str
        Id of the write of its manifest.
    container : str or None
        SHA-256 of the container; None if the build failed for good.
    container_bytes : int
    reason : str or None
        Why it failed for good, in one line.
    write : str
        Id of this write.
    summary : Summary
    info : bytes
        The description: what ``lodestream info --json`` prints of the container, as JSON; of a failed build
        ``choices``, if the files have several surfaces. It is sent as it is.
    """

    manifest: str
    container: str | None
    container_bytes: int
    reason: str | None
    write: str
    summary: Summary = field(default_factory=Summary)
    info: bytes = field(repr=False, default=b"")


@dataclass(frozen=True)
class Name:
    """A name that stays while the surface behind it changes.

    Attributes
    ----------
    name : str
    owner : str or None
        Name of the token that it was made with; None without one.
    surface : str
        Id of the surface that it leads to.
    changed : float
        When it last came to lead to another surface, in seconds since 1970.
    replaced : tuple of (str, float)
        Ids of surfaces that it led to, oldest first, and from when on each may be deleted, in seconds since 1970.
    write : str
        Id of this write.

    Raises
    ------
    InputError
        If it cannot be a name.
    """

    name: str
    owner: str | None
    surface: str
    changed: float
    replaced: tuple[tuple[str, float], ...]
    write: str

    def __post_init__(self) -> None:
        name_key(self.name)


@dataclass(frozen=True)
class Writer:
    """Which server writes to a bucket.

    Attributes
    ----------
    holder : str or None
        Id that a server has given itself; None: it was given up.
    name : str
        Of its machine and process, for people.
    number : int
        How often the lease has been taken.
    seconds : float
        How long it lasts after this write.
    write : str
        Id of this write.
    """

    holder: str | None
    name: str
    number: int
    seconds: float
    write: str


@dataclass(frozen=True)
class Changes:
    """What has changed of late.

    Attributes
    ----------
    series : str
        Changes of another series are counted anew: nothing is known of what was between the two.
    number : int
        Of the last change.
    what : tuple of str
        The last changes, at most `MOST_CHANGES`, oldest first: ids of surfaces, and keys of names.
    write : str
        Id of this write.
    """

    series: str
    number: int
    what: tuple[str, ...]
    write: str


def new_write() -> str:
    """Return the id of a new write."""
    return secrets.token_hex(16)


def upload_key(sha256: str, number: int) -> str:
    """Return the key of a file of an upload."""
    return f"{UPLOADS}{sha256}/{number}"


def manifest_key(surface: str) -> str:
    """Return the key of the manifest of a surface."""
    return f"{SURFACES}{surface}.json"


def built_key(surface: str) -> str:
    """Return the key of what became of the build of a surface."""
    return f"{BUILT}{surface}.json"


def container_key(sha256: str) -> str:
    """Return the key of a container."""
    return f"{CONTAINERS}{sha256}.lode"


def name_key(name: str) -> str:
    """Return the key of a name.

    Raises
    ------
    InputError
        If it cannot be a name.
    """
    key = f"{NAMES}{name}.json"
    if not re.fullmatch(NAME, name) or not is_key(key):
        raise InputError(
            f"{name[:100]!a} cannot be a name: one has at most 100 letters, digits and ._-, begins with a letter or a "
            "digit, and is none that Windows keeps for itself, such as con"
        )
    return key


def name_of(key: str) -> str | None:
    """Return the name that has a key; None of another key."""
    name = key.removeprefix(NAMES).removesuffix(".json")
    return name if f"{NAMES}{name}.json" == key and re.fullmatch(NAME, name) else None


def id_of(key: str) -> str | None:
    """Return the id of the surface to which a manifest or a ``built`` belongs; None of another key."""
    found = _ID.fullmatch(key)
    return None if found is None else found[1]


def sha256_of(key: str) -> str | None:
    """Return the hash by which a container, or the upload of a file, is called; None of another key."""
    found = _BYTES.fullmatch(key)
    return None if found is None else found[1] or found[2]


def describe(info: dict[str, Any], thumbnail: str | None = None) -> tuple[bytes, Summary]:
    """Return a description as JSON, and its summary, with a thumbnail that no description tells.

    Raises
    ------
    ValueError
        If JSON cannot express a value.
    """
    metadata = info.get("metadata") or {}
    name = metadata.get("name")
    shown: dict[str, Any] = {key: info[key] for key in _SHOWN if key in info}
    place = place_of(metadata)
    if place is not None:
        shown[SERIES] = place.told()
    title = name[:LONGEST_NAME] if isinstance(name, str) and name else None
    summary = Summary(title, len(info["levels"]), shown, thumbnail)
    return json.dumps(info | shown, ensure_ascii=False, allow_nan=False).encode(), summary


@cache
def _adapters() -> dict[type[Any], TypeAdapter[Any]]:
    return {kind: TypeAdapter(kind) for kind in (Identity, Manifest, Built, Name, Writer, Changes)}


def dump(small: Identity | Manifest | Built | Name | Writer | Changes) -> bytes:
    """Return a small object as bytes. The description in a ``built`` is JSON, and stands on a line of its own.

    Raises
    ------
    ValueError
        If JSON cannot express a value.
    """
    values = asdict(small)
    info = values.pop("info", b"")
    body = json.dumps(values, ensure_ascii=False, allow_nan=False).encode()[:-1]
    if info:
        body += _INFO + info + b"\n"
    return body + b', "check": "%08x"}' % zlib.crc32(body)


def read(store: Store, key: str) -> tuple[bytes, Tag]:
    """Read the bytes of a small object, and its tag; of one that is too large to be one none, so that `parse` tells it.

    Raises
    ------
    AbsentError
        If there is none.
    StoreError
        If the store cannot be read.
    """
    try:
        return store.get(key)
    except OversizedError as error:
        return b"", error.tag


def read_if(store: Store, key: str, tag: Tag | None) -> tuple[bytes, Tag] | None:
    """Read the same unless it is still the object that was read with a tag: then return None."""
    try:
        return store.get_if(key, tag)
    except OversizedError as error:
        return b"", error.tag


def kept_back(store: Store, error: DeniedError) -> DamagedObjectError:
    """Return what is wrong with an object that the store does not give, though it gives others.

    Raises
    ------
    StoreError
        If it gives none: then this says nothing about the object.
    """
    store.get(IDENTITY)
    return DamagedObjectError(str(error))


def parse(kind: type[T], key: str, data: bytes) -> T:
    """Read a small object; what later versions add is ignored.

    Raises
    ------
    DamagedObjectError
        If it is none of this kind, its checksum is wrong, or it is that of another surface or name; in one line.
    """
    check = _CHECK.search(data)
    if check is None or int(check[1], 16) != zlib.crc32(data[: check.start()]):
        raise DamagedObjectError(f"{key} cannot be read: expected a small object with its checksum, got other bytes")
    head, _, info = data[: check.start()].partition(_INFO)
    try:
        small: T = _adapters()[kind].validate_json(head + b"}")
    except (ValidationError, InputError) as error:
        words = str(error)
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False, include_input=False)[0]
            words = f"{'.'.join(map(str, first['loc'])) or 'object'}: {first['msg']}"
        raise DamagedObjectError(f"{key} cannot be read: {words}") from None
    if isinstance(small, Manifest) and manifest_key(small.id) != key:
        raise DamagedObjectError(f"{key} holds the surface {small.id[:80]!a}")
    if isinstance(small, Name) and name_key(small.name) != key:
        raise DamagedObjectError(f"{key} holds the name {small.name}")
    return replace(small, info=info.removesuffix(b"\n")) if isinstance(small, Built) else small
