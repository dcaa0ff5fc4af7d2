"""Uploads: request bodies that are written to disk while they are counted and hashed.

There is no temporary copy: a raw body is one file, a multipart body is parsed as it arrives.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from lodestream.errors import FormatError, OptionError, TooLargeError

from ..operation.settings import Settings
from ..problems import SlowUploadError
from ..store.durable import NewFile
from .layout import Manifest

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

__all__ = ["Body", "Upload", "blocks", "check_promised", "check_upload", "digest_of", "receive", "take_apart"]

# Larger blocks than the network's, so that a thread is asked less often; small enough for many uploads at once.
_BUFFER = 64 * 1024
_READ = 1 << 20
_FIELD = "file"
_MOST_PART_HEADERS = 16 * 1024
# Of a form: fields that are no files, and bytes of each.
_MOST_OPTIONS, _MOST_OPTION = 64, 4096


class Upload:
    """The files of an upload as they arrive, in a folder, named 0, 1, ...

    Parameters
    ----------
    folder : Path or None
        None: only their hash is computed.
    most_files : int

    Attributes
    ----------
    names : list of (str or None)
        Names of the files as the client sent them.
    options : list of (str, str)
        Fields of the form that are no files.
    size : int
        Bytes of all files.
    """

    def __init__(self, folder: Path | None, most_files: int) -> None:
        self.names: list[str | None] = []
        self.options: list[tuple[str, str]] = []
        self.size = 0
        self.digest = hashlib.sha256()
        self._folder = folder
        self._most_files = most_files
        self._stack = ExitStack()
        self._file: NewFile | _Nowhere | None = None

    @property
    def paths(self) -> list[Path]:
        """Paths of the files; empty if they are not stored."""
        if self._folder is None:
            return []
        return [self._folder / str(number) for number in range(len(self.names))]

    def begin(self, name: str | None) -> None:
        """Start the next file.

        Raises
        ------
        TooLargeError
            If the upload has as many files as it may have.
        """
        if len(self.names) == self._most_files:
            raise TooLargeError(f"The upload has more files than the {self._most_files} that it may have")
        if self._folder is None:
            self._file = _Nowhere()
        else:
            self._file = self._stack.enter_context(NewFile(self._folder / str(len(self.names))))
        self.names.append(name)

    def write(self, data: bytes) -> None:
        """Append to the file."""
        assert self._file is not None
        self._file.write(data)
        self.digest.update(data)
        self.size += len(data)

    def end(self) -> None:
        """Finish the file and synchronise it to disk.

        Raises
        ------
        FormatError
            If the file is empty.
        """
        assert self._file is not None
        # The length keeps files apart: two files are not the same upload as both in one.
        self.digest.update(self._file.size.to_bytes(8, "big"))
        if not self._file.size:
            raise FormatError("The file is empty")
        self._file = None
        self._stack.close()

    def adopt(self, name: str | None) -> str:
        """Take the next file as it is there already, complete; return the SHA-256 of the file alone."""
        assert self._folder is not None
        path, before = self._folder / str(len(self.names)), self.size
        alone = hashlib.sha256()
        self.names.append(name)
        with path.open("rb") as file:
            while block := file.read(_READ):
                alone.update(block)
                self.digest.update(block)
                self.size += len(block)
        self.digest.update((self.size - before).to_bytes(8, "big"))
        return alone.hexdigest()

    def abort(self) -> None:
        """Close open files, after an error."""
        self._stack.close()


class _Nowhere:
    """A file of which only the size is kept."""

    def __init__(self) -> None:
        self.size = 0

    def write(self, data: bytes) -> None:
        self.size += len(data)


def digest_of(files: Iterable[Path]) -> str:
    """Return the `Upload.digest` that these files had when they were uploaded, in hexadecimal digits."""
    digest = hashlib.sha256()
    for path in files:
        size = 0
        with path.open("rb") as file:
            while block := file.read(_READ):
                digest.update(block)
                size += len(block)
        digest.update(size.to_bytes(8, "big"))
    return digest.hexdigest()


def check_upload(files: Sequence[Path], manifest: Manifest) -> str | None:
    """Return the problem of the files of an upload; None if they are intact.

    Raises
    ------
    OSError
        If they exist and cannot be read: the disk has a problem, which may pass.
    """
    try:
        size = sum(path.stat().st_size for path in files)
        if size != manifest.upload_bytes:
            return f"expected {manifest.upload_bytes} bytes, got {size}"
        digest = digest_of(files)
    except (FileNotFoundError, NotADirectoryError) as error:
        return f"expected {len(files)} files: {error.strerror}"
    if digest != manifest.upload:
        return f"expected files with the SHA-256 {manifest.upload}, got {digest}"
    return None


class Body(Protocol):
    """A request body as it arrives."""

    def feed(self, data: bytes) -> None:
        """Take bytes."""

    def finish(self) -> None:
        """Declare the end of the body."""


class _Raw:
    """A body that is one file."""

    def __init__(self, upload: Upload, name: str | None) -> None:
        self._upload = upload
        upload.begin(name)

    def feed(self, data: bytes) -> None:
        self._upload.write(data)

    def finish(self) -> None:
        self._upload.end()


class _Multipart:
    """A multipart body: parts called ``file`` are files, and parts that are no files are options."""

    def __init__(self, upload: Upload, boundary: bytes) -> None:
        self._upload = upload
        self._name = b""
        self._value = b""
        self._headers: dict[bytes, bytes] = {}
        self._ended = False
        self._option: tuple[str, bytearray] | None = None  # the part that is being read, if it is one
        callbacks: MultipartCallbacks = {
            "on_part_begin": self._part_begin,
            "on_header_begin": self._header_begin,
            "on_header_field": self._header_field,
            "on_header_value": self._header_value,
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers_finished,
            "on_part_data": self._part_data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }
        self._parser = MultipartParser(boundary, callbacks)

    def feed(self, data: bytes) -> None:
        try:
            self._parser.write(data)
        except FormParserError as error:
            raise FormatError(f"The form cannot be read: {error}") from None

    def finish(self) -> None:
        if not self._ended:
            raise FormatError("The form is cut short: it has no last boundary")
        if not self._upload.names:
            raise FormatError(f"The form has no part called {_FIELD}")

    def _part_begin(self) -> None:
        self._headers = {}

    def _header_begin(self) -> None:
        self._name, self._value = b"", b""

    def _header_field(self, data: bytes, start: int, end: int) -> None:
        self._name = self._bounded(self._name + data[start:end])

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value = self._bounded(self._value + data[start:end])

    def _header_end(self) -> None:
        self._headers[self._name.lower()] = self._value
        if len(self._headers) > 16:
            raise FormatError("A part of the form has more than 16 headers")

    def _headers_finished(self) -> None:
        _, options = parse_options_header(self._headers.get(b"content-disposition"))
        field = options.get(b"name", b"").decode("utf-8", "replace")
        name = options.get(b"filename")
        if field != _FIELD:
            if name is not None or not field:
                raise OptionError(f"The form has a file called {field[:80]!a}; files are called {_FIELD}")
            if len(self._upload.options) == _MOST_OPTIONS:
                raise TooLargeError(f"The form has more than the {_MOST_OPTIONS} options that it may have")
            self._option = field, bytearray()
            return
        self._upload.begin(None if name is None else name.decode("utf-8", "replace"))

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._option is None:
            self._upload.write(data[start:end])
            return
        name, value = self._option
        value += data[start:end]
        if len(value) > _MOST_OPTION:
            raise TooLargeError(f"The option {name[:80]!a} has more than the {_MOST_OPTION} bytes that it may have")

    def _part_end(self) -> None:
        if self._option is None:
            self._upload.end()
            return
        name, value = self._option
        self._option = None
        try:
            self._upload.options.append((name, value.decode()))
        except UnicodeDecodeError:
            raise OptionError(f"The option {name[:80]!a} is not text in UTF-8") from None

    def _end(self) -> None:
        self._ended = True

    @staticmethod
    def _bounded(header: bytes) -> bytes:
        if len(header) > _MOST_PART_HEADERS:
            raise FormatError(f"A part of the form has a header of more than {_MOST_PART_HEADERS} bytes")
        return header


async def receive(request: Request, folder: Path | None, settings: Settings, name: str | None) -> Upload:
    """Write the body of a request to files in a folder, or only hash it if there is no folder.

    Raises
    ------
    TooLargeError
        If it is larger than allowed, or announces to be; the announcement is checked before the body is read.
    FormatError, OptionError
        If it is empty, or a multipart body that cannot be parsed.
    SlowUploadError
        If nothing arrived for too long.
    """
    check_promised(request, settings.upload_bytes)
    upload = Upload(folder, settings.upload_files)
    try:
        reader = await asyncio.to_thread(take_apart, upload, request.headers.get("content-type"), name)
        async for block in blocks(request, settings, settings.upload_bytes):
            await asyncio.to_thread(reader.feed, block)
        await asyncio.to_thread(reader.finish)
    finally:
        upload.abort()
    return upload


def take_apart(upload: Upload, content_type: str | None, name: str | None = None) -> Body:
    """Return the parser for a body of this type: raw, or the parts of a form.

    Raises
    ------
    FormatError
        If a form has no valid boundary.
    """
    kind, options = parse_options_header(content_type)
    if kind != b"multipart/form-data":
        return _Raw(upload, name)
    boundary = options.get(b"boundary")
    if not boundary:
        raise FormatError("The content type multipart/form-data has no boundary")
    try:
        return _Multipart(upload, boundary)
    except FormParserError as error:
        raise FormatError(f"The boundary of the form cannot be used: {error}") from None


def check_promised(request: Request, most: int) -> None:
    """Check the announced length of a body.

    Raises
    ------
    TooLargeError
        If it is more than `most` bytes.
    """
    promised = request.headers.get("content-length", "")
    if promised.isdecimal() and int(promised) > most:
        raise TooLargeError(f"The upload has {promised} bytes, and may have {most}")


async def blocks(request: Request, settings: Settings, most: int) -> AsyncIterator[bytes]:
    """Yield the body of a request in larger blocks; what came before an error, or the end of the task, is too.

    Raises
    ------
    TooLargeError
        If there are more than `most` bytes.
    SlowUploadError
        If nothing arrived for too long.
    """
    pending = bytearray()
    size = 0
    chunks = aiter(request.stream())
    while True:
        try:
            async with asyncio.timeout(settings.idle_seconds):
                chunk = await anext(chunks, None)
        except (Exception, asyncio.CancelledError) as error:
            if pending:
                yield bytes(pending)
            if not isinstance(error, TimeoutError):
                raise
            raise SlowUploadError(f"Nothing more of the upload came within {settings.idle_seconds:g} s") from None
        if chunk is None:
            break
        size += len(chunk)
        if size > most:
            raise TooLargeError(f"The upload has more than the {most} bytes that it may have")
        pending += chunk
        if len(pending) >= _BUFFER:
            yield bytes(pending)
            pending.clear()
    if pending:
        yield bytes(pending)
