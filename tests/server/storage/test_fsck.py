"""``lodestream fsck``: what is damaged is found, named, set aside, and built again from the upload."""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.container import sections
from lodestream.errors import LodestreamError
from lodestream_server import running_server
from lodestream_server.builds import jobs, worker
from lodestream_server.commands.fsck import register
from lodestream_server.storage.storage import Storage
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.helpers import hills, npy, push, settled, upload_of

Fsck = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A folder with two surfaces and one that failed, and what its server said of them."""
    data = tmp_path_factory.mktemp("fsck") / "data"
    with (
        running_server(data, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        return data, [
            push(http, npy(hills(90, 80, seed=1)), name="one", precision="0.01"),
            push(http, npy(hills(seed=2)), filename="two.npy"),
            push(http, npy(hills(seed=3))[:-1]),
        ]


@pytest.fixture
def data(made: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> Path:
    return shutil.copytree(made[0], tmp_path / "data")


@pytest.fixture
def surfaces(made: tuple[Path, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    return made[1]


@pytest.fixture
def fsck(data: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Fsck]:
    """Runs the command on the folder: exit code, and what it prints."""
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())

    def call(*options: str) -> tuple[int, dict[str, Any]]:
        args = parser.parse_args(["fsck", str(data), "--json", *options])
        code = args.run(args)
        return code, json.loads(capsys.readouterr().out)

    yield call
    # Whatever was repaired: a server takes the folder, and leaves nothing to repair.
    Storage(data).close()
    code, report = call()
    # What cannot be found again is told as long as it is not deleted.
    lost = {
        finding["surface"] for finding in report["findings"] if finding["what"] in ("upload", "container", "record")
    }
    assert {finding["surface"] for finding in report["findings"]} == lost
    assert code == bool(lost)


def test_a_repair_ends_where_the_disk_stays_full(
    data: Path, fsck: Fsck, surfaces: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    container = data / "containers" / f"{surfaces[0]['container']}.lode"
    flip(container, 100)
    with monkeypatch.context() as full:
        full.setattr(jobs, "_FIRST_DELAY", 0.01)
        full.setattr(worker, "build", slow.find_full)
        code, report = fsck("--repair")
    assert code == 1
    finding = next(finding for finding in report["findings"] if finding["surface"] == surfaces[0]["id"])
    assert (finding["repaired"], finding["lost"]) == (False, False)
    assert "space on the server's disk" in finding["repair"]
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        assert settled(http, surfaces[0]["url"])["container"] == surfaces[0]["container"]


def flip(path: Path, place: int) -> None:
    bytes_ = bytearray(path.read_bytes())
    bytes_[place] ^= 1
    path.write_bytes(bytes_)


def is_whole(data: Path, original: Path, *surfaces: dict[str, Any]) -> bool:
    """Whether the folder has for these surfaces what the original has."""
    names = []
    for surface in surfaces:
        names += [f"records/{surface['id']}.json"]
        names += [str((upload_of(original, surface) / "0").relative_to(original))]
        if surface["container"]:
            names += [f"containers/{surface['container']}.lode"]
    return all((data / name).read_bytes() == (original / name).read_bytes() for name in names)


@pytest.mark.parametrize("gone", [(), ("upload",), ("folder",), ("container",), ("upload", "container")], ids="-".join)
def test_what_is_gone_is_not_counted(
    fsck: Fsck, data: Path, surfaces: list[dict[str, Any]], capsys: pytest.CaptureFixture[str], gone: tuple[str, ...]
) -> None:
    one, *_ = surfaces
    if "upload" in gone:
        (upload_of(data, one) / "0").unlink()
    if "folder" in gone:
        shutil.rmtree(upload_of(data, one))
    if "container" in gone:
        (data / "containers" / f"{one['container']}.lode").unlink()
    _, report = fsck()
    uploads, containers = list(data.glob("uploads/*/0")), list(data.glob("containers/*.lode"))
    assert (report["surfaces"], report["uploads"], report["containers"]) == (3, len(uploads), len(containers))
    assert report["bytes"] == sum(path.stat().st_size for path in (*uploads, *containers))
    what = {"folder": "upload"}
    assert {(it["what"], it["surface"]) for it in report["findings"]} == {(what.get(it, it), one["id"]) for it in gone}
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(["fsck", str(data)])
    args.run(args)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith(f"3 surfaces, {len(uploads)} uploads, {len(containers)} containers, ")


def state(data: Path, surface: dict[str, Any]) -> str:
    return str(json.loads((data / "records" / f"{surface['id']}.json").read_text())["state"])


def test_a_folder_in_order(fsck: Fsck, data: Path) -> None:
    code, report = fsck()
    assert (code, report["clean"], report["findings"]) == (0, True, [])
    assert (report["surfaces"], report["uploads"], report["containers"]) == (3, 3, 2)
    files = [*data.glob("containers/*.lode"), *data.glob("uploads/*/0")]
    assert report["bytes"] == sum(path.stat().st_size for path in files)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ("bit", "(at byte"),
        ("cut", "expected bytes with the SHA-256 of the name"),
        ("longer", "expected bytes with the SHA-256 of the name"),
        ("gone", "No such file"),
        ("other", "expected bytes with the SHA-256 of the name"),
        ("empty", "expected bytes with the SHA-256 of the name"),
        ("version", "got version 7"),
    ],
)
def test_a_damaged_container_is_found(
    fsck: Fsck, data: Path, surfaces: list[dict[str, Any]], damage: str, words: str
) -> None:
    one, two, _ = surfaces
    path = data / "containers" / f"{one['container']}.lode"
    whole = path.read_bytes()
    if damage == "bit":
        flip(path, len(whole) // 2)
    elif damage == "gone":
        path.unlink()
    elif damage == "other":
        shutil.copy(data / "containers" / f"{two['container']}.lode", path)
    else:
        start = len(sections.MAGIC)
        other = whole[:start] + b"\7" + whole[start + 1 :]
        path.write_bytes({"cut": whole[:-100], "longer": whole + b"\0", "empty": b"", "version": other}[damage])
    code, report = fsck()
    assert (code, report["clean"]) == (1, False)
    (finding,) = report["findings"]
    assert (finding["what"], finding["surface"], finding["repair"]) == ("container", one["id"], None)
    assert finding["path"] == f"containers/{one['container']}.lode"
    assert words in finding["problem"]
    path.write_bytes(whole)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "other"])
def test_a_damaged_record_is_found(fsck: Fsck, data: Path, surfaces: list[dict[str, Any]], text: str) -> None:
    one, two, _ = surfaces
    path = data / "records" / f"{one['id']}.json"
    whole = path.read_text()
    path.write_text((data / "records" / f"{two['id']}.json").read_text() if text == "other" else text)
    code, report = fsck()
    assert code == 1
    damaged = [finding for finding in report["findings"] if finding["what"] == "record"]
    assert [finding["surface"] for finding in damaged] == [one["id"]]
    path.write_text(whole)


def test_what_is_damaged_is_set_aside_and_built_again(
    fsck: Fsck, data: Path, made: tuple[Path, list[dict[str, Any]]]
) -> None:
    original, surfaces = made
    one, two, failed = surfaces
    container = data / "containers" / f"{one['container']}.lode"
    flip(container, 1000)
    damaged = container.read_bytes()
    record = data / "records" / f"{two['id']}.json"
    record.write_text("{")
    code, report = fsck("--repair")
    assert (code, report["clean"]) == (0, True)
    repairs = {finding["what"]: finding["repair"] for finding in report["findings"] if finding["what"] != "leftover"}
    assert repairs.keys() == {"container", "record"}
    assert all(words.endswith("sound again") for words in repairs.values())
    assert all(finding["repaired"] for finding in report["findings"])
    assert (data / "damaged" / "containers" / container.name).read_bytes() == damaged
    assert (data / "damaged" / "records" / record.name).read_text() == "{"
    assert is_whole(data, original, *surfaces)
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        assert [http.get(surface["url"]).json() for surface in surfaces] == [one, two, failed]
        stored = http.get(f"{one['url']}/container", follow_redirects=True).content
        assert np.array_equal(ls.decode(stored).points, ls.decode(container.read_bytes()).points)


def test_a_damaged_upload_leaves_its_surface(fsck: Fsck, data: Path, surfaces: list[dict[str, Any]]) -> None:
    one, two, failed = surfaces
    damaged = upload_of(data, one)
    flip(damaged / "0", 500)
    shutil.rmtree(upload_of(data, two))
    code, report = fsck()
    assert code == 1
    found = {(finding["what"], finding["surface"]) for finding in report["findings"]}
    assert found == {("upload", one["id"]), ("upload", two["id"])}
    code, report = fsck("--repair")
    # What is not there may be elsewhere: nothing is written that says that it is gone.
    assert code == 1
    repairs = {finding["surface"]: finding for finding in report["findings"]}
    assert "is sound and is served" in repairs[one["id"]]["repair"]
    assert "none of its files are here" in repairs[two["id"]]["repair"]
    assert [repairs[surface["id"]]["repaired"] for surface in (one, two)] == [True, False]
    assert (data / "damaged" / "uploads" / damaged.name / "0").is_file()
    assert [state(data, surface) for surface in surfaces] == ["ready", "ready", "failed"]
    assert [finding["surface"] for finding in fsck()[1]["findings"]] == [two["id"]]
    # From now on there is nothing to build it from.
    (data / "containers" / f"{one['container']}.lode").unlink()
    code, report = fsck("--repair")
    assert (code, report["findings"][0]["lost"], report["findings"][0]["repaired"]) == (1, True, False)
    # Its record is as it was: what comes back to its place is served again.
    assert [state(data, surface) for surface in (one, two, failed)] == ["ready", "ready", "failed"]


def test_upload_and_container_damaged_at_once(fsck: Fsck, data: Path, surfaces: list[dict[str, Any]]) -> None:
    one, two, _ = surfaces
    flip(upload_of(data, one) / "0", 500)
    flip(data / "containers" / f"{one['container']}.lode", 10)
    code, report = fsck("--repair")
    assert code == 1
    assert {finding["what"] for finding in report["findings"] if finding["lost"]} == {"upload", "container"}
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        assert [http.get(surface["url"]).json()["state"] for surface in (one, two)] == ["missing", "ready"]
        assert http.get(f"{one['url']}/container").status_code == 503
        # The same file again is all that it takes.
        again = push(http, npy(hills(90, 80, seed=1)), name="one", precision="0.01")
        assert (again["state"], again["id"], again["container"]) == ("ready", one["id"], one["container"])


def test_a_record_that_is_lost_keeps_what_may_be_its(
    fsck: Fsck, data: Path, made: tuple[Path, list[dict[str, Any]]]
) -> None:
    original, (one, two, failed) = made
    upload = upload_of(data, one)
    (data / "records" / f"{one['id']}.json").write_text("{")
    (upload / f"{one['id']}.json").write_text("{")
    code, report = fsck("--repair")
    assert (code, [finding["what"] for finding in report["findings"]]) == (1, ["record"])
    # Nothing is moved that may be what the record spoke of, and the surface is not forgotten.
    assert list(data.glob("damaged/*/*")) == []
    assert (upload / "0").is_file()
    assert (data / "containers" / f"{one['container']}.lode").is_file()
    assert is_whole(data, original, two, failed)
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        assert http.get(one["url"]).json()["state"] == "missing"
        assert http.get(f"{one['url']}/container").status_code == 503


def test_figures_that_are_not_those_of_the_container(
    fsck: Fsck, data: Path, made: tuple[Path, list[dict[str, Any]]]
) -> None:
    original, surfaces = made
    path = data / "records" / f"{surfaces[0]['id']}.json"
    record = json.loads(path.read_text())
    record["info"]["layers"][0]["rms"] *= 2
    path.write_text(json.dumps(record))
    code, report = fsck()
    assert (code, [finding["what"] for finding in report["findings"]]) == (1, ["figures"])
    assert fsck("--repair")[0] == 0
    assert is_whole(data, original, *surfaces)


def test_what_a_killed_server_leaves_is_no_damage(fsck: Fsck, data: Path) -> None:
    for name in ("incoming/ab/0", "work/cd/container", f"uploads/{'0' * 20}/0", f"containers/{'0' * 64}.lode"):
        path = data / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    (data / "records" / "x.json.0123.new").write_bytes(b"{")
    code, report = fsck()
    assert (code, report["clean"]) == (0, True)
    assert {finding["what"] for finding in report["findings"]} == {"leftover"}
    assert len(report["findings"]) == 5
    code, _ = fsck("--repair")
    assert code == 0
    assert fsck()[1]["findings"] == []


def test_it_refuses_to_work_beside_a_server_or_elsewhere(data: Path, tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    storage = Storage(data)
    args = parser.parse_args(["fsck", str(data), "--repair"])
    with pytest.raises(LodestreamError, match="which another one uses"):
        args.run(args)
    storage.close()
    (tmp_path / "empty").mkdir()
    args = parser.parse_args(["fsck", str(tmp_path / "empty")])
    with pytest.raises(LodestreamError, match="expected the data folder of a server"):
        args.run(args)
    assert list((tmp_path / "empty").iterdir()) == []


def test_it_says_in_words_what_it_found(
    data: Path, surfaces: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    path = data / "containers" / f"{surfaces[0]['container']}.lode"
    flip(path, -1)
    args = parser.parse_args(["fsck", str(data)])
    assert args.run(args) == 1
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith(f"container of surface {surfaces[0]['id']}, containers/{path.name}: expected bytes with")
    assert last.startswith("3 surfaces, 3 uploads, 2 containers, ")
    assert last.endswith(": 1 damaged")
