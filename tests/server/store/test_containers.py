"""Open containers share what is known of them."""

from __future__ import annotations

import gc
import hashlib
import threading
import time
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from lodestream import Block, Surface, Target, encode
from lodestream.container import ByteRange, Index
from lodestream.container.metadata import MAX_BYTES
from lodestream.errors import CorruptStreamError, NotFoundError
from lodestream.grid.layout import Layout
from lodestream.planning.planner import plan
from lodestream.stores import Blob, Folder, Store, open_store
from lodestream_server import running_server
from lodestream_server.problems import BusyError
from lodestream_server.store import containers
from lodestream_server.store.container_cache import ContainerCache
from lodestream_server.store.containers import Containers
from lodestream_server.store.index import Surface as Known
from lodestream_server.store.surfaces import Surfaces
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, kept, push

from .world import upload


def stocked(folder: Path, containers_: dict[str, bytes], store: Store | None = None) -> Surfaces:
    """Surfaces with these containers, by their names."""
    surfaces = Surfaces(store or Folder(folder / "data"), folder / "index.sqlite")
    surfaces.sync()
    for number, (name, data) in enumerate(containers_.items()):
        manifest, files = upload(folder, number)
        surfaces.accept(manifest, files)
        path = folder / "built"
        path.write_bytes(data)
        surfaces.built(manifest.id, path, name, {"levels": []})
    return surfaces


NAMES = [f"{number:064x}" for number in range(3 * containers._INDEXES_KEPT)]


@pytest.fixture
def surfaces(tmp_path: Path) -> Iterator[Surfaces]:
    """Of more containers than indexes are kept of."""
    data = encode(hills(9, 8))
    found = stocked(tmp_path, dict.fromkeys(NAMES, data))
    yield found
    found.close()


def test_an_index_is_shared_while_a_container_is_open(surfaces: Surfaces) -> None:
    made = Containers(surfaces)
    first = [made.open(name) for name in NAMES]
    again = [made.open(name) for name in NAMES]
    assert [one.index is other.index for one, other in zip(first, again, strict=True)] == [True] * len(NAMES)
    for opened in first:
        opened.close()
    del first, opened
    gc.collect()
    third = [made.open(name) for name in NAMES]
    assert all(one.index is other.index for one, other in zip(again, third, strict=True))
    for opened in (*again, *third):
        opened.close()


def test_only_a_container_whose_index_is_in_memory_opens_at_once(surfaces: Surfaces) -> None:
    made = Containers(surfaces)
    assert made.open_known(NAMES[0], "me") is None
    first = made.open(NAMES[0], "me")
    again = made.open_known(NAMES[0], "me")
    assert again is not None
    assert again.index is first.index
    for opened in (first, again):
        opened.close()
    assert made._open == {}
    surfaces.store.delete([f"containers/{NAMES[0]}.lode"])
    lost: list[Known] = []
    made = Containers(surfaces, lost=lost.extend)
    with pytest.raises(BusyError, match="a moment ago"):
        made.open(NAMES[0])
    assert [surface.id for surface in lost] == [f"{0:020x}"], "it is built again"
    with pytest.raises(BusyError, match="is built again"):
        made.open(NAMES[0])
    with pytest.raises(NotFoundError):
        made.open("f" * 64)


def test_no_more_indexes_are_kept_than_are_worth_it(surfaces: Surfaces) -> None:
    made = Containers(surfaces)
    before = _indexes()  # which stay, whoever else lets them go meanwhile
    for name in NAMES:
        made.open(name).close()
    assert len(_indexes()) - len(before) == containers._INDEXES_KEPT


def test_nor_more_than_so_many_bytes_of_them(surfaces: Surfaces, monkeypatch: pytest.MonkeyPatch) -> None:
    made, before = Containers(surfaces), _indexes()
    with made.open(NAMES[0]).blob as blob:
        each = sum(containers.index_memory(blob.read, blob.size))
    assert each > 1000
    monkeypatch.setattr(containers, "_BYTES_KEPT", 3 * each + 1)
    for name in NAMES:
        made.open(name).close()
    assert len(_indexes()) - len(before) == 3


def test_those_that_are_open_have_room_for_so_many_bytes_of_indexes(surfaces: Surfaces) -> None:
    with Containers(surfaces).open(NAMES[0]).blob as blob:
        each = sum(containers.index_memory(blob.read, blob.size))
    made = Containers(surfaces, 5 * each)
    for name in NAMES[5:20]:  # what nobody has open any more is in nobody's way
        made.open(name).close()
    held = [made.open(name) for name in NAMES[:5]]
    with pytest.raises(BusyError, match="indexes of streamed surfaces"):
        made.open(NAMES[5])
    again = made.open(NAMES[0])
    assert again.index is held[0].index
    again.close()
    held.pop().close()
    gc.collect()
    held.append(made.open(NAMES[5]))
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


