"""Reading and writing files: one table of formats, selected by content.

The first bytes of a file decide its format; the suffix only helps with text. No reader opens another file that the
first one names. Every reader checks what a header announces before it allocates memory. Libraries are imported when a
file needs them.
"""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from ..container import metadata
from ..coordinates.seams import restore
from ..errors import FormatError, InputError, OptionError
from ..surface import Closed, Surface
from . import bezier, glb, notes, npy, npz, off, text_arrays
from .netcdf import reader as netcdf
from .non_finite import note_infinities
from .obj import reader as obj
from .obj import writer as obj_writer
from .pcd import reader as pcd
from .plot3d import reader as plot3d
from .ply import reader as ply
from .ply import writer as ply_writer
from .raster import ascii_grid, geotiff, png, srtm_hgt, usgs_dem
from .source import DEFAULT_MAX_VERTICES, Source, check_allowed
from .vtk import cgns
from .vtk import legacy as vtk_legacy
from .vtk import writer as vts_writer
from .vtk import xml_files as vtk_xml

__all__ = [
    "DEFAULT_MAX_VERTICES",
    "Format",
    "check_allowed",
    "check_blocks",
    "for_writing",
    "formats",
    "read",
    "sniff",
    "write",
    "write_stream",
]

#: Bytes at the start of a file that decide about its format.
_HEAD = 4096


@dataclass(frozen=True, slots=True)
class Format:
    """One row of the table of formats.

    Attributes
    ----------
    name : str
        Name in ``?format=`` and in messages.
    suffixes : tuple of str
        File name suffixes, in lower case with their dot; the usual one first.
    sniff : callable
        ``sniff(head, suffix)`` tells whether a file that begins with the bytes `head` has this format. The suffix is
        that of a known format, or empty.
    read : callable or None
        Takes a `Source`, returns a `Surface`; None if the format is only written.
    write : callable or None
        Takes a `Surface` and a binary file that need not be seekable; None if the format is only read.
    blocks : bool
        Whether several blocks can be written.
    options : mapping of str to str
        Options for reading, each with a line of help.
    kinds : tuple of str
        Names of variants of this format that are read by other rules. Each can be switched off by itself.
    more : str
        Description of further files of the same surface; empty if the format takes one file only.
    named : callable or None
        Returns the options that a file's name implies (such as the position of an .hgt); explicit options take
        precedence. Code that identifies surfaces by bytes and options must include these.
    media_type : str
        Media type for HTTP.
    process : bool
        Whether reading starts a separate process, which must be allowed and needs its own memory.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes, str], bool]
    read: Callable[[Source], Surface] | None = None
    write: Callable[[Surface, BinaryIO], None] | None = None
    blocks: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    kinds: tuple[str, ...] = ()
    more: str = ""
    named: Callable[[str], Mapping[str, str]] | None = None
    media_type: str = "application/octet-stream"
    process: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The names of this format and of its variants."""
        return self.name, *self.kinds


_CLOSED: Mapping[str, Closed | None] = {
    "auto": None,
    "none": (False, False),
    "rows": (True, False),
    "cols": (False, True),
    "both": (True, True),
}

_FORMATS = (
    Format("npy", (".npy",), npy.sniff, npy.read, npy.write),
    Format("npz", (".npz",), npz.sniff, npz.read, options=npz.READ_OPTIONS),
    Format(
        "geotiff",
        (".tif", ".tiff"),
        geotiff.sniff,
        geotiff.read,
        geotiff.write,
        options=geotiff.READ_OPTIONS,
        media_type="image/tiff",
    ),
    Format(
        "netcdf", (".nc", ".nc4", ".cdf"), netcdf.sniff, netcdf.read, options=netcdf.READ_OPTIONS, kinds=netcdf.KINDS
    ),
    Format(
        "png",
        (".png",),
        png.sniff,
        png.read,
        png.write,
        options=png.READ_OPTIONS,
        named=png.named,
        media_type="image/png",
    ),
    Format("esri-ascii", (".asc",), ascii_grid.sniff, ascii_grid.read),
    Format("usgs-dem", (".dem",), usgs_dem.sniff, usgs_dem.read),
    Format("srtm-hgt", (".hgt",), srtm_hgt.sniff, srtm_hgt.read, options=srtm_hgt.READ_OPTIONS, named=srtm_hgt.named),
    Format("ply", (".ply",), ply.sniff, ply.read, ply_writer.write, blocks=True),
    Format("off", (".off",), off.sniff, off.read),
    Format("obj", (".obj",), obj.sniff, obj.read, obj_writer.write, blocks=True, media_type="model/obj"),
    Format("pcd", (".pcd",), pcd.sniff, pcd.read),
    Format("vtk", (".vtk",), vtk_legacy.sniff, vtk_legacy.read, options=vtk_legacy.OPTIONS, process=True),
    Format(
        "vts",
        vtk_xml.SUFFIXES,
        vtk_xml.sniff,
        vtk_xml.read,
        vts_writer.write,
        blocks=True,
        options=vtk_xml.OPTIONS,
        more=vtk_xml.MORE,
        process=True,
    ),
    Format("glb", (".glb",), glb.sniff, write=glb.write, blocks=True, media_type=glb.MEDIA_TYPE),
    Format("cgns", (".cgns",), cgns.sniff, cgns.read, options=cgns.OPTIONS, process=True),
    Format("bpt", (bezier.SUFFIX,), bezier.sniff, bezier.read, options=bezier.OPTIONS),
    Format("text", text_arrays.SUFFIXES, text_arrays.sniff, text_arrays.read, more=text_arrays.MORE),
    Format("plot3d", plot3d.SUFFIXES, plot3d.sniff, plot3d.read, options=plot3d.READ_OPTIONS, more=plot3d.MORE),
)


