"""A pull that is interrupted or loses its server: what came is written, kept, and gone on from."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream_client import AsyncClient, AsyncStream, Client, Stream
from lodestream_client.__main__ import main
from lodestream_client.stream import cache
from lodestream_client.stream.reconnecting import Transport
from tests.links import Fault, linked
from tests.patience import PATIENCE
from tests.server.programs import Server, descendants

from ..conftest import Run, make_terrain
from ..files import ranged

pytestmark = pytest.mark.usefixtures("interrupts")

Terrain = NDArray[np.float32]

# What a pull says and asks beside the container: handshakes, headers, the surface's description, layers' figures.
TALK = 12_000

# Slow enough that a machine which stands still for a second or two changes nothing.
RATE = "400kbit"

# Bytes that are let come before it is ended; more than what is read at once, so that some of it has been decoded.
CAME = 100_000

# Half of the file is written, then nothing happens. A signal between two steps of Python ends no sleep that begins
# then, so that each is short.
STALLED = """\
import sys, time, lodestream.formats.writing as formats
whole = formats.write_stream
def stall(surface, name, file):
    class Half:
        def write(self, data):
            file.write(bytes(data)[:100])
            file.flush()
            while True:
                time.sleep(0.05)
    whole(surface, name, Half())
formats.write_stream = stall
"""

# The encoder is at it until somebody ends it.
ENDLESS = """\
import sys, pathlib, lodestream
encode = lodestream.encode
def again(*given, **more):
    pathlib.Path({began!r}).touch()
    while True:
        encode(*given, **{{**more, "out": None}})  # else it ends with each file
