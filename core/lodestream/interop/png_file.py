"""The file of a PNG, from its header and its data."""

from __future__ import annotations

import struct
import zlib

__all__ = ["png_file"]


def png_file(columns: int, rows: int, depth: int, kind: int, data: bytes, *before: tuple[bytes, bytes]) -> bytes:
    """Return a PNG.

    Parameters
    ----------
    columns, rows : int
    depth : int
        Bits of a sample.
    kind : int
        Its colour type.
    data : bytes
        Its rows, compressed, each behind the number of its filter.
    before : tuples of (bytes, bytes)
        Names and contents of chunks that come before the data.
    """
    head = struct.pack(">IIBBBBB", columns, rows, depth, kind, 0, 0, 0)
    chunks = ((b"IHDR", head), *before, (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        for name, content in chunks
    )
