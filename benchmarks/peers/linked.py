"""The second table of the page: the real server and client over emulated links."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from .curves import Results, geometric_mean
from .links import FAMILIES, RAW
from .prose import LINKS
from .seconds import named
from .tables import bold, table

__all__ = ["linked"]

Cell = dict[str, Any]


def linked(results: Results) -> Iterator[str]:
    """Means by link and threads, then all cells."""
    yield LINKS + "\n"
    measured = results.data.get("links")
    if not measured:
        yield "Nothing was measured."
        return
    cells: list[Cell] = measured["cells"]
    load = f", at a load of {measured['load']:.1f}" if measured["load"] is not None else ""
    yield f"{measured['surface']}, {measured['date']}, on {measured['processors']} processors{load}.\n"
    yield from _means(cells)
    for threads in dict.fromkeys(cell["threads"] for cell in cells):
        yield f"\n### Over emulated links: {_threads(threads)}\n"
        yield from _all([cell for cell in cells if cell["threads"] == threads])


def best(cell: Cell) -> tuple[str, float]:
    """The peer that was there first, and its seconds."""
    found: tuple[str, float] = min(
        ((name, seconds) for name, seconds in cell["seconds"].items() if name in FAMILIES), key=lambda one: one[1]
    )
    return found


def _means(cells: list[Cell]) -> Iterator[str]:
    rows = []
    for threads, rate in dict.fromkeys((cell["threads"], cell["rate"]) for cell in cells):
        some = [cell for cell in cells if (cell["threads"], cell["rate"]) == (threads, rate)]
        files = [cell["seconds"]["ours"] / best(cell)[1] for cell in some]
        raw = [cell["seconds"]["ours"] / cell["seconds"][RAW] for cell in some]
        worst = max(some, key=lambda cell: cell["seconds"]["ours"] / best(cell)[1])
        rows.append(
            [
                f"{rate / 1e6:.0f} Mbit/s, {_threads(threads)}",
                bold(geometric_mean(files), 1.0),
                f"{bold(max(files), 1.0)}: {_trip(worst)}, {named(worst['error'])}, {best(worst)[0]}",
                bold(geometric_mean(raw), 1.0),
                bold(max(raw), 1.0),
            ]
        )
    yield from table(["ours over", "best file, mean", "worst", "raw array, mean", "worst"], rows)


def _all(cells: list[Cell]) -> Iterator[str]:
    rows = []
    for cell in cells:
        seconds = cell["seconds"]
        name = f"{cell['rate'] / 1e6:.0f} Mbit/s, {_trip(cell)}, {named(cell['error'])}"
        times = [f"{1e3 * seconds[way]:,.0f}" if way in seconds else "-" for way in ("ours", *FAMILIES, RAW)]
        spent = f"{1e3 * cell['processor']['ours']:,.0f}"
        rows.append([name, *times, spent, bold(seconds["ours"] / best(cell)[1], 1.0)])
    yield from table(["ms", "ours", *FAMILIES, RAW, "ours, of processors", "ours / best file"], rows)


def _trip(cell: Cell) -> str:
    return f"{1e3 * cell['trip']:.0f} ms"


def _threads(count: int) -> str:
    return "one core" if count == 1 else f"all {count} cores"
