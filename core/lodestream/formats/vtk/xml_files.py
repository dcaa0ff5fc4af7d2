"""Read XML files of VTK with a structured grid (.vts); their headers are checked before VTK sees them.

Source: "VTK XML Formats" of the VTK documentation, and how VTK's vtkXMLDataParser.cxx reads blocks.
"""

from __future__ import annotations

import base64
import binascii
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError, TooLargeError
from ...surface import Surface
from .. import planes
from ..planes import Dims
from ..source import Source, number
from .grids import Mapped, Reading, check_arrays, read_grids

__all__ = ["MORE", "OPTIONS", "SUFFIXES", "read", "sniff"]

SUFFIXES = (".vts",)
OPTIONS: Mapping[str, str] = {"plane": planes.HELP}
MORE = "one more block each"

_CHUNK = 1 << 16
_SIZES = {"Int8": 1, "UInt8": 1, "Int16": 2, "UInt16": 2, "Int32": 4, "UInt32": 4, "Int64": 8, "UInt64": 8}
_SIZES |= {"Float32": 4, "Float64": 8}
#: Kind and bits in the name of a type, and numpy's letter of the kind.
_TYPE, _LETTERS = re.compile(r"(U?Int|Float)(8|16|32|64)"), {"Int": "i", "UInt": "u", "Float": "f"}
_GHOSTS = "vtkGhostType"
_SECTIONS = ("PointData", "CellData", "Points")

#: What to do with grids of other types.
_AS_STRUCTURED = ": save it as .vts, as by pyvista: pyvista.read({!r}).cast_to_structured_grid().save('a.vts')"
_AS_MESH = ": save the surface as .ply or .obj, of which a grid is made if the mesh is one"
_ADVICE = {
    "ImageData": _AS_STRUCTURED.format("a.vti"),
    "RectilinearGrid": _AS_STRUCTURED.format("a.vtr"),
    "PolyData": _AS_MESH,
    "UnstructuredGrid": _AS_MESH,
}

#: VTK looks through all attributes of an element to add one.
_MOST_ATTRIBUTES = 100

#: Bytes of a tag or comment. The parser begins it anew with each chunk of the file until it is whole.
_LONGEST_TAG = 1 << 18

