"""HTML of surfaces, views and streams for notebooks: a small picture, sizes, errors."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..text import is_remeshed, printable
from .pictures import SMALL, small_png

if TYPE_CHECKING:
    from ..container.model import Header
    from ..decoding.view import View
    from ..surface import Surface

__all__ = ["errors", "small_level", "surface_html", "table", "view_html"]

#: Rows of one table: blocks, attributes.
_MOST = 8


def surface_html(surface: Surface) -> str:
    """Return a surface as HTML: picture, blocks, attributes, name and unit."""
    shapes = [block.shape for block in surface.blocks]
    return table("Surface", _of_surface(surface, shapes), small_png(surface))


def small_level(header: Header) -> int | None:
    """Return the coarsest level that is enough for a small picture; None: full resolution."""
    layout = header.layout
    grids = range(len(layout.grids))
    widest = (max(max(layout.shape(grid, level)) for grid in grids) for level in range(layout.levels))
    return next((level for level, width in enumerate(widest) if width >= SMALL), None)


def view_html(view: View, surface: Surface, shapes: Sequence[tuple[int, int]]) -> str:
    """Return a view as HTML: picture, bytes, errors, and the rows of its surface.

    Parameters
    ----------
    view : View
    surface : Surface
        Its surface, or that of a level that is enough for a small picture.
    shapes : sequence of (int, int)
        Rows and columns of the blocks at full resolution.
    """
    return table("View", [*errors(view, surface.metadata), *_of_surface(surface, shapes)], small_png(surface))


def errors(view: View, metadata: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return rows with the bytes and errors of a view.

    A remeshed surface is never called exact, since its mesh is not.
    """
    exact = view.complete and view.rms == 0 and not is_remeshed(metadata)
    return [
        ("bytes", f"{view.bytes:,}"),
        ("level", f"{view.level}"),
        ("RMS error", "0, exact" if exact else f"{view.rms:.4g}"),
        ("maximum error", f"{view.max_error:.4g}"),
        ("state", "complete" if view.complete else f"layer {view.number}"),
    ]


def _of_surface(surface: Surface, shapes: Sequence[tuple[int, int]]) -> list[tuple[str, str]]:
    metadata = surface.metadata
    rows = [(key, metadata[key]) for key in ("name", "unit") if isinstance(metadata.get(key), str)]
    points = surface.blocks[0].points
    kind = "heights" if points.ndim == 2 else f"{points.shape[2]} channels"
    rows.append(("points", f"{kind}, {points.dtype}"))
    blocks = []
    for block, shape in zip(surface.blocks, shapes, strict=True):
        words = " x ".join(f"{n:,}{' (closed)' * wraps}" for n, wraps in zip(shape, block.closed, strict=True))
        holes = 0 if block.mask is None or block.shape != shape else int((~block.mask).sum())
        blocks.append(words + (f", {holes:,} holes" if holes else ""))
    rows.append(("block" if len(blocks) == 1 else f"{len(blocks)} blocks", _listed(blocks)))
    names = [
        f"{name} ({values.dtype}{f', {values.shape[2]} components' if values.ndim == 3 else ''})"
        for name, values in surface.blocks[0].attributes.items()
    ]
    return [*rows, *([("attributes", _listed(names))] if names else [])]


def _listed(words: Sequence[str]) -> str:
    more = len(words) - _MOST
    return "; ".join(words[:_MOST]) + (f" and {more:,} more" if more > 0 else "")


def table(title: str, rows: Iterable[tuple[str, str]], picture: bytes | None) -> str:
    """Return rows of names and values beside a PNG, as HTML; all text is escaped, control characters too."""
    cells = "".join(
        f'<tr><th style="text-align:left">{html.escape(printable(name))}</th>'
        f'<td style="text-align:left">{html.escape(printable(value))}</td></tr>'
        for name, value in rows
    )
    image = ""
    if picture is not None:
        data = base64.b64encode(picture).decode("ascii")
        image = f'<img alt="{html.escape(title)}" src="data:image/png;base64,{data}">'
    return (
        f'<div style="display:flex;gap:1em;align-items:flex-start">{image}'
        f"<table><caption>{html.escape(title)}</caption>{cells}</table></div>"
    )
