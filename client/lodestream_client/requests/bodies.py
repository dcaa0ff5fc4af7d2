"""The bodies of uploads: files opened for sending, and surfaces in memory encoded as containers."""

from __future__ import annotations

import hashlib
import io
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, cast

from lodestream.errors import InputError, OptionError

from .memory import Asked, Closure, encoded, in_memory

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from lodestream.surface import Surface

__all__ = ["Asked", "Body", "Closure", "Parcel", "Source", "are_files", "check_asked", "opened", "prepared"]

File: TypeAlias = "str | os.PathLike[str] | BinaryIO | bytes"
#: What can be uploaded: a file by its name, one that is open, the bytes of one, or a surface in memory: all that
#: `lodestream.encode` takes.
Source: TypeAlias = "File | Surface | ArrayLike"

_CHUNK = 64 * 1024
_HASHED = 1 << 20


@dataclass(frozen=True)
class Parcel:
    """An upload: files with their names (empty: the file's own name), the query, and a folder that goes with it."""

    files: tuple[tuple[str, File], ...]
    parameters: Mapping[str, str | list[str]] = field(default_factory=dict)
    folder: tempfile.TemporaryDirectory[str] | None = None


class Body:
    """Files to send, open and at their start.

    Parameters
    ----------
    files : sequence of (name, file)
    sent : callable or None
        Called as ``sent(fraction)`` while the files are read.

    Attributes
    ----------
    size : int
        Bytes of all files.
    sha256 : str
        Of the one file, once it was computed.
    """

    def __init__(self, files: Sequence[tuple[str, BinaryIO]], sent: Callable[[float], None] | None = None) -> None:
        self.files = files
        self.size = sum(_length(file) for _, file in files)
        self.sha256 = ""
        self._sent = sent
        self._done = 0

    @property
    def left(self) -> int:
        """Bytes that were not read yet."""
        return self.size - self._done

    def hash(self) -> None:
        """Compute the SHA-256 of the one file, as `sha256` in hexadecimal digits; it is at its start then."""
        (_, file), digest = self.files[0], hashlib.sha256()
        while block := file.read(_HASHED):
            digest.update(block)
        file.seek(0)
        self.sha256 = digest.hexdigest()

    def go_to(self, offset: int) -> None:
        """Go to a byte of the one file, from which on it is read."""
        self.files[0][1].seek(offset)
        self._done = offset

    def count(self, size: int) -> None:
        """Count `size` more bytes as read."""
        self._done += size
        if self._sent is not None:
            self._sent(min(self._done / max(self.size, 1), 1.0))

    def form(self) -> list[tuple[str, tuple[str, BinaryIO, str]]]:
        """Return several files as the parts of a form, as httpx expects them."""
        return [
            ("file", (name, cast("BinaryIO", _Counted(file, self)), "application/octet-stream"))
            for name, file in self.files
        ]

    def chunks(self) -> Iterator[bytes]:
        """Yield the contents of the one file, chunk by chunk."""
        file = _Counted(self.files[0][1], self)
        while chunk := file.read(_CHUNK):
            yield chunk


class _Counted:
    def __init__(self, file: BinaryIO, body: Body) -> None:
        self._file = file
        self._body = body

    def read(self, size: int = -1) -> bytes:
        chunk = self._file.read(size)
        self._body.count(len(chunk))
        return chunk

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _length(file: BinaryIO) -> int:
    end = file.seek(0, os.SEEK_END)
    file.seek(0)
    return end


def are_files(sources: Sequence[Source]) -> bool:
    """Return whether the sources are files, not a surface in memory.

    Raises
    ------
    InputError
        If a source has another type.
    """
    return bool(sources) and not any(map(in_memory, sources))


def check_asked(asked: Asked) -> None:
    """Refuse invalid options before any request.

    Raises
    ------
    OptionError
        If an option has an invalid value, or both a precision and an RMS error are given.
    """
    _parameters(asked)


