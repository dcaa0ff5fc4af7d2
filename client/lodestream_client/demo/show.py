"""The demo from beginning to end."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import LodestreamError
from lodestream.page import assets

from ..client import Client
from ..terminal.output import cell, console, human_size, note, print_json, progress_bar
from . import picture, plain
from .service import own_server
from .terrain import terrain

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from lodestream.decoding.decoder import View

    from ..requests.api import Description
    from ..terminal.output import Progress

__all__ = ["show"]

_SHAPE = (1024, 1280)
_LINK = 64_000 / 8  # bytes per second
_STOP = 10.0  # metres
_STEP = 3  # a line of the table for so many times the bytes of the line before
_WINDOW = 8  # the picture enlarges an eighth of the rows and of the columns


@dataclass(frozen=True)
class _Moment:
    """A line of the table; errors in metres."""

    seconds: float
    bytes: int
    rms: float
    rms_found: float
    max: float
    max_found: float
    npy_rows: int
    overview_factor: int
    overview_rms: float

    @property
    def agrees(self) -> bool:
        pairs = ((self.rms, self.rms_found), (self.max, self.max_found))
        # Containers tell errors in 20 bits of fraction, rounded up.
        return all((1 - 1e-9) * measured <= recorded <= (1 + 1e-6) * measured for recorded, measured in pairs)


def show(folder: Path, *, as_json: bool = False, shape: tuple[int, int] = _SHAPE) -> int:
    """Run the demo, and write its surface and, if matplotlib is installed, its picture into `folder`.

    Return the exit code.

    Parameters
    ----------
    folder : path
        Made if it is not there.
    as_json : bool
        Print one JSON object on standard output, and everything else on standard error.
    shape : (rows, columns)
        Of the surface.

    Raises
    ------
    LodestreamError
        When something that it needs is not installed, the server does not start, or an error told is not the error
        found.
    """
    out = console(stderr=as_json)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "terrain.npy"
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar())
        task = bar.add_task("starting a server", total=None, figures="")
        url = stack.enter_context(own_server())
        bar.remove_task(task)
        heights = _made(shape, file, bar)
        ls.decode(ls.encode(heights[:16, :16]))  # loads the decoder before the clock runs
        client = stack.enter_context(Client(url))
        surface = _uploaded(client, file, bar)
        whole = int(surface.details["levels"][-1]["bytes"])
        arrivals = _streamed(client, surface, bar)
    moments = [_moment(seconds, view, heights) for seconds, view in _chosen(arrivals)]
    last = moments[-1]
    plain_bytes = file.stat().st_size
    out.print(
        f"{shape[0]:,} x {shape[1]:,} generated heights in whole metres, over a link of {_LINK * 8 / 1000:.0f} kbit/s, "
        f"stopped at an RMS error of {_STOP:g} m\n"
    )
    out.print(_table(moments, whole, shape))
    _conclude(last, whole, plain_bytes, out)
    paths = [file]
    drawn = _draw(arrivals[-1][1], last, heights, plain_bytes, folder / "demo.png")
    if drawn is not None:
        paths.append(drawn)
    out.print(cell(f"Written: {', '.join(map(str, paths))}"))
    before = "" if assets() else "make page, and then "
    out.print(cell(f"See it come into focus in a browser: {before}{_program()} open {file}"))
    if as_json:
        print_json(
            {
                "shape": list(shape),
                "whole_bytes": whole,
                "plain_bytes": plain_bytes,
                "moments": [asdict(moment) for moment in moments],
                "files": [str(path) for path in paths],
            }
        )
    if not all(moment.agrees for moment in moments):
        raise LodestreamError("a stated error differs from the measured one: this is a bug, please report it")
    return 0


def _made(shape: tuple[int, int], file: Path, bar: Progress) -> NDArray[np.int16]:
    task = bar.add_task("generating the surface", total=1.0, figures=f"{math.prod(shape):,} points")
    heights = terrain(shape, lambda done: bar.update(task, completed=done))
    np.save(file, heights)
    bar.remove_task(task)
    return heights


def _uploaded(client: Client, file: Path, bar: Progress) -> Description:
    task = bar.add_task("sending", total=1.0, figures=human_size(file.stat().st_size))

    def progress(stage: str, fraction: float) -> None:
        bar.update(task, description=f"{stage} on the server" if stage == "building" else stage, completed=fraction)

    surface = client.upload(file, progress=progress)
    bar.remove_task(task)
    return surface


def _streamed(client: Client, surface: Description, bar: Progress) -> list[tuple[float, View]]:
    layers = surface.details["layers"]
    total = next((layer["bytes"] for layer in layers if layer["rms"] <= _STOP), layers[-1]["bytes"])
    task = bar.add_task("streaming", total=total, figures="")
    arrivals: list[tuple[float, View]] = []
    started = time.monotonic()
    with client.connect(surface.id, target=ls.Target(until_rms=ls.Tolerance(_STOP)), limit_rate=_LINK) as stream:
        for view in stream:
            arrivals.append((time.monotonic() - started, view))
            bar.update(task, completed=view.bytes, figures=f"{human_size(view.bytes)}, RMS error {view.rms:.3g} m")
    bar.remove_task(task)
    if not arrivals:
        raise LodestreamError("expected at least one view of the surface, got none")
    return arrivals


def _chosen(arrivals: Sequence[tuple[float, View]]) -> list[tuple[float, View]]:
    chosen = [arrivals[-1]]
    for arrival in reversed(arrivals):
        if arrival[1].bytes * _STEP <= chosen[-1][1].bytes:
            chosen.append(arrival)
    return chosen[::-1]


def _moment(seconds: float, view: View, heights: NDArray[np.int16]) -> _Moment:
    rms, greatest = _errors(view.points, heights)
    rough, factor = plain.overview(heights, view.bytes)
    rows = int(np.isfinite(plain.beginning(heights, view.bytes)).all(axis=1).sum())
    return _Moment(
        round(seconds, 3), view.bytes, view.rms, rms, view.max_error, greatest, rows, factor, _errors(rough, heights)[0]
    )


def _errors(points: NDArray[Any], heights: NDArray[np.int16]) -> tuple[float, float]:
    """Return the root mean square and the maximum of the differences."""
    difference = points.astype(np.float64) - heights
    return float(np.sqrt((difference**2).mean())), float(np.abs(difference).max())


def _program() -> str:
    """Return what a shell runs this program by: its path, where its folder is not among those that are searched."""
    path = sys.argv[0]
    return path if Path(path).name == "lodestream" and shutil.which("lodestream") is None else "lodestream"


def _table(moments: Sequence[_Moment], whole: int, shape: tuple[int, int]) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in (
        "bytes",
        "of the\nstream",
        "RMS error\nstated [m]",
        "\nmeasured [m]",
        "maximum\nstated [m]",
        "\nmeasured [m]",
        "plain file:\nrows received",
        "overview: factor,\nRMS error [m]",
    ):
        table.add_column(name.replace("[", "\\["), justify="right")  # the brackets of a unit are no markup
    for it in moments:
        table.add_row(
            f"{it.bytes:,}",
            f"{it.bytes / whole:.2%}",
            f"{it.rms:.3f}",
            f"{it.rms_found:.3f}",
            f"{it.max:.0f}",
            f"{it.max_found:.0f}",
            f"{it.npy_rows} of {shape[0]:,}",
            f"1:{it.overview_factor}  {it.overview_rms:5.1f}",
        )
    return table


def _conclude(last: _Moment, whole: int, plain_bytes: int, out: Console) -> None:
    out.print(
        f"\nStopped after {last.bytes:,} bytes: {last.bytes / whole:.1%} of the stream ({whole:,}), "
        f"{last.bytes / plain_bytes:.1%} of terrain.npy ({plain_bytes:,})."
    )
    out.print(
        f"Over this link: {last.seconds:.1f} s. The whole stream, every value exact, takes {whole / _LINK:.0f} s, "
        f"terrain.npy {plain_bytes / _LINK:.0f} s."
    )
    out.print(
        "Plain file: the first bytes of terrain.npy. Overview: the finest grid of means that fits into as many bytes, "
        "compressed as in a GeoTIFF (deflate), and interpolated bilinearly."
    )


def _draw(view: View, last: _Moment, heights: NDArray[np.int16], plain_bytes: int, path: Path) -> Path | None:
    rows, columns = heights.shape
    size = f"{last.bytes:,} bytes"
    panels = (
        picture.Panel(
            plain.beginning(heights, last.bytes),
            "first bytes of a plain file",
            (size, f"{last.npy_rows} of {rows:,} rows"),
        ),
        picture.Panel(
            plain.overview(heights, last.bytes)[0],
            f"overview 1:{last.overview_factor}, compressed",
            (size, f"RMS error {last.overview_rms:.1f} m"),
        ),
        picture.Panel(
            view.points,
            "Lodestream",
            (size, f"RMS error {last.rms:.1f} m"),
        ),
        picture.Panel(
            heights,
            "the original",
            (f"{plain_bytes:,} bytes", f"{rows:,} x {columns:,} heights, int16"),
        ),
    )
    top, left = round(0.36 * rows), round(0.24 * columns)
    window = slice(top, top + rows // _WINDOW), slice(left, left + columns // _WINDOW)
    try:
        picture.draw(panels, window, path)
    except ImportError:
        note("no picture without matplotlib: pip install 'lodestream[plot]'")
        return None
    return path
