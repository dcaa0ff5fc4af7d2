"""The first phases of a build: every channel transformed, level by level, from the finest to the coarsest."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..entropy.part_table import flat_span
from ..entropy.tile_coder import planes_of
from ..transform.predictors import COEFFICIENT_BITS, INTERFACES, default_predictors, fitted_steps
from . import tasks
from .build import Build
from .executing import Task
from .forward import fit_columns, fit_rows
from .one_error import quantize
from .task_arrays import CORE, PLAIN, name_of, name_of_fit, pieces_of, transformed

__all__ = ["TransformPhases", "planes_of_channel"]

#: What the transform of a channel leaves.
_TRANSFORMED = (
    *("samples", "columns", "halves", "rows"),
    *("coefficients", "planes", "largest", "rules", "core-rules"),
)

#: Carries out the tasks of a phase, which takes about this share of the time.
_CarryOut = Callable[[float, Sequence[Task]], None]


def planes_of_channel(build: Build, kind: str, channel: int) -> NDArray[np.int8]:
    """Return the bit-planes of all tiles of a channel, int8, shape (tile,); ``kind`` as of `transformed`."""
    return np.concatenate([build.scratch.read(name_of(kind, channel, level, k)) for level, k, _ in pieces_of(build)])


class TransformPhases:
    """Transforms the channels of a build.

    Parameters
    ----------
    build : Build
    carry_out : callable
    report : callable
        Gives, for a share of the time, what is told the fraction of it that is done.
    """

    def __init__(self, build: Build, carry_out: _CarryOut, report: Callable[[float], Callable[[float], None]]) -> None:
        self._build, self._carry_out, self._report = build, carry_out, report
        self._scratch, self._layout = build.scratch, build.prepared.layout

    def carry_out(self, share: float) -> None:
        """Transform all channels, and write their predictors: int8, shape (channel, level, rule, 2).

        ``share`` is that of the time which this takes, about.
        """
        channels, quantized = range(self._build.channels), 0
        if self._build.lattices.fineness:
            quantized = self._build.prepared.geometric
            self._quantize(share * quantized / len(channels))
        plain = [k >= quantized and self._is_plain(k, share / len(channels)) for k in channels]
        if not self._scratch.has(PLAIN):
            self._scratch.write(PLAIN, np.array(plain))
        if not self._scratch.has("predictors"):
            self._scratch.write("predictors", np.stack([self._predictors(channel) for channel in channels]))

    def _quantize(self, share: float) -> None:
        """Transform and quantize all coordinates, whose errors add up; all levels are in one piece.

        Raises
        ------
        NoQuantiserError
            If no quantization step is short enough.
        """
        build, core = self._build, self._build.pieces.core
        assert build.is_whole
        result = quantize(build.prepared, build.lattices, build.table(0), self._report(share))
        build.quantiser = result.quantiser
        for channel, indices in enumerate(result.indices):
            table, tiles = build.table(channel), build.pieces.core_tiles
            planes = np.array([planes_of(table, indices, tile) for tile in tiles], np.int8)
            self._scratch.write(name_of_fit("coefficients", channel, 1, core, CORE), indices[flat_span(table, tiles)])
            self._scratch.write(name_of_fit("planes", channel, 1, core, CORE), planes)
            self._scratch.write(name_of_fit("core-rules", channel, 1), result.predictors[channel])
            self._scratch.write(f"weights/{channel}", result.weights[channel])

    def _is_plain(self, channel: int, share: float) -> bool:
        """Transform a channel, and return whether it has the default predictors."""
        overflow = f"overflow/{channel}"
        if not self._scratch.has(overflow):
            self._transform(channel, share, fit=True)
            share = 0.0
            if not self._fits(channel):
                self._scratch.write(overflow, np.zeros(0))
        plain = self._scratch.has(overflow)
        if plain:
            # Fitted predictors let coefficients grow beyond what a container holds; the default ones never do.
            for kind in _TRANSFORMED:
                self._scratch.remove(f"{kind}/{channel}")
            self._transform(channel, share, fit=False)
        self._scratch.remove(name_of_fit("samples", channel, not plain))
        return plain

    def _transform(self, channel: int, share: float, fit: bool) -> None:
        pieces, finest = self._build.pieces, self._layout.levels
        done = name_of_fit("core-rules", channel, fit)
        if self._scratch.has(done):
            self._carry_out(share, [])
            return

        def names(kind: str, level: int, count: int) -> list[str]:
            return [name_of_fit(kind, channel, fit, level, k) for k in range(count)]

        def phase(kind: str, level: int, count: int, function: Callable[..., None], *arguments: int) -> list[Task]:
            numbered = enumerate(names(kind, level, count))
            return [Task(name, function, (channel, int(fit), *arguments, k)) for k, name in numbered]

        if self._build.prepared.interfaces:
            self._carry_out(0.0, [Task(f"interfaces/{channel}", tasks.interfaces, (channel,))])
        self._carry_out(share / 4, phase("columns", finest, len(pieces.samples(finest)), tasks.coordinates))
        for level in reversed(pieces.levels):
            count = len(pieces.of(level))
            part = share * 3 / 4 * self._layout.points(level) / (self._layout.points(finest) * 4 / 3)
            columns = names("columns", level, len(pieces.samples(level)))
            for rule in (0, INTERFACES):
                self._fit(channel, level, rule, fit, columns)
            self._carry_out(part / 2, phase("rows", level, count, tasks.first_step, level))
            self._scratch.remove(name_of_fit("samples", channel, fit, level))
            self._fit(channel, level, 1, fit, names("rows", level, count))
            self._carry_out(part / 2, phase("columns", level - 1, count, tasks.second_step, level))
            # Not by the task: one whose worker dies when it has done this could not be done again.
            self._scratch.remove(name_of_fit("halves", channel, fit, level))
        self._carry_out(0.0, [Task(done, tasks.core, (channel, int(fit)))])

    def _fit(self, channel: int, level: int, rule: int, fit: bool, names: list[str]) -> None:
        """Fit a predictor to the samples of the pieces of a level, or take the default one."""
        name = name_of_fit("rules", channel, fit, level, rule)
        if self._scratch.has(name):
            return
        fitted = None
        if fit and (level - 1, rule) in fitted_steps(self._layout):
            lines = [self._scratch.read(sampled) for sampled in names]
            pieces, search = self._build.pieces, self._build.prepared.choices.search
            if rule == 1:
                fitted = fit_columns(lines, pieces.of(level), self._layout, level, search)
            else:
                fitted = fit_rows(lines, pieces.samples(level), self._layout, level, rule, search)
        self._scratch.write(name, np.array(fitted or (0, 0), np.int8))

    def _predictors(self, channel: int) -> NDArray[np.int8]:
        predictors, pieces = default_predictors(self._layout), self._build.pieces
        core, rules = (transformed(self._build, kind, channel) for kind in ("core-rules", "rules"))
        predictors[: pieces.core] = self._scratch.read(f"{core}/{channel}")[: pieces.core]
        for level in pieces.levels:
            for rule in range(predictors.shape[1]):
                predictors[level - 1, rule] = self._scratch.read(f"{rules}/{channel}/{level}/{rule}")
        return predictors

    def _fits(self, channel: int) -> bool:
        """Return whether a container holds the coefficients that fitted predictors leave."""
        largest = (self._scratch.read(name_of("largest", channel, level, k)) for level, k, _ in pieces_of(self._build))
        return max(map(int, largest)) < 1 << COEFFICIENT_BITS
