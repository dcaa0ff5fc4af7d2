"""What a start, a repair and a running server make of folders in which several things went wrong at once."""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream_server import running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.commands.fsck import register
from lodestream_server.storage.markers import MARKER
from tests.patience import PATIENCE
from tests.server.helpers import hills, npy, problem, settled, upload_of

BODY = npy(hills(seed=11))


class Two:
    """A folder in which two owners have a surface of the same bytes, and who they are."""

    def __init__(self, data: Path, keys: TokenFile) -> None:
        self.data = data
        self.keys = keys
        self.headers = {
            name: {"authorization": f"Bearer {keys.create(name, ('write',))[0]}"} for name in ("anna", "bert")
        }
        self.places: dict[str, str] = {}
        with self.served() as http:
            for name, headers in self.headers.items():
                answer = http.post("/v1/surfaces", content=BODY, headers=headers)
                self.places[name] = answer.headers["location"]
                assert settled(http, self.places[name])["state"] == "ready"

    def served(self) -> Any:
        return _served(self.data, self.keys.path)

    def record(self, name: str) -> Path:
        return self.data / "records" / f"{self.places[name].rpartition('/')[2]}.json"

    def upload(self, name: str) -> Path:
        record = json.loads(self.record(name).read_text())
        return self.data / "uploads" / str(record["upload"])


class _Served:
    def __init__(self, data: Path, keys: Path) -> None:
        self._server = running_server(data, workers=1, token_file=keys, public_reads=True)

    def __enter__(self) -> httpx.Client:
        self._http = httpx.Client(base_url=self._server.__enter__(), trust_env=False, timeout=PATIENCE)
        return self._http

    def __exit__(self, *error: Any) -> None:
        self._http.close()
        self._server.__exit__(*error)


def _served(data: Path, keys: Path) -> _Served:
    return _Served(data, keys)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Two:
    folder = tmp_path_factory.mktemp("two")
    return Two(folder / "data", TokenFile(folder / "tokens.json"))


@pytest.fixture
def two(made: Two, tmp_path: Path) -> Iterator[Two]:
    kept = made.data
    made.data = shutil.copytree(kept, tmp_path / "data")
    yield made
    made.data = kept


def fsck(data: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict[str, Any]]:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(["fsck", str(data), "--json", *options])
    code = args.run(args)
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("other", ["lost", "damaged"])
def test_a_delete_that_is_finished_takes_nothing_of_another_owner(two: Two, other: str) -> None:
    # As a backup under load may have it: the record of one is on its way out, that of the other did not come along.
    anna, bert = two.record("anna"), two.record("bert")
    anna.rename(anna.with_suffix(".deleted"))
    if other == "lost":
        bert.unlink()
    else:
        bert.write_text("{")
    with two.served() as http:
        assert http.get(two.places["anna"]).status_code == 404
        assert settled(http, two.places["bert"])["state"] == "ready"
        assert http.get(f"{two.places['bert']}/container", follow_redirects=True).status_code == 200
    assert (two.upload("bert") / "0").read_bytes() == BODY


def test_a_delete_that_is_finished_keeps_what_cannot_be_read(two: Two) -> None:
    anna, bert = two.record("anna"), two.record("bert")
    upload = two.upload("bert")
    whole = bert.read_bytes()
    anna.rename(anna.with_suffix(".deleted"))
    bert.write_text("{")
    (upload / bert.name).write_text("{")
    with two.served() as http:
        assert http.get(two.places["bert"]).json()["state"] == "missing"
        answer = http.post(f"{two.places['bert']}/retry", headers=two.headers["bert"])
        assert problem(answer) == (403, "not-owner")  # nobody knows the owner of a damaged record
    assert (upload / "0").read_bytes() == BODY
    bert.write_bytes(whole)  # from a backup
    with two.served() as http:
        assert settled(http, two.places["bert"])["state"] == "ready"


def test_what_is_missing_is_built_again_once_another_owner_has_pushed_it(two: Two) -> None:
    # A restored backup may lack the files of both, and have one record.
    two.record("bert").unlink()
    container = json.loads(two.record("anna").read_text())["container"]
    shutil.rmtree(two.upload("anna"))
    (two.data / "containers" / f"{container}.lode").unlink()
    with two.served() as http:
        assert http.get(two.places["anna"]).json()["state"] == "missing"
        assert http.post("/v1/surfaces", content=BODY, headers=two.headers["bert"]).status_code == 202
        assert settled(http, two.places["bert"])["state"] == "ready"
    with two.served() as http:
        assert settled(http, two.places["anna"])["state"] == "ready"
        assert http.get(f"{two.places['anna']}/container", follow_redirects=True).status_code == 200
    assert (two.upload("anna") / "0").read_bytes() == BODY


