"""``lodestream fsck`` on the folder of a server that has ended; what it repairs, the next server builds."""

from __future__ import annotations

import argparse
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

import lodestream as ls
from lodestream.errors import InputError, LodestreamError
from lodestream.stores import Folder, open_store
from lodestream_server import running_server
from lodestream_server.commands import fsck as command
from lodestream_server.commands.fsck import register
from lodestream_server.store.claim import claim
from lodestream_server.store.data import Data
from lodestream_server.store.surfaces import Surfaces
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, push, settled, upload_of

Surface = dict[str, Any]
Fsck = Callable[..., tuple[int, dict[str, Any]]]


@contextmanager
def serving(data: Path | str, **settings: Any) -> Iterator[httpx.Client]:
    with (
        running_server(data, workers=1, **settings) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").json().get("role", "writer") == "writer", "it to write")
        yield http


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Surface]]:
    """A folder with three surfaces, one of them an uploaded container, and one that failed."""
    data = tmp_path_factory.mktemp("fsck") / "data"
    with serving(data) as http:
        return data, [
            push(http, npy(hills(90, 80, seed=1)), name="one", precision="0.01"),
            push(http, npy(hills(seed=2)), filename="two.npy"),
            push(http, ls.encode(hills(seed=3), precision=0.01), filename="three.lode"),
            push(http, npy(hills(seed=4))[:-1]),
        ]


@pytest.fixture
def data(made: tuple[Path, list[Surface]], tmp_path: Path) -> Path:
    return shutil.copytree(made[0], tmp_path / "data")


@pytest.fixture
def surfaces(made: tuple[Path, list[Surface]]) -> list[Surface]:
    return made[1]


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(["fsck", *arguments])
    return int(args.run(args))


@pytest.fixture
def fsck(data: Path, capsys: pytest.CaptureFixture[str]) -> Fsck:
    def call(*options: str) -> tuple[int, dict[str, Any]]:
        code = run(str(data), "--json", *options)
        return code, json.loads(capsys.readouterr().out)

    return call


def flip(path: Path, place: int) -> None:
    body = bytearray(path.read_bytes())
    body[place] ^= 1
    path.write_bytes(body)


def container(data: Path, surface: Surface) -> Path:
    return data / "containers" / f"{surface['container_sha256']}.lode"


def test_a_folder_in_order(fsck: Fsck, data: Path) -> None:
    before = sorted((path, path.stat().st_mtime_ns) for path in data.rglob("*"))
    code, report = fsck()
    assert (code, report["clean"], report["findings"], report["strays"]) == (0, True, [], 0)
    assert (report["surfaces"], report["uploads"], report["containers"], report["queued"]) == (4, 4, 3, 0)
    assert sorted((path, path.stat().st_mtime_ns) for path in data.rglob("*")) == before


def test_what_is_repaired_is_built_by_the_next_start(fsck: Fsck, data: Path, surfaces: list[Surface]) -> None:
    one, two, three, failed = surfaces
    flip(container(data, one), 1000)
    os.truncate(container(data, three), 100)
    flip(data / "built" / f"{two['id']}.json", 40)
    code, report = fsck()
    found = {(it["what"], it["surface"]) for it in report["findings"]}
    assert (code, found) == (1, {("container", one["id"]), ("container", three["id"]), ("built", two["id"])})
    code, report = fsck("--repair")
    assert (code, report["clean"], report["queued"]) == (0, True, 3)
    code, report = fsck()
    assert (code, report["findings"], report["queued"]) == (0, [], 3)
    with serving(data) as http:
        assert [settled(http, it["url"]) for it in surfaces] == [one, two, three, failed]
        stored = http.get(f"{one['url']}/container", follow_redirects=True).content
    assert (ls.decode(stored).points == ls.decode(container(data, one).read_bytes()).points).all()
    code, report = fsck()
    assert (code, report["findings"], report["queued"]) == (0, [], 0)


def test_what_is_lost_comes_back_with_its_file(fsck: Fsck, data: Path, surfaces: list[Surface]) -> None:
    one, two, *_ = surfaces
    flip(upload_of(data, one) / "0", 500)
    flip(container(data, one), 10)
    flip(data / "surfaces" / f"{two['id']}.json", 40)
    code, report = fsck("--repair")
    assert (code, len({it["key"] for it in report["findings"] if it["lost"]})) == (1, 3)
    with serving(data) as http:
        http.delete(one["url"]).raise_for_status()
        again = [push(http, npy(hills(90, 80, seed=1)), name="one", precision="0.01")]
        again += [push(http, npy(hills(seed=2)), filename="two.npy")]
        assert [it | {"created": None} for it in again] == [it | {"created": None} for it in (one, two)]
    code, report = fsck()
    assert (code, report["findings"]) == (0, [])


