"""Seconds until the error: ours measured now, beside what `make bench-peers` measured of the peers."""

from __future__ import annotations

import json

import lodestream

from .arrays import ROOT
from .measure import keep, note
from .peers.curves import Results
from .peers.ours import moments
from .peers.registry import OURS
from .peers.seconds import beaten, gates
from .peers.seconds import moments as compared
from .peers.surfaces import catalogue, specimen
from .peers.waiting import means
from .rate import layers_of

RESULTS = ROOT / "build" / "peers.json"


def main() -> None:
    """Print the means by link, and keep their gates."""
    if not RESULTS.exists():
        print(f"\nskipped: seconds until the error (`make bench-peers` writes {RESULTS.relative_to(ROOT)})")
        return
    data = json.loads(RESULTS.read_text())
    for name in catalogue():
        if name not in data["surfaces"]:
            continue
        surface = specimen(name)
        container = lodestream.encode(lodestream.Surface(surface.points, surface.closed))
        run = {"rows": [], "moments": moments(container, layers_of(container), surface.extent)}
        data["runs"][f"{name}|{OURS}"] = data["runs"].get(f"{name}|{OURS}", {}) | run
    results = Results(data)
    found = compared(results)
    if not found:
        print("\nskipped: seconds until the error (no peer was measured)")
        return
    print("\n### Seconds until the error over those of the best peer\n")
    print("\n".join(means(found)), flush=True)
    lost, count = beaten(results)
    dates = sorted({run["date"] for run in data["runs"].values() if "date" in run})
    note(
        "Bytes over the link and decoding, of one exact stream by one thread, measured now, and of the peers, measured "
        f"on {dates[0]} to {dates[-1]} by `make bench-peers`: docs/benchmarks.md says how, and has all cells. A coder "
        f"of integers or floats is both smaller and faster in {len(lost)} of {count} cells{':' if lost else '.'}"
    )
    for text in lost:
        print(f"- {text}")
    for one in gates(results):
        keep(one)
