"""The whole decoder: takes layers or segments, gives the picture of every state and the grid of every level."""

from __future__ import annotations

from collections.abc import Iterable

from tests.stranger.coder import MARGIN, Grid, clamp
from tests.stranger.container import Container, Header, Segment
from tests.stranger.picture import Levels, Points, exact, known_part, rounded, undo_level, units_of, value


class Decoder:
    """Decodes segments in any order that the page allows, and remembers what was known after every layer."""

    def __init__(self, header: Header) -> None:
        self.header = header
        self.levels = Levels(header)
        self.units = units_of(header, self.levels)
        self.known = [self._remaining()]  # passes that remain of every unit, after 0, 1, 2, ... layers

    def _remaining(self) -> list[int]:
        return [unit.remaining for unit in self.units]

    def take(self, segments: Iterable[Segment]) -> None:
        """Decodes the segments of one layer, or of one level."""
        for segment in segments:
            self.units[segment.unit].decode(segment.top, segment.passes, segment.data, 28 - self.header.fraction)
        self.known.append(self._remaining())

    def whole(self, channel: int, level: int, remaining: list[int], complete: bool) -> int:
        """The finest level up to which all coefficients of a channel are known."""
        unknown = level + 1
        for number in range(channel, len(self.units), self.header.channels):
            unit = self.units[number]
            is_known = (
                remaining[number] == 0
                or self.header.empty[channel] >> unit.level & 1
                or (complete and remaining[number] < 0)
            )
            if unit.level and not is_known:
                unknown = min(unknown, unit.level)
        return unknown - 1

    def _coordinates(self, channel: int, level: int, remaining: list[int], complete: bool) -> list[float]:
        rows, columns = self.levels.shape[level]
        scale = 2**self.header.fraction
        limit = 2 ** (27 - self.header.fraction)
        whole = self.whole(channel, level, remaining, complete)
        grid: Grid = [[0] * columns for _ in range(rows)]
        for number in range(channel, len(self.units), self.header.channels):
            unit = self.units[number]
            if unit.level > level or remaining[number] < 0:
                continue
            factor = scale if unit.level > whole else 1
            for band in unit.bands:
                for r in range(band.rows):
                    for c in range(band.columns):
                        magnitude = band.magnitude[r + MARGIN][c + MARGIN]
                        shown = known_part(magnitude, band.born[r][c], remaining[number])
                        place = band.sign[r + MARGIN][c + MARGIN] * shown * factor
                        grid[band.place[0] + r][band.place[1] + c] = place
        for step in range(1, level + 1):
            if step == whole + 1:
                for row in range(self.levels.shape[step - 1][0]):
                    for column in range(self.levels.shape[step - 1][1]):
                        grid[row][column] = clamp(grid[row][column], -limit, limit) * scale
            undo_level(grid, self.levels, step, self.levels.predictors[channel])
        over = scale if whole < level else 1
        return [number / over for row in grid for number in row]

    def picture(self, layers: int | None = None, level: int | None = None) -> Points:
        """The picture after so many layers (or calls of `take`), or the grid of a coarser level."""
        layers = len(self.known) - 1 if layers is None else layers
        level = self.levels.last if level is None else level
        complete = layers == self.header.layers
        channels = []
        for channel, lattice in enumerate(self.header.lattices):
            coordinates = self._coordinates(channel, level, self.known[layers], complete)
            channels.append([value(lattice, q) for q in coordinates])
        numbers = [number for point in zip(*channels, strict=True) for number in point]
        shape = self.levels.shape[level] if self.header.flat else (*self.levels.shape[level], self.header.channels)
        return rounded(numbers, self.header.type).reshape(shape)


def decode(container: Container) -> Decoder:
    """Decodes all layers of a container, or of the beginning of one."""
    decoder = Decoder(container.header)
    for layer in container.layers:
        decoder.take(layer.segments)
    return decoder


def surface(container: Container, decoder: Decoder) -> Points:
    """The surface itself: the last picture, with exactness where the container has it."""
    points = decoder.picture()
    return points if container.exactness is None else exact(container.exactness, points)
