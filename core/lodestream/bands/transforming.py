"""The first phases of a build: every channel transformed, level by level from the finest one down."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..encoding.one_error import quantize
from ..entropy.part_table import flat_span
from ..entropy.tile_coder import planes_of
from ..transform.predictors import COEFFICIENT_BITS, INTERFACES, default_predictors, fitted_steps
from . import grid_tasks, grid_transform, tasks
from .build import Build
from .executing import Task
from .forward import fit_columns, fit_rows
from .grid_runs import GridRuns
from .stored import CORE, PLAIN, name_of, name_of_fit, pieces_of, transformed

__all__ = ["Transforming", "planes_of_channel", "transforming"]

#: What the transform of a channel leaves.
_TRANSFORMED = (
    *("samples", "columns", "halves", "nodes", "details", "rows"),
    *("coefficients", "planes", "largest", "rules", "core-rules"),
)

#: Carries out the tasks of a phase, which takes about this share of the time.
_CarryOut = Callable[[float, Sequence[Task]], None]


def planes_of_channel(build: Build, kind: str, channel: int) -> NDArray[np.int8]:
    """Bit-planes of all tiles of a channel, int8, shape (tile,); ``kind`` as of `transformed`."""
    return np.concatenate([build.scratch.read(name_of(kind, channel, level, k)) for level, k, _ in pieces_of(build)])


class Transforming(ABC):
    """Transforms the channels of a build.

    Parameters
    ----------
    build : Build
    carry_out : callable
    report : callable
        Gives, for a share of the time, what is told the fraction of it that is done.
    """

    #: The module of the tasks, and the kinds of file in which they leave sampled rows; they write the last one last.
    _tasks: ClassVar[tuple[Any, tuple[str, ...]]]

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
        found = quantize(build.prepared, build.lattices, build.table(0), self._report(share))
        build.quantiser = found.quantiser
        for channel, indices in enumerate(found.indices):
            table, tiles = build.table(channel), build.pieces.core_tiles
            planes = np.array([planes_of(table, indices, tile) for tile in tiles], np.int8)
            self._scratch.write(name_of_fit("coefficients", channel, 1, core, CORE), indices[flat_span(table, tiles)])
            self._scratch.write(name_of_fit("planes", channel, 1, core, CORE), planes)
            self._scratch.write(name_of_fit("core-rules", channel, 1), found.predictors[channel])
            self._scratch.write(f"weights/{channel}", found.weights[channel])

    def _is_plain(self, channel: int, share: float) -> bool:
        """Transform a channel; whether it has the default predictors."""
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
            every = enumerate(names(kind, level, count))
            return [Task(name, function, (channel, int(fit), *arguments, k)) for k, name in every]

        work, rows = self._tasks
        self._carry_out(0.0, self._before(channel))
        self._carry_out(share / 4, phase("columns", finest, self._samples(finest), work.coordinates))
        for level in reversed(pieces.levels):
            count = len(pieces.of(level))
            part = share * 3 / 4 * self._layout.points(level) / (self._layout.points(finest) * 4 / 3)
            sampled = names("columns", level, self._samples(level))
            for rule in (0, INTERFACES):
                self._fit(channel, level, rule, fit, sampled)
            self._carry_out(part / 2, phase(rows[-1], level, count, work.first_step, level))
            self._scratch.remove(name_of_fit("samples", channel, fit, level))
            self._fit(channel, level, 1, fit, [name for kind in rows for name in names(kind, level, count)])
            self._carry_out(part / 2, phase("columns", level - 1, count, work.second_step, level))
            # Not by the task: one whose worker dies when it has done this could not be done again.
            self._scratch.remove(name_of_fit("halves", channel, fit, level))
        self._carry_out(0.0, [Task(done, work.core, (channel, int(fit)))])

    def _fit(self, channel: int, level: int, rule: int, fit: bool, names: list[str]) -> None:
        """Fit a predictor to what the pieces of a level have sampled, or let it be the default one."""
        name = name_of_fit("rules", channel, fit, level, rule)
        if self._scratch.has(name):
            return
        found = None
        if fit and (level - 1, rule) in fitted_steps(self._layout):
            found = self._fitted([self._scratch.read(sampled) for sampled in names], level, rule)
        self._scratch.write(name, np.array(found or (0, 0), np.int8))

    def _predictors(self, channel: int) -> NDArray[np.int8]:
        predictors, pieces = default_predictors(self._layout), self._build.pieces
        core, rules = (transformed(self._build, kind, channel) for kind in ("core-rules", "rules"))
        predictors[: pieces.core] = self._scratch.read(f"{core}/{channel}")[: pieces.core]
        for level in pieces.levels:
            for rule in range(predictors.shape[1]):
                predictors[level - 1, rule] = self._scratch.read(f"{rules}/{channel}/{level}/{rule}")
        return predictors

    @abstractmethod
    def _samples(self, level: int) -> int:
        """How many pieces a level's samples have."""

    def _before(self, channel: int) -> list[Task]:
        """What comes before the transform of a channel."""
        return []

    @abstractmethod
    def _fitted(self, sampled: list[NDArray[np.int32]], level: int, rule: int) -> tuple[int, int] | None:
        """The (a, b) that fits what pieces have sampled."""

    @abstractmethod
    def _fits(self, channel: int) -> bool:
        """Whether a container holds the coefficients that fitted predictors leave."""


class _OfBands(Transforming):
    """By bands of rows of the one grid."""

    _tasks = tasks, ("nodes", "details")

    def _samples(self, level: int) -> int:
        return len(tasks.sample_pieces(self._build, level))

    def _fitted(self, sampled: list[NDArray[np.int32]], level: int, rule: int) -> tuple[int, int] | None:
        return (fit_rows if rule == 0 else fit_columns)(sampled, self._layout, level)

    def _fits(self, channel: int) -> bool:
        return int(planes_of_channel(self._build, "planes", channel).max()) <= COEFFICIENT_BITS


class _OfGrids(Transforming):
    """By runs of grids."""

    _tasks = grid_tasks, ("rows",)

    @property
    def _runs(self) -> GridRuns:
        assert isinstance(self._build.pieces, GridRuns)
        return self._build.pieces

    def _before(self, channel: int) -> list[Task]:
        return [Task(f"interfaces/{channel}", grid_tasks.interfaces, (channel,))]

    def _samples(self, level: int) -> int:
        return len(self._runs.samples(level))

    def _fitted(self, sampled: list[NDArray[np.int32]], level: int, rule: int) -> tuple[int, int] | None:
        pieces = [run.grids for run in self._runs.of(level)] if rule == 1 else self._runs.samples(level)
        return grid_transform.fit(sampled, pieces, self._layout, level, rule)

    def _fits(self, channel: int) -> bool:
        largest = (self._scratch.read(name_of("largest", channel, level, k)) for level, k, _ in pieces_of(self._build))
        return max(map(int, largest)) < 1 << COEFFICIENT_BITS


def transforming(
    build: Build, carry_out: _CarryOut, report: Callable[[float], Callable[[float], None]]
) -> Transforming:
    """What transforms the channels of a build."""
    kind = _OfGrids if isinstance(build.pieces, GridRuns) else _OfBands
    return kind(build, carry_out, report)
