"""Sets of cells of a grid as compressed text for a surface's metadata."""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

__all__ = ["pack_cells", "unpack_cells"]


def pack_cells(cells: NDArray[np.bool_]) -> dict[str, Any]:
    """Write a set of cells: bool, shape (row of cells, column of cells)."""
    packed = zlib.compress(np.packbits(cells).tobytes(), 9)
    return {"shape": list(cells.shape), "cells": base64.b64encode(packed).decode("ascii")}


def unpack_cells(entry: Any, shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Decode a set of cells of `pack_cells`; return bool of ``shape``, or None if it belongs to another shape.

    Raises
    ------
    InputError
        When it is malformed.

    """
    try:
        if not isinstance(entry, Mapping) or tuple(entry["shape"]) != shape:
            return None
        size = shape[0] * shape[1]
        decoder = zlib.decompressobj()
        bits = decoder.decompress(base64.b64decode(entry["cells"], validate=True), (size + 7) // 8)
        return np.unpackbits(np.frombuffer(bits, np.uint8), count=size).astype(np.bool_).reshape(shape)
    except (KeyError, TypeError, ValueError, binascii.Error, zlib.error):
        raise InputError("expected a shape and the text of a set of its cells in the metadata's faces") from None