def shapes() -> dict[str, bytes]:
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


@pytest.mark.long
def test_what_is_counted_for_an_index_is_what_it_takes(tmp_path: Path) -> None:
    made_of = shapes()
    surfaces = stocked(tmp_path, {f"{number:064x}": data for number, data in enumerate(made_of.values())})
    for number, name in enumerate(made_of):
        made = Containers(surfaces)
        Layout.single.cache_clear()
        Layout.of.cache_clear()
        gc.collect()
        tracemalloc.start()
        try:
            opened = made.open(f"{number:064x}")
            for target in (Target(), Target(level=0), Target(order="level"), Target(attributes=())):
                plan(opened.index, target)
            if len(opened.index.header.blocks) == 1:
                plan(opened.index, Target(region=((0, 5), (0, 5))))
            gc.collect()
            taken, most = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        kept, masks = containers.index_memory(opened.blob.read, opened.blob.size)
        opened.close()
        assert taken <= kept, name
        assert most <= kept + masks + 4 * MAX_BYTES, name
        assert kept <= 8 * taken + 65_536, name
        assert made._taken() == kept


def _indexes() -> list[Any]:
    gc.collect()
    return [item for item in gc.get_objects() if issubclass(type(item), Index)]  # `isinstance` asks weak proxies


def test_of_many_who_open_a_container_at_once_one_reads_its_index(
    surfaces: Surfaces, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, read = Containers(surfaces), list[int]()
    together, right = threading.Barrier(8), containers._read_index

    def counted(blob: Blob) -> Index:
        read.append(1)
        return right(blob)

    monkeypatch.setattr(containers, "_read_index", counted)

    def open_one(_: int) -> object:
        together.wait()
        opened = made.open(NAMES[0])
        opened.close()
        return opened.index

    with ThreadPoolExecutor(8) as pool:
        indexes = list(pool.map(open_one, range(8)))
    assert len(set(map(id, indexes))) == 1
    assert len(read) == 1


def test_many_streams_of_a_bucket_share_blocks_and_then_a_file(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import obstore

    data = encode(hills(600, 700))
    name = hashlib.sha256(data).hexdigest()
    surfaces = stocked(tmp_path, {name: data}, open_store(memory))
    asked: list[int] = []
    get_range = obstore.get_range

    def counted(*given: Any, **named: Any) -> Any:
        asked.append(named["length"])
        time.sleep(0.005)
        return get_range(*given, **named)

    monkeypatch.setattr(obstore, "get_range", counted)
    cache = ContainerCache(tmp_path / "cache", 1 << 30, lambda: 1 << 40, surfaces.store)
    made = Containers(surfaces, cache=cache)

    def stream(_: int) -> bytes:
        opened = made.open(name)
        sent = []
        for place in plan(opened.index).ranges:
            for offset in range(place.offset, place.end, 16384):
                piece = ByteRange(offset, min(16384, place.end - offset))
                sent.append(opened.read_at_once(piece) or opened.read(piece))
        opened.close()
        return b"".join(sent)

    with ThreadPoolExecutor(50) as threads:
        first, *others = threads.map(stream, range(50))
    assert others == [first] * 49
    assert first in data
    blocks = -(-len(data) // (256 << 10))
    assert len(asked) <= blocks + len(data) / (2 << 20) + 1, "each block once, and the whole for the file"
    eventually(lambda: (tmp_path / "cache").exists() and not cache._wanted, "the file to be there")
    asked.clear()
    with made.blob(name) as blob:
        assert blob.path is not None
    assert stream(0) == first
    with made.local(name) as path:
        assert path == blob.path
        assert path.read_bytes() == data
    assert asked == []
    made.tell_damage(name, CorruptStreamError("expected another byte", 5))
    with made.local(name) as path:
        assert path != blob.path, "a file that may be damaged is fetched again"
        assert path.read_bytes() == data
    made.close()
    surfaces.store.delete([f"containers/{name}.lode"])
    anew = Containers(surfaces, cache=ContainerCache(tmp_path / "anew", 1 << 30, lambda: 1 << 40, open_store(memory)))
    with pytest.raises(BusyError, match="a moment ago"), anew.local(name):
        pass
    surfaces.close()
