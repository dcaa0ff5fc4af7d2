"""Open containers share what is known of them."""

from __future__ import annotations

import gc
import threading
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import httpx
import numpy as np
import pytest

from lodestream import Block, Surface, Target, encode
from lodestream.container import Index
from lodestream.container.metadata import MAX_BYTES
from lodestream.grid.layout import Layout
from lodestream.planning.planner import plan
from lodestream_server import running_server
from lodestream_server.problems import BusyError
from lodestream_server.storage import containers
from lodestream_server.storage.containers import Containers
from lodestream_server.storage.storage import Storage
from tests.patience import PATIENCE
from tests.server.helpers import hills, kept, push


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Of more containers than indexes are kept of, in a folder."""
    data = encode(hills(9, 8))
    found = [f"{number:064x}" for number in range(3 * containers._INDEXES_KEPT)]
    for name in found:
        (tmp_path / name).write_bytes(data)
    monkeypatch.setattr(Storage, "__init__", lambda self: None)
    monkeypatch.setattr(Storage, "container", lambda self, sha256: tmp_path / sha256)
    monkeypatch.setattr(Storage, "gone", lambda self, sha256: BusyError(sha256))
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


def test_only_a_container_whose_index_is_in_memory_opens_at_once(names: list[str]) -> None:
    made = Containers(Storage.__new__(Storage))
    assert made.open_known(names[0], "me") is None
    first = made.open(names[0], "me")
    again = made.open_known(names[0], "me")
    assert again is not None
    assert again.index is first.index
    for opened in (first, again):
        opened.close()
    assert made._open == {}
    (Path(first.file.name)).unlink()
    with pytest.raises(BusyError):
        made.open_known(names[0])


def test_no_more_indexes_are_kept_than_are_worth_it(names: list[str]) -> None:
    made = Containers(Storage.__new__(Storage))
    before = _indexes()
    for name in names:
        made.open(name).close()
    assert _indexes() - before == containers._INDEXES_KEPT


def test_nor_more_than_so_many_bytes_of_them(names: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    made = Containers(Storage.__new__(Storage))
    with made.open(names[0]).file as file:
        each = sum(containers.index_memory(file))
    assert each > 1000
    monkeypatch.setattr(containers, "_BYTES_KEPT", 3 * each + 1)
    before = _indexes() - 1
    for name in names:
        made.open(name).close()
    assert _indexes() - before == 3


def test_those_that_are_open_have_room_for_so_many_bytes_of_indexes(names: list[str]) -> None:
    with Containers(Storage.__new__(Storage)).open(names[0]).file as file:
        each = sum(containers.index_memory(file))
    made = Containers(Storage.__new__(Storage), 5 * each)
    for name in names[5:20]:  # what nobody has open any more is in nobody's way
        made.open(name).close()
    held = [made.open(name) for name in names[:5]]
    with pytest.raises(BusyError, match="indexes of all surfaces that are streamed"):
        made.open(names[5])
    again = made.open(names[0])
    assert again.index is held[0].index
    again.close()
    held.pop().close()
    gc.collect()
    held.append(made.open(names[5]))
    for opened in held:
        opened.close()


def test_a_container_whose_index_takes_too_much_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(containers, "most_for_indexes", lambda: 1000)
    with (
        running_server(tmp_path, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        surface = push(http, encode(hills()))
        assert surface["state"] == "waiting"
        assert "whose index takes at most" in surface["reason"]
        assert kept(tmp_path, "containers") == []
        assert len(kept(tmp_path, "uploads")) == 1


def joined(random: np.random.Generator) -> Surface:
    """Two blocks that touch in scattered points, and have the same scattered holes: long joints, and few parts."""
    x, y = np.meshgrid(np.arange(200.0), np.arange(200.0))
    low, high = (np.stack([x, y, np.full_like(x, z)], axis=2) for z in (0, 1))
    touching, valid = random.random(x.shape) < 0.3, random.random(x.shape) > 0.3
    high[touching] = low[touching]
    return Surface(blocks=[Block(low, mask=valid), Block(high, mask=valid)])


def surfaces() -> dict[str, bytes]:
    """Containers whose indexes are large in different ways, by name."""
    random = np.random.default_rng(4)
    heights, mask = hills(250, 240), random.random((250, 240)) > 0.5
    x, y = np.meshgrid(np.arange(12.0), np.arange(12.0))
    spoiled = heights.copy()
    spoiled[mask] = np.where(random.random(int(mask.sum())) > 0.5, np.nan, np.inf)
    cubes = [Block(np.stack([x + 11 * number, y, x * y], axis=2)) for number in range(30)]
    return {
        "small": encode(hills(9, 8)),
        "heights": encode(heights),
        "noise": encode(random.normal(size=(120, 120))),
        "constant": encode(np.zeros((400, 400), np.float32)),
        "holes": encode(Surface(heights, mask=mask)),
        "holes of a constant": encode(Surface(np.zeros(mask.shape, np.float32), mask=mask)),
        "not finite": encode(spoiled),
        "attributes": encode(Surface(hills(20, 20), attributes={f"a{n}": hills(20, 20, n) for n in range(40)})),
        "blocks": encode(Surface(blocks=cubes)),
        "joints": encode(joined(random)),
        "metadata": encode(Surface(hills(9, 8), metadata={"words": "word " * 10_000})),
    }


def test_what_is_counted_for_an_index_is_what_it_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Storage, "__init__", lambda self: None)
    monkeypatch.setattr(Storage, "container", lambda self, sha256: tmp_path / sha256)
    for name, data in surfaces().items():
        (tmp_path / name).write_bytes(data)
        made = Containers(Storage.__new__(Storage))
        Layout.single.cache_clear()
        Layout.of.cache_clear()
        gc.collect()
        tracemalloc.start()
        try:
            opened = made.open(name)
            for target in (Target(), Target(level=0), Target(order="level"), Target(attributes=())):
                plan(opened.index, target)
            if len(opened.index.header.blocks) == 1:
                plan(opened.index, Target(region=((0, 5), (0, 5))))
            gc.collect()
            taken, most = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        kept, masks = containers.index_memory(opened.file)
        opened.close()
        assert taken <= kept, name
        assert most <= kept + masks + 4 * MAX_BYTES, name
        assert kept <= 8 * taken + 65_536, name
        assert made._taken() == kept


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
