"""The first table of the page: seconds until the error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from .curves import Results, geometric_mean
from .prose import SECONDS
from .registry import OURS
from .seconds import ERRORS, LINKS, MEANS, WORST, Moment, beaten, moments, named
from .surfaces import GROUPS
from .tables import bold, number, table

__all__ = ["means", "waiting"]


def waiting(results: Results) -> Iterator[str]:
    """Means by link against their aims, by error and by group, where ours is beaten in both, and all cells."""
    found = moments(results)
    yield SECONDS + "\n"
    if not found:
        yield "Nothing was measured."
        return
    yield from means(found)
    yield ""
    yield from _parts(found)
    yield ""
    yield from _beaten(results)
    yield "\n### Seconds until the error: all cells\n"
    yield from _cells(found)


def means(found: Sequence[Moment]) -> Iterator[str]:
    """Geometric means and the worst cell by link, against their aims."""
    rows = []
    for link in LINKS:
        some = [moment for moment in found if moment.link == link]
        mean = geometric_mean([moment.ratio for moment in some])
        simple = geometric_mean([moment.simple for moment in some if not math.isnan(moment.simple)])
        worst = max(some, key=lambda moment: moment.ratio)
        limit = WORST.get(link)
        met = mean <= MEANS[link] and (limit is None or worst.ratio <= limit)
        rows.append(
            [
                _link(link),
                str(len(some)),
                bold(mean, MEANS[link]),
                f"{MEANS[link]}",
                number(simple),
                bold(worst.ratio, limit or worst.ratio),
                f"{limit}" if limit else "",
                f"{worst.name}: {1e3 * worst.ours:,.1f} ms, {worst.peer} {1e3 * worst.peer_seconds:,.1f} ms",
                "met" if met else "missed",
            ]
        )
    head = ["link", "cells", "mean ratio", "aim", "by the script", "worst", "aim", "the worst cell", ""]
    yield from table(head, rows)


def _parts(found: Sequence[Moment]) -> Iterator[str]:
    parts: dict[str, Callable[[Moment], bool]] = {}
    for error in ERRORS:
        parts[named(error)] = lambda moment, error=error: moment.error == error  # type: ignore[misc]
    parts["larger than 64 x 64"] = lambda moment: moment.group != "tiny"
    for group in GROUPS:
        parts[group] = lambda moment, group=group: moment.group == group  # type: ignore[misc]
    rows = []
    for name, belongs in parts.items():
        ratios_of = []
        for link in LINKS:
            ratios = [moment.ratio for moment in found if moment.link == link and belongs(moment)]
            ratios_of.append(bold(geometric_mean(ratios), MEANS[link]))
        rows.append([name, *ratios_of])
    yield from table(["mean ratio", *map(_link, LINKS)], rows)


def _beaten(results: Results) -> Iterator[str]:
    lost, count = beaten(results)
    yield f"An integer or float coder is both smaller and faster than {OURS}'s exact stream in {len(lost)} of {count}"
    yield f"cells (aim: at most one of fifty; {'met' if 50 * len(lost) <= count else 'missed'}){':' if lost else '.'}"
    if lost:
        yield ""
        yield from (f"- {text}" for text in lost)


def _cells(found: Sequence[Moment]) -> Iterator[str]:
    cells: dict[str, dict[float, Moment]] = {}
    for moment in found:
        cells.setdefault(moment.name, {})[moment.link] = moment
    rows = []
    for name, by_link in cells.items():
        row = [name, f"{next(iter(by_link.values())).bytes:,}"]
        for link in LINKS:
            moment = by_link[link]
            row += [
                f"{1e3 * moment.ours:,.1f}",
                f"{1e3 * moment.peer_seconds:,.1f}, {moment.peer}",
                bold(moment.ratio, 1.0),
            ]
        rows.append(row)
    head = [word for link in LINKS for word in (f"{_link(link)}: ours, ms", "best peer, ms", "ratio")]
    yield from table(["surface, error", "our bytes", *head], rows)


def _link(link: float) -> str:
    return f"{link / 1e6:.0f} Mbit/s"
