"""Bytes to an error, of coders that were tried at some settings, and who needs fewest."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from .registry import OURS, PEERS
from .trial import TARGETS

__all__ = ["EACH", "SMALL", "Cell", "Results", "bytes_at", "envelope", "family", "geometric_mean"]

#: Cells where the best peer needs fewer bytes do not enter means.
SMALL = 4096

#: The ends of our streams that are made for one error: a curve of settings, like a peer's.
EACH = "each error"

Row = dict[str, Any]


def envelope(rows: Iterable[Row], kind: str) -> list[tuple[float, float]]:
    """Bytes and error of the rows that no other row beats in both."""
    best, found = math.inf, []
    for size, error in sorted((row["bytes"], row[kind]) for row in rows):
        if error < best:
            found.append((float(size), error))
            best = error
    return found


def bytes_at(rows: Iterable[Row], kind: str, target: float) -> float | None:
    """Bytes at which the error is down to the target; None where it never is.

    Between two settings they are interpolated in log-log. Nothing is interpolated towards a lossless row: an error
    below the last lossy one costs all of it.
    """
    before: tuple[float, float] | None = None
    for size, error in envelope(rows, kind):
        if error <= target:
            if before is None or not error:
                return size
            part = math.log(before[1] / target) / math.log(before[1] / error)
            return math.exp(math.log(before[0]) + part * math.log(size / before[0]))
        before = (size, error)
    return None


@dataclass(frozen=True)
class Cell:
    """One error on one surface."""

    surface: str
    target: float
    peer: str
    peer_bytes: float
    ours: float
    stream: str
    exact: float

    @property
    def ratio(self) -> float:
        """Below 1 where ours needs fewer bytes."""
        return self.ours / self.peer_bytes

    @property
    def exact_ratio(self) -> float:
        """The same of the one exact stream."""
        return self.exact / self.peer_bytes

    @property
    def counts(self) -> bool:
        """Whether it enters means."""
        return self.peer_bytes >= SMALL


@dataclass(frozen=True)
class Results:
    """What was measured, as it stands in the file."""

    data: dict[str, Any]

    @property
    def surfaces(self) -> dict[str, dict[str, Any]]:
        """Facts of each surface."""
        found: dict[str, dict[str, Any]] = self.data["surfaces"]
        return found

    def group(self, group: str) -> list[str]:
        """Surfaces of a group."""
        return [name for name, facts in self.surfaces.items() if facts["group"] == group]

    def rows(self, surface: str, coder: str) -> list[Row]:
        """Rows of a coder; none where it does not take the surface."""
        found: list[Row] = self.data["runs"].get(f"{surface}|{coder}", {}).get("rows", [])
        return found

    def streams(self, surface: str) -> dict[str, list[Row]]:
        """Our rows, by stream, and the ends of the streams made for one error."""
        found: dict[str, list[Row]] = {}
        for row in self.rows(surface, OURS):
            found.setdefault(row["stream"], []).append(row)
        ends = [max(rows, key=lambda row: int(row["bytes"])) for name, rows in found.items() if name != "exact"]
        return {**found, EACH: ends} if ends else found

    def moments(self, surface: str) -> list[dict[str, Any]]:
        """What a receiver of our exact stream computes until each error, see `ours.moments`."""
        found: list[dict[str, Any]] = self.data["runs"].get(f"{surface}|{OURS}", {}).get("moments", [])
        return found

    def cells(self, surfaces: Sequence[str], kind: str) -> list[Cell]:
        """Every error on every surface where both ours and a peer were measured."""
        found = []
        for surface in surfaces:
            for target in TARGETS:
                peers = self._peers(surface, kind, target)
                ours = {
                    stream: size
                    for stream, rows in self.streams(surface).items()
                    if (size := bytes_at(rows, kind, target)) is not None
                }
                if peers and ours:
                    peer, best = min(peers, key=peers.__getitem__), min(ours, key=ours.__getitem__)
                    found.append(Cell(surface, target, peer, peers[peer], ours[best], best, ours["exact"]))
        return found

    def lossless(self, surface: str, coder: str, ours: str = "exact") -> Row | None:
        """The shortest lossless row of a coder, or the end of one of our streams: a receiver knows only there."""
        if coder == OURS:
            end = max(self.streams(surface).get(ours, []), key=lambda row: int(row["bytes"]), default=None)
            return None if end is None or end["max"] else end
        rows = self.rows(surface, coder)
        return min((row for row in rows if not row["max"]), key=lambda row: int(row["bytes"]), default=None)

    def _peers(self, surface: str, kind: str, target: float) -> dict[str, float]:
        # Modes of one coder are settings: on an envelope of each alone, lines between distant settings pass below what
        # the other modes were found to need there.
        families: dict[str, list[Row]] = {}
        for peer in PEERS:
            families.setdefault(family(peer), []).extend(self.rows(surface, peer))
        sizes = {name: bytes_at(rows, kind, target) for name, rows in families.items()}
        return {name: size for name, size in sizes.items() if size is not None}


def family(peer: str) -> str:
    """The coder that a peer is a mode of."""
    return peer.split(",")[0]


def geometric_mean(values: Sequence[float]) -> float:
    """NaN of nothing."""
    return math.exp(sum(map(math.log, values)) / len(values)) if values else math.nan
