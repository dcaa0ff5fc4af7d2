"""Open containers share what is known of them."""

from __future__ import annotations

import gc
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import pytest

from lodestream import encode
from lodestream.container import Index
from lodestream_server import containers
from lodestream_server.containers import Containers
from lodestream_server.storage import Storage
from tests.server.helpers import hills


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Of more containers than indexes are kept of, in a folder."""
    data = encode(hills(9, 8))
    found = [f"{number:064x}" for number in range(3 * containers._INDEXES_KEPT)]
    for name in found:
        (tmp_path / name).write_bytes(data)
    monkeypatch.setattr(Storage, "__init__", lambda self: None)
    monkeypatch.setattr(Storage, "container", lambda self, sha256: tmp_path / sha256)
    return found


def test_an_index_is_shared_while_a_container_is_open(names: list[str]) -> None:
    made = Containers(Storage.__new__(Storage))
    first = [made.open(name) for name in names]
    again = [made.open(name) for name in names]
    assert [one.index is other.index for one, other in zip(first, again, strict=True)] == [True] * len(names)
    for opened in first:
        opened.close()
    del first, opened
    gc.collect()
    third = [made.open(name) for name in names]
    assert all(one.index is other.index for one, other in zip(again, third, strict=True))
    for opened in (*again, *third):
        opened.close()


def test_no_more_indexes_are_kept_than_are_worth_it(names: list[str]) -> None:
    made = Containers(Storage.__new__(Storage))
    before = _indexes()
    for name in names:
        made.open(name).close()
    assert _indexes() - before == containers._INDEXES_KEPT


def _indexes() -> int:
    gc.collect()
    return sum(isinstance(item, Index) for item in gc.get_objects())


def test_of_many_who_open_a_container_at_once_one_reads_its_index(
    names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, read = Containers(Storage.__new__(Storage)), list[int]()
    together, right = threading.Barrier(8), containers._read_index

    def counted(file: BinaryIO) -> Index:
        read.append(1)
        return right(file)

    monkeypatch.setattr(containers, "_read_index", counted)

    def open_one(_: int) -> object:
        together.wait()
        opened = made.open(names[0])
        opened.close()
        return opened.index

    with ThreadPoolExecutor(8) as pool:
        indexes = list(pool.map(open_one, range(8)))
    assert len(set(map(id, indexes))) == 1
    assert len(read) == 1
