"""What of a container a window takes: at default settings, square, exact inside, at random places."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Any

import numpy as np

import lodestream as ls
from lodestream.container import Index, read_index
from lodestream.container.sections import FOOTER_LENGTH
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.transfer.range_download import RangeDownload
from lodestream.transfer.receiver_state import ReceiverState

from .arrays import fractal
from .measure import note, table

__all__ = ["main"]

AREA = 0.05
PLACES = 20
_TERRAIN = 4097


@dataclass(frozen=True)
class Case:
    """A surface, the side of its windows in points, and the largest share of the bytes that they may take."""

    side: int
    dtype: str
    window: int
    aim: float

    def points(self) -> Any:
        """A corner of one large terrain: whole metres, or all that float32 holds."""
        if self.dtype == "int16":
            return (fractal(_TERRAIN)[: self.side, : self.side] - 32768).astype(np.int16)
        return fractal(_TERRAIN, rounded=False)[: self.side, : self.side].astype(np.float32)


def _of_area(side: int, dtype: str, aim: float) -> Case:
    return Case(side, dtype, round(side * math.sqrt(AREA)), aim)


CASES = (
    _of_area(1025, "int16", 0.26),
    _of_area(2049, "int16", 0.17),
    _of_area(4097, "int16", 0.12),
    Case(512, "float32", 10, 0.20),
    _of_area(1025, "float32", 0.33),
    _of_area(2049, "float32", 0.22),
    _of_area(4097, "float32", 0.15),
)


def main() -> None:
    """Print the table."""
    rows = []
    for case in CASES:
        points = case.points()
        container = ls.encode(points)
        index = read_index(lambda offset, length: container[offset : offset + length], len(container))  # noqa: B023
        found = [shares(points, container, index, place, case.window) for place in places(case)]
        needed = sorted(share for share, _ in found)
        median = statistics.median(needed)
        rows.append(
            [
                f"{case.dtype}, {case.side} x {case.side}",
                f"{len(container):,}",
                f"{case.window} x {case.window}",
                f"{median:.1%}",
                f"{needed[0]:.1%}",
                f"{needed[-1]:.1%}",
                f"{case.aim:.0%}",
                "met" if median <= case.aim else "missed",
                f"{statistics.median(share for _, share in found):.1%}",
            ]
        )
    head = ["terrain", "bytes", "window", "median", "least", "most", "aim", "", "over Range"]
    table(f"Share of the container that a window takes, of {PLACES} places", head, rows)
    note(
        "All bytes count: header, index, footer, segments, chunks of the residual, metadata. The points of every "
        "window equal those of the surface. `over Range`: the median of the bytes that a client of HTTP Range "
        "reads. It also reads the gap between two slices if that costs less than another request (16 KiB and more)."
    )


def places(case: Case) -> list[tuple[int, int]]:
    """First rows and columns of the windows."""
    found = np.random.default_rng(5).integers(0, case.side - case.window + 1, (PLACES, 2))
    return [(int(row), int(column)) for row, column in found]


def shares(points: Any, container: bytes, index: Index, place: tuple[int, int], length: int) -> tuple[float, float]:
    """The share of a container that a window needs, and that a client of HTTP Range reads; the window is checked."""
    (top, left), (bottom, right) = place, (place[0] + length, place[1] + length)
    target = ls.Target(region=((top, bottom), (left, right)))
    chosen = plan(index, target)
    decoder = ls.Decoder(selection_of(target))
    for part in chosen.slices:
        decoder.feed_at(part.offset, container[part.offset : part.end])
    assert np.array_equal(decoder.surface().points, points[top:bottom, left:right])
    needed = FOOTER_LENGTH + sum(part.length for part in chosen.slices)
    return needed / len(container), read_over_range(container, target) / len(container)


def read_over_range(container: bytes, target: ls.Target) -> int:
    """Bytes of the answers that a client of HTTP Range gets."""
    reception = ReceiverState(target)
    download = RangeDownload(reception)
    while (request := download.request()[0]) is not None:
        body = container[request.offset : request.offset + request.length]
        last = request.offset + len(body) - 1
        download.answer(206, {"content-range": f"bytes {request.offset}-{last}/{len(container)}", "etag": '"1"'})
        download.receive(body)
        download.finish()
    return reception.wire_bytes
