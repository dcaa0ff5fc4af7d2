"""Uploads that are sent in parts: what has arrived is on disk, and the next request goes on from there.

::

    SCRATCH/partial/<id>/upload.json    what was said when it began, and the surface that it has become
    SCRATCH/partial/<id>/0              the bytes so far; removed once there is the surface

The offset of an upload is the size of its file once the file is synchronised, so it is never more than what is there,
whenever a server ends. File systems of today lengthen a file only after its bytes. Everything here but what is said to
be for threads runs in the event loop.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import re
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from lodestream.errors import InputError, NotFoundError

from ..operation.threads import carried_out
from ..problems import BusyError, LockedError, WrongOffsetError
from . import durable
from .durable import NewFile, discard, make_folder, sync_folder
from .private import make_again
from .uploads import Upload

__all__ = ["Declared", "PartialUpload", "PartialUploads"]

_log = logging.getLogger(__name__)

_DECLARED, _DATA = "upload.json", "0"
_NAME = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class Declared:
    """What is known of an upload before its bytes are.

    Attributes
    ----------
    owner : str or None
        Name of the token that it was begun with, and that alone may go on.
    length : int
        Bytes of the file.
    query : tuple of (str, str)
        The options of the surface.
    filename : str or None
    sha256 : str or None
        SHA-256 of the file, if the client has said it.
    metadata : str
        What the client has sent as metadata.
    surface : str or None
        Id of the surface, once the upload is complete and stored.
    """

    owner: str | None
    length: int
    query: tuple[tuple[str, str], ...]
    filename: str | None
    sha256: str | None
    metadata: str
    surface: str | None = None


@cache
def _adapter() -> TypeAdapter[Declared]:
    return TypeAdapter(Declared)


class PartialUpload:
    """One upload.

    Parameters
    ----------
    folder : Path
    declared : Declared
    offset : int
    touched : float
        When it last went on, in seconds since 1970.

    Attributes
    ----------
    id : str
    declared : Declared
    offset : int
        Bytes that are on disk.
    kept : int
        Bytes that count as the owner's: those of the file, synchronised or not, until they are a surface's.
    touched : float
    """

    def __init__(self, folder: Path, declared: Declared, offset: int, touched: float) -> None:
        self.id = folder.name
        self.declared = declared
        self.offset = offset
        self.kept = 0 if declared.surface is not None else offset
        self.touched = touched
        self.folder = folder
        self._lock = asyncio.Lock()
        self._clock: asyncio.Timeout | None = None
        self._asking = 0  # requests that look or delete, or wait for that
        self._gone = False

    @property
    def is_complete(self) -> bool:
        """Whether all its bytes are there."""
        return self.offset == self.declared.length

    @property
    def is_locked(self) -> bool:
        """Whether a request is at work on it."""
        return self._lock.locked()

    @property
    def is_lost(self) -> bool:
        """Whether its bytes were removed by somebody else, with the scratch folder."""
        if self.declared.surface is not None:
            return False
        try:
            os.stat(self.folder / _DATA)  # what says only whether it is there would take an error of the disk for a no
        except (FileNotFoundError, NotADirectoryError):
            return True
        except OSError:  # nobody knows now
            return False
        return False

    async def make(self) -> None:
        """Make its folder.

        Raises
        ------
        BusyError
            If the scratch folder is removed meanwhile.
        OSError
            If it cannot be made.
        """
        async with self._lock:
            try:
                await carried_out(partial(_make, self.folder, self.declared))
            except FileNotFoundError as error:
                raise BusyError("The server's scratch folder was removed meanwhile; begin again") from error

    @asynccontextmanager
    async def continued(self, offset: int) -> AsyncIterator[None]:
        """Hold the upload for a request that sends more of it.

        Raises
        ------
        LockedError
            If another one does.
        WrongOffsetError
            If the bytes that it sends are not the next ones.
        NotFoundError
            If it was removed.
        """
        if self.is_locked:
            raise LockedError("Another request is sending this upload; ask for its offset first")
        async with self._held():
            if offset != self.offset:
                raise WrongOffsetError(self.offset, offset)
            yield

    @asynccontextmanager
    async def settled(self) -> AsyncIterator[None]:
        """Hold the upload for a request that looks or deletes.

        A request that still sends more is ended first: whoever asks has lost it, and the server may not know that yet.

        Raises
        ------
        NotFoundError
            If it was removed.
        """
        if self._clock is not None:
            self._clock.reschedule(asyncio.get_running_loop().time())
            self._clock = None  # which cannot be done twice
        self._asking += 1
        try:
            async with self._held():
                yield
        finally:
            self._asking -= 1

    @asynccontextmanager
    async def _held(self) -> AsyncIterator[None]:
        async with self._lock:
            if self._gone or self.is_lost:
                raise _missing(self.id)
            try:
                yield
            except FileNotFoundError as error:
                if self.is_lost:
                    raise _missing(self.id) from error
                raise

    async def append(self, blocks: AsyncIterator[bytes]) -> None:
        """Put more bytes on disk; what came before an error stays. The upload is held.

        Raises
        ------
        LockedError
            If another request has asked for the upload meanwhile.
        OSError
            If the bytes cannot be written.
        """
        arrived = self.offset
        self._clock = clock = asyncio.timeout(0.0 if self._asking else None)
        try:
            async with clock:
                async for block in blocks:
                    await carried_out(partial(self._write, arrived, block))
                    arrived += len(block)
                    self.kept = arrived
        except TimeoutError:
            if clock.expired():
                raise LockedError("Another request has taken over this upload") from None
            raise
        finally:
            self._clock = None
            await carried_out(partial(self._synchronise, arrived))

    def _write(self, offset: int, block: bytes) -> None:
        # Opened for each block: nothing is open between two of them, whoever is cut short there.
        with durable.disk.extend(self.folder / _DATA, offset) as file:
            durable.disk.write(file, block)

    def _synchronise(self, arrived: int) -> None:
        path = self.folder / _DATA
        with path.open("rb") as file:
            durable.disk.sync(file.fileno(), path)
        self.offset, self.touched = arrived, time.time()

    def whole(self, folder: Path) -> Upload:
        """Return the complete upload, with a file of its own in a folder for uploads; for a thread.

        What is here stays until the surface is stored: whenever the server ends, that can be done again.

        Raises
        ------
        InputError
            If the file has another SHA-256 than the client has said.
        """
        durable.disk.link(self.folder / _DATA, folder / "0")
        upload = Upload(folder, 1)
        found = upload.adopt(self.declared.filename)
        if self.declared.sha256 not in (None, found):
            raise InputError(f"The file was to have the SHA-256 {self.declared.sha256}, and has {found}; send it again")
        return upload

    async def finish(self, surface: str) -> None:
        """Note the surface that the upload has become, and remove its bytes. The upload is held."""
        self.kept = 0
        finished = replace(self.declared, surface=surface)
        with suppress(FileNotFoundError):  # where the folder was removed, only this server remembers it
            await carried_out(partial(self._note, finished))
        self.declared, self.touched = finished, time.time()

    def _note(self, finished: Declared) -> None:
        new = self.folder / "upload.new"
        durable.remove(new)  # of a server that was killed
        with NewFile(new) as file:
            file.write(_dumped(finished))
        durable.rename(new, self.folder / _DECLARED)
        discard(self.folder / _DATA)

    async def remove(self) -> None:
        """Remove it. The upload is held."""
        self._gone = True
        await carried_out(partial(discard, self.folder))


class PartialUploads:
    """The uploads of a server that are sent in parts; what earlier servers left is found again.

    Parameters
    ----------
    folder : Path
    most : int
        Finished ones that are remembered, so that whoever has lost the last answer finds the surface.
    seconds : float
        How long an upload is kept that nobody continues.

    Raises
    ------
    OSError
        If the folder cannot be read.
    """

    def __init__(self, folder: Path, most: int, seconds: float) -> None:
        self._folder = folder
        self._most = most
        self._seconds = seconds
        self._all = {upload.id: upload for upload in _found(folder)}

    def count(self, owner: str | None) -> tuple[int, int]:
        """Return how many uploads are not finished: all of them, and those of an owner."""
        going = [upload.declared.owner for upload in self._all.values() if upload.declared.surface is None]
        return len(going), going.count(owner)

    def kept(self, owner: str | None) -> int:
        """Return the bytes on disk of an owner's uploads that are not finished; may be called from any thread."""
        return sum(upload.kept for upload in list(self._all.values()) if upload.declared.owner == owner)

    def get(self, name: str, owner: str | None) -> PartialUpload:
        """Return an upload of an owner.

        Raises
        ------
        NotFoundError
            If there is none, its time is over, or it is another owner's.
        """
        upload = self._all.get(name)
        if upload is None or upload.declared.owner != owner or self._is_over(upload):
            raise _missing(name)
        return upload

    def expires(self, upload: PartialUpload) -> float:
        """Return until when an upload is kept if nobody continues it, in seconds since 1970."""
        return upload.touched + self._seconds

    def _is_over(self, upload: PartialUpload) -> bool:
        return self.expires(upload) < time.time() and not upload.is_locked

    async def create(self, declared: Declared) -> PartialUpload:
        """Begin an upload.

        Raises
        ------
        BusyError, OSError
            See `PartialUpload.make`.
        """
        upload = PartialUpload(self._folder / os.urandom(16).hex(), declared, 0, time.time())
        self._all[upload.id] = upload  # counted before anybody else may ask
        try:
            await upload.make()
        except BaseException:
            del self._all[upload.id]
            await carried_out(partial(discard, upload.folder))
            raise
        finished = sorted((item for item in self._all.values() if item.declared.surface is not None), key=self.expires)
        for item in finished[: -self._most]:
            await self._remove(item)
        return upload

    async def remove(self, upload: PartialUpload) -> None:
        """Remove an upload that is held."""
        self._all.pop(upload.id, None)
        await upload.remove()

    async def expire(self) -> None:
        """Remove the uploads whose time is over, and forget those that were lost."""
        for upload in list(self._all.values()):
            # Each is asked in its turn: while another was removed this one may have been made, continued or finished.
            if upload.is_lost or self._is_over(upload):
                await self._remove(upload)

    async def _remove(self, upload: PartialUpload) -> None:
        # While another one was being removed, somebody else may have removed this one. Whoever comes from now on finds
        # it gone.
        if upload.id in self._all and not upload.is_locked:
            await self.remove(upload)


