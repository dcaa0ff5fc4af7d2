"""Sections 3.1, 4 and 5 of the page: grids and their levels, the ends that they have in common, tiles and units."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tests.stranger.coder import Band, Unit
from tests.stranger.header import Header, Side

GROUP_POINTS = 2**16
FITTED = 24

Predictor = tuple[int, int]


@dataclass(frozen=True)
class Step:
    """The step of one axis from a level to the next coarser one; `clamped` are the two ends of the axis."""

    samples: int
    closed: bool
    clamped: tuple[bool, bool]

    @property
    def periodic(self) -> bool:
        """Whether the run goes round without a gap."""
        return self.closed and self.samples % 2 == 0

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

    @property
    def clamped_run(self) -> tuple[bool, bool]:
        """Which ends of the run are clamped."""
        return self.clamped[0], self.clamped[1] and self.samples % 2 == 1


@dataclass(frozen=True)
class Axis:
    """One axis of a grid at the level of the surface."""

    samples: int
    closed: bool
    stops: bool
    clamped: tuple[bool, bool]

    def steps(self) -> list[Step]:
        """The steps of the axis, the finest first."""
        steps = []
        samples = self.samples
        while samples >= (5 if self.closed else 3) and not (self.stops and samples % 2 == 0):
            steps.append(Step(samples, self.closed, self.clamped))
            samples = steps[-1].nodes
        return steps


@dataclass
class Grid:
    """A curve (`part` is -1) or a part, at all levels."""

    part: int
    axes: tuple[Axis, Axis]
    sides: tuple[Side | None, ...] = (None,) * 4
    lacks: tuple[bool, ...] = (False,) * 4  # at level 0 only, of a curve; at all levels, of a part
    shape: list[tuple[int, int]] = field(default_factory=list)
    steps: list[list[Step | None]] = field(default_factory=list)  # from this level down
    places: list[list[list[int]]] = field(default_factory=list)  # level, axis: the samples where the nodes stand

    def lay_out(self, last: int) -> None:
        """Makes the levels, of which there are so many."""
        steps = [axis.steps() for axis in self.axes]
        for level in range(last, -1, -1):
            if level == last:
                self.places = [[list(range(axis.samples)) for axis in self.axes]]
            self.shape.insert(0, (len(self.places[0][0]), len(self.places[0][1])))
            done = last - level
            self.steps.insert(0, [steps[axis][done] if done < len(steps[axis]) else None for axis in (0, 1)])
            if level:
                coarser = [_nodes(self.places[0][axis], self.steps[0][axis]) for axis in (0, 1)]
                self.places.insert(0, coarser)

    def lacking(self, level: int, channel_is_coordinate: bool) -> tuple[bool, ...]:
        """Which of the first and last nodes of the two axes the bands of a level lack."""
        if not channel_is_coordinate or (self.part < 0 and level):
            return (False,) * 4
        return self.lacks


def _nodes(places: list[int], step: Step | None) -> list[int]:
    if step is None:
        return places
    nodes = places[: 2 * step.run : 2]
    return [*nodes, places[-1]] if step.nodes > step.run else nodes


End = tuple[int, int]  # of a curve: its number, and 0 for its first point, 1 for its last


def common_ends(header: Header) -> dict[End, End]:
    """For each end of a curve that another end holds, that end."""
    holder: dict[End, End] = {(curve, end): (curve, end) for curve in range(len(header.curves)) for end in (0, 1)}

    def join(one: End, other: End) -> None:
        first, second = holder[one], holder[other]
        for end in holder:
            if holder[end] in (first, second):
                holder[end] = min(first, second)

    for number, curve in enumerate(header.curves):
        if curve.length == 1:
            join((number, 0), (number, 1))
    for part in header.parts:
        if any(part.closed):
            continue
        for row in (0, 1):
            for column in (0, 1):
                across, down = part.sides[row], part.sides[2 + column]
                if across is not None and down is not None:
                    join((across.curve, column ^ across.reversed), (down.curve, row ^ down.reversed))
    one_point = [curve.length == 1 for curve in header.curves]
    return {end: held for end, held in holder.items() if end != held and not (one_point[end[0]] and end[0] == held[0])}


class Levels:
    """Section 4: all grids, curves first, and what the steps of each level are."""

    def __init__(self, header: Header) -> None:
        self.held = common_ends(header)
        self.grids = []
        for number, curve in enumerate(header.curves):
            ends = (not curve.closed, not curve.closed)
            axes = (Axis(curve.length, curve.closed, curve.stops, ends), Axis(1, False, False, (False, False)))
            lacks = ((number, 0) in self.held, (number, 1) in self.held, False, False)
            self.grids.append(Grid(-1, axes, lacks=lacks))
        for number, part in enumerate(header.parts):
            first_row, last_row, first_column, last_column = part.clamped
            rows = Axis(part.shape[0], part.closed[0], part.stops[0], (first_row, last_row))
            columns = Axis(part.shape[1], part.closed[1], part.stops[1], (first_column, last_column))
            self.grids.append(Grid(number, (rows, columns), part.sides, tuple(side is not None for side in part.sides)))
        self.last = max(len(axis.steps()) for grid in self.grids for axis in grid.axes)
        for grid in self.grids:
            grid.lay_out(self.last)
        self._fitted = self._predictors(header)

    def _predictors(self, header: Header) -> list[dict[tuple[int, int, bool], Predictor]]:
        given = iter(header.predictors)
        channels = []
        for channel in range(header.channels):
            fitted = {}
            for level in range(1, self.last + 1):
                for axis, of_curves in ((0, False), (1, False), (0, True)):
                    steps = [grid.steps[level][axis] for grid in self.grids if (grid.part < 0) == of_curves]
                    if of_curves and channel >= header.coordinates:
                        continue
                    if any(step is not None and step.run >= FITTED for step in steps):
                        fitted[level, axis, of_curves] = next(given)
            channels.append(fitted)
        if next(given, None) is not None:
            raise ValueError("more predictors than fitted steps")
        return channels

    def predictor(self, channel: int, grid: Grid, level: int, axis: int) -> Predictor:
        """The (a, b) of a grid's step from a level down."""
        step = grid.steps[level][axis]
        if step is None or step.run < FITTED:
            return 16, 0
        return self._fitted[channel][level, axis, grid.part < 0]

    def groups(self, level: int) -> list[list[int]]:
        """Section 5: the grids that have tiles in common at a level."""
        if level > self.last:
            return [[number] for number in range(len(self.grids))]
        groups: list[list[int]] = []
        for group in self.groups(level + 1):
            if groups and self._belong_together(groups[-1], group, level):
                groups[-1] += group
            else:
                groups.append(list(group))
        return groups

    def _belong_together(self, before: list[int], group: list[int], level: int) -> bool:
        kinds = {self.grids[number].part < 0 for number in (*before, *group)}
        points = sum(math.prod(self.grids[number].shape[level]) for number in (*before, *group))
        return kinds == {True} or (kinds == {False} and points <= GROUP_POINTS)


