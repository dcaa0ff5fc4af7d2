"""One run of the encoder: a prepared surface into a container of a certain kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.digest import DIGEST, values_digest
from ..container.fields import told, told_roughly
from ..container.model import Errors, Header
from ..container.writer import CodedLayer, CodedSegment, write_container
from ..decoding.reconstruction import Coordinates, initial_state, reconstruct_channel, to_values
from ..entropy.band_fields import COLUMNS, ROWS
from ..entropy.bitplanes import pass_count, pass_gains
from ..entropy.tile_coder import Channel, TileCoder, planes_of
from ..entropy.tiles import TileTable, gather
from ..planning.window_errors import KIND as WINDOW_ERRORS
from ..planning.window_errors import is_divided, layer_codes, no_errors, serialize_window_errors
from ..quantization.band_steps import Quantiser
from ..quantization.distortion import Original, coordinate_distances, other_originals
from ..quantization.lattice import Lattice
from ..surface import Surface
from ..transform.predictors import COEFFICIENT_BITS, default_predictors
from ..transform.pyramid import PADDING, copied, forward, synthesis_norms
from .allocation import TileCurve, assign_layers
from .closed_loop import ClosedLoop, quantise
from .large_units import large_level
from .preparation import Preparation
from .residual_encoder import as_returned, chunk_size, encode_chunks

__all__ = ["Encoding", "UnreachableError"]

#: What the last pass of a tile is worth for each coefficient, besides its own bits, in squared lattice steps: a level
#: whose tiles are all known is inverted without errors of rounding.
_ROUNDING = 0.2

#: The share of the bytes that errors of windows may take.
_WINDOWS_SHARE = 0.005

State = NDArray[np.int8]


class UnreachableError(Exception):
    """No step is short enough for the error: the type of the values itself rounds by more."""


class Encoding:
    """One run of the encoder; the methods stand in the order in which they are called.

    Parameters
    ----------
    prepared : Preparation
    progress : callable
        Called now and then with the fraction done, 0 to 1.
    bits : int, optional
        Keep no more of any channel than so many bits of its range.
    fine : (list of Lattice, int), optional
        What a stream for one error is quantised on, see `Preparation.fine_lattices`.
    """

    def __init__(
        self,
        prepared: Preparation,
        progress: Callable[[float], None],
        bits: int | None = None,
        fine: tuple[list[Lattice], int] | None = None,
    ) -> None:
        self.prepared, self.progress = prepared, progress
        self.quantiser: Quantiser | None = None
        self.large = 0
        self._loops: list[ClosedLoop] = []
        self.geometric, self.layout = prepared.geometric, prepared.layout
        table = TileTable.of(self.layout)
        self.tables = table, TileTable.of(self.layout, False) if self.layout.shared else table
        self.lattices, self.fineness = (prepared.lattices(bits), 0) if fine is None else fine

    def run(self) -> bytes:
        """The container.

        Raises
        ------
        UnreachableError
        """
        prepared = self.prepared
        predictors = np.zeros((len(self.lattices), *default_predictors(self.layout).shape), np.int8)
        channels = []
        for number, lattice in enumerate(self.lattices):
            channel, predictors[number] = self._transform(number, lattice)
            channels.append(channel)
        self.channels = channels
        self.predictors = predictors
        self.progress(0.1)
        if prepared.rms is not None:
            self._quantise(prepared.rms)
        curves = self._curves()
        self.header = self._header()
        states = assign_layers(curves, self.layout, len(channels), self.quantiser is not None)
        self.progress(0.4)
        states, errors = self._measured(states)
        self.progress(0.7)
        coefficients = sum(float(curve.bits.sum()) for curve in curves) / 8
        self.header = replace(self.header, chunk=chunk_size(prepared, self.header, self._last, coefficients))
        chunks, exact = encode_chunks(prepared, self.header, self._last)
        lossless = all(exact)
        levels = self._level_errors(_remaining(errors[-1], exact, self.geometric))
        self.progress(0.8)
        metadata = dict(prepared.surface.metadata)
        if lossless:
            metadata[DIGEST] = values_digest(as_returned(prepared.given, self.header.hole))
        coded = self._coded(states, errors)
        optional = self._optional(coded, chunks)
        return write_container(self.header, coded, levels, chunks, metadata, exact=lossless, optional=optional)

    def _header(self) -> Header:
        prepared, surface = self.prepared, self.prepared.surface
        masks = [block.mask for block in surface.blocks]
        return Header(
            dtype=surface.dtype,
            blocks=tuple((block.shape, block.closed) for block in surface.blocks),
            arrangement=prepared.arrangement,
            point_channels=prepared.point_channels,
            flat=surface.blocks[0].points.ndim == 2,
            attributes=prepared.kinds,
            lattices=tuple(self.lattices),
            predictors=self.predictors,
            extent=prepared.extent,
            empty=tuple(self._empty_levels(channel.top) for channel in self.channels),
            tile=self.layout.tile,
            chunk=prepared.chunks[-1],
            large=self.large,
            exact=False,
            corrected=False,
            layer_count=0,
            plane=prepared.plane,
            masked=any(mask is not None for mask in masks),
            hole=_hole(surface),
            holes=tuple(block.holes for block in surface.blocks),
            quantiser=self.quantiser,
            joint_changes=prepared.joint_changes,
            mask_data=tuple(b"" if mask is None else _encode_mask(mask) for mask in masks),
            **_kept(prepared),
        )

    def _quantise(self, wanted: float) -> None:
        """Choose indices, with the longest steps whose error is at most the one wanted."""
        table, canvases = self.tables[0], self._canvases()

        def error(tries: float) -> float:
            self.progress(0.1 + 0.2 * tries)
            return told(self._distances_of(canvases, [0] * self.geometric)[0][0])

        found = quantise(table, self._loops, canvases, error, wanted, self.fineness)
        if found is None:
            raise UnreachableError
        self.quantiser, indices = found
        self._loops.clear()
        squares = table.steps(self.quantiser).astype(np.float64) ** 2
        for channel, own in zip(self.channels, indices, strict=False):  # those behind the coordinates stay
            channel.true, channel.weights, channel.top = own, channel.weights * squares, self._tops(table, own)

    def _transform(self, number: int, lattice: Lattice) -> tuple[Channel, NDArray[np.int8]]:
        """Lattice coordinates of a channel, transformed and cut into tiles."""
        quantised = self.prepared.rms is not None and number < self.geometric
        for fit in (True, False):
            arrays = self.prepared.coordinates(number, lattice)
            given = [copied(array) for array in arrays] if quantised else []
            predictors = forward(arrays, self.layout, fit)
            if max(_largest(array) for array in arrays) < 1 << COEFFICIENT_BITS:
                break
        norms = [synthesis_norms(self.layout, predictors, grid) for grid in range(len(self.layout.grids))]
        table = self._table(number)
        if quantised:
            self._loops.append(ClosedLoop(table, predictors, given))
            true = np.zeros(table.size, np.int32)  # until indices have been chosen
        else:
            true = gather(table, arrays)
        # Errors are weighed relative to the extent, so that their squares stay within float64 at any scale; an
        # attribute shares the stream in proportion to its own range.
        span = self.prepared.extent if number < self.geometric else self._span(number)
        spacing = lattice.spacing / span if span else 0.0
        weights = np.array(
            [
                norms[band.grid][tile.level, *map(int, band.kind)] * spacing**2
                for tile, bands in zip(self.layout.tiles, table.members, strict=True)
                for band in bands
            ]
        )
        return Channel(true, weights, self._tops(table, true)), predictors

    def _tops(self, table: TileTable, true: NDArray[np.int32]) -> NDArray[np.int8]:
        """Bit-planes of each tile."""
        return np.array([planes_of(table, true, tile) for tile in range(len(self.layout.tiles))], np.int8)

    def _table(self, channel: int) -> TileTable:
        return self.tables[0 if channel < self.geometric else 1]

    def _span(self, channel: int) -> float:
        """Range of an attribute."""
        values = [self.prepared.channel(block, channel) for block in range(len(self.prepared.arrays))]
        return max(float(v.max()) for v in values) - min(float(v.min()) for v in values)

    def _empty_levels(self, top: NDArray[np.int8]) -> int:
        """The levels without a coefficient other than 0, as bits."""
        levels = range(self.layout.levels + 1)
        return sum(1 << level for level in levels if not top[self.layout.tiles_of(level)].any())

    def _curves(self) -> list[TileCurve]:
        """Cost and gain of every pass, by coding each tile once as a whole."""
        coded = self._tables_of_channels(), self.channels, self.geometric, self.quantiser
        self.large = large_level(*coded)
        coder = TileCoder(*coded, self.large)
        self.tiles, self._strings = coder.tiles, coder.strings
        curves = []
        for tile in range(len(self.layout.tiles)):
            for number, channel in enumerate(self.channels):
                top = int(channel.top[tile])
                if top:
                    passes = pass_count(top)
                    costs = np.zeros(passes, np.float64)
                    coder.code(tile, number, passes, passes, costs)
                    bits = np.diff(costs[::-1], prepend=0.0)[::-1]
                    table = self._table(number)
                    first, last = table.first[tile], table.first[tile + 1]
                    early, weights = coder.tiles[number].early, channel.weights[first:last]
                    rows = table.of_tile(tile)
                    gains = np.diff(pass_gains(rows, weights, passes, channel.true, early))
                    rounding = _ROUNDING if self.quantiser is None else 0.0
                    gains[0] += rounding * float((weights * rows[:, ROWS] * rows[:, COLUMNS]).sum())
                    curves.append(TileCurve(tile, number, bits, gains))
        return curves

    def _tables_of_channels(self) -> list[TileTable]:
        return [self._table(number) for number in range(len(self.channels))]

    def _distances(
        self, state: State, canvases: list[NDArray[np.int32]], cells: list[NDArray[np.float64]] | None = None
    ) -> list[tuple[float, float]]:
        """Errors of what a receiver shows in this state: of the distances and, if there are several, of coordinates."""
        fractions = []
        for number in range(self.geometric):
            places = [canvas[number, :, : -PADDING or None] for canvas in canvases]
            fractions.append(self._reconstructed(number, state, places)[1])
        return self._distances_of(canvases, fractions, cells)

    def _distances_of(
        self, shown: list[NDArray[np.int32]], fractions: list[int], cells: list[NDArray[np.float64]] | None = None
    ) -> list[tuple[float, float]]:
        """Errors of coordinates over two to these powers."""
        lattices, patches = self.lattices[: self.geometric], shown[self._curves_first :]
        return coordinate_distances(self.prepared.originals, lattices, patches, fractions, cells=cells)

    def _errors(
        self, state: State, canvases: list[NDArray[np.int32]], cells: list[NDArray[np.float64]] | None = None
    ) -> Errors:
        """Errors of what a receiver shows in this state, as a container tells them."""
        distances, *found = self._distances(state, canvases, cells)
        if len(self.lattices) > 1:
            found = found or [distances]
            for number, (originals, component) in enumerate(self._others, self.geometric):
                places = [canvas[0, :, : -PADDING or None] for canvas in canvases]
                fraction = self._reconstructed(number, state, places)[1]
                shown = [canvas[:1] for canvas in canvases[self._curves_first :]]
                found += coordinate_distances(originals, [self.lattices[number]], shown, [fraction], component)
        channels = tuple((told_roughly(rms), told_roughly(worst)) for rms, worst in found)
        return Errors(told(distances[0]), told(distances[1]), channels)

    @property
    def _curves_first(self) -> int:
        """How many grids are curves."""
        return len(self.layout.grids) - len(self.prepared.patches)

    @cached_property
    def _others(self) -> list[tuple[list[Original], int]]:
        """What the channels that are no coordinates are compared with."""
        prepared, blocks = self.prepared, self.prepared.surface.blocks
        arrays = [[_with_channels(array) for array in (b.points, *b.attributes.values())] for b in blocks]
        return other_originals(prepared.arrangement, arrays, [block.mask for block in blocks], self.geometric)

    def _reconstructed(self, number: int, state: State, canvases: list[NDArray[np.int32]] | None = None) -> Coordinates:
        return reconstruct_channel(
            self.header, number, self.tiles[number], state[:, number], self.layout.levels, canvases
        )

    def _canvases(self) -> list[NDArray[np.int32]]:
        """Room for a reconstruction of each channel that is a coordinate, one array for each grid."""
        shapes = [grid.shape for grid in self.layout.grids]
        return [np.empty((self.geometric, rows, columns + PADDING), np.int32) for rows, columns in shapes]

    def _measured(self, states: list[State]) -> tuple[list[State], list[Errors]]:
        """Errors of every layer's reconstruction; a layer that would raise the RMS is merged with the one after it."""
        canvases, start, announced = self._canvases(), initial_state(self.header), self._all_passes()
        kept: list[State] = []
        errors: list[Errors] = []
        codes: list[NDArray[np.uint8] | None] = []
        self._window_codes = codes
        for state in states:
            complete = state is states[-1]
            shown = state if complete else np.where(state < announced, state, start)
            cells: list[NDArray[np.float64]] = []
            measured = self._errors(shown.astype(np.int8), canvases, cells)
            if complete:
                while errors and measured.rms > errors[-1].rms:
                    kept.pop()
                    errors.pop()
                    codes.pop()
            elif errors and measured.rms > errors[-1].rms:
                continue
            kept.append(state)
            errors.append(measured)
            codes.append(self._codes(measured, cells))
        # The canvases hold the complete reconstruction of the coordinates, unless attributes took their place.
        shared = self.geometric if len(self.channels) == self.geometric else 0
        reconstructions: list[Coordinates] = [
            ([canvas[k, :, :-PADDING] for canvas in canvases], 0) for k in range(shared)
        ]
        reconstructions += [self._reconstructed(number, states[-1]) for number in range(shared, len(self.channels))]
        self._last = to_values(self.header, reconstructions, self.layout.levels)
        return kept, errors

    def _codes(self, errors: Errors, cells: list[NDArray[np.float64]]) -> NDArray[np.uint8] | None:
        """Errors of the cells of a layer, where there are several and they can be told."""
        if self.prepared.arrangement is not None or not is_divided(self.header):
            return None
        if not errors.maximum:
            return no_errors(self.header)
        return layer_codes(cells[0], self.header) if cells else None

    def _optional(self, coded: list[CodedLayer], chunks: list[bytes]) -> dict[int, bytes]:
        """Errors of windows, if they take little of the bytes."""
        codes = [known for known in self._window_codes if known is not None]
        if len(codes) < len(coded):
            return {}
        payload = serialize_window_errors(codes)
        total = sum(len(s.data) for layer in coded for s in layer.segments) + sum(map(len, chunks))
        return {WINDOW_ERRORS: payload} if len(payload) < _WINDOWS_SHARE * total else {}

    def _level_errors(self, last: Errors) -> list[Errors]:
        """Errors of the states that hold all levels up to one; the last of them is the complete surface."""
        canvases, start = self._canvases(), initial_state(self.header)
        errors = []
        for level in range(self.layout.levels):
            state = start.copy()
            state[: self.layout.tiles_of(level).stop] = 0
            errors.append(self._errors(state, canvases))
        return [*errors, last]

    def _all_passes(self) -> State:
        """Passes of every tile and channel."""
        return np.stack([np.maximum(2 * channel.top - 1, 0) for channel in self.channels], axis=1)

    def _coded(self, states: list[State], errors: list[Errors]) -> list[CodedLayer]:
        """Code the passes that each layer adds."""
        del self.tiles, self._last  # as large as what takes their place
        coded = self._tables_of_channels(), self.channels, self.geometric, self.quantiser
        coder = TileCoder(*coded, self.large, self._strings)
        before = start = self._all_passes()
        layers = []
        for state, measured in zip(states, errors, strict=True):
            segments = []
            for tile, number in np.argwhere(state < before):
                first, last = int(before[tile, number]), int(state[tile, number])
                data = coder.code(int(tile), int(number), first, first - last)
                top, begins = int(self.channels[number].top[tile]), first == start[tile, number]
                segments.append(CodedSegment(int(tile), int(number), top, first - last, bool(begins), data))
            layers.append(CodedLayer(measured, segments))
            before = state
        return layers


