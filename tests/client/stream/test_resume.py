"""Connections that break, stall or lead nowhere: the stream goes on, and nothing that came comes again."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.transfer.receiver_state import MemoryStore
from lodestream_client import AsyncClient, Client, UnreachableError
from lodestream_client.commands.keeping import Kept
from lodestream_client.requests.api import Identity
from lodestream_client.stream import cache, reconnecting
from lodestream_client.stream.stream import BaseStream
from tests.links import Fault, Link, linked
from tests.patience import PATIENCE

from ..conftest import Run
from ..files import Ranged, ranged
from ..scripted import document, scripted

Terrain = NDArray[np.float32]

LATER = Fault(cut_down=0)


@pytest.fixture(autouse=True)
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waits between attempts that are in proportion to a link within one machine."""
    monkeypatch.setattr(reconnecting, "_FIRST_PAUSE", 0.002)
    monkeypatch.setattr(reconnecting, "_LONGEST_PAUSE", 0.05)


def follow(url: str, asynchronous: bool, **options: Any) -> tuple[list[ls.View], BaseStream]:
    options = {"close_timeout": 0.5, **options}
    if not asynchronous:
        with Client(url).connect(url, **options) as stream:
            return list(stream), stream

    async def loop() -> tuple[list[ls.View], BaseStream]:
        async with AsyncClient(url) as client, client.connect(url, **options) as stream:
            return [view async for view in stream], stream

    return asyncio.run(loop())


def nothing_twice(stream: BaseStream) -> bool:
    return stream._reception.data_bytes == stream._reception.cached.total


def breaks_after(*bytes_down: int, **manner: Any) -> Callable[[int], Fault]:
    """Connections that break after so many bytes each; the later ones hold."""
    return lambda number: Fault(cut_down=bytes_down[number], **manner) if number < len(bytes_down) else Fault()


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.mark.parametrize("transport", ["ws", "http", "auto"])
@pytest.mark.parametrize("reset", [False, True], ids=["end", "reset"])
def test_a_stream_that_breaks_again_and_again(
    surface: str, terrain: Terrain, asynchronous: bool, transport: str, reset: bool
) -> None:
    with linked(surface, breaks_after(4000, 700, 4000, 250, 6000, reset=reset)) as link:
        views, stream = follow(link.url, asynchronous, transport=transport, window=2000)
    assert stream.ended == "complete"
    assert np.array_equal(views[-1].points, terrain)
    assert [view.number for view in views] == list(range(len(views))), "each view once, in order"
    assert nothing_twice(stream)
    assert link.connections >= 5


@pytest.mark.parametrize("target", [ls.Target(level=3), ls.Target(order="level"), ls.Target(max_bytes=6000)], ids=repr)
def test_every_target_survives(surface: str, asynchronous: bool, target: ls.Target) -> None:
    whole, _ = follow(surface, False, target=target)
    with linked(surface, breaks_after(2000, 900, 1500)) as link:
        views, stream = follow(link.url, asynchronous, target=target, window=500, transport="ws")
    assert [(view.bytes, view.rms) for view in views] == [(view.bytes, view.rms) for view in whole]
    assert np.array_equal(views[-1].points, whole[-1].points)
    assert nothing_twice(stream)


def test_another_address_goes_on_with_what_is_held(surface: str, terrain: Terrain, asynchronous: bool) -> None:
    store = MemoryStore()
    with linked(surface, breaks_after(5000)) as one, pytest.raises(ls.TruncatedStreamError):
        follow(one.url, asynchronous, window=2000, store=store, deadline=0, transport="ws")
    details = Client(surface).get(surface).details
    container, size = str(details["container_sha256"]), int(details["bytes"])
    with linked(surface, Fault()) as other:
        views, stream = follow(other.url, asynchronous, store=store, container=container, size=size)
    assert np.array_equal(views[-1].points, terrain)
    assert 0 < stream.data_bytes < size - 2000
    assert stream.data_bytes < stream._reception.cached.total


