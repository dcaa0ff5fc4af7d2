"""Sections 4, 5, 8 and 9 of the page: levels, tiles, and the way from coefficients to points."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.stranger.coder import Band, Grid, Unit, clamp
from tests.stranger.container import Header, Lattice
from tests.stranger.tables import TAPS

Points = NDArray[Any]


@dataclass(frozen=True)
class Step:
    """The step of one axis from a level to the next coarser one."""

    samples: int
    periodic: bool  # a closed axis of an even number of samples

    @property
    def midpoints(self) -> int:
        """M of the page."""
        return self.samples // 2 if self.periodic else (self.samples - 1) // 2

    @property
    def run(self) -> int:
        """R of the page."""
        return (self.samples + 1) // 2

    @property
    def nodes(self) -> int:
        """Samples of the coarser level."""
        return self.samples - self.midpoints


def steps_of(samples: int, closed: bool) -> list[Step]:
    """The steps of an axis, the finest first."""
    steps = []
    while samples >= (5 if closed else 3):
        steps.append(Step(samples, closed and samples % 2 == 0))
        samples = steps[-1].nodes
    return steps


class Levels:
    """Section 4: the grid of every level, and the steps between them."""

    def __init__(self, header: Header) -> None:
        steps = [steps_of(header.height, header.closed[0]), steps_of(header.width, header.closed[1])]
        self.last = max(len(steps[0]), len(steps[1]))
        size = [header.height, header.width]
        self.shape = [(0, 0)] * (self.last + 1)
        self.shape[self.last] = (size[0], size[1])
        self.steps: list[list[Step | None]] = [[None, None] for _ in range(self.last + 1)]  # from this level down
        for level in range(self.last, 0, -1):
            for axis in (0, 1):
                done = self.last - level
                if done < len(steps[axis]):
                    self.steps[level][axis] = steps[axis][done]
                    size[axis] = steps[axis][done].nodes
            self.shape[level - 1] = (size[0], size[1])
        self.predictors = self._predictors(header)

    def _predictors(self, header: Header) -> list[dict[tuple[int, int], tuple[int, int]]]:
        given = iter(header.predictors)
        channels = []
        for _ in range(header.channels):
            fitted = {}
            for level in range(self.last):
                for axis in (0, 1):
                    step = self.steps[level + 1][axis]
                    if step is not None and step.midpoints and step.run >= 24:
                        fitted[level + 1, axis] = next(given)
            channels.append(fitted)
        if next(given, None) is not None:
            raise ValueError("more predictors than fitted steps")
        return channels


def cut(nodes: int, details: int, size: int) -> list[tuple[range, range]]:
    """The pieces of an axis of a level: their nodes and their details."""
    count = max(1, (nodes + size // 2 - 1) // size)
    edges = [size * piece for piece in range(count)]
    node_edges, detail_edges = [*edges, nodes], [*(min(edge, details) for edge in edges), details]
    return [
        (range(node_edges[k], node_edges[k + 1]), range(detail_edges[k], detail_edges[k + 1])) for k in range(count)
    ]


def units_of(header: Header, levels: Levels) -> list[Unit]:
    """Section 5: all units, in the order of their numbers."""
    channels = range(header.channels)
    height, width = levels.shape[0]
    units = [Unit(0, [Band(0, (0, 0), height, width, (0, 0))]) for _ in channels]
    coarser: list[list[list[Unit]]] = []  # the units of level - 1, by row and column of tiles
    for level in range(1, levels.last + 1):
        (h, w), (nodes0, nodes1) = levels.shape[level], levels.shape[level - 1]
        down = cut(nodes0, h - nodes0, 2 ** header.tile[0])
        along = cut(nodes1, w - nodes1, 2 ** header.tile[1])
        shift = (int(levels.steps[level - 1][0] is not None), int(levels.steps[level - 1][1] is not None))
        grid: list[list[list[Unit]]] = []
        for i, rows in enumerate(down):
            grid.append([])
            for j, columns in enumerate(along):
                parents: list[Unit] = []
                if coarser:
                    parents = coarser[min(i >> shift[0], len(coarser) - 1)][min(j >> shift[1], len(coarser[0]) - 1)]
                grid[-1].append([])
                for channel in channels:
                    bands = []
                    for axis0, axis1 in ((0, 1), (1, 0), (1, 1)):
                        r, c = rows[axis0], columns[axis1]
                        if not len(r) or not len(c):
                            continue
                        kind = axis1 + 2 * axis0
                        place = (r.start + axis0 * nodes0, c.start + axis1 * nodes1)
                        inherited = parents[channel].bands if parents else []
                        parent = next((band for band in inherited if band.kind == kind), None)
                        bands.append(Band(kind, (r.start, c.start), len(r), len(c), place, parent, shift))
                    grid[-1][-1].append(Unit(level, bands))
                units += grid[-1][-1]
        coarser = grid
    return units


def known_part(magnitude: int, born: int, remaining: int) -> int:
    """Section 8: the magnitude that is shown when so many passes of the unit remain."""
    p = (remaining + 1) >> 1
    if magnitude >> p:
        return ((magnitude >> p) << p) + ((7 << p) >> 4)
    if remaining & 1 and born == remaining:
        return (1 << (p - 1)) + ((7 << (p - 1)) >> 4)
    return 0


def _details(line: list[int], step: Step, a: int, b: int) -> list[int]:
    run, count = step.run, step.midpoints
    e = line[step.nodes :]
    if run < 3 or (a, b) == (0, 0):
        return [clamp(number, -(2**28), 2**28) for number in e]
    c = {k: line[k] for k in range(run)}
    if step.periodic:
        for k in (-2, -1, run, run + 1, run + 2):
            c[k] = line[k % run]
    else:
        for k in (-1, -2):
            c[k] = 3 * c[k + 1] - 3 * c[k + 2] + c[k + 3]
        for k in (run, run + 1):
            c[k] = 3 * c[k - 1] - 3 * c[k - 2] + c[k - 3]
    d = []
    for k in range(count):
        v = a * (-c[k + 2] + c[k + 1] + c[k] - c[k - 1]) + b * (-c[k + 3] + c[k + 1] + c[k] - c[k - 2])
        d.append(clamp(e[k] + (v + 128) // 256, -(2**28), 2**28))
    return d


def _beyond(d: list[int], step: Step, index: int) -> int:
    if step.periodic:
        return d[index % len(d)]
    index = (index + 1) % (2 * len(d) + 2)  # the midpoint -1, which is 0, counted as 0; the other one as len(d) + 1
    if index in (0, len(d) + 1):
        return 0
    return d[index - 1] if index <= len(d) else -d[2 * len(d) + 1 - index]


def undo(line: list[int], step: Step, a: int, b: int) -> list[int]:
    """Undoes a step on one line of nodes and then details."""
    d = _details(line, step, a, b)
    wide = [_beyond(d, step, index) for index in range(-10, step.run + 9)]  # wide[10 + k] is d_k
    nodes = []
    for k in range(step.run):
        s = sum(tap * (wide[10 + k + j] + wide[9 + k - j]) for j, tap in enumerate(TAPS))
        nodes.append(line[k] - ((s + 3 * 2**21) >> 24))
    samples = [0] * step.samples
    samples[0 : 2 * step.run : 2] = nodes
    for k in range(step.midpoints):
        samples[2 * k + 1] = d[k] + ((nodes[k] + nodes[(k + 1) % step.run]) >> 1)
    if step.nodes > step.run:
        samples[-1] = line[step.run]
    return [clamp(number, -(2**27), 2**27) for number in samples]


def undo_level(grid: Grid, levels: Levels, level: int, fitted: dict[tuple[int, int], tuple[int, int]]) -> None:
    """Undoes the step from a level to the next coarser one: axis 1 on all rows, then axis 0 on all columns."""
    rows, columns = levels.shape[level]
    step = levels.steps[level][1]
    if step is not None:
        for row in range(rows):
            grid[row][:columns] = undo(grid[row][:columns], step, *fitted.get((level, 1), (16, 0)))
    step = levels.steps[level][0]
    if step is not None:
        for column in range(columns):
            line = [grid[row][column] for row in range(rows)]
            for row, number in enumerate(undo(line, step, *fitted.get((level, 0), (16, 0)))):
                grid[row][column] = number


def value(lattice: Lattice, q: float) -> float:
    """Section 3: the float64 value of a lattice coordinate, before it is rounded to the type."""
    return (lattice.origin + q) / lattice.step if lattice.decimal else lattice.origin + lattice.step * q


def rounded(numbers: list[float], kind: str) -> Points:
    """Values of the type."""
    dtype = np.dtype(kind).newbyteorder("<")
    if dtype.kind == "f":
        greatest = float(np.finfo(dtype).max)
        return np.array([min(max(number, -greatest), greatest) for number in numbers], dtype)
    least, most = int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    return np.array([clamp(round(number), least, most) for number in numbers], dtype)


def exact(payload: bytes, points: Points) -> Points:
    """Section 9: the values themselves, from the picture with all layers known and the exactness section."""
    size = points.dtype.itemsize
    bits, count = 8 * size, points.size
    planes = zlib.decompress(payload)
    if len(planes) != count * size:
        raise ValueError("the exactness section is too short or too long")
    whole, sign = 2**bits - 1, 2 ** (bits - 1)
    patterns = [int(number) for number in points.reshape(-1).view(f"<u{size}")]
    is_float = points.dtype.kind == "f"
    found = []
    for place, pattern in enumerate(patterns):
        z = sum(planes[plane * count + place] << 8 * plane for plane in range(size))
        t = (z >> 1) ^ -(z & 1)
        if not is_float:
            found.append((pattern + t) & whole)
            continue
        order = (pattern ^ whole if pattern & sign else pattern | sign) + t & whole
        found.append(order ^ sign if order & sign else order ^ whole)
    return np.array(found, f"<u{size}").view(points.dtype).reshape(points.shape)
