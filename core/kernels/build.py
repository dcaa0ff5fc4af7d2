"""Compiles the kernels into one shared library: when the package is installed, and for `make` in a working tree.

``python core/kernels/build.py`` compiles into ``core/lodestream/native`` unless the library there was made from these
sources. It takes ``CC``, else the machine's ``cc``, ``gcc`` or ``clang``, else the C compiler of the ``ziglang`` wheel.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # run by hand, where hatchling need not be
    BuildHookInterface = object

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
try:
    from lodestream.library import KERNELS, NATIVE, fingerprint, is_cut_off, library_name, wide_name
finally:
    del sys.path[0]

#: The versions whose C compiler was tried.
ZIG = "ziglang>=0.15,<0.18"

#: The same bits with every compiler: nothing is fused, and what the flags forbid the code does without.
FLAGS = [
    *("-std=c11", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off"),
    *("-fno-math-errno", "-fno-trapping-math", "-fno-strict-aliasing"),
]

#: The processor that x86-64-v2 names, in words that compilers knew before that name.
_X86_64_V2 = ["-msse4.2", "-mpopcnt", "-mcx16", "-msahf"]
#: And what x86-64-v3 has beyond it, for the second library.
_X86_64_V3 = ["-mavx2", "-mbmi", "-mbmi2", "-mf16c", "-mfma", "-mlzcnt", "-mmovbe"]
#: All that the second library holds: what takes 1.3 times as long without it, or longer.
WIDE = ("library.c", "inverse.c", "lifting.c", "predictor_fit.c", "values.c")


class Platform(NamedTuple):
    """What a wheel is made for.

    Attributes
    ----------
    system, machine : str
        As `sys.platform` and `platform.machine` say there.
    target : str
        zig's name of it, with the oldest version of the system.
    tag : str
        The wheel's.
    """

    system: str
    machine: str
    target: str
    tag: str


def _linux(machine: str) -> Platform:
    """Every Linux: the library needs no libc, so any that Python runs with will do."""
    tag = f"manylinux_2_17_{machine}.manylinux2014_{machine}.musllinux_1_2_{machine}"
    return Platform("linux", machine, f"{machine}-linux-gnu.2.17", tag)


#: By the name that ``LODESTREAM_WHEEL_FOR`` takes.
PLATFORMS = {
    "linux-x86_64": _linux("x86_64"),
    "linux-aarch64": _linux("aarch64"),
    "macos-x86_64": Platform("darwin", "x86_64", "x86_64-macos.11.0", "macosx_11_0_x86_64"),
    "macos-arm64": Platform("darwin", "arm64", "aarch64-macos.11.0", "macosx_11_0_arm64"),
    "windows-x86_64": Platform("win32", "AMD64", "x86_64-windows-gnu", "win_amd64"),
}


def sources(v3: bool = False) -> list[Path]:
    """The files that are compiled into the library, or into the second one, for x86-64-v3."""
    return [KERNELS / name for name in WIDE] if v3 else sorted(KERNELS.glob("*.c"))


def _is_zig(command: list[str]) -> bool:
    return any(Path(word).name in ("zig", "ziglang") for word in command)


def zig() -> list[str]:
    """The command of the C compiler in the ``ziglang`` wheel."""
    return [sys.executable, "-m", "ziglang", "cc"]


def machine_flags(command: list[str], wanted: Platform | None = None, *, v3: bool = False) -> list[str]:
    """Return what a compiler is told of the machine: the least processor that is served, and what to leave out.

    Parameters
    ----------
    command : list of str
        The compiler. zig takes the processor that it runs on and links a libc unless it is told not to.
    wanted : Platform or None
        None: this one.
    v3 : bool
        For x86-64-v3.
    """
    system, machine = (wanted.system, wanted.machine) if wanted else (sys.platform, platform.machine())
    wide = machine in ("x86_64", "AMD64")
    strip = ["-s"] if wanted or system == "linux" else []
    if not _is_zig(command):
        return (_X86_64_V2 if wide else []) + (_X86_64_V3 if v3 else []) + strip
    target = ["-target", wanted.target] if wanted else []
    # The kernels need no C library. On macOS, which has it everywhere, no shared library goes without it; for Windows
    # zig would compile it first, for a quarter of an hour.
    alone = [] if system == "darwin" else ["-nostdlib", "-rtlib=compiler-rt"]
    if system == "win32":
        alone.append("-DLODE_WITHOUT_LIBC")
    return [*target, f"-mcpu=x86_64_v{3 if v3 else 2}" if wide else "-mcpu=baseline", *alone, *strip]


def _run(command: list[str], flags: list[str], files: list[Path], target: Path) -> str:
    """Compile aside and rename, so that nobody loads half a library; what went wrong, else nothing."""
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".building-") as folder:
        made = Path(folder, target.name)
        define = f'-DLODE_SOURCES="{fingerprint()}"'
        # zig keeps what it has compiled in the home folder, which a build need not have.
        environment = {"ZIG_GLOBAL_CACHE_DIR": folder, "ZIG_LOCAL_CACHE_DIR": folder, **os.environ}
        # A library for macOS would tell the place where it was compiled.
        name = [f"-Wl,-install_name,@rpath/{target.name}"] if target.suffix == ".dylib" else []
        arguments = [*command, *FLAGS, *flags, *name, define, *map(str, files), "-o", str(made)]
        try:
            done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
        except OSError as error:
            return f"{shlex.join(command)}: {error.strerror}"
        if done.returncode or not made.exists():
            return f"{shlex.join(command)} ended with {done.returncode}:\n{done.stderr.strip()}"
        made.replace(target)
    return ""


def compiler() -> list[str]:
    """The command of the C compiler: ``CC``, else the machine's if it makes a library, else zig's.

    Raises
    ------
    RuntimeError
        Where there is none; with what was tried, and what each said.
    """
    chosen = shlex.split(os.environ.get("CC", ""))
    if chosen:
        return chosen
    tried = []
    for name in ("cc", "gcc", "clang"):
        path = shutil.which(name)
        if path is None:
            tried.append(f"{name}: not found")
            continue
        with tempfile.TemporaryDirectory() as folder:
            wrong = _run([path], machine_flags([path]), [KERNELS / "library.c"], Path(folder, "library"))
        if not wrong:
            return [path]
        tried.append(wrong)
    if importlib.util.find_spec("ziglang"):
        return zig()
    tried.append("ziglang: not installed for this Python")
    raise RuntimeError(
        "expected a C compiler that makes shared libraries, to compile the kernels of Lodestream. Tried:\n"
        + "\n".join(tried)
        + "\nInstall one (on Debian: apt install gcc libc6-dev), or pip install ziglang, or set CC to a compiler."
    )


def compile_library(
    target: Path, command: list[str] | None = None, wanted: Platform | None = None, *, v3: bool = False
) -> None:
    """Compile into ``target``.

    Parameters
    ----------
    target : Path
    command : list of str or None
        The compiler; None: `compiler`.
    wanted : Platform or None
        None: this one.
    v3 : bool
        The second library, for x86-64-v3.

    Raises
    ------
    RuntimeError
        Where there is no compiler, or it fails; with what it said.
    """
    command = command or compiler()
    target.parent.mkdir(parents=True, exist_ok=True)
    wrong = _run(command, machine_flags(command, wanted, v3=v3), sources(v3), target)
    if wrong:
        raise RuntimeError(f"the kernels of Lodestream could not be compiled: {wrong}")


def compile_all(folder: Path, command: list[str] | None = None, wanted: Platform | None = None) -> list[Path]:
    """Compile the library into a folder, and on x86-64 the second one, for v3.

    Parameters
    ----------
    folder : Path
    command : list of str or None
        The compiler; None: `compiler`.
    wanted : Platform or None
        None: this one.

    Raises
    ------
    RuntimeError
        As `compile_library`.
    """
    command = command or compiler()
    made = libraries(folder, wanted)
    for number, target in enumerate(made):
        compile_library(target, command, wanted, v3=number > 0)
    return made


def libraries(folder: Path, wanted: Platform | None = None) -> list[Path]:
    """Return where the libraries of a platform, by default of this one, stand in a folder."""
    where = (wanted.system, wanted.machine) if wanted else (sys.platform, None)
    return [folder / name for name in (library_name(*where), wide_name(*where)) if name]


def is_current(target: Path) -> bool:
    """Whether a library was made from these sources, and is whole."""
    return target.exists() and str(fingerprint()).encode() in target.read_bytes() and not is_cut_off(target)


class Hook(BuildHookInterface):  # type: ignore[misc]  # hatchling comes without types where it is not installed
    """hatchling's part: the library goes into the wheel, which is then one of this platform, for every Python.

    A library of the tree that was made from these sources is taken as it is, unless ``CC`` names a compiler.
    With ``LODESTREAM_WHEEL_FOR=linux-aarch64``, or another of `PLATFORMS`, the wheel is made for that platform, by zig.
    """

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """What building needs beside hatchling: zig, unless a compiler is there or was chosen."""
        if os.environ.get("LODESTREAM_WHEEL_FOR"):
            return [ZIG]
        if self.target_name != "wheel" or os.environ.get("CC"):
            return []
        try:
            compiler()
        except RuntimeError:
            return [ZIG]
        return []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile: beside the sources for a package that stays among them, else aside, since those may be read-only."""
        if self.target_name != "wheel":
            return
        self._folder = tempfile.TemporaryDirectory()
        try:
            wanted = _wanted(os.environ.get("LODESTREAM_WHEEL_FOR"))
            if version == "editable":
                compile_all(NATIVE)
            else:
                for made in _compile_for_wheel(Path(self._folder.name), wanted):
                    build_data["force_include"][str(made)] = f"lodestream/native/{made.name}"
        except (RuntimeError, OSError) as error:
            self._folder.cleanup()
            raise SystemExit(str(error)) from None
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{wanted.tag if wanted else _platform_tag()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled aside."""
        if self.target_name == "wheel":
            self._folder.cleanup()


def _wanted(name: str | None) -> Platform | None:
    """Return the platform that a wheel is to be made for; None: this one."""
    if name and name not in PLATFORMS:
        raise RuntimeError(f"expected LODESTREAM_WHEEL_FOR to be one of {', '.join(PLATFORMS)}, got {name}")
    return PLATFORMS[name] if name else None


def _compile_for_wheel(folder: Path, wanted: Platform | None) -> list[Path]:
    """Return the libraries of a wheel: compiled into a folder, or those of the tree where these are what is wanted."""
    if wanted is not None:
        return compile_all(folder, zig(), wanted)
    present = [] if os.environ.get("CC") else libraries(NATIVE)
    return present if present and all(map(is_current, present)) else compile_all(folder)


def _platform_tag() -> str:
    """The platform of this Python and of no other: hatchling comes with `packaging`."""
    from packaging.tags import platform_tags

    return next(tag for tag in platform_tags() if not tag.startswith(("manylinux", "musllinux")))


def main() -> None:
    """Compile into the working tree unless that was done."""
    if all(map(is_current, libraries(NATIVE))):
        return
    try:
        made = compile_all(NATIVE)
    except (RuntimeError, OSError) as error:
        raise SystemExit(str(error)) from None
    print(f"compiled {', '.join(map(os.path.relpath, made))}")


if __name__ == "__main__":
    main()
