"""Containers of another version: built again from their uploads, and kept until that is done; or they wait."""

from __future__ import annotations

import argparse
import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

import lodestream as ls
from lodestream.container import sections
from lodestream_server.builds import worker
from lodestream_server.commands.fsck import register
from tests.server.builds import slow
from tests.server.builds.test_builds import building, running
from tests.server.helpers import hills, kept, npy, problem, push, settled, upload_of

BODY = npy(hills(seed=31))
NEXT = sections.MAGIC + bytes([sections.VERSION + 1])
SIGNATURES = {"next": NEXT, "earlier": b"\x89LODE\r\n\x03"}


def aged(container: bytes, signature: bytes = NEXT) -> bytes:
    """A container as of another version."""
    return signature + container[len(signature) :]


def age(data: Path, *surfaces: dict[str, Any], signature: bytes = NEXT) -> Path:
    """Put a container of another version in the place of that of surfaces, as a server of that version left it."""
    (now,) = {data / "containers" / f"{surface['container']}.lode" for surface in surfaces}
    old = aged(now.read_bytes(), signature)
    path = now.with_stem(hashlib.sha256(old).hexdigest())
    path.write_bytes(old)
    now.unlink()
    for surface in surfaces:
        record = data / "records" / f"{surface['id']}.json"
        record.write_text(json.dumps(json.loads(record.read_text()) | {"container": path.stem}))
    return path


def fsck(data: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict[str, Any]]:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(["fsck", str(data), "--json", *options])
    code = args.run(args)
    return code, json.loads(capsys.readouterr().out)


def assert_said(surface: dict[str, Any], words: str) -> None:
    assert re.search(words, surface["reason"]), surface["reason"]


@contextmanager
def waiting_builds(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Builds that wait for a file ``go`` in the data folder when they are half done."""
    with monkeypatch.context() as patched:
        patched.setattr(worker, "build", slow.wait)
        yield


@pytest.mark.parametrize("signature", SIGNATURES.values(), ids=SIGNATURES)
def test_a_container_of_another_version_is_built_again_and_kept_until_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signature: bytes
) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        # Of the same bytes, so that they have one container.
        surfaces = [push(http, BODY, closed=closed) for closed in ("auto", "none")]
        stored = http.get(f"{surfaces[0]['url']}/container", follow_redirects=True).content
    old = age(data, *surfaces, signature=signature)
    with waiting_builds(monkeypatch), running(data, workers=2) as http:
        for surface in surfaces:
            building(http, surface["url"])
            assert problem(http.get(f"{surface['url']}/container")) == (409, "not-ready")
        assert old.read_bytes() == aged(stored, signature)
        (data / "go").touch()
        assert [settled(http, surface["url"]) for surface in surfaces] == surfaces
        assert http.get(f"{surfaces[0]['url']}/container", follow_redirects=True).content == stored
    assert kept(data, "containers") == [f"{surfaces[0]['container']}.lode"]
    assert not (data / "damaged").exists()


def test_it_is_kept_where_it_cannot_be_built_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    old = age(data, surface)
    with monkeypatch.context() as patched:
        patched.setattr(worker, "build", slow.refuse)
        with running(data) as http:
            assert settled(http, surface["url"])["state"] == "waiting"
            # Another upload of the same bytes does not take it for a container that can be served.
            assert push(http, BODY)["state"] == "waiting"
            answer = http.get(f"/v1/containers/{old.stem}.lode")
            assert problem(answer) == (503, "missing")
            assert f"got version {sections.VERSION + 1}" in answer.json()["detail"]
    assert kept(data, "containers") == [old.name]
    with running(data) as http:
        assert http.post(f"{surface['url']}/retry").status_code == 202
        assert settled(http, surface["url"]) == surface
    assert kept(data, "containers") == [f"{surface['container']}.lode"]


@pytest.mark.parametrize("signature", SIGNATURES.values(), ids=SIGNATURES)
def test_what_was_uploaded_as_a_container_waits_and_says_why(tmp_path: Path, signature: bytes) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, ls.encode(hills(seed=32)))
    old = age(data, surface, signature=signature)
    upload = upload_of(data, surface) / "0"
    upload.write_bytes(old.read_bytes())
    record = data / "records" / f"{surface['id']}.json"
    values = json.loads(record.read_text()) | {"upload_sha256": None}  # of other bytes than these
    record.write_text(json.dumps(values))
    for _ in range(2):
        with running(data) as http:
            found = settled(http, surface["url"])
            assert found["state"] == "waiting"
            words = f"version {sections.VERSION}, .* got version {signature[-1]}"
            assert_said(found, words)
            assert problem(http.get(f"{surface['url']}/container")) == (424, "waiting")
        assert old.is_file()
        assert upload.read_bytes() == old.read_bytes()


def test_one_without_its_upload_waits_and_says_why(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    old = age(data, surface)
    (upload_of(data, surface) / "0").unlink()
    with running(data) as http:
        found = http.get(surface["url"]).json()
        assert found["state"] == "waiting"
        assert_said(found, f"got version {sections.VERSION + 1}.*upload is missing")
        assert http.post(f"{surface['url']}/retry").json()["state"] == "waiting"
        assert old.is_file()
        # Its file again makes it whole.
        assert push(http, BODY)["state"] == "ready"


def test_a_container_of_another_version_waits_when_it_comes(http: httpx.Client) -> None:
    for signature in SIGNATURES.values():
        found = push(http, aged(ls.encode(hills(seed=33)), signature))
        assert found["state"] == "waiting"
        assert_said(found, f"version {sections.VERSION}, .* got version {signature[-1]}")
        http.delete(found["url"]).raise_for_status()


def test_it_is_no_damage_and_a_repair_builds_it_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    old = age(data, surface)
    code, report = fsck(data, capsys)
    assert (code, report["clean"]) == (0, True)
    (finding,) = report["findings"]
    assert (finding["what"], finding["path"]) == ("version", f"containers/{old.name}")
    code, report = fsck(data, capsys, "--repair")
    (finding,) = report["findings"]
    assert (code, finding["repaired"], finding["repair"]) == (0, True, "built again")
    assert not (data / "damaged").exists()
    assert fsck(data, capsys)[1]["findings"] == []
    with running(data) as http:
        assert http.get(surface["url"]).json() == surface
