"""OBJ of a quad grid in row order, read and written.

The reader is our own because the usual libraries cut quads into triangles or end the process on a bad file. References
to other files (``mtllib``) are skipped.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, TooLargeError
from ..surface import Surface
from .connectivity import find_curve, find_grid
from .quads import columns, edges, quads
from .source import Source, number

__all__ = ["read", "sniff", "write"]

#: Statements that say nothing about which points there are and how they are joined.
_IGNORED = frozenset(
    b"vt vn g o s mg usemtl mtllib usemap maplib shadow_obj trace_obj bevel c_interp d_interp lod".split()
)
_READ = frozenset((b"v", b"f", b"l"))

#: Bytes of text in any encoding that extends ASCII, for names and comments.
_TEXT = bytes((*b"\t\n\f\r", *range(0x20, 0x7F), *range(0x80, 0x100)))

_BLOCK = 1 << 20
_ROWS = 1 << 16


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file is text named .obj, or text that begins with an OBJ statement and is not named otherwise."""
    if head.translate(None, _TEXT):
        return False
    if suffix == ".obj":
        return True
    statements = (words for line in head.splitlines() if (words := line.split()) and not words[0].startswith(b"#"))
    return not suffix and next(statements, [b""])[0] in _READ | _IGNORED


def read(source: Source) -> Surface:
    """Read points in row order whose faces are exactly the quads of an H x W grid, open or closed on each axis.

    Faces may come in any order and be wound either way. Points with six values keep the last three as attributes.
    Without faces, points joined in order by ``l`` are a curve, of shape (N, 1, 3).
    """
    mesh = _Mesh(source)
    for line, run in _runs(source.path):
        mesh.add(line, run)
    points = mesh.points()
    metadata = source.metadata("obj")
    if mesh.face_count:
        rows, width, closed = find_grid(len(points), mesh.faces(), mesh.face_line)
        return Surface(points.reshape(rows, width, -1), closed, metadata=metadata)
    if not mesh.segments:
        raise FormatError(f"expected faces that join points to a grid, got {number(len(points))} points and no face")
    curve_closed = find_curve(len(points), np.array(mesh.segments, np.int64), mesh.segment_lines)
    return Surface(points.reshape(len(points), 1, -1), (curve_closed, False), metadata=metadata)


def _runs(path: Path) -> Iterator[tuple[int, list[bytes]]]:
    """Give the lines in runs that begin with the same two bytes, each with the number of its first line."""
    line, rest = 1, b""
    with path.open("rb") as file:
        while True:
            block = file.read(_BLOCK)
            text = rest + block
            lines = text.split(b"\n")
            rest = lines.pop() if block else b""
            if len(rest) > _BLOCK:
                raise FormatError(f"line {line}: expected a line of at most {number(_BLOCK)} bytes, got a longer one")
            for _, group in groupby(lines, _start):
                run = list(group)
                yield line, run
                line += len(run)
            if not block:
                return


def _start(line: bytes) -> bytes:
    return line[:2]