#: Characters of an array that are kept: those of its header in base64.
_KEPT = 256


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like an XML file of VTK."""
    return head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"<?xml", b"<VTKFile", b"<!--")) and b"<VTKFile" in head


def read(source: Source) -> Surface:
    """Read the grid of each file as a block; an index plane of volumes (option ``plane``).

    Raises
    ------
    FormatError
        If a file is not whole, or holds no structured grid; of several files the message names the one.
    """
    readings = []
    for path in (source.path, *source.more):
        try:
            dims, promised, mapped = _checked(path)
        except FormatError as error:
            raise FormatError(f"{path.name}: {error}" if source.more else str(error)) from None
        source.check_expansion(promised)
        readings.append(Reading("xml", path, promised, dims, mapped))
    return read_grids(source, "vts", readings)


@dataclass(slots=True)
class _Array:
    """A DataArray: its attributes, the points or cells that it is for, how its text begins and how long it is."""

    attributes: dict[str, str]
    tuples: int
    section: str = ""
    text: str = ""
    characters: int = 0

    @property
    def name(self) -> str:
        return self.attributes.get("Name", "of points")[:80]

    def promised(self) -> int:
        """Return the bytes that the array takes in memory."""
        kind, components = self.attributes.get("type", ""), self.attributes.get("NumberOfComponents", "1")
        if kind not in _SIZES or not re.fullmatch(r"[1-9]\d{0,4}", components):
            raise FormatError(
                f"expected array {self.name!r} of a type of VTK and 1 to 99999 components, got {kind[:40]!r} and "
                f"{components[:40]!r}"
            )
        return _SIZES[kind] * int(components) * self.tuples


@dataclass(slots=True)
class _Content:
    """Content of a file, as its XML describes it."""

    root: dict[str, str] = field(default_factory=dict)
    whole: tuple[int, ...] = ()
    piece: tuple[int, ...] = ()
    pieces: int = 0
    named: int = 0  # arrays of any kind, of field data too
    section: str = ""
    active: dict[str, str] = field(default_factory=dict)  # which point data are scalars, normals, ...
    arrays: list[_Array] = field(default_factory=list)
    open_array: bool = False
    appended: dict[str, str] | None = None
    appended_at: int = -1


def _checked(path: Path) -> tuple[Dims, int, Mapped | None]:
    """Check the headers of a file.

    Return the points along i, j and k, the bytes of its arrays, and the mapped arrays.
    """
    content = _parsed(path)
    kind = content.root.get("type", "none")
    if kind == "vtkMultiBlockDataSet":
        raise FormatError(
            "this is a .vtm file, which only names other files, and these are never opened: "
            "give its .vts files together, one for each block, as in lodestream.read('a/a_0.vts', 'a/a_1.vts')"
        )
    if kind != "StructuredGrid":
        advice = _ADVICE.get(kind, "")
        raise FormatError(f"this is a VTK file of type {kind[:60]}, not StructuredGrid{advice}")
    if not content.whole or not content.pieces:
        raise FormatError("expected a StructuredGrid with a WholeExtent and a Piece, got none")
    promised = sum(array.promised() for array in content.arrays)
    for array in content.arrays:
        _check_array(path, content, array)
    i, j, k = _lengths(content.whole)
    return (i, j, k), promised, _mapped(path, content, (i, j, k))


#: Which role the point data have that an attribute of their element names.
_ACTIVE = {"Normals": "normals", "TCoords": "texture", "Scalars": "scalars"}


def _mapped(path: Path, content: _Content, dims: Dims) -> Mapped | None:
    """Return memory maps of the arrays of a file; None if VTK must read them.

    VTK must read a file with several pieces, field data or hidden cells, or whose arrays are not raw bytes.
    """
    raw = content.appended is not None and content.appended.get("encoding", "base64") == "raw"
    is_whole = content.pieces == 1 and content.piece == content.whole and content.named == len(content.arrays)
    if not raw or not is_whole or content.root.get("compressor"):
        return None
    arrays: list[tuple[str, str, NDArray[Any]]] = []
    left_out: list[str] = []
    names: set[tuple[str, str | None]] = set()
    for array in content.arrays:
        key = array.section, array.attributes.get("Name")
        hides = key[1] == _GHOSTS and (array.section == "CellData" or array.attributes.get("type") != "UInt8")
        if hides or key in names or (not key[1] and array.section != "Points"):
            return None
        names.add(key)
        if array.section == "CellData":
            left_out.append(array.name)
            continue
        values = _values(path, content, array)
        if values is None:
            return None
        arrays.append((_role(content, array), "" if array.section == "Points" else str(key[1]), values))
    points = [values for role, _, values in arrays if role == "points"]
    if len(points) != 1 or points[0].shape[1:] != (3,) or points[0].dtype.kind != "f":
        return None
    arrays.sort(key=lambda entry: entry[0] != "points")
    return Mapped(dims, tuple(arrays), tuple(left_out))


def _role(content: _Content, array: _Array) -> str:
    if array.section == "Points":
        return "points"
    name = array.attributes.get("Name")
    if name == _GHOSTS:
        return "point_ghost"
    return next((role for key, role in _ACTIVE.items() if content.active.get(key) == name), "point")


def _values(path: Path, content: _Content, array: _Array) -> NDArray[Any] | None:
    """Return the values of an array that is appended as bytes, shape (point,) or (point, component); else None."""
    if array.attributes.get("format") != "appended":
        return None
    place, room = _place(path, content, array)
    words = _TYPE.fullmatch(array.attributes.get("type", ""))
    if place is None or words is None:
        return None
    order = ">" if content.root.get("byte_order") == "BigEndian" else "<"
    dtype = np.dtype(f"{order}{_LETTERS[words[1]]}{int(words[2]) // 8}")
    place += 8 if content.root.get("header_type", "UInt32") == "UInt64" else 4
    components = int(array.attributes.get("NumberOfComponents", "1"))
    if array.tuples * components * dtype.itemsize > room:
        return None
    shape = (array.tuples,) if components == 1 else (array.tuples, components)
    return np.memmap(path, dtype, "r", place, shape)


class _Parser:
    """Handles the events of expat, and collects the description of the grid in `content`."""

    def __init__(self) -> None:
        self.content = _Content()
        self.expat = expat.ParserCreate()
        self.expat.StartElementHandler, self.expat.EndElementHandler = self._start, self._end
        self.expat.CharacterDataHandler = self._text
        self.expat.StartDoctypeDeclHandler = self.expat.EntityDeclHandler = _refuse

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        content = self.content
        content.open_array = False
        content.named += name in ("DataArray", "Array")
        check_arrays(content.named)
        if len(attributes) > _MOST_ATTRIBUTES:
            got = number(len(attributes))
            raise TooLargeError(f"expected at most {_MOST_ATTRIBUTES} attributes of {name[:40]!r}, got {got}")
        match name:
            case "VTKFile":
                content.root = attributes
            case "StructuredGrid":
                content.whole = _extent(attributes.get("WholeExtent", ""))
            case "Piece" if content.whole:
                content.piece = _extent(attributes.get("Extent", ""))
                content.pieces += 1
                _check_inside(content.piece, content.whole)
            case "DataArray" if content.piece and content.section:
                lengths = _lengths(content.piece)
                if content.section == "CellData":
                    lengths = tuple(max(length - 1, 1) for length in lengths)
                content.arrays.append(_Array(attributes, prod(lengths), content.section))
                content.open_array = True
            case "AppendedData":
                content.appended = attributes
                content.appended_at = self.expat.CurrentByteIndex
            case _ if name in _SECTIONS:
                content.section = name
                if name == "PointData":
                    content.active = attributes

    def _end(self, name: str) -> None:
        self.content.open_array = False
        if name in _SECTIONS:
            self.content.section = ""

    def _text(self, characters: str) -> None:
        if self.content.open_array:
            array = self.content.arrays[-1]
            array.characters += len(characters)
            if len(array.text) < _KEPT:
                array.text += "".join(characters.split())[:_KEPT]


def _refuse(*_: Any) -> None:
    raise FormatError("expected XML without a DOCTYPE or entities, got one")


def _parsed(path: Path) -> _Content:
    """Parse a file to its end, or as far as its appended data."""
    parser = _Parser()
    content = parser.content
    try:
        with path.open("rb") as file:
            read = 0
            while content.appended is None and (chunk := file.read(_CHUNK)):
                parser.expat.Parse(chunk)
                read += len(chunk)
                if content.appended is None and read - parser.expat.CurrentByteIndex > _LONGEST_TAG:
                    raise TooLargeError(
                        f"expected tags and comments of at most {number(_LONGEST_TAG)} bytes, got a longer one"
                    )
            if content.appended is None:
                parser.expat.Parse(b"", True)
    except expat.ExpatError as error:
        if content.appended is None:  # what is appended may be bytes, which are no XML
            raise FormatError(f"expected an XML file of VTK, got {error}") from None
    return content


def _extent(text: str) -> tuple[int, ...]:
    words = text.split()
    if len(words) != 6 or not all(re.fullmatch(r"-?\d{1,9}", word) for word in words):
        raise FormatError(f"expected an extent of six whole numbers, got {text[:80]!r}")
    extent = tuple(map(int, words))
    if min(_lengths(extent)) < 1:
        raise FormatError(f"expected an extent from lower to higher numbers, got {text!r}")
    return extent


def _lengths(extent: Sequence[int]) -> tuple[int, ...]:
    return tuple(extent[axis + 1] - extent[axis] + 1 for axis in (0, 2, 4))


def _check_inside(piece: Sequence[int], whole: Sequence[int]) -> None:
    inside = all(whole[axis] <= piece[axis] and piece[axis + 1] <= whole[axis + 1] for axis in (0, 2, 4))
    if not inside:
        raise FormatError(f"expected pieces inside the WholeExtent {whole}, got {piece}")


def _check_array(path: Path, content: _Content, array: _Array) -> None:
    """Check that the length before the bytes of an array agrees with its type and extent."""
    form = array.attributes.get("format", "ascii")
    if form == "ascii":
        return
    if form not in ("binary", "appended"):
        raise FormatError(f"expected array {array.name!r} as ascii, binary or appended, got {form[:40]!r}")
    blocks = bool(content.root.get("compressor"))
    wide = content.root.get("header_type", "UInt32") == "UInt64"
    code = ("<" if content.root.get("byte_order") != "BigEndian" else ">") + ("Q" if wide else "I")
    head, room = _head(path, content, array, struct.calcsize(code) * (3 if blocks else 1))
    if head is None:
        raise FormatError(f"expected array {array.name!r} inside the file, got none there")
    if blocks:
        count, length, last = struct.unpack(f"{code[0]}3{code[1]}", head)
        stated = (count - (last > 0)) * length + last if count else 0
        least = (3 + count) * struct.calcsize(code)
    else:
        stated = struct.unpack(code, head)[0]
        least = stated + struct.calcsize(code)
    if stated != array.promised():
        raise FormatError(
            f"expected array {array.name!r} of {number(array.promised())} bytes by its extent and type, got a header "
            f"that says {number(stated)}"
        )
    if least > room:
        raise FormatError(f"expected array {array.name!r} of at least {number(least)} bytes, got {number(room)}")


def _head(path: Path, parsed: _Content, array: _Array, length: int) -> tuple[bytes | None, int]:
    """Return the first bytes of an array, decoded, None if there are none; and the bytes that the file has for it."""
    in_base64 = 4 * ((length + 2) // 3)
    if array.attributes.get("format") == "binary":
        return _decoded(array.text.encode("ascii", "replace")[:in_base64], length), array.characters * 3 // 4
    place, room = _place(path, parsed, array)
    if parsed.appended is None or place is None:
        return None, 0
    raw = parsed.appended.get("encoding", "base64") == "raw"
    with path.open("rb") as file:
        file.seek(place)
        content = file.read(length if raw else in_base64)
    if raw:
        return content if len(content) == length else None, room
    return _decoded(content, length), room * 3 // 4


def _place(path: Path, content: _Content, array: _Array) -> tuple[int | None, int]:
    """Return the offset of an appended array in the file, None if it is outside; and the bytes that follow."""
    offset = array.attributes.get("offset", "")
    if content.appended is None or not re.fullmatch(r"\d{1,18}", offset):
        return None, 0
    with path.open("rb") as file:
        file.seek(content.appended_at)
        start = file.read(1 << 12)
    mark = start.find(b"_", start.find(b">"))
    place = content.appended_at + mark + 1 + int(offset)
    room = path.stat().st_size - place
    return (None, 0) if mark < 0 or room <= 0 else (place, room)


def _decoded(content: bytes, length: int) -> bytes | None:
    try:
        decoded = base64.b64decode(content)
    except binascii.Error:
        return None
    return decoded[:length] if len(decoded) >= length else None
