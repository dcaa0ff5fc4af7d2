"""Draw surfaces: heights as a shaded map, others in space; with matplotlib, which no server needs."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.height_fields import coordinates, to_heights
from ..errors import InputError
from ..surface import Block, Surface

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "DPI",
    "RELIEF",
    "SMALL",
    "draw_surface",
    "is_height_field",
    "pixels_of",
    "points_in_space",
    "points_of_map",
    "small_png",
]

#: Pixels of an inch.
DPI = 100

#: Pixels of a small picture, along the longer side.
SMALL = 320

#: Height of the relief of a map for its shading, in widths of the surface.
RELIEF = 0.15

_COLOURS = "terrain"  # the colour map of heights
_LIGHT = 315, 45  # azimuth and altitude in degrees: north-west, as maps have it
_FLAT = 1e-300  # heights that differ by no more have no relief, and no factor would give them one
_DEGREES = 360.0  # of a full turn
_OTHER_UNIT = 10  # so many times higher than wide are points of x, y, z whose z has another unit
_FITTED = 0.2  # height of these, in widths of the surface


def draw_surface(figure: Figure, surface: Surface, pixels: int) -> None:
    """Draw a surface into an empty figure.

    Parameters
    ----------
    figure : matplotlib Figure
        Its size is set.
    surface : Surface
    pixels : int
        Of the longer side of a height field. In space there are a quarter as many nodes along an axis, since matplotlib
        draws each quad as a polygon.
    """
    if is_height_field(surface):
        _heights(figure, _as_map(surface), pixels)
    else:
        _in_space(figure, surface, pixels)


def pixels_of(surface: Surface, pixels: int) -> NDArray[np.uint8]:
    """Return the colours of a surface as `draw_surface` draws it, without title and legend.

    Parameters
    ----------
    surface : Surface
    pixels : int
        As in `draw_surface`.

    Returns
    -------
    ndarray of uint8, shape (row, column, 4)
        Red, green, blue and alpha (sRGB); alpha is 0 where nothing is drawn. A pixel is a node of a height field.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if is_height_field(surface):
        # A picture has no more pixels than this, whatever the surface has.
        block = _thinned(_as_map(surface), pixels)
        return np.asarray(np.rint(255 * _shaded(_valid(block.points.astype(np.float64), block.mask))), np.uint8)
    figure = Figure(layout="constrained", dpi=DPI, facecolor="none")
    canvas: Any = FigureCanvasAgg(figure)
    _in_space(figure, surface, pixels)
    figure.axes[0].patch.set_visible(False)  # axes in space paint their background even if they are off
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()


def is_height_field(surface: Surface) -> bool:
    """Return whether a surface is drawn as a shaded map: one block of heights."""
    return len(surface.blocks) == 1 and surface.blocks[0].points.ndim == 2


