"""Timing side by side, peaks of memory, tables, and aims that are met or missed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["STATUS", "Gate", "Peak", "gate", "gates", "keep", "medians", "memory", "note", "table"]

#: What a system tells a process of its memory, where it does.
STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Gate:
    """A figure that is to be at least, or at most, as large as its aim."""

    name: str
    found: float
    aim: float
    least: bool
    unit: str = ""

    @property
    def met(self) -> bool:
        """False of NaN."""
        return self.found >= self.aim if self.least else self.found <= self.aim

    @property
    def verdict(self) -> str:
        return "met" if self.met else "missed"


_gates: list[Gate] = []


def gate(
    name: str, found: float, *, at_least: float | None = None, at_most: float | None = None, unit: str = ""
) -> str:
    """Keep a figure and its one aim for the table of gates; returns ``met`` or ``missed``."""
    aim = at_most if at_least is None else at_least
    if aim is None or None not in (at_least, at_most):
        raise ValueError("expected one aim")
    return keep(Gate(name, found, aim, at_least is not None, unit))


def keep(one: Gate) -> str:
    """Keep a figure for the table of gates; returns ``met`` or ``missed``."""
    _gates.append(one)
    return one.verdict


def gates() -> None:
    """Print all figures that were kept, if there are any, beside their aims."""
    rows = [
        [
            one.name,
            f"{one.found:,.3g}{one.unit}",
            f"{'at least' if one.least else 'at most'} {one.aim:g}{one.unit}",
            one.verdict,
        ]
        for one in _gates
    ]
    if rows:
        table("Gates", ["figure", "found", "aim", ""], rows)


class Peak:
    """Peak memory of this process; None everywhere on a system that does not tell."""

    def __init__(self) -> None:
        self.base = self._read("VmRSS")

    def forget(self) -> None:
        """Start anew."""
        if self.base is not None:
            _CLEAR.write_text("5")

    def above(self) -> int | None:
        """Bytes above what the process held when this object was made."""
        peak = self._read("VmHWM")
        return None if peak is None or self.base is None else max(0, peak - self.base)

    @staticmethod
    def _read(field: str) -> int | None:
        try:
            line = next(line for line in STATUS.read_text().splitlines() if line.startswith(field))
        except (OSError, StopIteration):
            return None
        return 1024 * int(line.split()[1])


def medians(work: Mapping[str, Callable[[], object]], rounds: int = 5) -> dict[str, float]:
    """Median seconds of each piece of work, of this process's processor: others that share it do not count.

    Every piece runs once untimed (compilation, first touch of memory) and then once in each round, so that a machine
    that slows down for a while slows all of them down, and their ratios stay what they are.
    """
    for run in work.values():
        run()
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds):
        for name, run in work.items():
            start = time.process_time()
            run()
            seconds[name].append(time.process_time() - start)
    return {name: statistics.median(times) for name, times in seconds.items()}


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table: the first column to the left, the others to the right."""
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    print(f"\n### {title}\n")
    for row in (head, rule, *rows):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        print(f"| {' | '.join(cells)} |", flush=True)


def note(text: str) -> None:
    """Print a line of explanation under a table."""
    print(f"\n{text}", flush=True)


def memory(count: float) -> str:
    """Bytes for people: ``1.5 MiB``."""
    for unit in ("B", "KiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} MiB"
