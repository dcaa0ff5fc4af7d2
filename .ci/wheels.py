"""Build the source distribution, and from it the wheels for Linux, macOS and Windows, and check them.

``python .ci/wheels.py FOLDER`` needs the group ``wheels`` of pyproject.toml. Each wheel is made by zig for a platform
that need not be this one. Its libraries are read: what they ask of others, what they offer, for which system they are.
Then what was made for this machine is installed, the source distribution twice: by the machine's compiler, if there is
one, and by zig.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import lief
from elftools.elf.dynamic import DynamicSection
from elftools.elf.elffile import ELFFile

ROOT = Path(__file__).resolve().parent.parent

#: What the processors of a wheel are in ELF, and the largest pages that Linux has there.
MACHINES = {"x86_64": ("EM_X86_64", 1 << 12), "aarch64": ("EM_AARCH64", 1 << 16)}
LINUX = ("manylinux_2_17", "musllinux_1_2")
#: What every macOS and every Windows since 10 has, so that delocate and delvewheel would add nothing.
SYSTEM_LIBRARIES = {
    "darwin": re.compile("/usr/lib/libSystem.B.dylib"),
    "win32": re.compile(r"kernel32\.dll|api-ms-win-crt-[a-z0-9-]+\.dll", re.IGNORECASE),
}
#: Of a wheel: what it has without the page of the browser (1.27 MB compressed, 710 kB of it the readers, the codec and
#: meshes in Python), and the page. Whoever exceeds it has packed something that does not belong there, or raises it.
MOST_BYTES = 1_400_000 + 270_000

CHECK = """
import numpy as np
import lodestream as ls
from lodestream.library import NATIVE, why_missing
from lodestream.page import assets, widget_modules
assert "index.html" in assets(), "the page of the browser is not there"
assert widget_modules() is not None, "the modules of widgets are not there"
assert why_missing() is None, why_missing()
points = np.sqrt(np.arange(12.0)).reshape(3, 4)
assert np.array_equal(ls.decode(ls.encode(points)).points, points)
print(*sorted(path.name for path in NATIVE.iterdir()))
"""


def _build_module() -> Any:
    """Return `core/kernels/build.py`, which no package has."""
    specification = importlib.util.spec_from_file_location("build_kernels", ROOT / "core/kernels/build.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


KERNELS = _build_module()


def build(folder: Path) -> list[Path]:
    """Build the source distribution, and a wheel from it for each platform, in this environment."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder)]
    # zig is an installed one already: an environment for each wheel would download it again, 100 MB each time.
    run([*command, "--sdist", str(ROOT)])
    print("built the source distribution", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as name:
        (sdist,) = folder.glob("*.tar.gz")
        with tarfile.open(sdist) as archive:
            archive.extractall(name, filter="data")
        (sources,) = Path(name).iterdir()
        # What zig compiles of C libraries and of its own is the same for all libraries of a platform.
        environment = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": f"{name}/.zig"}
        for number, platform_name in enumerate(KERNELS.PLATFORMS, 1):
            run([*command, "--wheel", str(sources)], environment | {"LODESTREAM_WHEEL_FOR": platform_name})
            print(f"built {number} of {len(KERNELS.PLATFORMS)}: {platform_name}", file=sys.stderr, flush=True)
    return sorted(folder.iterdir())


def check_wheel(wheel: Path, wanted: Any) -> None:
    """Check a wheel's size and its libraries, and what auditwheel says of one for Linux."""
    expect(wheel.stat().st_size < MOST_BYTES, f"{wheel.name} below {MOST_BYTES} bytes, got {wheel.stat().st_size}")
    with ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if name.startswith("lodestream/native/")]
        libraries = [f"lodestream/native/{path.name}" for path in KERNELS.libraries(Path(), wanted)]
        page = "lodestream/page/static/index.html"
        expect(page in archive.namelist(), f"{page} in {wheel.name}: it is built by make page")
        expect(sorted(names) == sorted(libraries), f"{libraries}, got {names}")
        for name in names:
            if wanted.system == "linux":
                check_library(archive.read(name), wanted.machine)
            else:
                check_other_library(archive.read(name), Path(name).name, wanted)
    if wanted.system == "linux":
        check_by_auditwheel(wheel, wanted.machine)


def check_by_auditwheel(wheel: Path, machine: str) -> None:
    """Check what auditwheel says of a wheel to each platform that its name claims."""
    with tempfile.TemporaryDirectory() as folder:
        for tag in LINUX:
            # auditwheel asks of a wheel whether it fits the platform that it is named after.
            alone = Path(folder, "-".join([*wheel.name.split("-")[:4], f"{tag}_{machine}.whl"]))
            shutil.copy(wheel, alone)
            answer = json.loads(run([sys.executable, "-m", "auditwheel", "show", "--json", str(alone)]))
            wanted = {"pure": False, "external_libs": {}, "versioned_symbols": {}, "unsupported_isa": False}
            facts = {key: answer[key] for key in wanted}
            expect(facts == wanted, f"{wanted} of auditwheel for {alone.name}, got {facts}")
            fits = answer["overall_tag"].startswith(tag.split("_")[0])
            expect(fits and version(answer["overall_tag"]) <= version(tag), f"{tag}, got {answer['overall_tag']}")


