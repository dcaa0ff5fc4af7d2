"""Building the library of kernels, and what is said where it cannot be used."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from lodestream import library
from lodestream.errors import UnavailableError

KERNELS = Path(__file__).parents[2] / "core" / "kernels"


def module(name: str) -> ModuleType:
    """A program beside the kernels, which is no part of a package."""
    spec = importlib.util.spec_from_file_location(f"kernels_{name}", KERNELS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


build, tables = module("build"), module("tables")


def script(path: Path, text: str) -> Path:
    """A program in Python."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(0o755)
    return path


#: A compiler that fails, and one that takes its time to write what it makes: sources and ``-o FILE`` at the end.
FAILS = "import sys\nsys.exit('cannot find crti.o')\n"
SLOW = """
import sys, time
with open(sys.argv[-1], "wb", buffering=0) as file:
    for _ in range(4):
        file.write(bytes(1000))
        time.sleep(0.05)
"""


@pytest.fixture
def nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine without a compiler; the folder on its PATH."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    return folder


def test_what_was_tried_is_said_where_there_is_no_compiler(nothing: Path) -> None:
    script(nothing / "cc", FAILS)
    with pytest.raises(RuntimeError) as caught:
        build.compiler()
    words = str(caught.value)
    for expected in ("cannot find crti.o", "gcc: not found", "clang: not found", "ziglang: not", "install", "set CC"):
        assert expected in words


def test_a_compiler_that_makes_no_library_is_passed_over(nothing: Path) -> None:
    script(nothing / "cc", FAILS)
    script(nothing / "clang", SLOW)
    assert build.compiler() == [str(nothing / "clang")]


def test_zig_comes_last_and_is_asked_for_where_there_is_no_other(
    nothing: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert hook().dependencies() == [build.ZIG]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name == "ziglang")
    assert build.compiler() == [sys.executable, "-m", "ziglang", "cc"]
    script(nothing / "gcc", SLOW)
    assert build.compiler() == [str(nothing / "gcc")]
    assert hook().dependencies() == []


