"""``lodestream view --png``: what a receiver sees after so many bytes, drawn without a browser. Needs matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodestream.container import read_index
from lodestream.container.capacity import Capacity
from lodestream.decoding.decoder import Decoder
from lodestream.errors import UnavailableError
from lodestream.planning.planner import plan
from lodestream.surface import Block, Surface
from lodestream.target import Target

from ..terminal.output import human_size, replacing
from .sources import Source

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lodestream.decoding.view import View
    from lodestream.grid.layout import Layout

__all__ = ["draw", "view_after"]

_PIXELS = 1000  # along the longer side of a height field
_NODES_3D = 250  # along an axis of a surface in space: matplotlib draws each quad as a polygon
_DPI = 100
_LIGHT = 315, 45  # azimuth and altitude in degrees: north-west, as maps have it
_RELIEF = 0.15  # height of the relief for its shading, in widths of the surface


def view_after(source: Source, most: int | None, max_vertices: int | None = None) -> tuple[View, Layout]:
    """What a stream of a container shows after at most so many bytes.

    Parameters
    ----------
    source : Source
    most : int or None
        Bytes; None: all.
    max_vertices : int or None
        Limit on the memory of the surface, see `lodestream.Decoder`.

    Returns
    -------
    (View, Layout)
        What is shown, and the shapes of its levels.

    Raises
    ------
    OptionError
        If the first layer takes more bytes.
    StreamError, TooLargeError
        If the container is damaged or too large.
    """

    def read(offset: int, length: int) -> bytes:
        run = bytearray()
        while len(run) < length:
            run += source.read(offset + len(run), length - len(run))
        return bytes(run)

    decoder = Decoder(max_vertices=max_vertices)
    index = read_index(read, source.size, Capacity(decoder.capacity.max_vertices))
    chosen = plan(index, Target(max_bytes=most))
    for place in (*chosen.before, *chosen.ranges):
        decoder.feed_at(place.offset, read(place.offset, place.length))
    return decoder.view(), index.header.layout


def draw(view: View, layout: Layout, name: str, path: Path) -> None:
    """Write a picture of a view, with its bytes and its errors above it.

    Parameters
    ----------
    view : View
    layout : Layout
        Of the surface.
    name : str
        Of the surface.
    path : Path
        PNG to write.

    Raises
    ------
    UnavailableError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise UnavailableError("pictures need matplotlib: pip install 'lodestream[plot]'") from None
    surface = view.surface(_level(layout))
    flat = len(surface.blocks) == 1 and surface.blocks[0].points.ndim == 2
    figure = Figure(layout="constrained", dpi=_DPI)
    FigureCanvasAgg(figure)
    if flat:
        _heights(figure, surface.blocks[0])
    else:
        _in_space(figure, surface)
    exact = "exact" if view.complete and view.rms == 0 else f"RMS error {view.rms:.3g}, maximum {view.max_error:.3g}"
    figure.suptitle(f"{name}\n{human_size(view.bytes)}, {exact}", fontsize=11)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def _level(layout: Layout) -> int | None:
    """The coarsest level with enough nodes for the picture; None: the finest."""
    for level in range(layout.levels):
        shapes = [layout.shape(grid, level) for grid in range(len(layout.grids))]
        if max(max(shape) for shape in shapes) >= _PIXELS:
            return level
    return None


#: Heights that differ by no more have no relief, and no factor would give them one.
_FLAT = 1e-300


def _heights(figure: Figure, block: Block) -> None:
    from matplotlib.colors import LightSource

    heights = _valid(block.points.astype(np.float64), block.mask)
    rows, columns = heights.shape
    scale = _PIXELS / max(rows, columns)
    figure.set_size_inches(max(columns * scale, 300) / _DPI + 1.5, max(rows * scale, 200) / _DPI + 0.7)
    axes = figure.add_subplot()
    low, high = (float(edge) for edge in (np.nanmin(heights), np.nanmax(heights))) if heights.size else (0.0, 1.0)
    height = high - low
    image = axes.imshow(heights, cmap="terrain", vmin=low, vmax=high)
    if min(rows, columns) > 1:
        shaded = LightSource(*_LIGHT).shade(
            np.nan_to_num(heights, nan=low),
            image.cmap,
            blend_mode="soft",
            vmin=low,
            vmax=high,
            vert_exag=_RELIEF * max(rows, columns) / height if height > _FLAT else 0.0,
        )
        shaded[..., 3] = np.isfinite(heights)
        axes.imshow(shaded)
    axes.set_axis_off()
    figure.colorbar(image, ax=axes, shrink=0.8)


def _in_space(figure: Figure, surface: Surface) -> None:
    figure.set_size_inches(8, 8)
    axes: Any = figure.add_subplot(projection="3d")
    for block in surface.blocks:
        points = _placed(_valid(block.points.astype(np.float64), block.mask))
        points = _wrapped(points, block.closed)
        every = [max(1, -(-count // _NODES_3D)) for count in points.shape[:2]]
        if min(points.shape[:2]) == 1:
            axes.plot(*points.reshape(-1, 3).T, color="#3b6ea5")
        else:
            x, y, z = np.moveaxis(points, 2, 0)
            axes.plot_surface(x, y, z, rstride=every[0], cstride=every[1], color="#8fb3d9", linewidth=0)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _valid(points: NDArray[np.float64], mask: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """Points (row, column, ...) with NaN in holes."""
    if mask is not None:
        points[~mask] = np.nan
    points[~np.isfinite(points)] = np.nan
    return points


def _placed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (row, column, xyz) of heights (row, column), of points in a plane, or of points in space."""
    if points.ndim == 2:
        rows, columns = np.indices(points.shape, np.float64)
        return np.stack([columns, -rows, points], axis=2)
    if points.shape[2] < 3:
        padding = np.zeros((*points.shape[:2], 3 - points.shape[2]))
        return np.concatenate([points, padding], axis=2)
    return points[..., :3]


def _wrapped(points: NDArray[np.float64], closed: tuple[bool, bool]) -> NDArray[np.float64]:
    for axis in (0, 1):
        if closed[axis]:
            points = np.concatenate([points, np.take(points, [0], axis)], axis)
    return points
