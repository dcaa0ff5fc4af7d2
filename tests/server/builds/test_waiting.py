"""What could not be built for a local reason waits, with its upload and the reason, until somebody asks again."""

from __future__ import annotations

import argparse
import errno
import json
import logging
import os
from pathlib import Path
from typing import Any

import pytest

from lodestream.errors import FormatError, TooLargeError, UnavailableError
from lodestream_server.builds import jobs, worker
from lodestream_server.commands.fsck import register
from lodestream_server.storage.records import Record
from lodestream_server.storage.storage import Storage
from tests.server.builds import slow
from tests.server.builds.test_builds import building, running
from tests.server.helpers import eventually, hills, npy, problem, push, settled, upload_of

BODY = npy(hills(seed=5))


def fsck(data: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict[str, Any]]:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(["fsck", str(data), "--json", *options])
    code = args.run(args)
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    "cause",
    [
        UnavailableError("a library is missing"),
        TooLargeError("more vertices than this server takes"),
        MemoryError("no memory"),
        OSError(errno.EIO, "the disk"),
        PermissionError(errno.EACCES, "not for us"),
    ],
)
def test_a_reason_that_is_not_in_the_bytes_may_pass(cause: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(*_: object, **__: object) -> object:
        if isinstance(cause, UnavailableError | TooLargeError):
            raise cause
        try:
            raise cause
        except Exception:
            raise FormatError("expected a file that can be read") from None

    monkeypatch.setattr(worker, "_build", read)
    refused = worker.build(worker.Job((), None, None, "auto", {}, 1, Path()))
    assert isinstance(refused, worker.Refused)
    assert not refused.final


def test_bytes_that_are_no_surface_are_refused_for_good(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY[:-1])
        assert surface["state"] == "failed"
        assert (upload_of(data, surface) / "0").read_bytes() == BODY[:-1]
        assert http.delete(surface["url"]).status_code == 204
        assert not (data / "uploads" / surface["id"]).exists()


@pytest.mark.parametrize(("number", "state"), [(errno.ENOSPC, "queued"), (errno.EIO, "waiting")])
def test_nobody_is_told_of_a_failure_that_a_restart_could_take_back(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    number: int,
    state: str,
) -> None:
    """A record that cannot be written says after a restart that the surface is queued."""
    caplog.set_level(logging.INFO, "lodestream_server")
    write = Storage._write

    def broken(storage: Storage, record: Record) -> None:
        if record.state == "failed":
            raise OSError(number, os.strerror(number))
        write(storage, record)

    monkeypatch.setattr(Storage, "_write", broken)
    monkeypatch.setattr(jobs, "_FIRST_DELAY", 0.01)
    with running(tmp_path / "data") as http:
        location = http.post("/v1/surfaces", content=BODY[:-1]).headers["location"]

        def reason() -> str | None:
            said: dict[str, Any] = http.get(location).json()
            assert said["state"] in ("queued", "building", state)
            return said.get("reason") if said["state"] == state else None

        told = eventually(reason, "a reason")
        assert not [record for record in caplog.records if " failed: " in record.getMessage()]
        assert 'state="failed"' not in http.get("/metrics").text
        monkeypatch.undo()
        if state == "queued":
            assert told == "waits for space on the server's disk"
        else:
            assert "that could not be recorded: the server's disk: Input/output error" in told
            assert http.post(f"{location}/retry").status_code == 202
        assert settled(http, location)["state"] == "failed"
    with running(tmp_path / "data") as http:
        assert http.get(location).json()["state"] == "failed"


def test_it_waits_over_a_restart_and_is_built_when_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.kill)
    with running(data) as http:
        surface = push(http, BODY)
        assert surface["state"] == "waiting"
        assert "process ended" in surface["reason"]
        for path in (f"{surface['url']}/container", f"{surface['url']}/levels/0"):
            assert problem(http.get(path)) == (424, "waiting")
    monkeypatch.undo()
    with running(data) as http:
        # Nobody asked: it is not built at every start, which it may have ended.
        assert http.get(surface["url"]).json() == surface
        answer = http.post(f"{surface['url']}/retry")
        assert (answer.status_code, answer.headers["location"]) == (202, surface["url"])
        ready = settled(http, surface["url"])
        assert (ready["state"], ready["reason"]) == ("ready", None)
        answer = http.post(f"{surface['url']}/retry")
        assert (answer.status_code, answer.json()) == (200, ready)
        assert http.post("/v1/surfaces/0123/retry").status_code == 404


