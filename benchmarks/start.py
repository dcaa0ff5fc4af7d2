"""What a new user installs and waits for: an environment of its own, made from the wheel, and its first commands."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
import venv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from .arrays import ROOT
from .measure import note, table

SIDE = 65
ROUNDS = 9
STARTS = 3
PATIENCE = 300.0

#: Not counted: numpy, which every user of arrays has, and what makes environments.
BESIDE = ("numpy", "pip", "setuptools", "_distutils_hack", "distutils-precedence")

#: What each command may take: so many times `import numpy`, and so many seconds more.
AIMS = {"--help": (2, 0.0), "decode": (3, 0.2), "encode": (4, 0.0)}
MOST_INSTALLED, MOST_WHEEL, MOST_SECONDS = 25e6, 1e6, 2.0


@dataclass
class Runs:
    """Seconds of a command: by the clock, and of processors."""

    clock: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """Seconds of processors."""
        return statistics.median(self.processor)


def main() -> None:
    """Print sizes and times."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            _measure(Path(folder))
        except subprocess.CalledProcessError as error:
            print(f"\nskipped: sizes and times of a new installation ({(error.stderr or '').strip()[-500:]})")


def _measure(folder: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    _run([*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)])
    (wheel,) = folder.glob("*.whl")
    environment = folder / "environment"
    venv.create(environment)
    install = [*pip, "--python", str(environment / "bin" / "python"), "install", "--quiet"]
    _run([*install, str(wheel)])
    _print_sizes(wheel, environment)
    points = np.add.outer(np.sqrt(np.arange(SIDE)), np.cos(np.arange(SIDE) / 9))
    np.save(folder / "surface.npy", points)
    _print_times(folder, environment / "bin")
    _run([*install, f"{wheel}[server]"])
    _print_server(folder, environment / "bin")


def _print_sizes(wheel: Path, environment: Path) -> None:
    (packages,) = environment.glob("lib/python*/site-packages")
    sizes = {path.name: _size(path) for path in packages.iterdir()}
    counted = {name: size for name, size in sizes.items() if not name.startswith(BESIDE)}
    rows = [
        ["the wheel", _megabytes(wheel.stat().st_size), f"below {_megabytes(MOST_WHEEL)}"],
        ["all that it installs, beside numpy", _megabytes(sum(counted.values())), f"{_megabytes(MOST_INSTALLED)}"],
        ["numpy", _megabytes(sum(size for name, size in sizes.items() if name.startswith("numpy"))), ""],
    ]
    table("Size of the client without extras", ["", "MB", "at most"], rows)
    largest = sorted(counted, key=counted.__getitem__, reverse=True)[:6]
    note("The largest: " + ", ".join(f"{name} {_megabytes(counted[name])}" for name in largest) + ".")


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.1f}"


def _print_times(folder: Path, programs: Path) -> None:
    lodestream = str(programs / "lodestream")
    surface, container = str(folder / "surface.npy"), str(folder / "surface.lode")
    numpy = "import numpy"
    commands = {
        numpy: [str(programs / "python"), "-c", numpy],
        "--help": [lodestream, "--help"],
        "encode": [lodestream, "encode", surface, container],
        "decode": [lodestream, "decode", container, str(folder / "again.npy")],
    }
    runs = {name: Runs() for name in commands}
    for _ in range(ROUNDS):
        for name, command in commands.items():
            before = _processor()
            started = time.perf_counter()
            _run(command, _plain(folder))
            runs[name].clock.append(time.perf_counter() - started)
            runs[name].processor.append(_processor() - before)
    base = runs[numpy].median
    rows = []
    for name, timed in runs.items():
        times, more = AIMS.get(name, (0, 0.0))
        aim = f"{times} x{f' + {more:g} s' if more else ''} = {times * base + more:.2f}" if times else ""
        clock = [f"{seconds:.2f}" for seconds in (timed.clock[0], statistics.median(timed.clock))]
        rows.append([name, *clock, f"{timed.median:.2f}", f"{timed.median / base:.2f}", aim])
    head = ["command", "first, s", "median, s", "of processors, s", "x import numpy", "at most"]
    table(f"Commands on a surface of {SIDE} x {SIDE} float64", head, rows)
    note(f"The first run of each after the installation, and the medians of {ROUNDS}; ratios are of processor time.")


def _print_server(folder: Path, programs: Path) -> None:
    runs = Runs()
    for _ in range(STARTS):
        clock, processor = _ready(folder, programs)
        runs.clock.append(clock)
        runs.processor.append(processor)
    clocks = [f"{seconds:.2f}" for seconds in (runs.clock[0], statistics.median(runs.clock))]
    head = ["", "first, s", "median, s", "of processors, s", "at most, s"]
    table("The server", head, [["ready", *clocks, f"{runs.median:.2f}", f"{MOST_SECONDS:.2f}"]])
    note("From its start to the first answer 200 of /readyz, with its fork server.")


def _ready(folder: Path, programs: Path) -> tuple[float, float]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [str(programs / "lodestream"), "serve", "--port", str(port), "--data", str(folder / "data")]
    command += ["--unconfined"]  # on any machine
    started = time.perf_counter()
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, env=_plain(folder), cwd=folder, stdout=quiet, stderr=quiet) as server:
        try:
            while server.poll() is None and time.perf_counter() - started < PATIENCE:
                with contextlib.suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz") as answer:
                    if answer.status == 200:
                        seconds = time.perf_counter() - started
                        ours = psutil.Process(server.pid)
                        times = [process.cpu_times() for process in (ours, *ours.children(recursive=True))]
                        return seconds, sum(one.user + one.system for one in times)
                time.sleep(0.02)
        finally:
            server.terminate()
    raise RuntimeError(f"the server was not ready within {PATIENCE:g} s")


def _plain(folder: Path) -> dict[str, str]:
    """An environment in which nothing of the working tree is found, and nothing is kept from before."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "NUMBA", "LODESTREAM"))}
    return {**kept, "HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}


def _processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _run(command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
    folder = None if environment is None else environment["HOME"]
    subprocess.run(command, check=True, capture_output=True, text=True, env=environment, cwd=folder)
