"""Very many surfaces: no request looks at all of them, or puts them in order."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream_server import running_server
from lodestream_server.storage import catalog
from lodestream_server.storage.catalog import Catalog
from lodestream_server.storage.records import Record
from lodestream_server.storage.storage import Storage
from tests.patience import PATIENCE
from tests.server.helpers import hills, npy

_COUNT = 20_000


def record(number: int, **more: Any) -> Record:
    values = {"name": None, "created": 1e9 + number, "filenames": ("a.npy",), "upload_bytes": 1000 + number}
    return Record(**{"id": f"{number:020x}", "options": {}, **values, **more})


class Counting(dict[str, Record]):
    """Records by id, and how often one was looked for."""

    looks = 0

    def __getitem__(self, key: str) -> Record:
        Counting.looks += 1
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        Counting.looks += 1
        return super().get(key, default)

    def _all(self) -> Any:
        raise AssertionError("expected single records to be looked for, got a look at all of them")

    __iter__ = keys = values = items = _all


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Of a server with very many surfaces, all of one upload, which come in no order."""
    folder, numbers = tmp_path_factory.mktemp("many"), list(range(_COUNT))
    random.Random(1).shuffle(numbers)
    same = {"state": "ready", "container": "c" * 64, "upload_sha256": "d" * 64, "upload": "d" * 64}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Storage, "records", lambda self: [])  # nothing is to be built
        begin = Storage.__init__

        def begin_full(self: Storage, root: Path) -> None:
            begin(self, root)
            self._catalog = Catalog(record(number, **same) for number in numbers)
            self._catalog._records = Counting(self._catalog._records)

        patch.setattr(Storage, "__init__", begin_full)
        with (
            running_server(folder, max_surfaces=_COUNT, workers=1) as url,
            httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
        ):
            yield http


@pytest.fixture
def client(full: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> httpx.Client:
    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("expected nothing to be sorted")

    monkeypatch.setattr(catalog, "sorted", refuse, raising=False)
    Counting.looks = 0
    return full


def test_a_page_looks_at_what_is_on_it(client: httpx.Client) -> None:
    address = "/v1/surfaces"
    for start in (0, 100, 200):
        page = client.get(address).json()
        assert [surface["id"] for surface in page["surfaces"]] == [f"{start + number:020x}" for number in range(100)]
        address = page["next"]
    last = client.get("/v1/surfaces", params={"after": f"{1e9 + _COUNT - 3!r}_{_COUNT - 3:020x}"}).json()
    assert [surface["id"] for surface in last["surfaces"]] == [f"{_COUNT - 2:020x}", f"{_COUNT - 1:020x}"]
    assert Counting.looks < 4 * 110


def test_figures_and_files_look_at_hardly_any(client: httpx.Client) -> None:
    assert f"lodestream_surfaces {_COUNT:.1f}" in client.get("/metrics").text
    assert client.get(f"/v1/containers/{'e' * 64}.lode").status_code == 404
    assert Counting.looks == 0
    # It is not on the disk: one of its surfaces tells, before and after the look there, that it was not deleted.
    assert client.get(f"/v1/containers/{'c' * 64}.lode").status_code == 503
    assert Counting.looks == 2


def test_an_upload_that_has_no_room_looks_at_none(client: httpx.Client) -> None:
    body = npy(hills(9, 8))
    answer = client.post("/v1/surfaces", content=body[:100])
    assert (answer.status_code, answer.json()["code"]) == (507, "full")
    assert Counting.looks == 0


def test_what_is_counted_follows_the_records() -> None:
    made = Catalog([record(1, state="ready", container="a" * 64), record(2, upload_bytes=7)])
    assert made.serves("a" * 64)
    assert not made.serves("b" * 64)
    assert made.has_size(7, form=False)
    assert not made.has_size(8, form=False)
    assert made.has_size(None, form=False)
    assert made.has_size(8, form=True)
    made.put(record(2, upload_bytes=7, state="failed"))
    assert not made.has_size(7, form=False)
    made.put(record(1, state="missing", container="a" * 64))
    assert made.has_container("a" * 64)
    assert not made.serves("a" * 64)
    made.put(replace(record(1, container="b" * 64), state="ready"))
    assert (made.serves("b" * 64), made.has_container("a" * 64)) == (True, False)
    made.drop(record(1).id)
    made.drop(record(2).id)
    assert not made.serves("b" * 64)
    assert not made.has_size(None, form=False)
    assert not made.has_size(8, form=True)


def test_a_start_puts_very_many_in_order_once() -> None:
    numbers = list(range(3000))
    random.Random(2).shuffle(numbers)
    made = Catalog(record(number, created=1e9 + number // 2) for number in numbers)
    assert [item.id for item in made.all()] == [f"{number:020x}" for number in range(3000)]