def formats() -> tuple[Format, ...]:
    """All formats that can be read or written."""
    return _FORMATS


def sniff(path: str | os.PathLike[str], *, filename: str | None = None) -> Format:
    """Find the format of a file by its first bytes.

    Parameters
    ----------
    path : str or path-like
        An existing file.
    filename : str, optional
        The file's original name, if `path` has another; only its suffix matters, and only for text.

    Raises
    ------
    FormatError
        If the file is empty, not a regular file, or of no known format.
    """
    path = Path(path)
    label = filename or os.fspath(path)
    try:
        return _sniff(path, Path(label).suffix.lower())
    except InputError as error:
        raise _named(error, label) from None


def read(
    path: str | os.PathLike[str],
    *more: str | os.PathLike[str],
    closed: str | Closed = "auto",
    max_vertices: int = DEFAULT_MAX_VERTICES,
    filename: str | None = None,
    allowed: Collection[str] | None = None,
    **options: Any,
) -> Surface:
    """Read a surface from a file; the file's content decides its format.

    Parameters
    ----------
    path : str or path-like
        A file of one of the `formats`.
    *more : str or path-like
        Further files of the same surface, for formats that take them (`Format.more`).
    closed : {"auto", "none", "rows", "cols", "both"} or (bool, bool)
        Which axes are closed. "auto": those that the format declares closed, and those whose last row or column repeats
        the first bit for bit. The repeated one is merged (``seam`` in the metadata) and written again by `write`.
    max_vertices : int
        Larger surfaces are refused before memory is allocated for them.
    filename : str, optional
        The file's original name, if `path` has another, as with uploads. It is used in messages and as ``name`` in the
        metadata; its suffix helps with text.
    allowed : collection of str, optional
        Names (`Format.names`) of the formats that may be read; by default all.
    **options
        Options of the format, see `Format.options`: for example ``array`` of NPZ, ``band`` of GeoTIFF.

    Returns
    -------
    Surface
        With its own copy of the values, in the file's type (float64 for text). Its metadata have ``name``, ``format``
        and, if the file has them, ``crs`` (WKT), ``geotransform`` (six numbers in GDAL's order), ``nodata`` (a number,
        or text if it is not finite), ``unit``, ``scale`` and ``offset`` (for values kept as stored), ``scalars``
        (single numbers beside the array of an NPZ), ``tags``, ``bands`` and others that docs/formats.md lists. A
        `FormatWarning` tells what was left out; so also if metadata exceed `lodestream.container.metadata.MAX_BYTES`
        and their largest entries are dropped.

    Raises
    ------
    FormatError
        If the file is invalid, cut short, or not a structured surface.
    SwitchedOffError
        If its format may not be read.
    TooLargeError
        If it announces more vertices than allowed, or expands implausibly.
    OptionError
        If an option does not exist, or its value is not valid.
    InputError
        If the values cannot be a surface because none is valid.
    OSError
        If the file cannot be opened.
    """
    path = Path(path)
    label = filename or os.fspath(path)
    name = Path(label)
    try:
        if isinstance(closed, str) and closed not in _CLOSED:
            raise OptionError(f"expected closed as one of {', '.join(_CLOSED)}, got {closed!r}")
        chosen = _CLOSED[closed] if isinstance(closed, str) else closed
        if not isinstance(max_vertices, int):  # as options of a command line would be, which are text
            raise OptionError(f"expected max_vertices as a whole number, got {max_vertices!r}")
        format_ = _sniff(path, name.suffix.lower())
        if format_.read is None:
            raise FormatError(f"expected {_readable()}, got {format_.name}, which is written but not read yet")
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
        surface = format_.read(Source(path, name.stem, size, max_vertices, options, others, chosen, allowed))
        surface.metadata, dropped = metadata.fitted(surface.metadata)
        if dropped:
            words = notes.listing(f"{key} ({size:,} bytes)" for key, size in dropped)
            notes.warn(f"metadata are limited to {metadata.MAX_BYTES:,} bytes; left out: {words}")
        return surface if chosen is None else _closed(surface, chosen)
    except InputError as error:
        raise _named(error, label) from None


