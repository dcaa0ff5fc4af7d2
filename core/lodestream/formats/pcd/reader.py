"""Read PCD 0.7 (Point Cloud Data).

Organised clouds, whose points lie on a grid, from text, binary and compressed files.

The reader is our own because no library checks what the header promises before it takes memory. Source: the format's
page in the documentation of the Point Cloud Library, "The PCD file format".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.seams import merge
from ...errors import FormatError
from ...surface import Surface
from ..attributes import COLOR, group
from ..notes import listing, warn
from ..source import Source, number

__all__ = ["read", "sniff"]

_HEAD = 1 << 16
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_TYPES = {"I": "i", "U": "u", "F": "f"}
_SIZES = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}
_PADDING = "_"

#: Where a sensor stands, and how it is turned, unless the header says otherwise.
_ORIGIN = ("0", "0", "0", "1", "0", "0", "0")


@dataclass(frozen=True, slots=True)
class _Header:
    record: np.dtype[Any]
    rows: int
    columns: int
    data: str
    end: int
    lines: int
    viewpoint: tuple[str, ...]

    @property
    def points(self) -> int:
        return self.rows * self.columns


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins with the lines of a PCD header."""
    lines = [line for line in head.splitlines() if line.strip() and not line.startswith(b"#")]
    return (bool(lines) and lines[0].split()[0] == b"VERSION") or head.startswith(b"# .PCD")


def read(source: Source) -> Surface:
    """Read an organised cloud (HEIGHT above 1); points with a coordinate that is not finite are holes.

    Packed colours (``rgb``, ``rgba``) become "color", normals "normal"; other fields keep their name.

    Raises
    ------
    FormatError
        If the file is not whole, or HEIGHT is 1: points without a grid.
    """
    with source.path.open("rb") as file:
        header = _read_header(file.read(_HEAD))
    if header.rows < 2:
        raise FormatError(
            f"this cloud has HEIGHT {header.rows}, so that nothing says which of its {number(header.points)} points "
            "are neighbours: save it organised in rows and columns, with HEIGHT 2 or more, or make a mesh of it"
        )
    source.check_vertices(header.points, f"a cloud of {header.columns} x {header.rows}")
    if not _at_origin(header.viewpoint):
        warn(f"VIEWPOINT {listing([' '.join(header.viewpoint)])} left out")
    columns = _READERS[header.data](source, header)
    shape = (header.rows, header.columns)
    points = np.stack([columns.pop(axis) for axis in "xyz"], axis=-1).reshape(*shape, 3)
    attributes = {
        name: values.reshape(*shape, *values.shape[1:]) for name, values in group(_with_colors(columns)).items()
    }
    return merge(Surface(points, attributes=attributes, metadata=source.metadata("pcd")), source.closed)


def _at_origin(viewpoint: tuple[str, ...]) -> bool:
    try:
        return tuple(map(float, viewpoint)) == tuple(map(float, _ORIGIN))
    except ValueError:
        return False