class _Mesh:
    """What has been read so far, in arrays of one run of lines each."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.point_count = 0
        self.face_count = 0
        self.segments: list[tuple[int, int]] = []
        self.segment_lines: list[int] = []
        self._points: list[NDArray[np.float64]] = []
        self._faces: list[NDArray[np.int64]] = []
        self._face_starts: list[tuple[int, int]] = []  # number of the first face of a run and of its line

    def add(self, line: int, run: list[bytes]) -> None:
        """Add lines that begin alike; a run without surprises is converted as a whole, any other line by line."""
        if run[0][:2] in (b"vt", b"vn"):
            return
        if run[0][:2] == b"v " and self._add_points_at_once(line, run):
            return
        if run[0][:2] == b"f " and self._add_quads_at_once(line, run):
            return
        for offset, text in enumerate(run):
            self._add_line(line + offset, text)

    def _add_points_at_once(self, line: int, run: list[bytes]) -> bool:
        values = _table(run, b"v", len(run[0].split()) - 1, _floats)
        if values is None or values.shape[1] not in (3, 6):
            return False
        self._keep_points(line, values)
        return True

    def _add_quads_at_once(self, line: int, run: list[bytes]) -> bool:
        if any(b"/" in text for text in run):
            run = [b" ".join([word.split(b"/", 1)[0] for word in text.split()]) for text in run]
        corners = _table(run, b"f", 4, _integers)
        if corners is None or corners.min() < 1 or corners.max() > self.point_count:
            return False
        self._keep_faces(line, corners - 1)
        return True

    def _add_line(self, line: int, text: bytes) -> None:
        words = text.split(b"#", 1)[0].split()
        if not words or words[0] in _IGNORED:
            return
        if words[0] not in _READ:
            raise FormatError(f"line {line}: expected an OBJ statement of points and faces (v, f), got {_shown(text)}")
        if words[-1] == b"\\":
            raise FormatError(f"line {line}: expected a statement on one line, got one that is continued")
        if words[0] == b"v":
            self._keep_points(line, _point(line, words[1:], text))
            return
        corners = [self._index(line, word, text) for word in words[1:]]
        if words[0] == b"f":
            if len(corners) != 4:
                raise FormatError(f"line {line}: expected a face of 4 corners, got {len(corners)}: {_shown(text)}")
            self._keep_faces(line, np.array([corners], np.int64))
        else:
            self._keep_segments(line, corners)

    def _index(self, line: int, word: bytes, text: bytes) -> int:
        try:
            index = int(word.split(b"/", 1)[0])
        except ValueError:
            raise FormatError(f"line {line}: expected the number of a point, got {_shown(text)}") from None
        absolute = index - 1 if index > 0 else self.point_count + index
        if index == 0 or not 0 <= absolute < self.point_count:
            raise FormatError(
                f"line {line}: expected the number of one of the {number(self.point_count)} points so far, got {index}"
            )
        return absolute

    def _keep_points(self, line: int, values: NDArray[np.float64]) -> None:
        if self._points and self._points[-1].shape[1] != values.shape[1]:
            raise FormatError(
                f"line {line}: expected points of {self._points[-1].shape[1]} values like those before, "
                f"got {values.shape[1]}"
            )
        self._points.append(values)
        self.point_count += len(values)
        self.source.check_vertices(self.point_count, f"{number(self.point_count)} points or more")

    def _keep_faces(self, line: int, corners: NDArray[np.int64]) -> None:
        self._face_starts.append((self.face_count, line))
        self._faces.append(corners)
        self.face_count += len(corners)
        if self.face_count > self.source.max_vertices:  # a grid has no more quads than points
            raise TooLargeError(f"expected at most {number(self.source.max_vertices)} faces, got more")

    def _keep_segments(self, line: int, corners: list[int]) -> None:
        self.segments += pairwise(corners)
        self.segment_lines += [line] * (len(corners) - 1)
        if len(self.segments) > self.source.max_vertices:
            raise TooLargeError(f"expected at most {number(self.source.max_vertices)} segments, got more")

    def points(self) -> NDArray[np.float64]:
        if not self._points:
            raise FormatError("expected points (v x y z), got none")
        return np.concatenate(self._points)

    def faces(self) -> NDArray[np.int64]:
        return np.concatenate(self._faces)

    def face_line(self, face: int) -> int:
        """Give the number of the line that holds a face."""
        first, line = self._face_starts[bisect_right(self._face_starts, face, key=lambda start: start[0]) - 1]
        return line + face - first


def _table(
    run: list[bytes], keyword: bytes, width: int, convert: Callable[[list[bytes]], NDArray[Any]]
) -> NDArray[Any] | None:
    """Convert lines of `keyword` and exactly `width` numbers; None when any line is of another form."""
    words = b" ".join(run).split()
    if len(words) != len(run) * (width + 1) or any(word != keyword for word in words[:: width + 1]):
        return None  # with a line too long and one too short, a number stands where the keyword should
    del words[:: width + 1]
    try:
        return convert(words).reshape(-1, width)
    except (ValueError, OverflowError):
        return None


def _floats(words: list[bytes]) -> NDArray[np.float64]:
    return np.fromiter(map(float, words), np.float64, len(words))


def _integers(words: list[bytes]) -> NDArray[np.int64]:
    return np.fromiter(map(int, words), np.int64, len(words))


def _point(line: int, words: list[bytes], text: bytes) -> NDArray[np.float64]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) == 4 and values[3] == 1.0:  # the weight of a rational curve, without effect on a point
        values.pop()
    if len(values) not in (3, 6):
        raise FormatError(f"line {line}: expected a point of 3 numbers (or 6, with attributes), got {_shown(text)}")
    return np.array([values])


def _shown(text: bytes) -> str:
    return repr(text[:60].decode("ascii", "backslashreplace").strip())


def write(surface: Surface, file: BinaryIO) -> None:
    """Write points and quads, or segments of a curve; every number reads back as it was.

    Closed axes are joined by faces. Three attributes follow x, y and z as readers of vertex colours expect; OBJ has no
    place for any other number of them.
    """
    values = columns(surface)
    if len(values) not in (3, 6):
        raise FormatError(f"expected x, y, z and none or 3 attributes for OBJ, got {len(values) - 3} attributes")
    _write_lines(file, "v", values)
    curve = 1 in surface.shape
    connections = edges(surface) if curve else quads(surface)
    for start in range(0, len(connections), _ROWS):
        block = connections[start : start + _ROWS] + 1
        _write_lines(file, "l" if curve else "f", list(block.T))


def _write_lines(file: BinaryIO, keyword: str, values: list[NDArray[Any]]) -> None:
    """Write a line for each index of the arrays `values`, all of one length."""
    template = " ".join([keyword, *(_spell(column.dtype) for column in values)]) + "\n"
    for start in range(0, len(values[0]), _ROWS):
        block = [column[start : start + _ROWS].tolist() for column in values]
        flat: list[float] = [0] * (len(block) * len(block[0]))
        for index, column in enumerate(block):
            flat[index :: len(block)] = column
        file.write((template * len(block[0]) % tuple(flat)).encode("ascii"))


def _spell(dtype: np.dtype[Any]) -> str:
    """Choose the shortest of the usual spellings that reads back as the same number."""
    if dtype.kind in "iu":
        return "%d"
    return "%.9g" if dtype.itemsize == 4 else "%r"
