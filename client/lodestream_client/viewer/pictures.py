"""``lodestream view --png``: what a receiver sees after so many bytes, drawn without a browser. Needs matplotlib."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import UnavailableError
from lodestream.interop.pictures import DPI, draw_surface, is_height_field, pixels_of
from lodestream.planning.plan import Mark
from lodestream.planning.planner import plan
from lodestream.surface import Block, Surface
from lodestream.target import Region, Target
from lodestream.text import is_remeshed, printable

from ..terminal.output import human_size, replacing
from .picture_change import DONE, Judge, Stage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from lodestream.decoding.view import View
    from lodestream.grid.layout import Layout
    from lodestream.opening.container import Container

__all__ = [
    "Picture",
    "layers_of",
    "least_size",
    "require_matplotlib",
    "view_after",
    "view_when_done",
    "write_png",
]

_PIXELS = 1000  # along the longer side of a height field
_THINNED = 2  # levels by which a surface in space is drawn coarser, since it has a quarter as many nodes along an axis
_LONGEST = 100  # characters of a name


def view_after(container: Container, most: int | None, region: Region | None = None) -> tuple[View, Layout | None]:
    """Return the view of a container, or of a window of it, after at most so many bytes of its stream.

    Parameters
    ----------
    container : Container
    most : int or None
        Bytes; None: all.
    region : ((int, int), (int, int)), optional
        The window.

    Returns
    -------
    (View, Layout or None)
        What is shown, and the shapes of its levels; None of a window.

    Raises
    ------
    OptionError
        If the first layer takes more bytes, or there is no such window.
    StreamError, TooLargeError
        If the container is damaged or too large.
    """
    view = container.view_at(Target(max_bytes=most, region=region))
    return view, container.header.layout if region is None else None


def view_when_done(container: Container, name: str) -> tuple[View, Picture, float]:
    """Read a container layer by layer until its picture looks done.

    Parameters
    ----------
    container : Container
    name : str
        Of the surface.

    Returns
    -------
    (View, Picture, float)
        The state, its picture, and the share of its pixels that is expected to change visibly after it; 0 at the end.
    """
    layout = container.header.layout
    judge = Judge(layers_of(container))
    for view in container:
        if view.complete:
            break
        picture = Picture.of(view, layout, name)
        share = judge.remaining(picture.stage, picture.pixels())
        if share < DONE:
            return view, picture, share
    return view, Picture.of(view, layout, name), 0.0


def layers_of(container: Container) -> tuple[Mark, ...]:
    """Return the states of a whole container in order: its layers, and the exact end if it has one."""
    return plan(container.index).marks


def least_size(container: Container, region: Region | None = None) -> int:
    """Return the bytes that the first picture of a container, or of a window of it, takes."""
    return plan(container.index, Target(region=region)).marks[0].bytes


def require_matplotlib() -> None:
    """Check early that pictures can be drawn.

    Raises
    ------
    UnavailableError
        If matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise UnavailableError("pictures need matplotlib: pip install 'lodestream[plot]'") from None


@dataclass(frozen=True)
class Picture:
    """The content of a picture: points of one level by block, the known angles, the title, and what it shows."""

    surface: Surface
    title: str
    stage: Stage

    @classmethod
    def of(cls, view: View, layout: Layout | None, name: str) -> Picture:
        """Return the picture of a view, with its bytes and its errors as title.

        Parameters
        ----------
        view : View
        layout : Layout or None
            Of the surface: a level with enough nodes for the picture is drawn. None: the finest, as a window needs.
        name : str
            Of the surface.
        """
        level = None if layout is None else _level(layout)
        surface = view.surface(level)
        blocks = [Block(block.points, block.closed, mask=block.mask) for block in surface.blocks]
        errors = f"RMS error {view.rms:.3g}, maximum {view.max_error:.3g}"
        if view.complete and view.rms == 0:
            errors = "complete" if is_remeshed(surface.metadata) else "exact"
        title = printable(" ".join(name.split()))[:_LONGEST]
        shown = Surface(blocks=blocks, metadata=surface.metadata)
        finest = level
        if finest is not None and not is_height_field(shown):
            finest -= _THINNED
        stage = Stage(view.number, finest)
        return cls(shown, f"{title}\n{human_size(view.bytes)}, {errors}", stage)

    def pixels(self) -> NDArray[np.uint8]:
        """Return the colours of the picture without its title and legend, (row, column, rgba), to be compared."""
        require_matplotlib()
        return pixels_of(self.surface, _PIXELS)

    def png(self) -> bytes:
        """Draw the picture, and return it as PNG.

        Raises
        ------
        UnavailableError
            If matplotlib is not installed.
        """
        require_matplotlib()
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained", dpi=DPI)
        FigureCanvasAgg(figure)
        draw_surface(figure, self.surface, _PIXELS)
        # What a file or a server calls itself is no formula.
        figure.suptitle(self.title, fontsize=11, parse_math=False)
        file = io.BytesIO()
        # Packing it tighter takes a fifth of the time, for a twentieth to a sixth of the bytes.
        figure.savefig(file, format="png", pil_kwargs={"compress_level": 1})
        return file.getvalue()


def write_png(png: bytes, path: Path) -> None:
    """Write a drawn picture, replacing an earlier one."""
    with replacing(path) as temporary:
        temporary.write_bytes(png)


def _level(layout: Layout) -> int | None:
    """Return the coarsest level with enough nodes for the picture; None: the finest."""
    for level in range(layout.levels):
        shapes = [layout.shape(grid, level) for grid in range(len(layout.grids))]
        if max(max(shape) for shape in shapes) >= _PIXELS:
            return level
    return None
