"""``lodestream decode`` of surfaces that do not fit into memory: by bands of rows or by blocks, through files."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import CorruptStreamError, LodestreamError, StreamError, TooLargeError, TruncatedStreamError
from lodestream.target import Target

from .inputs import named
from .outcome import Outcome, check_grid

if TYPE_CHECKING:
    from lodestream.decoding.piecewise import PiecewiseDecoder
    from lodestream.planning.byte_ranges import RangeSet

    from .decode import DecodeOptions

__all__ = ["by_rows"]

#: Bytes for each value that decoding in one piece takes.
_WHOLE = 12
#: The part of the memory that an array in memory may take.
_PART = 16
#: In the folder on the way to the file: arrays, and the file with what its writer makes beside it.
_VALUES, _FILE = "values", "file"


def by_rows(path: Path, options: DecodeOptions, started: float, progress: Callable[[float], None]) -> Outcome | None:
    """Decode a surface, or a level of it, by bands, if it takes more memory than there is.

    It is decoded into files beside OUT, from which OUT is written.

    Returns
    -------
    Outcome or None
        None: it takes no more than there is, or cannot be decoded by bands, and nothing was done.

    Raises
    ------
    TooLargeError
        If there are more vertices than allowed, or if decoding or writing takes more memory than was given, or than
        the machine has if none was.
    LodestreamError, OSError
        From decoding and writing.
    """
    if options.target.region is not None:
        return None
    from lodestream.container.capacity import Capacity, default_memory
    from lodestream.container.reader import read_index
    from lodestream.decoding.piecewise import PiecewiseDecoder
    from lodestream.planning.byte_ranges import RangeSet

    memory = default_memory() if options.memory is None else options.memory
    size, seen = path.stat().st_size, RangeSet()
    with path.open("rb") as file:

        def read(offset: int, length: int) -> bytes:
            file.seek(offset)
            data = file.read(length)
            seen.add(offset, len(data))
            return data

        capacity = Capacity(options.max_vertices)
        try:
            index = read_index(read, size, capacity)
            header, level = index.header, options.target.level
            if level is not None and level > header.levels:
                return None  # decoding in one piece tells so
            decoder = PiecewiseDecoder(read, index, level)
        except (CorruptStreamError, TruncatedStreamError, TooLargeError):
            return None  # decoding in one piece tells what is wrong with it, and what is left
        check_grid(options.out, header)
        needs = _Needs(decoder, options, memory)
        try:
            needs.check(memory)
            if needs.whole(memory):
                return None
            capacity.promise(needs.points, (), masked=0, tables=header.tables)
        except TooLargeError as error:
            raise named(error, options.container) from None
        # Or GDAL would take a twentieth of the machine's memory for what it writes; in megabytes.
        os.environ.setdefault("GDAL_CACHEMAX", str(max(memory >> 22, 32)))
        try:
            return _decode(decoder, Path(options.out), memory, started, progress, seen)
        except StreamError as error:
            raise named(error, options.container) from None


class _Needs:
    """The memory that decoding all points of a surface or a level takes.

    Attributes
    ----------
    points : int
    decoding : int
        Bytes that it takes in one piece.
    reason : str or None
        Why it is not done by bands; None: it can be.
    """

    def __init__(self, decoder: PiecewiseDecoder, options: DecodeOptions, memory: int) -> None:
        from lodestream.container.capacity import memory_limit
        from lodestream.decoding.pieces import why_not_by_pieces
        from lodestream.formats import for_writing, written
        from lodestream.planning.selection import selection_of

        self._format = written("npy") if options.out == "-" else for_writing(options.out)
        self._limit = memory if options.memory is not None else memory_limit()
        header = decoder.header
        shapes = decoder.shapes
        self._several = len(shapes) > 1
        self.points = sum(rows * columns for rows, columns in shapes)
        self._together = max(rows * columns for rows, columns in shapes) if self._format.by_block else self.points
        channels = selection_of(options.target).channels(header)
        self.decoding = self.points * int(channels.sum()) * _WHOLE
        self._values = self.points * sum(
            kind.itemsize for kind, wanted in zip(header.dtypes, channels, strict=True) if wanted
        )
        if options.out == "-":
            self.reason: str | None = "standard output is written in one piece"
        elif options.partial or replace(options.target, level=None) != Target():
            self.reason = "only the whole surface or a level is, without --partial, limits and --attributes"
        else:
            self.reason = why_not_by_pieces(header, self._limit, decoder.level)

    def whole(self, memory: int) -> bool:
        """Return whether to decode in one piece.

        Bands are not possible, or there is memory for the surface and its writer.
        """
        writing = self._format.memory * self._together + self._values
        return self.reason is not None or (self.decoding <= memory and writing <= self._limit)

    def check(self, memory: int) -> None:
        """Refuse a decoding that takes more memory than was given or, by default, than there is.

        Raises
        ------
        TooLargeError
        """
        from lodestream.formats import formats

        limit, alone = self._limit, self._format.memory * self._together
        whole = self.whole(memory)
        writing = alone + (self._values if whole else 0)
        if self._format.memory and writing > limit:
            needed = (
                f"expected a surface that takes at most {limit >> 20:,} MiB to write as {self._format.name}, got one "
            )
            needed += f"that takes about {-(-writing >> 20):,} MiB"
            if alone <= limit and self.reason is not None:
                raise TooLargeError(f"{needed} and is not decoded by bands: {self.reason}; --memory takes more")
            by_part = [
                it.name
                for it in formats()
                if it is not self._format
                and (it.write or it.write_beside)
                and (it.by_block if self._several else not it.memory)
            ]
            how = "block by block" if self._several else "by bands of rows"
            raise TooLargeError(f"{needed}; {', '.join(by_part)} are written {how}, and --memory takes more")
        if self.reason is not None and self.decoding > limit:
            raise TooLargeError(
                f"expected a surface that takes at most {limit >> 20:,} MiB to decode, got one that takes about "
                f"{-(-self.decoding >> 20):,} MiB and is not decoded by bands: {self.reason}; --memory takes more"
            )


def _decode(
    decoder: PiecewiseDecoder,
    out: Path,
    memory: int,
    started: float,
    progress: Callable[[float], None],
    seen: RangeSet,
) -> Outcome:
    from lodestream.encoding.folders import temporary_folder
    from lodestream.scratch import FolderScratch, Room

    with temporary_folder(out.resolve().parent, out.name) as folder:
        surface = decoder.surface(Room(lambda: FolderScratch(folder / _VALUES), memory // _PART), memory, progress)
        index, last = decoder.index, decoder.index.levels[decoder.level]
        finest = decoder.level == decoder.header.levels
        outcome = Outcome(
            surface,
            index.surface_end if finest else last.bytes,
            index.size if finest else seen.total,
            index.size if finest else seen.total,
            decoder.level,
            last.rms,
            last.max_error,
            False,
            time.monotonic() - started,
            "complete" if finest else "level",
            dict(zip(decoder.header.channel_names, last.channels, strict=False)),
        )
        _write(outcome, out, folder / _FILE)
        return outcome


def _write(outcome: Outcome, out: Path, folder: Path) -> None:
    """Write OUT in a folder of its own, since writers may leave other files there, and move it to its place.

    A pipe or a device is written to directly. The writer of a folder reports itself what is in its way. A file with a
    folder, as of .vtm, is put in place by its writer, which names both.
    """
    from lodestream.formats import for_writing

    format_ = for_writing(out)
    together = format_.write is not None and format_.write_beside is not None
    if together or (out.exists() and (not out.is_file() or format_.write is None)):
        outcome.write(str(out))
        return
    folder.mkdir()
    written = folder / out.name
    try:
        outcome.write(str(written))
        written.replace(out.resolve())  # a link stays a link
    except LodestreamError as error:
        error.args = tuple(str(part).replace(str(written), str(out)) for part in error.args)
        raise
    except OSError as error:
        error.filename, error.filename2 = str(out), None
        raise
