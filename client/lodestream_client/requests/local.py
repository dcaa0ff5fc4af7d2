"""Encode files here and send a container, because the server does not read their format or on request."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from lodestream.errors import FormatError, FormatWarning, InputError, OptionError, UnavailableError

from .memory import Asked, noted

__all__ = ["checked_options", "encoded_here"]

#: Of `_others`: all formats, whatever the file is, for sure.
_NO_LIMIT: tuple[frozenset[str] | None, Sequence[str], bool] = (None, ("any",), True)

#: The option of meshes to be resampled, which a server lists as it does formats if it does that.
_REMESH = "remesh"

_HEAD = 4096
_UNNAMED = "upload"
_NAME = "surface.lode"

#: Parameters of `lodestream.read` and of its callers that are no options of any format.
_NO_OPTIONS = (
    *("path", "closed", "max_vertices", "filename", "allowed", "format_name", "room", "nodata", "progress"),
    *("folder", "paths", "memory", "by_bands", "kept"),
)


def checked_options(options: Mapping[str, str | Sequence[str]]) -> dict[str, Any]:
    """Return options of a format as keyword arguments of `lodestream.read`.

    Raises
    ------
    OptionError
        If one of them is another parameter of it.
    """
    for key in _NO_OPTIONS:
        if key in options:
            raise OptionError(f"{key} is not an option of any format")
    return dict(options)


def encoded_here(
    sources: Sequence[str | os.PathLike[str] | BinaryIO | bytes],
    asked: Asked,
    read_there: Collection[str] | None,
    folder: Path,
    progress: Callable[[str, float], None] | None,
) -> Path | None:
    """Encode files of one surface, if the server does not read their format, or would have to resample and does not.

    Parameters
    ----------
    sources : sequence of str, path, binary file or bytes
    asked : Asked
    read_there : collection of str or None
        The formats that the server reads; None: encode files of any format.
    folder : Path
        Empty; for the container and for what does not fit into memory.
    progress : callable or None
        Called as ``progress("encoding", fraction)``, and before as ``progress("remeshing", fraction)`` if it is.

    Returns
    -------
    Path or None
        The container; None: send the files as they are, since the server reads their format, or they are a container.
        What the reader leaves out is a `FormatWarning`, and so is that the files were encoded here, if the server's
        formats are the reason.

    Raises
    ------
    LodestreamError, OSError
        From `lodestream.read` and `lodestream.encode`.
    """
    from lodestream import encode
    from lodestream.container.sections import is_container
    from lodestream.encoding.reading import read_into

    name = asked.filename or _name_of(sources[0])
    if is_container(_head(sources[0])):
        return None
    if read_there is None:
        allowed, candidates, sure = _NO_LIMIT
    elif asked.options.get(_REMESH) is not None and _REMESH not in read_there:
        allowed, candidates, sure = None, (_REMESH,), True
    else:
        allowed, candidates, sure = _others(sources[0], name, read_there, folder)
    if not candidates:
        return None
    paths = [_path(source, folder / f"file-{number}") for number, source in enumerate(sources)]
    try:
        surface = read_into(
            folder / "arrays",
            paths,
            None,
            asked.quality.rms is None,
            closed=asked.closed,
            nodata=asked.nodata,
            filename=name or _UNNAMED,
            allowed=allowed,
            progress=None if progress is None else (lambda fraction: progress("remeshing", fraction)),
            **checked_options(asked.options),
        )
    except (InputError, UnavailableError):
        if sure:
            raise
        return None  # it is of the variant that the server reads, or else the server says what is wrong with it
    if asked.name:
        surface.metadata["name"] = asked.name
    elif not name:
        surface.metadata.pop("name", None)  # which the reader took from the name that stands in for the file's
    if read_there is not None:
        there = "resample meshes" if candidates == (_REMESH,) else f"read files of format {' or '.join(candidates)}"
        warnings.warn(
            f"the server does not {there}: {name or 'the file'} is encoded here and sent as a container",
            FormatWarning,
            stacklevel=2,
        )
    surface.metadata = noted(surface)
    container = folder / _NAME
    tell = None if progress is None else (lambda fraction: progress("encoding", fraction))
    encode(surface, quality=asked.quality, progress=tell, out=container)
    return container


def _others(
    source: Any, name: str | None, read_there: Collection[str], folder: Path
) -> tuple[frozenset[str] | None, Sequence[str], bool]:
    """Return the formats that the server does not read, the formats that a file may have, and whether one is certain.

    A variant, as VMEC's NetCDF, is known only to its reader, which refuses it before it reads values.
    """
    from lodestream.formats import formats, sniff

    others = frozenset(name for format_ in formats() if format_.read for name in format_.names) - frozenset(read_there)
    head = folder / "head"
    head.write_bytes(_head(source))
    try:
        names = sniff(head, filename=name or _UNNAMED).names
    except FormatError:
        return others, (), False  # the server says what is wrong with it
    return others, [name for name in names if name in others], others.issuperset(names)


def _name_of(source: Any) -> str | None:
    return os.fspath(source) if isinstance(source, str | os.PathLike) else None


def _head(source: Any) -> bytes:
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if path.is_dir():
            return b""
        with path.open("rb") as file:
            return file.read(_HEAD)
    if isinstance(source, bytes | bytearray | memoryview):
        return bytes(source[:_HEAD])
    source.seek(0)
    head: bytes = source.read(_HEAD)
    source.seek(0)
    return head


def _path(source: Any, copy: Path) -> Path:
    """Return the path of a file; of its copy if it has no name."""
    if isinstance(source, str | os.PathLike):
        return Path(source)
    with copy.open("wb") as file:
        if isinstance(source, bytes | bytearray | memoryview):
            file.write(source)
        else:
            source.seek(0)
            shutil.copyfileobj(source, file)
            source.seek(0)
    return copy
