"""Who only saves the bytes of a stream decodes nothing; who asks for the end gets it, or is told that it is damaged."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.decoding import segments
from lodestream_client import AsyncClient, Client
from tests.client import files
from tests.core.decoding.test_damaged_residual import with_chunk
from tests.core.surfaces import index_of, terrain

from ..conftest import Run


@pytest.fixture(scope="module")
def container() -> bytes:
    data = ls.encode(terrain((70, 60)))
    assert index_of(data).residual is not None
    return data


@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
@pytest.mark.parametrize("transport", ["ws", "http"])
def test_a_stream_whose_bytes_are_saved_decodes_nothing(
    server: str, container: bytes, asynchronous: bool, transport: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = Client(server).upload(container).url
    calls: Counter[str] = Counter()
    for name in ("rounds_of", "values_of", "restore"):
        original = getattr(segments, name)

        def called(*args: Any, name: str = name, original: Any = original, **options: Any) -> Any:
            calls[name] += 1
            return original(*args, **options)

        monkeypatch.setattr(segments, name, called)
    saved = bytearray(len(container))

    def save(offset: int, data: bytes) -> None:
        saved[offset : offset + len(data)] = data

    async def receive() -> ls.Decoder:
        async with AsyncClient(url) as client, client.connect(url, transport=transport, sink=save) as stream:
            async for _ in stream:
                pass
        assert stream.ended == "complete"
        assert not calls
        # In a thread, where it holds nobody up.
        assert (await asyncio.to_thread(stream.decoder.view)).complete
        return stream.decoder

    if asynchronous:
        decoder = asyncio.run(receive())
    else:
        with Client(url).connect(url, transport=transport, sink=save) as stream:
            assert [view.complete for view in stream][-1]
        assert stream.ended == "complete"
        assert not calls
        decoder = stream.decoder
    end = index_of(container).surface_end
    assert saved[:end] == container[:end]
    np.testing.assert_array_equal(decoder.surface().points, terrain((70, 60)))
    assert calls["restore"] == 1


def test_a_damaged_end_is_told_and_nothing_is_written(run: Run, container: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.lode").write_bytes(with_chunk(container, random.Random(0), 255))
    before = ls.Decoder().feed(container)[-2]
    with files.ranged(tmp_path) as web:
        with Client(f"{web.url}/a.lode").connect(f"{web.url}/a.lode", transport="http") as stream:
            last = list(stream)[-1]
        with pytest.raises(ls.CorruptStreamError):
            _ = last.points
        with pytest.raises(ls.CorruptStreamError):
            stream.decoder.view()
        np.testing.assert_array_equal(stream.decoder.view().points, before.points)
        code, _, errors = run("pull", f"{web.url}/a.lode", tmp_path / "a.npy", "--transport", "http")
        assert code != 0
        assert "expected" in errors
        assert not (tmp_path / "a.npy").exists()
    for order in ("quality", "level"):
        code, _, errors = run("decode", tmp_path / "a.lode", tmp_path / "b.npy", "--order", order)
        assert code != 0
        assert not (tmp_path / "b.npy").exists()
        code, _, errors = run("decode", tmp_path / "a.lode", tmp_path / "c.npy", "--partial", "--order", order)
        assert code == 0, errors
        assert "the last complete layer before that is written" in errors
        np.testing.assert_array_equal(np.load(tmp_path / "c.npy"), before.points)
