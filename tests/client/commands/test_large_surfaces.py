"""``encode`` and ``decode`` of surfaces larger than memory: the same bytes, cut builds, workers of a cluster."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.encoding import cluster, tasks
from lodestream_client.commands import decode_by_rows, values
from lodestream_client.commands.building_options import BuildingOptions, reading_folder
from lodestream_client.commands.outcome import Outcome
from tests.clusters import local_cluster
from tests.core.surfaces import terrain
from tests.patience import PATIENCE

from ..conftest import Run
from .test_program import COMMAND, environment

LITTLE = ("--memory", "1MiB")

signals = pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no such signals")

#: Seconds until a build in a process of its own must have come so far.


@pytest.fixture(scope="module")
def heights() -> NDArray[np.int16]:
    """The values of a file that takes a few seconds."""
    return np.rint(300 * terrain((1100, 900))).astype(np.int16)


@pytest.fixture
def file(heights: NDArray[np.int16], tmp_path: Path) -> Path:
    path = tmp_path / "a.npy"
    np.save(path, heights)
    return path


@pytest.fixture(scope="module")
def expected(heights: NDArray[np.int16], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("large") / "a.npy"
    np.save(path, heights)
    return ls.encode(ls.read(path))


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def contents(path: Path) -> dict[str, bytes]:
    """The bytes of a file, or of all files in a folder."""
    files = [it for it in path.rglob("*") if it.is_file()] if path.is_dir() else [path]
    return {it.relative_to(path).as_posix(): it.read_bytes() for it in files}


def begun(file: Path, out: Path, scratch: Path, *options: object) -> subprocess.Popen[bytes]:
    """A build in a process of its own, some units of which are coded."""
    slow = {**environment(), "LODESTREAM_THREADS": "1"}
    command = [*COMMAND, "encode", str(file), str(out), *LITTLE, *map(str, options)]
    process = subprocess.Popen(command, env=slow, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    end = time.monotonic() + PATIENCE
    # Not by a glob, which fails where a folder vanishes meanwhile.
    while not any(files and "/exact/ends/" in above for above, _, files in os.walk(scratch)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.005)
    return process


def ended(process: subprocess.Popen[bytes], number: int) -> tuple[int, bytes]:
    """Its exit code and standard error after a signal."""
    process.send_signal(number)
    _, stderr = process.communicate(timeout=PATIENCE)
    return process.returncode, stderr


@pytest.fixture
def repeated(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Tasks of the phases before coding that are carried out from here on, by name."""
    called: list[str] = []

    def counted(name: str, task: Callable[..., None]) -> Callable[..., None]:
        def call(folder: str, *arguments: int) -> None:
            called.append(name)
            task(folder, *arguments)

        return call

    for name in ("coordinates", "first_step", "second_step", "core"):
        monkeypatch.setattr(tasks, name, counted(name, getattr(tasks, name)))
    return called


@pytest.mark.long
def test_little_memory_gives_the_same_bytes(
    run: Run, file: Path, expected: bytes, tmp_path: Path, repeated: list[str]
) -> None:
    code, stdout, stderr = run("encode", file, tmp_path / "a.lode", *LITTLE, "--json")
    assert code == 0, stderr
    assert "first_step" in repeated, "in several pieces"
    assert (tmp_path / "a.lode").read_bytes() == expected
    assert json.loads(stdout)["bytes"] == len(expected)
    assert names(tmp_path) == {"a.npy", "a.lode"}
    repeated.clear()
    assert run("encode", file, tmp_path / "b.lode")[0] == 0
    assert set(repeated) == {"coordinates", "core"}, "in one piece"
    assert (tmp_path / "b.lode").read_bytes() == expected