def check_other_library(content: bytes, name: str, wanted: Any) -> None:
    """Check that a library for macOS or Windows asks for the system's alone, and offers the kernels alone.

    These are the rules by which delocate and delvewheel would add libraries to a wheel. Mach-O and PE are read by LIEF.
    """
    binary: Any = lief.parse(list(content))
    expect(binary is not None, f"{name} to be a library")
    if wanted.system == "darwin":
        expect(isinstance(binary, lief.MachO.Binary), f"{name} to be of macOS")
        needed = [library.name for library in binary.libraries][1:]  # the first one is the library's own name
        own = binary.libraries[0].name
        # Besides these two, which the linker puts into every library.
        linkers = {"__mh_dylib_header", "___dso_handle"}
        symbols = [symbol.name for symbol in binary.exported_symbols if symbol.name not in linkers]
        expect(own == f"@rpath/{name}", f"{name} to tell no place where it was compiled, got {own}")
        oldest, processor = list(binary.build_version.minos)[:2], binary.header.cpu_type.name.lower()
        expect(oldest == [11, 0], f"{name} for macOS 11.0, got {oldest}")
        expect(processor == wanted.machine, f"{name} for {wanted.machine}, got {processor}")
        # Processors of Apple run no code without a signature, and that of the linker is enough.
        expect(wanted.machine != "arm64" or binary.has_code_signature, f"{name} to be signed")
        prefix = "_lode_"
    else:
        expect(isinstance(binary, lief.PE.Binary), f"{name} to be of Windows")
        needed = [library.name for library in binary.imports]
        symbols = [entry.name for entry in binary.get_export().entries]
        processor = binary.header.machine.name
        expect(processor == wanted.machine, f"{name} for {wanted.machine}, got {processor}")
        prefix = "lode_"
    foreign = [library for library in needed if not SYSTEM_LIBRARIES[wanted.system].fullmatch(library)]
    expect(not foreign, f"{name} to ask for the system's libraries alone, got {foreign}")
    others = [symbol for symbol in symbols if not symbol.startswith(prefix)]
    expect(symbols and not others, f"{name} to offer the kernels alone, got {others or 'nothing'}")


def version(tag: str) -> tuple[int, int]:
    """The version of the libc that a tag names."""
    _, major, minor = tag.split("_")[:3]
    return int(major), int(minor)


def check_library(content: bytes, machine: str) -> None:
    """It asks nothing of any other library, and offers the kernels alone."""
    elf: Any = ELFFile(io.BytesIO(content))
    name, page = MACHINES[machine]
    expect(elf["e_machine"] == name, f"a library for {name}, got {elf['e_machine']}")
    expect(elf.get_section_by_name(".symtab") is None, "no symbols but those of the kernels")
    dynamic: Any = next(section for section in elf.iter_sections() if isinstance(section, DynamicSection))
    needed = [tag.needed for tag in dynamic.iter_tags("DT_NEEDED")]
    expect(not needed, f"no other library, got {needed}")
    symbols = [symbol for symbol in elf.get_section_by_name(".dynsym").iter_symbols() if symbol.name]
    missing = [symbol.name for symbol in symbols if symbol["st_shndx"] == "SHN_UNDEF"]
    expect(not missing, f"no symbol of another library, got {missing}")
    others = [symbol.name for symbol in symbols if not symbol.name.startswith("lode_")]
    expect(not others, f"the kernels alone, got {others}")
    for segment in elf.iter_segments("PT_LOAD"):
        expect(segment["p_align"] >= page, f"segments at pages of {page} bytes, got {segment['p_align']}")
        both = (segment["p_flags"] & 3) == 3  # executable and writable
        expect(not both, "no memory that is both written and run")


def check_installation(distribution: Path, path: str) -> None:
    """Install it into a folder of its own, with programs of ``path`` alone, and code a surface."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {key: value for key, value in os.environ.items() if key != "CC"} | {"PATH": path}
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-cache-dir"]
        run([*pip, "--target", folder, str(distribution)], environment)
        # -P: nothing of the working tree, from whose folder this may be run.
        print(f"  {run([sys.executable, '-P', '-c', CHECK], environment | {'PYTHONPATH': folder}).strip()}")


def run(command: list[str], environment: dict[str, str] | None = None) -> str:
    """What a program prints; when it fails, this one ends with all that it said."""
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout


def expect(holds: bool, what: str) -> None:
    """End unless it holds."""
    if not holds:
        sys.exit(f"expected {what}")


def main(folder: Path) -> None:
    """Build, check, install."""
    shutil.rmtree(folder, ignore_errors=True)
    made = build(folder)
    for path in made:
        print(f"{path.stat().st_size:>9,} {path.name}", flush=True)
    wheels = {
        name: next(path for path in made if path.name.endswith(f"-{wanted.tag}.whl"))
        for name, wanted in KERNELS.PLATFORMS.items()
    }
    for name, wheel in wheels.items():
        check_wheel(wheel, KERNELS.PLATFORMS[name])
    sdist = next(path for path in made if path.name.endswith(".tar.gz"))
    bare = str(Path(sys.executable).parent)  # an environment has no compiler
    if sys.platform == "linux" and (here := f"linux-{platform.machine()}") in wheels:
        print("the wheel of this machine, installed:", flush=True)
        check_installation(wheels[here], bare)
    if any(map(shutil.which, ("cc", "gcc", "clang"))):
        print("the source distribution, compiled by the machine's compiler:", flush=True)
        check_installation(sdist, os.environ["PATH"])
    print("the source distribution, compiled by zig:", flush=True)
    check_installation(sdist, bare)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python .ci/wheels.py FOLDER")
    main(Path(sys.argv[1]))
