"""Parts in processes of their own, some side by side: one that fails, or dies, takes no other with it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from .parts import PROGRESS, Part, Result

__all__ = ["STAGES", "Lanes", "Wish"]

#: What measures runs first and alone. The others wait for links and processes most of the time, or compute all the
#: time: these lanes run side by side, the parts of each one after another.
STAGES = (
    (("throughput", "crowds", "proxied"),),
    (
        ("streams",),
        ("kills", "disk", "history", "takeovers", "faults"),
        ("fuzz", "kernels", "decoders", "layouts", "tests", "mutants"),
    ),
)

# Long enough to end servers and remove folders.
_PATIENCE = 30.0


@dataclass(frozen=True)
class Wish:
    """A part, how many of what it counts, and the most seconds, if it may be cut short."""

    part: Part
    count: int
    seconds: float | None


class Lanes:
    """Runs parts.

    Parameters
    ----------
    begun, ended : callable
        Told of each part; from several threads.
    kept : Path or None
        A folder for what the parts did and how far they came: with the same folder none is done twice.
    """

    def __init__(
        self, begun: Callable[[Part], None], ended: Callable[[Result], None], kept: Path | None = None
    ) -> None:
        self._begun = begun
        self._ended = ended
        self._kept = kept
        self._over = threading.Event()

    def run(self, wishes: Sequence[Wish]) -> None:
        """Run them all; after KeyboardInterrupt, those that are under way are ended and nothing is told of them."""
        by_name = {wish.part.name: wish for wish in wishes}
        for stage in STAGES:
            # Not threads: one whose join is interrupted counts as ended, and would be left behind with its process.
            with ThreadPoolExecutor(len(stage)) as pool:
                lanes = [pool.submit(self._lane, [by_name[name] for name in lane if name in by_name]) for lane in stage]
                try:
                    for lane in lanes:
                        lane.result()
                except BaseException:
                    self._over.set()  # and the pool waits for all lanes
                    raise

    def _lane(self, wishes: Sequence[Wish]) -> None:
        for wish in wishes:
            if self._over.is_set():
                return
            result = self._known(wish)
            if result is None:
                self._begun(wish.part)
                result = self._one(wish)
            if result is not None:
                self._ended(result)

    def _known(self, wish: Wish) -> Result | None:
        file = None if self._kept is None else self._kept / wish.part.name / "result.json"
        result = Result.of_json(file.read_text()) if file is not None and file.exists() else None
        return result if result is not None and result.wanted == wish.count else None

    def _keep(self, result: Result) -> Result:
        if self._kept is not None and result.failure is None and result.cases >= result.wanted:
            (self._kept / result.part.name / "result.json").write_text(result.to_json())
        return result

    def _one(self, wish: Wish) -> Result | None:
        started = time.monotonic()
        kept = "-"
        if self._kept is not None:
            kept = str(self._kept / wish.part.name)
            os.makedirs(kept, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            file, said = Path(folder, "result.json"), Path(folder, "said")
            seconds = "-" if wish.seconds is None else str(wish.seconds)
            command = [sys.executable, "-m", "tests.torture.parts", wish.part.name, str(wish.count), seconds, str(file)]
            command.append(kept)
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            with said.open("wb") as output:
                # A group of its own: what it has started can be ended with it. No session: Linux would take a part for
                # somebody else's work, whatever the priority of this process.
                process = subprocess.Popen(
                    command, stdout=output, stderr=subprocess.STDOUT, env=environment, process_group=0
                )
            self._await(process, said)
            result = Result.of_json(file.read_text()) if file.exists() else None
            if self._over.is_set() and (result is None or result.failure is not None):
                return None  # what fails because it was ended has not failed
            if result is not None:
                return self._keep(result)
            words = f"the process ended with {process.returncode}\n{said.read_text(errors='replace')[-4000:]}"
            return Result(wish.part, wish.count, 0, (), time.monotonic() - started, words)

    def _await(self, process: subprocess.Popen[bytes], said: Path) -> None:
        """Wait for a part, and repeat the lines in which it says how far it is."""
        with contextlib.suppress(ProcessLookupError), said.open(errors="replace") as output:
            over = False
            while not over:
                over = process.poll() is not None or self._over.wait(0.2)
                for line in output:
                    if line.startswith(PROGRESS):
                        print(line, end="", flush=True)
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_PATIENCE)
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
