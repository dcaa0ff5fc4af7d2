"""Commands that are run to their end while the memory of their processes is watched."""

from __future__ import annotations

import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

__all__ = ["Run", "all_cores", "anonymous", "command", "row"]


@dataclass(frozen=True)
class Run:
    """A command that has ended: seconds by the clock, and the largest anonymous memory of any of its processes."""

    seconds: float
    memory: int


def row(name: str, run: Run, made: Path, samples: int) -> list[str]:
    """A row of a table: seconds, microseconds a sample, bytes of the file that was made, and memory."""
    size = made.stat().st_size
    return [
        name,
        f"{run.seconds:.1f}",
        f"{run.seconds / samples * 1e6:.2f}",
        f"{size:,}",
        f"{run.memory / 2**20:.0f} MiB",
    ]


def command(words: list[str], said: Path | None = None) -> Run:
    """Run a command to its end; `CalledProcessError` is raised if it fails. What it says goes into a file."""
    started = time.monotonic()
    with open(said or os.devnull, "wb") as told:
        process = psutil.Popen(words, env=all_cores(), stdout=told, stderr=subprocess.DEVNULL)
    most = 0
    while process.poll() is None:
        most = max(most, anonymous(process))
        time.sleep(0.05)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words)
    return Run(time.monotonic() - started, most)


def all_cores() -> dict[str, str]:
    """The environment without what keeps the other benchmarks on one core."""
    return {key: value for key, value in os.environ.items() if not key.endswith("_THREADS")}


def anonymous(process: psutil.Process) -> int:
    """The largest anonymous memory of a process and of those that it has started, bytes."""
    found = 0
    try:
        for one in (process, *process.children(recursive=True)):
            with open(f"/proc/{one.pid}/status") as lines:
                own = next((line for line in lines if line.startswith("RssAnon")), "RssAnon: 0 kB")
            found = max(found, int(own.split()[1]) << 10)
    except (psutil.NoSuchProcess, OSError):
        pass
    return found
