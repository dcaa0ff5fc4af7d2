"""Compiles the kernels in other ways than ``core/kernels/build.py`` does, into folders of their own under ``build``."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shlex
import shutil
import subprocess
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

from .declared import dispatch

__all__ = [
    "BUILD",
    "COVERAGE",
    "HERE",
    "KERNELS",
    "ROOT",
    "SANITIZERS",
    "build",
    "compiled",
    "preloaded",
    "sanitizing_compiler",
]

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
KERNELS = ROOT / "core" / "kernels"
BUILD = ROOT / "build" / "kernels"

#: A fault ends the program. Dividing by zero is no fault in floating point, where it has a result.
SANITIZERS = (
    *("-g", "-fno-omit-frame-pointer", "-fno-sanitize-recover=all"),
    "-fsanitize=address,undefined,float-cast-overflow",
)
#: Besides, count which lines run: an optimised return is counted for another.
COVERAGE = ("-O0", "--coverage")

#: Those of gcc: another compiler has others.
_WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Werror")


@cache
def build() -> ModuleType:
    """``core/kernels/build.py``."""
    spec = importlib.util.spec_from_file_location("lodestream_kernels_build", KERNELS / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def sanitizing_compiler() -> str | None:
    """gcc or clang, whichever can link a program with sanitizers; None where neither can."""
    for name in ("gcc", "clang"):
        if shutil.which(name):
            command = [name, *SANITIZERS, "-x", "c", "-", "-o", "/dev/null"]
            done = subprocess.run(command, input="int main(void) { return 0; }", capture_output=True, text=True)
            if done.returncode == 0:
                return name
    return None


def preloaded(compiler: str) -> str:
    """The runtime of AddressSanitizer, which must be loaded before Python is."""
    names = ["libasan.so"] if compiler == "gcc" else ["libclang_rt.asan-x86_64.so", "libclang_rt.asan.so"]
    for name in names:
        found = Path(_printed([compiler, f"-print-file-name={name}"]).strip())
        if found.is_absolute():
            return str(found.resolve())
    raise FileNotFoundError(f"expected a {' or '.join(names)} of {compiler}, got none")


def _printed(command: Sequence[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _run(command: Sequence[str]) -> None:
    # zig keeps what it has compiled in the home folder, which a build need not have.
    caches = {name: str(BUILD / "zig-cache") for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")}
    done = subprocess.run(command, env={**caches, **os.environ}, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{shlex.join(command)} ended with {done.returncode}:\n{done.stderr.strip()}")


@dataclass(frozen=True)
class _Unit:
    """A file to compile, the command that does it, and what it includes."""

    source: Path
    command: tuple[str, ...]
    headers: tuple[Path, ...]
    target: Path

    def make(self, version: str) -> None:
        """Compile it, unless that was done with the same sources by the same compiler."""
        digest = hashlib.sha256(repr((self.command, version)).encode())
        for path in (self.source, *self.headers):
            digest.update(path.read_bytes() + b"\0")
        stamp = self.target.with_suffix(".stamp")
        if self.target.exists() and stamp.exists() and stamp.read_text() == digest.hexdigest():
            return
        stamp.unlink(missing_ok=True)
        for old in self.target.parent.glob(f"{self.target.stem}.gc*"):  # counts of the lines of other sources
            old.unlink()
        _run([*self.command, "-c", str(self.source), "-o", str(self.target)])
        stamp.write_text(digest.hexdigest())


def compiled(
    name: str,
    compiler: Sequence[str],
    flags: Sequence[str],
    beside: Sequence[str] = (),
    kernel_flags: Sequence[str] = (),
    link_flags: Sequence[str] = (),
    kernels: Path = KERNELS,
    names: Collection[str] | None = None,
    folder: Path | None = None,
) -> Path:
    """A library or a program of the kernels; what has not changed is not compiled again.

    Parameters
    ----------
    name : str
        Of the file; a library's ends with ``.so``.
    compiler : sequence of str
        Its command.
    flags : sequence of str
        Of all files, behind those of ``build.py`` but ``-shared``.
    beside : sequence of str
        C files in this folder that go with the kernels; with ``calls.c`` there is also the table of `declared`.
    kernel_flags : sequence of str
        Of the kernels alone.
    link_flags : sequence of str
        Of the whole.
    kernels : Path
        Where the kernels' sources are.
    names : collection of str or None
        The kernels of the table; None: all.
    folder : Path or None
        Where to; None: ``BUILD`` and the name, without what comes after a point.

    Returns
    -------
    Path

    Raises
    ------
    RuntimeError
        When the compiler fails; with what it said.
    """
    folder = folder or BUILD / name.removesuffix(".so")
    folder.mkdir(parents=True, exist_ok=True)
    flags = [*(flag for flag in build().FLAGS if flag != "-shared"), *flags, f"-I{kernels}", f"-I{HERE}"]
    command = (*compiler, *flags, *(_WARNINGS if compiler[0] == "gcc" else ["-w"]))
    define = f'-DLODE_SOURCES="{build().fingerprint()}"'
    inside, outside = tuple(sorted(kernels.glob("*.h"))), (*sorted(HERE.glob("*.h")), kernels / "lodestream.h")

    def unit(source: Path, headers: tuple[Path, ...], *more: str) -> _Unit:
        return _Unit(source, (*command, *more), headers, folder / f"{source.stem}.o")

    units = [unit(path, inside, *kernel_flags, define) for path in sorted(kernels.glob("*.c"))]
    units += [unit(HERE / other, outside) for other in beside]
    if "calls.c" in beside:
        (folder / "dispatch.c").write_text(dispatch(names))
        units.append(unit(folder / "dispatch.c", outside))
    version = _printed([*compiler, "--version"])
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda item: item.make(version), units))
    shared = ["-shared"] if name.endswith(".so") else []
    _run([*command, *link_flags, *shared, *(str(item.target) for item in units), "-o", str(folder / name)])
    return folder / name
