"""Sections of a container as it arrives in pieces of any length, each checked before it is passed on."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator
from typing import NamedTuple

from ..errors import CorruptStreamError, UnsupportedVersionError
from . import limits, sections
from .metadata import check_length

__all__ = [
    "Frame",
    "FrameReader",
    "index_extent",
    "index_sections",
    "section_extent",
    "section_lengths",
    "whole_section",
]

_SIGNATURE_BYTES = len(sections.SIGNATURE)
#: Bytes of the kind and length of a section, at most.
_MAX_START_BYTES = 10
_CRC_BYTES = 4  # at the end of a section
_KNOWN = frozenset(
    {
        sections.HEADER,
        sections.LAYER,
        sections.RESIDUAL,
        sections.METADATA,
        sections.INDEX,
        sections.MASKS,
        sections.KEPT_MASKS,
        sections.PAGES,
    }
)


class Frame(NamedTuple):
    """A section whose CRC holds: its payload stands at ``payload_offset``, all of it at ``offset`` to ``end``."""

    kind: int
    offset: int
    payload_offset: int
    payload: memoryview
    end: int


class _Passing:
    """A section whose bytes are checked as they arrive, and not kept.

    Parameters
    ----------
    kind, offset : int
        Kind of the section and its offset in the container.
    length : int
        Bytes of the whole section, the CRC included.
    """

    def __init__(self, kind: int, offset: int, length: int) -> None:
        self.kind, self._offset, self.left = kind, offset, length
        self._crc, self._end = 0, b""

    def take(self, data: bytes | memoryview) -> None:
        """Process the next bytes, at most as many as remain."""
        checked = max(min(len(data), self.left - _CRC_BYTES), 0)
        self._crc = zlib.crc32(memoryview(data)[:checked], self._crc)
        self._end += bytes(memoryview(data)[checked:])
        self.left -= len(data)

    def check(self) -> None:
        """Raise an error for a section that fails its CRC, or that is unknown and not optional."""
        _check(self._crc == int.from_bytes(self._end, "little"), self.kind, self._offset)


class FrameReader:
    """Sections in file order.

    Memory grows with the bytes that have arrived, never with a length that a section announces: a section within the
    bytes of one call is a view of these, others are assembled. Sections that are not in ``keeps`` are not assembled,
    only checked as they pass. Metadata that are too long are refused as soon as their length is known.

    Parameters
    ----------
    keeps : collection of int
        Kinds of the sections that are yielded; all others are only checked.
    """

    def __init__(self, keeps: Collection[int] = _KNOWN) -> None:
        self._keeps = keeps
        self._data: bytes | bytearray = b""  # of one call; or of several, while a section is incomplete
        self._place = 0  # of the first byte in `_data` that is not yet processed
        self._offset = 0  # of the same byte in the container
        self._passing: _Passing | None = None
        self._optional = self._windows = 0  # optional sections so far, and those of errors of windows
        self._started = False
        self.ended = False  # the index was read: nothing but the footer follows

    @property
    def position(self) -> int:
        """Bytes of the container taken so far, without those of a section that wait for the rest of it."""
        return self._offset

    @property
    def pending(self) -> int:
        """Bytes that wait for the rest of their section."""
        return len(self._data) - self._place

    @property
    def partial(self) -> bool:
        """Whether a section has begun that is not whole."""
        return self.pending > 0 or self._passing is not None

    def feed(self, data: bytes | memoryview) -> Iterator[Frame]:
        """Process bytes and yield the sections that they complete.

        Raises
        ------
        CorruptStreamError
            If the bytes are no container, a section fails its CRC, or there are more optional sections than allowed.
        UnsupportedVersionError
            If the container has another version, or an unknown section that is not optional.
        """
        if not self.pending:
            self._data, self._place = bytes(data), 0
        elif isinstance(self._data, bytes):
            self._data, self._place = bytearray(self._data[self._place :]) + data, 0
        else:
            self._data += data
        while not self.ended and self._begin():
            if self._passing is not None:
                if not self._pass(self._passing):
                    return
            elif (frame := self._next()) is not None:
                self.ended = frame.kind == sections.INDEX
                yield frame
            else:
                return

    def rest(self) -> bytes:
        """Return the bytes after the index, once it was read."""
        rest, self._data, self._place = bytes(self._ahead()), b"", 0
        return rest

    def _begin(self) -> bool:
        """Examine the start of the next section, unless one is passing; return False if more bytes are needed."""
        if self._passing is not None:
            return True
        if not self._started and not self._start():
            return False
        first = self._ahead(_MAX_START_BYTES)
        if self._offset == _SIGNATURE_BYTES and first and first[0] != sections.HEADER:
            raise CorruptStreamError(f"expected the header section first, got kind {first[0]}", _SIGNATURE_BYTES)
        extent = section_extent(first, self._offset)
        if extent is None:
            return False
        if first[0] not in self._keeps:
            self._optional += first[0] >= sections.OPTIONAL
            self._windows += first[0] == sections.WINDOW_ERRORS
            limits.check_count(self._optional, limits.OPTIONAL, "optional sections", self._offset)
            limits.check_count(self._windows, 1, "sections of errors of windows", self._offset)
            self._passing = _Passing(first[0], self._offset, extent[1])
        return True

    def _pass(self, passing: _Passing) -> bool:
        """Check bytes of a passing section; return False if there are more to come."""
        passing.take(self._take(min(self.pending, passing.left)))
        if passing.left:
            return False
        passing.check()
        self._passing, self.ended = None, passing.kind == sections.INDEX
        return True

    def _next(self) -> Frame | None:
        """Return the next section if it is complete."""
        first, offset = self._ahead(_MAX_START_BYTES), self._offset
        extent = section_extent(first, offset)
        if extent is None or self.pending < extent[1]:
            return None
        start, length = extent
        return checked(self._take(length), first[0], offset, start)

    def _start(self) -> bool:
        """Check the signature; return False if more bytes are needed."""
        first = self._ahead(_SIGNATURE_BYTES)
        sections.check_signature(bytes(first))
        if len(first) < _SIGNATURE_BYTES:
            return False
        self._take(_SIGNATURE_BYTES)
        self._started = True
        return True

    def _ahead(self, length: int | None = None) -> bytes | bytearray:
        """Return the next ``length`` unprocessed bytes, or all, without consuming them."""
        return self._data[self._place : None if length is None else self._place + length]

    def _take(self, length: int) -> bytes | memoryview:
        """Consume and return the next bytes."""
        consumed: bytes | memoryview
        if isinstance(self._data, bytes):
            consumed = memoryview(self._data)[self._place : self._place + length]
            self._place += length
        else:
            # What is left is the end of one call's bytes; what is taken may be as long as the file, and is not copied.
            taken, self._data, self._place = self._data, bytes(memoryview(self._data)[length:]), 0
            del taken[length:]
            consumed = memoryview(taken).toreadonly()
        self._offset += length
        return consumed


def section_lengths(read: Callable[[int, int], bytes], size: int) -> Iterator[tuple[int, int]]:
    """Return the kind of each section of a container, and its announced payload length in bytes.

    Nothing else is read or checked; it ends with the root of the index, or where the bytes are no section any more.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Gives fewer bytes where the container ends.
    size : int
        Bytes of the container.
    """
    place = _SIGNATURE_BYTES
    while place < size:
        head = read(place, 10)
        length = 0
        for number, byte in enumerate(head[1:]):
            length |= (byte & 127) << 7 * number
            if byte < 128:
                break
        else:
            return
        yield head[0], length
        if head[0] == sections.INDEX:
            return
        place += 1 + (number + 1) + length + 4


def section_extent(data: bytes | bytearray, offset: int) -> tuple[int, int] | None:
    """Return where the payload of the first section of ``data`` begins and the section ends; None: unknown yet.

    ``offset`` is the section's place in the container.

    Raises
    ------
    CorruptStreamError
        If the length takes more than nine bytes.
    """
    length, shift = 0, 0
    for place in range(1, min(len(data), 10)):
        length |= (data[place] & 127) << shift
        shift += 7
        if data[place] < 128:
            if data[0] == sections.METADATA:
                check_length(length, offset)
            return place + 1, place + 1 + length + 4
    if len(data) >= 10:
        raise CorruptStreamError("expected the length of a section, got a number of more than 9 bytes", offset)
    return None


def index_extent(data: bytes | bytearray, offset: int) -> int | None:
    """Return where the index at the start of ``data`` ends, pages and root; None: unknown yet."""
    pages = section_extent(data[:_MAX_START_BYTES], offset)
    if pages is None:
        return None
    root = section_extent(data[pages[1] : pages[1] + _MAX_START_BYTES], offset + pages[1])
    return None if root is None else pages[1] + root[1]


def index_sections(data: bytes, offset: int) -> tuple[Frame, Frame]:
    """Return the pages and the root of an index that was fetched by itself.

    Raises
    ------
    CorruptStreamError
        When these are not two whole sections.
    """
    pages = section_extent(data[:_MAX_START_BYTES], offset)
    end = len(data) if pages is None else pages[1]
    root = whole_section(data[end:], offset + end, sections.INDEX)
    return whole_section(data[:end], offset, sections.PAGES), root


def checked(frame: bytes | memoryview, kind: int, offset: int, start: int) -> Frame:
    """Return a whole section, whose payload starts at ``start``, after checking its CRC."""
    payload, crc = memoryview(frame)[start:-_CRC_BYTES], int.from_bytes(frame[-_CRC_BYTES:], "little")
    _check(zlib.crc32(memoryview(frame)[:-_CRC_BYTES]) == crc, kind, offset)
    return Frame(kind, offset, offset + start, payload, offset + len(frame))


def _check(sound: bool, kind: int, offset: int) -> None:
    """Refuse a section that is not sound, or that is not known and must be."""
    if not sound:
        raise CorruptStreamError(f"expected a section of kind {kind} to match its CRC, got other bytes", offset)
    if kind not in _KNOWN and kind < sections.OPTIONAL:
        raise UnsupportedVersionError(
            f"expected sections of version {sections.VERSION}, got an unknown one of kind {kind} that must not be "
            "skipped"
        )


def whole_section(data: bytes, offset: int, kind: int) -> Frame:
    """Return a section that was fetched by itself.

    Raises
    ------
    CorruptStreamError
        When it is not one whole section of that kind.
    """
    extent = section_extent(data[:10], offset)
    if extent is None or extent[1] != len(data) or data[0] != kind:
        raise CorruptStreamError(f"expected one whole section of kind {kind}, got other bytes", offset)
    return checked(data, kind, offset, extent[0])
