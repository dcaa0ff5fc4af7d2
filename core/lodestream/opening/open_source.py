"""From what a caller has of a container, a path, an address or its bytes, to its bytes."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, OptionError, UnavailableError

if TYPE_CHECKING:
    from .byte_sources import ByteSource

__all__ = ["GROUP", "is_address", "open_source"]

#: Entry points by scheme (``https``): each is called with an address and a token, and returns a `ByteSource`.
GROUP = "lodestream.sources"

# One letter before a colon is a drive of Windows.
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://", re.ASCII)
_BUCKETS = ("s3", "az", "abfss")
_KNOWN = "a file, or an address that begins with http://, https://, s3://, az:// or abfss://"


def is_address(source: object) -> bool:
    """Return whether what is opened is the address of something on another machine, not a file or bytes."""
    return isinstance(source, str) and _SCHEME.match(source) is not None


def open_source(
    source: str | os.PathLike[str] | bytes | bytearray | memoryview, token: str | None = None
) -> ByteSource:
    """Open the bytes of a container; see `lodestream.open` for the parameters.

    Raises
    ------
    InputError
        If it is something else.
    OptionError
        If there is a token, but no server to which it belongs.
    UnavailableError
        If what reads such addresses is not installed.
    LodestreamError, OSError
        If it cannot be reached or read, or is not there.
    """
    from .byte_sources import FileSource, MemorySource  # commands that open nothing start without it

    if isinstance(source, bytes | bytearray | memoryview):
        _refuse_token(token, "bytes")
        return MemorySource(bytes(source))
    if not isinstance(source, str | os.PathLike):
        raise InputError(f"expected {_KNOWN}, or the bytes of a container, got {type(source).__name__}")
    place = os.fspath(source)
    found = _SCHEME.match(source) if isinstance(source, str) else None
    if found is None:
        if isinstance(source, str) and source.partition(":")[0].lower() in _BUCKETS:
            from ..stores.connections import parsed

            parsed(source)  # refuses it, and says which slash is missing
        _refuse_token(token, place)
        return FileSource(Path(place))
    scheme = found[1].lower()
    if scheme in _BUCKETS:
        from .bucket_source import BucketSource

        _refuse_token(token, f"an address of {scheme}://, whose credentials come from the environment")
        return BucketSource(place)
    from importlib.metadata import entry_points  # a third of the time of a short command

    entry = next(iter(entry_points(group=GROUP, name=scheme)), None)
    if entry is None and scheme in ("http", "https"):
        raise UnavailableError(
            f"expected Lodestream's client for addresses of {scheme}://, which is not installed, or was installed "
            "before it read them: install lodestream with pip, again if it is there"
        )
    if entry is None:
        raise InputError(f"expected {_KNOWN}, got one of {scheme}://")
    opened: Any = entry.load()(place, token)
    made: ByteSource = opened
    return made


def _refuse_token(token: str | None, what: str) -> None:
    if token is not None:
        raise OptionError(f"expected a URL, to whose server the token belongs, got {what}")
