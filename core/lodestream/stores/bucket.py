"""A bucket as a store: Amazon S3 and what is compatible with it, and Azure Blob Storage, by the library obstore.

This module and what it uses are the only part of the core that does network I/O. The library is imported on use.
"""

from __future__ import annotations

import itertools
import os
import random
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import BinaryIO, NoReturn, Self, TypeVar

from ..errors import UnavailableError
from .answers import RequestError, ask, check_process, wait_for
from .blocks import Blocks, Extent
from .connections import LONGEST_PAUSE, Limits, connected, endpoint_of, parsed
from .errors import (
    AbsentError,
    ConflictError,
    DeniedError,
    ExistsError,
    OversizedError,
    StoreError,
    UnacknowledgedError,
    UnfitStoreError,
)
from .headers import headers
from .interface import SMALL, Entry, Progress, Still, Tag, always
from .keys import checked_key, checked_prefix, checked_small, is_key
from .probe import try_out
from .threads import Threads

__all__ = ["Bucket"]

_T = TypeVar("_T")

#: Bytes of a part of a large object, and what more parts than this a store does not take.
_PART = 8 << 20
_MOST_PARTS = 9_000
#: Parts that are on their way at once.
_PARTS_AT_ONCE = 3
#: Objects that are deleted at once; threads that read ahead.
_THREADS = 8
#: Bytes that whoever wants all of an object asks for at once.
_PIECE = 2 << 20


