"""What is run on an imitated system: ``python -m tests.other_systems.main_paths SYSTEM FOLDER URL``."""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import pkgutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.other_systems.imitation import imitate

#: Modules that are for Linux alone, or for a process of their own.
_LEFT_OUT = ("lodestream.confinement.landlock", "lodestream.confinement.seccomp", "lodestream.formats.vtk.process")
#: Packages of the server that do not build surfaces, which needs Linux.
_SERVER = ("access", "commands", "connections", "operation", "store")


def main(system: str, folder: Path, url: str) -> None:
    """Run all parts; the name of each is printed when it has passed."""
    imitate(system)
    for part in (modules, memory, stores, bands, continuing, commands, streams, cache, serving, limits, reader_of_vtk):
        place = folder / part.__name__
        place.mkdir()
        part(place, url)
        gc.collect()
        left = sorted(path.name for path in place.rglob("*") if ".lodestream" in path.name or path.suffix == ".part")
        assert not left, f"{part.__name__} left {left}"
        print(part.__name__, flush=True)


def modules(folder: Path, url: str) -> None:
    """Import every module."""
    import lodestream
    import lodestream_client

    parts = [importlib.import_module(f"lodestream_server.{name}") for name in _SERVER]
    for package in (lodestream, lodestream_client, *parts):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.", onerror=_refuse):
            if module.name not in _LEFT_OUT and not module.name.endswith("__main__"):
                importlib.import_module(module.name)


def stores(folder: Path, url: str) -> None:
    """Keep objects in a folder."""
    from lodestream.stores import Folder
    from lodestream.stores.folder import OWN

    store = Folder(folder / "store")
    store.probe()
    tag = store.create("a/b", b"1")
    store.replace("a/b", b"2", tag)
    (folder / "source").write_bytes(b"3" * 2_000_000)
    for _ in range(2):
        store.put_file("a/c", folder / "source")
    with store.open("a/c") as blob:
        assert blob.read(1_999_990, 100) == b"3" * 10
    assert [entry.key for entry in store.entries("")] == ["a/b", "a/c"]
    store.delete(["a/b", "a/c"])
    (folder / "store" / OWN / "lock").unlink()
    (folder / "store" / OWN).rmdir()


def _refuse(name: str) -> None:
    raise ImportError(name)


def terrain(rows: int, columns: int) -> NDArray[np.float32]:
    y, x = np.mgrid[0:rows, 0:columns]
    noise = np.random.default_rng(1).normal(size=x.shape)
    return np.asarray(900 + 80 * np.sin(x / 9.0) * np.cos(y / 7.0) + noise, np.float32)


def memory(folder: Path, url: str) -> None:
    """Encode and decode in memory, and read the limits of memory and processors."""
    import lodestream as ls
    from lodestream.container.capacity import memory_limit
    from lodestream.parallel import threads

    assert 1 << 24 < memory_limit() < 1 << 50
    assert threads() >= 1
    heights = terrain(60, 50)
    container = ls.encode(heights)
    assert isinstance(container, bytes)
    assert np.array_equal(ls.decode(container).points, heights)


def bands(folder: Path, url: str) -> None:
    """Encode in bands, through files that are mapped, to the bytes of an encoding in memory; decode to a file."""
    import lodestream as ls

    heights = terrain(350, 300)
    np.save(folder / "heights.npy", heights)
    whole = folder / "whole.lode"
    ls.encode(folder / "heights.npy", out=whole)
    parts = folder / "parts.lode"
    parts.write_bytes(b"an earlier file")
    ls.encode(folder / "heights.npy", out=parts, memory=1 << 20, scratch=folder / "scratch")
    assert parts.read_bytes() == whole.read_bytes()
    assert list((folder / "scratch").iterdir()) == []
    run("decode", parts, folder / "back.npy", "--memory", "8MB")
    assert np.array_equal(np.load(folder / "back.npy"), heights)


def continuing(folder: Path, url: str) -> None:
    """Continue an interrupted build, and refuse a second one in the same folder."""
    import lodestream as ls
    from lodestream.encoding.folders import kept_folder

    heights, scratch = terrain(350, 300), folder / "scratch"
    np.save(folder / "heights.npy", heights)

    def stop(fraction: float) -> None:
        if fraction > 0.6:
            raise KeyboardInterrupt

    def build(progress: Any = None) -> None:
        ls.encode(folder / "heights.npy", out=folder / "x.lode", memory=1 << 20, scratch=scratch, progress=progress)

    with pytest.raises(KeyboardInterrupt):
        build(stop)
    assert not (folder / "x.lode").exists()
    assert len(list(scratch.iterdir())) == 1
    gc.collect()
    build()
    assert np.array_equal(ls.decode((folder / "x.lode").read_bytes()).points, heights)
    assert list(scratch.iterdir()) == []
    with (
        kept_folder(scratch, "key"),
        pytest.raises(ls.InputError, match="the same build is at work"),
        kept_folder(scratch, "key"),
    ):
        pass


