"""Height fields: surfaces whose x and y follow a rule, so that only heights are stored.

A surface given as xyz with such an x and y is encoded as heights, and returned as xyz bit for bit.
In the metadata of a surface, ``grid`` holds the two rules of x and y where the surface was given as xyz. For heights
given with coordinates, ``axes`` is a map of the rules "x" and "y", of the "dtype" of the coordinates unless
that is float64, and of "rows": "x" where x runs along the rows. Without either, ``geotransform`` says where they lie.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface import Closed, Surface
from .coordinate_rules import VALUES, Rule, bits, evaluate, fit_axis, neighbours, plain, rounded
from .georeference import even_step, level_geotransform
from .seams import wrapped

__all__ = ["axes_at", "coordinates", "grid_at", "level_metadata", "to_heights", "to_xyz"]

_VALUES_PER_STRIP = 1 << 18

#: Metadata that give the position of heights.
_PLACEMENT_KEYS = ("grid", "axes", "geotransform", "nodes", "angles")


def to_heights(surface: Surface, exactly: bool = True) -> Surface | None:
    """Convert xyz over a regular lattice to heights.

    Parameters
    ----------
    surface : Surface
    exactly : bool
        The rules must also hold at the holes whose points are kept (`Block.kept`).

    Returns
    -------
    Surface or None
        Heights with ``grid`` in the metadata, from which `to_xyz` restores every value bit for bit; None where x and y
        follow no rule, or the surface is not one block of x, y, z with at least two rows and columns.
    """
    if len(surface.blocks) != 1 or surface.points.ndim != 3 or surface.points.shape[2] != 3 or min(surface.shape) < 2:
        return None
    mask, kept = surface.mask, surface.blocks[0].kept
    if mask is not None and kept is not None and exactly:
        mask = mask | kept
        if not np.isfinite(surface.points[..., :2][mask]).all():
            return None
    rules = []
    for channel in (0, 1):
        rule = _fit(surface.points[..., channel], mask, down=channel == 1)
        if rule is None:
            return None
        rules.append(rule)
    metadata = {**surface.metadata, "grid": rules}
    heights = surface.points[..., 2]
    return Surface(heights, surface.closed, mask=surface.mask, attributes=surface.attributes, metadata=metadata)


def to_xyz(surface: Surface, kept: NDArray[np.bool_] | None = None) -> Surface:
    """Add x and y to heights; return surfaces of other kinds unchanged.

    Parameters
    ----------
    surface : Surface
    kept : bool, shape (H, W), optional
        Holes that have x and y; by default those of infinite height.

    Returns
    -------
    Surface
        xyz in the type of the heights if it was given as xyz, otherwise in a type that also holds the coordinates
        (float64). Float coordinates of holes that are not kept are NaN. Metadata that give the position of heights are
        removed.
    """
    if len(surface.blocks) != 1 or surface.points.ndim != 2:
        return surface
    x, y = coordinates(surface)
    dtype = surface.dtype if "grid" in surface.metadata else np.result_type(x, y, surface.dtype)
    points = np.empty((*surface.shape, 3), dtype)
    for channel, values in enumerate((x, y, surface.points)):
        points[..., channel] = values
    if surface.mask is not None and dtype.kind == "f":
        kept = surface.blocks[0].kept if kept is None else kept
        points[~surface.mask if kept is None else ~(surface.mask | kept)] = np.nan
    metadata = {key: value for key, value in surface.metadata.items() if key not in ("grid", "axes", "nodes")}
    if metadata.pop("angles", None):
        metadata.pop("turn", None)
    return Surface(points, surface.closed, mask=surface.mask, attributes=surface.attributes, metadata=metadata)


def coordinates(surface: Surface, rows: slice | None = None) -> tuple[NDArray[Any], NDArray[Any]]:
    """Compute x and y of a height field, each of shape (H, W), or of the rows of a slice with start and stop.

    By the metadata's ``grid`` (then in the type of the heights), ``axes`` or ``geotransform`` (of the centres of the
    cells), else x is the column and y the row; at the places that ``nodes`` gives for a coarser level.

    Raises
    ------
    InputError
        When the metadata do not hold such rules.
    """
    try:
        return _coordinates(surface, slice(0, surface.shape[0]) if rows is None else rows)
    except InputError:
        raise
    except (TypeError, ValueError, LookupError, AttributeError, OverflowError):
        # Metadata of a hostile container may be anything.
        said = {key: surface.metadata[key] for key in _PLACEMENT_KEYS if key in surface.metadata}
        raise InputError(f"expected rules of coordinates in the metadata, got {str(said)[:80]!a}") from None


def _coordinates(surface: Surface, rows: slice) -> tuple[NDArray[Any], NDArray[Any]]:
    """Do what `coordinates` does, for a slice of rows and with other errors for malformed metadata."""
    metadata, shape = surface.metadata, surface.shape
    nodes = _nodes(metadata)
    row, column = (
        np.arange(n, dtype=np.float64) if at is None else np.asarray(at, np.float64)
        for n, at in zip(shape, nodes, strict=True)
    )
    dtype: np.dtype[Any] = np.dtype(np.float64)
    swapped = False
    if "grid" in metadata:
        rules, dtype = metadata["grid"], surface.dtype
    elif "axes" in metadata:
        rules, dtype, swapped = _axes(metadata["axes"])
    elif metadata.get("geotransform") is not None:
        rules = _geotransform_rules(metadata["geotransform"])
    else:
        rules = [[0, 1], [0, 1]]
        dtype = np.dtype(np.int64) if not any(nodes) else dtype
    planes = []
    for channel, rule in enumerate(rules):
        try:
            at = row if rule[-1] is True else row[rows]  # this rule depends on the number of places
            values = evaluate(rule, at[:, None], column[None, :], down=(channel == 1) != swapped)
            values = values[rows] if at is row and len(values) == len(row) else values
        except (TypeError, ValueError, IndexError):
            raise InputError(f"expected two rules of coordinates in the metadata, got {str(rules)[:80]}") from None
        for angle in metadata.get("angles", ()):
            if angle["channel"] == channel:
                values = wrapped(values, angle["period"], angle["low"])
        planes.append(np.broadcast_to(rounded(values, dtype), (rows.stop - rows.start, shape[1])))
    return planes[0], planes[1]


def _nodes(metadata: Mapping[str, Any]) -> Any:
    """Return the places of rows and of columns; None for 0, 1, 2, ..."""
    return metadata.get("nodes") or [None, None]


def _axes(axes: Any) -> tuple[list[Rule], np.dtype[Any], bool]:
    """Return the two rules, the type of coordinates, and whether x runs along the rows."""
    try:
        return [axes["x"], axes["y"]], np.dtype(axes.get("dtype", "float64")), axes.get("rows") == "x"
    except (TypeError, KeyError, AttributeError):
        raise InputError(f"expected axes of x and y in the metadata, got {str(axes)[:80]}") from None


def _geotransform_rules(transform: Any) -> list[Rule]:
    """Return the rules of x and y of a geotransform."""
    try:
        x0, x_column, x_row, y0, y_column, y_row = map(float, transform)
    except (TypeError, ValueError):
        raise InputError(f"expected a geotransform of six numbers in the metadata, got {transform!r}") from None
    return [[x0, x_column, x_row, 0.5], [y0, y_column, y_row, 0.5]]


def _fit(plane: NDArray[Any], mask: NDArray[np.bool_] | None, down: bool) -> Rule | None:
    """Find the rule of one coordinate, (H, W); ``down``: it is y, whose short rules run along the rows."""
    for axis in (0, 1) if down else (1, 0):
        line, known = _profile(plane, mask, axis)
        if line is None:
            continue
        rule = fit_axis(line, known)
        if rule is None:
            continue
        if axis == (0 if down else 1):
            return rule
        shift = 0.5 if rule[-1] is False else 0
        if len(rule) == 3 and not shift:
            continue
        rule = [rule[0], rule[1], 0, shift] if axis == 1 else [rule[0], 0, rule[1], shift]
        return rule if _holds(rule, plane, mask, down) else None
    return _fit_plane(plane, mask, down)


def _profile(
    plane: NDArray[Any], mask: NDArray[np.bool_] | None, axis: int
) -> tuple[NDArray[Any] | None, NDArray[np.bool_]]:
    """Return the values along an axis if they are constant along the other, and which of them are known."""
    lines = plane if axis == 1 else plane.T
    if mask is None:
        line = lines[0]
        return (line if _same(lines, line) else None), np.ones(len(line), np.bool_)
    valid = mask if axis == 1 else mask.T
    line = lines[valid.argmax(axis=0), np.arange(lines.shape[1])]
    return (line if _same(lines, line, valid) else None), np.asarray(valid.any(axis=0))


def _same(lines: NDArray[Any], line: NDArray[Any], valid: NDArray[np.bool_] | None = None) -> bool:
    """Return whether all lines equal one line bit for bit, where valid."""
    height = max(1, _VALUES_PER_STRIP // lines.shape[1])
    wanted = bits(line)
    for start in range(0, len(lines), height):
        equal: NDArray[np.bool_] = bits(lines[start : start + height]) == wanted
        if valid is not None:
            equal |= ~valid[start : start + height]
        if not equal.all():
            return False
    return True


def _holds(rule: Rule, plane: NDArray[Any], mask: NDArray[np.bool_] | None, down: bool) -> bool:
    """Return whether a rule gives a plane, (H, W), bit for bit, where valid."""
    rows, width = plane.shape
    height = max(1, _VALUES_PER_STRIP // width)
    column = np.arange(width, dtype=np.float64)[None, :]
    for start in range(0, rows, height):
        row = np.arange(start, min(start + height, rows), dtype=np.float64)[:, None]
        evaluated = np.broadcast_to(rounded(evaluate(rule, row, column, down), plane.dtype), (len(row), width))
        equal: NDArray[np.bool_] = bits(evaluated) == bits(plane[start : start + height])
        if mask is not None:
            equal |= ~mask[start : start + height]
        if not equal.all():
            return False
    return True


def _fit_plane(plane: NDArray[Any], mask: NDArray[np.bool_] | None, down: bool) -> Rule | None:
    """Find the rule of a coordinate that varies along both axes, as in a rotated lattice."""
    if mask is not None and not mask[[0, 0, -1], [0, -1, 0]].all():
        return None
    origin, right, below = (float(plane[i, j]) for i, j in ((0, 0), (0, -1), (-1, 0)))
    rows, width = plane.shape
    across, by_row = (right - origin) / (width - 1), (below - origin) / (rows - 1)
    spread = abs(across) + abs(by_row)
    if not 0 < spread < np.inf or not np.isfinite(origin):
        return None
    with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN becomes a quiet one
        values = plane.astype(np.float64)
        near = values - (origin + across * np.arange(width) + by_row * np.arange(rows)[:, None])
    if np.nanmax(np.abs(near)) > spread:
        return None
    for step_across in neighbours(across)[:7]:
        for step_down in neighbours(by_row)[:7]:
            for shift in (0.0, 0.5):
                for start in neighbours(origin - shift * (step_across + step_down))[:7]:
                    rule = [start, step_across, step_down, shift]
                    corner = plane[:8, :8], None if mask is None else mask[:8, :8]
                    if _holds(rule, *corner, down) and _holds(rule, plane, mask, down):
                        return [plain(number) for number in rule]
    return None


def level_metadata(
    metadata: Mapping[str, Any], shape: tuple[int, int], closed: Closed, places: Sequence[NDArray[np.int64]]
) -> dict[str, Any]:
    """Return the metadata of a coarser level of heights, whose nodes lie at places of the full grid.

    Parameters
    ----------
    metadata : mapping
        Metadata of the whole surface.
    shape : (int, int)
        Of the full grid.
    closed : (bool, bool)
    places : two int64 arrays, shape (row,) and (column,)
        The rows and columns of the full grid at which the nodes lie, ascending.

    Returns
    -------
    dict
        Without ``seam`` and ``turn``, which do not apply to a level's grid. ``axes`` have the coordinates of the
        nodes; without them ``geotransform`` is that of the level's even grid. Where the nodes are not evenly spaced,
        since an axis had a gap, ``nodes`` has the places of rows and of columns in steps of that grid, or None for an
        even axis; a geotransform beside ``axes`` is then left out.
    """
    result = {key: value for key, value in metadata.items() if key not in ("seam", "turn", "nodes")}
    transform, nodes = metadata.get("geotransform"), []
    for length, wraps, at, before in zip(shape, closed, places, _nodes(metadata), strict=True):
        line = at if before is None else np.asarray(before, np.float64)[at]
        step = even_step(length, len(at), wraps)
        nodes.append(None if np.array_equal(line, step * np.arange(len(at))) else (line / step).tolist())
    if "axes" in metadata:
        result["axes"] = axes_at(metadata["axes"], shape, places, closed)
        result.pop("geotransform", None)
        if any(nodes) or transform is None:
            return result
    result["geotransform"] = level_geotransform(transform, shape, (len(places[0]), len(places[1])), closed)
    if any(nodes):
        result["nodes"] = nodes
    return result


def grid_at(rules: Sequence[Rule], shape: tuple[int, int], places: Sequence[NDArray[np.int64]]) -> dict[str, Any]:
    """Return metadata that give heights at some rows and columns of a grid their x and y, see `coordinates`.

    Parameters
    ----------
    rules : two rules, of x and of y
    shape : (int, int)
        Rows and columns of the grid.
    places : two int64 arrays, shape (row,) and (column,)
        The chosen rows and columns of the grid.
    """
    anywhere = []
    for rule, length, down in zip(rules, (shape[1], shape[0]), (False, True), strict=True):
        # A rule with ``last`` refers to the last place of the grid, so its values are listed.
        anywhere.append(_listed(rule, length, np.arange(length), down) if rule[-1] is True else rule)
    return {"grid": anywhere, "nodes": [line.tolist() for line in places]}


def axes_at(
    axes: Any, shape: tuple[int, int], places: Sequence[NDArray[np.int64]], closed: Closed = (False, False)
) -> dict[str, Any]:
    """Return the ``axes`` of some rows and columns of a grid, with the same coordinates bit for bit.

    Parameters
    ----------
    axes : mapping
        Axes of the grid.
    shape : (int, int)
        Rows and columns of the grid.
    places : two int64 arrays, shape (row,) and (column,)
        The chosen rows and columns of the grid. Along a closed axis they may continue after its end, where the
        coordinates of the first places follow, one turn further. A list with one number more than the axis has places
        gives the step across the seam; otherwise this is as long as the step before it.
    closed : (bool, bool)
        Axes along which the places are closed: a list with a number for the next turn keeps such a number.

    Raises
    ------
    InputError
        When ``axes`` are malformed.
    """
    rules, _, swapped = _axes(axes)
    result = dict(axes)
    for name, rule, down in (("x", rules[0], swapped), ("y", rules[1], not swapped)):
        axis = 0 if down else 1
        length, line = shape[axis], places[axis]
        if closed[axis] and _has_turn(rule, length):
            line = np.append(line, line[0] + length)
        result[name] = _thinned(rule, length, line, down) or _listed(rule, length, line, down)
    return result


def _listed(rule: Rule, length: int, places: NDArray[np.int64], down: bool) -> Rule:
    """Return the values of a rule at some places of its axis as a rule that lists them."""
    axis, still = np.arange(length, dtype=np.float64), np.zeros((1, 1))
    line = axis[:, None] if down else axis[None, :]
    values = evaluate(rule, line if down else still, still if down else line, down)
    values = np.broadcast_to(values, line.shape).ravel()
    listed, beyond = values[places % length], places >= length
    if beyond.any():
        after = float(rule[length]) if _has_turn(rule, length) else 2 * values[-1] - values[-2]
        listed[beyond] += after - values[0]
    return [*listed.tolist(), VALUES]


def _has_turn(rule: Rule, length: int) -> bool:
    """Return whether a rule of a closed axis of this length lists the first number again, one turn further."""
    return rule[-1] == VALUES and len(rule) - 1 > length


def _thinned(rule: Rule, length: int, places: NDArray[np.int64], down: bool) -> Rule | None:
    """Return the rule at every so many places of an axis from the first on; None where places or rule are others.

    Rules avoid lists of values that are too long for metadata. The step between nodes is a power of two, so that
    multiplication by it is exact.
    """
    step = int(places[1]) if len(places) > 1 else 1
    if step & (step - 1) or rule[-1] == VALUES or not np.array_equal(places, step * np.arange(len(places))):
        return None
    if rule[-1] is True:
        return rule if places[-1] == length - 1 else None
    if rule[-1] is False:
        rule = [rule[0], *([0, rule[1]] if down else [rule[1], 0]), 0.5]
    if len(rule) == 4:
        origin, across, by_row, shift = rule
        return [origin, across * step, by_row * step, shift / step]
    return [rule[0], rule[1] * step, *rule[2:]]