def cut(nodes: int, details: int, size: int) -> list[tuple[range, range]]:
    """The pieces of an axis of a level: their nodes and their details."""
    count = max(1, (nodes + size // 2 - 1) // size)
    edges = [size * piece for piece in range(count)]
    node_edges, detail_edges = [*edges, nodes], [*(min(edge, details) for edge in edges), details]
    return [
        (range(node_edges[k], node_edges[k + 1]), range(detail_edges[k], detail_edges[k + 1])) for k in range(count)
    ]


def _without(span: range, nodes: int, first: bool, last: bool) -> range:
    """A piece of the nodes of an axis without its first or last node."""
    return range(max(span.start, int(first)), min(span.stop, nodes - int(last)))


Tiles = list[list[list[Unit]]]  # by row and column of tiles, then channel


def units_of(header: Header, levels: Levels) -> list[Unit]:
    """Section 5: all units, in the order of their numbers."""
    units = []
    coarser: dict[int, Tiles] = {}
    for level in range(levels.last + 1):
        finer: dict[int, Tiles] = {}
        for group in levels.groups(level) if level else [list(range(len(levels.grids)))]:
            tiles = _tiles(header, levels, level, group, coarser)
            finer.update(dict.fromkeys(group, tiles))
            units += [unit for row in tiles for tile in row for unit in tile]
        coarser = finer if level else {}  # no parents are in level 0
    return units


def _tiles(header: Header, levels: Levels, level: int, group: list[int], coarser: dict[int, Tiles]) -> Tiles:
    """The tiles of a group at a level; `coarser` has those of the level below, by the number of a grid."""
    is_cut = level > 0 and len(group) == 1 and levels.grids[group[0]].part >= 0
    pieces = [1, 1]
    shift = [0, 0]
    if is_cut:
        grid = levels.grids[group[0]]
        pieces = [len(cut(grid.shape[level - 1][axis], 0, 2 ** header.tile[axis])) for axis in (0, 1)]
        shift = [int(grid.steps[level - 1][axis] is not None) for axis in (0, 1)]
    below = coarser.get(group[0], [])
    tiles: Tiles = []
    for i in range(pieces[0]):
        tiles.append([])
        for j in range(pieces[1]):
            parents: list[Unit] = []
            if below:
                parents = below[min(i >> shift[0], len(below) - 1)][min(j >> shift[1], len(below[0]) - 1)]
            tiles[-1].append([])
            for channel in range(header.channels):
                inherited = parents[channel].bands if parents else []
                unit = Unit(level, [], header.base > 0 and channel < header.coordinates)
                for number in group:
                    unit.bands += _bands(header, levels, level, number, channel, (i, j) if is_cut else None, inherited)
                tiles[-1][-1].append(unit)
    return tiles


def _bands(
    header: Header,
    levels: Levels,
    level: int,
    number: int,
    channel: int,
    tile: tuple[int, int] | None,
    inherited: list[Band],
) -> list[Band]:
    grid = levels.grids[number]
    if grid.part < 0 and channel >= header.coordinates:
        return []
    lacks = grid.lacking(level, channel < header.coordinates)
    coarser = grid.shape[max(level - 1, 0)]
    spans = []
    for axis in (0, 1):
        nodes = coarser[axis]
        details = grid.shape[level][axis] - nodes
        piece = (range(nodes), range(details))
        if tile is not None:
            piece = cut(nodes, details, 2 ** header.tile[axis])[tile[axis]]
        spans.append((_without(piece[0], nodes, *lacks[2 * axis : 2 * axis + 2]), piece[1]))
    down, along = (int(step is not None) for step in grid.steps[max(level - 1, 0)])
    bands = []
    for axis0, axis1 in ((0, 1), (1, 0), (1, 1)) if level else ((0, 0),):
        r, c = spans[0][axis0], spans[1][axis1]
        if not len(r) or not len(c):
            continue
        kind = axis1 + 2 * axis0
        place = (r.start + axis0 * coarser[0], c.start + axis1 * coarser[1])
        parent = next((band for band in inherited if (band.grid, band.kind) == (number, kind)), None)
        bands.append(Band(kind, number, (r.start, c.start), len(r), len(c), place, parent, (down, along)))
    return bands