def _closed(surface: Surface, closed: Closed) -> Surface:
    if len(surface.blocks) > 1:
        raise OptionError(f"expected closed=auto for a surface of several blocks, got {len(surface.blocks)} blocks")
    if surface.closed == tuple(closed):
        return surface
    attributes = surface.attributes
    return Surface(surface.points, closed, mask=surface.mask, attributes=attributes, metadata=surface.metadata)


def check_blocks(format_: Format, count: int) -> None:
    """Refuse to write several blocks in a format that holds only one.

    Raises
    ------
    FormatError
        Naming the formats that hold several.
    """
    if count > 1 and not format_.blocks:
        several = [it.name for it in _FORMATS if it.write and it.blocks]
        words = f"{', '.join(several[:-1])} and {several[-1]} hold several"
        raise FormatError(f"expected one block for {format_.name}, got {count}: {words}")


def for_writing(path: str | os.PathLike[str]) -> Format:
    """The format in which a file of this name is written.

    Raises
    ------
    OptionError
        If no format that can be written has this suffix; the message names those that exist.
    """
    path = Path(path)
    format_ = next((it for it in _FORMATS if it.write and path.suffix.lower() in it.suffixes), None)
    if format_ is None:
        suffixes = ", ".join(suffix for it in _FORMATS if it.write for suffix in it.suffixes)
        raise _named(OptionError(f"expected a name that ends in one of {suffixes}"), str(path))
    return format_


def write(surface: Surface, path: str | os.PathLike[str]) -> None:
    """Write a surface to a file; the suffix decides the format.

    The file is written under a temporary name and renamed at the end, so it is complete or absent. A `FormatWarning`
    tells what the format cannot hold.

    Raises
    ------
    OptionError
        If no format that can be written has this suffix; the message names those that exist.
    FormatError
        If the format cannot hold this surface.
    """
    path, format_ = Path(path), for_writing(path)
    if path.exists() and not path.is_file():
        with path.open("wb") as file:  # a pipe or a device cannot be replaced by a file; a folder is refused here
            write_stream(surface, format_.name, file)
        return
    target = path.resolve()  # a link stays a link
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            write_stream(surface, format_.name, file)
        temporary.replace(target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = os.fspath(path)  # not the temporary name, which tells the user nothing
        if isinstance(error, InputError):
            raise _named(error, str(path)) from None
        raise


def write_stream(surface: Surface, format_name: str, file: BinaryIO) -> None:
    """Write a surface to an open binary file, such as standard output or the body of a response.

    Parameters
    ----------
    surface : Surface
    format_name : str
        Name of a format that can be written, as in `formats`.
    file : binary file
        Only its ``write`` is used.

    Raises
    ------
    OptionError
        If there is no such format; the message names those that exist.
    FormatError
        If the format cannot hold this surface. Nothing has been written then.
    """
    written = {it.name: it for it in _FORMATS if it.write}
    if format_name not in written:
        raise OptionError(f"expected a format that is written ({', '.join(written)}), got {format_name!r}")
    format_ = written[format_name]
    check_blocks(format_, len(surface.blocks))
    assert format_.write is not None, "it is written"
    surface = restore(surface)
    note_infinities(surface, format_name)
    format_.write(surface, file)


def _sniff(path: Path, suffix: str) -> Format:
    _check_regular(path)
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if not any(suffix in it.suffixes for it in _FORMATS):
        suffix = ""
    if not head:
        raise FormatError(f"expected {_readable()}, got an empty file")
    for format_ in _FORMATS:
        if format_.sniff(head, suffix):
            return format_
    raise FormatError(f"expected {_readable()}, got {_describe(head)}")


def _check_regular(path: Path) -> None:
    if not stat.S_ISREG(path.stat().st_mode):
        raise FormatError("expected a regular file, got a folder, pipe or device")


def _readable() -> str:
    names = [it.name for it in _FORMATS if it.read]
    return f"a file of format {', '.join(names[:-1])} or {names[-1]}"


def _describe(head: bytes) -> str:
    """Say how a file begins, in characters that are safe to print."""
    text = head[:40].decode("ascii", "replace")
    if all(character.isprintable() or character.isspace() for character in text) and "\ufffd" not in text:
        return f"text that begins with {' '.join(text.split())!r}"
    return f"bytes that begin with {head[:8].hex(' ')}"


def _check_options(format_: Format, options: Mapping[str, Any]) -> None:
    for name in options:
        if name not in format_.options:
            known = ", ".join(format_.options) or "none"
            raise OptionError(f"expected an option of format {format_.name} ({known}), got {name!r}")


def _named(error: InputError, label: str) -> InputError:
    """Put the file's name in front of a message, which stays one line whatever either holds."""
    message = f"{label}: {error}"
    return type(error)("".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message))
