"""Stored containers that are open for reading, and their indexes."""

from __future__ import annotations

import os
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, BinaryIO
from weakref import WeakValueDictionary

from lodestream.container.capacity import memory_limit
from lodestream.errors import CorruptStreamError, StreamError
from lodestream.operating_system import read_at, read_cached

from ..problems import BusyError
from . import damage
from .storage import Storage

if TYPE_CHECKING:
    from lodestream.container import ByteRange, Index
    from lodestream.planning.window_errors import WindowErrors

__all__ = ["Containers", "OpenContainer", "Share", "index_memory", "most_for_indexes"]

# An index holds a record per segment, and whoever makes a container may make many: so many are kept when nobody has the
# container open any more, as long as they take no more bytes than this.
_INDEXES_KEPT = 16
_BYTES_KEPT = 64 << 20

# Of an index without its masks and metadata: that of the smallest surface, and the tables of its levels.
_LEAST_INDEX = 16 << 10
# How many times its bytes a header takes in memory: joints and rules of x and y are lists of numbers there.
_HEADER_GROWTH = 64
# What a block, a patch, an interface or a channel takes, with its sides and its grids at each level.
_PART_BYTES = 4 << 10
# How often the bytes of masks are in memory while the index is read.
_COPIES_OF_MASKS = 4


#: Takes the bytes of memory that there are for indexes, and of these all that are taken and those of the caller, with
#: one more index; raises an error if the caller may not have that.
Share = Callable[[int, tuple[int, int]], None]