def commands(folder: Path, url: str) -> None:
    """Convert between formats and draw."""
    np.save(folder / "heights.npy", terrain(120, 90))
    container = folder / "heights.lode"
    run("encode", folder / "heights.npy", container)
    run("info", container)
    for suffix in ("npy", "ply", "obj", "vts", "tif", "nc", "png", "asc", "glb", "p3d"):
        run("decode", container, folder / f"heights.{suffix}", "--until-rms", "5")
    run("convert", folder / "heights.tif", folder / "again.npy")
    run("view", container, "--png", folder / "picture.png", "--at", "1kB,all")
    assert len(list(folder.glob("picture*.png"))) >= 1


def streams(folder: Path, url: str) -> None:
    """Push a surface; pull a part of it, continue, pull a window, and delete it."""
    from lodestream_client import Client

    heights = terrain(200, 160)
    np.save(folder / "heights.npy", heights)
    run("push", folder / "heights.npy", url)
    surface = Client(url).upload(folder / "heights.npy").url
    run("pull", surface, folder / "rough.npy", "--until-rms", "20", "--resume")
    run("pull", surface, folder / "whole.npy", "--resume")
    assert np.array_equal(np.load(folder / "whole.npy"), heights)
    run("pull", surface, folder / "window.npy", "--roi", "10:50,20:90")
    assert np.array_equal(np.load(folder / "window.npy"), heights[10:50, 20:90])
    run("pull", surface, folder / "watched.npy", "--watch", "--picture", folder / "watched.png")
    assert np.array_equal(np.load(folder / "watched.npy"), heights)
    run("list", url)


def cache(folder: Path, url: str) -> None:
    """Keep received bytes, lock them, continue with them, discard them, forget old ones."""
    import os

    from lodestream.errors import LodestreamError
    from lodestream_client.stream.cache import CacheFile, cache_folder, forget_old

    assert cache_folder().is_absolute()
    name, data = "ab" * 32, bytes(range(200))
    file = CacheFile(folder, name, 1000)
    file.write(100, data)
    with pytest.raises(LodestreamError, match="another program is receiving"):
        CacheFile(folder, name, 1000)
    assert file.read(150, 20) == data[50:70]
    file.close()
    file = CacheFile(folder, name, 1000)
    assert file.read(100, 200) == data
    file.discarded = True
    file.close()
    assert list(folder.iterdir()) == []
    old = CacheFile(folder, "cd" * 32, 1000)
    old.write(0, data)
    old.close()
    long_ago = time.time() - 100 * 24 * 3600
    os.utime(folder / f"{'cd' * 32}.part", (long_ago, long_ago))
    forget_old(folder)
    assert list(folder.iterdir()) == []
    link = folder / f"{'ef' * 32}.part"
    (folder / "other").write_bytes(b"LODEPART")
    link.symlink_to(folder / "other")
    with pytest.raises(OSError, match="symbolic links"):
        CacheFile(folder, "ef" * 32, 1000)
    link.unlink()


def serving(folder: Path, url: str) -> None:
    """Explain the commands of a server, and refuse each in one line, as the names that start one in Python."""
    import lodestream_server
    from lodestream.errors import UnavailableError
    from lodestream_client.program import main as command

    data = str(folder / "data")
    for words in (
        ("serve", "--data", data, "--port", "0"),
        ("serve", "--data", data, "--unconfined"),
        ("token", "create", "--data", data),
        ("fsck", data),
    ):
        with contextlib.redirect_stdout(io.StringIO()) as said, pytest.raises(SystemExit, match="0"):
            command([words[0], "--help"])
        assert said.getvalue().startswith(f"usage: lodestream {words[0]}")
        with contextlib.redirect_stderr(io.StringIO()) as said:
            code = command([*words])
        assert code == 1
        (line,) = said.getvalue().splitlines()
        assert "needs Linux" in line
    for name in ("create_app", "running_server"):
        with pytest.raises(UnavailableError, match="needs Linux"):
            getattr(lodestream_server, name)
    assert lodestream_server.Settings().port == 8000
    assert list(folder.iterdir()) == []


def limits(folder: Path, url: str) -> None:
    """Read and lower the limits of a process that the server reads and lowers, as far as the system has them."""
    import socket

    from lodestream import operating_system

    before = operating_system.file_limit()
    assert operating_system.raise_file_limit(64) == 64
    assert operating_system.file_limit() == before
    assert before is None or before >= 64
    with operating_system.limited_file_size(100) as exceeded, (folder / "file").open("wb", buffering=0) as file:
        assert file.write(bytes(100)) == 100
        assert not exceeded()
    with (folder / "file").open("rb") as file:
        assert operating_system.read_at(file.fileno(), 10, 95) == bytes(5)
        assert operating_system.read_cached(file.fileno(), 10, 0) is None
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert operating_system.unacknowledged(ours.fileno()) == 0
    operating_system.lower_limit("CORE", 0)


def reader_of_vtk(folder: Path, url: str) -> None:
    """Limit the process that reads files of VTK as far as the system can; here, where it ends afterwards."""
    from lodestream.operating_system import limit_files, limit_memory, limit_processor

    limit_memory(1 << 30)
    limit_processor(600)
    limit_files(64)


def run(*arguments: object) -> None:
    """Run a command, which must succeed."""
    from lodestream_client.program import main as command

    code = command([str(argument) for argument in arguments])
    assert code == 0, f"{arguments} ended with {code}"


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
