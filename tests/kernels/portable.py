"""``make portable``: the same bits from the kernels whatever compiles them, and on other machines.

The calls of kernels of `scenes` are recorded with the library that is installed here: every golden file is decoded at
every layer and level, and encoded anew. Then they are made again by programs that other compilers have made, with and
without optimisation, and for machines of other kinds, which ``qemu-user`` imitates: one of them stores numbers with
the highest byte first. Under wine a program loads the library of the wheel for Windows. What they return and what they
leave in memory is compared bit for bit.

``python -m tests.kernels.portable`` takes what there is on this machine and names what is missing; ``--zig`` installs
the ``ziglang`` wheel into ``build`` for it.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lodestream.library import library, library_name, wide_name

from .compiling import BUILD, HERE, KERNELS, build, compiled
from .declared import declarations, dispatch
from .recording import recorded
from .scenes import SCENES, check

__all__ = ["Build", "Replayed", "builds", "compare"]

#: Machines of other kinds, as Debian calls their compilers and zig its targets.
MACHINES = {
    "aarch64": ("aarch64-linux-gnu-gcc", "aarch64-linux-musl"),
    "s390x": ("s390x-linux-gnu-gcc", "s390x-linux-musl"),
}

_LEVELS = ("-O0", "-O3")

#: The wheel whose library is run by wine, and the compiler of the program that loads it: for one with a C library zig
#: takes a quarter of an hour.
_WINDOWS = "windows-x86_64"
_MINGW = "x86_64-w64-mingw32-gcc"
_FILES = ["calls.c", "replay.c"]


@dataclass(frozen=True)
class Build:
    """A way to compile the kernels, and to run them.

    Attributes
    ----------
    compiler : str
        For people.
    machine : str
    command, flags, runner : tuple of str
        Of the compiler; its flags; what runs the program, empty where this machine does.
    """

    compiler: str
    machine: str
    command: tuple[str, ...]
    flags: tuple[str, ...]
    runner: tuple[str, ...] = ()

    @property
    def is_of_windows(self) -> bool:
        """Whether the program loads the library of the wheel for Windows, and has no kernels of its own."""
        return self.machine == _WINDOWS


def builds() -> Iterator[Build | str]:
    """All that can be had on this machine, and why others cannot."""
    for name in ("gcc", "clang"):
        if shutil.which(name):
            yield from _here(_version(name), (name,))
        else:
            yield f"{name}: not on this machine"
    zig = _zig()
    if zig is None:
        yield "zig: not on this machine"
    else:
        yield from _here(_zig_version(zig), zig)
    for machine, (cross, target) in MACHINES.items():
        runner = shutil.which(f"qemu-{machine}") or shutil.which(f"qemu-{machine}-static")
        if machine == platform.machine():
            continue
        if runner is None:
            yield f"{machine}: no qemu-{machine} on this machine (Debian's qemu-user)"
        elif shutil.which(cross):
            for level in _LEVELS:
                yield Build(_version(cross), machine, (cross,), (level, "-static"), (runner,))
        elif zig is not None:
            for level in _LEVELS:
                yield Build(_zig_version(zig), machine, zig, (level, "-static", "-target", target), (runner,))
        else:
            yield f"{machine}: neither {cross} nor zig on this machine"
    yield _windows(zig)


class Replayed:
    """What one build has made of the calls so far.

    Raises
    ------
    RuntimeError
        When the kernels cannot be compiled.
    """

    def __init__(self, build_: Build) -> None:
        self.build = build_
        self.seconds = 0.0
        self.wrong: list[str] = []
        name = f"replay-{build_.machine}-{build_.compiler.partition(' ')[0]}{build_.flags[0]}"
        if build_.is_of_windows:
            self._program = _program_of_windows(build_)
        else:
            self._program = compiled(name, build_.command, build_.flags, _FILES)

    def replay(self, scene: str, calls: Path) -> None:
        """Make the calls of a scene again, and compare."""
        started = time.monotonic()
        command = [*self.build.runner, str(self._program), str(calls)]
        wine = {"WINEPREFIX": str(BUILD / "wine"), "WINEDEBUG": "-all"}
        done = subprocess.run(command, env=os.environ | wine, capture_output=True, text=True, errors="replace")
        self.seconds += time.monotonic() - started
        if done.returncode or not done.stdout.endswith("the same\n"):
            self.wrong.append(f"{scene}: {done.stdout}{done.stderr}")

    def __str__(self) -> str:
        words = f"**different** in {len(self.wrong)} scenes" if self.wrong else "the same"
        cells = (self.build.compiler, self.build.flags[0], self.build.machine, words, f"{self.seconds:.0f}")
        return f"| {' | '.join(cells)} |"


def _here(compiler: str, command: tuple[str, ...]) -> Iterator[Build]:
    """The builds of a compiler for this machine, as the installed libraries are told of its processor."""
    wide = wide_name() is not None and library().lode_runs_v3()
    for level, v3 in ((_LEVELS[0], False), (_LEVELS[1], False), *([(_LEVELS[1], True)] if wide else [])):
        processor = [flag for flag in build().machine_flags(list(command), v3=v3) if flag.startswith("-m")]
        yield Build(compiler, f"{platform.machine()}{'-v3' * v3}", command, (level, *processor))


def _windows(zig: tuple[str, ...] | None) -> Build | str:
    """The build of the library for Windows; or why it cannot be run."""
    wine = shutil.which("wine")
    if wine is None or shutil.which(_MINGW) is None or zig is None:
        missing = {"wine": wine, f"{_MINGW} (Debian's gcc-mingw-w64-x86-64)": shutil.which(_MINGW), "zig": zig}
        return f"windows: no {', no '.join(name for name, there in missing.items() if not there)} on this machine"
    return Build(_zig_version(zig), _WINDOWS, zig, (_LEVELS[1],), (wine,))


def _program_of_windows(build_: Build) -> Path:
    """Compile the library of a wheel for Windows, and a program that loads it from its own folder."""
    folder = BUILD / f"replay-{_WINDOWS}"
    folder.mkdir(parents=True, exist_ok=True)
    wanted = build().PLATFORMS[_WINDOWS]
    loaded = folder / str(library_name(wanted.system, wanted.machine))
    build().compile_library(loaded, list(build_.command), wanted)
    (folder / "dispatch.c").write_text(dispatch(None))
    sources = [*(str(HERE / name) for name in _FILES), str(folder / "dispatch.c"), str(loaded)]
    command = [_MINGW, "-std=c11", "-O2", "-static", f"-I{KERNELS}", f"-I{HERE}", *sources]
    done = subprocess.run([*command, "-o", str(folder / "replay.exe")], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{_MINGW} ended with {done.returncode}:\n{done.stderr}")
    return folder / "replay.exe"


def _version(command: str) -> str:
    said = subprocess.run([command, "--version"], capture_output=True, text=True, check=True).stdout
    words = [word for word in said.splitlines()[0].split() if word[0].isdigit()]
    return f"{'clang' if 'clang' in command else 'gcc'} {words[-1]}"


def _zig() -> tuple[str, ...] | None:
    if importlib.util.find_spec("ziglang"):
        return (sys.executable, "-m", "ziglang", "cc")
    unpacked = BUILD / "ziglang" / "ziglang" / "zig"
    return (str(unpacked), "cc") if unpacked.exists() else None


def _zig_version(command: tuple[str, ...]) -> str:
    said = subprocess.run([*command[:-1], "version"], capture_output=True, text=True, check=True).stdout
    return f"zig {said.strip()}"


def main() -> int:
    """Compare all builds, and print a table of them; 1 where one differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.kernels.portable", description=__doc__)
    parser.add_argument("--zig", action="store_true", help="install ziglang into build, where there is none")
    parser.add_argument("word", nargs="*", help="only scenes whose names contain one of these words")
    args = parser.parse_args()
    scenes = {name: scene for name, scene in SCENES.items() if not args.word or any(word in name for word in args.word)}
    BUILD.mkdir(parents=True, exist_ok=True)
    if args.zig and _zig() is None:
        where = BUILD / "ziglang"
        subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "--target", str(where), build().ZIG])
    found = list(builds())
    replayed = [Replayed(item) for item in found if isinstance(item, Build)]
    calls, size = compare(replayed, scenes)
    if not args.word:
        check(calls)
    called = sum(count > 0 for count in calls.values())
    print(f"{sum(calls.values()):,} calls of {called} kernels in {len(scenes)} scenes, {size / 2**20:.0f} MiB\n")
    print("| compiler | | machine | calls made again | seconds |\n| --- | --- | --- | --- | ---: |")
    print("\n".join(map(str, replayed)))
    print("\n".join(["", *(f"Skipped: {item}" for item in found if isinstance(item, str))]))
    for item in replayed:
        print("\n".join(f"{item.build.compiler} {item.build.machine}, {words}" for words in item.wrong[:3]))
    return 1 if any(item.wrong for item in replayed) else 0


def compare(replayed: Sequence[Replayed], scenes: Mapping[str, Callable[[], None]]) -> tuple[dict[str, int], int]:
    """Record scene after scene and let every build make its calls again; the calls of each kernel, and their bytes."""
    path, calls, size = BUILD / "scene.calls", dict.fromkeys(declarations(), 0), 0
    for name, scene in scenes.items():
        with recorded(path) as recorder:
            scene()
        size += path.stat().st_size
        for kernel, count in recorder.calls.items():
            calls[kernel] += count
        if any(recorder.calls.values()):
            for item in replayed:
                item.replay(name, path)
    path.unlink()
    return calls, size


if __name__ == "__main__":
    sys.exit(main())
