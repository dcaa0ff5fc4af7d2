"""One stream of a surface, built by phases of tasks; its bytes are the same whatever the pieces are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..container import limits
from ..container.codecs import needed_codecs
from ..container.digest import DIGEST
from ..container.model import Errors, Header
from ..container.writer import ContainerWriter
from ..decoding.measurer import Measured, distances_of
from ..planning.window_errors import KIND as WINDOW_ERRORS
from . import tasks
from .allocation import layer_ends, pass_order
from .assembling import Chunks, coded_layers, returned_digest, window_section_of
from .build import Build
from .coding import parents_of, sizes_of_unit
from .curves import Curves, band_weights
from .effort import FOR_ONE_ERROR
from .executing import Execution, Task
from .header import header_of
from .large_units import candidate, tried_tiles, worth
from .layers import (
    MeasuredLayer,
    State,
    all_passes,
    kept_layers,
    level_states,
    remaining_errors,
    shown_states,
    told_errors,
)
from .residual_encoder import chunk_sample, chunk_size
from .state_errors import exact_errors, last_values, measured_runs
from .stops import moved_ends, sought_ends
from .task_arrays import name_of, pieces_of, read_figures, read_tiles, transformed
from .transform_phases import TransformPhases, planes_of_channel

__all__ = ["OutOfRangeError", "Phases"]

#: Fractions of the time that the phases take, about: transform, coding, measuring, residual, writing.
_SHARES = 0.3, 0.2, 0.35, 0.05, 0.1
#: And of that of measuring, each turn after the first.
_OTHER_TURN = 0.03


class OutOfRangeError(Exception):
    """The squares of errors are out of float64's range: the surface must be measured in one piece."""


