"""Repeated last rows and columns, and angles that jump: removed before encoding, restored afterwards.

A file that closes a surface by repeating its first row or column at the end stores those points twice. `merge` finds
that bit by bit and makes the axis closed instead; `restore`, which every writer calls first, repeats the points again.
Likewise `unwrap` adds whole turns to angles so that neighbours are near each other, and `restore` subtracts them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scratch import IN_MEMORY, Room, rows_at_once
from ..surface import DTYPES, Block, Closed, Surface

__all__ = ["angles_of", "merge", "restore", "shapes_in_files", "unwrap", "wrapped"]

_WORDS: Mapping[Closed, str] = {(True, False): "rows", (False, True): "cols", (True, True): "both"}
_AXES: Mapping[str, Closed] = {word: closed for closed, word in _WORDS.items()}

#: Rows or columns with a repeated one, at least: a closed axis has at least three points.
_MIN_LINES_WITH_SEAM = 4

#: A channel of angles, and a full turn.
Turns = tuple[int, float]


def merge(
    surface: Surface, closed: Closed | None = None, *, angle: Turns | None = None, room: Room = IN_MEMORY
) -> Surface:
    """Merge repeated last rows and columns of every block into closed axes.

    Points repeat where their bits are equal, and those of their mask and attributes. A row whose points all coincide is
    a pole and no seam.

    Parameters
    ----------
    surface : Surface
        Of a height field, whose heights do not show their position, only axes in ``closed`` are examined.
    closed : (bool, bool), optional
        The axes that may be merged; None: both.
    angle : (int, float), optional
        A channel, and the full turn by which its last row or column may differ from the first.
    room : Room
        Where arrays without their last column are allocated.

    Returns
    -------
    Surface
        The same surface when nothing repeats. Otherwise with ``seam`` in the metadata: "rows", "cols" or "both", or a
        list of these (or "") for several blocks; and ``turn``: [channel, number, axis], where a seam adds a full turn.
    """
    blocks, words, turn = [], [], []
    for block in surface.blocks:
        merged = [False, False]
        for axis in (0, 1):
            wanted = closed[axis] if closed is not None else block.points.ndim == 3
            if not wanted or block.closed[axis] or block.shape[axis] < _MIN_LINES_WITH_SEAM:
                continue
            by = _repeats(block, axis, angle)
            if by is not None:
                merged[axis] = True
                block = _without_last(block, axis, room)
                if angle is not None and by:
                    turn = [angle[0], by, axis]
        blocks.append(block)
        words.append(_WORDS.get((merged[0], merged[1]), ""))
    if not any(words):
        return surface
    metadata = {**surface.metadata, "seam": words[0] if len(words) == 1 else words}
    if turn:
        metadata["turn"] = turn
    return Surface(blocks=blocks, metadata=metadata)


def _repeats(block: Block, axis: int, angle: Turns | None) -> float | None:
    """Return the turn by which the last line differs from the first, 0 for none; None where it is no repetition."""
    valid = compared = np.ones(block.shape[1 - axis], np.bool_)
    if block.mask is not None:
        mask = np.moveaxis(block.mask, axis, 0)
        if not np.array_equal(mask[0], mask[-1]) or not mask[0].any():
            return None
        valid = compared = mask[0]
        if block.kept is not None:
            kept = np.moveaxis(block.kept, axis, 0)
            if not np.array_equal(kept[0], kept[-1]):
                return None
            compared = valid | kept[0]
    for array in block.attributes.values():
        lines = np.moveaxis(array, axis, 0)
        if lines[0][compared].tobytes() != lines[-1][compared].tobytes():
            return None
    points = np.moveaxis(block.points, axis, 0)
    first, last, turn = points[0], points[-1], 0.0
    if angle is not None and first.ndim == 2:
        channel, period = angle
        turn = float(np.sign(last[valid][0, channel] - first[valid][0, channel])) * period
        first = first.copy()
        with np.errstate(invalid="ignore"):  # of signalling NaN
            first[:, channel] += first.dtype.type(turn)
    if first[compared].tobytes() != last[compared].tobytes():
        return None
    first = first[valid]
    collapsed = first.ndim == 2 and len(first) > 1 and bool((first == first[0]).all())
    return None if collapsed else turn


def _without_last(block: Block, axis: int, room: Room) -> Block:
    """Return a block without its last row or column, closed along that axis."""

    def kept(array: NDArray[Any]) -> NDArray[Any]:
        """Return an array without its last row or column."""
        if axis == 0:
            return array[:-1]
        shorter = room.empty((array.shape[0], array.shape[1] - 1, *array.shape[2:]), array.dtype)
        for rows in rows_at_once(shorter.shape):
            shorter[rows] = array[rows, :-1]
        return shorter

    return Block(
        kept(block.points),
        (block.closed[0] or axis == 0, block.closed[1] or axis == 1),
        mask=None if block.mask is None else kept(block.mask),
        attributes={name: kept(array) for name, array in block.attributes.items()},
    )


def unwrap(surface: Surface, channel: int, period: float) -> Surface:
    """Add whole turns to a channel of angles, so that neighbours are within half a turn where they can be.

    Parameters
    ----------
    surface : Surface
        One block of planar points or xyz. If its type cannot hold the sums without rounding, the result is float64, and
        ``dtype`` in the metadata names the original type.
    channel : int
    period : float
        A full turn.

    Returns
    -------
    Surface
        The same surface when no angle jumps, or when subtracting the turns would not restore every bit; otherwise with
        ``angles`` in the metadata: a list of {"channel", "period", "low"}, where angles lie between low and
        low + period.
    """
    angles = surface.points[..., channel]
    valid = np.isfinite(angles) if surface.mask is None else surface.mask
    compared = valid if surface.blocks[0].kept is None else valid | surface.blocks[0].kept
    least, greatest = angles[valid].min(), angles[valid].max()
    # The angle of a hole is often known, and then connects its neighbours.
    known = valid | ((angles >= least) & (angles <= greatest))
    turns = _turns(np.where(known, angles, np.nan).astype(np.float64), period)
    if not turns.any():
        return surface
    low = float((least + (greatest - period)) / 2)
    for dtype in dict.fromkeys((surface.dtype, np.dtype(np.float64))):
        with np.errstate(invalid="ignore"):  # of signalling NaN
            points = surface.points.astype(dtype)
            points[..., channel] += (turns * period).astype(dtype)
            back = wrapped(points[..., channel], period, low).astype(surface.dtype)
        if back[compared].tobytes() == angles[compared].tobytes():
            break
    else:
        return surface
    metadata = {**surface.metadata, "angles": [{"channel": channel, "period": period, "low": low}]}
    if dtype != surface.dtype:
        metadata["dtype"] = surface.dtype.name
    return Surface(points, surface.closed, mask=surface.mask, attributes=surface.attributes, metadata=metadata)


def _turns(angles: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """Compute the whole turns to add, (H, W): along the first column, then along every row; holes are skipped."""
    filled = _filled(angles)
    smooth = np.unwrap(filled, period=period, axis=1)
    smooth += (np.unwrap(filled[:, 0], period=period) - filled[:, 0])[:, None]
    turns = np.rint((smooth - filled) / period)
    if _jumps(filled + turns * period, period) >= _jumps(filled, period):
        turns[:] = 0
    turns[np.isnan(angles)] = 0
    return turns


def _filled(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fill missing angles: from the point before in the row, else the first of the row, else the row before."""
    holes = np.isnan(angles)
    if not holes.any():
        return angles
    places = np.where(holes, 0, np.arange(angles.shape[1]))
    filled = np.take_along_axis(angles, np.maximum.accumulate(places, axis=1), axis=1)
    first = np.take_along_axis(angles, (~holes).argmax(axis=1)[:, None], axis=1)[:, 0]
    rows = np.where(np.isnan(first), 0, np.arange(len(first)))
    first = first[np.maximum.accumulate(rows)]
    first = np.where(np.isnan(first), angles[~holes][0], first)
    return np.where(np.isnan(filled), first[:, None], filled)