def small_png(surface: Surface) -> bytes | None:
    """Return a small picture of a surface as PNG; None where matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return None
    figure = Figure(layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    if is_height_field(surface):
        surface = Surface(blocks=[_as_map(surface)])
    blocks = [_thinned(block, SMALL) for block in surface.blocks]
    angles: dict[str, Any] = {key: surface.metadata[key] for key in ("angles", "turn") if key in surface.metadata}
    draw_surface(figure, Surface(blocks=blocks, metadata=angles), SMALL)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _as_map(surface: Surface) -> Block:
    """Return the heights of a surface with north at the top, if its metadata give their position."""
    block = surface.blocks[0]
    metadata = surface.metadata
    if not any(metadata.get(key) is not None for key in ("grid", "axes", "geotransform")):
        return block
    try:
        x, y = (np.asarray(values, np.float64) for values in coordinates(surface))
    except InputError:
        return block  # a picture does not fail for its metadata
    points, mask = block.points, block.mask
    if isinstance(axes := metadata.get("axes"), dict) and axes.get("rows") == "x":
        points, x, y = points.T, x.T, y.T
        mask = None if mask is None else mask.T
    # Most steps count, since longitudes may begin again on the way.
    down = slice(None, None, -1 if np.median(np.sign(np.diff(y[:, :1], axis=0))) > 0 else 1) if len(y) > 1 else ...
    across = slice(None, None, -1 if np.median(np.sign(np.diff(x[:1], axis=1))) < 0 else 1) if x.shape[1] > 1 else ...
    points = points[down][:, across]
    return Block(points, mask=None if mask is None else mask[down][:, across])


def _thinned(block: Block, pixels: int) -> Block:
    """Return a block with fewer rows and columns, if it has more than a picture of so many pixels shows."""
    rows, columns = (slice(None, None, max(1, length // pixels)) for length in block.shape)
    mask = None if block.mask is None else block.mask[rows, columns]
    if mask is not None and not mask.any():
        return block
    return Block(block.points[rows, columns], block.closed, mask=mask)


def _heights(figure: Figure, block: Block, pixels: int) -> None:
    heights = _valid(block.points.astype(np.float64), block.mask)
    rows, columns = heights.shape
    scale = pixels / max(rows, columns)
    figure.set_size_inches(max(columns * scale, 300) / DPI + 1.5, max(rows * scale, 200) / DPI + 0.7)
    axes = figure.add_subplot()
    low, high = _range(heights)
    image = axes.imshow(heights, cmap=_COLOURS, vmin=low, vmax=high)
    if min(rows, columns) > 1:
        axes.imshow(_shaded(heights))
    axes.set_axis_off()
    figure.colorbar(image, ax=axes, shrink=0.8)


def _range(heights: NDArray[np.float64]) -> tuple[float, float]:
    return (float(np.nanmin(heights)), float(np.nanmax(heights))) if heights.size else (0.0, 1.0)


def _shaded(heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours of heights, (row, column, rgba) from 0 to 1; in a single row or column they are not shaded."""
    import matplotlib
    from matplotlib.colors import LightSource, Normalize

    low, high = _range(heights)
    height = high - low
    colours = matplotlib.colormaps[_COLOURS]
    known = np.nan_to_num(heights, nan=low)
    if min(heights.shape) > 1:
        rise = RELIEF * max(heights.shape) / height if height > _FLAT else 0.0
        shaded = LightSource(*_LIGHT).shade(known, colours, blend_mode="soft", vmin=low, vmax=high, vert_exag=rise)
    else:
        shaded = colours(Normalize(low, high)(known))
    shaded[..., 3] = np.isfinite(heights)
    return np.asarray(shaded, np.float64)