def _missing(name: str) -> NotFoundError:
    return NotFoundError(f"No upload {name[:80]!a} of yours is under way or was completed of late")


def _dumped(declared: Declared) -> bytes:
    return json.dumps(asdict(declared)).encode()


def _make(folder: Path, declared: Declared) -> None:
    make_again(folder.parent)
    make_folder(folder)
    for name, data in ((_DATA, b""), (_DECLARED, _dumped(declared))):
        with NewFile(folder / name) as file:
            file.write(data)
    for changed in (folder, folder.parent):
        sync_folder(changed)


def _found(folder: Path) -> Iterator[PartialUpload]:
    """Yield the uploads of earlier servers; what is none, as a beginning that was cut short, is removed."""
    for path in list(folder.iterdir()) if folder.is_dir() else []:
        try:
            if not _NAME.fullmatch(path.name):
                raise ValueError("it has another name")
            declared = _adapter().validate_json((path / _DECLARED).read_bytes())
            yield PartialUpload(path, declared, *_reached(path, declared))
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError, ValidationError, ValueError) as error:
            _log.info("%s is no upload that can go on, and is removed: %s", path, str(error).partition("\n")[0])
            discard(path)
        except OSError as error:  # which says nothing of what was sent
            _log.error("%s cannot be read now, and is left for the next start: %s", path, error.strerror)


def _reached(folder: Path, declared: Declared) -> tuple[int, float]:
    """Return how many bytes of an upload are on disk, and when it last went on."""
    if declared.surface is not None:
        discard(folder / _DATA)
        return declared.length, (folder / _DECLARED).stat().st_mtime
    with (folder / _DATA).open("rb") as file:
        durable.disk.sync(file.fileno(), folder / _DATA)
        found = os.fstat(file.fileno())
    if found.st_size > declared.length:
        raise ValueError(f"it has {found.st_size} bytes, and may have {declared.length}")
    return found.st_size, found.st_mtime
