"""Containers that are read as they are asked: their description, states, windows and levels."""

from __future__ import annotations

import hashlib
import logging
import os
import time
import weakref
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Self

from ..container import describe, read_index
from ..container.capacity import Capacity
from ..container.model import ByteRange, Header, Index
from ..decoding.decoder import Decoder
from ..decoding.view import View
from ..errors import InputError, LodestreamError, OptionError, named
from ..planning.plan import Plan
from ..planning.planner import plan
from ..planning.window_errors import read_window_errors, wants_window_errors
from ..sizes import parse_size
from ..surface import Surface
from ..target import Limits, Target, check_target
from .byte_sources import AT_ONCE, ByteSource
from .open_source import open_source

if TYPE_CHECKING:
    import xarray

__all__ = ["Container", "open"]

_log = logging.getLogger(__name__)

Bytes = bytes  # the name where a parameter is called bytes


class Container:
    """A container that is somewhere else, of which only what a call needs is read; `lodestream.open` returns one.

    Its methods may be called from any thread. It can be pickled: a copy is opened again, and refused if there is
    another container by then. What reads raises `LodestreamError` or `OSError` if the bytes cannot be had, with a note
    that names the place.

    Parameters
    ----------
    source : ByteSource
    max_vertices : int or None
        Limit on the memory of what is decoded at once, see `lodestream.Decoder`.

    Attributes
    ----------
    source : ByteSource
        Its bytes, with ``place``, ``name`` and ``size``.
    index : Index
        What it contains, and where.

    Raises
    ------
    StreamError, TooLargeError
        If it is damaged, cut short or too large.

    Examples
    --------
    >>> import lodestream
    >>> with lodestream.open("terrain.lode") as container:
    ...     rough = container.view(rms=5)
    ...     window = container.window((10, 50), (20, 60))
    >>> rough.complete, rough.rms <= 5, rough.points.shape, window.shape
    (False, True, (97, 70), (40, 40))
    """

    def __init__(self, source: ByteSource, max_vertices: int | None = None) -> None:
        self.source = source
        self._max_vertices = max_vertices
        self._kept: list[tuple[int, Bytes]] = []  # header, index and metadata, which every call needs
        self._open = weakref.finalize(self, source.close)
        self._open.atexit = False  # the system closes connections of a process that ends
        try:
            with named(source.place):
                self.index: Index = read_index(self._first, source.size, Capacity(max_vertices))
        except BaseException:
            self.close()
            raise

    @property
    def header(self) -> Header:
        """The header: shapes, levels, channels, masks."""
        return self.index.header

    @property
    def info(self) -> dict[str, Any]:
        """What ``lodestream info --json`` prints of a container: shape, levels and layers with bytes and errors, ..."""
        return describe(self.index, channels=True)

    def view(
        self,
        *,
        rms: Limits | None = None,
        max_error: Limits | None = None,
        bytes: int | str | None = None,
        level: int | None = None,
        attributes: Sequence[str] | str | None = None,
    ) -> View:
        """Read up to a limit, and return the state there; without limits all, which is exact if the container is.

        Parameters
        ----------
        rms, max_error : number, text, Tolerance, mapping or None
            The first layer with an error of at most this, in the surface's unit, or relative to its extent (a text);
            see `lodestream.Target`.
        bytes : int, text or None
            The last layer that ends within so many bytes; a text such as ``"20kB"`` or ``"1MiB"``.
        level : int or None
            This level and coarser ones, exactly; `View.surface` and `View.points_at` take its number.
        attributes : sequence of str, or None
            Names of the attributes to include; None: all.

        Raises
        ------
        OptionError
            If a limit is not allowed, or two contradict each other, see `Target`; or nothing meets it.
        StreamError, TooLargeError
            If it is damaged or takes too much memory.
        """
        chosen = None if attributes is None else tuple([attributes] if isinstance(attributes, str) else attributes)
        try:
            most = parse_size(bytes) if isinstance(bytes, str) else bytes
        except ValueError as error:
            raise OptionError(str(error)) from None
        return self.view_at(Target(until_rms=rms, until_max=max_error, max_bytes=most, level=level, attributes=chosen))

    def window(
        self,
        rows: tuple[int, int],
        columns: tuple[int, int],
        level: int | None = None,
        attributes: Sequence[str] | str | None = None,
    ) -> Surface:
        """Read a window of the only block, exact if the container is; only the slices that it needs.

        Parameters
        ----------
        rows, columns : (int, int)
            Half-open, of the full grid at any level. Along a closed axis they may go on across the seam, as columns
            (350, 370) of 360.
        level : int or None
            A coarser level, of which those points are taken that lie in the window. None: full resolution.
        attributes : sequence of str, or None
            Names of the attributes to include; None: all.

        Raises
        ------
        OptionError
            If there is no such window or level, or there are several blocks, which have no windows.
        StreamError, TooLargeError
            If it is damaged or takes too much memory.
        """
        chosen = None if attributes is None else tuple([attributes] if isinstance(attributes, str) else attributes)
        return self._end(Target(region=(rows, columns), level=level, attributes=chosen), bounded=False).surface()

    def view_at(self, target: Target) -> View:
        """Return the state in which a target is met. Its ``seconds`` are ignored.

        Raises
        ------
        OptionError
            If it is no target, the surface has no such level, region or channel, or not even the first layer is within
            the bytes.
        StreamError, TooLargeError
            If it is damaged or takes too much memory.
        """
        return self._end(target, bounded=True)

    def views(self, target: Target | None = None) -> Iterator[View]:
        """Read layer by layer up to a target, all by default, and yield the state after each.

        What is not iterated over is not read.

        Raises
        ------
        As `view_at`.
        """
        decoder, chosen = self._begun(Target() if target is None else target, bounded=True)

        def states() -> Iterator[View]:
            for _, places in chosen.steps():
                reached: list[View] = []
                with named(self.source.place):
                    for offset, data in self._pieces(places):
                        reached += decoder.feed_at(offset, data)
                yield from reached

        return states()

    def __iter__(self) -> Iterator[View]:
        """Iterate over the states after each layer, from coarse to exact."""
        return self.views()

    def to_xarray(self) -> xarray.Dataset | xarray.DataTree:
        """Return the surface as a lazy Dataset, a DataTree of several blocks, as ``engine="lode"`` of xarray does.

        What is indexed is decoded as a window, while this container is open.

        Raises
        ------
        UnavailableError
            If xarray is not installed.
        """
        from ..interop.optional import require_library

        require_library("xarray", "xarray")
        from ..interop.lazy_xarray import LazyBlocks
        from ..interop.to_xarray import tree

        blocks = LazyBlocks(self)
        datasets = [blocks.dataset(None, number) for number in range(len(self.header.blocks))]
        return datasets[0] if len(datasets) == 1 else tree(datasets)

    def close(self) -> None:
        """Close the connection, if there is one. Nothing can be read afterwards; views keep what they have."""
        self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        header = self.header
        shape = " x ".join(map(str, header.blocks[0][0])) if len(header.blocks) == 1 else f"{len(header.blocks)} blocks"
        place = self.source.place
        return f"Container({place!r}, {shape} {header.dtype}, levels 0 to {header.levels}, {self.source.size} bytes)"

    def _repr_html_(self) -> str:
        """Return the HTML for a notebook: a small picture, for which a coarse level is read, sizes and errors."""
        from ..interop.html import small_level, view_html

        level = small_level(self.header)
        view = self.view(level=level)
        return view_html(view, view.surface(level), [shape for shape, _ in self.header.blocks])

    def __reduce__(self) -> tuple[Any, ...]:
        return _opened_again, (self.source, self._max_vertices, self._mark())

    def _mark(self) -> str:
        """Return a digest by which header and index are recognised."""
        return hashlib.sha256(b"".join(data for _, data in self._kept)).hexdigest()

    def _begun(self, target: Target, *, bounded: bool) -> tuple[Decoder, Plan]:
        """Return a decoder that has what comes before the slices of the plan, and the plan."""
        check_target(target)
        with named(self.source.place):
            wanted = bounded and wants_window_errors(target, self.header)
            windows = read_window_errors(self.index, self._read) if wanted else None
            chosen = plan(self.index, target, windows=windows)
            decoder = Decoder(target, max_vertices=self._max_vertices)
            for offset, data in self._pieces([*chosen.before, *chosen.after]):
                decoder.feed_at(offset, data)
        return decoder, chosen

    def _end(self, target: Target, *, bounded: bool) -> View:
        decoder, chosen = self._begun(target, bounded=bounded)
        with named(self.source.place):
            for offset, data in self._pieces(chosen.ranges):
                decoder.feed_at(offset, data)
            return decoder.view()

    def _pieces(self, places: Sequence[ByteRange]) -> Iterator[tuple[int, Bytes]]:
        """Read ranges in their order, near ones at once, and yield their bytes and where they begin."""
        for run in _runs(places, self.source.gap):
            data = self._read(run[0].offset, run[-1].end - run[0].offset)
            for place in run:
                start = place.offset - run[0].offset
                yield place.offset, data[start : start + place.length]

    def _first(self, offset: int, length: int) -> Bytes:
        data = self._read(offset, length)
        self._kept.append((offset, data))
        return data

    def _read(self, offset: int, length: int) -> Bytes:
        """Return bytes, fewer only where the container ends; those that are kept are not read again."""
        run, end = bytearray(), min(offset + length, self.source.size)
        while (at := offset + len(run)) < end:
            known = next((data[at - first :] for first, data in self._kept if first <= at < first + len(data)), None)
            if known is None:
                if not self._open.alive:
                    raise InputError(f"expected an open container, got {self.source.place}, which was closed")
                began = time.perf_counter()
                known = self.source.read(at, end - at)
                seconds = time.perf_counter() - began
                _log.debug("read %d bytes at %d of %s in %.3f s", len(known), at, self.source.place, seconds)
            run += known[: end - at]
        return Bytes(run)


