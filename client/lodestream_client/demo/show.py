"""The demo from beginning to end."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lodestream as ls
from lodestream.errors import LodestreamError

from .. import sync
from ..commands.output import cell, console, human_size, print_json
from . import models, picture
from .service import own_server

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from lodestream.decoder import View

    from ..requests import Description

__all__ = ["show"]

_LINK = 64_000 / 8  # bytes per second
_STOP = ls.Tolerance(1e-3, relative=True)

# Shares of the extent: the picture shows the first states whose RMS error is at most these, then the stop.
_EARLIER = {"jacksboro": (0.1, 0.02), "torus": (0.02, 0.005)}


@dataclass(frozen=True)
class _Arrival:
    seconds: float
    view: View


@dataclass(frozen=True)
class _Run:
    """One surface streamed: what came when, and what it is compared with."""

    model: models.Model
    arrivals: Sequence[_Arrival]
    ended: str
    whole: int
    extent: float

    @property
    def last(self) -> View:
        return self.arrivals[-1].view

    @property
    def raw(self) -> int:
        return int(self.model.points.size) * 4


def show(folder: Path, *, as_json: bool = False) -> int:
    """Run the demo and write its picture and surfaces into `folder`; the exit code.

    Raises
    ------
    LodestreamError
        When something that it needs is not installed, or the server does not start.
    """
    out = console(stderr=as_json)
    chosen = (models.jacksboro(), models.torus())
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        with out.status("starting a server (the first time, kernels are compiled, which takes a while)"):
            url = stack.enter_context(own_server())
            _warm()
        out.print(f"A server of our own at {url}, and a link of 64 kbit/s to it")
        runs = [_run(model, url, out) for model in chosen]
    agreed = [_compare(run, out) for run in runs]
    paths = _write(runs, folder)
    out.print()
    out.print(cell(f"Written: {', '.join(map(str, paths))}"))
    if as_json:
        print_json({"surfaces": [_summary(run) for run in runs], "files": [str(path) for path in paths]})
    if not all(agreed):
        raise LodestreamError("the error told and the error found differ: this is a bug, please report it")
    return 0


def _warm() -> None:
    # Compiles the decoder before the clock runs: what is shown is the link, not the compiler.
    import numpy as np

    wave = np.add.outer(np.arange(9.0), np.arange(8.0) ** 2).astype(np.float32)
    ls.decode(ls.encode(wave))


def _run(model: models.Model, url: str, out: Console) -> _Run:
    from rich.live import Live

    out.print(f"\n[bold]{model.title}[/bold]")
    surface = sync.upload(url, model.source, options=model.options)
    table = _table(model.unit)
    arrivals: list[_Arrival] = []
    started = time.monotonic()
    with (
        sync.connect(surface.url, target=ls.Target(until_rms=_STOP), limit_rate=_LINK) as stream,
        Live(table, console=out, refresh_per_second=8, vertical_overflow="visible"),
    ):
        for view in stream:
            arrivals.append(_Arrival(time.monotonic() - started, view))
            _add(table, arrivals[-1], _whole(surface))
    header = stream.decoder.header
    if header is None or stream.ended is None or not arrivals:
        raise LodestreamError("expected at least one view of the surface, got none")
    return _Run(model, arrivals, stream.ended, _whole(surface), header.extent)


def _whole(surface: Description) -> int:
    # The surface without index and metadata: what a view's bytes are counted in.
    return int(surface.details["levels"][-1]["bytes"])


def _table(unit: str) -> Table:
    from rich.table import Table

    suffix = f" [{unit}]" if unit else ""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("time [s]", "bytes", "of all", "level", f"RMS error{suffix}", f"maximum{suffix}"):
        # The brackets of a unit are no markup.
        table.add_column(name.replace("[", "\\["), justify="right")
    return table


def _add(table: Table, arrival: _Arrival, whole: int) -> None:
    view = arrival.view
    table.add_row(
        f"{arrival.seconds:.2f}",
        f"{view.bytes:,}",
        f"{view.bytes / whole:.1%}",
        str(view.level),
        f"{view.rms:.6g}",
        f"{view.max_error:.6g}",
    )


def _compare(run: _Run, out: Console) -> bool:
    """Print the error told beside the error found, and the price; whether the errors agree."""
    view, model = run.last, run.model
    found = model.errors(view.points)
    pairs = [(f"{told:.9g}", f"{seen:.9g}") for told, seen in zip((view.rms, view.max_error), found, strict=True)]
    goal = "1e-3 of the extent"
    why = (
        f"stopped at an RMS error of {goal}" if run.ended == "rms" else f"came whole: no state before is within {goal}"
    )
    out.print(f"\n[bold]{model.title.split(',')[0]}[/bold] {why}; {run.arrivals[-1].seconds:.1f} s")
    for name, (told, seen) in zip(("RMS error", "maximum"), pairs, strict=True):
        verdict = "agree" if told == seen else "DIFFER"
        out.print(f"  {name:9}  told {told:>13} {model.unit:2} found {seen:>13} {model.unit:2} {verdict}")
    out.print(
        f"  bytes      {view.bytes:,}: {view.bytes / run.whole:.1%} of the whole stream ({run.whole:,}), "
        f"{view.bytes / run.raw:.1%} of the float32 surface ({run.raw:,})"
    )
    return all(told == seen for told, seen in pairs)


def _summary(run: _Run) -> dict[str, Any]:
    view = run.last
    rms, max_error = run.model.errors(view.points)
    return {
        "name": run.model.stem,
        "ended": run.ended,
        "seconds": round(run.arrivals[-1].seconds, 3),
        "bytes": view.bytes,
        "whole_bytes": run.whole,
        "raw_bytes": run.raw,
        "rms": view.rms,
        "rms_found": rms,
        "max": view.max_error,
        "max_found": max_error,
    }


def _write(runs: Sequence[_Run], folder: Path) -> list[Path]:
    moments = folder / "moments.png"
    picture.draw([_moments(run) for run in runs], moments)
    paths = [moments]
    for run in runs:
        paths.append(folder / f"{run.model.stem}.obj")
        ls.write(run.model.placed(run.last.points), paths[-1])
    return paths


def _moments(run: _Run) -> list[picture.Moment]:
    shares = (*_EARLIER[run.model.stem], 0.0)
    moments = []
    for share in shares:
        arrival = next((it for it in run.arrivals if it.view.rms <= share * run.extent), run.arrivals[-1])
        view = arrival.view
        error = f"RMS error {view.rms:.3g} {run.model.unit}".rstrip()
        moments.append(picture.Moment(view.points, human_size(view.bytes), f"after {arrival.seconds:.1f} s · {error}"))
    size = f"{human_size(run.raw)} as float32 · {run.raw / _LINK:.0f} s at 64 kbit/s"
    return [*moments, picture.Moment(run.model.points, "the original", size)]
