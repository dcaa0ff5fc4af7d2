"""One stream of a surface, built by phases of tasks: the bytes that `encoding.encoder` makes of it in one piece."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..container.codecs import needed_codecs
from ..container.digest import DIGEST
from ..container.model import Errors, Header
from ..container.writer import ContainerWriter
from ..encoding.allocation import assign_layers
from ..encoding.corrected import remaining_errors
from ..encoding.curves import Curves
from ..encoding.header import header_of
from ..encoding.large_units import candidate, worth
from ..encoding.measured import MeasuredLayer, all_passes, kept_layers, level_states, shown_states
from ..encoding.residual_encoder import chunk_sample, chunk_size
from ..encoding.transformed import band_weights
from ..encoding.written import window_section_of
from ..planning.window_errors import KIND as WINDOW_ERRORS
from ..transform.predictors import COEFFICIENT_BITS, default_predictors
from . import tasks
from .assembling import Chunks, coded_layers, returned_digest
from .build import Build
from .coding import parents_of, sizes_of_unit
from .executing import Execution, Task
from .forward import fit_columns, fit_rows
from .measuring import Figures, ValuesOfRows, errors_of, kinds_of, measured_rows
from .stored import PLAIN, kind_of, name_of, pieces_of, read_tiles, transformed

__all__ = ["Building", "OutOfRangeError"]

#: Fractions of the time that the phases take, about: transform, coding, measuring, writing.
_SHARES = 0.3, 0.3, 0.3, 0.1

#: What the transform of a channel leaves.
_TRANSFORMED = "samples", "columns", "halves", "nodes", "details", "coefficients", "planes", "rules", "core-rules"


class OutOfRangeError(Exception):
    """The squares of errors are out of float64's range: the surface must be measured in one piece."""