def test_a_lost_manifest_comes_back_with_its_file(fsck: Fsck, data: Path, surfaces: list[Surface]) -> None:
    _, two, *_ = surfaces
    flip(data / "surfaces" / f"{two['id']}.json", 40)
    shutil.rmtree(data / "scratch")
    with serving(data) as http:
        assert http.get(two["url"]).status_code == 404
        assert push(http, npy(hills(seed=2)), filename="two.npy")["container_sha256"] == two["container_sha256"]
    assert fsck()[1]["findings"] == []


def test_strays_are_removed(fsck: Fsck, data: Path) -> None:
    names = [f"uploads/{'0' * 64}/0", f"containers/{'0' * 64}.lode"]
    for name in names:
        (data / name).parent.mkdir(parents=True, exist_ok=True)
        (data / name).write_bytes(b"half")
    code, report = fsck()
    assert (code, report["strays"], report["stray_bytes"], report["collected"]["keys"]) == (0, 2, 8, [])
    assert fsck("--collect")[1]["collected"]["keys"] == [], "they may be of something that has just begun"
    for name in names:
        os.utime(data / name, (1, 1))
    code, report = fsck("--collect")
    assert (code, report["refused"]) == (0, None)
    assert report["collected"] == {"bytes": 8, "keys": sorted(names, key=lambda name: not name.startswith("uploads"))}
    assert fsck()[1]["strays"] == 0


def test_it_says_why_it_removes_no_strays(
    data: Path, surfaces: list[Surface], capsys: pytest.CaptureFixture[str]
) -> None:
    flip(data / "surfaces" / f"{surfaces[0]['id']}.json", 40)
    assert run(str(data), "--collect") == 1
    words = f"no stray removed: surfaces/{surfaces[0]['id']}.json cannot be read: "
    assert capsys.readouterr().out.splitlines()[-1].startswith(words)


def test_what_waits_is_tried_again_by_the_next_start(fsck: Fsck, data: Path, surfaces: list[Surface]) -> None:
    one, *_ = surfaces
    container(data, one).unlink()
    assert fsck("--repair")[0] == 0
    known = Surfaces(Folder(data), data / "scratch" / "index.sqlite")
    known.sync()
    known.stuck(one["id"], "no library")
    known.close()
    code, report = fsck()
    assert (code, report["waiting"], report["retried"], report["queued"]) == (0, [one["id"]], False, 0)
    code, report = fsck("--retry")
    assert (code, report["waiting"], report["retried"], report["queued"]) == (0, [one["id"]], True, 1)
    with serving(data) as http:
        assert settled(http, one["url"]) == one


