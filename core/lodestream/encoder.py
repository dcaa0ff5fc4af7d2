"""A surface into a container."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import exactness
from .allocation import TileCurve, assign_layers
from .bitplanes import code_passes, new_model, pass_count, pass_gains
from .container.model import Header
from .container.sections import MOST_FRACTION, TILE_BITS
from .container.writer import CodedLayer, CodedSegment, write_container
from .errors import InputError
from .lattice import LATTICE_BITS, Lattice
from .layout import Layout
from .measure import extent_of
from .picture import coordinate_distances
from .predictors import COEFFICIENT_BITS
from .quantise import channel_of, choose_lattices
from .reconstruction import channel_picture, initial_state, to_points
from .surface import Surface
from .target import Tolerance
from .tiles import Tiles, TileTable, gather
from .transform import PADDING, allocate, forward, synthesis_norms

__all__ = ["encode"]

#: What the last pass of a tile is worth for each coefficient, besides its own bits, in squared lattice steps: a level
#: whose tiles are all known is inverted without errors of rounding.
_ROUNDING = 0.2

#: Bits of a channel's range that the lattice keeps where coding does not pay, in the order in which they are tried.
_COARSER = (8, 4, 0)

Figures = tuple[float, float]
State = NDArray[np.int8]


def encode(
    surface: Surface | ArrayLike,
    precision: float | str | Tolerance | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> bytes:
    """Encode a surface into a container.

    Parameters
    ----------
    surface : Surface or array
        An array is taken as ``Surface(array)``.
    precision : float, str, Tolerance or None
        Largest distance allowed between a point and what comes back, in the surface's unit or, as ``"1e-4d"``, times
        the range of the heights or the diagonal of the box. None: every value comes back bit for bit.
    progress : callable, optional
        Called now and then with the fraction done, 0 to 1.

    Returns
    -------
    bytes
        A container, see ``docs/format.md``.

    Raises
    ------
    InputError
        When the surface cannot be encoded, or not with this precision.
    """
    if not isinstance(surface, Surface):
        surface = Surface(surface)
    if len(surface.blocks) > 1 or surface.mask is not None or surface.attributes:
        raise InputError("expected one block without holes and attributes; others are not encoded yet")
    progress = progress or (lambda fraction: None)
    container = _Encoding(surface, precision, progress).run()
    for bits in _COARSER:
        if precision is not None or len(container) <= longest(surface.points.nbytes):
            break
        # What looks like noise is not worth coding: the lattice keeps the highest bits, exactness stores the rest.
        container = min(container, _Encoding(surface, precision, progress, bits).run(), key=len)
    return container


def longest(raw: int) -> int:
    """Most bytes that a container takes which restores so many bytes of values."""
    return raw + raw // 100 + 1024


@dataclass
class _Channel:
    """One channel on its way: coefficients with signs, flat, and what they weigh."""

    true: NDArray[np.int32]
    weights: NDArray[np.float64]  # a band
    top: NDArray[np.int8]  # a tile


class _Encoding:
    """One run of the encoder; the methods stand in the order in which they are called."""

    def __init__(
        self,
        surface: Surface,
        precision: float | str | Tolerance | None,
        progress: Callable[[float], None],
        bits: int | None = None,
    ) -> None:
        self.surface, self.points, self.progress = surface, surface.points, progress
        count = 1 if self.points.ndim == 2 else self.points.shape[2]
        self.geometric = min(count, 3)
        self.extent = extent_of(self.points, self.geometric)
        if isinstance(precision, str):
            precision = Tolerance.parse(precision)
        elif precision is not None and not isinstance(precision, Tolerance):
            precision = Tolerance(float(precision))
        if precision is not None and precision.relative and not self.extent:
            precision = None  # a fraction of nothing: one point, which a lattice holds exactly
        self.precision = None if precision is None else precision.absolute(self.extent)
        tile = tile_exponents(surface.shape)
        self.layout = Layout(surface.shape, surface.closed, tile)
        self.table = TileTable.of(self.layout)
        self.bits = 0
        self.lattices = choose_lattices(self.points, self.geometric, self.precision, bits)

    def run(self) -> bytes:
        predictors = np.zeros((len(self.lattices), self.layout.levels, 2, 2), np.int8)
        channels = []
        for number, lattice in enumerate(self.lattices):
            channel, predictors[number] = self._transform(number, lattice)
            channels.append(channel)
        self.channels = channels
        self.progress(0.1)
        states = assign_layers(self._curves(), self.layout, len(channels))
        self.progress(0.4)
        self.header = Header(
            dtype=self.points.dtype,
            shape=self.surface.shape,
            closed=self.surface.closed,
            flat=self.points.ndim == 2,
            lattices=tuple(self.lattices),
            predictors=predictors,
            extent=self.extent,
            empty=tuple(self._empty_levels(channel.top) for channel in channels),
            fraction=max(0, min(MOST_FRACTION, LATTICE_BITS - self.bits, COEFFICIENT_BITS - self._most_planes())),
            tile=self.layout.tile,
            exact=False,
            corrected=False,
            layer_count=0,
        )
        states, figures = self._measured(states)
        self.progress(0.7)
        correction, exact = self._correction()
        levels = self._level_figures((0.0, 0.0) if exact else figures[-1])
        self.progress(0.8)
        coded = self._coded(states, figures)
        container = write_container(
            self.header,
            coded,
            levels,
            correction,
            self.surface.metadata,
            exact=exact,
        )
        self.progress(1.0)
        return container

    def _transform(self, number: int, lattice: Lattice) -> tuple[_Channel, NDArray[np.int8]]:
        """Lattice coordinates of a channel, transformed and cut into tiles."""
        for fit in (True, False):
            values = allocate(self.surface.shape)
            lattice.coordinates(channel_of(self.points, number), out=values)
            self.bits = max(self.bits, max(int(values.max()), -int(values.min())).bit_length())
            predictors = forward(values, self.layout, fit)
            if max(int(values.max()), -int(values.min())) < 1 << COEFFICIENT_BITS:
                break
        true = gather(self.table, values)
        norms = synthesis_norms(self.layout, predictors)
        spacing = 1.0 / lattice.step if lattice.rule == "decimal" else lattice.step
        # Errors are weighed relative to the extent, so that their squares stay within float64 at any scale; an
        # attribute shares the stream in proportion to its own range.
        span = self.extent if number < self.geometric else extent_of(channel_of(self.points, number), 1)
        spacing = spacing / span if span else 0.0
        weights = np.array(
            [norms[tile.level, *map(int, band.kind)] * spacing**2 for tile in self.layout.tiles for band in tile.bands]
        )
        top = np.array([self._top(true, number) for number in range(len(self.layout.tiles))], np.int8)
        return _Channel(true, weights, top), predictors

    def _most_planes(self) -> int:
        """Bit-planes of the tile that has most; with the fraction they must fit a coefficient."""
        return max(int(channel.top.max()) for channel in self.channels)

    def _empty_levels(self, top: NDArray[np.int8]) -> int:
        """The levels without a coefficient other than 0, as bits."""
        levels = range(self.layout.levels + 1)
        return sum(1 << level for level in levels if not top[self.layout.tiles_of(level)].any())

    def _top(self, true: NDArray[np.int32], tile: int) -> int:
        """Bit-planes of a tile."""
        rows = self.table.of_tile(tile)
        largest = 0
        for place, stride, height, _ in rows[:, :4]:
            frame = true[place - stride - 1 : place + (height + 1) * stride - 1]
            largest = max(largest, int(frame.max()), -int(frame.min()))
        return largest.bit_length()

    def _curves(self) -> list[TileCurve]:
        """Cost and gain of every pass, by coding each tile once as a whole."""
        coder = self._whole = _TileCoder(self.table, self.channels)
        curves = []
        for tile in range(len(self.layout.tiles)):
            for number, channel in enumerate(self.channels):
                top = int(channel.top[tile])
                if top:
                    passes = pass_count(top)
                    costs = np.zeros(passes, np.float64)
                    coder.code(tile, number, passes, passes, costs)
                    bits = np.diff(costs[::-1], prepend=0.0)[::-1]
                    errors = np.zeros(passes + 1, np.float64)
                    first, last = self.table.first[tile], self.table.first[tile + 1]
                    early, weights = coder.tiles[number].early, channel.weights[first:last]
                    rows = self.table.of_tile(tile)
                    pass_gains(rows, weights, passes, channel.true, early, errors)
                    gains = np.diff(errors)
                    gains[0] += _ROUNDING * float((weights * rows[:, 2] * rows[:, 3]).sum())
                    curves.append(TileCurve(tile, number, bits, gains))
        return curves

    def _figures(self, state: State, canvases: NDArray[np.int32]) -> Figures:
        """RMS and maximum error of what a receiver shows in this state, see `reconstruction.Reconstruction`."""
        columns = self.surface.shape[1]
        pictures = [self._picture(number, state, canvas[:, :columns]) for number, canvas in enumerate(canvases)]
        fractions = [fraction for _, fraction in pictures]
        return coordinate_distances(self.points, self.lattices[: self.geometric], canvases, fractions)

    def _picture(
        self, number: int, state: State, canvas: NDArray[np.int32] | None = None
    ) -> tuple[NDArray[np.int32], int]:
        tiles = self._whole.tiles[number]
        return channel_picture(self.header, number, tiles, state[:, number], self.layout.levels, canvas)

    def _canvases(self) -> NDArray[np.int32]:
        """Room for a picture of each channel that is a coordinate."""
        rows, columns = self.surface.shape
        return np.empty((self.geometric, rows, columns + PADDING), np.int32)

    def _measured(self, states: list[State]) -> tuple[list[State], list[Figures]]:
        """Errors of every layer's picture; a layer that would raise the RMS is merged with the one before."""
        canvases = self._canvases()
        kept: list[State] = []
        figures: list[Figures] = []
        for state in states:
            announced = state < self._all_passes()
            shown = state if state is states[-1] else np.where(announced, state, initial_state(self.header))
            measured = self._figures(shown.astype(np.int8), canvases)
            while figures and measured[0] > figures[-1][0]:
                kept.pop()
                figures.pop()
            kept.append(state)
            figures.append(measured)
        del canvases
        pictures = [self._picture(number, states[-1]) for number in range(len(self.channels))]
        self._last = to_points(self.header, pictures)
        return kept, figures

    def _level_figures(self, last: Figures) -> list[Figures]:
        """Errors of the states that hold all levels up to one; the last of them is the lattice itself."""
        passes = self._all_passes()
        canvases, start = self._canvases(), initial_state(self.header)
        announced = np.where(passes > 0, 0, start).astype(np.int8)
        figures = []
        for level in range(self.layout.levels):
            state = start.copy()
            known = slice(0, self.layout.tiles_of(level).stop)
            state[known] = announced[known]
            figures.append(self._figures(state, canvases))
        return [*figures, last]

    def _all_passes(self) -> State:
        """Passes of every tile and channel."""
        return np.stack([np.maximum(2 * channel.top - 1, 0) for channel in self.channels], axis=1)

    def _correction(self) -> tuple[bytes, bool]:
        """The exactness section's payload, if there is anything to correct, and whether all is exact then.

        A precision is for the coordinates: attributes come back bit for bit all the same.
        """
        delta = exactness.difference(self.points, self._last)
        if not delta or self.precision is None:
            return delta, True
        if self.points.ndim == 2 or self.points.shape[2] == self.geometric:
            return b"", False
        kept = self._last.copy()
        kept[..., self.geometric :] = self.points[..., self.geometric :]
        return exactness.difference(kept, self._last), not exactness.difference(self.points, kept)

    def _coded(self, states: list[State], figures: list[Figures]) -> list[CodedLayer]:
        """Code the passes that each layer adds."""
        del self._whole, self._last  # as large as what takes their place
        coder = _TileCoder(self.table, self.channels)
        before = start = self._all_passes()
        layers = []
        for state, (rms, worst) in zip(states, figures, strict=True):
            segments = []
            for tile, number in np.argwhere(state < before):
                first, last = int(before[tile, number]), int(state[tile, number])
                data = coder.code(int(tile), int(number), first, first - last)
                top, begins = int(self.channels[number].top[tile]), first == start[tile, number]
                segments.append(CodedSegment(int(tile), int(number), top, first - last, bool(begins), data))
            layers.append(CodedLayer(rms, worst, segments))
            before = state
        return layers


