"""The size limit of a surface's metadata, and how larger metadata are cut down."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any

import msgpack

from ..errors import CorruptStreamError, InputError
from .digest import DIGEST

__all__ = ["FOREIGN", "MAX_BYTES", "check", "check_length", "fitted", "packed", "with_notes"]

#: Most bytes of metadata as a container has them, a MessagePack map, with the fingerprint of the values in it.
MAX_BYTES = 1 << 16

# Kind, length and CRC of the section around them.
_FRAME = 1 + 9 + 4

#: What readers leave free of these, for what is added after them: a name, a server's notes, the fingerprint.
_ROOM = 1 << 12

#: The fingerprint that an encoder adds: 64 digits in hexadecimal.
_FINGERPRINT = {DIGEST: "0" * 64}

#: A map from names of authors, such as "org.example.tool", to anything of theirs, which others pass on unchanged.
FOREIGN = "foreign"

#: Maps of which single entries are dropped, so many levels deep; of the other values, the whole one.
_DEPTHS = {"bands": 2, "faces": 1, "foreign": 1, "scalars": 1, "tags": 2, "types": 1}

_Path = tuple[str | int, ...]


def packed(metadata: Mapping[str, Any]) -> bytes:
    """Encode metadata as a MessagePack map, as a container stores them.

    Raises
    ------
    InputError
        If MessagePack cannot represent a value.
    """
    return _packed(dict(metadata))


def check(metadata: Mapping[str, Any]) -> None:
    """Refuse metadata that would take more than `MAX_BYTES` in a container.

    Raises
    ------
    InputError
        With their size and largest entry; or if MessagePack cannot represent a value; or if ``foreign`` is no map from
        names.
    """
    foreign = metadata.get(FOREIGN, {})
    if not isinstance(foreign, Mapping) or not all(isinstance(name, str) for name in foreign):
        raise InputError(f"expected {FOREIGN!r} as a map from names of authors, got {foreign!r:.80}")
    size = len(packed({**metadata, **_FINGERPRINT}))
    if size > MAX_BYTES:
        most, largest = max((len(_packed(value)), str(key)) for key, value in metadata.items())
        raise InputError(
            f"expected metadata of at most {MAX_BYTES:,} bytes, got {size:,}, of which {most:,} are {largest[:40]!r}"
        )


def check_length(length: int, offset: int, *, section: bool = False) -> None:
    """Refuse a container's metadata by their announced length, before they are read, if it exceeds `MAX_BYTES`.

    Parameters
    ----------
    length : int
        Bytes of the map, or of the whole section.
    offset : int
        Offset of the announcement or of the section, for the error.
    section : bool
        Whether the length is that of the whole section.

    Raises
    ------
    CorruptStreamError
    """
    if length > MAX_BYTES + (_FRAME if section else 0):
        raise CorruptStreamError(f"expected at most {MAX_BYTES:,} bytes of metadata, got {length:,}", offset)


def fitted(metadata: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[str, int]]]:
    """Drop the largest entries of metadata that are too large for a container.

    Entries of ``tags``, ``types``, ``bands``, ``scalars`` and ``faces`` are dropped one by one, other values as a
    whole. Others than ``scalars`` and their tags are dropped only if they would not fit without these either. Some room
    is left for later additions, such as a server's notes.

    Parameters
    ----------
    metadata : mapping of str to plain values

    Returns
    -------
    metadata : dict
        Without the dropped entries; no value of the original is changed.
    dropped : list of (str, int)
        Name and size in bytes of each dropped entry, the largest first, and then those of ``scalars``.

    Raises
    ------
    InputError
        If MessagePack cannot represent a value.
    """
    most = MAX_BYTES - _ROOM
    result, dropped = dict(metadata), []
    size = len(packed(result))
    if size <= most:
        return result, []
    result |= {key: deepcopy(result[key]) for key in _DEPTHS if key in result}
    single = [path for key, value in result.items() for path in _paths(value, (key,), _DEPTHS.get(key, 0))]
    of_scalars = _of_scalars(result, single)
    others = [path for path in single if path not in of_scalars]
    # Maps of large keys, or of very many entries.
    whole_entries: list[_Path] = [(key,) for key in result if key in _DEPTHS]
    spare = sum(_size(result, path) for path in of_scalars)
    for paths, enough in ((others, most + spare), ([*of_scalars], most), (whole_entries, most)):
        sizes = {path: _size(result, path) for path in paths if path[0] in result}
        for path in sorted(sizes, key=lambda path: -sizes[path]):
            if size <= enough:
                break
            _drop(result, path)
            dropped.append((" ".join(str(part) for part in path if part != ""), sizes[path]))
            size -= sizes[path]
        size = len(packed(result))
    return result, dropped


def with_notes(metadata: Mapping[str, Any], notes: Sequence[str]) -> dict[str, Any]:
    """Add ``notes`` to metadata: as many as fit, and how many more there were."""
    room = MAX_BYTES - len(packed({**metadata, **_FINGERPRINT, "notes": [""] * 16}))
    kept: list[str] = []
    for number, text in enumerate(notes):
        more = f"and {len(notes) - number:,} more notes"
        room -= len(_packed(text))
        if room < len(_packed(more)):
            kept.append(more)
            break
        kept.append(text)
    return {**metadata, **({"notes": kept} if kept else {})}


def _packed(value: Any) -> bytes:
    """Encode a value with MessagePack."""
    try:
        return bytes(msgpack.packb(value, use_bin_type=True))
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"expected metadata that MessagePack can hold: {error}") from None


def _size(metadata: Mapping[str, Any], path: _Path) -> int:
    """Return the bytes of an entry with its key."""
    return len(_packed(path[-1])) + len(_packed(_at(metadata, path)))


def _of_scalars(metadata: Mapping[str, Any], paths: Sequence[_Path]) -> dict[_Path, None]:
    """Choose the paths of single numbers, of their tags and of the types of these."""
    scalars = metadata.get("scalars")
    names = scalars if isinstance(scalars, Mapping) else {}
    return dict.fromkeys(
        path
        for path in paths
        if path[0] == "scalars" or (path[0] in ("tags", "types") and str(path[-1]).partition("#")[0] in names)
    )


def _paths(value: Any, path: _Path, depth: int) -> Iterator[_Path]:
    """Yield the paths of the entries that are dropped one by one."""
    if depth and isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _paths(inner, (*path, key), depth - 1)
    elif depth and isinstance(value, list) and all(isinstance(inner, Mapping) for inner in value):
        for number, inner in enumerate(value):
            if inner:  # an empty one keeps the place of those after it
                yield from _paths(inner, (*path, number), depth)
    else:
        yield path


def _drop(metadata: dict[str, Any], path: _Path) -> None:
    """Delete an entry, and the maps that it leaves empty."""
    del _at(metadata, path[:-1])[path[-1]]
    while len(path) > 2 and isinstance(path[-2], str) and not _at(metadata, path[:-1]):
        path = path[:-1]
        del _at(metadata, path[:-1])[path[-1]]


def _at(value: Any, path: _Path) -> Any:
    """Return the entry at a path."""
    for part in path:
        value = value[part]
    return value
