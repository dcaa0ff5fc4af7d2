"""Windows of the heights of any level of a container, of which only the bytes that they need are read."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..container import read_index
from ..container.capacity import Capacity
from ..decoding.level_grids import level_nodes
from ..decoding.pieces import region_of_window
from ..decoding.segments import StoredSegments
from ..errors import InputError
from ..grid.window import spanning, within
from ..joints import Nodes
from ..planning.selection import Selection
from ..planning.window_errors import WindowErrors, read_window_errors
from ..target import Region

__all__ = ["HeightWindows"]


class HeightWindows:
    """A container of one block of heights, or of points whose x and y follow a rule.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Gives the bytes of the container.
    size : int
        Bytes of the container.
    max_vertices : int or None
        Limit on the memory of header, index and masks, see `lodestream.Decoder`.

    Attributes
    ----------
    header : Header
    metadata : dict
        Of the whole surface, and ``grid`` where x and y follow a rule.

    Raises
    ------
    InputError
        If it is another surface.
    StreamError, TooLargeError
        If it is damaged, or takes more memory.
    """

    def __init__(self, read: Callable[[int, int], bytes], size: int, max_vertices: int | None = None) -> None:
        index = read_index(read, size, Capacity(max_vertices))
        self.header = header = index.header
        if header.arrangement is not None:  # of which no window is decoded by itself
            got = f"{len(header.blocks)} blocks" if len(header.blocks) > 1 else "a block that meets itself"
            raise InputError(f"expected one block of heights for a map, got {got}")
        if header.point_channels != 1:
            raise InputError("expected one block of heights for a map, got points with an x and a y of their own")
        self._read, self._index = read, index
        self._segments = StoredSegments(read, index, Selection(attributes=()).channels(header))
        self._told = np.array([layer.max_error for layer in index.layers])
        self.metadata = dict(index.metadata_values)
        if header.plane is not None:
            self.metadata["grid"] = header.plane["grid"]
        self._nodes: dict[int, Nodes] = {}
        self._hidden: dict[int, bool] = {}

    def nodes(self, level: int) -> Nodes:
        """Return the rows and columns of the full grid at a level's nodes, int64, shape (row,) and (column,)."""
        if level not in self._nodes:
            self._nodes[level] = level_nodes(self.header, level)[0]
        return self._nodes[level]

    @cached_property
    def _window_errors(self) -> WindowErrors | None:
        return read_window_errors(self._index, self._read)

    def layers_within(self, error: float, level: int, window: Region) -> int | None:
        """Return after how few layers a window of a level is told to be no further off than an error.

        For the finest level the errors of windows count, if the container has them; for others, whose heights are
        means of finer ones, those of the whole surface.

        Parameters
        ----------
        error : float
            In the unit of the container.
        level : int
        window : ((int, int), (int, int))
            Rows and columns of the level, half-open.

        Returns
        -------
        int or None
            For `heights`; None if only everything is.

        Raises
        ------
        CorruptStreamError
            If the errors of windows are damaged.
        """
        told = self._told
        if level == self.header.levels and self._window_errors is not None:
            _, fractions = self._window_errors.cells(window, slice(None))
            told = np.minimum(told, fractions[..., 1].max(axis=(0, 1)) * self.header.extent)
        enough = np.flatnonzero(told <= error)
        return int(enough[0]) + 1 if enough.size else None

    def heights(self, level: int, window: Region, layers: int | None = None) -> NDArray[np.float64]:
        """Return a window of a level as the container has it, shape (row, column); NaN in holes.

        Parameters
        ----------
        level : int
        window : ((int, int), (int, int))
            Rows and columns of the level, half-open.
        layers : int, optional
            From the first so many layers, of which alone bytes are read; None: from everything.

        Raises
        ------
        CorruptStreamError
            If the container is damaged.
        """
        valid = self._valid(level, window)
        if valid is not None and not valid.any():
            return np.full(valid.shape, np.nan)
        nodes = self.nodes(level)
        shape = len(nodes[0]), len(nodes[1])
        made = region_of_window(self.header, level, spanning(window, self.header.shape, nodes))
        (values,) = self._segments.values(made, layers).values()
        heights = within(values.arrays[0], made.spans_in(shape), window, shape)[..., 0].astype(np.float64)
        if valid is not None:
            heights[~valid] = np.nan
        return heights

    def _valid(self, level: int, window: Region) -> NDArray[np.bool_] | None:
        """Return which nodes of a window of a level are no holes, shape (row, column); None: all that are shown."""
        (mask,) = self.header.masks or (None,)
        if mask is None:
            return None
        lines = self.nodes(level)
        if level not in self._hidden:
            # If no node of a level is valid, a decoder shows the values under the holes.
            self._hidden[level] = not mask[np.ix_(*lines)].any()
        rows, columns = (line[slice(*span)] for line, span in zip(lines, window, strict=True))
        return None if self._hidden[level] else mask[np.ix_(rows, columns)]
