"""A surface as files of a scratch folder, which another process opens without trusting them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from uuid import uuid4

import msgpack
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scratch import FolderScratch, rows_at_once
from ..surface import DTYPES, Block, Surface
from .references import root_of

__all__ = ["load_surface", "save_surface"]

_FILE = "surface.msgpack"
#: The largest description of a surface that is read; metadata are limited to far less.
_MOST = 64 << 20


#: What unpacking and small changes of types may raise beside the usual.
_OTHERS = RecursionError, OverflowError, msgpack.UnpackException

#: Where an array lies: the name of a file, the first byte among its values, dtype and shape.
_Place = tuple[str, int, str, tuple[int, ...]]


def save_surface(surface: Surface, scratch: FolderScratch) -> None:
    """Write a surface of any size into a folder; arrays that lie in files of the folder already stay there.

    The others share a file for each dtype, since a process may have only so many files open. Which points of the
    surface are one (`Surface.joints`) is not kept.
    """
    block_arrays: list[dict[str, NDArray[Any]]] = []
    for block in surface.blocks:
        arrays = {"points": block.points}
        if block.mask is not None:
            arrays["mask"] = block.mask
        block_arrays.append(arrays | {f"attribute {k}": array for k, array in enumerate(block.attributes.values())})
    places: list[dict[str, _Place | None]] = [
        {key: _place_of(array, scratch) for key, array in arrays.items()} for arrays in block_arrays
    ]
    left: dict[str, list[tuple[int, str]]] = {}
    for number, arrays in enumerate(block_arrays):
        for key, array in arrays.items():
            if places[number][key] is None:
                left.setdefault(array.dtype.name, []).append((number, key))
    for dtype, several in left.items():
        name, done = f"surface/{dtype}-{uuid4().hex}", 0  # arrays that stay may lie in a file of before
        scratch.write_joined(name, [block_arrays[number][key] for number, key in several])
        for number, key in several:
            places[number][key] = name, done, dtype, block_arrays[number][key].shape
            done += block_arrays[number][key].nbytes
    blocks = [
        {"arrays": arrays, "closed": list(block.closed), "attributes": list(block.attributes)}
        for arrays, block in zip(places, surface.blocks, strict=True)
    ]
    described = msgpack.packb({"blocks": blocks, "metadata": surface.metadata})
    temporary = scratch.folder / f"{_FILE}.part"
    temporary.write_bytes(described)
    temporary.replace(scratch.folder / _FILE)


def load_surface(scratch: FolderScratch) -> Surface | None:
    """Open the surface that `save_surface` wrote into a folder, its arrays memory-mapped; None if there is none.

    Raises
    ------
    InputError
        If what is there is no such surface.
    """
    path = scratch.folder / _FILE
    try:
        with path.open("rb") as file:
            described = file.read(_MOST + 1)
    except FileNotFoundError:
        return None
    try:
        if len(described) > _MOST:
            raise ValueError("too long")
        fields = msgpack.unpackb(described, strict_map_key=False)
        files = _Files(scratch)
        blocks = [_block(entry, files) for entry in fields["blocks"]]
        metadata = fields["metadata"]
        if not isinstance(metadata, dict):
            raise TypeError("no map")
    except InputError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OSError, *_OTHERS) as error:
        raise InputError(f"expected a surface in {scratch.folder.name}, got something else ({error})") from None
    return Surface(blocks=blocks, metadata=metadata)


class _Files:
    """Files of a folder, each mapped once."""

    def __init__(self, scratch: FolderScratch) -> None:
        self._scratch = scratch
        self._known: dict[str, NDArray[np.uint8]] = {}

    def bytes_of(self, name: object) -> NDArray[np.uint8]:
        """Return the values of a file as bytes, shape (byte,)."""
        if not isinstance(name, str):
            raise TypeError(f"a name was expected, not {type(name).__name__}")
        if ".." in Path(name).parts or Path(name).is_absolute():
            raise ValueError(f"a name within the folder was expected, not {name[:80]!a}")
        if name not in self._known:
            array = self._scratch.read(name)
            if not array.flags.c_contiguous:
                raise ValueError("values in another order were not expected")
            self._known[name] = np.ndarray((array.nbytes,), np.uint8, array)
        return self._known[name]


def _block(entry: dict[str, Any], files: _Files) -> Block:
    arrays = {key: _read(place, files) for key, place in entry["arrays"].items()}
    if not all(isinstance(name, str) for name in entry["attributes"]):
        raise TypeError("names of attributes were expected")
    attributes = {name: arrays[f"attribute {number}"] for number, name in enumerate(entry["attributes"])}
    rows, columns = entry["closed"]
    return Block(arrays["points"], (rows, columns), mask=arrays.get("mask"), attributes=attributes)


def _read(place: Any, files: _Files) -> NDArray[Any]:
    name, start, kind, shape = place
    if not isinstance(kind, str) or kind not in [*DTYPES, "bool"]:
        raise ValueError("values of another type were not expected")
    if not isinstance(shape, list) or not 2 <= len(shape) <= 3:
        raise ValueError("two or three axes were expected")
    if not all(type(number) is int and 0 <= number < 1 << 63 for number in (start, *shape)) or 0 in shape:
        raise ValueError("whole numbers were expected of a place")
    dtype, raw = np.dtype(kind), files.bytes_of(name)
    if start + math.prod(shape) * dtype.itemsize > raw.size:
        raise ValueError(f"values beyond the end of {name[:80]!a} were not expected")
    array: NDArray[Any] = np.ndarray(tuple(shape), dtype, raw, start)
    if not array.flags.aligned:
        raise ValueError("values between two places of memory were not expected")
    if kind == "bool" and any((array[rows].view(np.uint8) > 1).any() for rows in rows_at_once(array.shape)):
        raise ValueError("bytes other than 0 and 1 in a mask were not expected")  # numpy counts them wrongly
    return array


def _place_of(array: NDArray[Any], scratch: FolderScratch) -> _Place | None:
    """Return the place of an array in a file of this folder; None if it is elsewhere, or in another order."""
    root = root_of(array)
    if root is None or not array.flags.c_contiguous:
        return None
    path, folder = Path(str(root.filename)).resolve(), scratch.folder.resolve()
    if path.suffix != ".npy" or not path.is_relative_to(folder):
        return None
    name = str(path.relative_to(folder).with_suffix(""))
    stored = scratch.read(name)
    start = array.__array_interface__["data"][0] - root.__array_interface__["data"][0]
    same = isinstance(stored, np.memmap) and stored.offset == root.offset and stored.flags.c_contiguous
    return (name, start, array.dtype.name, array.shape) if same and start >= 0 else None