class Building:
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
        """Build the container and write it into a file; returns its bytes.

        Raises
        ------
        OutOfRangeError
            If it must be built in one piece.
        """
        self._transform()
        self._code()
        self._choose_layers()
        self._measure()
        return self._assemble(out)

    def _carry_out(self, share: float, phase: list[Task]) -> None:
        start = self._done
        self._execution.carry_out(phase, lambda fraction: self._progress(start + share * fraction))
        self._done = start + share

    # Transform: level by level, from the finest one down.

    def _transform(self) -> None:
        plain = [self._is_plain(channel) for channel in range(self._build.channels)]
        if not self._scratch.has(PLAIN):
            self._scratch.write(PLAIN, np.array(plain))
        if not self._scratch.has("predictors"):
            predictors = np.stack([self._predictors(channel) for channel in range(self._build.channels)])
            self._scratch.write("predictors", predictors)
        for channel, lattice in enumerate(self._build.lattices.channels):
            if not self._scratch.has(f"weights/{channel}"):
                own = self._read("predictors")[channel]
                weights = band_weights(self._build.prepared, channel, lattice, self._build.table, own)
                self._scratch.write(f"weights/{channel}", weights)

    def _is_plain(self, channel: int) -> bool:
        """Transform a channel; whether it has the default predictors."""
        overflow, share = f"overflow/{channel}", _SHARES[0] / self._build.channels
        if not self._scratch.has(overflow):
            self._transform_channel(channel, share, fit=True)
            share = 0.0
            if not self._fits(channel):
                self._scratch.write(overflow, np.zeros(0))
        plain = self._scratch.has(overflow)
        if plain:
            # Fitted predictors let coefficients grow beyond what a container holds; the default ones never do.
            for kind in _TRANSFORMED:
                self._scratch.remove(f"{kind}/{channel}")
            self._transform_channel(channel, share, fit=False)
        self._scratch.remove(f"{kind_of('samples', not plain)}/{channel}")
        return plain

    def _transform_channel(self, channel: int, share: float, fit: bool) -> None:
        bands, finest = self._build.bands, self._layout.levels
        done = f"{kind_of('core-rules', fit)}/{channel}"
        if self._scratch.has(done):
            self._done += share
            return

        def names(kind: str, level: int, pieces: Sequence[int]) -> list[str]:
            return [name_of(kind_of(kind, fit), channel, level, k) for k in pieces]

        def phase(names: list[str], function: Callable[..., None], *arguments: int) -> list[Task]:
            return [Task(name, function, (channel, int(fit), *arguments, k)) for k, name in enumerate(names)]

        count = len(tasks.sample_pieces(self._build, finest))
        self._carry_out(share / 4, phase(names("columns", finest, range(count)), tasks.coordinates))
        for level in reversed(bands.levels):
            own = range(len(bands.of(level)))
            part = share * 3 / 4 * self._layout.points(level) / (self._layout.points(finest) * 4 / 3)
            sampled = names("columns", level, range(len(tasks.sample_pieces(self._build, level))))
            self._fit(channel, level, 0, fit, sampled)
            self._carry_out(part / 2, phase(names("details", level, own), tasks.first_step, level))
            self._scratch.remove(f"{kind_of('samples', fit)}/{channel}/{level}")
            self._fit(channel, level, 1, fit, names("nodes", level, own) + names("details", level, own))
            self._carry_out(part / 2, phase(names("columns", level - 1, own), tasks.second_step, level))
            # Not by the task: one whose worker dies when it has done this could not be done again.
            self._scratch.remove(f"{kind_of('halves', fit)}/{channel}/{level}")
        self._carry_out(0.0, [Task(done, tasks.core, (channel, int(fit)))])

    def _fit(self, channel: int, level: int, axis: int, fit: bool, names: list[str]) -> None:
        """Fit the predictor of an axis to what the pieces of a level have sampled, or let it be the default one."""
        name = f"{kind_of('rules', fit)}/{channel}/{level}/{axis}"
        if self._scratch.has(name):
            return
        rule = None
        if fit:
            fitted = fit_rows if axis == 0 else fit_columns
            rule = fitted([self._read(sampled) for sampled in names], self._layout, level)
        self._scratch.write(name, np.array(rule or (0, 0), np.int8))

    def _fits(self, channel: int) -> bool:
        return max(int(self._planes("planes", channel).max()), 0) <= COEFFICIENT_BITS

    def _planes(self, kind: str, channel: int) -> NDArray[np.int8]:
        """Bit-planes of all tiles of a channel, int8, shape (tile,)."""
        return np.concatenate([self._read(name_of(kind, channel, level, k)) for level, k, _ in self._pieces])

    def _predictors(self, channel: int) -> NDArray[np.int8]:
        predictors = default_predictors(self._layout)
        core, rules = (transformed(self._build, kind, channel) for kind in ("core-rules", "rules"))
        coarsest = self._build.bands.core
        predictors[:coarsest] = self._read(f"{core}/{channel}")[:coarsest]
        for level in self._build.bands.levels:
            for axis in range(2):
                predictors[level - 1, axis] = self._read(f"{rules}/{channel}/{level}/{axis}")
        return predictors

    # Coding.

    @cached_property
    def _tops(self) -> list[NDArray[np.int8]]:
        channels = range(self._build.channels)
        return [self._planes(transformed(self._build, "planes", channel), channel) for channel in channels]

    def _code(self) -> None:
        if not self._scratch.has("large"):
            self._scratch.write("large", np.array(self._large_level()))
        units = [(channel, level, k) for level, k, _ in self._pieces for channel in range(self._build.channels)]
        self._carry_out(_SHARES[1], [Task(name_of("ends", *unit), tasks.code, unit) for unit in units])

    def _large_level(self) -> int:
        """See `large_level`."""
        level, tried = candidate(self._layout)
        if not level:
            return 0
        sizes = []
        for tile in tried:
            for channel, tops in enumerate(self._tops):
                if not tops[tile]:
                    continue
                parents = parents_of(self._build.table, range(tile, tile + 1))
                kind = transformed(self._build, "coefficients", channel)
                above = read_tiles(self._build, kind, channel, parents) if parents else np.zeros(0, np.int32)
                true = read_tiles(self._build, kind, channel, range(tile, tile + 1))
                sizes.append(sizes_of_unit(self._build.table, tile, true, above, int(tops[tile]), level))
        return level if worth([large for large, _ in sizes], [small for _, small in sizes]) else 0

    @property
    def _large(self) -> int:
        return int(self._read("large"))

    def _curves(self) -> Curves:
        """Of all units, in the order in which they are coded in one piece: by level, tile and channel."""
        found = [self._curves_of(*piece) for piece in self._pieces]
        return Curves(*(np.concatenate(own) for own in zip(*found, strict=True)))

    def _curves_of(self, level: int, number: int, tiles: range) -> tuple[NDArray[Any], ...]:
        """The arrays of `Curves` for a piece."""
        channels = self._build.channels
        own = np.array([tops[tiles.start : tiles.stop] for tops in self._tops], np.int64)
        counts = np.maximum(2 * own - 1, 0)
        passes = [np.repeat(np.arange(len(tiles)), each) for each in counts]
        order = np.argsort(np.concatenate(passes), kind="stable")  # from one channel after the other to tile by tile
        bits, gains = (
            np.concatenate([self._read(name_of(kind, channel, level, number)) for channel in range(channels)])[order]
            for kind in ("bits", "gains")
        )
        tile, channel = np.nonzero(counts.T)
        return tile + tiles.start, channel, counts[channel, tile], bits, gains

    # Layers.

    @cached_property
    def _header(self) -> Header:
        """With the largest chunks."""
        build = self._build
        predictors = np.array(self._read("predictors"))
        return header_of(build.prepared, build.lattices, predictors, self._tops, None, self._large)

    def _choose_layers(self) -> None:
        if self._scratch.has("layers"):
            return
        curves = self._curves()
        layers = assign_layers(curves, self._layout, self._build.channels)
        shown = shown_states(self._header, layers, all_passes(self._tops))
        self._scratch.write("states", np.stack([*shown, *level_states(self._header)]))
        self._scratch.write("last-state", shown[-1])
        self._scratch.write("coefficient-bytes", np.array(curves.bytes))
        self._scratch.write("layers", np.stack(layers))

    # Errors and residual.

    def _measure(self) -> None:
        if not self._scratch.has("chunk"):
            self._scratch.write("chunk", np.array(self._chunk()))
        rows, columns = (int(exponent) for exponent in self._read("chunk"))
        self._build.save_header(replace(self._header, chunk=(rows, columns)))
        self._carry_out(_SHARES[2], [Task(f"exact/{k}", tasks.measure, (k,)) for k in range(self._runs)])

    @property
    def _runs(self) -> int:
        """How many runs of rows are measured."""
        rows, columns = (int(exponent) for exponent in self._read("chunk"))
        return len(measured_rows(self._build.prepared, (rows, columns), self._build.points))

    def _chunk(self) -> tuple[int, int]:
        """See `chunk_size`."""
        prepared, header = self._build.prepared, self._header
        if len(prepared.chunks) == 1:
            return prepared.chunks[0]
        rows = chunk_sample(prepared, header.shape)[0]
        measurer = tasks.measurer_of(self._build, rows)
        values = measurer.values(np.array(self._read("last-state")), kinds_of(prepared))
        coefficients = float(self._read("coefficient-bytes"))
        return chunk_size(prepared, header, [ValuesOfRows(values, rows[0])], coefficients)

    def _measured(self) -> tuple[list[MeasuredLayer], list[Errors], list[bool]]:
        """The layers that are kept, the errors of all levels, and of each channel whether it is exact."""
        prepared, count = self._build.prepared, self._runs
        figures = [
            Figures(self._read(f"squares/{k}"), self._read(f"equal/{k}"), self._read(f"counts/{k}"))
            for k in range(count)
        ]
        layers = list(self._read("layers"))
        states = len(self._read("states"))
        found = []
        for state in range(states):
            errors = errors_of(figures, state, prepared.geometric, self._header.dtypes)
            if errors is None:
                raise OutOfRangeError
            found.append(errors)
        kept = kept_layers(self._header, layers, found[: len(layers)])
        whole = np.all([self._read(f"exact/{k}") for k in range(count)], axis=0)
        exact = [bool(channel) for channel in whole]
        last = remaining_errors(kept[-1].errors, exact, prepared.geometric)
        return kept, [*(errors for errors, _ in found[len(layers) :]), last], exact

    # The container.

    def _assemble(self, out: BinaryIO) -> int:
        build, scratch = self._build, self._scratch
        layers, levels, exact = self._measured()
        if not scratch.has("kept-states"):
            scratch.write("kept-states", np.stack([layer.state for layer in layers]))
        units = [
            (channel, level, k)
            for level, k, tiles in self._pieces
            for channel in range(build.channels)
            if self._has_small(tiles)
        ]
        self._carry_out(_SHARES[3] / 2, [Task(name_of("lengths", *unit), tasks.segments, unit) for unit in units])
        chunks = Chunks(scratch, self._runs)
        header = replace(build.stored_header(), exact=all(exact), corrected=any(chunks), layer_count=len(layers))
        header = replace(header, codecs=needed_codecs(header, chunks))
        writer = ContainerWriter(out, header)
        total = sum(map(len, chunks))
        for coded in coded_layers(build, self._pieces, layers, self._tops, self._large):
            writer.layer(coded)
            total += sum(len(segment.data) for segment in coded.segments)
        if header.corrected:
            writer.residual(levels[-1], chunks)
        metadata = dict(build.prepared.surface.metadata)
        if all(exact):
            metadata[DIGEST] = returned_digest(build.prepared.given, header.hole)
        writer.metadata(metadata)
        codes = [layer.window_codes for layer in layers if layer.window_codes is not None]
        if len(codes) == len(layers):
            payload = window_section_of(codes, total)
            if payload is not None:
                writer.optional(WINDOW_ERRORS, payload)
        return writer.end(levels)

    def _has_small(self, tiles: range) -> bool:
        return tiles.start < self._build.table.tiles_from(self._large)

    def _read(self, name: str) -> NDArray[Any]:
        return self._scratch.read(name)