def prepared(
    sources: Sequence[Source],
    asked: Asked,
    progress: Callable[[str, float], None] | None,
    read_there: Collection[str] | None = None,
    local: bool = False,
) -> Parcel:
    """Prepare an upload; encode a surface in memory, and files that the server does not read.

    Parameters
    ----------
    sources : sequence of files, or one surface
    asked : Asked
    progress : callable or None
        Called as ``progress("encoding", fraction)``.
    read_there : collection of str or None
        The formats that the server reads; None: it does not say.
    local : bool
        Encode files whatever the server reads.

    Raises
    ------
    OptionError
        If there is nothing to upload, an option has an invalid value, both a precision and an RMS error are given, or
        there are format options for a surface in memory.
    InputError
        If a source has another type, a surface in memory is not the only source, or it cannot be encoded.
    """
    if not sources:
        raise OptionError("expected at least one file to upload, got none")
    kinds = [in_memory(source) for source in sources]
    if any(kinds):
        if len(sources) > 1:
            raise InputError(f"expected a surface in memory as the only source, got {len(sources)} sources")
        return Parcel((("surface.lode", encoded(sources[0], asked, progress)),))
    if local or read_there is not None:
        from .local import encoded_here

        folder = tempfile.TemporaryDirectory(prefix="lodestream-")
        try:
            given = cast("Sequence[File]", sources)
            container = encoded_here(given, asked, None if local else read_there, Path(folder.name), progress)
        except BaseException:
            folder.cleanup()
            raise
        if container is not None:
            return Parcel((("surface.lode", container),), folder=folder)
        folder.cleanup()
    names = [asked.filename or "", *[""] * (len(sources) - 1)]
    files = tuple((name, cast("File", source)) for name, source in zip(names, sources, strict=True))
    return Parcel(files, _parameters(asked))


@contextmanager
def opened(parcel: Parcel, sent: Callable[[float], None] | None = None) -> Iterator[Body]:
    """Open the files of an upload, and yield its body.

    Raises
    ------
    InputError
        If a path is that of a folder.
    OptionError
        If there are options for a container, which takes none but a name.
    OSError
        If a file cannot be opened.
    """
    with ExitStack() as stack:
        if parcel.folder is not None:
            stack.enter_context(parcel.folder)
        files: list[tuple[str, BinaryIO]] = []
        for name, source in parcel.files:
            if isinstance(source, str | os.PathLike):
                path = Path(source)
                if path.is_dir():
                    raise InputError(
                        f"expected a file to upload, got the folder {path}: lodestream encode makes a container of a "
                        "Zarr store"
                    )
                files.append((name or path.name, stack.enter_context(path.open("rb"))))
            elif isinstance(source, bytes | bytearray | memoryview):
                files.append((name, io.BytesIO(source)))
            else:
                files.append((name, source))
        options = [option for option in parcel.parameters if option != "name"]
        if options and any(_is_container(file) for _, file in files):
            raise OptionError(f"expected no {options[0]} for a container (.lode), which is encoded already")
        yield Body(files, sent)


def _is_container(file: BinaryIO) -> bool:
    file.seek(0)
    head = file.read(8)
    if b"LODE" not in head:
        return False
    from lodestream.container.sections import is_container  # only where it may be one

    return is_container(head)


def _parameters(asked: Asked) -> dict[str, str | list[str]]:
    """Return the query of an upload."""
    parameters: dict[str, str | list[str]] = {}
    precisions, rms = asked.quality.texts()
    if precisions:
        parameters["precision"] = precisions
    if rms is not None:
        parameters["rms"] = rms
    if asked.effort != "default":
        parameters["effort"] = asked.effort
    if asked.closed != "auto":
        parameters["closed"] = asked.closed
    if asked.nodata is not None:
        parameters["nodata"] = str(asked.nodata)
    if asked.name:
        parameters["name"] = asked.name
    for key, value in asked.options.items():
        if key in ("precision", "rms", "effort", "closed", "nodata", "name", "filename"):
            raise OptionError(f"{key} is not an option of a format")
        # A list, as of attributes, is a text with commas in a query.
        parameters[key] = value if isinstance(value, str) or not isinstance(value, Iterable) else ",".join(value)
    return parameters