@pytest.mark.parametrize("out", ["a.npy", "a.tif", "a.nc", "a.zarr"])
@pytest.mark.long
def test_decode_with_little_memory_writes_the_same_file(
    run: Run, expected: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    needed = {"a.tif": "rasterio", "a.nc": "h5netcdf", "a.zarr": "zarr"}
    if out in needed:
        pytest.importorskip(needed[out])
    (tmp_path / "a.lode").write_bytes(expected)
    by_bands, decode = list[str](), decode_by_rows._decode

    def counted(decoder: object, path: Path, *rest: object) -> Outcome:
        by_bands.append(path.name)
        return decode(decoder, path, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(decode_by_rows, "_decode", counted)
    assert run("decode", tmp_path / "a.lode", tmp_path / f"whole-{out}")[0] == 0
    code, stdout, stderr = run("decode", tmp_path / "a.lode", tmp_path / out, *LITTLE, "--json")
    assert code == 0, stderr
    assert by_bands == [out]
    assert json.loads(stdout)["ended"] == "complete"
    assert contents(tmp_path / out) == contents(tmp_path / f"whole-{out}")
    assert names(tmp_path) == {"a.lode", out, f"whole-{out}"}


def test_a_file_and_the_folder_that_it_names_are_both_written(run: Run, tmp_path: Path) -> None:
    rows, columns = np.mgrid[0:300, 0:300].astype(np.float64)
    points = np.stack([rows + np.sin(columns / 20), columns + np.cos(rows / 30), np.sin(rows / 9)], axis=-1)
    (tmp_path / "a.lode").write_bytes(ls.encode(ls.Surface(points, attributes={"a": rows, "b": columns}), 1e-3))
    # Five channels by bands, since they take 12 bytes each in one piece; a .vtm takes 48 for a point.
    code, _, stderr = run("decode", tmp_path / "a.lode", tmp_path / "a.vtm", "--memory", "5MiB")
    assert code == 0, stderr
    assert set(contents(tmp_path)) == {"a.lode", "a.vtm", "a/a_0.vts"}
    assert 'file="a/a_0.vts"' in (tmp_path / "a.vtm").read_text()
    found = ls.read(tmp_path / "a" / "a_0.vts")
    np.testing.assert_array_equal(found.points, ls.decode((tmp_path / "a.lode").read_bytes()).points)


def test_errors_name_the_file_and_not_the_folder_on_the_way(
    run: Run, expected: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zarr")
    (tmp_path / "a.lode").write_bytes(expected)
    (tmp_path / "a.zarr").write_text("a file")
    code, _, stderr = run("decode", tmp_path / "a.lode", tmp_path / "a.zarr", *LITTLE)
    assert code == 1
    assert "a.zarr: expected a place for the folder of a Zarr store, got a file" in stderr

    def full(surface: object, path: str) -> None:
        raise OSError(errno.ENOSPC, "no space left", path)

    monkeypatch.setattr("lodestream.formats.write", full)
    code, _, stderr = run("decode", tmp_path / "a.lode", tmp_path / "a.npy", *LITTLE)
    assert code == 1
    assert f"{tmp_path / 'a.npy'}: no space left" in stderr
    assert names(tmp_path) == {"a.lode", "a.zarr"}


@signals
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
@pytest.mark.usefixtures("interrupts")
@pytest.mark.long
def test_a_build_that_is_cut_goes_on_in_its_folder(
    run: Run, file: Path, expected: bytes, tmp_path: Path, repeated: list[str], name: str
) -> None:
    scratch, out, number = tmp_path / "scratch", tmp_path / "a.lode", signal.Signals[name]
    code, stderr = ended(begun(file, out, scratch, "--scratch", scratch), number)
    if name == "SIGKILL":
        assert code == -number
    else:
        assert code == 128 + number
        assert stderr.count(b"\n") == 3
        assert f"lodestream: {scratch} is kept: the same command continues from there".encode() in stderr
    assert names(tmp_path) == {"a.npy", "scratch"}
    assert run("encode", file, out, *LITTLE, "--scratch", scratch)[0] == 0
    assert not repeated, "the phases before coding were done"
    assert out.read_bytes() == expected
    assert names(tmp_path) == {"a.npy", "a.lode", "scratch"}
    assert not names(scratch)


@pytest.mark.parametrize(
    ("error", "kept"),
    [(ls.UnavailableError("lost"), True), (CancelledError("lost"), True), (ls.InputError("expected another"), False)],
)
def test_the_folder_is_named_where_the_command_goes_on(
    error: Exception, kept: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = BuildingOptions(None, tmp_path / "scratch", None)
    with pytest.raises(type(error)), reading_folder(options, "a.lode", "key"):
        raise error
    assert ("is kept: the same command continues from there" in capsys.readouterr().err) == kept
    assert names(tmp_path) == {"scratch"}


@signals
@pytest.mark.long
def test_another_command_in_the_folder_of_a_build_that_was_cut_begins_anew(
    run: Run, file: Path, expected: bytes, tmp_path: Path, repeated: list[str]
) -> None:
    scratch, out = tmp_path / "scratch", tmp_path / "a.lode"
    ended(begun(file, out, scratch, "--scratch", scratch, "--name", "hill"), signal.SIGKILL)
    assert run("encode", file, out, *LITTLE, "--scratch", scratch)[0] == 0
    assert repeated
    assert out.read_bytes() == expected
    assert names(tmp_path) == {"a.npy", "a.lode", "scratch"}


@signals
@pytest.mark.usefixtures("interrupts")
def test_an_interrupted_build_without_a_folder_leaves_nothing(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.lode"
    code, stderr = ended(begun(file, out, tmp_path), signal.SIGINT)
    assert (code, stderr.splitlines()[-1]) == (130, b"lodestream: interrupted")
    assert b"kept" not in stderr
    assert names(tmp_path) == {"a.npy"}


@pytest.mark.parametrize("command", ["encode", "decode"])
@pytest.mark.parametrize("size", ["much", "-5", "0", "5lb", ""])
def test_memory_that_is_no_size(run: Run, file: Path, tmp_path: Path, command: str, size: str) -> None:
    code, stdout, stderr = run(command, file, tmp_path / "a.lode", f"--memory={size}")
    assert (code, stdout) == (2, "")
    assert "argument --memory: expected" in stderr
    assert repr(size) in stderr
    assert names(tmp_path) == {"a.npy"}


@pytest.mark.parametrize("command", ["encode", "decode"])
def test_too_little_memory_is_refused(run: Run, file: Path, tmp_path: Path, command: str) -> None:
    code, stdout, stderr = run(command, file, tmp_path / "a.lode", "--memory", "1KiB")
    assert (code, stdout) == (2, "")
    assert "argument --memory: expected 1 MiB of memory or more to work in, got '1KiB'" in stderr


@pytest.mark.long
def test_memory_that_will_be_exceeded_is_told(run: Run, file: Path, tmp_path: Path) -> None:
    code, _, stderr = run("encode", file, tmp_path / "a.lode", *LITTLE)
    assert code == 0
    assert "--memory 1.0 MB is exceeded, and encoding goes on: this surface takes about 15.8 MB at least\n" in stderr
    assert "exceeded" not in run("encode", file, tmp_path / "a.lode", "--memory", "1GiB")[2]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--rms", "3"), "a stream for one error (rms) is made of all values together"),
    ],
)
@pytest.mark.parametrize("scratch", [False, True])
def test_what_cannot_be_built_by_bands_says_why(
    run: Run, file: Path, tmp_path: Path, options: tuple[str, ...], reason: str, scratch: bool
) -> None:
    more = ("--scratch", tmp_path / "scratch") if scratch else ()
    code, _, stderr = run("encode", file, tmp_path / "a.lode", *LITTLE, *options, *more)
    assert code == 1
    assert "expected a surface that takes at most 1 MiB to encode, got one that takes about 44 MiB" in stderr
    assert f"cannot be built by bands: {reason}" in stderr
    assert not (tmp_path / "a.lode").exists()


@pytest.mark.long
def test_workers_of_a_cluster_give_the_same_bytes(run: Run, file: Path, expected: bytes, tmp_path: Path) -> None:
    with local_cluster(2) as workers:
        code, _, stderr = run("encode", file, tmp_path / "a.lode", *LITTLE, "--dask", workers.scheduler_address)
    assert code == 0, stderr
    assert (tmp_path / "a.lode").read_bytes() == expected
    assert names(tmp_path) == {"a.npy", "a.lode"}


def be_impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait a second for schedulers."""
    monkeypatch.setattr(cluster, "_PATIENCE", 1)


def test_a_scheduler_that_does_not_answer(
    run: Run, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    be_impatient(monkeypatch)
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{closed.getsockname()[1]}"
        code, _, stderr = run("encode", file, tmp_path / "a.lode", "--dask", address)
    assert code == 1
    assert f"expected the address of a Dask scheduler, got '{address}': " in stderr
    assert names(tmp_path) == {"a.npy"}


@pytest.mark.parametrize(
    "address", ["", "nowhere", "http://127.0.0.1:8786", "nonsense://x", "tcp://a:b", "tcp://:8786", "a:70000"]
)
def test_what_is_no_address_of_a_scheduler_is_refused_at_once(
    run: Run, file: Path, tmp_path: Path, address: str
) -> None:
    code, stdout, stderr = run("encode", file, tmp_path / "a.lode", f"--dask={address}")
    assert (code, stdout) == (2, "")
    assert "argument --dask: expected the address of a Dask scheduler such as tcp://10.0.0.1:8786, got" in stderr


@pytest.mark.parametrize(
    "address", ["tcp://10.0.0.1:8786", "10.0.0.1:8786", "tls://host.example:1", "tcp://[::1]:8786"]
)
def test_addresses_of_schedulers(address: str) -> None:
    assert values.parse_scheduler(address) == address
