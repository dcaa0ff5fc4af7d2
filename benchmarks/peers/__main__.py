"""Measure this project and its peers: ``python -m benchmarks.peers``.

What was measured stays in ``build/peers.json``; a coder is run again on a surface only where the surface changed, where
it is named, or where it is this project.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

from ..__main__ import processor
from ..arrays import ROOT
from ..measure import gates, keep
from . import links, remeshed, report
from .curves import Results
from .registry import OURS, PEERS, versions
from .seconds import gates as gates_of
from .surfaces import BUILD, catalogue, prepare, specimen

RESULTS = ROOT / "build" / "peers.json"
LIMIT = 600.0  # seconds for one coder on one surface, by the clock


def main() -> int:
    """Run what is asked for, and write the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--only", help="coders whose name contains one of these, separated by commas; run again")
    parser.add_argument("--surfaces", help="surfaces whose name contains one of these, separated by commas")
    parser.add_argument("--again", action="store_true", help="measure again what is known")
    parser.add_argument("--tables", action="store_true", help="write the tables and figures of what is known")
    parser.add_argument("--links", action="store_true", help="measure streams over emulated links only")
    parser.add_argument("--meshes", action="store_true", help="measure triangle meshes that are resampled only")
    options = parser.parse_args()
    results = known()
    if not options.tables:
        try:
            if not (options.links or options.meshes):
                _measure(results, options)
            if options.meshes or not (options.links or options.only or options.surfaces):
                _measure_meshes(results)
            if options.links or not (options.meshes or options.only or options.surfaces):
                _measure_links(results)
        except KeyboardInterrupt:
            print("stopped; what was measured is kept")
            return 130
    if options.tables or not (options.only or options.surfaces or options.meshes):
        for path in report.write(results):
            print(f"wrote {path.relative_to(ROOT)}")
        for one in gates_of(Results(results)):
            keep(one)
        gates()
    return 0


def known() -> dict[str, Any]:
    """What was measured before."""
    if RESULTS.exists():
        known: dict[str, Any] = json.loads(RESULTS.read_text())
        return known
    return {"surfaces": {}, "runs": {}, "skipped": []}


def _measure(results: dict[str, Any], options: argparse.Namespace) -> None:
    start = time.perf_counter()
    if not (options.only and catalogue()):
        skipped = prepare()
        names = catalogue()

        def prepared(results: dict[str, Any]) -> None:
            results["skipped"] = skipped
            results["surfaces"] = {name: results["surfaces"][name] for name in names if name in results["surfaces"]}

        _keep(results, prepared)
    coders = [name for name in (*PEERS, OURS) if _chosen(name, options.only)]
    if not coders:
        sys.exit(f"expected one of {', '.join((*PEERS, 'ours'))}, got {options.only}")
    for name in catalogue():
        if not _chosen(name, options.surfaces):
            continue
        surface = specimen(name)
        facts = {
            "group": surface.group,
            "source": surface.source,
            "shape": list(surface.points.shape),
            "dtype": surface.points.dtype.name,
            "closed": list(surface.closed),
            "lattice": surface.lattice is not None,
        }
        for coder in coders:
            key = f"{name}|{coder}"
            old = results["runs"].get(key, {}).get("fingerprint")
            if old == surface.fingerprint and not (options.again or options.only or coder == OURS):
                continue
            run = _run(name, coder) | {"fingerprint": surface.fingerprint, "date": date.today().isoformat()}
            print(f"{time.perf_counter() - start:6.0f} s  {name}, {coder}: {len(run['rows'])} rows", flush=True)
            for note in run["notes"]:
                print(f"          {note}", flush=True)
            _keep(results, partial(_add, name=name, facts=facts, key=key, run=run))

    def finished(results: dict[str, Any]) -> None:
        if any(coder != OURS for coder in coders):
            results["versions"] = versions()
        results["machine"] = {
            "processor": processor(),
            "system": platform.system(),
            "python": platform.python_version(),
        }

    _keep(results, finished)


def _measure_links(results: dict[str, Any]) -> None:
    start = time.perf_counter()
    if not links.chosen(Results(results), links.SURFACE):
        print(f"no streams over links: nothing was measured of {links.SURFACE}")
        return
    found = links.measure(Results(results)) | {"date": date.today().isoformat()}
    print(f"{time.perf_counter() - start:6.0f} s  streams over emulated links")
    _keep(results, lambda results: results.update(links=found))


def _measure_meshes(results: dict[str, Any]) -> None:
    found = remeshed.measure()
    if not found:
        print(f"no triangle meshes: expected some of {', '.join(remeshed.MESHES)} in {remeshed.FOLDER}")
        return
    _keep(results, lambda results: results.update(meshes=found))
    print("\n".join(remeshed.page(found)))


def _add(results: dict[str, Any], name: str, facts: dict[str, Any], key: str, run: dict[str, Any]) -> None:
    results["surfaces"][name] = facts
    results["runs"][key] = run


def _chosen(name: str, words: str | None) -> bool:
    if words is None:
        return True
    return any(
        (word == "ours" and name == OURS) or word in name.lower() for word in map(str.strip, words.lower().split(","))
    )


def _run(surface: str, coder: str) -> dict[str, Any]:
    """A process of its own: what a coder does to memory, or its crash, touches no other."""
    out = BUILD / f"run-{os.getpid()}.json"
    out.unlink(missing_ok=True)
    command = [sys.executable, "-m", "benchmarks.peers.worker", surface, coder, str(out)]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT)
        failure = None
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1][:200]
            failure = f"failed with exit code {done.returncode}: {last}"
    except subprocess.TimeoutExpired:
        failure = f"ended after {LIMIT:.0f} s"
    result: dict[str, Any] = {"rows": [], "notes": [], "moments": [], "seconds": 0.0}
    with contextlib.suppress(OSError, json.JSONDecodeError):  # nothing, or cut short
        result = json.loads(out.read_text())
    out.unlink(missing_ok=True)
    if failure is not None:
        result["notes"].append(failure)
    return result


def _keep(results: dict[str, Any], change: Callable[[dict[str, Any]], None]) -> None:
    """Change what is known, in memory and in the file, which another run may have added to meanwhile."""
    results.update(known())
    change(results)
    part = Path(f"{RESULTS}.{os.getpid()}")
    part.write_text(json.dumps(results))
    part.replace(RESULTS)


if __name__ == "__main__":
    sys.exit(main())
