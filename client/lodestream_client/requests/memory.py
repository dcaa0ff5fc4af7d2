"""Surfaces in memory: recognise them, and encode them before they are sent."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from lodestream.errors import InputError, OptionError
from lodestream.quality import Effort, Quality
from lodestream.target import Tolerance

if TYPE_CHECKING:
    from lodestream.surface import Closed, Surface

__all__ = ["Asked", "Closure", "encoded", "in_memory", "noted"]

#: Which axes of a grid wrap, in the words of the command line.
Closure = Literal["auto", "none", "rows", "cols", "both"]

_CLOSED: Mapping[str, Closed] = {
    "none": (False, False),
    "rows": (True, False),
    "cols": (False, True),
    "both": (True, True),
}
_ARRAYS = ("__array__", "__array_interface__", "__array_struct__")


@dataclass(frozen=True)
class Asked:
    """The options of an upload, see `Client.upload`."""

    precision: Tolerance | float | str | None = None
    rms: Tolerance | float | str | None = None
    closed: Closure = "auto"
    name: str | None = None
    options: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    attribute_precision: Mapping[str, Tolerance | float | str] = field(default_factory=dict)
    filename: str | None = None
    nodata: float | str | None = None
    effort: Effort = "default"

    @property
    def quality(self) -> Quality:
        """How closely the surface is to be kept, and with how much effort it is encoded.

        Raises
        ------
        OptionError
            If an error is no number of 0 or more, if both a precision and a root mean square error are asked for, or if
            there is no such effort.
        """
        return Quality.of(self.precision, self.rms, self.attribute_precision, self.effort)


def in_memory(source: object) -> bool:
    """Return whether a source is a surface or an array, not a file, without importing their libraries.

    Raises
    ------
    InputError
        If it is neither.
    """
    if isinstance(source, str | os.PathLike | bytes | bytearray) or _is_bytes(source):
        return False
    if hasattr(source, "read") and hasattr(source, "seek") and not isinstance(source, io.TextIOBase):
        return False
    known = sys.modules.get("lodestream.surface")  # loaded by whoever made one
    if known is not None and isinstance(source, known.Surface):
        return True
    if isinstance(source, list | tuple | memoryview) or any(hasattr(source, name) for name in _ARRAYS):
        return True
    kind = "a file open for text" if isinstance(source, io.TextIOBase) else type(source).__name__
    raise InputError(
        f"expected the name of a file, an open binary file, its bytes, a Surface or an array of points, got {kind}"
    )


def _is_bytes(source: object) -> bool:
    return isinstance(source, memoryview) and source.ndim == 1 and source.itemsize == 1


def encoded(source: object, asked: Asked, progress: Callable[[str, float], None] | None) -> bytes:
    """Return the container of a surface or an array.

    Values that a container does not keep are a `FormatWarning`, and are listed in its ``notes``.

    Parameters
    ----------
    source : Surface or array
    asked : Asked
        The name becomes the surface's own. Format options are refused, because there is no file.
    progress : callable or None
        Called as ``progress("encoding", fraction)``.

    Raises
    ------
    OptionError
        If there are format options, or an option has an invalid value.
    InputError
        If the surface cannot be encoded.
    UnavailableError
        If the compiled kernels are missing.
    """
    for option in asked.options:
        raise OptionError(f"expected no options of a file's format for a surface in memory, got {option}")
    if asked.closed != "auto" and asked.closed not in _CLOSED:
        raise OptionError(f"expected closed to be one of auto, {', '.join(_CLOSED)}, got {asked.closed!r}")

    from lodestream.encoding.encode import encode

    surface = _surface(source, asked)
    surface.metadata = noted(surface)
    return encode(
        surface,
        quality=asked.quality,
        progress=None if progress is None else (lambda fraction: progress("encoding", fraction)),
    )


def _surface(source: Any, asked: Asked) -> Surface:
    """Return a copy of the surface with the closure and the name that are asked for."""
    from lodestream.formats.nodata import checked, with_nodata
    from lodestream.scratch import IN_MEMORY
    from lodestream.surface import Block, Surface

    if isinstance(source, Surface):
        surface = copy(source)
        surface.metadata = dict(source.metadata)
    else:
        try:
            surface = Surface(source)
        except InputError:
            raise
        except (TypeError, ValueError) as error:  # numpy's, of what is no array
            raise InputError(f"expected an array of points, got {type(source).__name__}: {error}") from None
    if asked.nodata is not None:
        surface = with_nodata(surface, checked(asked.nodata), IN_MEMORY)
    if asked.closed != "auto":
        if len(surface.blocks) > 1:
            raise OptionError(f"expected closed=auto for a surface of several blocks, got {len(surface.blocks)} blocks")
        block = surface.blocks[0]
        closed = Block(block.points, _CLOSED[asked.closed], mask=block.mask, attributes=block.attributes)
        surface.blocks = (closed,)
    if asked.name:
        surface.metadata["name"] = asked.name
    return surface


def noted(surface: Surface) -> dict[str, Any]:
    """Return the metadata of a surface, with a note of values that a container does not keep."""
    from lodestream.container.metadata import check
    from lodestream.encoding.losses import at_holes

    lost, known = at_holes(surface), surface.metadata.get("notes", [])
    if lost is None or not isinstance(known, list):
        return surface.metadata
    noted = {**surface.metadata, "notes": [*known, lost]}
    try:
        check(noted)
    except InputError:  # there is no room for it; or for what was there before, which is refused in a moment
        return surface.metadata
    return noted