class _TileCoder:
    """Codes the tiles of all channels, plane after plane, as a reader will meet them."""

    def __init__(self, table: TileTable, channels: list[_Channel]) -> None:
        self._table = table
        self._channels = channels
        self.tiles = [Tiles(table) for _ in channels]
        self._models: dict[tuple[int, int], NDArray[np.int32]] = {}

    def code(self, tile: int, channel: int, first: int, passes: int, costs: NDArray[np.float64] | None = None) -> bytes:
        """The bytes of the next ``passes`` passes of a tile of which ``first`` remain."""
        model = self._models.setdefault((tile, channel), new_model())
        tiles, rows = self.tiles[channel], self._table.of_tile(tile)
        coefficients = int((rows[:, 2] * rows[:, 3]).sum())
        # A decision takes at most 11 bits (a chance of 32 in 2**16), a coefficient two of them in a plane.
        data = np.empty(64 + 3 * passes * coefficients, np.uint8)
        length = code_passes(
            False,
            rows,
            first - 1,
            first - passes,
            tiles.known,
            tiles.sign,
            tiles.flags,
            tiles.early,
            self._channels[channel].true,
            model,
            data,
            np.zeros(0, np.float64) if costs is None else costs,
        )
        return data[:length].tobytes()


def tile_exponents(shape: tuple[int, int]) -> tuple[int, int]:
    """Tiles are square, unless the surface is so narrow that longer ones hold more of it."""
    rows = TILE_BITS // 2
    narrow = min(shape)
    while rows > 1 and narrow <= 1 << rows:
        rows -= 1
    if narrow > 1 << (TILE_BITS // 2):
        return TILE_BITS // 2, TILE_BITS // 2
    return (rows, TILE_BITS - rows) if shape[0] <= shape[1] else (TILE_BITS - rows, rows)
