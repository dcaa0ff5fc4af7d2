"""A surface as files of a scratch folder, which another process opens without trusting them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scratch import Scratch, rows_at_once
from ..surface import DTYPES, Block, Surface

__all__ = ["load_surface", "save_surface"]

_FILE = "surface.msgpack"
#: The largest description of a surface that is read; metadata are limited to far less.
_MOST = 64 << 20


def save_surface(surface: Surface, scratch: Scratch) -> None:
    """Write a surface of any size into a folder; arrays that are whole files of the folder already stay there.

    Which of its points are one (`Surface.joints`) is not kept.
    """
    blocks = []
    for number, block in enumerate(surface.blocks):
        arrays = {"points": block.points}
        if block.mask is not None:
            arrays["mask"] = block.mask
        arrays.update({f"attribute {k}": array for k, array in enumerate(block.attributes.values())})
        names = {}
        for key, array in arrays.items():
            name = _name_of(array, scratch)
            if name is None:
                name = f"surface/{number}/{key.replace(' ', '-')}"
                scratch.write(name, array)
            names[key] = name
        blocks.append({"arrays": names, "closed": list(block.closed), "attributes": list(block.attributes)})
    described = msgpack.packb({"blocks": blocks, "metadata": surface.metadata})
    temporary = scratch.folder / f"{_FILE}.part"
    temporary.write_bytes(described)
    temporary.replace(scratch.folder / _FILE)


def load_surface(scratch: Scratch) -> Surface | None:
    """The surface that `save_surface` wrote into a folder, its arrays memory-mapped; None: it has written none.

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
        found = msgpack.unpackb(described, strict_map_key=False)
        blocks = [_block(entry, scratch) for entry in found["blocks"]]
        metadata = found["metadata"]
        if not isinstance(metadata, dict):
            raise TypeError("no map")
    except InputError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OSError, msgpack.UnpackException) as error:
        raise InputError(f"expected a surface in {scratch.folder.name}, got something else ({error})") from None
    return Surface(blocks=blocks, metadata=metadata)


def _block(entry: dict[str, Any], scratch: Scratch) -> Block:
    arrays = {key: _read(name, scratch) for key, name in entry["arrays"].items()}
    attributes = {name: arrays[f"attribute {number}"] for number, name in enumerate(entry["attributes"])}
    rows, columns = entry["closed"]
    return Block(arrays["points"], (rows, columns), mask=arrays.get("mask"), attributes=attributes)


def _read(name: object, scratch: Scratch) -> NDArray[Any]:
    if not isinstance(name, str) or ".." in Path(name).parts or Path(name).is_absolute():
        raise ValueError(f"a name within the folder was expected, not {str(name)[:80]!a}")
    array = scratch.read(name)
    if array.dtype.name not in [*DTYPES, "bool"]:
        raise ValueError(f"no values of {array.dtype} are expected")
    if array.dtype == bool and any((array[rows].view(np.uint8) > 1).any() for rows in rows_at_once(array.shape)):
        raise ValueError("bytes other than 0 and 1 in a mask were not expected")  # numpy counts them wrongly
    return array


def _name_of(array: NDArray[Any], scratch: Scratch) -> str | None:
    """The name of the file of which an array is the whole; None: there is none in this folder."""
    root: Any = array
    while isinstance(root, np.ndarray) and not isinstance(root, np.memmap):
        root = root.base
    if not isinstance(root, np.memmap) or root.filename is None:
        return None
    path = Path(root.filename).resolve()
    folder = scratch.folder.resolve()
    if path.suffix != ".npy" or not path.is_relative_to(folder):
        return None
    name = str(path.relative_to(folder).with_suffix(""))
    stored = scratch.read(name)
    same = stored.shape == array.shape and stored.dtype == array.dtype and stored.strides == array.strides
    start = array.__array_interface__["data"][0] - root.__array_interface__["data"][0]
    return name if same and start == 0 else None