def test_a_connection_that_falls_silent_is_replaced(surface: str, terrain: Terrain, asynchronous: bool) -> None:
    with linked(surface, breaks_after(4000, vanish=True)) as link:
        views, stream = follow(link.url, asynchronous, silence=0.4, close_timeout=0.1)
    assert np.array_equal(views[-1].points, terrain)
    assert nothing_twice(stream)


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_after_the_deadline_the_last_error_is_raised(surface: str, asynchronous: bool, transport: str) -> None:
    with (
        linked(surface, lambda number: Fault(cut_down=5000) if number == 0 else LATER) as link,
        pytest.raises((UnreachableError, ls.TruncatedStreamError, ls.LodestreamError)),
    ):
        follow(link.url, asynchronous, deadline=0.5, transport=transport)
    assert link.connections > 1


def test_without_a_deadline_nothing_is_replaced(surface: str, asynchronous: bool) -> None:
    with (
        linked(surface, breaks_after(5000)) as link,
        pytest.raises(ls.TruncatedStreamError, match="before the connection was lost"),
    ):
        follow(link.url, asynchronous, deadline=0, transport="ws")
    assert link.connections == 1


def test_where_nobody_listens_it_is_told_soon(asynchronous: bool) -> None:
    with pytest.raises(UnreachableError, match="no connection"):
        follow("http://127.0.0.1:9/v1/surfaces/ab", asynchronous)


def test_stopping_while_there_is_no_connection(surface: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("random.uniform", lambda least, most: 500.0)
    with linked(surface, lambda number: Fault(cut_down=5000) if number == 0 else LATER) as link:
        with Client(link.url).connect(
            link.url, deadline=1000, window=2000, close_timeout=0.2, transport="ws"
        ) as stream:
            next(stream)
            stopping = threading.Timer(0.5, stream.stop)
            stopping.start()
            list(stream)
            stopping.join()
        assert stream.ended == "stopped"
        with Client(surface).connect(
            surface, target=ls.Target(seconds=0.3), limit_rate=4000.0, deadline=1000
        ) as stream:
            list(stream)
        assert stream.ended == "seconds"

    async def late() -> str | None:
        async with (
            Link(surface, lambda number: Fault(cut_down=5000) if number == 0 else LATER) as link,
            AsyncClient(link.url) as client,
            client.connect(link.url, target=ls.Target(seconds=0.6), window=2000, deadline=1000) as stream,
        ):
            async for _ in stream:
                pass
            return stream.ended

    assert asyncio.run(late()) == "seconds"


@pytest.fixture
def without_sockets(tmp_path: Path, container_file: Path) -> Iterator[Ranged]:
    """A surface behind something that lets no WebSocket through."""
    folder = tmp_path / "v1" / "surfaces" / "ab"
    folder.mkdir(parents=True)
    shutil.copy(container_file, folder / "container")
    with ranged(tmp_path) as web:
        yield web


def test_where_no_websocket_comes_through_http_does(
    without_sockets: Ranged, terrain: Terrain, asynchronous: bool
) -> None:
    url = f"{without_sockets.url}/v1/surfaces/ab"
    views, stream = follow(url, asynchronous)
    assert stream.transport == "http"
    assert np.array_equal(views[-1].points, terrain)
    with pytest.raises(ls.NotFoundError, match="404"):
        follow(url, asynchronous, transport="ws")
    # A wrong address is one by either transport: it is said once.
    with pytest.raises(ls.NotFoundError, match="404") as wrong:
        follow(f"{without_sockets.url}/v1/surfaces/cd", asynchronous)
    assert "WebSocket" not in str(wrong.value)


def test_a_wish_that_cannot_be_met_is_told_at_once(surface: str, asynchronous: bool) -> None:
    for kind in ("ws", "http"):
        with pytest.raises(ls.OptionError, match="expected a level of 0 to"):
            follow(surface, asynchronous, target=ls.Target(level=99), transport=kind)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"transport": "carrier pigeon"}, "auto, ws or http"), ({"deadline": -1.0}, "deadline")],
)
def test_options_that_do_not_exist(surface: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ls.OptionError, match=words):
        Client(surface).connect(surface, **options)