def _with_channels(array: NDArray[Any]) -> NDArray[Any]:
    return array if array.ndim == 3 else array[..., np.newaxis]


def _remaining(errors: Errors, exact: list[bool], geometric: int) -> Errors:
    """The errors of the complete surface, of which some channels are exact."""
    channels = tuple((0.0, 0.0) if known else pair for known, pair in zip(exact, errors.channels, strict=False))
    return Errors(0.0, 0.0, channels) if all(exact[:geometric]) else errors._replace(channels=channels)


def _largest(values: NDArray[np.int32]) -> int:
    """The largest magnitude."""
    return max(int(values.max()), -int(values.min()))


def _encode_mask(mask: NDArray[np.bool_]) -> bytes:
    from ..entropy.mask import encode_mask  # only where there is one

    return encode_mask(mask)


def _kept(prepared: Preparation) -> dict[str, Any]:
    """The fields of a header that tell which holes have values that come back."""
    if all(kept is None for kept in prepared.kept):
        return {}
    counts, coded = [], []
    for kept, block in zip(prepared.kept, prepared.surface.blocks, strict=True):
        counts.append(0 if kept is None else int(np.count_nonzero(kept)))
        coded.append(b"" if kept is None or counts[-1] == block.holes else _encode_mask(kept))
    return {"kept": tuple(counts), "kept_data": tuple(coded)}


def _hole(surface: Surface) -> int:
    """What integer points are under holes: the surface's nodata value where it is one of them."""
    nodata = surface.metadata.get("nodata")
    if surface.dtype.kind == "f" or not isinstance(nodata, int | float) or nodata != int(nodata):
        return 0
    limits = np.iinfo(surface.dtype)
    return int(nodata) if max(limits.min, -(2**63)) <= nodata <= min(limits.max, 2**63 - 1) else 0
