"""Write files: the suffix of a name decides the format."""

from __future__ import annotations

import os
import secrets
from pathlib import Path
from typing import BinaryIO

from ..coordinates.seams import restore
from ..errors import FormatError, InputError, OptionError
from ..surface import Surface
from .non_finite import note_infinities
from .source import with_name
from .table import FORMATS, Format

__all__ = ["check_blocks", "for_writing", "write", "write_stream", "written"]


def check_blocks(format_: Format, count: int) -> None:
    """Refuse to write several blocks in a format that holds only one.

    Raises
    ------
    FormatError
        Naming the formats that hold several.
    """
    if count > 1 and not format_.blocks:
        several = [it.name for it in FORMATS if it.write and it.blocks]
        words = f"{', '.join(several[:-1])} and {several[-1]} hold several"
        raise FormatError(f"expected one block for {format_.name}, got {count}: {words}")


def for_writing(path: str | os.PathLike[str]) -> Format:
    """Return the format in which a file of this name is written.

    Raises
    ------
    OptionError
        If no format that can be written has this suffix; the message names those that exist.
    """
    path = Path(path)
    by_suffix = {suffix: it for it in FORMATS for suffix in it.suffixes_out}
    fitting = [suffix for suffix in by_suffix if path.name.lower().endswith(suffix) and path.name.lower() != suffix]
    if not fitting:
        raise with_name(OptionError(f"expected a name that ends in one of {', '.join(by_suffix)}"), str(path))
    return by_suffix[max(fitting, key=len)]  # .cog.tif before .tif


def written(name: str) -> Format:
    """Return the format of a name or suffix (``geotiff``, ``tif`` and ``tiff`` are one) that can be one file.

    Raises
    ------
    OptionError
        If there is none that is written; the message names those that exist.
    """
    formats = {it.name: it for it in FORMATS if it.write}
    by_suffix = {suffix[1:]: it for it in formats.values() for suffix in it.suffixes_out}
    match = (by_suffix | formats).get(name)
    if match is None:
        raise OptionError(f"expected format to be one of {', '.join(formats)}, got {name[:80]!a}")
    return match


def write(surface: Surface, path: str | os.PathLike[str]) -> None:
    """Write a surface to a file; the suffix decides the format.

    The file is written under a temporary name and renamed at the end, so it is complete or absent. The same holds for
    the file and the folder of a .vtm, and for the folder of a .zarr. A `FormatWarning` lists what the format cannot
    hold.

    Raises
    ------
    InputError
        If it is no `Surface`.
    OptionError
        If no format that can be written has this suffix; the message names those that exist.
    FormatError
        If the format cannot hold this surface.

    Examples
    --------
    >>> import lodestream
    >>> surface = lodestream.read("terrain.npy")
    >>> lodestream.write(surface, "terrain.vts")
    >>> lodestream.read("terrain.vts").shape
    (97, 70)
    """
    if not isinstance(surface, Surface):
        kind = type(surface).__name__
        raise InputError(f"expected a Surface, such as lodestream.Surface(array) makes of an array, got {kind}")
    path, format_ = Path(path), for_writing(path)
    if format_.write is not None and path.exists() and not path.is_file():
        with path.open("wb") as file:  # a pipe or a device cannot be replaced by a file; a folder is refused here
            write_stream(surface, format_.name, file)
        return
    target = path.resolve()  # a link stays a link
    if format_.write_beside is not None:
        try:
            format_.write_beside(_prepared(surface, format_), target)
        except InputError as error:
            raise with_name(error, str(path)) from None
        except OSError as error:
            if error.errno is None:
                raise
            raise OSError(error.errno, error.strerror, os.fspath(path)) from None  # not one of the temporary names
        return
    temporary = target.with_name(f".{target.name[:50]}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            write_stream(surface, format_.name, file)
        temporary.replace(target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = os.fspath(path)  # not the temporary name, which tells the user nothing
        if isinstance(error, InputError):
            raise with_name(error, str(path)) from None
        raise


def write_stream(surface: Surface, format_name: str, file: BinaryIO) -> None:
    """Write a surface to an open binary file, such as standard output or the body of a response.

    Parameters
    ----------
    surface : Surface
    format_name : str
        Name of a format that can be written, as in `formats`, or a suffix of its files without the dot.
    file : binary file
        Only its ``write`` is used.

    Raises
    ------
    OptionError
        If there is no such format; the message names those that exist.
    FormatError
        If the format cannot hold this surface. Nothing has been written then.
    """
    format_ = written(format_name)
    surface = _prepared(surface, format_)
    assert format_.write is not None, "it is written"
    format_.write(surface, file)


def _prepared(surface: Surface, format_: Format) -> Surface:
    """Return the surface for a writer: with its repeated rows, columns and angles, unless the writer restores them."""
    check_blocks(format_, len(surface.blocks))
    surface = restore(surface) if format_.restored else surface
    note_infinities(surface, format_.name)
    return surface
