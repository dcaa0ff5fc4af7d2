"""Bytes against RMS error, one figure for each group of surfaces."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from .curves import EACH, Results, envelope
from .registry import OURS, PEERS
from .surfaces import GROUPS

__all__ = ["draw"]

_LEAST, _MOST = 3e-6, 5e-2
_COLUMNS = 3
_EXACT, _EACH = f"{OURS}, one exact stream", f"{OURS}, one stream for each error"


def draw(results: Results, folder: Path) -> dict[str, Path]:
    """Draw all groups; returns the path of each."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {}
    for group in GROUPS:
        names = [name for name in results.group(group) if results.rows(name, OURS)]
        if names:
            drawn[group] = folder / f"{group.replace(' ', '-')}.png"
            _figure(results, names, drawn[group])
    return drawn


def _figure(results: Results, names: list[str], path: Path) -> None:
    columns = min(_COLUMNS, len(names))
    rows = math.ceil(len(names) / columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.6 * columns + 2.8, 3.7 * rows + 0.4), squeeze=False, layout="constrained"
    )
    for place, name in zip(axes.flat, names, strict=False):
        _surface(results, name, place)
    for place in axes.flat[len(names) :]:
        place.set_axis_off()
    handles: dict[str, Artist] = {}
    for place in axes.flat:
        handles.update(dict(zip(*reversed(place.get_legend_handles_labels()), strict=True)))
    order = [name for name in (_EXACT, _EACH, *PEERS) if name in handles]
    figure.legend([handles[name] for name in order], order, loc="outside right upper", fontsize=8, frameon=False)
    # Neither version nor date stands in the file: the same results draw the same bytes.
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)


def _surface(results: Results, name: str, axes: Axes) -> None:
    colours = plt.get_cmap("tab20")
    for number, peer in enumerate(PEERS):
        _curve(axes, envelope(results.rows(name, peer), "rms"), peer, colours(number), 1.1)
    streams = results.streams(name)
    _curve(axes, envelope(streams.get(EACH, []), "rms"), _EACH, "dimgrey", 2.0, "dotted")
    _curve(axes, envelope(streams["exact"], "rms"), _EXACT, "black", 2.0)
    shape = " x ".join(map(str, results.surfaces[name]["shape"]))
    axes.set(xscale="log", yscale="log", ylim=(_LEAST, _MOST), xlabel="bytes", ylabel="RMS error / extent")
    axes.set_title(f"{name}, {shape}", fontsize=10)
    axes.grid(True, which="major", linewidth=0.4, alpha=0.6)


def _curve(
    axes: Axes, points: list[tuple[float, float]], name: str, colour: Any, width: float, style: str = "solid"
) -> None:
    """A line through the lossy points; a lossless one stands as a triangle at the lower edge."""
    lossy = [(size, error) for size, error in points if _LEAST / 3 < error < _MOST * 3]
    if lossy:
        axes.plot(*zip(*lossy, strict=True), color=colour, linewidth=width, linestyle=style, label=name)
    exact = [size for size, error in points if not error]
    if exact:
        axes.plot(exact, [_LEAST * 1.15], marker="v", markersize=5, color=colour, linestyle="none", clip_on=False)
