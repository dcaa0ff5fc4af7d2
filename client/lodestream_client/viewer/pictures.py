"""``lodestream view --png``: what a receiver sees after so many bytes, drawn without a browser. Needs matplotlib."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.container import read_index
from lodestream.container.capacity import Capacity
from lodestream.decoding.decoder import Decoder
from lodestream.errors import UnavailableError
from lodestream.interop.pictures import DPI, draw_surface
from lodestream.planning.planner import plan
from lodestream.target import Target

from ..terminal.output import human_size, replacing
from .sources import Source, read_fully

if TYPE_CHECKING:
    from lodestream.decoding.view import View
    from lodestream.grid.layout import Layout

__all__ = ["draw", "least_size", "view_after"]

_PIXELS = 1000  # along the longer side of a height field


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
    read = partial(read_fully, source)
    decoder = Decoder(max_vertices=max_vertices)
    index = read_index(read, source.size, Capacity(decoder.capacity.max_vertices))
    chosen = plan(index, Target(max_bytes=most))
    for place in (*chosen.before, index.metadata, *chosen.ranges):
        decoder.feed_at(place.offset, read(place.offset, place.length))
    return decoder.view(), index.header.layout


def least_size(source: Source, max_vertices: int | None = None) -> int:
    """Bytes that the first picture of a container takes; the parameters are those of `view_after`."""
    decoder = Decoder(max_vertices=max_vertices)
    index = read_index(partial(read_fully, source), source.size, Capacity(decoder.capacity.max_vertices))
    return index.layers[0].end


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
    figure = Figure(layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    draw_surface(figure, view.surface(_level(layout)), _PIXELS)
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
