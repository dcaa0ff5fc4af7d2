"""Decoding a container while its bytes arrive."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container import headers, sections
from ..container.capacity import Capacity
from ..container.digest import DIGEST
from ..container.frames import Frame, FrameReader, index_extent, section_extent
from ..container.model import ByteRange, Chunk, Header, Index
from ..container.reader import INDEX_GROWTH, index_from, index_of, read_metadata
from ..container.slices import Slices, State
from ..entropy.dequantize import UNANNOUNCED
from ..errors import CorruptStreamError, InputError, TruncatedStreamError
from ..library import require
from ..planning.selection import Selection, select, selection_of
from ..surface import Surface
from ..target import Region, Target
from .batches import Coded
from .progress import Progress
from .segments import SegmentQueue
from .view import Ending, View
from .window_state import WindowState

__all__ = ["Decoder", "View", "decode"]

# What an entry of a layer's table becomes until its segment has been decoded.
_ENTRY = 256

Bytes = bytes  # the name within classes that have a property of this name


class Decoder:
    """Decodes a container while its bytes arrive, and returns a `View` for each state whose errors are known.

    `feed` takes the bytes in file order; `feed_at` takes slices in the order of a `plan`. Damaged bytes raise
    `CorruptStreamError` with their offset; the data before them stay usable. Segments are decoded when values are
    requested. Damage in a residual is found only when the residual is applied, so the complete state is verified when
    it is first requested: by `view`, `complete`, `finish`, errors or values. If it is damaged, this raises an error,
    and from then on the state before it is the last one.

    Parameters
    ----------
    selection : Selection or Target, optional
        A window of the surface, or some of its attributes. Views then contain nothing else. The errors of a window are
        bounds until it is complete, see `View.bound`. If it is a target, only its region, attributes and level are
        used. The caller decides in which order slices come and where they end (`lodestream.planning.planner.plan`).
    max_vertices : int or None
        Limit on the memory of the surface, see `capacity.Capacity`; checked before anything is decoded. None: as much
        as fits this process's memory.
    level : int or None
        The finest level that the caller will use; None: that of the selection, or full resolution. Only memory for this
        level is then counted, and a window consists of points of this level.

    Raises
    ------
    UnavailableError
        If the compiled kernels are missing.
    TooLargeError
        From methods that take bytes: if the header announces a surface that needs more memory than allowed, or if there
        are more bytes than such a surface can have.

    Examples
    --------
    >>> import lodestream
    >>> decoder = lodestream.Decoder()
    >>> with open("terrain.lode", "rb") as file:
    ...     while data := file.read(1000):
    ...         for view in decoder.feed(data):
    ...             pass  # draw view.points
    >>> decoder.finish()
    >>> view.complete, view.rms
    (True, 0.0)
    """

    def __init__(
        self,
        selection: Selection | Target | None = None,
        *,
        max_vertices: int | None = None,
        level: int | None = None,
    ) -> None:
        require("decoding")
        if isinstance(selection, Target):
            selection = selection_of(selection)
        selection = selection or Selection()
        self._selection = selection if level is None else replace(selection, level=level)
        self.capacity = Capacity(max_vertices)
        self.header: Header | None = None
        self._index: Index | None = None
        self._unparsed: tuple[Frame, Frame] | None = None  # pages and root of an index that nobody has asked for
        self.metadata: dict[str, Any] | None = None
        self.layers: list[View] = []
        self._values: dict[str, Any] = {}
        self._ending = Ending()  # filled when it comes, for views that were made before
        self._frames = FrameReader()
        self._pages: Frame | None = None  # of the index, before its root
        self._slices: Slices | None = None
        self._window: WindowState | None = None
        self._focus: Region | None = None  # the region that comes first
        self._near: NDArray[np.bool_] | None = None  # its tiles, once the index is known
        self._turned = False
        self._early: list[tuple[int, bytes]] = []
        self._loose: dict[int, tuple[int, bytearray]] = {}  # unfinished service sections, by where each goes on
        self._footer = bytearray()

    def feed(self, data: bytes | bytearray | memoryview) -> list[View]:
        """Decode the next bytes of the file, and return the views that they complete.

        Raises
        ------
        CorruptStreamError, UnsupportedVersionError
            The layers before the damage stay usable.
        InputError
            If it is no bytes, but the path of a file.
        """
        if isinstance(data, str | PathLike):
            raise InputError(
                f"expected the bytes of a container, got {data!r:.80}: pass what pathlib.Path(...).read_bytes() returns"
            )
        self.capacity.take(len(data))
        if self._frames.ended:
            self._take_footer(bytes(data))
            return []
        before = len(self.layers)
        for frame in self._frames.feed(bytes(data)):
            self._take(frame)
        if self._frames.ended:
            self._take_footer(self._frames.rest())
        return self.layers[before:]

    def feed_at(self, offset: int, data: bytes | bytearray | memoryview) -> list[View]:
        """Decode a slice of the container that starts at ``offset``, and return the views that it completes.

        Slices must come in the order of a `plan`. They may be cut anywhere.
        """
        before = len(self.layers)
        if self._slices is not None:
            self.capacity.take(len(data))
            self._take_part(offset, bytes(data))
        elif offset == self._frames.position + self._frames.pending:
            self.feed(data)
            if self.header is not None and (self.header.holes or not self.header.masked):
                early, self._early = self._early, []
                for place, more in early:
                    self._take_part(place, more)
        else:
            self.capacity.take(len(data))
            if self.header is None or (self.header.masked and not self.header.holes):
                self._early.append((offset, bytes(data)))
            else:
                self._take_loose(offset, bytes(data))
        return self.layers[before:]

    def focus(self, region: Region | None) -> None:
        """Announce another order of the bytes: the data of a region first; with None, the plan's own order.

        The index must have arrived before, or be among these bytes. A view is returned when a layer or level is
        complete in the region, and again when it is complete everywhere. Its errors are NaN if more data have arrived
        than belong to the layer.

        Raises
        ------
        OptionError
            If the header is known and the surface has no such region.
        """
        self._focus, self._turned = region, True
        if self.header is not None:
            Selection(region).check(self.header)
        self._follow_focus()

    def finish(self) -> None:
        """Declare that no more bytes will come.

        Raises
        ------
        TruncatedStreamError
            If the surface is not complete. The data received so far stay usable.
        CorruptStreamError
            If its end is damaged.
        """
        if self._ending.damage is not None:
            raise self._ending.damage
        if not self.complete:
            got, wanted = len(self.layers), self.header.layer_count if self.header else None
            what = f"{got} of {wanted} layers" if got != wanted else f"{got} layers without what makes them exact"
            raise TruncatedStreamError(
                f"expected a whole container, got {what if self.header else 'no header'} in "
                f"{self._frames.position + self._frames.pending} bytes: it is cut short"
            )

    @property
    def index(self) -> Index | None:
        """The index, once it has arrived; None before. It is parsed when it is first used.

        Raises
        ------
        CorruptStreamError
            If it contradicts itself or the header.
        """
        if self._unparsed is not None and self.header is not None:
            known = index_of(*self._unparsed, self.header)
            self._index = replace(known, metadata_values=self.metadata or {}, digest=self._ending.promised)
            self._unparsed = None
        return self._index

    @property
    def arrived(self) -> bool:
        """Whether all bytes of the surface have arrived. Nothing is decoded, so a residual may still be damaged."""
        return bool(self.layers) and self.layers[-1].complete

    @property
    def complete(self) -> bool:
        """Whether the whole surface has arrived and is not damaged; metadata and index may still be missing.

        Raises
        ------
        CorruptStreamError
            If its end is damaged, when this is first found.
        """
        self._verify()
        return self.arrived

    def view(self) -> View:
        """Return the current state.

        Raises
        ------
        TruncatedStreamError
            If the first layer is not complete.
        CorruptStreamError
            If the end is damaged, when this is first found; then the state before it is the current one.
        """
        self._verify()
        if not self.layers:
            raise TruncatedStreamError("expected at least one whole layer, got less")
        return self.layers[-1]

    def surface(self, level: int | None = None) -> Surface:
        """Return the current state as a surface, see `View.surface`."""
        return self.view().surface(level)

    def points_at(self, level: int) -> NDArray[Any]:
        """Return the current grid of a level, shape (row, column), or (row, column, component).

        See `View.points_at`.
        """
        return self.view().points_at(level)

    @property
    def level(self) -> int:
        """Finest level of which there are decoded data, see `view`."""
        return self.view().level

    @property
    def bytes(self) -> int:
        """Bytes received of header, layers and residual; 0 before the first layer is complete."""
        return self.layers[-1].bytes if self.layers else 0

    @property
    def rms(self) -> float:
        """Measured RMS error of the current state, see `view`."""
        return self.view().rms

    @property
    def max_error(self) -> float:
        """Measured maximum error of the current state, see `view`."""
        return self.view().max_error

    def _take(self, frame: Frame) -> None:
        if frame.kind == sections.HEADER:
            self._take_header(frame)
        elif self.header is None:
            raise CorruptStreamError(f"expected the header, got a section of kind {frame.kind}", frame.offset)
        elif frame.kind in (sections.MASKS, sections.KEPT_MASKS):
            self._take_masks(frame, self.header)
        elif self.header.masked and not self.header.holes:
            raise CorruptStreamError(f"expected masks, got a section of kind {frame.kind}", frame.offset)
        elif frame.kind == sections.LAYER:
            self._take_layer(frame, self.header)
        elif frame.kind == sections.RESIDUAL:
            self._take_residual(frame, self.header)
        elif frame.kind == sections.METADATA:
            self._take_metadata(sections.parse_metadata(frame.payload, frame.payload_offset))
        elif frame.kind == sections.PAGES:
            self._pages = frame
        else:
            self._take_index(frame)

    def _take_index(self, root: Frame) -> None:
        pages, self._pages = self._pages, None
        if pages is None:
            raise CorruptStreamError("expected the pages of an index before its root, got the root", root.offset)
        self.capacity.take(INDEX_GROWTH * (root.end - pages.offset))
        self._unparsed = pages, root

    def _take_footer(self, data: Bytes) -> None:
        offset, length = self._frames.position, sections.FOOTER_LENGTH
        self._footer += data[: length + 1 - len(self._footer)]
        if len(self._footer) > length:
            raise CorruptStreamError(
                "expected the end of the container, got more bytes", offset + sections.FOOTER_LENGTH
            )
        if len(self._footer) == length:
            sections.parse_footer(bytes(self._footer), offset)

    def _take_header(self, frame: Frame) -> None:
        if self.header is not None:
            raise CorruptStreamError("expected one header, got a second", frame.offset)
        self.header = headers.parse_header(frame.payload, frame.payload_offset, frame.end)
        self._selection.check_surface(self.header)
        self._selection.check_size(self.header, self.capacity)
        if not self.header.masked:
            self._begin(self.header)

    def _begin(self, header: Header) -> None:
        self._window = None if self._selection.region is None else WindowState(header, self._selection)
        self._progress = Progress(header)
        self._queue = SegmentQueue(header)
        self._level = 0

    def _take_masks(self, frame: Frame, header: Header) -> None:
        if not header.masked or header.holes:
            raise CorruptStreamError("expected layers, got masks", frame.offset)
        self.header = headers.parse_masks(header, frame)
        self._begin(self.header)

    def _take_layer(self, frame: Frame, header: Header) -> None:
        number = len(self.layers)
        if number >= header.layer_count:
            raise CorruptStreamError(f"expected {header.layer_count} layers, got more", frame.offset)
        errors, entries, start = sections.parse_layer(frame.payload, frame.payload_offset, header)
        self.capacity.take(_ENTRY * len(entries))
        segments = self._progress.advance_all(entries, frame.payload, start, frame.payload_offset)
        finest = entries[-1].tile if entries else 0  # tiles stand by level
        self._level = max(self._level, header.layout.level_of(finest))
        self._queue.add(segments)
        last = number + 1 == header.layer_count
        complete = last and not header.corrected
        figures = errors.rms, errors.maximum
        self._show(State(number, self._level, frame.end, *figures, complete, last, channels=errors.channels))

    def _take_residual(self, frame: Frame, header: Header) -> None:
        if len(self.layers) != header.layer_count or not header.corrected:
            raise CorruptStreamError("expected layers, got residual", frame.offset)
        errors, chunks = sections.parse_chunks(frame.payload, frame.payload_offset, header)
        for number, chunk in enumerate(chunks):
            self._queue.add_chunk(number, *chunk)
        number, figures = len(self.layers), (errors.rms, errors.maximum)
        self._show(State(number, header.levels, frame.end, *figures, True, True, channels=errors.channels))

    def _take_metadata(self, values: dict[str, Any]) -> None:
        if DIGEST in values:
            self._ending.promised = values.pop(DIGEST)
        self.metadata = values
        self._values.update(values)

    def _verify(self) -> None:
        """Verify the complete state, if it has arrived and is wanted.

        Raises
        ------
        CorruptStreamError
            If it is damaged; what came before the residual stays.
        """
        if self.header is None or not self.arrived or self._selection.finest(self.header) < self.header.levels:
            return
        try:
            self.layers[-1].verify()
        except CorruptStreamError:
            self.layers.pop()
            raise

    def _show(self, shown: State) -> None:
        corrected = shown.complete and self.header is not None and self.header.corrected
        window = self._window
        length, state = self._queue.length, self._progress.snapshot(shown.all_layers)
        self.capacity.take(state.nbytes)
        if self.header is not None and shown.whole_level >= 0:
            # The index says that there is nothing more of these levels.
            levels = state[: self.header.layout.tiles_of(shown.whole_level).stop]
            levels[levels == UNANNOUNCED] = 0
        if shown.whole_near and self._near is not None:
            state[self._near[:, None] & (state == UNANNOUNCED)] = 0
        figures = shown.rms, shown.max_error, False
        if window is not None:
            window.put_outside(shown, state)
            figures = window.figures(shown)
        view = View(
            shown.number,
            shown.level,
            shown.bytes,
            *figures,
            shown.complete,
            self._queue,
            length,
            state,
            corrected,
            self._values,
            self._ending,
            self._selection,
            channels=shown.channels if window is None else (),
        )
        self.layers.append(view)

    def _take_part(self, offset: int, data: Bytes) -> None:
        """Decode bytes of a plan, once the header is known."""
        if self._slices is None:
            self._take_loose(offset, data)
        elif self._window is None or not self._window.take(offset, data):
            self._take_slice(offset, data)

    def _take_loose(self, offset: int, data: Bytes) -> None:
        """Store bytes that do not continue the file, but belong to the index or the metadata."""
        start, run = self._loose.pop(offset, (offset, bytearray()))
        run += data
        kind, place = run[0], ByteRange(start, len(run))
        if kind not in (sections.PAGES, sections.METADATA):
            raise CorruptStreamError(f"expected the index or the metadata, got a section of kind {kind}", offset)
        if kind == sections.METADATA:
            extent = section_extent(run, start)
            end = None if extent is None else extent[1]
        else:
            end = index_extent(run, start)
        if end is None or len(run) < end:
            self._loose[start + len(run)] = start, run
            return
        if len(run) > end:
            raise CorruptStreamError("expected a section by itself, got bytes after it", start + end)
        if kind == sections.METADATA:
            self._take_metadata(read_metadata(bytes(run), place))
        elif self.header is not None:
            self.capacity.take(INDEX_GROWTH * len(run))
            self._index = index = index_from(bytes(run), place, self.header)
            chosen = select(index, self._selection)
            if self._window is not None:
                self._window.follow(index)
            finest = None if self._window is None else self._selection.finest(self.header)
            self._slices = Slices(index, chosen.segments, chosen.chunks, chosen.whole, finest)
            if self.layers or self._frames.partial:
                # The file was read in its own order so far, and is not any more.
                self._slices.continue_file(self._frames.position)
                self._follow_focus()
                self._take_slice(self._frames.position, self._frames.rest())
                for begun, part in self._loose.values():
                    self._take_slice(begun, bytes(part))
            else:
                self._follow_focus()
                if (state := self._slices.state()) is not None:
                    self._show(state)

    def _follow_focus(self) -> None:
        if self._turned and self._slices is not None and self.header is not None:
            self._near = None if self._focus is None else Selection(self._focus).tiles(self.header)
            self._slices.focus(self._near)

    def _take_slice(self, offset: int, data: Bytes) -> None:
        assert self._slices is not None
        self._slices.add(offset, data)
        for item, payload in self._slices.items():
            place = item.range.offset
            if sections.check_of(payload) != item.check:
                raise CorruptStreamError("expected a segment or chunk to match its CRC, got other bytes", place)
            if isinstance(item, Chunk):
                self._queue.add_chunk(self._slices.number(item), payload, place)
                state = self._slices.hold_chunk(item)
            else:
                first = self._progress.follow(item)
                self._queue.add([Coded(item.tile, item.channel, first, item.passes, payload, place)])
                state = self._slices.hold(item)
            if state is not None:
                self._show(state)
        frame = self._slices.metadata()
        if frame is not None:
            self._take_metadata(sections.parse_metadata(frame.payload, frame.payload_offset))


def decode(container: bytes | bytearray | memoryview, *, max_vertices: int | None = None) -> Surface:
    """Decode a complete container.

    Parameters
    ----------
    container : bytes
    max_vertices : int or None
        Limit on the memory of the surface, see `Decoder`.

    Returns
    -------
    Surface
        With the dtype and axes of the original. The values are bit for bit the same, unless a precision or an error was
        chosen in `encode`.

    Raises
    ------
    CorruptStreamError, UnsupportedVersionError
    TruncatedStreamError
        If the container is cut short; use `Decoder` for a prefix.
    TooLargeError
        If it needs more memory than allowed.
    InputError
        If it is no bytes, but the path of a file.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> lodestream.decode(pathlib.Path("terrain.lode").read_bytes())
    Surface(Block(97 x 70 float32, closed=(False, False)))
    """
    decoder = Decoder(max_vertices=max_vertices)
    decoder.feed(container)
    if decoder.arrived:
        decoder._queue.keep_last(decoder.layers[-1]._state)
    decoder.finish()
    return decoder.surface()
