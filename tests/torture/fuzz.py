"""Any bytes into one of the `targets`, very many times: ``python -m tests.torture.fuzz containers --count 1000000``.

With atheris, which watches which lines are reached and keeps what reaches new ones; without it, changes of known files
at random. A fault ends the process with its traceback and the bytes in a file.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import logging
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .targets import Target

__all__ = ["Fuzzed", "run"]

#: Most memory of the process, and most seconds of one case.
MEMORY = 3 << 30
PATIENCE = 20

# Python whose lines are counted; compiled loops cannot be.
_INSTRUMENTED = [
    "lodestream.container",
    "lodestream.formats",
    "lodestream.protocol.messages",
    "lodestream.planning.planner",
    "lodestream.protocol.connection",
    "lodestream.transfer.sender",
    "lodestream.protocol.wire",
    "lodestream_server.builds.options",
    "lodestream_server.store.uploads",
    "python_multipart",
]

_MENDED = 0.7
_REPORT_EACH = 200


@dataclass(frozen=True)
class Fuzzed:
    """What a run did.

    Attributes
    ----------
    target, fuzzer : str
    cases : int
    taken : int
        Cases that were taken, not refused.
    seconds : float
    memory : int
        Most memory of the process, in bytes.
    """

    target: str
    fuzzer: str
    cases: int
    taken: int
    seconds: float
    memory: int


def run(target: str, count: int, seconds: float | None = None, seed: int = 1, folder: Path | None = None) -> Fuzzed:
    """Fuzz a target in a process of its own.

    A run with the folder of another one goes on with its corpus, and its cases count.

    Raises
    ------
    AssertionError
        When it found a fault: with what the process said.
    """
    with _folder(folder) as folder:
        folder.mkdir(exist_ok=True)
        state = folder / "state.json"
        command = [sys.executable, "-m", "tests.torture.fuzz", target, "--count", str(count), "--seed", str(seed)]
        command += ["--folder", str(folder), *(["--seconds", str(seconds)] if seconds is not None else [])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        started = time.monotonic()
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
        ) as process:
            assert process.stdout is not None
            said = process.stdout.read()
        found = (
            json.loads(state.read_text()) if state.exists() else {"cases": 0, "taken": 0, "fuzzer": "?", "memory": 0}
        )
        faults = [repr(path.read_bytes()[:4000]) for path in folder.glob("fault-*")]
        # The fuzzer's own diary is of no interest where there is a traceback.
        said = said[said.rfind("Traceback (most recent call last)") :] if "Traceback" in said else said
        assert process.returncode == 0, f"{target}, after {found['cases']:,} cases: {said[:4000]} {faults}"
        return Fuzzed(target, seconds=time.monotonic() - started, **found)


class _Tally:
    """Tries bytes and keeps count in a file."""

    def __init__(self, target: Target, fuzzer: str, folder: Path) -> None:
        self._target = target
        self._state = folder / "state.json"
        self._found: dict[str, Any] = {"fuzzer": fuzzer, "cases": 0, "taken": 0, "memory": 0}
        if self._state.exists():  # of an earlier run
            self._found |= json.loads(self._state.read_text())

    @property
    def cases(self) -> int:
        """Cases so far."""
        return int(self._found["cases"])

    def try_(self, data: bytes) -> None:
        """Try some bytes."""
        self._found["taken"] += self._target.run(data)
        self._found["cases"] += 1
        if self._found["cases"] % _REPORT_EACH == 0:
            self.write()

    def write(self) -> None:
        """Write what was counted."""
        self._found["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        new = self._state.with_suffix(".new")
        new.write_text(json.dumps(self._found))
        new.replace(self._state)


def _loop(target: Target, count: int, seconds: float, seed: int, folder: Path) -> None:
    """Change known files at random."""
    import signal

    from .targets import mutate

    def too_long(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"expected an end within {PATIENCE} s")

    signal.signal(signal.SIGALRM, too_long)
    tally, corpus = _Tally(target, "own mutations", folder), target.corpus()
    random_ = random.Random(seed + tally.cases)
    until = time.monotonic() + seconds
    while tally.cases < count and time.monotonic() < until:
        data = mutate(random_.choice(corpus), random_)
        data = target.mend(data) if random_.random() < _MENDED else data
        signal.alarm(PATIENCE)
        try:
            tally.try_(data)
        except BaseException:
            (folder / "fault-0").write_bytes(data)
            raise
    signal.alarm(0)
    tally.write()


def _atheris(name: str, count: int, seconds: float, seed: int, folder: Path) -> None:
    import atheris

    with atheris.instrument_imports(include=_INSTRUMENTED):
        from .targets import TARGETS, mutate
    target = TARGETS[name]
    _measure_memory_once()
    tally = _Tally(target, "atheris", folder)
    corpus = folder / "corpus"
    corpus.mkdir(exist_ok=True)
    seed += tally.cases
    left = count - tally.cases
    if left <= 0:
        return
    known = target.corpus()
    for number, data in enumerate(known):
        (corpus / str(number)).write_bytes(data)

    def change(data: bytes, most: int, seed: int) -> bytes:
        random_ = random.Random(seed)
        # What reaches new lines is mostly refused: half of the time it is started again from what is taken.
        data = bytes(data) if random_.random() < 0.5 else random_.choice(known)
        changed = atheris.Mutate(data, most) if random_.random() < 0.3 else mutate(data, random_)
        changed = target.mend(changed) if random_.random() < _MENDED else changed
        return bytes(changed[:most])

    for data in known:
        target.run(data)  # whatever has to be compiled is, before anything is timed

    def once(data: bytes) -> None:
        tally.try_(data)
        if tally.cases == count:
            tally.write()

    arguments = [sys.argv[0], str(corpus), f"-runs={left}", f"-seed={seed}", f"-timeout={PATIENCE}", "-max_len=65536"]
    # A change that `mutate` makes is one or several already, and each is mended anew.
    arguments += [
        "-mutate_depth=1",
        f"-rss_limit_mb={MEMORY >> 20}",
        f"-artifact_prefix={folder}/fault-",
        "-print_final_stats=0",
    ]
    arguments += [f"-max_total_time={max(1, int(seconds))}"] if seconds != float("inf") else []
    atheris.Setup(arguments, once, custom_mutator=change)
    atheris.Fuzz()


def _measure_memory_once() -> None:
    from lodestream.container import capacity  # not before its lines are counted

    # Each decoder reads several files for it, in which nothing changes: a sixth of the time of a case.
    limit = capacity.memory_limit()
    names: Any = capacity
    names.memory_limit = lambda: limit


def main() -> None:
    """Fuzz one target in this process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target")
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--own", action="store_true", help="own mutations, even if atheris is installed")
    args = parser.parse_args()
    logging.getLogger("python_multipart").setLevel(logging.CRITICAL)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    with _folder(args.folder) as folder:
        if importlib.util.find_spec("atheris") and not args.own:
            _atheris(args.target, args.count, args.seconds, args.seed, folder)
        else:
            from .targets import TARGETS

            _measure_memory_once()
            _loop(TARGETS[args.target], args.count, args.seconds, args.seed, folder)
            print((folder / "state.json").read_text())


@contextlib.contextmanager
def _folder(chosen: Path | None) -> Iterator[Path]:
    if chosen is not None:
        yield chosen
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


if __name__ == "__main__":
    main()