lodestream.encode = again
"""

MAIN = "from lodestream_client.__main__ import main\nsys.exit(main(sys.argv[1:]))"


@pytest.fixture(scope="session")
def relief() -> Terrain:
    """Large enough that some of it is far from all of it."""
    return make_terrain(340, 330)


@pytest.fixture(scope="session")
def relief_file(relief: Terrain, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("relief") / "relief.npy"
    np.save(path, relief)
    assert main(["encode", str(path), str(path.with_suffix(".lode")), "--name", "relief"]) == 0
    return path


@pytest.fixture(scope="session")
def relief_surface(server: str, relief_file: Path) -> str:
    return Client(server).upload(relief_file, name="relief").url


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(params=["ws", "http", "file"])
def source(request: pytest.FixtureRequest, relief_surface: str, relief_file: Path) -> Iterator[tuple[str, ...]]:
    if request.param != "file":
        yield relief_surface, "--transport", request.param
        return
    with ranged(relief_file.parent) as web:
        yield (f"{web.url}/relief.lode",)


def kept(folder: Path) -> int:
    """Bytes of what is kept on disk."""
    return sum(path.stat().st_size for path in folder.glob("*.part"))


def cached(folder: Path) -> int:
    """Bytes of the container that are kept; a record of which a kill left the beginning counts for nothing."""
    path = next(folder.glob("*.part"))
    with tempfile.TemporaryDirectory() as copy:
        shutil.copy(path, copy)
        size = int.from_bytes(path.read_bytes()[12:20], "little")
        file = cache.CacheFile(Path(copy), path.stem, size)
        total = file.ranges.total
        file.close()
    return total


def until(condition: Callable[[], object], process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert process.poll() is None, f"it ended before: {process.communicate()!r}"
        assert time.monotonic() < end
        time.sleep(0.005)


@contextmanager
def command(*arguments: object, before: str = "import sys") -> Iterator[subprocess.Popen[bytes]]:
    """The command in a process of its own, which does not outlive the block.

    One that computes all the time is not traced: coverage takes locks wherever an interrupt may come.
    """
    program = [sys.executable, "-c", f"{before}\n{MAIN}", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    if "lodestream.encode = again" in before:
        environment = {name: value for name, value in environment.items() if not name.startswith("COVERAGE_")}
    process = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def end(process: subprocess.Popen[bytes]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out.decode(), err.decode()


def check_written(out: Path, figures: dict[str, Any], whole: Terrain) -> None:
    """The errors told are those of what was written, which is not the whole."""
    error = np.load(out).astype(np.float64) - whole
    assert 0 < figures["rms"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
    assert figures["max"] == pytest.approx(np.abs(error).max(), rel=1e-6)


def check_resumed(source: tuple[str, ...], out: Path, folder: Path, whole: Terrain, run: Run) -> None:
    """`pull --resume` asks for what is missing, and the end is the same to the bit."""
    before = cached(folder)
    with linked(source[0], Fault()) as link:
        # The name of what a file's address gave goes with that address; a surface's goes with its container.
        url = link.url if source[1:] else source[0]
        code, stdout, stderr = run("pull", url, out, "--resume", "--json", *source[1:])
    assert code == 0, stderr
    assert "are here from an earlier pull" in stderr
    figures = json.loads(stdout)
    assert figures["ended"] == "complete"
    came = max(figures["wire_bytes"], link.down)
    assert figures["bytes"] - before - 1000 < came < figures["bytes"] - before + TALK
    assert np.load(out).tobytes() == whole.tobytes()
    assert kept(folder) == 0


@pytest.mark.parametrize(
    ("source", "number", "code"),
    [("ws", signal.SIGINT, 130), ("http", signal.SIGTERM, 143), ("file", signal.SIGINT, 130)],
    indirect=["source"],
)
def test_after_an_interrupt_there_is_what_came(
    source: tuple[str, ...], number: int, code: int, folder: Path, tmp_path: Path, relief: Terrain, run: Run
) -> None:
    out = tmp_path / "o.npy"
    with command("pull", source[0], out, "--json", "--limit-rate", RATE, *source[1:]) as process:
        until(lambda: kept(folder) > CAME, process)
        process.send_signal(number)
        ended, stdout, stderr = end(process)
    assert ended == code, stderr
    figures = json.loads(stdout) if stdout else pytest.fail(stderr)
    assert figures["ended"] == "stopped"
    assert figures["bytes"] > 30_000
    check_written(out, figures, relief)
    assert f"the data received so far are written to {out}; " in stderr
    assert "are kept; pull --resume continues from there" in stderr
    check_resumed(source, out, folder, relief, run)


def test_for_people_there_is_a_line_of_figures(relief_surface: str, folder: Path, tmp_path: Path) -> None:
    with command("pull", relief_surface, tmp_path / "o.npy", "--limit-rate", RATE) as process:
        until(lambda: kept(folder) > CAME, process)
        process.send_signal(signal.SIGINT)
        code, stdout, stderr = end(process)
    assert (code, stdout) == (130, "")
    # Somebody who interrupts is not kept waiting: on a busy machine the name may not come in time, and that is told.
    late = "lodestream: written without metadata such as name and position, which "
    lines = [line for line in stderr.splitlines() if line.startswith("lodestream: ") and not line.startswith(late)]
    assert len(lines) == 3, stderr
    first, figures, last = lines
    assert first == "lodestream: interrupted"
    assert figures.startswith("lodestream: stopped: level ")
    assert "maximum" in figures
    assert last.startswith("lodestream: the data received so far are written to ")


@pytest.mark.long
def test_a_server_that_is_killed(relief_file: Path, folder: Path, tmp_path: Path, relief: Terrain, run: Run) -> None:
    out = tmp_path / "o.npy"
    server = Server(tmp_path / "data")
    try:
        url = Client(server.url).upload(relief_file).url
        with command("pull", url, out, "--json", "--limit-rate", RATE, "--retry", "1") as process:
            until(lambda: kept(folder) > CAME, process)
            server.kill()
            code, stdout, stderr = end(process)
    finally:
        server.kill()
    assert code == 1
    figures = json.loads(stdout)
    assert figures["ended"] == "truncated"
    check_written(out, figures, relief)
    assert f"the data received so far are written to {out}; " in stderr
    assert "are kept; pull --resume continues from there" in stderr
    again = Server(tmp_path / "data")
    try:
        place = url.removeprefix(server.url)
        check_resumed((f"{again.url}{place}", "--transport", "auto"), out, folder, relief, run)
    finally:
        again.kill()


def lost(after: int) -> Callable[[int], Fault]:
    """The first connection breaks after so many bytes; there is no other."""
    return lambda number: Fault(cut_down=after if number == 0 else 0)


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_below_the_first_layer_nothing_is_written(
    relief_surface: str, transport: str, folder: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "o.npy"
    out.write_bytes(b"as it was")
    # The handshake or the head of the answer, and a little of what follows it.
    after = 400
    if transport == "http":
        with linked(relief_surface, Fault()) as link:
            Client(link.url).fetch_range(link.url, 0, 10)
        after = link.down + 20
    with linked(relief_surface, lost(after)) as link:
        code, stdout, stderr = run("pull", link.url, out, "--json", "--retry", "0", "--transport", transport)
    assert (code, stdout) == (1, "")
    assert out.read_bytes() == b"as it was"
    assert f"the first layer has not arrived, and {out} is not written" in stderr.splitlines()[-1]
    with (
        linked(relief_surface, Fault(cut_down=after, vanish=True)) as link,
        command("pull", link.url, out, "--json", "--transport", transport) as process,
    ):
        until(lambda: link.down == after, process)
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        code, stdout, stderr = end(process)
    assert (code, stdout) == (130, "")
    assert stderr.splitlines()[-1] == f"lodestream: interrupted: {out} is not written"
    assert out.read_bytes() == b"as it was"
    assert sorted(path.name for path in tmp_path.iterdir() if path != folder) == ["o.npy"]


def test_a_second_interrupt_ends_at_once(
    relief_surface: str, folder: Path, tmp_path: Path, relief: Terrain, run: Run
) -> None:
    places = tmp_path / "places"
    places.mkdir()
    out = places / "o.npy"
    out.write_bytes(b"as it was")
    with command("pull", relief_surface, out, "--limit-rate", RATE, "--json", before=STALLED) as process:
        until(lambda: kept(folder) > CAME, process)
        process.send_signal(signal.SIGINT)
        until(lambda: any(path.stat().st_size >= 100 for path in places.iterdir() if path != out), process)
        process.send_signal(signal.SIGINT)
        code, stdout, stderr = end(process)
    assert (code, stdout) == (130, "")
    assert stderr.splitlines()[-1] == f"lodestream: interrupted: {out} is not written"
    assert "are kept; pull --resume continues from there" in stderr
    assert list(places.iterdir()) == [out]
    assert out.read_bytes() == b"as it was"
    check_resumed((relief_surface, "--transport", "ws"), out, folder, relief, run)


def test_an_interrupt_of_the_writing_loses_nothing(
    relief_surface: str, folder: Path, tmp_path: Path, relief: Terrain, run: Run
) -> None:
    places = tmp_path / "places"
    places.mkdir()
    with command("pull", relief_surface, places / "o.npy", before=STALLED) as process:
        until(lambda: any(path.stat().st_size >= 100 for path in places.iterdir()), process)
        process.send_signal(signal.SIGINT)
        code, _, stderr = end(process)
    assert code == 130
    assert "are kept; pull --resume continues from there" in stderr
    assert list(places.iterdir()) == []
    check_resumed((relief_surface, "--transport", "ws"), places / "o.npy", folder, relief, run)


@pytest.mark.sweep(1)
@pytest.mark.long
def test_a_pull_that_is_killed_is_gone_on_from_unasked(
    source: tuple[str, ...], folder: Path, tmp_path: Path, relief: Terrain, run: Run
) -> None:
    with command("pull", source[0], tmp_path / "o.npy", "--limit-rate", RATE, *source[1:]) as process:
        until(lambda: kept(folder) > CAME, process)
        process.kill()
        end(process)
    # A kill may come in the middle of a write, and leave its beginning.
    with next(folder.glob("*.part")).open("ab") as file:
        file.write(struct.pack("<QII", 0, 64_000, 0) + bytes(47_000))
    check_resumed(source, tmp_path / "o.npy", folder, relief, run)


@pytest.mark.usefixtures("paced")
def test_a_pull_that_ends_as_wanted_leaves_nothing_behind(
    surface: str, server: str, terrain: Terrain, container_file: Path, folder: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "o.npy"
    assert run("pull", surface, out)[0] == 0
    assert np.array_equal(np.load(out), terrain)
    for limit in (("--max-bytes", 9000), ("--until-rms", 2), ("--level", 3), ("--seconds", 0.2, "--limit-rate", "1kB")):
        assert run("pull", surface, out, *limit)[0] == 0
    with ranged(container_file.parent) as web:
        assert run("pull", f"{web.url}/{container_file.name}", out)[0] == 0
    assert run("pull", surface, out, "--level", 99)[0] == 1
    assert run("pull", f"{server}/v1/surfaces/0123456789abcdef0123", out)[0] == 1
    assert list(folder.iterdir()) == []


def test_what_was_asked_to_be_kept_is_left_by_a_pull_that_was_not(
    surface: str, folder: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "o.npy"
    assert run("pull", surface, out, "--resume", "--max-bytes", 9000)[0] == 0
    before = kept(folder)
    assert before > 5000
    assert run("pull", surface, out, "--max-bytes", 4000)[0] == 0
    assert kept(folder) >= before
    assert run("pull", surface, out)[0] == 0
    assert kept(folder) >= before
    # A part of the surface is not all that may be asked for; the whole is.
    assert run("pull", surface, out, "--resume", "--roi", "0:9,0:9")[0] == 0
    assert kept(folder) >= before
    assert run("pull", surface, out, "--resume")[0] == 0
    assert kept(folder) == 0


def test_a_folder_that_cannot_be_written(
    surface: str, terrain: Terrain, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "file" / "cache"))
    out = tmp_path / "o.npy"
    code, _, stderr = run("pull", surface, out, "--limit-rate", "1mbit")
    assert code == 0
    assert np.array_equal(np.load(out), terrain)
    assert stderr.count("received data are not kept for pull --resume: ") == 1
    assert len(stderr.splitlines()) == 2
    with linked(surface, lost(9000)) as link:
        code, stdout, stderr = run("pull", link.url, out, "--retry", "0", "--transport", "ws", "--json")
    assert (code, json.loads(stdout)["ended"]) == (1, "truncated")
    check_written(out, json.loads(stdout), terrain)
    assert "; nothing is kept: " in stderr


@pytest.mark.parametrize("when", ["before", "while it comes"])
def test_a_disk_that_is_full(
    surface: str,
    terrain: Terrain,
    folder: Path,
    tmp_path: Path,
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
    when: str,
) -> None:
    if when == "before":
        monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=20_000))
    else:
        wrote: list[int] = []
        write = os.pwrite

        def fill(file: int, data: bytes, offset: int) -> int:
            wrote.append(len(data))
            return write(file, data, offset) if sum(wrote) < 6000 else 0

        monkeypatch.setattr(os, "pwrite", fill)
    out = tmp_path / "o.npy"
    code, _, stderr = run("pull", surface, out, "--limit-rate", "1mbit")
    assert code == 0
    assert np.array_equal(np.load(out), terrain)
    assert stderr.count("no more data are kept for pull --resume: ") == (when != "before")
    assert kept(folder) == 0


def test_two_pulls_of_one_surface(surface: str, terrain: Terrain, folder: Path, tmp_path: Path, run: Run) -> None:
    identity = Client(surface).identify(surface)
    assert identity.name is not None
    assert identity.size is not None
    out = tmp_path / "o.npy"
    part = cache.CacheFile(folder, identity.name, identity.size)
    try:
        code, _, stderr = run("pull", surface, out)
        assert code == 0
        assert len(stderr.splitlines()) == 1
        assert np.array_equal(np.load(out), terrain)
        with linked(surface, lost(9000)) as link:
            code, stdout, stderr = run("pull", link.url, out, "--retry", "0", "--transport", "ws", "--json")
        assert (code, json.loads(stdout)["ended"]) == (1, "truncated")
        assert "; nothing is kept: another program is receiving the same surface" in stderr
    finally:
        part.close()


def test_the_name_of_the_surface_is_fetched_where_it_can_be(
    relief_surface: str, folder: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "o.npy"
    # The stream breaks; the server is there and answers.
    with linked(relief_surface, lambda number: Fault(cut_down=60_000 if number == 0 else None)) as link:
        code, _, stderr = run("pull", link.url, out, "--retry", "0", "--transport", "ws")
    assert code == 1
    assert "written without metadata" not in stderr
    next(folder.glob("*.part")).unlink()
    with linked(relief_surface, lost(60_000)) as link:
        code, _, stderr = run("pull", link.url, out, "--retry", "0", "--transport", "ws")
    assert code == 1
    assert "written without metadata such as name and position, which could not be fetched: " in stderr


@pytest.mark.parametrize("transport", ["ws", "http"])
@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
def test_a_stream_that_lost_its_server_has_what_came(
    relief_surface: str, relief: Terrain, transport: Any, asynchronous: bool
) -> None:
    views: list[ls.View] = []
    errors: list[ls.LodestreamError] = []
    options: dict[str, Any] = {"transport": transport, "deadline": 0, "window": 4000}

    def follow(url: str) -> Stream:
        with Client(url).connect(url, **options) as stream:
            try:
                for view in stream:
                    views.append(view)  # noqa: PERF402  (what came before the error counts)
            except ls.LodestreamError as error:
                errors.append(error)
        return stream

    async def follow_async(url: str) -> AsyncStream:
        async with AsyncClient(url) as client, client.connect(url, **options) as stream:
            try:
                async for view in stream:
                    views.append(view)  # noqa: PERF401  (as above)
            except ls.LodestreamError as error:
                errors.append(error)
        return stream

    with linked(relief_surface, lost(60_000)) as link:
        stream = asyncio.run(follow_async(link.url)) if asynchronous else follow(link.url)
    assert len(errors) == 1
    assert stream.ended == "truncated"
    assert len(views) > 5
    for view in (views[0], views[-1], stream.decoder.view()):
        error = view.points.astype(np.float64) - relief
        assert view.rms == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
    assert stream.decoder.view().bytes >= views[-1].bytes > 30_000


def test_what_a_stream_gives_to_a_sink(surface: str, container_file: Path) -> None:
    content = container_file.read_bytes()
    transports: tuple[Transport, ...] = ("ws", "http")
    for transport in transports:
        found = bytearray(len(content))
        seen: list[tuple[int, int]] = []

        def take(offset: int, data: bytes, found: bytearray = found, seen: list[tuple[int, int]] = seen) -> None:
            found[offset : offset + len(data)] = data
            seen.append((offset, len(data)))

        with (
            linked(surface, lambda number: Fault(cut_down=9000 if number == 0 else None)) as link,
            Client(link.url).connect(link.url, transport=transport, sink=take) as stream,
        ):
            list(stream)
            identity = stream.identity
        assert (identity.container_sha256, identity.size) == (
            Client(surface).identify(surface).container_sha256,
            len(content),
        )
        covered = sum(length for _, length in seen)
        assert covered == len(set().union(*(range(o, o + n) for o, n in seen))), "nothing twice"
        assert all(found[o : o + n] == content[o : o + n] for o, n in seen)
        assert covered > len(content) * 0.9


@pytest.mark.sweep(1)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.long
def test_encode_and_decode_leave_no_half_of_a_file(
    relief_file: Path, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    said = "lodestream: interrupted\n" if number == signal.SIGINT else "lodestream: terminated\n"
    places = tmp_path / "places"
    places.mkdir()
    began, out = tmp_path / "began", places / "o.lode"
    out.write_bytes(b"as it was")
    with command("encode", relief_file, out, before=ENDLESS.format(began=str(began))) as process:
        until(began.exists, process)
        time.sleep(0.5)
        process.send_signal(number)
        assert end(process) == (code, "", said)
    assert list(places.iterdir()) == [out]
    assert out.read_bytes() == b"as it was"
    with command("decode", relief_file.with_suffix(".lode"), places / "o.npy", before=STALLED) as process:
        until(lambda: any(path.stat().st_size == 100 for path in places.iterdir()), process)
        process.send_signal(number)
        assert end(process) == (code, "", said)
    assert list(places.iterdir()) == [out]


@pytest.mark.sweep(1)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.long
def test_the_demo_leaves_no_server(tmp_path: Path, number: signal.Signals, code: int) -> None:
    with command("demo", "--out", tmp_path / "demo") as process:
        until(lambda: descendants(process.pid), process)
        children = descendants(process.pid)
        time.sleep(0.3)
        process.send_signal(number)
        assert end(process)[0] == code
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]


def test_an_interrupt_of_an_import_is_one(tmp_path: Path) -> None:
    # A class body makes a RuntimeError of whatever is raised where a name is set, in Python before 3.12.
    before = """\
import sys, lodestream_client.commands.decode as decode
def interrupted(args):
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as error:
        raise RuntimeError("Error calling __set_name__") from error
decode.check_out = interrupted
"""
    with command("decode", "-", tmp_path / "o.npy", before=before) as process:
        assert end(process) == (130, "", "lodestream: interrupted\n")