# On disk.


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def parts(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.part"))


@pytest.fixture(params=["stream", "file"])
def source(request: pytest.FixtureRequest, surface: str, container_file: Path) -> Iterator[str]:
    if request.param == "stream":
        yield surface
        return
    with ranged(container_file.parent) as web:
        yield f"{web.url}/{container_file.name}"


def pull(run: Run, source: str, out: Path, *options: object) -> tuple[dict[str, Any], str]:
    code, stdout, stderr = run("pull", source, out, "--resume", "--json", *options)
    assert code == 0, stderr
    figures: dict[str, Any] = json.loads(stdout)
    return figures, stderr


def test_a_finer_pull_goes_on_from_a_coarser_one(
    run: Run, source: str, folder: Path, tmp_path: Path, terrain: Terrain
) -> None:
    coarse, stderr = pull(run, source, tmp_path / "a.npy", "--max-bytes", "9000")
    assert coarse["ended"] == "bytes"
    assert "from an earlier pull" not in stderr
    assert len(parts(folder)) == 1
    level, stderr = pull(run, source, tmp_path / "b.npy", "--level", "3")
    assert "from an earlier pull" in stderr
    again, _ = pull(run, source, tmp_path / "c.npy", "--max-bytes", "9000")
    assert {key: again[key] for key in ("bytes", "rms", "max")} == {key: coarse[key] for key in ("bytes", "rms", "max")}
    assert again["wire_bytes"] < 1500, "nothing but what is said"
    assert np.array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "c.npy"))
    whole, _ = pull(run, source, tmp_path / "d.npy")
    assert whole["ended"] == "complete"
    assert whole["wire_bytes"] < whole["bytes"] - 8000 + 3000
    assert np.array_equal(np.load(tmp_path / "d.npy"), terrain)
    assert parts(folder) == [], "what has been written whole is not kept twice"
    plain = json.loads(run("pull", source, tmp_path / "e.npy", "--level", "3", "--json")[1])
    assert {key: level[key] for key in ("bytes", "rms")} == {key: plain[key] for key in ("bytes", "rms")}


@pytest.mark.parametrize(("code", "how"), [("bad-token", " with another token"), ("busy", "")])
def test_what_is_kept_after_a_token_was_refused_needs_another_one(
    folder: Path, code: str, how: str, capsys: pytest.CaptureFixture[str]
) -> None:
    refusal = ls.RemoteError(code, "no more")
    with suppress(ls.RemoteError), Kept(asked=True) as kept:
        kept.use(Identity("0" * 64, None, 5000))
        kept.write(0, bytes(1000))
        raise refusal
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"are kept; pull --resume continues from there{how}")


def test_a_pull_that_breaks_is_gone_on_with_by_the_next(
    run: Run, surface: str, server: str, folder: Path, tmp_path: Path, terrain: Terrain
) -> None:
    # The first connection is that of the question which container it is.
    with linked(surface, lambda number: Fault() if number == 0 else Fault(cut_down=9000)) as link:
        code, _, stderr = run("pull", link.url, tmp_path / "o.npy", "--resume", "--retry", "0", "--transport", "ws")
    assert code == 1
    assert "are kept; pull --resume continues from there" in stderr
    assert np.load(tmp_path / "o.npy").shape == terrain.shape, "as far as it came"
    kept = parts(folder)[0].stat().st_size
    assert kept > 4000
    figures, _ = pull(run, surface, tmp_path / "o.npy")
    assert figures["wire_bytes"] < figures["bytes"] - kept + 2500
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_a_pull_that_is_killed_is_gone_on_with(
    run: Run, surface: str, folder: Path, tmp_path: Path, terrain: Terrain, transport: str
) -> None:
    def fault(number: int) -> Fault:
        """It cannot end before it is killed: the rest does not come, nor anything of later connections."""
        return Fault(cut_down=12_000 if number < 2 else 1, vanish=True)

    with linked(surface, fault) as link:
        command = [sys.executable, "-m", "lodestream_client", "pull", link.url, str(tmp_path / "o.npy"), "--resume"]
        command += ["--limit-rate", "64kbit", "--transport", transport]
        environment = {**os.environ, "LODESTREAM_CACHE": str(folder)}
        process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
        try:
            until = time.monotonic() + PATIENCE
            while not parts(folder) or parts(folder)[0].stat().st_size < 6000:
                assert time.monotonic() < until
                assert process.poll() is None, "it was to be killed before its end"
                time.sleep(0.01)
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait()
    kept = parts(folder)[0].stat().st_size
    figures, stderr = pull(run, surface, tmp_path / "o.npy", "--transport", transport)
    assert "from an earlier pull" in stderr
    assert figures["wire_bytes"] < figures["bytes"] - kept + 5000
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)


