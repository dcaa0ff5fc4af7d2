"""Tables of speed and memory."""

from __future__ import annotations

import math
from typing import Any

from .curves import Results, Row, geometric_mean
from .registry import OURS, PEERS

__all__ = ["memory_table", "speed_table"]

Table = tuple[list[str], list[list[str]]]
_NEAR = 1e-4


def speed_table(results: Results) -> Table:
    """MB/s of each coder, on terrain and on what is smooth."""
    kinds = {"terrain": ("rough terrain",), "smooth, xyz": ("smooth", "xyz")}
    head = ["MB/s"]
    for kind in kinds:
        head += [f"{kind}: encode at 1e-4", "decode", "encode lossless", "decode"]
    rows = []
    for coder in (OURS, *PEERS):
        cells = []
        for groups in kinds.values():
            surfaces = [name for group in groups for name in results.group(group)]
            for pick in (_nearest, _lossless):
                found = [(name, row) for name in surfaces if (row := pick(results, name, coder))]
                for field in ("encode_s", "decode_s"):
                    speeds = [_megabytes(results, name) / row[field] for name, row in found]
                    cells.append(_speed(geometric_mean(speeds)))
        rows.append([coder, *cells])
    return head, rows


def memory_table(results: Results) -> Table:
    """Peaks on the largest heights and the largest x, y, z."""
    chosen = []
    for dimensions in (2, 3):
        names = [name for name, facts in results.surfaces.items() if len(facts["shape"]) == dimensions]
        if names:
            chosen.append(max(names, key=lambda name: _megabytes(results, name)))
    head = ["times the samples as float32"]
    for name in chosen:
        head += [f"{name} ({_megabytes(results, name):.0f} MB): encode", "decode"]
    rows = []
    for coder in (OURS, *PEERS):
        cells = []
        for name in chosen:
            for field in ("encode_peak", "decode_peak"):
                peaks = [row[field] for row in results.rows(name, coder) if row[field] is not None]
                cells.append(f"{max(peaks) / 1e6 / _megabytes(results, name):.1f}" if peaks else "-")
        rows.append([coder, *cells])
    return head, rows


def _nearest(results: Results, surface: str, coder: str) -> Row | None:
    rows = results.streams(surface).get("exact", []) if coder == OURS else results.rows(surface, coder)
    lossy = [row for row in rows if row["rms"] > 0 and not math.isnan(row["decode_s"])]
    best = min(lossy, key=_distance, default=None)
    return best if best is not None and _distance(best) < math.log(3) else None


def _distance(row: dict[str, Any]) -> float:
    return abs(math.log(row["rms"] / _NEAR))


def _lossless(results: Results, surface: str, coder: str) -> Row | None:
    return results.lossless(surface, coder)


def _megabytes(results: Results, surface: str) -> float:
    shape: list[int] = results.surfaces[surface]["shape"]
    return 4 * math.prod(shape) / 1e6


def _speed(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"
