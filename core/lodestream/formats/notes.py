"""Notes of readers and writers about lost data: one line for each loss."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.digest import DIGEST
from ..container.metadata import MAX_BYTES
from ..errors import FormatWarning
from ..surface import Block, Surface
from .source import number

__all__ = [
    "keep_words",
    "listing",
    "metadata_left_out",
    "survives",
    "warn",
    "warn_left_out",
    "warn_too_large",
    "with_nul_shown",
]

#: Names in one note, and characters of each.
_MOST_NAMES = 12
_LONGEST_NAME = 60

#: Metadata that are no loss where a format cannot hold them: how a file was read and how its values were stored there.
_OF_THE_FILE = frozenset(
    "name format nodata seam turn angles dtype nodes plane volumes variable encoding notes recognised poles "
    f"types area_or_point {DIGEST}".split()
)

#: Where heights lie; of points that have x and y, leftovers.
_PLACE = ("geotransform", "grid", "axes")

#: How a CRS begins in WKT 1 and 2.
_WKT = re.compile(r"[A-Z][A-Z0-9_]*\[")

#: Of ``faces``, what a grid of quads does not tell.
_CUT = ("diagonal", "crossed", "left_out")


def warn(text: str) -> None:
    """Issue a note as a `FormatWarning`, in one line."""
    line = "".join(character if character.isprintable() else " " for character in text)
    warnings.warn(" ".join(line.split()), FormatWarning, stacklevel=3)


def listing(names: Iterable[Any]) -> str:
    """Return the first names, shortened, and the number of the others."""
    texts = [str(name) for name in names]
    shown = [text if len(text) <= _LONGEST_NAME else f"{text[: _LONGEST_NAME - 3]}..." for text in texts[:_MOST_NAMES]]
    return ", ".join(shown) + (f" and {number(len(texts) - _MOST_NAMES)} more" if len(texts) > _MOST_NAMES else "")


def warn_left_out(kind: str, names: Collection[str], why: str = "which it cannot hold") -> None:
    """Issue a note about data that a file cannot hold, if there are any."""
    if names:
        warn(f"{kind} is written without {listing(names)}, {why}")


def warn_too_large(dropped: Collection[tuple[str, int]]) -> None:
    """Issue a note about metadata that were dropped since all of them were too large, with names and bytes."""
    if dropped:
        words = listing(f"{key} ({size:,} bytes)" for key, size in dropped)
        warn(f"metadata are limited to {MAX_BYTES:,} bytes; left out: {words}")


def with_nul_shown(kind: str, surface: Surface) -> Surface:
    """Return a surface without NUL in metadata and names of attributes.

    Libraries in C end a text there, or refuse it.

    NUL is replaced by Python's escape, with a note, as writers of meshes do with all control characters.
    """
    metadata = {key: _nul_shown(value) for key, value in surface.metadata.items()}
    changed = [f"control characters of {key}" for key, value in metadata.items() if value != surface.metadata[key]]
    names = {name: _nul_shown(name) for name in surface.blocks[0].attributes}
    changed += [f"control characters of {shown}" for name, shown in names.items() if shown != name]
    if not changed:
        return surface
    warn_left_out(kind, changed, "which are written as Python writes them")
    if all(name == shown for name, shown in names.items()):
        return Surface(blocks=surface.blocks, metadata=metadata)
    blocks = [
        Block(
            block.points,
            block.closed,
            attributes={names[name]: values for name, values in block.attributes.items()},
            mask=block.mask,
        )
        for block in surface.blocks
    ]
    return Surface(blocks=blocks, metadata=metadata)


def _nul_shown(value: Any) -> Any:
    if isinstance(value, str):
        return value.replace("\0", "\\x00")
    if isinstance(value, dict):
        return {_nul_shown(key): _nul_shown(inner) for key, inner in value.items()}
    return [_nul_shown(inner) for inner in value] if isinstance(value, list) else value


def keep_words(words: dict[str, str], key: str, text: str) -> None:
    """Keep unit and CRS from a comment, as our writers of meshes put them; the first ones count."""
    text = text.strip()
    if key in words or not text or (key == "crs" and not _WKT.match(text)) or key not in ("unit", "crs"):
        return
    words[key] = text


def metadata_left_out(surface: Surface, held: Collection[str]) -> list[str]:
    """Return a list, in words, of metadata that a user would miss in a file that holds only some of them.

    Parameters
    ----------
    surface : Surface
    held : collection of str
        The keys that the file holds, in whatever form.
    """
    heights = surface.blocks[0].points.ndim == 2
    names = []
    for key, value in surface.metadata.items():
        if key in held or key in _OF_THE_FILE or value is None or value in ({}, [], ""):
            continue
        if key in _PLACE and not heights:
            continue
        if key == "faces" and not any(part in it for it in _maps(value) for part in _CUT):
            continue
        # An attribute of a VTK file is often called scalars too, and that one is kept.
        single = key == "scalars" and isinstance(value, dict)
        names.append(f"single numbers (scalars: {listing(value)})" if single else str(key))
    return names


def _maps(value: Any) -> list[dict[str, Any]]:
    return [it for it in (value if isinstance(value, list) else [value]) if isinstance(it, dict)]


def survives(values: NDArray[Any], dtype: Any) -> bool:
    """Return whether every value, of an array of any shape, is the same number in another type.

    NaN counts as the same.
    """
    if values.dtype == dtype:
        return True
    with np.errstate(over="ignore", invalid="ignore"):
        other = values.astype(dtype)
        back = other.astype(values.dtype)
    whole = np.dtype(dtype).kind == "f" and values.dtype.kind in "iu"
    # The largest integers are rounded up to a power of two, which comes back as another number, or as the same by luck.
    beyond = whole and bool((other >= 2.0 ** (np.iinfo(values.dtype).bits - (values.dtype.kind == "i"))).any())
    return not beyond and np.array_equal(back, values, equal_nan=values.dtype.kind == "f")