class Phases:
    """The phases of a build, each of which goes on where a build before it was cut.

    Parameters
    ----------
    build : Build
        Saved in its folder.
    execution : Execution
    progress : callable
        Is told the fraction done, 0 to 1.
    """

    def __init__(self, build: Build, execution: Execution, progress: Callable[[float], None]) -> None:
        self._build, self._execution, self._progress = build, execution, progress
        self._scratch, self._layout = build.scratch, build.prepared.layout
        self._pieces = pieces_of(build)
        self._done = 0.0

    def write(self, out: BinaryIO) -> int:
        """Build the container and write it into a file; return its bytes.

        Raises
        ------
        OutOfRangeError
            If it must be built in one piece.
        """
        self._transform()
        self._code()
        layers, levels = self._layers()
        exact = self._residual()
        levels.append(remaining_errors(layers[-1].errors, exact, self._build.prepared.geometric))
        return self._assemble(out, layers, levels, all(exact))

    def _carry_out(self, share: float, phase: Sequence[Task]) -> None:
        self._execution.carry_out(phase, self._report(share))

    def _report(self, share: float) -> Callable[[float], None]:
        """Return a callback for the progress of work that takes a share of the time."""
        start = self._done
        self._done = start + share
        return lambda fraction: self._progress(start + share * fraction)

    # Transform.

    def _transform(self) -> None:
        TransformPhases(self._build, self._carry_out, self._report).carry_out(_SHARES[0])
        for channel, lattice in enumerate(self._build.lattices.channels):
            if not self._scratch.has(f"weights/{channel}"):
                predictors, table = self._read("predictors")[channel], self._build.table(channel)
                weights = band_weights(self._build.prepared, channel, lattice, table, predictors)
                self._scratch.write(f"weights/{channel}", weights)

    # Coding.

    @cached_property
    def _tops(self) -> list[NDArray[np.int8]]:
        build, channels = self._build, range(self._build.channels)
        return [planes_of_channel(build, transformed(build, "planes", channel), channel) for channel in channels]

    def _code(self) -> None:
        if not self._scratch.has("large"):
            self._scratch.write("large", np.array(self._large_level()))
        units = [(channel, level, k) for level, k, _ in self._pieces for channel in range(self._build.channels)]
        self._carry_out(_SHARES[1], [Task(name_of("ends", *unit), tasks.code, unit) for unit in units])

    def _large_level(self) -> int:
        """Return the coarsest level whose units should be large; 0 if none should be."""
        choices = self._build.prepared.choices
        level = candidate(self._layout, choices.large_points) if choices.large_growth else 0
        if not level or all(self._build.quantiser_of(channel) for channel in range(self._build.channels)):
            return 0
        sizes = []
        for tile in tried_tiles(self._layout, choices.large_tried):
            for channel, tops in enumerate(self._tops):
                if not tops[tile] or self._build.quantiser_of(channel):
                    continue
                table = self._build.table(channel)
                parents = parents_of(table, range(tile, tile + 1))
                kind = transformed(self._build, "coefficients", channel)
                above = read_tiles(self._build, kind, channel, parents) if parents else np.zeros(0, np.int32)
                true = read_tiles(self._build, kind, channel, range(tile, tile + 1))
                sizes.append(sizes_of_unit(table, tile, true, above, int(tops[tile]), level))
        large, small = [large for large, _ in sizes], [small for _, small in sizes]
        return level if worth(large, small, choices.large_growth) else 0

    @property
    def _large(self) -> int:
        return int(self._read("large"))

    def _curves(self) -> Curves:
        """Return the curves of all units, sorted by level, tile and channel, as a build in one piece has them."""
        arrays = [self._curves_of(*piece) for piece in self._pieces]
        return Curves(*(np.concatenate(parts) for parts in zip(*arrays, strict=True)))

    def _curves_of(self, level: int, number: int, tiles: range) -> tuple[NDArray[Any], ...]:
        """Return the arrays of `Curves` of a piece."""
        channels = self._build.channels
        planes = np.array([tops[tiles.start : tiles.stop] for tops in self._tops], np.int64)
        counts = np.maximum(2 * planes - 1, 0)
        passes = [np.repeat(np.arange(len(tiles)), count) for count in counts]
        order = np.argsort(np.concatenate(passes), kind="stable")  # from one channel after the other to tile by tile
        bits, gains = (
            np.concatenate([self._read(name_of(kind, channel, level, number)) for channel in range(channels)])[order]
            for kind in ("bits", "gains")
        )
        tile, channel = np.nonzero(counts.T)
        return tile + tiles.start, channel, counts[channel, tile], bits, gains

    # Layers and their errors.

    @cached_property
    def _header(self) -> Header:
        """The header with chunks of the largest size."""
        build = self._build
        predictors = np.array(self._read("predictors"))
        return header_of(build.prepared, build.lattices, predictors, self._tops, build.quantiser, self._large)

    def _layers(self) -> tuple[list[MeasuredLayer], list[Errors]]:
        """Return the layers that are kept, and the errors of all levels but the last."""
        build, header = self._build, self._header
        curves = self._curves()
        order = pass_order(curves, self._layout, build.channels)
        if not self._scratch.has("coefficient-bytes"):
            self._scratch.write("coefficient-bytes", np.array(curves.bytes))
        del curves
        most = limits.most_layers(build.channels, self._layout.levels + 1)
        choices = build.prepared.choices
        ends = layer_ends(order, most, choices.layers or (FOR_ONE_ERROR if build.quantiser is not None else None))
        states = dict(zip(ends, order.states(ends), strict=True))
        passes, last = all_passes(self._tops), states[ends[-1]]
        if not self._scratch.has("last-state"):
            self._scratch.write("last-state", last)
        if build.is_whole:  # to choose chunks takes the values of all, which come later
            build.save_header(header)
        else:
            self._choose_chunk()  # runs begin where chunks do
        of_levels = level_states(header)
        shown = shown_states(header, [states[end] for end in ends[:-1]], passes)
        measured = self._measure(0, [*shown, last, *of_levels])
        levels = [errors for errors, _ in measured[len(ends) :]]
        known = dict(zip(ends, measured, strict=False))
        for turn in range(1, choices.stop_turns + 1):
            rms = {end: errors.rms for end, (errors, _) in known.items()}
            sought = sought_ends(order, rms, header.extent, header.geometric)
            if not sought:
                break
            states.update(zip(sought, order.states(sought), strict=True))
            shown = shown_states(header, [states[end] for end in sought], passes)
            known.update(zip(sought, self._measure(turn, shown), strict=True))
        rms = {end: errors.rms for end, (errors, _) in known.items()}
        ends = moved_ends(order, ends, rms, header.extent, most)
        return kept_layers(header, [states[end] for end in ends], [known[end] for end in ends]), levels

    def _measure(self, turn: int, states: Sequence[State]) -> list[Measured]:
        """Measure the errors of states, int8, shape (tile, channel) each."""
        build = self._build
        if not self._scratch.has(f"states/{turn}"):
            self._scratch.write(f"states/{turn}", np.stack(states))
        runs = range(self._runs)
        phase = [Task(f"counts/{turn}/{k}", tasks.measure, (k, turn)) for k in runs]
        self._carry_out(_SHARES[2] * (_OTHER_TURN if turn else 1 - 3 * _OTHER_TURN), phase)
        figures = [read_figures(build, turn, k) for k in runs]
        measured = []
        for number, state in enumerate(states):
            distances = distances_of(self._header, figures, number)
            if distances is None and not build.is_whole:
                raise OutOfRangeError
            errors, cells = distances or exact_errors(build, self._header, state)
            measured.append((told_errors(errors), cells))
        return measured

    @property
    def _runs(self) -> int:
        """Number of runs of rows, or of blocks, that are measured."""
        return len(measured_runs(self._build.stored_header(), self._build.points))

    # Residual.

    def _residual(self) -> list[bool]:
        """Code the residual; return for each channel whether it is exact with it."""
        self._choose_chunk()
        runs = range(self._runs)
        self._carry_out(_SHARES[3], [Task(f"exact/{k}", tasks.residual, (k,)) for k in runs])
        whole = np.all([self._read(f"exact/{k}") for k in runs], axis=0)
        return [bool(channel) for channel in whole]

    def _choose_chunk(self) -> None:
        """Save the header with the size of chunks, for tasks."""
        if not self._scratch.has("chunk"):
            self._scratch.write("chunk", np.array(self._chunk()))
        rows, columns = (int(exponent) for exponent in self._read("chunk"))
        self._build.save_header(replace(self._header, chunk=(rows, columns)))

    def _chunk(self) -> tuple[int, int]:
        """Choose the size of chunks, see `chunk_size`."""
        prepared, header = self._build.prepared, self._header
        if len(prepared.chunks) == 1:
            return prepared.chunks[0]
        start, stop = chunk_sample(prepared, header.shape)[0]
        values = last_values(self._build, header, range(start, stop))
        return chunk_size(prepared, header, values, float(self._read("coefficient-bytes")))

    # The container.

    def _assemble(self, out: BinaryIO, layers: Sequence[MeasuredLayer], levels: Sequence[Errors], exact: bool) -> int:
        build, scratch = self._build, self._scratch
        if not scratch.has("kept-states"):
            scratch.write("kept-states", np.stack([layer.state for layer in layers]))
        units = [
            (channel, level, k)
            for level, k, tiles in self._pieces
            for channel in range(build.channels)
            if tiles.start < build.first_large(channel, self._large)
        ]
        self._carry_out(_SHARES[4] / 2, [Task(name_of("lengths", *unit), tasks.segments, unit) for unit in units])
        chunks = Chunks(scratch, self._runs)
        header = replace(build.stored_header(), exact=exact, corrected=any(chunks), layer_count=len(layers))
        header = replace(header, codecs=needed_codecs(header, chunks))
        writer = ContainerWriter(out, header)
        total = sum(map(len, chunks))
        for coded in coded_layers(build, self._pieces, layers, self._tops, self._large):
            writer.layer(coded)
            total += sum(len(segment.data) for segment in coded.segments)
        if header.corrected:
            writer.residual(levels[-1], chunks)
        metadata = dict(build.prepared.surface.metadata)
        if exact:
            metadata[DIGEST] = returned_digest(build.prepared.given, header.hole)
        writer.metadata(metadata)
        codes = [layer.window_codes for layer in layers if layer.window_codes is not None]
        if len(codes) == len(layers) and build.prepared.choices.window_errors:
            payload = window_section_of(codes, total)
            if payload is not None:
                writer.optional(WINDOW_ERRORS, payload)
        return writer.end(levels)

    def _read(self, name: str) -> NDArray[Any]:
        return self._scratch.read(name)
