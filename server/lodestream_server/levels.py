"""One level of a surface as a file."""

from __future__ import annotations

import tempfile
import warnings
from typing import TYPE_CHECKING, BinaryIO

from lodestream.errors import FormatWarning
from lodestream.formats import formats

from .containers import OpenContainer

if TYPE_CHECKING:
    from pathlib import Path

    from lodestream import Surface

__all__ = ["MEDIA_TYPES", "write_level"]

#: The formats of a level, and what they are called on the way.
MEDIA_TYPES = {format_.name: format_.media_type for format_ in formats() if format_.write}


def write_level(container: OpenContainer, level: int, format_name: str, folder: Path) -> BinaryIO:
    """Decode a level and write it in a format.

    Parameters
    ----------
    container : OpenContainer
    level : int
        It exists.
    format_name : str
        A key of `MEDIA_TYPES`.
    folder : Path
        Where the file is written.

    Returns
    -------
    binary file
        At its start; it has no name, so that it is gone when it is closed, or when the process dies.
    """
    from lodestream.formats import write_stream

    surface = _decode(container, level)
    # Whoever takes the file closes it.
    file: BinaryIO = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FormatWarning)  # whoever asked for a format knows what it holds
            write_stream(surface, format_name, file)
        file.seek(0)
    except BaseException:
        file.close()
        raise
    return file


def _decode(container: OpenContainer, level: int) -> Surface:
    # The decoder brings the compiler of the kernels: a server that only streams does without.
    from lodestream import Decoder, Target
    from lodestream.plan import plan

    chosen = plan(container.index, Target(level=level))
    decoder = Decoder()
    for place in (*chosen.before, *chosen.ranges, *chosen.after):
        decoder.feed_at(place.offset, container.read(place))
    return decoder.surface(level)