def test_two_pulls_do_not_write_the_same_file(run: Run, surface: str, folder: Path, tmp_path: Path) -> None:
    identity = Client(surface).identify(surface)
    assert identity.name is not None
    assert identity.size is not None
    part = cache.CacheFile(folder, identity.name, identity.size)
    code, _, stderr = run("pull", surface, tmp_path / "o.npy", "--resume")
    assert code == 1
    assert "another program is receiving the same surface" in stderr
    part.close()
    assert run("pull", surface, tmp_path / "o.npy", "--resume")[0] == 0


def test_damage_on_disk_is_met_once(run: Run, surface: str, folder: Path, tmp_path: Path, terrain: Terrain) -> None:
    pull(run, surface, tmp_path / "a.npy", "--max-bytes", "9000")
    path = parts(folder)[0]
    data = bytearray(path.read_bytes())
    data[3000] ^= 1
    path.write_bytes(data)
    figures, _ = pull(run, surface, tmp_path / "b.npy")
    assert figures["ended"] == "complete"
    assert np.array_equal(np.load(tmp_path / "b.npy"), terrain)


def test_bytes_that_no_checksum_of_ours_covers_are_not_met_twice(
    run: Run, surface: str, folder: Path, tmp_path: Path, terrain: Terrain
) -> None:
    identity = Client(surface).identify(surface)
    assert identity.name is not None
    assert identity.size is not None
    part = cache.CacheFile(folder, identity.name, identity.size)
    part.write(0, bytes(2000))
    part.close()
    code, _, stderr = run("pull", surface, tmp_path / "o.npy", "--resume")
    assert code == 1
    assert "at byte" in stderr
    assert parts(folder) == []
    pull(run, surface, tmp_path / "o.npy")
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)


def test_a_file_without_a_version_is_not_kept(
    run: Run, folder: Path, tmp_path: Path, container_file: Path, terrain: Terrain
) -> None:
    with ranged(container_file.parent) as web:
        web.tags = False
        _, stderr = pull(run, f"{web.url}/{container_file.name}", tmp_path / "o.npy")
    assert "nothing is kept" in stderr
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)
    assert parts(folder) == []


def test_a_file_that_is_cut_short_is_asked_for_once(
    run: Run, tmp_path: Path, container_file: Path, asynchronous: bool, terrain: Terrain
) -> None:
    whole = container_file.read_bytes()
    path = tmp_path / "cut.lode"
    with ranged(tmp_path) as web:
        for left in (len(whole) - 1000, 5000, 40, 0):
            path.write_bytes(whole[:left])
            web.requests.clear()
            with pytest.raises(ls.TruncatedStreamError, match=r"the file was cut short|shorter file"):
                follow(f"{web.url}/cut.lode", asynchronous)
            asked = [part for _, part in web.requests]
            assert len(asked) == len(set(asked)) <= 3
        code, _, stderr = run("pull", f"{web.url}/cut.lode", tmp_path / "o.npy")
        assert code == 1
        assert "shorter file" in stderr
        path.write_bytes(whole)
        assert run("pull", f"{web.url}/cut.lode", tmp_path / "o.npy")[0] == 0
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)


@pytest.mark.usefixtures("paced")
def test_seconds_and_the_metadata_are_kept_too(run: Run, surface: str, folder: Path, tmp_path: Path) -> None:
    figures, _ = pull(run, surface, tmp_path / "a.npy", "--seconds", "1.2", "--limit-rate", "64kbit")
    assert figures["ended"] == "seconds"
    again, _ = pull(run, surface, tmp_path / "a.npy", "--max-bytes", "1000")
    assert again["ended"] == "bytes"
    assert again["wire_bytes"] < 1000


