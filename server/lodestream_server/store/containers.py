"""Stored containers that are open for reading, and their indexes."""

from __future__ import annotations

import logging
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from weakref import WeakValueDictionary

from lodestream.container.capacity import memory_limit
from lodestream.errors import CorruptStreamError, NotFoundError, StreamError, UnsupportedVersionError
from lodestream.stores import AbsentError, Blob

from ..problems import BusyError
from . import damage, layout
from .container_cache import ContainerCache
from .index import IndexLostError, Surface
from .surfaces import Surfaces

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


_log = logging.getLogger(__name__)

#: Reads bytes at an offset, so many of them.
Read = Callable[[int, int], bytes]

#: Takes the bytes of memory that one more index needs; those that there are for indexes; and of these all that are
#: taken, and those of the caller. Raises an error if the caller may not have the index.
Share = Callable[[int, int, int, int], None]


def _nothing(*_: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class OpenContainer:
    """A container that is open for reading; in a folder it stays readable if it is deleted meanwhile."""

    sha256: str
    index: Index
    blob: Blob
    held: ExitStack = field(default_factory=ExitStack)

    @property
    def is_here(self) -> bool:
        """Whether it is read from a file of this machine."""
        return self.blob.path is not None

    def read(self, place: ByteRange) -> bytes:
        """Read a slice; fewer bytes if the container ends. May be called from any thread."""
        return self.blob.read(place.offset, place.length)

    def read_at_once(self, place: ByteRange) -> bytes | None:
        """Read a slice if that needs no access to a disk; None if it would, or if the system cannot tell."""
        return self.blob.read_at_once(place.offset, place.length)

    def window_errors(self) -> WindowErrors | None:
        """Read the bounds of the errors of windows; None if the container has none. May be called from any thread.

        Raises
        ------
        CorruptStreamError
            If they are damaged.
        """
        from lodestream.planning.window_errors import read_window_errors

        return read_window_errors(self.index, self.blob.read)

    def close(self) -> None:
        """Close it; once more does nothing."""
        self.held.close()
        self.blob.close()


class Containers:
    """The containers of all surfaces, with the indexes of open containers and the most recently used others.

    Parameters
    ----------
    surfaces : Surfaces
    most : int or None
        Bytes of memory that all indexes may take; None: `most_for_indexes`.
    lost : callable
        Called with surfaces that are queued again, because their container is not there or is no longer read.
    cache : ContainerCache, optional
        For a store on another machine.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        most: int | None = None,
        lost: Callable[[list[Surface]], object] = _nothing,
        cache: ContainerCache | None = None,
    ) -> None:
        self._surfaces = surfaces
        self._cache = cache
        self._lost = lost
        self._most = most_for_indexes() if most is None else most
        self._coming: Counter[str] = Counter()  # bytes of indexes that are being read, by caller
        self._open: dict[str, Counter[str]] = {}  # what callers have open, and how often
        self._lock = threading.Lock()
        self._used: OrderedDict[str, Index] = OrderedDict()
        self._sizes: dict[str, int] = {}  # bytes of indexes
        self._indexes: WeakValueDictionary[str, Index] = WeakValueDictionary()
        self._readers: WeakValueDictionary[str, _Reader] = WeakValueDictionary()

    def blob(self, sha256: str) -> Blob:
        """Open the bytes of a container.

        Raises
        ------
        NotFoundError
            If no surface has it.
        BusyError
            If it is built again, because it was not there.
        StreamError
            If it has not the length that it had when it was stored.
        StoreError
            If the store cannot be read.
        """
        blob, size = self._bytes(sha256)
        if blob.size != size:
            blob.close()
            error = StreamError(f"expected {size} bytes of the container {sha256}, got {blob.size}")
            self.tell_damage(sha256, error)
            raise error
        return blob

    @contextmanager
    def local(self, sha256: str) -> Iterator[Path]:
        """Give a container as a file on this machine for the length of a block; it must not be changed.

        Raises
        ------
        NotFoundError, BusyError, StoreError
            See `blob`.
        TooLargeError, FullError, StreamError
            Of one on another machine, see `ContainerCache.local`.
        """
        size = self._check(sha256)
        with ExitStack() as stack:
            try:
                if self._cache is None:
                    local = self._surfaces.store.local(layout.container_key(sha256))
                else:
                    local = self._cache.local(sha256, size)
                path = stack.enter_context(local)
            except AbsentError:
                self.gone(sha256)
            except StreamError as error:
                self.tell_damage(sha256, error)
                raise
            yield path

    def is_here(self, sha256: str) -> bool:
        """Return whether `local` need not fetch a container."""
        return self._cache is None or sha256 in self._cache

    def is_used(self, sha256: str) -> bool:
        """Return whether a surface has this container, as far as the index knows."""
        with suppress(IndexLostError):
            return self._surfaces.index.uses_container(sha256)
        return True

    def tell_damage(self, sha256: str, error: StreamError) -> None:
        """Log that a container turned out to be damaged when it was read."""
        self.forget(sha256)  # it may be the file that is
        damage.tell(self._surfaces, sha256, error)

    def forget(self, sha256: str) -> None:
        """Remove what is kept of a container that is deleted."""
        if self._cache is not None:
            self._cache.forget(sha256)

    def close(self) -> None:
        """End what goes on in the background."""
        if self._cache is not None:
            self._cache.close()

    def _bytes(self, sha256: str) -> tuple[Blob, int]:
        """Open the bytes of a container; return also how many it had when it was stored."""
        size = self._check(sha256)
        cached = None if self._cache is None else self._cache.open(sha256, size)
        if cached is not None:
            return cached, size
        try:
            return self._surfaces.store.open(layout.container_key(sha256), size), size
        except AbsentError:
            self.gone(sha256)

    def _check(self, sha256: str) -> int:
        """Return the bytes of a container that some surface has; raise an error if none has it."""
        size = self._surfaces.index.served_bytes(sha256)
        if size is None and not self._surfaces.index.uses_container(sha256):
            raise NotFoundError(f"No container {sha256[:80]!a} on this server")
        if size is None:
            raise BusyError(f"The container {sha256} was not there, and is built again; try again later")
        return size

    def gone(self, sha256: str) -> NoReturn:
        """Have a container built again that is not in the store, as a read has shown.

        Raises
        ------
        NotFoundError
            If no surface has it any more.
        BusyError
            Otherwise.
        """
        lost = self._surfaces.lose(sha256)
        if not lost and not self._surfaces.index.uses_container(sha256):
            raise NotFoundError(f"No container {sha256[:80]!a} on this server")
        if lost:
            _log.error("the container %s is not in the store, and is built again", sha256)
            self._lost(lost)
        raise BusyError(f"The container {sha256} was not there a moment ago; try again soon")

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
        NotFoundError, StoreError
            See `blob`.
        StreamError
            If it is damaged.
        BusyError
            If the indexes of open containers leave no memory for its index, or the container is built again.
        """
        blob, _ = self._bytes(sha256)
        try:
            return self._opened(sha256, self._index(sha256, blob, caller, share), blob, caller)
        except UnsupportedVersionError as error:
            blob.close()
            if lost := self._surfaces.lose(sha256, unreadable=True):
                _log.info("the container %s is built again: %s", sha256, error)
                self._lost(lost)
            raise BusyError(
                f"the container {sha256} is of another version and is built again; try again soon"
            ) from None
        except StreamError as error:
            blob.close()
            self.tell_damage(sha256, error)
            raise
        except AbsentError:  # of a bucket the first read says so
            blob.close()
            self.gone(sha256)
        except BaseException:
            blob.close()
            raise

    def open_known(self, sha256: str, caller: str = "") -> OpenContainer | None:
        """Open a container if its index is in memory, so that nothing is read; otherwise return None.

        Raises
        ------
        NotFoundError, BusyError, StoreError
            See `blob`.
        """
        with self._lock:
            index = self._known(sha256)
        return None if index is None else self._opened(sha256, index, self._bytes(sha256)[0], caller)

    def _opened(self, sha256: str, index: Index, blob: Blob, caller: str) -> OpenContainer:
        with self._lock:
            self._open.setdefault(caller, Counter())[sha256] += 1
        held = ExitStack()
        held.callback(self._let_go, caller, sha256)
        return OpenContainer(sha256, index, blob, held)

    def _let_go(self, caller: str, sha256: str) -> None:
        with self._lock:
            held = self._open[caller]
            held[sha256] -= 1
            if not held[sha256]:
                del held[sha256]
            if not held:
                del self._open[caller]

    def _index(self, sha256: str, blob: Blob, caller: str, share: Share) -> Index:
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
                kept, masks = index_memory(blob.read, blob.size)
                with self._room(kept + masks, caller, share):
                    known = _read_index(blob)
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
                    f"The indexes of streamed surfaces may take {self._most >> 20} MiB of memory: {taken >> 20} MiB is "
                    f"taken, and this one needs {size >> 20} MiB more; try again soon"
                )
            # Those that nobody has open make room. Who has nothing yet finds a place.
            everybody = self._coming.total() + self._bytes_of(set().union(*self._open.values()))
            of_caller = self._coming[caller] + self._bytes_of(self._open.get(caller, ()))
            if of_caller:
                share(size, self._most, everybody, of_caller)
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