def test_asking_at_once_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.explode)
    with running(tmp_path / "data") as http:
        surface = push(http, BODY)
        for _ in range(10):
            assert http.post(f"{surface['url']}/retry").status_code == 202
            assert settled(http, surface["url"])["state"] == "waiting"


def test_fsck_builds_what_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.explode)
    with running(data) as http:
        surface = push(http, BODY)
    assert fsck(data, capsys)[0] == 0
    assert fsck(data, capsys, "--retry")[1]["waiting"] == [surface["id"]]
    monkeypatch.undo()
    code, report = fsck(data, capsys, "--retry")
    assert (code, report["waiting"]) == (0, [])
    with running(data) as http:
        assert http.get(surface["url"]).json()["state"] == "ready"


@pytest.mark.parametrize("build", [slow.kill, slow.explode, slow.refuse])
def test_a_rebuild_that_fails_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], build: Any
) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    upload = upload_of(data, surface) / "0"
    container = data / "containers" / f"{surface['container']}.lode"
    whole = container.read_bytes()
    container.write_bytes(whole[:-1])
    monkeypatch.setattr(worker, "build", build)
    code, report = fsck(data, capsys, "--repair")
    (finding,) = report["findings"]
    assert (code, finding["repaired"], finding["lost"]) == (1, False, False)
    assert "waiting: " in finding["repair"]
    assert upload.read_bytes() == BODY
    monkeypatch.undo()
    code, _ = fsck(data, capsys, "--retry")
    assert code == 0
    assert container.read_bytes() == whole
    with running(data) as http:
        assert http.get(surface["url"]).json() == surface


def test_an_upload_that_cannot_be_read_is_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        where = http.post("/v1/surfaces", content=BODY).headers["location"]
        building(http, where)  # which has been found as it was acknowledged
        (upload_of(data, http.get(where).json()) / "0").write_bytes(BODY[:-1])  # as a bad disk gives it back
        (data / "go").touch()
        surface = settled(http, where)
        assert surface["state"] == "waiting"
        assert f"expected {len(BODY)} bytes, got {len(BODY) - 1}" in surface["reason"]
        # The same file again makes it whole.
        assert push(http, BODY)["state"] == "ready"


def test_fsck_without_a_lock_repairs_what_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    (data / "lock").unlink()
    container = data / "containers" / f"{surface['container']}.lode"
    whole = container.read_bytes()
    container.write_bytes(whole[::-1])
    code, report = fsck(data, capsys, "--repair")
    assert (code, [finding["repaired"] for finding in report["findings"]]) == (0, [True])
    assert container.read_bytes() == whole
    assert (data / "damaged" / "containers" / container.name).read_bytes() == whole[::-1]


@pytest.mark.parametrize("kind", ["container", "upload"])
def test_setting_aside_on_another_disk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    from lodestream_server.store import durable

    class OtherDisk(durable.Disk):
        def rename(self, source: Path, target: Path) -> None:
            if "damaged" in target.parts and "damaged" not in source.parts:
                raise OSError(errno.EXDEV, "Invalid cross-device link")
            super().rename(source, target)

    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    container = data / "containers" / f"{surface['container']}.lode"
    upload = upload_of(data, surface)
    damaged = container if kind == "container" else upload / "0"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    bytes_ = damaged.read_bytes()
    monkeypatch.setattr(durable, "disk", OtherDisk())
    assert fsck(data, capsys, "--repair")[0] == 0
    aside = data / "damaged" / damaged.relative_to(data / f"{kind}s").parent
    aside = data / "damaged" / f"{kind}s" / (damaged.name if kind == "container" else f"{upload.name}/0")
    assert aside.read_bytes() == bytes_
    storage = Storage(data)
    assert storage.get(surface["id"]).state == "ready"
    storage.close()


def test_nothing_is_lost_where_it_cannot_be_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lodestream_server.store import durable

    class NoRename(durable.Disk):
        def rename(self, source: Path, target: Path) -> None:
            raise OSError(errno.EROFS, "Read-only file system")

    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    container = data / "containers" / f"{surface['container']}.lode"
    container.write_bytes(container.read_bytes()[:-1])
    before = {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}
    monkeypatch.setattr(durable, "disk", NoRename())
    with pytest.raises(OSError, match="Read-only"):
        fsck(data, capsys, "--repair")
    assert {path: path.read_bytes() for path in data.rglob("*") if path.is_file()} == before