def test_an_index_elsewhere(
    fsck: Fsck, data: Path, surfaces: list[Surface], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    container(data, surfaces[0]).unlink()
    assert fsck("--repair")[0] == 0
    (tmp_path / "fast" / "lodestream").mkdir(parents=True)
    known = Surfaces(Folder(data), tmp_path / "fast" / "lodestream" / "index.sqlite")
    known.sync()
    known.stuck(surfaces[0]["id"], "no library")
    known.close()
    assert fsck()[1]["waiting"] == []
    assert fsck("--scratch", str(tmp_path / "fast"))[1]["waiting"] == [surfaces[0]["id"]]
    monkeypatch.setenv("LODESTREAM_SCRATCH", str(tmp_path / "fast"))
    assert fsck()[1]["waiting"] == [surfaces[0]["id"]]


def test_it_refuses_to_work_beside_a_server_or_elsewhere(data: Path, tmp_path: Path) -> None:
    guard = claim(data)
    for options in ((), ("--repair",)):
        with pytest.raises(LodestreamError, match="which another one uses"):
            run(str(data), *options)
    os.close(guard)
    (tmp_path / "empty").mkdir()
    for options in ((), ("--repair",), ("--collect",), ("--retry",)):
        for folder in ("empty", "nowhere"):
            with pytest.raises(LodestreamError, match="expected the data of a server"):
                run(str(tmp_path / folder), *options)
    assert list((tmp_path / "empty").iterdir()) == []
    assert not (tmp_path / "nowhere").exists()


def test_a_folder_without_surfaces_and_one_of_an_earlier_version(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    with serving(data) as http:
        one = push(http, npy(hills()))
        assert http.delete(one["url"]).status_code == 204
    assert run(str(data), "--collect") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "0 strays removed, 0.0 MB"
    stray = data / "containers" / f"{'0' * 64}.lode"
    stray.write_bytes(b"whole")
    os.utime(stray, (1, 1))
    assert run(str(data), "--collect") == 1
    assert "surfaces/ may be missing by mistake" in capsys.readouterr().out
    assert stray.exists()
    earlier = tmp_path / "earlier"
    (earlier / "records").mkdir(parents=True)
    with pytest.raises(InputError) as served:
        Data(earlier)
    with pytest.raises(InputError) as checked:
        run(str(earlier))
    assert str(checked.value) == str(served.value)
    assert "expected a data folder of this version" in str(served.value)


def test_a_retry_without_an_index_says_so(fsck: Fsck, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    index = data / "scratch" / "index.sqlite"
    assert fsck("--retry")[1]["index"]
    assert run(str(data), "--retry") == 0
    assert "no index" not in capsys.readouterr().out
    shutil.rmtree(data / "scratch")
    assert not fsck("--retry")[1]["index"]
    assert run(str(data), "--retry") == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"no index at {index}: nobody knows what waits.")
    assert run(str(data)) == 0
    assert "no index" not in capsys.readouterr().out


def test_who_only_looks_makes_nothing(data: Path) -> None:
    shutil.rmtree(data / "scratch")
    (data / "lock").unlink()
    before = sorted(data.rglob("*"))
    assert run(str(data)) == 0
    assert sorted(data.rglob("*")) == before


def test_it_says_in_words_what_it_found(
    data: Path, surfaces: list[Surface], capsys: pytest.CaptureFixture[str]
) -> None:
    path = container(data, surfaces[0])
    flip(path, -1)
    assert run(str(data)) == 1
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith(f"container of surface {surfaces[0]['id']}, containers/{path.name}: expected bytes with")
    assert last.startswith("4 surfaces, 4 uploads, 3 containers, ")
    assert last.endswith(": 1 damaged")
    assert run(str(data), "--repair") == 0
    first, last, more = capsys.readouterr().out.splitlines()
    assert first.endswith(" - removed; the next start of the server builds it again")
    assert last.endswith(": 1 damaged, 1 of these repaired")
    assert more == "the next start of the server builds 1 surface"


def test_a_bucket_is_checked_beside_its_servers_and_repaired_without_them(
    memory: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, bad = open_store(memory), tmp_path / "bad"

    def asked(*options: str) -> tuple[int, dict[str, Any]]:
        code = run(memory, "--json", *options)
        return code, json.loads(capsys.readouterr().out)

    with serving(memory, scratch=tmp_path / "first") as http:
        one, two = push(http, npy(hills(seed=1))), push(http, ls.encode(hills(seed=2)), filename="two.lode")
        http.put("/v1/names/one", json={"surface": one["id"]}).raise_for_status()
        code, report = asked()
        assert (code, report["clean"], report["findings"], report["data"]) == (0, True, [], memory)
        assert (report["surfaces"], report["uploads"], report["containers"], report["strays"]) == (2, 2, 2, 0)
        key = f"containers/{one['container_sha256']}.lode"
        bad.write_bytes(b"half")
        store.put_file(key, bad)
        code, report = asked()
        assert (code, [(it["what"], it["key"], it["surface"]) for it in report["findings"]]) == (
            1,
            [("container", key, one["id"])],
        )
        with monkeypatch.context() as patch:
            patch.setattr(command, "_PATIENCE", 0.5)
            for option in ("--repair", "--collect"):
                with pytest.raises(LodestreamError, match=r"no server writes to s3://memory/data, but .* end it"):
                    run(memory, option)
        with pytest.raises(LodestreamError, match="lodestream retry URL"):
            run(memory, "--retry")
    code, report = asked("--repair", "--collect")
    assert (code, report["clean"], report["queued"]) == (0, True, 1)
    assert (report["refused"], report["collected"]["keys"]) == (None, []), "no stray is a day old"
    with serving(memory, scratch=tmp_path / "second") as http:
        assert [settled(http, it["url"]) for it in (one, two)] == [one, two]
        http.delete(two["url"]).raise_for_status()
    code, report = asked()
    assert (code, report["surfaces"], report["strays"]) == (0, 1, 2), "servers collect them after a day"


def test_who_waits_for_a_bucket_takes_over_after_a_repair(memory: str, tmp_path: Path) -> None:
    with serving(memory, scratch=tmp_path / "first"):
        pass
    with command._writing(open_store(memory)) as lease:
        assert lease.held
        with (
            running_server(memory, workers=1, scratch=tmp_path / "second") as url,
            httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
        ):
            assert http.get("/readyz").json()["role"] == "waiting"
            lease.close()
            eventually(lambda: http.get("/readyz").json()["role"] == "writer", "it to write")
