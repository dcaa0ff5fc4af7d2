"""Build the source distribution, and from it the wheels for every Linux, and check them.

``python .ci/wheels.py FOLDER`` needs the group ``wheels`` of pyproject.toml. Each wheel is made by zig for a machine
that need not be this one. Then what was made for this machine is installed, the source distribution twice: by the
machine's compiler, if there is one, and by zig.
"""

from __future__ import annotations

import io
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any
from zipfile import ZipFile

from elftools.elf.dynamic import DynamicSection
from elftools.elf.elffile import ELFFile

ROOT = Path(__file__).resolve().parent.parent

#: What the processors of a wheel are in ELF, and the largest pages that Linux has there.
MACHINES = {"x86_64": ("EM_X86_64", 1 << 12), "aarch64": ("EM_AARCH64", 1 << 16)}
PLATFORMS = ("manylinux_2_17", "musllinux_1_2")
#: Of a wheel: what it has without the page of the browser, and the page.
MOST_BYTES = 1_000_000 + 270_000

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


def build(folder: Path) -> list[Path]:
    """The source distribution, and a wheel from it for each machine."""
    for machine in MACHINES:
        environment = {**os.environ, "LODESTREAM_WHEEL_FOR": machine}
        run([sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)], environment)
    return sorted(folder.iterdir())


def check_wheel(wheel: Path, machine: str) -> None:
    """Its size, its library, and what auditwheel says to each platform that its name claims."""
    expect(wheel.stat().st_size < MOST_BYTES, f"{wheel.name} below {MOST_BYTES} bytes, got {wheel.stat().st_size}")
    with ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if name.startswith("lodestream/native/")]
        made_for = [machine, "x86_64-v3"] if machine == "x86_64" else [machine]
        wanted = [f"lodestream/native/lodestream-linux-{name}.so" for name in made_for]
        page = "lodestream/page/static/index.html"
        expect(page in archive.namelist(), f"{page} in {wheel.name}: it is built by make page")
        expect(sorted(names) == sorted(wanted), f"{wanted}, got {names}")
        for name in names:
            check_library(archive.read(name), machine)
    with tempfile.TemporaryDirectory() as folder:
        for tag in PLATFORMS:
            # auditwheel asks of a wheel whether it fits the platform that it is named after.
            alone = Path(folder, "-".join([*wheel.name.split("-")[:4], f"{tag}_{machine}.whl"]))
            shutil.copy(wheel, alone)
            found = json.loads(run([sys.executable, "-m", "auditwheel", "show", "--json", str(alone)]))
            told_by = {"pure": False, "external_libs": {}, "versioned_symbols": {}, "unsupported_isa": False}
            told = {key: found[key] for key in told_by}
            expect(told == told_by, f"{told_by} of auditwheel for {alone.name}, got {told}")
            fits = found["overall_tag"].startswith(tag.split("_")[0])
            expect(fits and version(found["overall_tag"]) <= version(tag), f"{tag}, got {found['overall_tag']}")


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
    wheels = {machine: next(path for path in made if path.name.endswith(f"_{machine}.whl")) for machine in MACHINES}
    for machine, wheel in wheels.items():
        check_wheel(wheel, machine)
    sdist = next(path for path in made if path.name.endswith(".tar.gz"))
    bare = str(Path(sys.executable).parent)  # an environment has no compiler
    if sys.platform == "linux" and platform.machine() in wheels:
        print("the wheel of this machine, installed:", flush=True)
        check_installation(wheels[platform.machine()], bare)
    if any(map(shutil.which, ("cc", "gcc", "clang"))):
        print("the source distribution, compiled by the machine's compiler:", flush=True)
        check_installation(sdist, os.environ["PATH"])
    print("the source distribution, compiled by zig:", flush=True)
    check_installation(sdist, bare)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python .ci/wheels.py FOLDER")
    main(Path(sys.argv[1]))