def _in_space(figure: Figure, surface: Surface, pixels: int) -> None:
    figure.set_size_inches(0.8 * pixels / DPI, 0.8 * pixels / DPI)
    most = pixels // 4
    axes: Any = figure.add_subplot(projection="3d")
    for points in points_in_space(surface):
        strides = [max(1, -(-count // most)) for count in points.shape[:2]]
        if min(points.shape[:2]) == 1:
            axes.plot(*points.reshape(-1, 3).T, color="#3b6ea5")
        else:
            x, y, z = np.moveaxis(points, 2, 0)
            axes.plot_surface(x, y, z, rstride=strides[0], cstride=strides[1], color="#8fb3d9", linewidth=0)
    axes.set_aspect("equal")
    axes.set_axis_off()


def points_in_space(surface: Surface) -> Iterator[NDArray[np.float64]]:
    """Yield the points of each block as they are drawn in space.

    Yields
    ------
    ndarray of float64, shape (row, column, xyz)
        Closed axes have their first points again at the end, so there is a row or a column more. NaN in holes, and
        where an angle jumps. Heights that have another unit than x and y are lower or higher.
    """
    periods, lift = _periods(surface.metadata), _lift(surface)
    for block in surface.blocks:
        points = _placed(_valid(block.points.astype(np.float64), block.mask))
        points = _without_jumps(_wrapped(points, block.closed, periods), periods)
        points[..., 2] *= lift
        yield points


def points_of_map(surface: Surface) -> NDArray[np.float64]:
    """Return the points of a height field as they are drawn as a map, north at the top if that is known.

    Returns
    -------
    ndarray of float64, shape (row, column, xyz)
        x grows to the right by 1 with each column, y upwards; NaN in holes.
    """
    block = _as_map(surface)
    return _placed(_valid(block.points.astype(np.float64), block.mask))


def _valid(points: NDArray[np.float64], mask: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """Return points (row, column, ...) with NaN in holes."""
    if mask is not None:
        points[~mask] = np.nan
    points[~np.isfinite(points)] = np.nan
    return points


def _placed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (row, column, xyz) from heights (row, column), points in a plane, or points in space."""
    if points.ndim == 2:
        rows, columns = np.indices(points.shape, np.float64)
        return np.stack([columns, -rows, points], axis=2)
    if points.shape[2] < 3:
        padding = np.zeros((*points.shape[:2], 3 - points.shape[2]))
        return np.concatenate([points, padding], axis=2)
    return points[..., :3]


def _wrapped(
    points: NDArray[np.float64], closed: tuple[bool, bool], periods: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return points (row, column, xyz) with the first ones of closed axes repeated; angles continue by a full turn."""
    for axis in (0, 1):
        if not closed[axis]:
            continue
        length = points.shape[axis]
        first, last = np.take(points, [0], axis), np.take(points, [length - 1], axis)
        around = (last - first) * (length / max(length - 1, 1))
        for channel, period in enumerate(periods):
            if period:
                turns = np.rint(around[..., channel] / period)
                first[..., channel] += period * np.where(np.isfinite(turns), turns, 0)
        if not any(periods):
            _go_on(points, first, around, axis)
        points = np.concatenate([points, first], axis)
    return points


def _go_on(points: NDArray[np.float64], first: NDArray[np.float64], around: NDArray[np.float64], axis: int) -> None:
    """Add a full turn to x or y of `first`, if they continue like this along an axis; around: (row, column, xyz)."""
    steps = np.diff(points, axis=axis)
    for channel in (0, 1):
        turns = around[..., channel]
        known = np.isfinite(turns)
        with np.errstate(invalid="ignore"):
            even = known & (np.abs(np.abs(turns) - _DEGREES) <= _DEGREES / points.shape[axis])
            even &= ~(steps[..., channel] * turns <= 0).any(axis=axis, keepdims=True)
        if 2 * even.sum() > known.sum():
            first[..., channel] += _DEGREES * np.sign(np.median(turns[even]))


def _periods(metadata: dict[str, Any]) -> tuple[float, float, float]:
    """Return the full turns of x, y and z; 0 for a coordinate that is no angle."""
    periods = [0.0, 0.0, 0.0]
    angles = metadata.get("angles")
    entries = [(angle.get("channel"), angle.get("period")) for angle in angles or () if isinstance(angle, dict)]
    turn = metadata.get("turn")
    if isinstance(turn, (list, tuple)) and len(turn) == 3:
        entries.append((turn[0], turn[1]))
    for channel, period in entries:
        if isinstance(period, (int, float)) and channel in (0, 1, 2):
            periods[channel] = abs(float(period))
    return periods[0], periods[1], periods[2]


def _without_jumps(points: NDArray[np.float64], periods: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return points with NaN where an angle changes by more than half a turn from the row or column before."""
    for channel, period in enumerate(periods):
        if not period:
            continue
        values = points[..., channel].copy()
        with np.errstate(invalid="ignore"):
            points[1:][np.abs(np.diff(values, axis=0)) > period / 2] = np.nan
            points[:, 1:][np.abs(np.diff(values, axis=1)) > period / 2] = np.nan
    return points


def _lift(surface: Surface) -> float:
    """Return the factor of z: not 1 if z has another unit than x and y, so that the relief can be seen."""
    boxes = [_box(_placed(_valid(block.points.astype(np.float64), block.mask))) for block in surface.blocks]
    low = np.nanmin([box[0] for box in boxes], axis=0)
    high = np.nanmax([box[1] for box in boxes], axis=0)
    width, height = float(max(high[:2] - low[:2])), float(high[2] - low[2])
    # Heights that range over more than x and y have another unit than these; z of other points has from ten times on.
    heights = all(block.points.ndim == 2 for block in surface.blocks) or to_heights(surface, exactly=False) is not None
    return _FITTED * width / height if width > 0 and height > width * (1 if heights else _OTHER_UNIT) else 1.0


def _box(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    known = points.reshape(-1, 3)
    known = known[np.isfinite(known).all(axis=1)]
    if not len(known):
        return np.full(3, np.nan), np.full(3, np.nan)
    return known.min(axis=0), known.max(axis=0)
