"""From coefficients to values: section 8 of docs/format.md."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .header import Header
from .levels import positions
from .lifting import details, inverse

Array = NDArray[np.int64]


def reconstruct(
    header: Header, channel: int, level: int, whole: int, coefficients: Callable[[int, int], list[Array]]
) -> list[Array]:
    """Reconstruct all grids of a channel.

    `header` (Header): of the container; `channel` (int): number of the channel; `level` (int): the level that is made,
    K; `whole` (int): the largest level up to which all coefficients are known, F, at most K; `coefficients` (callable):
    gives those of a tile and channel, one int64 array for each share. Returns list of int64 (rows, columns): q of each
    grid, in eighths if F < K; of an attribute's interfaces nothing of meaning.
    """
    grids, coordinate = header.grids, channel < header.coordinates
    arrays = [np.zeros(grid.shape(level), np.int64) for grid in grids]
    for number, tile in enumerate(header.tiles):
        if tile.level > level:
            break
        shares = tile.shares[not coordinate]
        for share, values in zip(shares, coefficients(number, channel) if shares else [], strict=True):
            if tile.level > whole:
                values = np.clip(8 * values, -(1 << 28), 1 << 28)
            arrays[share.grid][share.rows, share.columns] = values
    if coordinate:
        _copy_ends(header, arrays)
    for upper in range(1, level + 1):
        for number, (grid, array) in enumerate(zip(grids, arrays, strict=True)):
            if grid.interface and not coordinate:
                continue
            nodes = grid.shape(upper - 1)
            if upper == whole + 1:
                lower = array[: nodes[0], : nodes[1]]
                lower[:] = 8 * np.clip(lower, -(1 << 24), 1 << 24)
            if coordinate and not grid.interface:
                _details_of_sides(header, channel, upper, number, arrays)
            rows, columns = grid.shape(upper)
            for axis in (1, 0):
                if grid.stepped(upper, axis):
                    corner = array[:rows, :columns]
                    line = grid.axes[upper][axis]
                    pair = _pair(header, channel, upper, number, axis)
                    if axis:
                        corner[:] = inverse(np.ascontiguousarray(corner.T), line, pair).T
                    else:
                        corner[:] = inverse(corner, line, pair)
    return arrays


def _pair(header: Header, channel: int, upper: int, number: int, axis: int) -> tuple[int, int]:
    """Give (a, b) of a grid's step from a level to the one below."""
    grid = header.grids[number]
    if grid.axes[upper][axis].run < 24:
        return 16, 0
    return header.predictors[channel][upper - 1, 2 if grid.interface else axis]


def _copy_ends(header: Header, arrays: list[Array]) -> None:
    """Copy points of level 0 from ends that hold them, and from interfaces to the sides of patches."""
    grids = header.grids

    def place(end: tuple[int, int]) -> int:
        return grids[end[0]].shape(0)[0] - 1 if end[1] else 0

    for end, holder in sorted(header.holders.items()):
        arrays[end[0]][place(end), 0] = arrays[holder[0]][place(holder), 0]
    for number, patch in enumerate(header.patches, len(header.interfaces)):
        rows, columns = grids[number].shape(0)
        for side, source in enumerate(patch.interfaces):
            if source is not None:
                interface, turned = source
                points = arrays[interface][: grids[interface].shape(0)[0], 0]
                target = (0, rows - 1, 0, columns - 1)[side]
                line = points[::-1] if turned else points
                if side < 2:
                    arrays[number][target, :columns] = line
                else:
                    arrays[number][:rows, target] = line


