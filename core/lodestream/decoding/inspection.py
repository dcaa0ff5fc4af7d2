"""What is held against a container from an untrusted source: values, levels, and the recorded errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.fields import told, told_roughly
from ..container.model import Errors, Index, LayerRecord
from ..coordinates.height_fields import to_xyz
from ..coordinates.seams import restore
from ..errors import CorruptStreamError, InputError
from ..planning.window_errors import CELL, WindowErrors, layer_codes
from ..quantization.measure import extent_of
from ..surface import Surface
from .inspected_sections import Walked
from .measurer import Measured
from .progress import initial_state

__all__ = [
    "READ",
    "Inspection",
    "check_errors",
    "check_levels",
    "check_values",
    "corners_of",
    "states_of",
]

#: By how much, of itself, a recorded error may differ from the one found. Values are the same bit for bit wherever they
#: are decoded; but who adds up as many squares as a surface may have points in another order finds another last digit.
_TOLERANCE = 1e-9

#: How much is done when all sections are read.
READ = 0.2

#: What the functions that put a surface back where its metadata say may raise when these say something else.
_UNUSABLE = (InputError, TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RecursionError)


@dataclass(frozen=True)
class Inspection:
    """The result of checking a container that is sound.

    Attributes
    ----------
    index : Index
    errors_checked : bool
        Whether the recorded errors were measured again. This needs the original values, which only an exact container
        has; otherwise the errors are what the container's maker claims.
    """

    index: Index
    errors_checked: bool


def check_values(index: Index, holes: tuple[int, ...], corners: Sequence[NDArray[Any]]) -> None:
    """Refuse holes or an extent that are not the complete surface's. The digest was checked when it was decoded.

    Parameters
    ----------
    index : Index
    holes : tuple of int
        Of each block.
    corners : sequence of arrays, shape (channel,)
        The least and the largest values of the valid points, or of parts of them.

    Raises
    ------
    CorruptStreamError
        If anything else was told.
    """
    header = index.header
    if index.digest is not None and not header.exact:
        raise CorruptStreamError(
            f"expected no SHA-256 of values that are not exact, got {index.digest!a:.80}", index.metadata.offset
        )
    if holes != (header.holes or (0,) * len(holes)):
        raise CorruptStreamError(f"expected {header.holes} holes in the blocks, got {holes}", 0)
    if any(own == rows * columns for own, ((rows, columns), _) in zip(holes, header.blocks, strict=True)):
        raise CorruptStreamError("expected a valid point in each block, got none", 0)
    if header.exact:
        box = np.stack(corners)[:, np.newaxis]
        found = extent_of(box[..., 0] if box.shape[2] == 1 else box, min(box.shape[2], 3))
        if not math.isclose(found, header.extent, rel_tol=_TOLERANCE):
            raise CorruptStreamError(f"expected the extent of the surface, {found}, got {header.extent}", 0)


def corners_of(points: NDArray[Any], mask: NDArray[np.bool_] | None) -> list[NDArray[Any]]:
    """The least and the largest values of valid points, shape (channel,); none where none are valid.

    Parameters
    ----------
    points : shape (row, column, channel)
    mask : bool, shape (row, column), or None
        True where a point is valid.
    """
    flat = points.reshape(-1, points.shape[2]) if mask is None else points[mask]
    return [flat.min(axis=0), flat.max(axis=0)] if len(flat) else []


def check_levels(index: Index, surface_at: Callable[[int], Surface], most: int | None = None) -> None:
    """Refuse metadata that would upset whoever writes a level of the surface into a file.

    Parameters
    ----------
    index : Index
    surface_at : callable (level) -> Surface
        The finest level complete.
    most : int, optional
        Levels of more points are not looked at.

    Raises
    ------
    CorruptStreamError
        If a level cannot be restored.
    """
    finest = index.header.levels
    for level in range(finest + 1):
        if most is not None and index.header.layout.points(level) > most:
            break
        try:
            surface = restore(surface_at(level))
            if level < finest:
                to_xyz(surface)
        except _UNUSABLE as error:
            problem = f"{type(error).__name__}: {error}"
            raise CorruptStreamError(
                f"expected metadata with which level {level} can be restored, got others ({problem:.200})",
                index.metadata.offset,
            ) from None


def states_of(walked: Walked) -> Iterator[NDArray[np.int8]]:
    """The states whose errors are told, int8, shape (tile, channel): of the layers, then of the levels but the last."""
    header = walked.index.header
    for _, view in zip(walked.index.layers, walked.decoder.layers, strict=False):
        yield view._state
    for known in walked.index.levels[:-1]:
        state = initial_state(header)
        state[: header.layout.tiles_of(known.level).stop] = 0
        yield state


def check_errors(walked: Walked, found: Iterable[Measured], progress: Callable[[float], None]) -> None:
    """Refuse errors of layers, levels and windows that are not theirs.

    Parameters
    ----------
    walked : Walked
        Of an exact container.
    found : iterable of (Errors, list)
        What was measured of each of `states_of`.
    progress : callable
        Called with the fraction done.

    Raises
    ------
    CorruptStreamError
        If others were told.
    """
    index, windows = walked.index, walked.windows
    names: list[tuple[str, LayerRecord | None, Errors, int]] = [
        (f"layer {record.number}", record, record.errors, record.offset) for record in index.layers
    ]
    names += [(f"level {known.level}", None, known.errors, index.index.offset) for known in index.levels[:-1]]
    for number, ((name, record, errors, offset), (measured, cells)) in enumerate(zip(names, found, strict=True), 1):
        _agree(errors, measured, name, offset)
        if record is not None and windows is not None and index.header.arrangement is None and cells:
            _bound(windows, cells[0], record)
        progress(number / len(names))
    nothing = Errors(0.0, 0.0, ((0.0, 0.0),) * len(index.levels[-1].channels))
    _agree(index.levels[-1].errors, nothing, "the exact surface", index.index.offset)


def _agree(said: Errors, found: Errors, what: str, offset: int) -> None:
    pairs = [(told, said[:2], found[:2])]
    pairs += [(told_roughly, *channel) for channel in zip(said.channels, found.channels, strict=True)]
    for rounded, one, other in pairs:
        for a, b in zip(one, other, strict=True):
            if not rounded(b * (1 - _TOLERANCE)) <= a <= rounded(b * (1 + _TOLERANCE)):
                wanted, got = (f"{pair[0]} and {pair[1]}" for pair in (other, one))
                raise CorruptStreamError(f"expected the RMS and maximum error of {what}, {wanted}, got {got}", offset)


def _bound(windows: WindowErrors, cells: NDArray[np.float64], layer: LayerRecord) -> None:
    """Refuse errors of windows that are smaller than what was measured, as far as cells are the same."""
    known = layer_codes(cells, windows.header)
    if windows.cell != CELL or known is None:
        return
    if (windows.codes[:, layer.number] > known).any():
        raise CorruptStreamError(
            f"expected bounds of the errors of windows in layer {layer.number}, got smaller ones", 0
        )
