"""Content of an OBJ file: points, attributes of corners, faces and lines.

The reader is our own because the usual libraries cut quads into triangles or end the process on a bad file. References
to other files (``mtllib``) are skipped.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Callable, Iterator
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError, TooLargeError
from ...mesh import CornerAttribute, Mesh
from ...mesh.ears import cut_faces
from ..attributes import COLOR, NORMAL, TEXTURE
from ..meshes import check_corners, check_faces, polygons_allowed
from ..notes import keep_words
from ..source import Source, number

__all__ = ["GEOMETRY", "IGNORED", "READ", "ObjFile"]

#: Statements that say nothing about which points there are and how they are joined.
IGNORED = frozenset(b"g o s mg usemtl mtllib usemap maplib shadow_obj trace_obj bevel c_interp d_interp lod".split())
READ = frozenset((b"v", b"vt", b"vn", b"f", b"l"))

#: Statements of points, curves and surfaces that are not read: without them it would be another surface.
GEOMETRY = frozenset(
    b"vp p curv curv2 surf fo cstype deg bmat step parm trim hole scrv sp con end bzp bsp cdc cdp res call csh".split()
)

#: What a statement of another program may be called, such as the ``t crease`` of subdivision surfaces.
_KEYWORD = re.compile(rb"[A-Za-z][A-Za-z0-9_.:-]{0,39}")

#: How many kinds of such statements are counted and named.
_MOST_KINDS = 16

#: Of these, what a user would miss, in words, and from how many different ones on: a single name parts nothing.
_LEFT_OUT = (
    ((b"g", b"o"), "groups and objects", 2),
    ((b"s",), "smoothing groups", 2),
    ((b"usemtl", b"usemap"), "materials", 1),
    ((b"mg", b"shadow_obj", b"trace_obj", b"bevel", b"c_interp", b"d_interp", b"lod"), "rendering attributes", 1),
)
_NOTHING = frozenset((b"", b"off", b"none", b"0", b"default"))

#: How many names of a kind are kept to be counted.
_ENOUGH = 4

_BLOCK = 1 << 20

#: Numbers of a point: a weight of 1 is dropped, three or four more are a colour.
_POINT_WIDTHS = (3, 4, 6, 7)

#: Which of point, texture and normal a corner of a face names, by its slashes and how many of them are double.
_FORMS = {(0, 0): (0,), (1, 0): (0, 1), (2, 1): (0, 2), (2, 0): (0, 1, 2)}
_KINDS = (b"v", b"vt", b"vn")
_WORDS = {b"v": "a point of 3 numbers (or 6, with a colour)", b"vt": "1 to 3 numbers", b"vn": "a normal of 3 numbers"}


class ObjFile:
    """The content read so far, in arrays, each of a run of lines.

    Raises
    ------
    FormatError
        When a line is no statement about points and faces, or names points that do not exist.
    TooLargeError
        When there are more points or faces than allowed.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.face_count = 0
        self.segments: list[tuple[int, int]] = []
        self.segment_lines: list[int] = []
        self._values: dict[bytes, list[NDArray[np.float64]]] = {kind: [] for kind in _KINDS}
        self._counts = dict.fromkeys(_KINDS, 0)
        self._corners: list[list[NDArray[np.int32] | None]] = [[], [], []]  # of points, textures, normals
        self._faces: list[int] = []  # faces of each run
        self._face_starts: list[tuple[int, int]] = []  # number of the first face of a run and of its line
        self._polygons = polygons_allowed(source.options)
        self._fans: list[tuple[int, int]] = []  # first triangle and corners of faces of more than four
        self._others: dict[bytes, set[bytes]] = {}  # what other statements say, a few of each kind
        self._foreign: dict[str, int] = {}  # statements of other programs, and how many of each
        self.words: dict[str, str] = {}  # what comments say, as the writer puts it
        for line, run in _runs(source.path):
            self._add(line, run)

    def _add(self, line: int, run: list[bytes]) -> None:
        """Add lines with the same keyword; a regular run is converted as a whole, any other line by line."""
        keyword = run[0][:2].strip()
        if keyword in _KINDS and self._add_values_at_once(line, keyword, run):
            return
        if run[0][:2] == b"f " and self._add_faces_at_once(line, run):
            return
        for offset, text in enumerate(run):
            self._add_line(line + offset, text)

    def _add_values_at_once(self, line: int, keyword: bytes, run: list[bytes]) -> bool:
        values = _table(run, keyword, len(run[0].split()) - 1, _floats)
        values = None if values is None else _fitting(keyword, values)
        if values is None:
            return False
        self._keep_values(line, keyword, values)
        return True

    def _add_faces_at_once(self, line: int, run: list[bytes]) -> bool:
        words = run[0].split()
        sides = len(words) - 1
        if sides not in (3, 4):
            return False
        slashes, doubles = words[1].count(b"/"), words[1].count(b"//")
        form = _FORMS.get((slashes, doubles))
        if form is None:
            return False
        if slashes:
            text = b"\n".join(run)
            corners = sides * len(run)
            if text.count(b"/") != slashes * corners or text.count(b"//") != doubles * corners:
                return False
            run = text.replace(b"//", b" ").replace(b"/", b" ").split(b"\n")
        table = _table(run, b"f", sides * len(form), _integers)
        if table is None or table.min(initial=1) < 1:
            return False
        table = table.reshape(len(run), sides, len(form)) - 1
        if table[..., 0].max() >= self._counts[b"v"] or table.max() >= 2**31 - 1:
            return False
        numbers: list[NDArray[np.int32] | None] = [None, None, None]
        for place, kind in enumerate(form):
            padded = np.full((len(run), 4), -1, np.int32)
            padded[:, :sides] = table[..., place]
            numbers[kind] = padded
        self._keep_faces(line, len(run), numbers)
        return True

    def _add_line(self, line: int, text: bytes) -> None:
        words = text.split(b"#", 1)[0].split()
        if not words:
            self._keep_comment(text)
            return
        if words[0] in IGNORED:
            arguments = self._others.setdefault(words[0], set())
            if len(arguments) < _ENOUGH:
                arguments.add(b" ".join(words[1:]).lower())
            return
        # Text that begins with something else is no OBJ, whatever it is called.
        foreign = words[0] not in READ and self._counts[b"v"] > 0 and bool(_KEYWORD.fullmatch(words[0]))
        if words[0] in GEOMETRY or not (foreign or words[0] in READ):
            raise FormatError(f"line {line}: expected an OBJ statement of points and faces (v, f), got {_shown(text)}")
        if words[-1] == b"\\":
            raise FormatError(f"line {line}: expected a statement on one line, got one that is continued")
        if foreign:
            self._pass_over(words)
            return
        if words[0] in _KINDS:
            self._keep_values(line, words[0], _numbers(line, words, text))
            return
        corners = [self._corner(line, word, text) for word in words[1:]]
        if words[0] == b"l":
            self._keep_segments(line, [corner[0] for corner in corners])
            return
        try:
            check_corners(len(corners), f"in {_shown(text)}", self._polygons)
        except FormatError as error:
            raise FormatError(f"line {line}: {error}") from None
        faces = [corners]
        if len(corners) > 4:
            self._fans.append((self.face_count, len(corners)))
            faces = [[corners[0], *pair] for pair in pairwise(corners[1:])]
        for face in faces:
            rows = np.full((3, 1, 4), -1, np.int32)
            rows[:, 0, : len(face)] = np.array(face, np.int32).T
            self._keep_faces(line, 1, [row if row.max() >= 0 else None for row in rows])

    def _pass_over(self, words: list[bytes]) -> None:
        """Count a statement of another program, which has no points and faces."""
        second = words[1] if len(words) > 1 and words[0] == b"t" and _KEYWORD.fullmatch(words[1]) else b""
        kind = b" ".join(filter(None, (words[0], second))).decode("ascii")
        if kind not in self._foreign and len(self._foreign) >= _MOST_KINDS:
            kind = "others"
        self._foreign[kind] = self._foreign.get(kind, 0) + 1

    def _corner(self, line: int, word: bytes, text: bytes) -> tuple[int, int, int]:
        """Return point, texture coordinates and normal of a corner; -1 for each that it does not have."""
        parts = word.split(b"/")
        result = [-1, -1, -1]
        for place, part in enumerate(parts[:3]):
            if not part and place:
                continue
            try:
                index = int(part)
            except ValueError:
                raise FormatError(f"line {line}: expected the number of a point, got {_shown(text)}") from None
            count = self._counts[_KINDS[place]]
            absolute = index - 1 if index > 0 else count + index
            if index == 0 or absolute < 0 or (place == 0 and absolute >= count) or absolute >= 2**31 - 1:
                raise FormatError(
                    f"line {line}: expected the number of one of the {number(count)} "
                    f"{('points', 'places in a texture', 'normals')[place]} so far, got {index}"
                )
            result[place] = absolute
        return result[0], result[1], result[2]

    def _keep_values(self, line: int, keyword: bytes, values: NDArray[np.float64]) -> None:
        before = self._values[keyword]
        if before and before[-1].shape[1] != values.shape[1]:
            what = {b"v": "points", b"vt": "places in a texture", b"vn": "normals"}[keyword]
            raise FormatError(
                f"line {line}: expected {what} of {before[-1].shape[1]} values like those before, got {values.shape[1]}"
            )
        before.append(values)
        count = self._counts[keyword] = self._counts[keyword] + len(values)
        if keyword == b"v":
            self.source.check_vertices(count, f"{number(count)} points or more")
        elif count > 8 * self.source.max_vertices:  # each corner of four faces round a vertex may have its own
            raise TooLargeError(f"expected at most eight values of {keyword.decode()} a vertex, got more")

    def _keep_faces(self, line: int, count: int, corners: list[NDArray[np.int32] | None]) -> None:
        self._face_starts.append((self.face_count, line))
        self._faces.append(count)
        for kept, added in zip(self._corners, corners, strict=True):
            kept.append(added)
        self.face_count += count
        check_faces(self.source, self.face_count)

    def _keep_segments(self, line: int, corners: list[int]) -> None:
        self.segments += pairwise(corners)
        self.segment_lines += [line] * (len(corners) - 1)
        if len(self.segments) > self.source.max_vertices:
            raise TooLargeError(f"expected at most {number(self.source.max_vertices)} segments, got more")

    def _keep_comment(self, text: bytes) -> None:
        key, _, rest = text.strip().removeprefix(b"# ").partition(b" ")
        if not self._counts[b"v"] and text.startswith(b"# "):
            keep_words(self.words, key.decode("utf-8", "replace"), rest.decode("utf-8", "replace"))

    def notes(self) -> tuple[str, ...]:
        """Return a list, in words, of content that a surface cannot hold."""
        lines = []
        for kinds, what, least in _LEFT_OUT:
            arguments = set().union(*(self._others.get(kind, set()) for kind in kinds))
            if len(arguments - _NOTHING) >= least:
                lines.append(f"{what} ({', '.join(kind.decode() for kind in kinds if kind in self._others)}) left out")
        if self._foreign:
            foreign = ", ".join(f"{kind} ({number(count)})" for kind, count in self._foreign.items())
            lines.append(f"statements that are no geometry left out: {foreign}")
        if self.face_count and self.segments:
            lines.append("lines (l) beside faces left out")
        for place, what in ((1, "places in a texture (vt)"), (2, "normals (vn)")):
            if self._counts[_KINDS[place]] and all(run is None for run in self._corners[place]):
                lines.append(f"{what} that no face names left out")
        return tuple(lines)

    def points(self) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
        """Return points, (V, 3), and their attributes.

        Raises
        ------
        FormatError
            If there is none.
        """
        if not self._values[b"v"]:
            raise FormatError("this OBJ has no points (v x y z)")
        points = np.concatenate(self._values[b"v"])
        if points.shape[1] == 3:
            return points, {}
        return np.ascontiguousarray(points[:, :3]), {COLOR: np.ascontiguousarray(points[:, 3:])}

    def mesh(self) -> Mesh:
        """Return the points and faces, with the attributes of corners.

        Raises
        ------
        FormatError
            If a corner of a face names a normal, or a place in a texture, that there is not.
        """
        points, attributes = self.points()
        corners = self._joined(0)
        cuts = self._cuts(points, corners)
        self._cut(corners, cuts)
        of_corners: dict[str, CornerAttribute] = {}
        for place, name in ((2, NORMAL), (1, TEXTURE)):
            values = self._values[_KINDS[place]]
            if not values or all(run is None for run in self._corners[place]):
                continue
            rows = self._joined(place)
            self._cut(rows, cuts)
            if rows.max() >= self._counts[_KINDS[place]]:
                face = int((rows >= self._counts[_KINDS[place]]).any(axis=1).argmax())
                raise FormatError(
                    f"line {self.face_line(face)}: expected {_KINDS[place].decode()} up to "
                    f"{number(self._counts[_KINDS[place]])}, got {number(int(rows[face].max()) + 1)}"
                )
            of_corners[name] = CornerAttribute(np.concatenate(values), rows)
        return Mesh(points, corners, attributes, of_corners, self.face_name, self.notes())

    def _cuts(self, points: NDArray[np.float64], corners: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """Return how each fan is to be cut, now that all points are known: (N - 2, 3) places among its N corners."""
        if not self._fans:
            return []
        counts = np.array([count for _, count in self._fans], np.int64)
        around = np.concatenate([_around(corners, first, count) for first, count in self._fans])
        places, fan = cut_faces(points, counts, around)
        starts = np.cumsum(counts) - counts
        return np.split(places[:, :3] - starts[fan][:, np.newaxis], np.cumsum(counts - 2)[:-1])

    def _cut(self, rows: NDArray[np.int32], cuts: list[NDArray[np.int64]]) -> None:
        for (first, count), cut in zip(self._fans, cuts, strict=True):
            rows[first : first + count - 2, :3] = _around(rows, first, count)[cut]

    def _joined(self, place: int) -> NDArray[np.int32]:
        runs = [
            np.full((count, 4), -1, np.int32) if run is None else run
            for count, run in zip(self._faces, self._corners[place], strict=True)
        ]
        return np.concatenate(runs)

    def face_line(self, face: int) -> int:
        """Return the number of the line of a face."""
        first, line = self._face_starts[bisect_right(self._face_starts, face, key=lambda start: start[0]) - 1]
        return line + face - first

    def face_name(self, face: int) -> str:
        """Return the name in messages of a face, from the number that it has once polygons are cut into triangles."""
        further = sum(min(face - first, count - 3) for first, count in self._fans if first < face)
        return f"face {face - further + 1} (line {self.face_line(face)})"


def _around(rows: NDArray[np.int32], first: int, count: int) -> NDArray[np.int32]:
    """Return what the corners of a fan name, in their order round the face."""
    return np.concatenate([rows[first, :2], rows[first : first + count - 2, 2]])


def _runs(path: Path) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the lines in runs that begin with the same two bytes, each with the number of its first line."""
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


def _table(
    run: list[bytes], keyword: bytes, width: int, convert: Callable[[list[bytes]], NDArray[Any]]
) -> NDArray[Any] | None:
    """Convert lines of `keyword` and exactly `width` numbers; None if any line has another form."""
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


def _fitting(keyword: bytes, values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return rows of numbers without a weight; None if there are too many or too few."""
    width = values.shape[1]
    if keyword != b"v":
        return values if (width == 3 if keyword == b"vn" else 1 <= width <= 3) else None
    if width == 4:  # the weight of a rational curve, without effect on a point when it is 1
        return np.ascontiguousarray(values[:, :3]) if (values[:, 3] == 1.0).all() else None
    return values if width in _POINT_WIDTHS else None


def _numbers(line: int, words: list[bytes], text: bytes) -> NDArray[np.float64]:
    try:
        values = _fitting(words[0], np.array([[float(word) for word in words[1:]]]))
    except ValueError:
        values = None
    if values is None:
        raise FormatError(f"line {line}: expected {_WORDS[words[0]]}, got {_shown(text)}")
    return values


def _shown(text: bytes) -> str:
    return repr(text[:60].decode("ascii", "backslashreplace").strip())