def _details_of_sides(header: Header, channel: int, upper: int, number: int, arrays: list[Array]) -> None:
    """Compute the details along the sides of a patch that come from interfaces."""
    grid, array = header.grids[number], arrays[number]
    nodes, shape = grid.shape(upper - 1), grid.shape(upper)
    for side, source in enumerate(header.patches[number - len(header.interfaces)].interfaces):
        along = 1 if side < 2 else 0
        if source is None or not grid.stepped(upper, along):
            continue
        interface, turned = source
        found: Array | int = 0
        if header.interfaces[interface].length > 1:
            points = arrays[interface][: shape[along]]
            points = points[::-1] if turned else points
            found = details(points, grid.axes[upper][along], _pair(header, channel, upper, number, along))[:, 0]
        target = nodes[1 - along] - 1 if side & 1 else 0
        if along:
            array[target, nodes[1] : shape[1]] = found
        else:
            array[nodes[0] : shape[0], target] = found


def values_of(q: Array, eighths: bool, lattice: tuple[int, float, float], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Compute the values of a channel from its lattice coordinates, in its type."""
    rule, origin, step = lattice
    wide: NDArray[np.float64] = q.astype(np.float64) * (0.125 if eighths else 1.0)
    with np.errstate(over="ignore", divide="ignore"):
        wide = origin + step * wide if rule == 0 else (origin + wide) / step
    return to_type(wide, dtype)


def to_type(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Round float64 values to a type, ties to even, and clamp them to its finite range."""
    if dtype.kind == "f":
        most = float(np.finfo(dtype).max)
        clamped: NDArray[Any] = np.clip(values, -most, most).astype(dtype)
        return clamped
    limits = np.iinfo(dtype)
    whole = np.rint(values)
    # The highest value of 64 bits is no float64; what reaches it is put in by hand.
    inside = np.clip(
        whole, float(limits.min), np.nextafter(float(limits.max) + 1, 0) if limits.bits == 64 else limits.max
    )
    found: NDArray[Any] = inside.astype(dtype)
    found[whole >= float(limits.max)] = limits.max
    return found


def places(header: Header, block: int, level: int) -> tuple[list[NDArray[np.int64]], list[tuple[int, Any]]]:
    """Find where the nodes of a level stand in a block.

    Returns `lines` (list of int64): the block's rows, and columns, at which nodes stand; `patches` (list of (int,
    index)): number of each patch's grid, and where its nodes lie in the block's grid of the level.
    """
    sizes = header.blocks[block].rows, header.blocks[block].columns
    found = []
    for number, patch in enumerate(header.patches, len(header.interfaces)):
        if patch.block == block:
            stands = []
            for axis, size in enumerate(sizes):
                first, count = patch.window[axis]
                place = positions(header.grids[number], axis, level)
                place = count - 1 - place if patch.reverse[axis] else place
                stands.append((first + place) % size)
            found.append((number, stands))
    lines = [np.unique(np.concatenate([stands[axis] for _, stands in found])) for axis in (0, 1)]
    return lines, [
        (number, np.ix_(*(np.searchsorted(line, stand) for line, stand in zip(lines, stands, strict=True))))
        for number, stands in found
    ]


def plane_values(header: Header) -> list[NDArray[Any]]:
    """Compute x and y of a surface with a plane; (rows, columns) each, in the type of the points."""
    block = header.blocks[0]
    r, c = np.indices((block.rows, block.columns)).astype(np.float64)
    found = []
    for rule, p, n in zip(header.plane or [], (c, r), (block.columns, block.rows), strict=True):
        with np.errstate(all="ignore"):
            found.append(to_type(_evaluate(rule, p, n, r, c), header.types[0]))
    return found


def _evaluate(
    rule: list[Any], p: NDArray[np.float64], n: int, r: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.float64]:
    if rule[-1] == "values":
        return np.array(rule[:-1], np.float64)[p.astype(np.int64)]
    last = rule[-1]
    origin, step = float(rule[0]), float(rule[1])
    if last is False:
        return step * (p + 0.5) + origin
    if last is True:
        return np.where(p == n - 1, step, origin + p * ((step - origin) / np.float64(n - 1)))
    if len(rule) == 2:
        return origin + step * p
    if len(rule) == 3:
        return (origin + step * p) / float(last)
    return step * (c + float(last)) + float(rule[2]) * (r + float(last)) + origin
