"""The header of a PLY file: its tables, with their rows and columns, text or binary."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...errors import FormatError
from ..source import number

__all__ = ["Element", "PlyHeader", "Property", "read_header"]

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEAD = 1 << 20
_END = re.compile(rb"(?:^|\n|\r)end_header[ \t]*(?:\r\n|\n|\r)")


@dataclass(frozen=True, slots=True)
class Property:
    """A column of a table; `count` is the type of the lengths where it holds lists, else empty."""

    name: str
    dtype: str
    count: str = ""


@dataclass(frozen=True, slots=True)
class Element:
    """A table: its name, how many rows it has, its columns."""

    name: str
    rows: int
    properties: tuple[Property, ...]


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """Everything that precedes the tables.

    Attributes
    ----------
    order : str
        ``<`` or ``>``; empty for text.
    elements : tuple of Element
        In the order of the file.
    info : tuple of str
        The lines of ``obj_info`` and ``comment``, without these words.
    end : int
        Bytes of the header.
    lines : int
        Lines of the header.
    """

    order: str
    elements: tuple[Element, ...]
    info: tuple[str, ...]
    end: int
    lines: int


def read_header(path: Path) -> PlyHeader:
    """Read the header of a PLY file and check what it promises against the size of the file.

    Raises
    ------
    FormatError
        When it is no header of PLY 1.0, or its elements cannot fit into the file.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
    end = _END.search(head)
    if end is None:
        raise FormatError(f"expected a PLY header that ends with end_header within {number(_HEAD)} bytes, got none")
    lines = head[: end.end()].decode("latin-1").splitlines()
    order: str | None = None
    elements: list[Element] = []
    properties: list[dict[str, Property]] = []  # of each element, by their names
    info: list[str] = []
    for place, line in enumerate(lines, 1):
        words = line.split()
        match words:
            case ["ply"] | ["end_header"] | []:
                pass
            case ["format", name, "1.0"] if name in _FORMATS and order is None:
                order = _FORMATS[name]
            case ["comment" | "obj_info", *_]:
                info.append(line.split(None, 1)[1] if len(words) > 1 else "")
            case ["element", name, rows] if rows.isdecimal() and len(rows) < 20:
                elements.append(Element(name, int(rows), ()))
                properties.append({})
            case ["property", "list", count, dtype, name] if {count, dtype} <= _TYPES.keys() and elements:
                if _TYPES[count][0] == "f":
                    raise FormatError(f"line {place}: expected a list whose length is an integer, got {line.strip()!r}")
                _add(properties[-1], Property(name, _TYPES[dtype], _TYPES[count]), place)
            case ["property", dtype, name] if dtype in _TYPES and elements:
                _add(properties[-1], Property(name, _TYPES[dtype]), place)
            case _:
                raise FormatError(f"line {place}: expected a line of a PLY 1.0 header, got {line.strip()[:80]!r}")
    if order is None:
        raise FormatError("expected a PLY header with a line of the format, got none")
    whole = (replace(it, properties=tuple(of.values())) for it, of in zip(elements, properties, strict=True))
    header = PlyHeader(order, tuple(whole), tuple(info), end.end(), len(lines))
    _check_size(header, path.stat().st_size)
    return header


def _add(properties: dict[str, Property], added: Property, line: int) -> None:
    if added.name in properties:
        raise FormatError(f"line {line}: expected properties of different names, got {added.name!r} twice")
    properties[added.name] = added


def _check_size(header: PlyHeader, size: int) -> None:
    follows = size - header.end
    promised = 0
    for element in header.elements:
        sizes = [np.dtype(it.count or it.dtype).itemsize if header.order else 2 for it in element.properties]
        promised += element.rows * sum(sizes)
        if promised > follows + 1:  # the last number of a text may lack its end of line
            raise FormatError(
                f"this PLY is cut short: its header says {number(element.rows)} rows of {element.name}, for which at "
                f"least {number(promised)} bytes follow it, and {number(follows)} do"
            )
    if len({element.name for element in header.elements}) < len(header.elements):
        raise FormatError("expected elements of different names in a PLY header, got one twice")
