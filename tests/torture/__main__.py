"""``make torture``: what takes too long for every run of the tests, and the page that says what it did.

Without names every part runs, and docs/reliability.md is written, again whenever a part ends: a run that is interrupted
leaves what there is. ``--seconds 300 fuzz=600`` is the most that each part may take which can be cut short; it then
says how far it came. ``--count`` makes each part that many times as large.

A machine that is not free for so long: ``--resume FOLDER`` keeps what was done in a folder, and goes on from there when
it is given again, for the same program. What a part had begun is begun again, but for faults, fuzz and kernels.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import signal
import sys
import threading
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import lodestream

from .lanes import Lanes, Wish
from .parts import PARTS, Part, Result

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"

_MARK = "## One run\n"


def main() -> int:
    """Run the parts; 1 when one of them failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.torture", description=__doc__)
    parser.add_argument("part", nargs="*", help=f"of {', '.join(PARTS)}; all when none is named")
    parser.add_argument(
        "--seconds",
        metavar="S",
        type=_limit,
        nargs="+",
        default=[],
        help="the most that a part may take which can be cut short: of all parts, or PART=S of one",
    )
    parser.add_argument("--count", type=float, default=1.0, help="how many times the usual counts (default: 1)")
    parser.add_argument(
        "--page", type=Path, help="where to write the page (default: docs/reliability.md, for all parts)"
    )
    parser.add_argument("--resume", metavar="FOLDER", type=Path, help="keep what is done there, and go on from there")
    args = parser.parse_args()
    if args.resume is not None and not _of_this_program(args.resume):
        parser.error(f"expected a folder of runs of this program, got {args.resume}, of another version")
    unknown = sorted(set(args.part) - PARTS.keys())
    if unknown:
        parser.error(f"expected parts of {', '.join(PARTS)}, got {', '.join(unknown)}")
    limits = dict(args.seconds)
    wishes = [
        Wish(part, max(1, int(part.count * args.count)), limits.get(name, limits.get("")))
        for name, part in PARTS.items()
        if not args.part or name in args.part
    ]
    page = Page(args.page or (None if args.part else PAGE), [wish.part for wish in wishes])
    print("\n".join(page.machine), flush=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        Lanes(page.begun, page.ended, args.resume).run(wishes)
    except KeyboardInterrupt:
        print(f"\n{page.state()}")
        return 130
    finally:
        page.write()
    print(f"\n{page.state()}")
    return 1 if any(result.failure for result in page.results.values()) else 0


class Page:
    """The page, which is written again whenever a part ends.

    Parameters
    ----------
    path : Path or None
        None writes none.
    parts : list of Part
        What is to be done.

    Attributes
    ----------
    machine : list of str
    results : dict of str to Result
        What has been done, by the names of the parts.
    """

    def __init__(self, path: Path | None, parts: list[Part]) -> None:
        self.machine = _machine()
        self.results: dict[str, Result] = {}
        self._path = path
        self._parts = parts
        self._started = time.monotonic()
        self._lock = threading.Lock()

    def begun(self, part: Part) -> None:
        """A part has begun."""
        with self._lock:
            print(f"\n{part.name} begins, {_duration(time.monotonic() - self._started)} after the start", flush=True)

    def ended(self, result: Result) -> None:
        """A part has ended."""
        with self._lock:
            self.results[result.part.name] = result
            print("\n" + "\n".join(_lines(result)), flush=True)
        self.write()

    def state(self) -> str:
        """How long it took, and what is not done."""
        taken = _duration(time.monotonic() - self._started)
        left = [f"`{part.name}`" for part in self._parts if part.name not in self.results]
        if left:
            return f"**Interrupted, or not yet at its end**, after {taken}: {', '.join(left)} had not ended."
        return f"All together, parts side by side: {taken}."

    def write(self) -> None:
        """Write it."""
        with self._lock:
            if self._path is None or not self.results:
                return
            lines = ["", *self.machine, "", self.state()]
            for part in self._parts:
                if part.name in self.results:
                    lines += ["", *_lines(self.results[part.name])]
            before = self._path.read_text().partition(_MARK)[0] if self._path.exists() else ""
            new = self._path.with_suffix(".new")
            new.write_text(before + _MARK + "\n".join(lines) + "\n")
            new.replace(self._path)


def _of_this_program(folder: Path) -> bool:
    """Whether what is kept in a folder, which is made if it is not there, is of these sources."""
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for path in sorted(
        path for part in ("core", "server", "client", "tests") for path in (root / part).rglob("*.[pch]*")
    ):
        if path.suffix in (".py", ".c", ".h"):
            digest.update(f"{path.relative_to(root)} {path.stat().st_size}\n".encode() + path.read_bytes())
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "program"
    if not file.exists():
        file.write_text(digest.hexdigest())
    return file.read_text() == digest.hexdigest()


def _limit(text: str) -> tuple[str, float]:
    name, _, seconds = text.rpartition("=")
    if name and name not in PARTS:
        raise argparse.ArgumentTypeError(f"expected a part of {', '.join(PARTS)}, got {name}")
    return name, float(seconds)


def _machine() -> list[str]:
    from benchmarks.__main__ import processor

    packages = []
    for name in ("numpy", "fastapi", "starlette", "uvicorn", "websockets", "hypothesis", "atheris"):
        try:
            packages.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            packages.append(f"no {name}")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    system = f"{platform.system()} {platform.release().split('-')[0]}"
    return [
        f"- {os.cpu_count()} x {processor()}, {memory:.0f} GiB, {system}; load when it began: {os.getloadavg()[0]:.1f}",
        f"- Lodestream {lodestream.__version__}, Python {platform.python_version()}, {', '.join(packages)}",
        f"- begun {time.strftime('%Y-%m-%d %H:%M', time.gmtime())} UTC",
    ]


def _lines(result: Result) -> list[str]:
    done = f"{result.cases:,} in {_duration(result.seconds)}"
    if result.failure:
        done = f"**failed** after {_duration(result.seconds)}"
    elif result.cases < result.wanted:
        done += f", **of {result.wanted:,}**"
    lines = [f"### {result.part.title}", "", f"`{result.part.name}` ({result.part.unit}): {done}.", ""]
    if result.failure:
        return [*lines, "```text", *result.failure.strip().splitlines()[-40:], "```"]
    if any(fact.startswith("|") for fact in result.facts):
        return [*lines, *(fact.replace("###", "####") for fact in result.facts)]
    return [*lines, *(f"- {fact}" for fact in result.facts)]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


if __name__ == "__main__":
    sys.exit(main())
