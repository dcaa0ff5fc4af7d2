"""``docs/benchmarks.md``: tables of everything that was measured."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import lodestream

from ..arrays import ROOT
from . import figures, remeshed
from .curves import Cell, Results, geometric_mean
from .linked import linked
from .prose import GATES, LOSSLESS, MEMORY, NOT_MEASURED, RESAMPLED, RULES, SPEED
from .registry import OURS, PEERS, old
from .remarks import REMARKS, TERRACES, remark_of
from .speed import memory_table, speed_table
from .surfaces import GROUPS
from .tables import bold, number, table
from .trial import TARGETS
from .waiting import waiting

__all__ = ["write"]

PAGE = ROOT / "docs" / "benchmarks.md"
GATE = 1.03
AIMS = {"rough terrain": 0.95, "smooth": 0.75, "xyz": 0.75}
KINDS = {"rms": "RMS error", "max": "Maximum error"}


def write(data: dict[str, Any]) -> list[Path]:
    """Write the page and its figures; returns their paths."""
    results = Results(data)
    drawn = figures.draw(results, ROOT / "docs" / "benchmarks")
    PAGE.write_text("\n".join(_page(results, drawn)) + "\n")
    return [PAGE, *drawn.values()]


def _page(results: Results, drawn: dict[str, Path]) -> Iterator[str]:
    yield from _head(results)
    yield "\n## Seconds until the error\n"
    yield from waiting(results)
    yield "\n## Over emulated links\n"
    yield from linked(results)
    for kind, title in KINDS.items():
        yield f"\n## {title}\n"
        yield from _summary(results, kind)
        for group in GROUPS:
            cells = results.cells(results.group(group), kind)
            if cells:
                yield f"\n### {title}: {group}\n"
                yield from _cells(cells)
                if kind == "rms" and group in drawn:
                    yield f"\n![Bytes against RMS error: {group}]({drawn[group].relative_to(PAGE.parent)})"
    if results.data.get("meshes"):
        yield "\n## Triangle meshes that are resampled\n"
        yield RESAMPLED
        yield from remeshed.page(results.data["meshes"])
    yield "\n## Lossless\n"
    yield from _lossless(results)
    yield "\n## Speed\n"
    yield from table(*speed_table(results))
    yield SPEED
    yield "\n## Memory\n"
    yield from table(*memory_table(results))
    yield MEMORY
    yield from _losses(results)
    yield "## Not measured\n"
    yield NOT_MEASURED
    yield from _left_out(results)


def _head(results: Results) -> Iterator[str]:
    machine = results.data.get("machine", {})
    runs = results.data["runs"].values()
    dates = sorted({run["date"] for run in runs})
    took = sum(run["seconds"] for run in runs)
    yield "# Seconds, bytes, speed and memory, compared with other coders\n"
    yield "This page and its figures are written by\n"
    yield "    make bench-peers\n"
    yield "in an environment of its own (layers of JPEG 2000 need Debian's OpenJPEG: `apt-get install libopenjp2-7`),"
    name = machine.get("processor", "an unknown processor").strip()
    yield f"which took {took / 60:.0f} minutes of processor time, on one core of {name} "
    when = " to ".join(sorted({dates[0], dates[-1]}))
    yield f"({machine.get('system', '')}, Python {machine.get('python', '')}), {when}.\n"
    yield f"Lodestream {lodestream.__version__}; {', '.join(results.data.get('versions', []))}.\n"
    outdated = old(results.data.get("versions", []))
    if outdated:
        yield f"**Old**: {', '.join(outdated)}. Newer ones, with JPEG XL 0.12 and SZ3 3.4, need Python 3.12 or newer.\n"
    yield RULES
    yield "\n| surface | group | size | type | closed | from |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, facts in results.surfaces.items():
        size = " x ".join(map(str, facts["shape"]))
        closed = (
            ", ".join(word for word, flag in zip(("rows", "columns"), facts["closed"], strict=True) if flag) or "no"
        )
        yield f"| {name} | {facts['group']} | {size} | {facts['dtype']} | {closed} | {facts['source']} |"


def _summary(results: Results, kind: str) -> Iterator[str]:
    rows = []
    for group in GROUPS:
        cells = results.cells(results.group(group), kind)
        for target in TARGETS:
            at = [cell for cell in cells if cell.target == target]
            if not at:
                continue
            large = [cell for cell in at if cell.counts]
            mean = geometric_mean([cell.ratio for cell in large])
            alone = geometric_mean([cell.exact_ratio for cell in large])
            worst = max((cell.ratio for cell in large), default=math.nan)
            alone_worst = max((cell.exact_ratio for cell in large), default=math.nan)
            over = max((cell.ours - cell.peer_bytes for cell in at if not cell.counts), default=math.nan)
            aim = AIMS.get(group) if kind == "rms" else None
            lost = sum(cell.ratio > 1 for cell in at)
            rows.append(
                [
                    f"{group}, {target:.0e}",
                    f"{len(large)} of {len(at)}",
                    bold(mean, aim or 1.0),
                    f"{aim}" if aim else "",
                    bold(worst, 1.0),
                    str(sum(cell.ratio > GATE for cell in large)),
                    "" if math.isnan(over) else f"{over:+,.0f}",
                    str(lost),
                    bold(alone, aim or 1.0),
                    bold(alone_worst, 1.0),
                ]
            )
    head = [
        "group, error",
        "cells of 4 KB",
        "best setting: mean ratio",
        "aim",
        "worst",
        f"above {GATE}",
        "worst below 4 KB, bytes",
        "lost",
        "one exact stream: mean ratio",
        "worst",
    ]
    yield from table(head, rows)
    if kind == "rms":
        yield "\n" + GATES
        yield from _without_terraces(results)


def _without_terraces(results: Results) -> Iterator[str]:
    """What one surface of another kind does to the means."""
    names = [name for name in results.group("rough terrain") if name not in TERRACES]
    if len(names) == len(results.group("rough terrain")):
        return
    cells = [cell for cell in results.cells(names, "rms") if cell.counts]
    at = [[cell for cell in cells if cell.target == target] for target in TARGETS]
    best = ", ".join(number(geometric_mean([cell.ratio for cell in some])) for some in at)
    alone = ", ".join(number(geometric_mean([cell.exact_ratio for cell in some])) for some in at)
    yield f"\nRough terrain without {', '.join(TERRACES)} (terraces, see the cells that lose): means of"
    yield f"{best} at the best setting, of {alone} with one exact stream."


def _cells(cells: Sequence[Cell]) -> Iterator[str]:
    rows = [
        [
            f"{cell.surface}, {cell.target:.0e}",
            cell.peer,
            f"{cell.peer_bytes:,.0f}",
            f"{cell.ours:,.0f}",
            bold(cell.ratio, 1.0),
            cell.stream,
            f"{cell.exact:,.0f}",
            bold(cell.exact_ratio, 1.0),
        ]
        for cell in cells
    ]
    yield from table(
        ["surface, error", "best peer", "bytes", "ours, best setting", "ratio", "setting", "one exact stream", "ratio"],
        rows,
    )


def _lossless(results: Results) -> Iterator[str]:
    gates = ("JPEG XL, efforts 9 and 10", "pcodec", "SZ3")
    rows: list[list[str]] = []
    ratios: dict[str, dict[str, list[float]]] = {}
    without = f"the same heights without {', '.join(TERRACES)}"
    for kind in ("heights of at most 16 bits", without, "float32 x, y, z"):
        ratios[kind] = {}
    for name, facts in results.surfaces.items():
        ours = results.lossless(name, OURS)
        if ours is None:
            continue
        found = {peer: row["bytes"] for peer in PEERS if (row := results.lossless(name, peer))}
        best = min(found, key=found.__getitem__, default=None)
        cells = []
        for peer in gates:
            ratio = ours["bytes"] / found[peer] if peer in found else math.nan
            cells += [f"{found[peer]:,}" if peer in found else "-", bold(ratio, 1.0)]
            xyz = facts["shape"][2:] == [3]
            kind = "float32 x, y, z" if xyz else "heights of at most 16 bits"
            fits = facts["dtype"] == "float32" if xyz else _sixteen_bits(results, name)
            counted = facts["group"] != "tiny" and fits
            if counted and not math.isnan(ratio):
                ratios[kind].setdefault(peer, []).append(ratio)
                if name not in TERRACES and not xyz:
                    ratios[without].setdefault(peer, []).append(ratio)
        last = [best, f"{found[best]:,}", bold(ours["bytes"] / found[best], 1.0)] if best else ["-", "-", ""]
        rows.append([name, f"{ours['bytes']:,}", f"{ours['file']:,}", *cells, *last])
    head = [
        "surface",
        "ours",
        "whole file",
        *(word for peer in gates for word in (peer, "ratio")),
        "best peer",
        "bytes",
        "ratio",
    ]
    yield from table(head, rows)
    yield ""
    for kind, by_peer in ratios.items():
        means = ", ".join(
            f"{bold(geometric_mean(values), 1.0)} of {peer} ({len(values)})" for peer, values in by_peer.items()
        )
        yield f"- {kind}, larger than 64 x 64, geometric means (surfaces): {means or 'nothing measured'}."
    yield LOSSLESS


def _sixteen_bits(results: Results, surface: str) -> bool:
    """Whether JPEG XL could be given whole numbers, of which it has 16 bits."""
    row = results.lossless(surface, "JPEG XL, efforts 9 and 10")
    return row is not None and "float32" not in row["setting"]


def _losses(results: Results) -> Iterator[str]:
    yield "\n## Cells that lose\n"
    yield "All cells above 1 of ours at its best setting, each under its cause."
    yield "What was tried: [experiments.md](experiments.md).\n"
    lost: dict[str, dict[str, list[str]]] = {key: {} for key in REMARKS}
    for kind, title in KINDS.items():
        for cell in results.cells(list(results.surfaces), kind):
            if cell.ratio > 1:
                key = remark_of(results.surfaces[cell.surface]["group"], kind, cell)
                text = f"{title.split()[0]} {cell.target:.0e} {cell.ratio:.3f} of {cell.peer}"
                lost[key].setdefault(cell.surface, []).append(text)
    for key, surfaces in lost.items():
        if surfaces:
            yield f"### Lost: {key}\n\n{REMARKS[key]}\n"
            for surface, texts in surfaces.items():
                yield f"- {surface}: {'; '.join(texts)}."
            yield ""
    if not any(lost.values()):
        yield "None.\n"


def _left_out(results: Results) -> Iterator[str]:
    yield "\n## Left out\n"
    for note in results.data.get("skipped", []):
        yield f"- {note}"
    told: dict[str, tuple[dict[str, None], dict[str, None]]] = {}
    for key, run in results.data["runs"].items():
        surface, coder = key.split("|")
        if surface in results.surfaces:
            for note in run["notes"]:
                coders, surfaces = told.setdefault(note, ({}, {}))
                coders[coder] = surfaces[surface] = None
    for note, (coders, surfaces) in sorted(told.items()):
        where = f"{len(surfaces)} surfaces" if len(surfaces) > 4 else ", ".join(surfaces)
        yield f"- {', '.join(coders)}: {note} ({where})"
