"""Containers that are uploaded: kept as they came once all of them was checked, and nothing of a wrong one is kept."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.container import describe, sections
from lodestream.container.model import Errors
from lodestream.container.writer import CodedLayer, write_container
from lodestream.stores import Folder
from lodestream.transform.predictors import default_predictors
from lodestream_server import running_server
from lodestream_server.builds import worker
from lodestream_server.builds.finished import plain
from lodestream_server.maintenance.check import check
from lodestream_server.store import layout
from tests.core.container.forgery import index_of, rewritten, unchanged, with_layer_errors, with_metadata
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, kept, npy, problem, push, settled
from tests.server.routes.test_bad_uploads import stored

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")


def whole(seed: int = 1) -> ls.Surface:
    """A surface of two blocks with holes, attributes and metadata."""
    blocks = []
    for number in range(2):
        z = hills(seed=seed)
        r, c = np.indices(z.shape).astype(np.float32)
        mask = np.ones(z.shape, bool)
        mask[5 + number : 9, 6:11] = False
        attributes: dict[str, Any] = {
            "kind": (r % 7).astype(np.uint8),
            "flow": np.stack((r, np.sqrt(c)), axis=-1).astype(np.float64),
        }
        blocks.append(ls.Block(np.stack((r, c + 29 * number, z), axis=-1), mask=mask, attributes=attributes))
    return ls.Surface(blocks=blocks, metadata={"name": f"whole/{seed}\x1b[31m", "crs": "LOCAL_CS[]", "nodata": -1})


@pytest.fixture(scope="module")
def exact() -> bytes:
    return ls.encode(hills(seed=71))


@pytest.fixture(scope="module")
def near() -> bytes:
    return ls.encode(ls.Surface(hills(seed=72), metadata={"name": "near"}), 0.5)


def fetched(http: httpx.Client, surface: dict[str, Any]) -> bytes:
    return http.get(f"{surface['url']}/container", follow_redirects=True).raise_for_status().content


def test_a_container_is_kept_as_it_is(http: httpx.Client, data: Path) -> None:
    surface = whole()
    container = ls.encode(surface)
    made = push(http, container, filename="whole.lode")
    assert made["state"] == "ready", made["reason"]
    assert made["errors"] == "checked"
    assert made["options"] == {}
    assert made["container_sha256"] == hashlib.sha256(container).hexdigest()
    assert fetched(http, made) == container
    told = plain(describe(index_of(container), channels=True))
    assert {key: made[key] for key in told} == told
    assert made["metadata"]["crs"] == "LOCAL_CS[]"
    assert made["name"] == "whole/1[31m"
    eventually(lambda: not kept(data, "scratch/work"), "the build's folder to be removed")
    for level in (0, len(made["levels"]) - 1):
        answer = http.get(f"{made['url']}/levels/{level}", params={"format": "ply"})
        assert (answer.status_code, answer.content[:3]) == (200, b"ply")


def test_the_same_bytes_are_the_same_surface(http: httpx.Client, near: bytes) -> None:
    first = push(http, near, name="Another name")
    assert (first["name"], first["metadata"]["name"], first["errors"]) == ("Another name", "near", "told")
    answer = http.post("/v1/surfaces", content=near, params={"name": "Another name"})
    assert (answer.status_code, answer.json()["id"]) == (200, first["id"])
    assert fetched(http, first) == near


def test_a_file_and_its_container_have_one_container(http: httpx.Client, exact: bytes) -> None:
    built = push(http, npy(hills(seed=73)))
    sent = push(http, fetched(http, built))
    assert sent["id"] != built["id"]
    assert sent["container_sha256"] == built["container_sha256"]
    assert "errors" not in built
    assert sent["errors"] == "checked"


@pytest.mark.parametrize(
    "query",
    [
        {"precision": "1"},
        {"rms": "1"},
        {"effort": "fast"},
        {"precision": "kind=1"},
        {"closed": "rows"},
        {"band": "1"},
        {"array": "a"},
    ],
    ids=repr,
)
def test_options_have_no_place_beside_a_container(
    http: httpx.Client, data: Path, exact: bytes, query: dict[str, str]
) -> None:
    before = stored(data)
    answer = http.post("/v1/surfaces", content=exact, params=query)
    assert problem(answer) == (422, "bad-option")
    assert "only name and filename" in answer.json()["detail"]
    assert next(iter(query)) in answer.json()["detail"]
    assert stored(data) == before


def test_a_container_comes_by_itself(http: httpx.Client, data: Path, exact: bytes, near: bytes) -> None:
    before = stored(data)
    for others in ((near,), (npy(hills()),)):
        for files in ((exact, *others), (*others, exact)):
            parts = [("file", (f"{k}.lode", file)) for k, file in enumerate(files)]
            answer = http.post("/v1/surfaces", files=parts)
            assert problem(answer) == (422, "bad-file")
            assert "A container is uploaded alone" in answer.json()["detail"]
    assert stored(data) == before


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 16]) + data[place + 1 :]


def digest_forged(data: bytes) -> bytes:
    return with_metadata(data, lambda values: values.update(values_sha256="0" * 64))


def index_forged(data: bytes) -> bytes:
    index = index_of(data)
    return rewritten(data, unchanged, replace(index, segments=index.segments[:-1]))


WRONG: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "magic alone": (lambda data: data[:7], "at byte 7"),
    "no header": (lambda data: data[:8], "at byte 8"),
    "half": (lambda data: data[: len(data) // 2], "cut short .at byte"),
    "without its last byte": (lambda data: data[:-1], "cut short .at byte"),
    "one byte more": (lambda data: data + b"\0", "1 bytes more .at byte"),
    "twice": (lambda data: data + data, "bytes more .at byte"),
    "header": (lambda data: flipped(data, 20), "at byte 8"),
    "segment": (lambda data: flipped(data, index_of(data).segments[-1].range.offset), "at byte"),
    "metadata": (lambda data: flipped(data, index_of(data).metadata.offset + 3), "at byte"),
    "index": (lambda data: flipped(data, index_of(data).index.offset + 5), "at byte"),
    "footer": (lambda data: flipped(data, len(data) - 20), "at byte"),
    "errors of a layer": (lambda data: with_layer_errors(data, 0, 0.5, 1), "error of layer 0.*at byte"),
    "digest": (digest_forged, "SHA-256"),
    "index forged": (index_forged, "at byte"),
    "name": (lambda data: with_metadata(data, lambda values: values.update(name=[1])), "a name.*at byte"),
    "long name": (lambda data: with_metadata(data, lambda values: values.update(name="n" * 5000)), "a name.*at byte"),
    "too deep": (lambda data: with_metadata(data, lambda values: values.update(deep=nested())), "metadata that JSON"),
}


def nested() -> list[Any]:
    values: list[Any] = []
    for _ in range(500):
        values = [values]
    return values


@pytest.mark.parametrize("what", WRONG)
def test_nothing_of_a_wrong_container_is_kept(http: httpx.Client, data: Path, exact: bytes, what: str) -> None:
    before = stored(data)
    change, words = WRONG[what]
    made = push(http, change(exact))
    assert made["state"] == "failed"
    assert made["container_sha256"] is None
    assert re.search(words, made["reason"]), made["reason"]
    assert "\n" not in made["reason"]
    new = [path for path in stored(data) if path not in before]
    assert {path.partition("/")[0] for path in new} == {"built", "surfaces", "uploads"}  # until somebody deletes it
    assert http.get(f"{made['url']}/container").status_code == 409
    assert kept(data, "scratch/work") == []
    http.delete(made["url"]).raise_for_status()
    assert stored(data) == before


def test_metadata_that_are_too_long_are_refused_at_once(http: httpx.Client, data: Path, exact: bytes) -> None:
    place = index_of(exact).metadata.offset
    longer = exact[:place] + bytes([sections.METADATA]) + b"\x81\x80\x04" + bytes(65537)
    before = len(http.get("/v1/surfaces?limit=1000").json()["surfaces"])
    answer = http.post("/v1/surfaces", content=longer)
    assert problem(answer) == (413, "too-large")
    assert "65537 bytes of metadata, and at most 65536 are read" in answer.json()["detail"]
    assert len(http.get("/v1/surfaces?limit=1000").json()["surfaces"]) == before


def test_limits_of_builds_hold(tmp_path: Path, exact: bytes) -> None:
    with (
        running_server(tmp_path / "data", workers=1, max_vertices=40 * 30 - 1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, exact)
        assert made["state"] == "waiting"
        assert "at most 1,199 vertices, got 1,200" in made["reason"]


def promising(rows: int, columns: int) -> bytes:
    """A container of a few hundred bytes whose header promises so many points of a plane, with rules of x and y."""
    across = np.stack([*np.indices((9, 9))[::-1], np.zeros((9, 9))], axis=-1)
    known = index_of(ls.encode(across)).header
    assert known.plane is not None
    header = replace(known, blocks=(((rows, columns), (False, False)),), exact=False, corrected=False)
    header = replace(header, predictors=default_predictors(header.layout)[np.newaxis])
    header = replace(header, empty=((2 << header.levels) - 1,))
    nothing = Errors(0.0, 0.0)
    return write_container(header, [CodedLayer(nothing, [])], [nothing] * (header.levels + 1), [], {}, exact=False)


def test_a_small_container_that_takes_much_memory_is_held_to_that_of_a_build(tmp_path: Path) -> None:
    container = promising(1 << 14, 1 << 14)
    assert len(container) < 2000
    with (
        running_server(tmp_path / "data", workers=1, build_memory=600 << 20) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, container)
        assert made["state"] == "waiting"
        assert "expected a surface that takes at most 300 MiB to check" in made["reason"]
        assert push(http, promising(64, 64))["state"] == "ready"


def test_what_takes_too_long_is_ended(tmp_path: Path, exact: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        running_server(tmp_path / "data", workers=1, build_seconds=0.001) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, exact)
        assert made["state"] == "waiting"
        assert "took longer" in made["reason"]


def test_whose_word_the_errors_are_outlives_a_repair(tmp_path: Path, exact: bytes, near: bytes) -> None:
    data = tmp_path / "data"
    with (
        running_server(data, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = {name: push(http, body) for name, body in (("checked", exact), ("told", near))}
    store = Folder(data)
    assert check(store).findings == []
    for name, surface in made.items():
        key = layout.built_key(surface["id"])
        built = layout.parse(layout.Built, key, (data / key).read_bytes())
        info = json.loads(built.info)
        assert info["errors"] == name
        for errors, repaired in ((name, name), (None, "told"), ("measured", "told")):
            # With other figures than the container has, or without a word of whose they are.
            wrong = json.dumps(info | {"bytes": 5, "errors": errors}).encode()
            (data / key).write_bytes(layout.dump(replace(built, info=wrong)))
            assert [finding.what for finding in check(store).findings] == ["figures"]
            assert check(store, repair=True).clean
            assert check(store).findings == []
            with (
                running_server(data, workers=1) as url,
                httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
            ):
                told = http.get(surface["url"]).json()
            assert told == surface | {"errors": repaired}


def test_a_container_that_is_lost_is_copied_again_and_never_encoded(tmp_path: Path, exact: bytes) -> None:
    data = tmp_path / "data"
    with (
        running_server(data, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, exact)
        assert made["state"] == "ready"
    lost = data / "containers" / f"{made['container_sha256']}.lode"
    lost.unlink()
    with (
        running_server(data, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        assert problem(http.get(f"{made['url']}/container")) == (409, "not-ready")
        again = push(http, exact)
        assert (again["state"], again["container_sha256"], again["errors"]) == (
            "ready",
            made["container_sha256"],
            "checked",
        )
    assert lost.read_bytes() == exact


def test_a_build_of_a_container_does_not_encode(tmp_path: Path, exact: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    def encode(*_: object, **__: object) -> bytes:
        raise AssertionError("a container was encoded again")

    monkeypatch.setattr(ls, "encode", encode)
    (tmp_path / "0").write_bytes(exact)
    folder = tmp_path / "work"
    folder.mkdir()
    job = worker.Job((tmp_path / "0",), "x.lode", None, "auto", {}, 1 << 20, folder)
    built = worker.build(job)
    assert isinstance(built, worker.Built)
    assert job.container.read_bytes() == exact
    assert built.errors == "checked"
    assert worker.read_progress(folder) > 0
    with pytest.raises(AssertionError):
        worker.build(worker.Job((_npy(tmp_path),), "x.npy", None, "auto", {}, 1 << 20, folder))


def _npy(folder: Path) -> Path:
    (folder / "1").write_bytes(npy(hills()))
    return folder / "1"


def with_layers(count: int) -> bytes:
    """A sound container but for its many layers, none of which has a segment."""
    header = index_of(ls.encode(np.add.outer(np.arange(9.0), np.arange(8.0)))).header
    header = replace(header, exact=False, corrected=False)
    nothing = Errors(0.0, 0.0)
    layers = [CodedLayer(nothing, [])] * count
    return write_container(header, layers, [nothing] * (header.levels + 1), [], {}, exact=False)


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (1200, "at most 1,024 layers, got 1,200"),
        (20_000, "more than 1,286 sections"),
        (3, "segments in each of 3 layers"),
    ],
)
def test_too_many_layers_and_empty_ones_are_refused(tmp_path: Path, count: int, text: str) -> None:
    """Nobody can open what would hold up the event loop, and its description is small."""
    with (
        running_server(tmp_path / "data", workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        answer = http.post("/v1/surfaces", content=with_layers(count))
        if answer.status_code == 413:
            reason = answer.text
        else:
            made = settled(http, answer.headers["location"])
            assert made["state"] == "failed"
            reason = made["reason"]
        assert text in reason
        assert len(http.get("/v1/surfaces").content) < 10_000