def index_memory(read: Read, size: int) -> tuple[int, int]:
    """Estimate the bytes of memory of a container's index from the lengths of its sections.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Gives fewer bytes where the container ends.
    size : int
        Bytes of the container.

    Returns
    -------
    int
        Of the index that is kept, which has no masks and no metadata.
    int
        Of masks, while the index is read.
    """
    from lodestream.container import section_lengths
    from lodestream.container.reader import INDEX_GROWTH
    from lodestream.container.sections import FOOTER_LENGTH, KEPT_MASKS, MASKS, parse_footer

    tail = max(size - FOOTER_LENGTH, 0)
    try:
        index = parse_footer(read(tail, FOOTER_LENGTH), tail)[0].length
    except CorruptStreamError:
        index = 0
    sections = [*islice(section_lengths(read, size), 2), (0, 0), (0, 0)]
    header = sections[0][1]
    masks = sections[1][1] if sections[1][0] in (MASKS, KEPT_MASKS) else 0
    # A length that the file does not have is refused when it is read.
    header = min(header, tail)
    parts = _parts(read, header) * _PART_BYTES
    return _LEAST_INDEX + INDEX_GROWTH * index + _HEADER_GROWTH * header + parts, _COPIES_OF_MASKS * min(masks, tail)


def _parts(read: Read, length: int) -> int:
    """Return the number of blocks, patches, interfaces and channels in a header whose payload has ``length`` bytes.

    0 if it cannot be read: it is refused then when the index is read.
    """
    from lodestream.container.frames import section_extent, whole_section
    from lodestream.container.headers import parse_header
    from lodestream.container.sections import HEADER, SIGNATURE

    offset = len(SIGNATURE)
    try:
        data = read(offset, length + 16)  # and what stands before and behind the payload
        extent = section_extent(data[:10], offset)
        frame = whole_section(data[: extent[1]] if extent else data, offset, HEADER)
        header = parse_header(frame.payload, frame.payload_offset, frame.end)
    except StreamError:
        return 0
    grids = 0 if header.arrangement is None else len(header.arrangement.patches) + len(header.arrangement.interfaces)
    return len(header.blocks) + grids + header.channels


def _read_index(blob: Blob) -> Index:
    """Read the index without masks and metadata, which no plan needs."""
    from lodestream.container import read_index

    index = read_index(blob.read, blob.size)
    return replace(index, header=replace(index.header, mask_data=(), kept_data=()), metadata_values={})
