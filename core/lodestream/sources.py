"""Arrays stored elsewhere that are read window by window: files of simulations, Zarr, Dask, xarray, HDF5."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .scratch import Room

__all__ = ["Source", "is_source", "read_source", "windows"]

#: Values that are read at a time, about.
_AT_ONCE = 1 << 22


@runtime_checkable
class Source(Protocol):
    """An array that `encode` reads window by window, of shape (row, column) or (row, column, channel).

    >>> import numpy as np, lodestream
    >>> class Plane:
    ...     shape, dtype = (300, 400), np.dtype(np.int32)
    ...
    ...     def read(self, window):
    ...         rows, columns = (np.arange(part.start, part.stop) for part in window)
    ...         return np.add.outer(rows, columns).astype(self.dtype)
    >>> lodestream.decode(lodestream.encode(Plane())).points[5, 7]
    np.int32(12)

    Attributes
    ----------
    shape : tuple of int
    dtype : dtype
        Of its values; one that `Surface` takes.
    """

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, columns, and channels if it has several."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the values."""

    def read(self, window: tuple[slice, slice]) -> NDArray[Any]:
        """Return the values of some rows and columns, shape (row, column) or (row, column, channel).

        Both slices have a start and a stop.
        """


def is_source(value: object) -> TypeGuard[Source]:
    """Return whether a value is read by windows: a `Source`, or an array of h5py, Zarr, Dask or xarray."""
    if isinstance(value, np.ndarray | list | tuple | str | bytes | memoryview):
        return False
    shaped = hasattr(value, "shape") and hasattr(value, "dtype")
    return shaped and (callable(getattr(value, "read", None)) or hasattr(value, "__getitem__"))


def read_source(source: Source, room: Room) -> NDArray[Any]:
    """Read all values of a source, shape (row, column) or (row, column, channel), into an array of ``room``.

    Raises
    ------
    InputError
        If it has another number of axes, or gives windows of another shape or dtype, or with masked values.
    """
    shape = tuple(int(length) for length in source.shape)
    if len(shape) not in (2, 3):
        raise InputError(f"expected a source of shape (H, W) or (H, W, C), got shape {shape}")
    values = room.empty(shape, np.dtype(source.dtype).newbyteorder("="))
    here = _holds_arrays(source)
    for window in windows(shape, _chunk(source)):
        read = _part(source, window, here)
        if np.ma.is_masked(read):
            raise InputError(
                f"expected values in all of a source of shape {shape}, got masked ones: fill them with NaN"
            )
        part = np.asarray(read)
        expected = (*(span.stop - span.start for span in window), *shape[2:])
        if part.shape != expected:
            raise InputError(f"expected a window of shape {expected} of a source of shape {shape}, got {part.shape}")
        if part.dtype.newbyteorder("=") != values.dtype:
            raise InputError(f"expected values of {values.dtype}, as the source says, got {part.dtype}")
        values[window] = part
    return values


def _part(source: Any, window: tuple[slice, slice], here: bool) -> Any:
    """Read or compute a window."""
    part = source.read(window) if callable(getattr(source, "read", None)) else source[window]
    return part.compute(scheduler="threads") if here else part


def _holds_arrays(source: Any) -> bool:
    """Return whether a source is an array of Dask, or of xarray with Dask, made of arrays in memory.

    A cluster would receive all of them for each window, so threads of this process compute such a source.
    """
    graph = getattr(source, "__dask_graph__", lambda: None)()
    return graph is not None and any(isinstance(task, np.ndarray) for task in graph.values())


def _chunk(source: Any) -> tuple[int, int]:
    """Return rows and columns of the chunks of a source, 1 where they are unknown."""
    chunks = getattr(source, "chunks", None)
    lengths = [*(chunks if isinstance(chunks, tuple) else ())][:2]
    sides = [max(side, default=1) if isinstance(side, tuple) else side for side in lengths]  # Dask lists all of them
    rows, columns = [*(side if isinstance(side, int) and side > 0 else 1 for side in sides), 1, 1][:2]
    return rows, columns


def windows(shape: tuple[int, ...], chunk: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Yield all windows of an array of this shape, (row, column, ...), each of a few million values.

    They consist of whole chunks (rows, columns), because a chunk is read, or computed, as a whole. They have all
    columns if these are not too many.
    """
    rows, columns = (max(1, min(side, length)) for side, length in zip(chunk, shape, strict=False))
    others = max(1, math.prod(shape[2:]))
    across = max(columns, min(shape[1], _AT_ONCE // (rows * others)))
    across = shape[1] if across == shape[1] else across // columns * columns
    down = max(rows, _AT_ONCE // (across * others) // rows * rows)
    for top in range(0, shape[0], down):
        for first in range(0, shape[1], across):
            yield slice(top, min(top + down, shape[0])), slice(first, min(first + across, shape[1]))
