"""Read OFF as text: vertices and faces, with normals, colours and texture coordinates if the first word announces them.

Geomview's manual describes it. Colours of faces are left out.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..mesh import Mesh
from ..mesh.ears import cut_faces
from ..surface import Surface
from .attributes import COLOR, NORMAL, TEXTURE
from .meshes import check_corners, check_faces, polygons_allowed, surface_of
from .source import Source, number

__all__ = ["read", "sniff"]

_KEYWORD = re.compile(rb"(?:\s*#[^\n]*\n)*\s*(ST)?(C)?(N)?(4)?(n)?OFF(?=[\s#]|$)")
_ROWS = 1 << 16

#: A vertex is three numbers and a face four, each with a separator.
_LEAST_BYTES = 6


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins with OFF, or with one of the words that say more than that."""
    return _KEYWORD.match(head) is not None


def read(source: Source) -> Surface:
    """Read a mesh that is a structured surface.

    Raises
    ------
    FormatError
        If the file is not whole, or its faces are no grid.
    """
    lines = _Lines(source)
    vertices, faces = lines.counts()
    source.check_vertices(vertices, f"{number(vertices)} vertices")
    check_faces(source, faces)
    if _LEAST_BYTES * (vertices + faces) > source.size:
        raise FormatError(
            f"this OFF is cut short: it says {number(vertices)} vertices and {number(faces)} faces, at least "
            f"{number(_LEAST_BYTES * (vertices + faces))} bytes, and has {number(source.size)}"
        )
    points, attributes = lines.vertices(vertices)
    counts, values, coloured = lines.faces(faces, vertices, polygons_allowed(source.options))
    lines.end()
    check_faces(source, len(values) - 2 * faces)
    places, face_of = cut_faces(points, counts, values)
    corners = np.where(places >= 0, values[places], -1).astype(np.int32)
    first = lines.numbers[len(lines.numbers) - faces :]
    notes = ("colours of faces left out",) * coloured

    def name(row: int) -> str:
        face = int(face_of[row])
        return f"face {face + 1} (line {first[face]})"

    return surface_of(source, Mesh(points, corners, attributes, {}, name, notes), "off")