def _read_header(head: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    place = line = 0
    while "DATA" not in entries:
        end = head.find(b"\n", place)
        if end < 0:
            raise FormatError(
                f"this PCD header has no line DATA within {number(_HEAD)} bytes: the file is cut short, or damaged"
            )
        words = head[place:end].decode("ascii", "replace").split("#", 1)[0].split()
        place, line = end + 1, line + 1
        if words:
            if words[0] not in _KEYS:
                raise FormatError(
                    f"line {line}: this PCD header has {words[0][:40]!r}, and may have {', '.join(_KEYS)} only"
                )
            entries[words[0]] = words[1:]
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT") if key not in entries]
    if missing:
        raise FormatError(f"this PCD header has no line {' and no line '.join(missing)}: save the cloud again")
    width, height = (_integer(entries, key) for key in ("WIDTH", "HEIGHT"))
    if "POINTS" in entries and _integer(entries, "POINTS") != width * height:
        points = _integer(entries, "POINTS")
        raise FormatError(
            f"this PCD header contradicts itself: POINTS is {number(points)}, and WIDTH x HEIGHT is {width} x {height}"
        )
    data = " ".join(entries["DATA"])
    if data not in _READERS:
        raise FormatError(f"this PCD header has DATA {data[:40]!r}: save the cloud as {' or '.join(_READERS)}")
    return _Header(_record(entries), height, width, data, place, line, tuple(entries.get("VIEWPOINT", _ORIGIN)))


def _integer(entries: dict[str, list[str]], key: str) -> int:
    words = entries[key]
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 20:
        raise FormatError(f"expected {key} and a whole number in the PCD header, got {' '.join(words)[:40]!r}")
    return int(words[0])


def _record(entries: dict[str, list[str]]) -> np.dtype[Any]:
    names = entries["FIELDS"]
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(counts) == len(entries["SIZE"]) == len(entries["TYPE"]):
        raise FormatError(f"expected SIZE, TYPE and COUNT for each of the {len(names)} FIELDS of the PCD header")
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for index, (name, size, kind, count) in enumerate(
        zip(names, entries["SIZE"], entries["TYPE"], counts, strict=True)
    ):
        if kind not in _TYPES or not size.isdecimal() or int(size[:9]) not in _SIZES[kind]:
            raise FormatError(f"expected a PCD field of type I, U or F and its size, got {name!r}: {kind} {size}")
        if not count.isdecimal() or not 1 <= int(count[:9]) <= 4096:
            raise FormatError(f"expected COUNT from 1 to 4096 in the PCD header, got {count[:40]!r} for {name!r}")
        label = f"{_PADDING}{index}" if name == _PADDING else name
        fields.append((label, f"<{_TYPES[kind]}{size}", (int(count),) if int(count) > 1 else ()))
    if len({name for name, _, _ in fields}) < len(fields):
        raise FormatError("expected FIELDS of different names in the PCD header, got one twice")
    record = np.dtype(fields)
    assert record.fields is not None  # it was just made of fields
    axes = {record.fields[axis][0] for axis in "xyz" if axis in record.fields}
    if lacking := [axis for axis in "xyz" if axis not in record.fields]:
        raise FormatError(
            f"this cloud has no field {' and no field '.join(lacking)}, only {' '.join(names)[:80]}: save it with x, y "
            "and z"
        )
    if len(axes) != 1 or axes.pop().kind != "f":
        raise FormatError(
            "this cloud has x, y and z of unlike or whole numbers: save all three with TYPE F and one SIZE"
        )
    return record


def _read_text(source: Source, header: _Header) -> dict[str, NDArray[Any]]:
    with source.path.open("rb") as file:
        file.seek(header.end)
        rows = [row.split() for row in file.read().splitlines()]
    while rows and not rows[-1]:
        rows.pop()
    if len(rows) != header.points:
        words = "is cut short" if len(rows) < header.points else "goes on behind its points"
        raise FormatError(
            f"this cloud {words}: its header says {number(header.points)} points, and {number(len(rows))} lines follow"
        )
    names = header.record.names or ()
    width = sum(header.record[name].shape[0] if header.record[name].shape else 1 for name in names)
    columns: dict[str, NDArray[Any]] = {}
    place = 0
    for name in names:
        dtype = header.record[name]
        count = dtype.shape[0] if dtype.shape else 1
        try:
            convert = float if dtype.base.kind == "f" else int
            values = [convert(word) for row in rows for word in _cells(row, width, place, count)]
            columns[name] = np.array(values, dtype.base).reshape(-1, *dtype.shape)
        except (ValueError, OverflowError):
            raise _bad_line(rows, header, width) from None
        place += count
    return _unpadded(columns)


def _cells(row: list[bytes], width: int, place: int, count: int) -> list[bytes]:
    if len(row) != width:
        raise ValueError("another number of values")
    return row[place : place + count]


def _bad_line(rows: list[list[bytes]], header: _Header, width: int) -> FormatError:
    """Return the error of the first line that does not hold the values of a point."""
    fields = [header.record[name] for name in header.record.names or ()]
    dtypes = [dtype.base for dtype in fields for _ in range(dtype.shape[0] if dtype.shape else 1)]
    for index, row in enumerate(rows):
        try:
            for word, dtype in zip(_cells(row, width, 0, width), dtypes, strict=True):
                np.array(float(word) if dtype.kind == "f" else int(word), dtype)
        except (ValueError, OverflowError):
            shown = b" ".join(row)[:60].decode("ascii", "backslashreplace")
            names = " ".join(header.record.names or ())
            line = header.lines + 1 + index
            return FormatError(f"line {line}: expected {width} values of {names}, got {shown!r}")
    return FormatError(f"expected {width} values on each line of points, got others")


def _read_binary(source: Source, header: _Header) -> dict[str, NDArray[Any]]:
    promised = header.points * header.record.itemsize
    follows = source.size - header.end
    if follows != promised:
        words = "is cut short" if follows < promised else "goes on behind its points"
        raise FormatError(
            f"this cloud {words}: its header says {number(header.points)} points, {number(promised)} bytes, and "
            f"{number(follows)} follow"
        )
    rows = np.memmap(source.path, header.record, "r", header.end, (header.points,))
    return _unpadded({name: np.array(rows[name]) for name in header.record.names or ()})


def _read_compressed(source: Source, header: _Header) -> dict[str, NDArray[Any]]:
    """Read fields that are stored one after another and compressed together.

    Padding of a page after them is ignored.
    """
    from .lzf import decompress  # compiled, so not before a file needs it

    promised = header.points * header.record.itemsize
    source.check_expansion(promised)
    with source.path.open("rb") as file:
        file.seek(header.end)
        head = file.read(8)
        sizes = struct.unpack("<II", head) if len(head) == 8 else ()
        follows = source.size - file.tell()
        if len(sizes) != 2 or sizes[0] > follows:
            words = f"{number(sizes[0])} bytes of compressed points" if sizes else "two sizes of compressed points"
            raise FormatError(f"this cloud is cut short: {words} should follow, and {number(follows)} bytes do")
        if sizes[1] != promised:
            raise FormatError(
                f"this cloud contradicts itself: its header says {number(header.points)} points, {number(promised)} "
                f"bytes, and its compressed points make {number(sizes[1])}"
            )
        content = file.read(sizes[0])
    values = decompress(content, promised)
    columns: dict[str, NDArray[Any]] = {}
    place = 0
    for name in header.record.names or ():
        dtype = header.record[name]
        stop = place + dtype.itemsize * header.points
        columns[name] = values[place:stop].view(dtype.base).reshape(header.points, *dtype.shape)
        place = stop
    return _unpadded(columns)


_READERS = {"ascii": _read_text, "binary": _read_binary, "binary_compressed": _read_compressed}


def _unpadded(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: column for name, column in columns.items() if not name.startswith(_PADDING)}


def _with_colors(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Unpack colours, which are four bytes in a number of any type: blue, green, red, alpha."""
    for name, order in (("rgba", (2, 1, 0, 3)), ("rgb", (2, 1, 0))):
        packed = columns.get(name)
        if packed is not None and packed.ndim == 1 and packed.dtype.itemsize == 4 and COLOR not in columns:
            packed = np.ascontiguousarray(columns.pop(name)).astype(packed.dtype.newbyteorder("<"))
            columns[COLOR] = np.ascontiguousarray(packed.view(np.uint8).reshape(-1, 4)[:, order])
    return columns
