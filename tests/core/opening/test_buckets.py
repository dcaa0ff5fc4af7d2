"""`lodestream.open` of objects in buckets."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.stores import AbsentError, open_store
from lodestream_client.program import main
from tests.core.surfaces import terrain
from tests.stores.emulators import Emulator, azure, azurite, ministack, s3

__all__ = ["azure", "azurite", "ministack", "s3"]

HEIGHTS = (terrain((900, 1100), 3) * 200).round().astype("i2")


@pytest.mark.parametrize("place", ["s3", "azure"])
@pytest.mark.long
def test_an_object_is_read_in_blocks(
    place: str, request: pytest.FixtureRequest, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    emulator: Emulator = request.getfixturevalue(place)
    address = emulator.address()
    (tmp_path / "a.lode").write_bytes(ls.encode(HEIGHTS))
    open_store(address).put_file("maps/hills.lode", tmp_path / "a.lode")
    with ls.open(f"{address}/maps/hills.lode") as opened:
        assert (opened.source.name, opened.source.size) == ("hills", (tmp_path / "a.lode").stat().st_size)
        assert np.array_equal(opened.window((100, 160), (700, 790)).points, HEIGHTS[100:160, 700:790])
        assert opened.view(rms=20).bytes < 0.6 * opened.source.size
        assert np.array_equal(opened.view().points, HEIGHTS)
        assert pickle.loads(pickle.dumps(opened)).info == opened.info
        capsys.readouterr()
        assert main(["info", "--json", f"{address}/maps/hills.lode"]) == 0
        assert json.loads(capsys.readouterr().out) == opened.info
    with pytest.raises(AbsentError, match=r"there is no none\.lode"):
        ls.open(f"{address}/maps/none.lode")
    (tmp_path / "a.lode").write_bytes(ls.encode(HEIGHTS[::-1]))
    copy, before = pickle.dumps(opened), ls.open(f"{address}/maps/hills.lode")
    open_store(address).put_file("maps/hills.lode", tmp_path / "a.lode")
    with pytest.raises(ls.LodestreamError, match="as it was when it was opened first"):
        pickle.loads(copy)
    with pytest.raises(ls.StreamError):
        before.view()