class _Lines:
    """Lines with content, one after another, without comments."""

    def __init__(self, source: Source) -> None:
        content = source.path.read_bytes().replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        keyword = _KEYWORD.match(content)
        if keyword is None:  # it was taken for OFF by its first bytes alone, with other ends of lines
            raise FormatError("expected a line with OFF at the beginning, got another")
        self.texture, self.colours, self.normals = (part is not None for part in keyword.groups()[:3])
        if keyword[4] or keyword[5]:
            raise FormatError(f"expected OFF of three dimensions, got {keyword[0].split()[-1].decode('ascii')}")
        before = content[: keyword.end()].count(b"\n")
        texts = content[keyword.end() :].split(b"\n")
        del content
        self._rows: list[list[bytes]] = []
        self.numbers: list[int] = []
        for line, text in enumerate(texts, before + 1):
            words = (text[: text.index(b"#")] if b"#" in text else text).split()
            if words:
                self._rows.append(words)
                self.numbers.append(line)
        self._place = 0

    def counts(self) -> tuple[int, int]:
        """Return the numbers of vertices and faces that the file announces."""
        words = self._rows[0] if self._rows else []
        if words[:1] == [b"BINARY"]:
            raise FormatError("expected OFF as text, got OFF BINARY")
        if len(words) not in (2, 3) or not all(word.isdigit() and len(word) < 12 for word in words):
            line = f"line {self.numbers[0]}: " if self._rows else ""
            raise FormatError(f"{line}expected the numbers of vertices, faces and edges, got {_shown(words)}")
        self._place = 1
        return int(words[0]), int(words[1])

    def _take(self, count: int, what: str) -> tuple[list[list[bytes]], list[int]]:
        rows = self._rows[self._place : self._place + count]
        if len(rows) < count:
            raise FormatError(
                f"this OFF is cut short: it says {number(count)} {what}, and {number(len(rows))} lines of them follow"
            )
        numbers = self.numbers[self._place : self._place + count]
        self._place += count
        return rows, numbers

    def vertices(self, count: int) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]]]:
        """Return points and their attributes."""
        rows, numbers = self._take(count, "vertices")
        if not rows:
            raise FormatError("expected at least one vertex, got none")
        width = len(rows[0])
        colours = width - 3 - 3 * self.normals - 2 * self.texture if self.colours else 0
        wanted = 3 + 3 * self.normals + colours + 2 * self.texture
        if colours not in ((3, 4) if self.colours else (0,)):
            raise FormatError(
                f"line {numbers[0]}: expected a vertex with a colour of 3 or 4 numbers, got {_shown(rows[0])}"
            )
        values = np.empty((count, wanted))
        for start in range(0, count, _ROWS):
            chunk = rows[start : start + _ROWS]
            words = [word for row in chunk for word in row]
            try:
                if any(len(row) != wanted for row in chunk):
                    raise ValueError("rows of other lengths")
                values[start : start + len(chunk)] = np.fromiter(map(float, words), np.float64, len(words)).reshape(
                    -1, wanted
                )
            except ValueError:
                raise self._wrong(chunk, numbers[start:], wanted) from None
        attributes: dict[str, NDArray[Any]] = {}
        place = 3
        if self.normals:
            attributes[NORMAL] = values[:, 3:6].copy()
            place = 6
        if self.colours:
            attributes[COLOR] = _colours(values[:, place : place + colours])
        if self.texture:
            attributes[TEXTURE] = values[:, -2:].copy()
        return values[:, :3].copy(), attributes

    def _wrong(self, rows: list[list[bytes]], numbers: list[int], wanted: int) -> FormatError:
        for row, line in zip(rows, numbers, strict=False):
            try:
                if len([float(word) for word in row]) == wanted:
                    continue
            except ValueError:
                pass
            return FormatError(f"line {line}: expected a vertex of {wanted} numbers, got {_shown(row)}")
        raise AssertionError("one of the rows is wrong")

    def faces(self, count: int, vertices: int, polygons: bool) -> tuple[NDArray[np.int64], NDArray[np.int64], bool]:
        """Return the number of corners of each face, all their vertices, and whether some have colours."""
        rows, numbers = self._take(count, "faces")
        counts = np.empty(count, np.int64)
        corners: list[int] = []
        coloured = False
        for face, (row, line) in enumerate(zip(rows, numbers, strict=True)):
            try:
                sides = int(row[0])
                indices = [int(word) for word in row[1 : sides + 1]]
                if sides < 1 or len(indices) < sides or min(indices) < 0 or max(indices) >= vertices:
                    raise ValueError("no such vertex")
            except ValueError:
                raise FormatError(
                    f"line {line}: expected 3 or 4 and as many vertices from 0 to {number(vertices - 1)}, got "
                    f"{_shown(row)}"
                ) from None
            check_corners(sides, f"in line {line}", polygons)
            counts[face] = sides
            corners += indices
            coloured |= len(row) > sides + 1
        return counts, np.array(corners, np.int64), coloured

    def end(self) -> None:
        """Refuse lines after the last face."""
        if self._place < len(self._rows):
            raise FormatError(
                f"line {self.numbers[self._place]}: expected the end of the file after its faces, got "
                f"{_shown(self._rows[self._place])}"
            )


def _colours(values: NDArray[np.float64]) -> NDArray[Any]:
    """Return colours as bytes if they are whole numbers up to 255, else unchanged."""
    whole = (values == np.trunc(values)).all() and values.min() >= 0 and values.max() <= 255
    return values.astype(np.uint8) if whole and values.max() > 1 else values.copy()


def _shown(words: list[bytes]) -> str:
    return repr(b" ".join(words)[:60].decode("ascii", "backslashreplace"))