def _jumps(angles: NDArray[np.float64], period: float) -> int:
    """Count the neighbours that differ by more than half a turn."""
    return sum(int((np.abs(np.diff(angles, axis=axis)) > period / 2).sum()) for axis in (0, 1))


def wrapped(angles: NDArray[Any], period: float, low: float) -> NDArray[np.float64]:
    """Bring angles of any shape between low and low + period, by whole turns; keep NaN and infinities."""
    values = angles.astype(np.float64)
    with np.errstate(invalid="ignore"):
        values -= np.where(np.isfinite(values), period * np.floor((values - low) / period), 0.0)
    return values


def angles_of(metadata: Mapping[str, Any]) -> list[tuple[int, float, float]]:
    """Return channel, full turn and least value of each of the ``angles`` that metadata say were unwrapped.

    Raises
    ------
    InputError
        When the metadata say something else: a hostile container may say anything.
    """
    angles = metadata.get("angles") or ()
    try:
        numbers = [(angle["channel"], angle["period"], angle["low"]) for angle in angles]
        result = [(int(channel), float(period), float(low)) for channel, period, low in numbers]
    except (TypeError, ValueError, LookupError, OverflowError):
        result = [(-1, 0.0, 0.0)]
    if not all(channel >= 0 and 0 < period < math.inf and math.isfinite(low) for channel, period, low in result):
        raise InputError(f"expected angles of channel, period and low in the metadata, got {angles!a:.80}")
    return result