class Bucket:
    """A store in a bucket. See `Store` for what the methods do.

    Credentials, region and endpoint are those of the environment: ``AWS_ACCESS_KEY_ID``, ``AWS_REGION``,
    ``AWS_ENDPOINT_URL``; ``AZURE_STORAGE_ACCOUNT_NAME``, ``AZURE_STORAGE_SAS_KEY`` and so on; or of the machine's role.
    Plain HTTP is used only if the endpoint says so.

    Parameters
    ----------
    address : str
        Such as ``s3://bucket/prefix``; see `lodestream.stores.connections`.
    limits : Limits
    fetched : Path, optional
        Folder for the files of `local`, in a folder that is there; otherwise that of the system for what is temporary.

    Raises
    ------
    InputError
        If it is no such address, or has more in it than bucket and prefix.
    UnavailableError
        If obstore is not installed.
    StoreError
        If settings in the environment are missing or cannot be used.
    """

    at_once = 16

    def __init__(self, address: str, limits: Limits | None = None, *, fetched: Path | None = None) -> None:
        place = parsed(address)
        endpoint_of(place.scheme)  # in words of ours, before the library tries it
        try:
            import obstore
        except ModuleNotFoundError:
            raise UnavailableError(
                "expected obstore, which is not installed: pip install 'lodestream[stores]'"
            ) from None
        self._library = obstore
        self._address = place.address
        self._prefix = place.prefix
        self._limits = limits = limits or Limits()
        self._fetched = fetched
        try:
            self._store = ask(lambda: connected(place, limits, limits.stalled, limits.request))
            self._parts = ask(lambda: connected(place, limits, limits.part, limits.part))
            once = replace(limits, stalled=min(limits.stalled, limits.delete), retries=0)
            self._once = ask(lambda: connected(place, once, once.stalled, once.delete))
        except RequestError as failure:
            self._refuse("", failure)
        self._threads = Threads(_THREADS)
        self._blocks = Blocks(self._range, self._threads)

    def get(self, key: str, most: int = SMALL) -> tuple[bytes, Tag]:
        """Read a small object and its tag."""
        found = self.get_if(key, None, most)
        assert found is not None, "without a tag it is read in any case"
        return found

    def get_if(self, key: str, tag: Tag | None, most: int = SMALL) -> tuple[bytes, Tag] | None:
        """Read a small object and its tag; return None if it is still the one with this tag."""
        found = self._ask(key, partial(self._read, self._at(key), most, tag))
        if found is None:
            return None
        data, its_tag = found[0], self._tag(found[1])
        if data is None:
            raise OversizedError(f"{self._named(key)}: expected at most {most:,} bytes", its_tag)
        return data, its_tag

    def create(self, key: str, data: bytes) -> Tag:
        """Write a small object if there is none, and return its tag."""
        return self._write(key, data, None)

    def replace(self, key: str, data: bytes, tag: Tag) -> Tag:
        """Write a small object in place of the one that was read with a tag, and return the new tag."""
        return self._write(key, data, tag)

    def put_file(self, key: str, path: Path, progress: Progress | None = None, *, given: bool = False) -> None:
        """Write a large object from a file, in parts. After a failure it begins again, and so does what is told."""
        at = self._at(key)
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            part = max(_PART, -(-size // _MOST_PARTS))
            end = self._end()
            for pause in self._pauses():
                file.seek(0)
                pieces = _Pieces(file, part, progress)
                try:
                    ask(partial(self._send, at, key, pieces, part, whole=size <= part), pieces.stop)
                    return
                except RequestError as failure:
                    if pieces.error is not None:
                        raise pieces.error from None
                    # A conflict with another upload of the same bytes, or no answer: it never changes, so once more.
                    self._pause(key, failure, pause, end)

    def open(self, key: str, size: int | None = None) -> BucketBlob:
        """Open an object for reading."""
        at = self._at(key)
        if size is None:
            try:
                size = self._ask(key, lambda: self._library.head(self._store, at))["size"]
            except AbsentError:
                # The answer to HEAD does not tell whether the object or the bucket is absent; that to GET does.
                with suppress(OversizedError):  # it has come to be meanwhile
                    self.get(key, 0)
                raise
        return BucketBlob(self._blocks, Extent(key, size))

    def pieces(self, key: str, size: int | None = None) -> Iterator[bytes]:
        """Read an object from its beginning to its end; one piece is on its way while another is used."""
        blob = self.open(key, size)
        coming = deque[Future[bytes]]()
        for offset in range(0, blob.size, _PIECE):
            length = min(_PIECE, blob.size - offset)
            coming.append(self._threads.submit(self._piece, key, blob, offset, length))
            if len(coming) > 1:
                yield wait_for(coming.popleft())
        if coming:
            yield wait_for(coming.popleft())

    def _piece(self, key: str, blob: BucketBlob, offset: int, length: int) -> bytes:
        """Read a piece past the blocks that are kept, unless it is there: nobody wants all of it again soon."""
        data = blob.read_at_once(offset, length) or self._range(key, offset, length)
        if len(data) != length:
            raise StoreError(f"{self._named(key)}: expected {length:,} bytes at byte {offset:,}, got {len(data):,}")
        return data

    @contextmanager
    def local(self, key: str) -> Iterator[Path]:
        """Fetch an object into a temporary file for the length of a block."""
        name = checked_key(key).rpartition("/")[2]
        with ExitStack() as held:
            try:
                if self._fetched is not None:
                    self._fetched.mkdir(0o700, exist_ok=True)
                folder = held.enter_context(TemporaryDirectory(prefix="lodestream-", dir=self._fetched))
                path = Path(folder) / name
                with path.open("wb") as file:
                    file.writelines(self.pieces(key))
            except OSError as error:
                where = self._fetched or gettempdir()
                raise StoreError(f"{self._named(key)} cannot be kept in {where}: {error.strerror}") from error
            yield path

    def delete(self, keys: Iterable[str], still: Still = always) -> None:
        """Delete objects, as far as there are any."""
        places = {key: self._at(key) for key in keys}
        check_process()
        # One by one, to know which is gone. For S3 the library asks for each by `POST ?delete` (DeleteObjects), which a
        # store has to have; its refusal is in the body of an answer 200.
        answers: list[Future[None]] = []
        try:
            answers.extend(self._threads.submit(self._delete, key, at, still) for key, at in places.items())
            for answer in answers:
                wait_for(answer)
        except BaseException as error:
            under_way = [answer for answer in answers if not answer.cancel()]
            if isinstance(error, Exception):
                wait(under_way)  # they would delete what the caller makes anew
            raise

    def _delete(self, key: str, at: str, still: Still) -> None:
        end = self._end()
        for pause in self._pauses():
            try:
                if still() < self._limits.delete:
                    raise RequestError("unknown", "there is not enough time left for a request")
                return ask(partial(self._library.delete, self._once, at))
            except RequestError as failure:
                if failure.kind == "absent":
                    return None
                self._pause(key, failure, pause, end)
        raise AssertionError("there is always another attempt")

    def entries(self, prefix: str, after: str = "") -> Iterator[Entry]:
        """List objects in the order of their keys."""
        where = self._prefix + checked_prefix(prefix)
        end, pauses = self._end(), self._pauses()
        while True:
            offset = self._prefix + after if after else None
            try:
                listed = ask(partial(self._library.list, self._store, where or None, offset=offset))
                while (chunk := ask(partial(next, listed, None))) is not None:
                    for found in chunk:
                        key = found["path"][len(self._prefix) :]
                        if key > after and is_key(key):  # others are of other programs
                            after = key
                            tag = Tag((found["e_tag"] or "").strip('"'))
                            yield Entry(key, found["size"], tag, found["last_modified"].timestamp())
                    end, pauses = self._end(), self._pauses()
                return
            except RequestError as failure:
                # A list that failed ends as if there were no more: another one goes on behind the last key.
                self._pause(prefix, failure, next(pauses), end)

    def room(self) -> int | None:
        """Return None: a bucket has no end."""
        return None

    def probe(self) -> float:
        """Try out whether the store heeds conditions, and reads and lists what was written; return its time."""
        return try_out(self)

    def describe(self) -> str:
        """Return the address."""
        return self._address

    def __repr__(self) -> str:
        return f"Bucket({self.describe()!r})"

    def _at(self, key: str) -> str:
        return self._prefix + checked_key(key)

    def _named(self, key: str) -> str:
        return f"{self.describe()}: {key}" if key else self.describe()

    def _ask(self, key: str, call: Callable[[], _T]) -> _T:
        """Make a call that may be repeated: the library repeats not every request, and none whose answer is cut."""
        end = self._end()
        for pause in self._pauses():
            try:
                return ask(call)
            except RequestError as failure:
                self._pause(key, failure, pause, end)
        raise AssertionError("there is always another attempt")

    def _pauses(self) -> Iterator[float]:
        """Seconds between attempts, without end: longer and longer, and never those of other writers."""
        first = self._limits.pause
        return (min(LONGEST_PAUSE, first * 2**number) * random.uniform(0.5, 1.5) for number in itertools.count())

    def _end(self) -> float:
        return time.monotonic() + self._limits.again

    def _pause(self, key: str, failure: RequestError, pause: float, end: float) -> None:
        """Wait before a call is made once more, or raise what its failure is if that does not help."""
        if failure.kind in ("absent", "refused") or time.monotonic() + pause > end:
            self._refuse(key, failure)
        time.sleep(pause)

    def _refuse(self, key: str, failure: RequestError) -> NoReturn:
        """Raise what a failure is for whoever reads, or writes what may be repeated."""
        if failure.kind == "absent":
            raise AbsentError(f"{self.describe()}: there is no {key}") from None
        raise (DeniedError if failure.denied else StoreError)(f"{self._named(key)}: {failure.words}") from None

    def _read(self, at: str, most: int, tag: str | None = None) -> tuple[bytes | None, str | None] | None:
        """Return the bytes of an object, or None if they are too many, and its tag; None if it still has a tag."""
        from obstore.exceptions import NotModifiedError

        try:
            answer = self._library.get(self._store, at, options={"if_none_match": tag} if tag else None)
        except NotModifiedError:
            return None
        return bytes(answer.bytes()) if answer.meta["size"] <= most else None, answer.meta["e_tag"]

    def _tag(self, tag: str | None) -> Tag:
        if not tag:
            raise UnfitStoreError(f"{self.describe()} gives no tags (ETag), so nothing can be changed in it safely")
        return Tag(tag)

    def _range(self, key: str, offset: int, length: int) -> bytes:
        call = partial(self._library.get_range, self._store, self._at(key), start=offset, length=length)
        return bytes(self._ask(key, call))

    def _write(self, key: str, data: bytes, tag: Tag | None) -> Tag:
        """Create an object, or replace the one with a tag; look what is there whenever it is not known to be done."""
        at = self._at(key)
        put = partial(
            self._library.put,
            self._store if len(data) <= _PIECE else self._parts,
            at,
            checked_small(key, data),
            attributes=headers(key),
            mode="create" if tag is None else {"e_tag": tag},
            use_multipart=False,
        )
        end = self._end()
        for pause in self._pauses():
            try:
                return self._tag(ask(put)["e_tag"])
            except RequestError as failure:
                unmade = failure
            # Of a lost answer, a time-out, a conflict with a write on its way (409 of S3), and a lost race (412, and
            # 409 of Azure), the latter two may also be those of this write, which was made before in this very call.
            try:
                there, its_tag = ask(partial(self._read, at, SMALL)) or (None, None)
            except RequestError as failure:
                if failure.kind != "absent":
                    break
                there, its_tag = None, None
            if there == data:
                return self._tag(its_tag)
            if unmade.kind == "refused":
                self._refuse(key, unmade)
            if its_tag != tag:
                raise self._lost(key, tag, its_tag)
            if time.monotonic() + pause > end:
                break
            time.sleep(pause)
        if unmade.kind == "refused":
            self._refuse(key, unmade)
        raise UnacknowledgedError(
            f"{self._named(key)}: it is not known whether it was written: {unmade.words}. It may be written again"
        )

    def _lost(self, key: str, tag: Tag | None, its_tag: str | None) -> StoreError:
        if tag is None:
            return ExistsError(f"{self.describe()}: {key} exists already")
        what = "gone" if its_tag is None else "changed"
        return ConflictError(f"{self.describe()}: {key} has {what} meanwhile: read it again")

    def _send(self, at: str, key: str, pieces: _Pieces, part: int, *, whole: bool) -> None:
        self._library.put(
            self._parts,
            at,
            b"".join(pieces) if whole else pieces,
            attributes=headers(key),
            use_multipart=not whole,
            chunk_size=part,
            max_concurrency=_PARTS_AT_ONCE,
        )


class BucketBlob:
    """An object in a bucket that is open for reading, through the blocks of its store. See `Blob`."""

    path = None

    def __init__(self, blocks: Blocks, extent: Extent) -> None:
        self.size = extent.size
        self._blocks = blocks
        self._extent = extent

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes; fewer where the object ends."""
        return self._blocks.read(self._extent, offset, length)

    def read_at_once(self, offset: int, length: int) -> bytes | None:
        """Read exactly so many bytes if they are in memory; otherwise return None."""
        return self._blocks.read_at_once(self._extent, offset, length)

    def close(self) -> None:
        """Do nothing: blocks stay as long as there is memory for them."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Pieces:
    """The parts of a file, one after the other; remembers what the file or the caller objected."""

    def __init__(self, file: BinaryIO, part: int, progress: Progress | None) -> None:
        self._file = file
        self._part = part
        self._progress = progress
        self._stopped = False
        self.error: BaseException | None = None

    def stop(self) -> None:
        """Let the next part be an error, after which the store forgets those before."""
        self._stopped = True

    def __iter__(self) -> Iterator[bytes]:
        done = 0
        try:
            while piece := self._file.read(self._part):
                if self._stopped:
                    raise InterruptedError("stopped")
                done += len(piece)
                if self._progress is not None:
                    self._progress(done)
                yield piece
        except BaseException as error:
            self.error = error
            raise