@pytest.mark.usefixtures("slow_handshakes")
def test_a_pull_from_a_server_that_falls_silent_ends(run: Run, surface: str, tmp_path: Path) -> None:
    with linked(surface, lambda number: Fault(cut_down=3000, vanish=True)) as link:
        code, _, stderr = run("pull", link.url, tmp_path / "o.npy", "--retry", "0.4", "--transport", "ws")
    assert code == 1
    assert "has sent nothing for 0.4 seconds" in stderr


def test_resume_at_another_address_and_retry_of_the_command(
    run: Run, surface: str, folder: Path, tmp_path: Path, terrain: Terrain
) -> None:
    # The first connection asks what there is, the second is the stream.
    with linked(surface, lambda number: Fault(cut_down=9000) if number < 2 else LATER) as link:
        assert run("pull", link.url, tmp_path / "o.npy", "--resume", "--retry", "0.5")[0] == 1
    code, stdout, stderr = run("pull", surface, tmp_path / "o.npy", "--resume", "--json")
    assert code == 0, stderr
    assert json.loads(stdout)["wire_bytes"] < int(Client(surface).get(surface).details["bytes"]) - 2000
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)
    for retry in ("-1", "soon", "inf"):
        assert run("pull", surface, tmp_path / "o.npy", "--retry", retry)[0] == 2


@pytest.mark.parametrize("container", ["../../victim", "a" * 63, "A" * 64, "ab" * 32 + "/", ["ab" * 32]])
def test_a_container_that_no_server_of_ours_names_is_refused(
    run: Run, folder: Path, tmp_path: Path, container: Any
) -> None:
    victim = tmp_path / "victim.part"
    victim.write_bytes(b"of somebody else")
    told = {"id": "ab", "state": "ready", "container_sha256": container, "bytes": 5000}
    with scripted(lambda _: document(told)) as server:
        code, _, stderr = run("pull", f"{server.url}/v1/surfaces/ab", tmp_path / "o.npy", "--resume")
    assert code == 1
    assert "expected" in stderr
    assert len(stderr.splitlines()) == 1
    assert victim.read_bytes() == b"of somebody else"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["victim.part"]


@pytest.mark.parametrize("size", [0, -1, 1 << 80, 10**400, True])
def test_nor_one_of_a_size_that_none_has(run: Run, folder: Path, tmp_path: Path, size: int) -> None:
    told = {"id": "ab", "state": "ready", "container_sha256": "ab" * 32, "bytes": size}
    with scripted(lambda _: document(told)) as server:
        code, _, stderr = run("pull", f"{server.url}/v1/surfaces/ab", tmp_path / "o.npy", "--resume")
    assert code == 1
    assert "expected" in stderr
    assert not folder.exists()


def test_a_link_in_the_folder_is_not_followed(
    run: Run, surface: str, folder: Path, tmp_path: Path, terrain: Terrain
) -> None:
    identity = Client(surface).identify(surface)
    victim = tmp_path / "victim"
    victim.write_bytes(b"of somebody else")
    folder.mkdir()
    (folder / f"{identity.name}.part").symlink_to(victim)
    code, _, stderr = run("pull", surface, tmp_path / "o.npy", "--resume")
    assert code == 1
    assert "symbolic links" in stderr
    # Without --resume keeping is not asked for, and the surface comes nevertheless.
    code, _, stderr = run("pull", surface, tmp_path / "o.npy")
    assert code == 0, stderr
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)
    assert victim.read_bytes() == b"of somebody else"


def test_a_folder_that_cannot_be_used_is_named(
    run: Run, surface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "file"))
    code, _, stderr = run("pull", surface, tmp_path / "o.npy", "--resume")
    assert code == 1
    assert f"LODESTREAM_CACHE), got {tmp_path / 'file'}: " in stderr
    assert "leave out --resume" in stderr