def test_the_compiler_of_cc_is_taken_with_its_arguments_and_no_other(
    nothing: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script(nothing / "cc", SLOW)
    monkeypatch.setenv("CC", f"'{script(tmp_path / 'my tools' / 'compiler', FAILS)}' -m32")
    assert hook().dependencies() == []
    with pytest.raises(RuntimeError, match=r"my tools/compiler' -m32 ended with 1:\ncannot find crti"):
        build.compile_library(tmp_path / "library")
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(RuntimeError, match="no-such-compiler: No such file"):
        build.compile_library(tmp_path / "library")


@pytest.mark.parametrize("command", [["cc"], ["zig", "cc"], [sys.executable, "-m", "ziglang", "cc"]])
def test_the_processor_is_named_to_each_compiler_in_its_words(command: list[str]) -> None:
    flags = build.machine_flags(command, build.PLATFORMS["linux-x86_64"])
    assert ("-msse4.2" in flags) == (command == ["cc"])
    assert ("-mcpu=x86_64_v2" in flags) == (command != ["cc"])
    assert "-msse4.2" not in build.machine_flags(command, build.PLATFORMS["macos-arm64"])


def test_a_build_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / "library"
    target.write_bytes(b"before")
    with pytest.raises(RuntimeError, match="crti"):
        build.compile_library(target, [str(script(tmp_path / "cc", FAILS))])
    assert target.read_bytes() == b"before"
    assert {path.name for path in tmp_path.iterdir()} == {"cc", "library"}


def test_of_two_builds_at_once_each_leaves_a_whole_library(tmp_path: Path) -> None:
    target = tmp_path / "native" / "library"
    slow = [str(script(tmp_path / "cc", SLOW))]
    with ThreadPoolExecutor(2) as pool:
        running = [pool.submit(build.compile_library, target, slow) for _ in range(4)]
        sizes = set()
        while not all(one.done() for one in running):
            if target.exists():
                sizes.add(target.stat().st_size)
        for one in running:
            one.result()
    assert sizes <= {4000}
    assert target.stat().st_size == 4000
    assert list(target.parent.iterdir()) == [target]


def test_the_library_is_made_without_any_package() -> None:
    # -S: no site-packages; -I: no PYTHONPATH. What is there is current, or becomes so.
    done = subprocess.run(
        [sys.executable, "-I", "-S", str(KERNELS / "build.py")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert build.is_current(library.NATIVE / library.library_name())


def hook() -> Any:
    """hatchling's hook, whether hatchling is there or not."""

    class Hook(build.Hook):  # type: ignore[name-defined, misc]
        target_name = "wheel"

        def __init__(self) -> None:
            """Nothing that hatchling gives is used."""

    return Hook()


def test_a_wheel_gets_its_library_from_outside_the_sources(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(build, "NATIVE", tmp_path / "native")
    monkeypatch.setenv("CC", str(script(tmp_path / "cc", SLOW)))
    data: dict[str, Any] = {"force_include": {}}
    building = hook()
    building.initialize("standard", data)
    names = [name for name in (library.library_name(), library.wide_name()) if name]
    assert list(data["force_include"].values()) == [f"lodestream/native/{name}" for name in names]
    made = list(data["force_include"])
    assert {Path(path).stat().st_size for path in made} == {4000}
    assert data["tag"].startswith("py3-none-")
    assert not data["tag"].endswith("-any")
    assert not data["pure_python"]
    building.finalize("standard", data, "")
    assert not any(Path(path).exists() for path in made)
    assert not build.NATIVE.exists()
    building.initialize("editable", data)
    building.finalize("editable", data, "")
    assert sorted(path.name for path in build.NATIVE.iterdir()) == sorted(names)


def test_a_wheel_gets_the_library_of_the_tree_if_that_is_current_and_no_compiler_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(build, "compile_library", lambda *_, **__: pytest.fail("nothing is to be compiled"))
    data: dict[str, Any] = {"force_include": {}}
    building = hook()
    building.initialize("standard", data)
    building.finalize("standard", data, "")
    there = build.libraries(build.NATIVE)
    assert list(data["force_include"]) == [str(path) for path in there]
    assert all(map(build.is_current, there))


def test_an_installation_that_fails_ends_without_a_traceback(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CC", str(script(tmp_path / "cc", FAILS)))
    with pytest.raises(SystemExit, match="crti"):
        hook().initialize("standard", {"force_include": {}})
    monkeypatch.setenv("LODESTREAM_WHEEL_FOR", "pdp11")
    with pytest.raises(SystemExit, match=r"expected LODESTREAM_WHEEL_FOR to be one of linux-x86_64, .*, got pdp11"):
        hook().initialize("standard", {"force_include": {}})


@pytest.fixture
def native(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """An empty folder in the place of that of the library, which is loaded anew from there."""
    monkeypatch.setattr(library, "NATIVE", tmp_path)
    library._load.cache_clear()
    yield tmp_path
    library._load.cache_clear()


OURS = (library.NATIVE / library.library_name()).read_bytes()
CURRENT = str(library.fingerprint()).encode()


def refused() -> str:
    """Why the library cannot be used."""
    reason = library.why_missing()
    assert reason is not None
    assert "\n" not in reason
    with pytest.raises(UnavailableError) as caught:
        library.library()
    assert str(caught.value) == reason
    return reason


def test_a_library_that_is_not_there(native: Path) -> None:
    assert "found none" in refused()


def test_a_library_of_another_platform_is_named(native: Path) -> None:
    (native / library.library_name("plan9", "pdp11")).write_bytes(OURS)
    reason = refused()
    assert library.library_name() in reason
    assert "found those of other platforms: lodestream-plan9-pdp11.so" in reason


@pytest.mark.parametrize("content", [b"", b"no library", OURS.replace(b"lode_sources", b"lode_sourceX")])
def test_what_cannot_be_loaded_is_refused(native: Path, content: bytes) -> None:
    (native / library.library_name()).write_bytes(content)
    assert "cannot be loaded" in refused()


@pytest.mark.skipif(OURS[:5] != b"\x7fELF\x02", reason="libraries have another form here")
@pytest.mark.parametrize("length", [10, 63, 64, 1000, len(OURS) // 2, len(OURS) - 1])
def test_a_library_that_was_cut_off_is_refused_and_made_again(native: Path, length: int) -> None:
    (native / library.library_name()).write_bytes(OURS)
    assert build.is_current(native / library.library_name())
    (native / library.library_name()).write_bytes(OURS[:length])
    assert "cannot be loaded" in refused()
    assert not build.is_current(native / library.library_name())


def test_a_library_of_other_sources_is_refused_with_the_remedy(native: Path) -> None:
    assert OURS.count(CURRENT) == 1
    (native / library.library_name()).write_bytes(OURS.replace(CURRENT, b"0123456789abcdef"))
    reason = refused()
    assert f"({CURRENT.decode()}), got 0123456789abcdef" in reason
    assert "make kernels" in reason
    assert "build.py" in reason


def test_a_library_without_sources_beside_it_is_loaded_as_it_is(
    native: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(library, "KERNELS", tmp_path / "none")
    (native / library.library_name()).write_bytes(OURS.replace(CURRENT, b"f" * 16))
    assert library.why_missing() is None
    assert isinstance(library.library(), ctypes.CDLL)
    assert library.library().lode_sources() == b"f" * 16


def test_the_remedy_of_an_installed_package_is_another_installation(
    native: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(library, "KERNELS", tmp_path / "none")
    assert "install the package again" in refused()


def test_nothing_is_hashed_or_run_where_the_package_is_installed(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from lodestream import library\n"
        f"library.KERNELS = Path({str(tmp_path)!r})\n"
        "library.library(); print({'hashlib', 'subprocess', 'tempfile'} & set(sys.modules))"
    )
    environment = {**os.environ, "PYTHONPATH": str(KERNELS.parent)}
    done = subprocess.run([sys.executable, "-S", "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


def test_kernels_include_nothing_that_a_compiler_alone_does_not_have() -> None:
    text = "".join(path.read_text() for path in KERNELS.glob("*.[ch]"))
    included = set(re.findall(r"#include <(.*)>", text))
    assert "stdint.h" in included
    # immintrin.h, of x86-64 alone, comes with the compiler too.
    assert included <= {"cpuid.h", "float.h", "immintrin.h", "limits.h", "stdbool.h", "stddef.h", "stdint.h"}


@pytest.mark.skipif(library.wide_name() is None, reason="there is no second library on this machine")
def test_the_library_for_wider_registers_is_loaded_where_they_are_there() -> None:
    words = Path("/proc/cpuinfo").read_text().split()
    there = {"avx2", "bmi1", "bmi2", "fma", "f16c", "movbe", "abm"} <= set(words)
    assert library.library().lode_runs_v3() == there
    wanted = library.wide_name() if there else library.library_name()
    assert Path(library.library()._name).name == wanted


@pytest.mark.skipif(library.wide_name() is None, reason="there is no second library on this machine")
def test_the_library_for_wider_registers_has_what_gains_by_them_and_the_other_one_the_rest() -> None:
    both = [ctypes.CDLL(str(library.NATIVE / str(name))) for name in (library.library_name(), library.wide_name())]
    for name, wide in (("lode_lift", True), ("lode_store_values", True), ("lode_passes", False), ("lode_mask", False)):
        assert [hasattr(one, name) for one in both] == [True, wide]
        assert hasattr(library.library(), name)
    assert not hasattr(library.library(), "lode_nothing")


@pytest.mark.skipif(library.wide_name() is None, reason="there is no second library on this machine")
@pytest.mark.parametrize("content", [b"no library", OURS[:-1]])
def test_a_second_library_that_cannot_be_loaded_is_done_without(native: Path, content: bytes) -> None:
    (native / library.library_name()).write_bytes(OURS)
    (native / str(library.wide_name())).write_bytes(content)
    assert library.why_missing() is None
    assert Path(library.library()._name).name == library.library_name()


@pytest.mark.skipif(library.wide_name() is None, reason="there is no second library on this machine")
def test_a_second_library_of_other_sources_than_the_first_is_done_without(
    native: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    wide = (Path(library.__file__).with_name("native") / str(library.wide_name())).read_bytes()
    monkeypatch.setattr(library, "KERNELS", tmp_path / "none")  # installed: nothing else says which are wanted
    (native / library.library_name()).write_bytes(OURS)
    (native / str(library.wide_name())).write_bytes(wide.replace(CURRENT, b"f" * 16))
    assert Path(library.library()._name).name == library.library_name()


def test_tables_are_those_of_their_program() -> None:
    for path, text in tables.headers().items():
        assert path.read_text() == text
