"""Read files: the first bytes decide the format, whose row of the table has the reader."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..container import metadata
from ..container.sections import is_container
from ..errors import FormatError, InputError, OptionError
from ..scratch import IN_MEMORY, Room
from ..surface import Closed, Surface
from . import notes
from .nodata import checked, with_nodata
from .source import DEFAULT_MAX_VERTICES, UNLIMITED_VERTICES, Source, check_allowed, with_name
from .table import FORMATS, Format

__all__ = ["read", "sniff"]

#: Bytes at the start of a file that decide about its format.
_HEAD = 4096

_CLOSED: Mapping[str, Closed | None] = {
    "auto": None,
    "none": (False, False),
    "rows": (True, False),
    "cols": (False, True),
    "both": (True, True),
}


def sniff(path: str | os.PathLike[str], *, filename: str | None = None, format_name: str | None = None) -> Format:
    """Find the format of a file by its first bytes.

    Parameters
    ----------
    path : str or path-like
        An existing file, or a folder.
    filename : str, optional
        The file's original name, if `path` has another; only its suffix matters, and only for text.
    format_name : str, optional
        The format that it must have, or a suffix of it without the dot; as a suffix of the name would say.

    Raises
    ------
    FormatError
        If the file is empty, not a regular file, of no known format, or not of the one that is asked for.
    OptionError
        If no format that is read has this name.
    """
    path = Path(path)
    label = filename or os.fspath(path)
    try:
        return _sniff(path, Path(label).suffix.lower(), format_name)
    except InputError as error:
        raise with_name(error, label) from None


def read(
    path: str | os.PathLike[str],
    *more: str | os.PathLike[str],
    closed: str | Closed = "auto",
    max_vertices: int | None = None,
    filename: str | None = None,
    allowed: Collection[str] | None = None,
    format_name: str | None = None,
    room: Room | None = None,
    nodata: float | str | None = None,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> Surface:
    """Read a surface from a file; the file's content decides its format.

    Parameters
    ----------
    path : str or path-like
        A file of one of the `formats`, or the folder of a Zarr store.
    *more : str or path-like
        Further files of the same surface, for formats that take them (`Format.more`).
    closed : {"auto", "none", "rows", "cols", "both"} or (bool, bool)
        Which axes are closed. "auto": those that the format declares closed, and those whose last row or column repeats
        the first bit for bit. The repeated one is merged (``seam`` in the metadata) and written again by `write`.
    max_vertices : int, optional
        Surfaces with more vertices are refused before memory is allocated for them. Default: 2**28 without `room`, no
        limit with it.
    filename : str, optional
        The file's original name, if `path` has another, as with uploads. It is used in messages and as ``name`` in the
        metadata; its suffix helps with text.
    allowed : collection of str, optional
        Names (`Format.names`) of the formats that may be read; by default all.
    format_name : str, optional
        The format that the file must have, or one of its suffixes without the dot ("hgt"), for a file whose name does
        not show its format.
    room : Room, optional
        Where large arrays are kept: NPY files are memory-mapped; rasters, NetCDF, Zarr, binary PLOT3D and raw .vts are
        read window by window into files. Other formats are read into memory all the same.
    nodata : float or str, optional
        A value, or "nan", that marks holes in addition to the values that the file declares. A height with this value
        becomes a hole, and so does a point whose coordinates all have it, such as 0, 0, 0 of a depth camera. If no
        point has it in x, y and z, the points that have it in z become holes; their x and y are kept. A `FormatWarning`
        says how many points were masked.
    progress : callable, optional
        Called with the fraction done, 0 to 1, while a mesh is resampled (``remesh``); not called while a file is read.
    **options
        Options of the format, see `Format.options`: for example ``array`` of NPZ, ``band`` of GeoTIFF.

    Returns
    -------
    Surface
        With its own copy of the values, in the file's type (float64 for text). Its metadata have ``name``, ``format``
        and, if the file has them, ``crs`` (WKT), ``geotransform`` (six numbers in GDAL's order), ``nodata`` (a number,
        or text if it is not finite), ``unit``, ``scale`` and ``offset`` (for values kept as stored), ``scalars``
        (single numbers beside the array of an NPZ), ``tags``, ``bands`` and others that docs/formats.md lists. A
        `FormatWarning` lists what was left out, also the largest entries of metadata that exceed
        `lodestream.container.metadata.MAX_BYTES`.

    Raises
    ------
    FormatError
        If the file is invalid, cut short, or not a structured surface; or a container, which `decode` takes.
    SwitchedOffError
        If its format may not be read.
    TooLargeError
        If the file declares more vertices than allowed, or its compressed data expand implausibly.
    OptionError
        If an option or `format_name` does not exist, or a value is not valid.
    InputError
        If the values cannot be a surface because none is valid.
    OSError
        If the file cannot be opened.

    Examples
    --------
    >>> import lodestream
    >>> surface = lodestream.read("terrain.npy")
    >>> surface.shape, surface.metadata["format"]
    ((97, 70), 'npy')
    """
    path = Path(path)
    label = filename or os.fspath(path)
    name = Path(label)
    try:
        if isinstance(closed, str) and closed not in _CLOSED:
            raise OptionError(f"expected closed as one of {', '.join(_CLOSED)}, got {closed!r}")
        chosen = _CLOSED[closed] if isinstance(closed, str) else closed
        if max_vertices is None:
            max_vertices = DEFAULT_MAX_VERTICES if room is None else UNLIMITED_VERTICES
        if not isinstance(max_vertices, int):  # as options of a command line would be, which are text
            raise OptionError(f"expected max_vertices as a whole number, got {max_vertices!r}")
        hole = None if nodata is None else checked(nodata)
        format_ = _sniff(path, name.suffix.lower(), format_name)
        assert format_.read is not None  # or its `sniff` would have known no file
        check_allowed(format_.names, allowed)
        if more and not format_.more:
            raise OptionError(f"expected one file of format {format_.name}, got {1 + len(more)}")
        _check_options(format_, options)
        if format_.named:
            options = {**format_.named(name.name), **options}
        others = tuple(map(Path, more))
        for other in others:
            _check_regular(other)
        size = path.stat().st_size
        source = Source(path, name.stem, size, max_vertices, options, others, chosen, allowed, room or IN_MEMORY)
        if progress is not None:
            source = replace(source, progress=progress)
        surface = format_.read(source)
        if hole is not None:
            surface = with_nodata(surface, hole, source.room)
        surface.metadata, dropped = metadata.fitted(surface.metadata)
        notes.warn_too_large(dropped)
        return surface if chosen is None else _closed(surface, chosen)
    except InputError as error:
        raise with_name(error, label) from None


def _closed(surface: Surface, closed: Closed) -> Surface:
    if len(surface.blocks) > 1:
        raise OptionError(f"expected closed=auto for a surface of several blocks, got {len(surface.blocks)} blocks")
    if surface.closed == tuple(closed):
        return surface
    attributes = surface.attributes
    return Surface(surface.points, closed, mask=surface.mask, attributes=attributes, metadata=surface.metadata)


def _sniff(path: Path, suffix: str, wanted: str | None) -> Format:
    if path.is_dir():
        return _of_folder(path, wanted)
    _check_regular(path)
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if wanted is not None:
        called = f".{wanted.lower().removeprefix('.')}"
        candidates = _readable_as(wanted)
        for format_ in candidates:
            known = next((it for it in (suffix, called) if it in format_.suffixes), format_.suffixes[0])
            if head and format_.sniff(head, known):
                return format_
        names = " or ".join(format_.name for format_ in candidates)
        raise FormatError(f"this is {_describe(head)}, not a file of format {names}")
    if is_container(head):
        raise FormatError(
            "this is a container of Lodestream already: lodestream.open reads it, lodestream decode writes it to a "
            "file of another format"
        )
    if not any(suffix in it.suffixes for it in FORMATS):
        suffix = ""
    for format_ in FORMATS:
        if head and format_.sniff(head, suffix):
            return format_
    called = f", though its name ends in {suffix}" if suffix and head else ""
    names = ", ".join(it.name for it in FORMATS if it.read)
    raise FormatError(f"this is {_describe(head)}{called}, not a file of a format that is read: {names}")


def _readable_as(name: str) -> tuple[Format, ...]:
    """Return the format that is read under this name, or the formats with this suffix, such as .xyz.

    Raises
    ------
    OptionError
        If there is none; the message names those that exist.
    """
    plain = name.lower().removeprefix(".")
    formats = {it.name: it for it in FORMATS if it.read}
    if plain in formats:
        return (formats[plain],)
    by_suffix = tuple(it for it in formats.values() if f".{plain}" in it.suffixes)
    if not by_suffix:
        raise OptionError(f"expected format to be one of {', '.join(formats)}, got {name[:80]!a}")
    return by_suffix


def _check_regular(path: Path) -> None:
    if not stat.S_ISREG(path.stat().st_mode):
        raise FormatError("expected a regular file, got a folder, a pipe or a device")


def _of_folder(path: Path, wanted: str | None) -> Format:
    match = next((it for it in FORMATS if it.folder and it.folder(path)), None)
    if wanted is not None and match not in (candidates := _readable_as(wanted)):
        names = " or ".join(format_.name for format_ in candidates)
        raise FormatError(f"this is {'a folder' if match is None else match.name}, not a file of format {names}")
    if match is None:
        raise FormatError("expected a regular file or the folder of a Zarr store, got another folder")
    return match


def _describe(head: bytes) -> str:
    """Return what a file is by its beginning, as text that is safe to print."""
    if not head:
        return "an empty file"
    if head.lstrip()[:14].lower().startswith((b"<!doctype html", b"<html")):
        return "a web page, perhaps one that a host sent in place of the file"
    text = head[:40].decode("ascii", "replace")
    if all(character.isprintable() or character.isspace() for character in text) and "\ufffd" not in text:
        return f"text that begins with {' '.join(text.split())!r}"
    return f"a file that begins with the bytes {head[:8].hex(' ')}"


def _check_options(format_: Format, options: Mapping[str, Any]) -> None:
    for name in options:
        if name not in format_.options:
            known = ", ".join(format_.options) or "none"
            raise OptionError(f"expected an option of format {format_.name} ({known}), got {name!r}")