def test_a_rotten_upload_never_becomes_a_surface(two: Two) -> None:
    container = json.loads(two.record("anna").read_text())["container"]
    (two.data / "containers" / f"{container}.lode").unlink()
    place = two.upload("anna") / "0"
    place.write_bytes(BODY[:-2] + bytes([BODY[-2] ^ 1]) + BODY[-1:])
    with two.served() as http:
        surface = settled(http, two.places["anna"])
        assert surface["state"] == "waiting"
        assert "expected files with the SHA-256" in surface["reason"]
        # Whoever has the file makes it whole, for all who had the same.
        http.post("/v1/surfaces", content=BODY, headers=two.headers["anna"])
        assert settled(http, two.places["anna"])["container"] == container
        http.post(f"{two.places['bert']}/retry", headers=two.headers["bert"])
        assert settled(http, two.places["bert"])["container"] == container


def test_a_repair_keeps_the_records_beside_a_damaged_upload(two: Two, capsys: pytest.CaptureFixture[str]) -> None:
    place = two.upload("anna") / "0"
    place.write_bytes(BODY[:-1])
    two.record("bert").unlink()
    code, report = fsck(two.data, capsys, "--repair")
    assert code == 0
    assert {finding["what"] for finding in report["findings"]} == {"upload", "record"}
    with two.served() as http:
        for where in two.places.values():
            assert http.get(where).json()["state"] == "ready"
            assert http.get(f"{where}/container", follow_redirects=True).status_code == 200


def test_what_is_not_there_is_not_written_down_as_gone(two: Two, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in (two.data / "records").iterdir()}
    upload = two.upload("anna")
    upload.rename(two.data / "away")
    code, report = fsck(two.data, capsys, "--repair")
    assert code == 1
    assert not any(finding["repaired"] for finding in report["findings"])
    assert {path: path.read_bytes() for path in before} == before
    (two.data / "away").rename(upload)
    assert fsck(two.data, capsys)[0] == 0


def test_a_container_that_is_lost_is_not_unknown(two: Two) -> None:
    container = json.loads(two.record("anna").read_text())["container"]
    address = f"/v1/containers/{container}.lode"
    (two.data / "containers" / f"{container}.lode").unlink()
    two.upload("anna").rename(two.data / "away")
    with two.served() as http:
        assert problem(http.get(address)) == (503, "missing")
        assert http.get("/v1/containers/" + "0" * 64 + ".lode").status_code == 404


def test_a_container_that_is_cut_is_not_served(two: Two) -> None:
    container = json.loads(two.record("anna").read_text())["container"]
    path = two.data / "containers" / f"{container}.lode"
    path.write_bytes(path.read_bytes()[:-100])
    with two.served() as http:
        answer = http.get(f"/v1/containers/{container}.lode")
        assert problem(answer) == (500, "damaged")
        assert "immutable" not in answer.headers.get("cache-control", "")


@pytest.mark.parametrize("name", ["records", "uploads", "containers"])
def test_nothing_is_changed_while_a_folder_is_not_there(two: Two, name: str) -> None:
    folder = two.data / name
    with two.served() as http:
        folder.rename(two.data / "away")
        folder.mkdir()
        headers = two.headers["anna"]
        assert problem(http.delete(two.places["anna"], headers=headers)) == (503, "missing")
        answer = http.post("/v1/surfaces", content=npy(hills(seed=12)), headers=headers)
        assert problem(answer) == (503, "missing")
        assert list(folder.iterdir()) == []
        folder.rmdir()
        (two.data / "away").rename(folder)
        assert http.delete(two.places["anna"], headers=headers).status_code == 204
    with two.served() as http:
        assert http.get(two.places["anna"]).status_code == 404
        assert http.get(two.places["bert"]).json()["state"] == "ready"


def test_adopting_and_repairing_are_two_steps(two: Two, capsys: pytest.CaptureFixture[str]) -> None:
    from lodestream.errors import OptionError

    (two.data / "uploads" / MARKER).unlink()
    with pytest.raises(OptionError, match="adopt first"):
        fsck(two.data, capsys, "--adopt", "--repair")
    assert fsck(two.data, capsys, "--adopt")[0] == 0
    assert upload_of(two.data, {"id": two.record("anna").stem}).is_dir()
