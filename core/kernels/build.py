"""Compiles the kernels into one shared library: when the package is installed, and for `make` in a working tree.

``python core/kernels/build.py`` compiles into ``core/lodestream/native`` unless the library there was made from these
sources. It takes ``CC``, else the machine's ``cc``, else the C compiler of the ``ziglang`` wheel.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # run by hand, where hatchling need not be
    BuildHookInterface = object

KERNELS = Path(__file__).resolve().parent
NATIVE = KERNELS.parent / "lodestream" / "native"
ZIG = "ziglang>=0.13,<0.17"

#: The same bits with every compiler: nothing is fused, and what the flags forbid the code does without.
FLAGS = [
    *("-std=c11", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off"),
    *("-fno-math-errno", "-fno-trapping-math", "-fno-strict-aliasing"),
]
_BASELINE = {"x86_64": ["-march=x86-64-v2"], "AMD64": ["-march=x86-64-v2"]}


def sources() -> list[Path]:
    """The files that are compiled."""
    return sorted(KERNELS.glob("*.c"))


def fingerprint() -> str:
    """A hash of all that the library is made from: 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for path in sorted([*KERNELS.glob("*.[ch]"), Path(__file__)]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def library_name(system: str = sys.platform, machine: str = platform.machine()) -> str:
    """What the library of a platform is called."""
    suffix = {"darwin": "dylib", "win32": "dll"}.get(system, "so")
    return f"lodestream-{system}-{machine.lower()}.{suffix}"


def compiler() -> list[str] | None:
    """The command of the C compiler: ``CC``, else ``cc``, else zig's; None where there is none."""
    if os.environ.get("CC"):
        return shlex.split(os.environ["CC"])
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if found:
        return [found]
    try:
        import ziglang  # noqa: F401
    except ImportError:
        return None
    return [sys.executable, "-m", "ziglang", "cc"]


def compile_library(target: Path, command: list[str] | None = None, flags: list[str] | None = None) -> None:
    """Compile into ``target``, aside and renamed, so that nobody loads half of it.

    Parameters
    ----------
    target : Path
    command : list of str or None
        The compiler; None: `compiler`.
    flags : list of str or None
        Behind `FLAGS`; None: those of this machine's baseline, and what leaves out symbols.

    Raises
    ------
    RuntimeError
        Where there is no compiler, or it fails; with what it said.
    """
    command = command or compiler()
    if command is None:
        raise RuntimeError("expected a C compiler: set CC, install cc, or pip install ziglang; found none")
    if flags is None:
        flags = _BASELINE.get(platform.machine(), []) + ([] if sys.platform == "win32" else ["-s"])
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".building-") as folder:
        made = Path(folder) / target.name
        define = f'-DLODE_SOURCES="{fingerprint()}"'
        arguments = [*command, *FLAGS, *flags, define, *map(str, sources()), "-o", str(made)]
        # zig keeps what it has compiled in the home folder, which a build need not have.
        environment = {"ZIG_GLOBAL_CACHE_DIR": folder, "ZIG_LOCAL_CACHE_DIR": folder, **os.environ}
        done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{shlex.join(command)} ended with {done.returncode}:\n{done.stderr.strip()}")
        made.replace(target)


def is_current(target: Path) -> bool:
    """Whether a library was made from these sources."""
    return target.exists() and fingerprint().encode() in target.read_bytes()


class Hook(BuildHookInterface):  # type: ignore[misc]  # hatchling comes without types where it is not installed
    """hatchling's part: the library goes into the wheel, which is then one of this platform, for every Python."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """What building needs beside hatchling."""
        return [] if compiler() else [ZIG]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and say what the wheel holds."""
        if self.target_name != "wheel":
            return
        target = NATIVE / library_name()
        if not is_current(target):
            compile_library(target)
        build_data["artifacts"].append(f"core/lodestream/native/{target.name}")
        build_data["pure_python"] = False
        tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{tag}"


if __name__ == "__main__":
    LIBRARY = NATIVE / library_name()
    if not is_current(LIBRARY):
        compile_library(LIBRARY)
        print(f"compiled {LIBRARY.relative_to(Path.cwd()) if LIBRARY.is_relative_to(Path.cwd()) else LIBRARY}")
