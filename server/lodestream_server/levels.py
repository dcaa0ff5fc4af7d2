"""One level of a surface as a file."""

from __future__ import annotations

import tempfile
from typing import TYPE_CHECKING, Any, BinaryIO

from .containers import OpenContainer

if TYPE_CHECKING:
    from pathlib import Path

    from lodestream import Surface
    from lodestream.container import Header

__all__ = ["MEDIA_TYPES", "write_level"]

#: The formats of a level, and what they are called on the way.
MEDIA_TYPES = {"npy": "application/octet-stream", "obj": "model/obj", "ply": "application/octet-stream"}


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
        write_stream(surface, format_name, file)
        file.seek(0)
    except BaseException:
        file.close()
        raise
    return file


def _decode(container: OpenContainer, level: int) -> Surface:
    # The decoder brings the compiler of the kernels: a server that only streams does without.
    from lodestream import Decoder, Surface, Target
    from lodestream.plan import plan

    chosen = plan(container.index, Target(level=level))
    decoder = Decoder()
    for place in (*chosen.before, *chosen.ranges, *chosen.after):
        decoder.feed_at(place.offset, container.read(place))
    header = container.index.header
    if level == header.levels:
        return decoder.surface()
    points = decoder.points_at(level)
    metadata = dict(decoder.metadata or {})
    if header.channels == 1:
        metadata["geotransform"] = _spread(metadata.get("geotransform"), header, points.shape)
    return Surface(points, header.closed, metadata=metadata)


def _spread(transform: Any, header: Header, coarse: tuple[int, ...]) -> list[float]:
    # The nodes of a level are drawn as far apart as makes the level as large as the surface. Heights without a place of
    # their own are drawn over their indices.
    x0, x_column, x_row, y0, y_column, y_row = transform or (-0.5, 1.0, 0.0, -0.5, 0.0, 1.0)
    down, across = (
        full / nodes if wraps else (full - 1) / max(nodes - 1, 1)
        for full, nodes, wraps in zip(header.shape, coarse[:2], header.closed, strict=True)
    )
    x0 += 0.5 * x_column * (1 - across) + 0.5 * x_row * (1 - down)
    y0 += 0.5 * y_column * (1 - across) + 0.5 * y_row * (1 - down)
    return [x0, x_column * across, x_row * down, y0, y_column * across, y_row * down]
