"""Seconds until a receiver holds a surface at an error, by the speed of its link: bytes and decoding together."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ..measure import Gate
from .curves import Results, Row, bytes_at, geometric_mean
from .registry import MESHES, PEERS

__all__ = ["ERRORS", "LINKS", "Moment", "arrival", "beaten", "choices", "gates", "moments", "named", "overlapped"]

#: Bits a second.
LINKS = (1e6, 1e7, 1e8, 1e9)

#: RMS errors, of the extent; 0 is every value exact.
ERRORS = (1e-2, 1e-3, 1e-4, 0.0)

#: At most these means of ours over the best peer, by link; and no cell above the last at 100 Mbit/s.
MEANS = {1e6: 0.95, 1e7: 0.95, 1e8: 1.0, 1e9: 4.0}
WORST = {1e8: 1.5}
#: At most this part of the cells may have an integer or float coder that is both smaller and faster.
BEATEN = 1 / 50

#: The coders that ``shared/bench/time_to_error.py`` compares with, lossy and lossless.
SCRIPT = (
    ("SPERR", "SZ3", "LERC", "JPEG 2000"),
    ("LERC", "pcodec", "JPEG XL, efforts", "JPEG-LS", "HTJ2K", "JPEG 2000"),
)

Choice = tuple[float, float]


@dataclass(frozen=True)
class Moment:
    """One error on one surface over one link: ours, and the best peer.

    ``simple`` is the ratio as ``shared/bench/time_to_error.py`` counts it, with its peers; NaN without any.
    """

    surface: str
    group: str
    error: float
    link: float
    ours: float
    simple: float
    bytes: int
    peer: str
    peer_seconds: float
    peer_bytes: float

    @property
    def ratio(self) -> float:
        """Below 1 where ours is first."""
        return self.ours / self.peer_seconds

    @property
    def name(self) -> str:
        """Surface and error."""
        return f"{self.surface}, {named(self.error)}"


def named(error: float) -> str:
    """An error as tables tell it."""
    return f"{error:.0e}" if error else "exact"


def arrival(ends: Sequence[int], feeds: Sequence[float], picture: float, link: float) -> float:
    """Seconds until there are points: each layer is decoded when it has come and the ones before are decoded."""
    done = 0.0
    for end, feed in zip(ends, feeds, strict=True):
        done = max(done, 8 * end / link) + feed
    return done + picture


def overlapped(ends: Sequence[int], feeds: Sequence[float], picture: float, link: float) -> float:
    """The same where decoding and the network overlap wholly, as in ``shared/bench/time_to_error.py``."""
    return max(8 * ends[-1] / link, sum(feeds) + picture)


def settings(rows: Sequence[Row], error: float) -> list[Choice]:
    """Bytes and seconds to decode of a coder's streams that meet an error, as they were made."""
    found = [
        (float(row["bytes"]), float(row["decode_s"])) for row in rows if row["rms"] <= error and _exact(row, error)
    ]
    return [(size, seconds) for size, seconds in found if not math.isnan(seconds)]


def choices(rows: Sequence[Row], error: float) -> list[Choice]:
    """The same, and what lies between two of them: bytes as everywhere on the page, seconds in between."""
    found = settings(rows, error)
    size = bytes_at(rows, "rms", error) if error else None
    coarser = [row for row in rows if row["rms"] > error and size is not None and row["bytes"] <= size]
    if size is not None and coarser and found:
        before, after = max(coarser, key=lambda row: int(row["bytes"])), min(found)
        if before["bytes"] < after[0]:
            part = (size - before["bytes"]) / (after[0] - before["bytes"])
            found.append((size, before["decode_s"] + part * (after[1] - before["decode_s"])))
    return found


def _exact(row: Row, error: float) -> bool:
    return bool(error) or not row["max"]


def moments(results: Results) -> list[Moment]:
    """Every link, error and surface where both ours and a peer were measured."""
    found = []
    for surface, facts in results.surfaces.items():
        for told in results.moments(surface):
            error = told["target"]
            peers = {peer: choices(results.rows(surface, peer), error) for peer in PEERS}
            if not any(peers.values()):
                continue
            decoding = told["bytes"], told["feed_s"], told["picture_s"]
            made = [
                choice
                for peer in PEERS
                if peer.startswith(SCRIPT[not error])
                for choice in settings(results.rows(surface, peer), error)
            ]
            for link in LINKS:
                waits = sorted(
                    (8 * size / link + spent, size, peer) for peer, some in peers.items() for size, spent in some
                )
                script = min((8 * size / link + spent for size, spent in made), default=math.nan)
                simple = overlapped(*decoding, link) / script
                seconds, size, peer = waits[0]
                place = surface, facts["group"], error, link
                ours = arrival(*decoding, link)
                found.append(Moment(*place, ours, simple, told["bytes"][-1], peer, seconds, size))
    return found


def beaten(results: Results) -> tuple[list[str], int]:
    """Cells in which one stream of an integer or float coder is both smaller and faster, and how many cells there are.

    Faster: it takes less time to decode than all layers of ours and the points.
    """
    lost, count = [], 0
    coders = [peer for peer in PEERS if peer not in MESHES]
    for surface in results.surfaces:
        for told in results.moments(surface):
            size, seconds = told["bytes"][-1], sum(told["feed_s"]) + told["picture_s"]
            some = {peer: choices(results.rows(surface, peer), told["target"]) for peer in coders}
            count += any(some.values())
            for peer, (other, spent) in _both(some, size, seconds):
                parts = f"{other / size:.2f} of the bytes, {spent / seconds:.2f} of the time"
                lost.append(f"{surface}, {named(told['target'])}: {peer}, {parts}")
    return lost, count


def _both(some: dict[str, list[Choice]], size: float, seconds: float) -> Iterable[tuple[str, Choice]]:
    """The smallest stream that is smaller and faster, if there is one."""
    winners = [
        (choice, peer) for peer, found in some.items() for choice in found if choice[0] < size and choice[1] < seconds
    ]
    return [(peer, choice) for choice, peer in sorted(winners)[:1]]


def gates(results: Results) -> list[Gate]:
    """The figures that have an aim."""
    found, all_moments = [], moments(results)
    for link in LINKS:
        ratios = [moment.ratio for moment in all_moments if moment.link == link]
        name = f"3. seconds at {link / 1e6:.0f} Mbit/s over the best peer's"
        found.append(Gate(f"{name}, mean", geometric_mean(ratios), MEANS[link], False))
        if link in WORST:
            found.append(Gate(f"{name}, worst", max(ratios, default=math.nan), WORST[link], False))
    lost, count = beaten(results)
    part = len(lost) / count if count else math.nan
    found.append(Gate("3. part of the cells with a peer both smaller and faster", part, BEATEN, False))
    return found