def open(
    source: str | os.PathLike[str] | bytes | bytearray | memoryview,
    *,
    token: str | None = None,
    max_vertices: int | None = None,
) -> Container:
    """Open a container wherever it is. Header and index are read at once, everything else when it is asked for.

    Parameters
    ----------
    source : str, path-like or bytes
        A container as a file or as bytes; in a bucket (``s3://bucket/prefix/name.lode``, ``az://``, ``abfss://``); at a
        URL: a file on any web server that answers Range requests, a name on a published page, a surface of a
        Lodestream server, or a name there. A surface in a file of another format is read by `lodestream.read`.
    token : str or None
        Token of the server of a URL.
    max_vertices : int or None
        Limit on the memory of what is decoded at once, see `lodestream.Decoder`.

    Raises
    ------
    InputError
        If it is none of these.
    UnavailableError
        If the library for buckets, or the client, is not installed.
    StreamError, TooLargeError
        If the container is damaged, cut short or too large.
    LodestreamError, OSError
        If it cannot be reached or read, or is not there.

    Examples
    --------
    >>> import lodestream
    >>> container = lodestream.open("terrain.lode")
    >>> container.info["shape"], len(container.info["levels"])
    ([97, 70], 8)
    >>> for view in container:
    ...     if view.rms < 2:
    ...         break
    >>> view.complete
    False
    """
    return Container(open_source(source, token), max_vertices)


def _opened_again(source: ByteSource, max_vertices: int | None, mark: str) -> Container:
    """Open a container that was pickled.

    Raises
    ------
    LodestreamError
        If another one is there now, whose values would mix with those of the one before.
    """
    container = Container(source, max_vertices)
    if container._mark() != mark:
        container.close()
        raise LodestreamError(
            f"expected {source.place} as it was when it was opened first, got another: it has changed"
        )
    return container


def _runs(places: Sequence[ByteRange], gap: int) -> Iterator[list[ByteRange]]:
    """Yield ranges in their order, cut to what is read at once, and grouped into those that are read together."""
    run: list[ByteRange] = []
    for place in places:
        for offset in range(place.offset, place.end, AT_ONCE):
            part = ByteRange(offset, min(AT_ONCE, place.end - offset))
            if run and not (0 <= part.offset - run[-1].end <= gap and part.end - run[0].offset <= AT_ONCE):
                yield run
                run = []
            run.append(part)
    if run:
        yield run