def restore(surface: Surface) -> Surface:
    """Restore repeated rows and columns, angles and type of a surface, and remove their entries in the metadata.

    The ``angles`` of a height field stay, because its coordinates are computed later.

    Raises
    ------
    InputError
        When the metadata name a type or angles that points cannot have, or no seam and turn.
    """
    metadata = dict(surface.metadata)
    heights = surface.blocks[0].points.ndim == 2
    angles, turn = ([], None) if heights else (angles_of(metadata), _turn_of(metadata))
    seam, _, dtype = (metadata.pop(key, None) for key in ("seam", "turn", "dtype"))
    if not heights:
        metadata.pop("angles", None)
        channels = surface.blocks[0].points.shape[2]
        if any(number >= channels for number, *_ in (*angles, *([turn] if turn else []))):
            raise InputError(f"expected angles of {channels} channels in the metadata, got another channel")
    if not angles and seam is None and dtype is None:
        return surface
    if dtype is not None and dtype not in DTYPES:
        # A hostile container may name any type, such as long strings, of which every point would be one.
        raise InputError(f"expected a type of points in the metadata, got {dtype!a:.80}")
    blocks, nodes = [], []
    for block, repeat in zip(surface.blocks, _repeated(surface), strict=True):
        points = block.points.copy() if angles else block.points
        for number, period, low in angles:
            points[..., number] = wrapped(points[..., number], period, low)
        points = points.astype(dtype or points.dtype, copy=False)
        points = _with_last(points, repeat, turn)
        attributes = {name: _with_last(array, repeat) for name, array in block.attributes.items()}
        mask = None if block.mask is None else _with_last(block.mask, repeat)
        closed = (block.closed[0] and not repeat[0], block.closed[1] and not repeat[1])
        blocks.append(Block(points, closed, mask=mask, attributes=attributes))
        rows, columns = (np.arange(length + again) % length for length, again in zip(block.shape, repeat, strict=True))
        nodes.append((rows, columns))
    restored = Surface(blocks=blocks, metadata=metadata)
    restored.joints = None if surface.joints is None else surface.joints.at(nodes)
    return restored


def shapes_in_files(surface: Surface) -> list[tuple[int, int]]:
    """Return rows and columns of each block, including those that `restore` repeats."""
    return [
        (block.shape[0] + rows, block.shape[1] + columns)
        for block, (rows, columns) in zip(surface.blocks, _repeated(surface), strict=True)
    ]


def _repeated(surface: Surface) -> list[Closed]:
    """Return for each block whether its first row and its first column are repeated at the end."""
    seam = surface.metadata.get("seam") or ()
    if not isinstance(seam, str | list | tuple):
        raise InputError(f"expected a seam of words in the metadata, got {seam!a:.80}")
    words = [seam] if isinstance(seam, str) else [*seam]
    words += [""] * (len(surface.blocks) - len(words))
    return [_AXES.get(str(word), (False, False)) for word in words[: len(surface.blocks)]]


def _turn_of(metadata: Mapping[str, Any]) -> tuple[int, float, int] | None:
    """Return channel, number and axis of the turn that a seam adds, if metadata say one."""
    turn = metadata.get("turn")
    if turn is None:
        return None
    try:
        channel, number, axis = turn
        result = (int(channel), float(number), int(axis))
    except (TypeError, ValueError, OverflowError):
        result = (-1, 0.0, 0)
    if result[0] < 0 or not math.isfinite(result[1]):
        raise InputError(f"expected a turn of channel, number and axis in the metadata, got {turn!a:.80}")
    return result


def _with_last(array: NDArray[Any], repeat: Closed, turn: tuple[int, float, int] | None = None) -> NDArray[Any]:
    """Repeat the first row or column of an array at the end, with the turn added if there is one."""
    for axis in (0, 1):
        if repeat[axis]:
            line = np.take(array, [0], axis=axis)
            if turn is not None and turn[2] == axis:
                line[..., turn[0]] += line.dtype.type(turn[1])
            array = np.concatenate((array, line), axis=axis)
    return array