def _nothing(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class OpenContainer:
    """A container that is open for reading; it stays readable if it is deleted meanwhile."""

    sha256: str
    index: Index
    file: BinaryIO
    let_go: Callable[[], None] = _nothing

    def read(self, place: ByteRange) -> bytes:
        """Read a slice; fewer bytes if the file ends. May be called from any thread."""
        return _read_from(self.file.fileno(), place.offset, place.length)

    def read_at_once(self, place: ByteRange) -> bytes | None:
        """Read a slice if that needs no disk access; None if it would, or if the system cannot tell."""
        return read_cached(self.file.fileno(), place.length, place.offset)

    def window_errors(self) -> WindowErrors | None:
        """Read the bounds of the errors of windows; None if the container has none. May be called from any thread.

        Raises
        ------
        CorruptStreamError
            If they are damaged.
        """
        from lodestream.planning.window_errors import read_window_errors

        return read_window_errors(self.index, partial(_read_from, self.file.fileno()))

    def close(self) -> None:
        """Close the file."""
        if not self.file.closed:
            self.let_go()
        self.file.close()


class Containers:
    """The containers of a storage, with the indexes of open containers and the most recently used others.

    Parameters
    ----------
    storage : Storage
    most : int or None
        Bytes of memory that all indexes may take; None: `most_for_indexes`.
    """

    def __init__(self, storage: Storage, most: int | None = None) -> None:
        self._storage = storage
        self._most = most_for_indexes() if most is None else most
        self._coming: Counter[str] = Counter()  # bytes of indexes that are being read, by caller
        self._open: dict[str, Counter[str]] = {}  # what callers have open, and how often
        self._lock = threading.Lock()
        self._used: OrderedDict[str, Index] = OrderedDict()
        self._sizes: dict[str, int] = {}  # bytes of indexes
        self._indexes: WeakValueDictionary[str, Index] = WeakValueDictionary()
        self._readers: WeakValueDictionary[str, _Reader] = WeakValueDictionary()

    def open(self, sha256: str, caller: str = "", share: Share = _nothing) -> OpenContainer:
        """Open a container.

        Parameters
        ----------
        sha256 : str
        caller : str
            Key of who has it open; each index counts for everybody who has.
        share : callable
            Checks the share of the caller where an index is to be read, and raises what it has to say.

        Raises
        ------
        NotFoundError
            If there is none.
        MissingError
            If it is not on disk.
        StreamError
            If it is damaged.
        BusyError
            If the indexes of open containers leave no memory for its index, or it was deleted and stored again at this
            moment.
        """
        file = self._file(sha256)
        try:
            return self._opened(sha256, self._index(sha256, file, caller, share), file, caller)
        except StreamError as error:
            file.close()
            damage.tell(self._storage, sha256, error)
            raise
        except BaseException:
            file.close()
            raise

    def open_known(self, sha256: str, caller: str = "") -> OpenContainer | None:
        """Open a container if its index is in memory, so that nothing is read; otherwise return None.

        Raises
        ------
        NotFoundError, MissingError, BusyError
            See `open`.
        """
        with self._lock:
            index = self._known(sha256)
        return None if index is None else self._opened(sha256, index, self._file(sha256), caller)

    def _file(self, sha256: str) -> BinaryIO:
        try:
            return self._storage.container(sha256).open("rb")
        except FileNotFoundError:
            raise self._storage.gone(sha256) from None

    def _opened(self, sha256: str, index: Index, file: BinaryIO, caller: str) -> OpenContainer:
        with self._lock:
            self._open.setdefault(caller, Counter())[sha256] += 1
        return OpenContainer(sha256, index, file, partial(self._let_go, caller, sha256))

    def _let_go(self, caller: str, sha256: str) -> None:
        with self._lock:
            held = self._open[caller]
            held[sha256] -= 1
            if not held[sha256]:
                del held[sha256]
            if not held:
                del self._open[caller]

    def _index(self, sha256: str, file: BinaryIO, caller: str, share: Share) -> Index:
        with self._lock:
            known = self._known(sha256)
            if known is not None:
                return known
            reader = self._readers.get(sha256)
            if reader is None:
                reader = self._readers[sha256] = _Reader()
        # Of many who open one container at the same time one reads its index.
        with reader.lock:
            with self._lock:
                known = self._known(sha256)
            if known is None:
                kept, masks = index_memory(file)
                with self._room(kept + masks, caller, share):
                    known = _read_index(file)
                    with self._lock:
                        self._sizes[sha256] = kept
                        self._indexes[sha256] = known
                        self._known(sha256)
            return known

    @contextmanager
    def _room(self, size: int, caller: str, share: Share) -> Iterator[None]:
        with self._lock:
            if self._taken() + size > self._most:
                self._used.clear()
            taken = self._taken()
            if taken + size > self._most:
                raise BusyError(
                    f"expected at most {self._most >> 20} MiB of memory for the indexes of all surfaces that are "
                    f"streamed, got {taken >> 20} MiB and {size >> 20} MiB more; try again soon"
                )
            # Those that nobody has open make room. Who has nothing yet finds a place.
            everybody = self._coming.total() + self._bytes_of(set().union(*self._open.values()))
            of_caller = self._coming[caller] + self._bytes_of(self._open.get(caller, ()))
            share(self._most, (everybody + size, of_caller + size if of_caller else 0))
            self._coming[caller] += size
        try:
            yield
        finally:
            with self._lock:
                self._coming[caller] -= size
                if not self._coming[caller]:
                    del self._coming[caller]

    def _bytes_of(self, names: Iterable[str]) -> int:
        return sum(self._sizes.get(sha256, 0) for sha256 in names)

    def _taken(self) -> int:
        self._sizes = {sha256: self._sizes[sha256] for sha256 in tuple(self._indexes)}
        return self._coming.total() + sum(self._sizes.values())

    def _known(self, sha256: str) -> Index | None:
        index = self._indexes.get(sha256)
        if index is not None:
            self._used[sha256] = index
            self._used.move_to_end(sha256)
            while len(self._used) > _INDEXES_KEPT or sum(map(self._sizes.__getitem__, self._used)) > _BYTES_KEPT:
                self._used.popitem(last=False)
        return index


class _Reader:
    """Whoever reads an index, and those who wait for it."""

    def __init__(self) -> None:
        self.lock = threading.Lock()


def most_for_indexes() -> int:
    """Return the bytes of memory that indexes may take: an eighth of the memory available."""
    return memory_limit() // 8


def index_memory(file: BinaryIO) -> tuple[int, int]:
    """Estimate the bytes of memory of a container's index from the lengths of its sections.

    Returns
    -------
    int
        Of the index that is kept, which has no masks and no metadata.
    int
        Of masks, while the index is read.
    """
    from lodestream.container.frames import section_lengths
    from lodestream.container.reader import INDEX_GROWTH
    from lodestream.container.sections import FOOTER_LENGTH, KEPT_MASKS, MASKS, parse_footer

    tail = max(os.fstat(file.fileno()).st_size - FOOTER_LENGTH, 0)
    try:
        index = parse_footer(_read_from(file.fileno(), tail, FOOTER_LENGTH), tail)[0].length
    except CorruptStreamError:
        index = 0
    sections = [*islice(section_lengths(file), 2), (0, 0), (0, 0)]
    header = sections[0][1]
    masks = sections[1][1] if sections[1][0] in (MASKS, KEPT_MASKS) else 0
    # A length that the file does not have is refused when it is read.
    header = min(header, tail)
    parts = _parts(file.fileno(), header) * _PART_BYTES
    return _LEAST_INDEX + INDEX_GROWTH * index + _HEADER_GROWTH * header + parts, _COPIES_OF_MASKS * min(masks, tail)


def _parts(handle: int, length: int) -> int:
    """Return the number of blocks, patches, interfaces and channels in a header whose payload has ``length`` bytes.

    0 if it cannot be read: it is refused then when the index is read.
    """
    from lodestream.container.frames import section_extent, whole_section
    from lodestream.container.headers import parse_header
    from lodestream.container.sections import HEADER, SIGNATURE

    offset = len(SIGNATURE)
    try:
        data = _read_from(handle, offset, length + 16)  # and what stands before and behind the payload
        extent = section_extent(data[:10], offset)
        frame = whole_section(data[: extent[1]] if extent else data, offset, HEADER)
        header = parse_header(frame.payload, frame.payload_offset, frame.end)
    except StreamError:
        return 0
    grids = 0 if header.arrangement is None else len(header.arrangement.patches) + len(header.arrangement.interfaces)
    return len(header.blocks) + grids + header.channels


def _read_index(file: BinaryIO) -> Index:
    """Read the index without masks and metadata, which no plan needs."""
    from lodestream.container import read_index

    handle = file.fileno()
    index = read_index(partial(_read_from, handle), os.fstat(handle).st_size)
    return replace(index, header=replace(index.header, mask_data=(), kept_data=()), metadata_values={})


def _read_from(handle: int, offset: int, length: int) -> bytes:
    """Read bytes of a file, fewer if it ends; repeats reads that the system cuts short."""
    data = bytearray()
    while len(data) < length:
        piece = read_at(handle, length - len(data), offset + len(data))
        if not piece:
            break
        data += piece
    return bytes(data)
