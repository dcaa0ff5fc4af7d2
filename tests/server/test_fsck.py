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
from lodestream.errors import LodestreamError
from lodestream_server import running_server
from lodestream_server.fsck_command import register
from lodestream_server.storage import Storage
from tests.server.helpers import hills, npy, push

Fsck = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A folder with two surfaces and one that failed, and what its server said of them."""
    data = tmp_path_factory.mktemp("fsck") / "data"
    with (
        running_server(data, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=60) as http,
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
    assert (code, report["findings"]) == (0, [])


def flip(path: Path, place: int) -> None:
    bytes_ = bytearray(path.read_bytes())
    bytes_[place] ^= 1
    path.write_bytes(bytes_)


def is_whole(data: Path, original: Path, *surfaces: dict[str, Any]) -> bool:
    """Whether the folder has for these surfaces what the original has."""
    names = []
    for surface in surfaces:
        names += [f"records/{surface['id']}.json"]
        if surface["container"]:
            names += [f"containers/{surface['container']}.lode", f"uploads/{surface['id']}/0"]
    return all((data / name).read_bytes() == (original / name).read_bytes() for name in names)


def state(data: Path, surface: dict[str, Any]) -> str:
    return str(json.loads((data / "records" / f"{surface['id']}.json").read_text())["state"])


def test_a_folder_in_order(fsck: Fsck, data: Path) -> None:
    code, report = fsck()
    assert (code, report["clean"], report["findings"]) == (0, True, [])
    assert (report["surfaces"], report["uploads"], report["containers"]) == (3, 2, 2)
    files = [*data.glob("containers/*"), *data.glob("uploads/*/0")]
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
        ("version", "version 0"),
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
        start = len(b"\x89LODE\r\n")
        older = whole[:start] + b"\0" + whole[start + 1 :]
        path.write_bytes({"cut": whole[:-100], "longer": whole + b"\0", "empty": b"", "version": older}[damage])
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
    assert all(words.endswith("built again") for words in repairs.values())
    assert (data / "damaged" / "containers" / container.name).read_bytes() == damaged
    assert (data / "damaged" / "records" / record.name).read_text() == "{"
    assert is_whole(data, original, *surfaces)
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=60) as http:
        assert [http.get(surface["url"]).json() for surface in surfaces] == [one, two, failed]
        stored = http.get(f"{one['url']}/container", follow_redirects=True).content
        assert np.array_equal(ls.decode(stored).points, ls.decode(container.read_bytes()).points)


def test_a_damaged_upload_leaves_its_surface(fsck: Fsck, data: Path, surfaces: list[dict[str, Any]]) -> None:
    one, two, failed = surfaces
    flip(data / "uploads" / one["id"] / "0", 500)
    shutil.rmtree(data / "uploads" / two["id"])
    code, report = fsck()
    assert code == 1
    found = {(finding["what"], finding["surface"]) for finding in report["findings"]}
    assert found == {("upload", one["id"]), ("upload", two["id"])}
    code, report = fsck("--repair")
    assert code == 0
    assert all("is whole and is served" in finding["repair"] for finding in report["findings"])
    assert (data / "damaged" / "uploads" / one["id"] / "0").is_file()
    assert [state(data, surface) for surface in surfaces] == ["ready", "ready", "failed"]
    assert fsck()[1]["findings"] == []
    # From now on there is nothing to build it from.
    (data / "containers" / f"{one['container']}.lode").unlink()
    code, report = fsck("--repair")
    assert (code, report["findings"][0]["lost"]) == (1, True)
    assert [state(data, surface) for surface in (one, two, failed)] == ["failed", "ready", "failed"]


def test_upload_and_container_damaged_at_once(fsck: Fsck, data: Path, surfaces: list[dict[str, Any]]) -> None:
    one, two, _ = surfaces
    flip(data / "uploads" / one["id"] / "0", 500)
    flip(data / "containers" / f"{one['container']}.lode", 10)
    code, report = fsck("--repair")
    assert code == 1
    assert {finding["what"] for finding in report["findings"] if finding["lost"]} == {"upload", "container"}
    assert [state(data, surface) for surface in (one, two)] == ["failed", "ready"]


def test_a_record_that_is_lost_keeps_what_may_be_its(
    fsck: Fsck, data: Path, made: tuple[Path, list[dict[str, Any]]]
) -> None:
    original, (one, two, failed) = made
    (data / "records" / f"{one['id']}.json").write_text("{")
    (data / "uploads" / one["id"] / "record.json").write_text("{")
    assert fsck("--repair")[0] == 1
    kept = {str(path.relative_to(data / "damaged")) for path in data.glob("damaged/*/*")}
    assert kept == {f"records/{one['id']}.json", f"uploads/{one['id']}", f"containers/{one['container']}.lode"}
    assert is_whole(data, original, two, failed)


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
    with pytest.raises(LodestreamError, match="another works"):
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
    assert last.startswith("3 surfaces, 2 uploads, 2 containers, ")
    assert last.endswith(": 1 damaged")
