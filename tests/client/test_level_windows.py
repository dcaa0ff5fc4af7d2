"""Windows of coarser levels through both clients and the command, by both transports, over real sockets; resumed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.planning.planner import plan
from lodestream.planning.window_errors import read_window_errors
from lodestream_client import Client
from tests.client import files
from tests.core.surfaces import index_of, terrain
from tests.links import Fault, linked

from .conftest import Run
from .test_parts_of_a_surface import follow

#: Across the seam of the closed axis.
REGION = (60, 140), (1110, 1260)
ROI = "60:140,1110:1260"


@pytest.fixture(scope="module")
def original() -> ls.Surface:
    heights = terrain((520, 1200), 3).astype("f4")
    return ls.Surface(heights, (False, True), attributes={"kind": (heights.astype("i4") % 5).astype("i2")})


@pytest.fixture(scope="module")
def container(original: ls.Surface) -> bytes:
    return ls.encode(original)


@pytest.fixture(scope="module")
def address(server: str, container: bytes) -> str:
    return Client(server).upload(container).url


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


def level_of(container: bytes) -> int:
    return index_of(container).header.levels - 2


def cut(container: bytes, level: int) -> NDArray[Any]:
    """The level's own grid, cut as its definition says."""
    decoder = ls.Decoder()
    decoder.feed(container)
    grid = decoder.points_at(level)
    assert grid.shape == (131, 300), "every fourth row and the last one, every fourth column"
    rows, columns = (range(*span) for span in REGION)
    assert isinstance(grid, np.ndarray)
    return grid[np.ix_([row // 4 for row in rows if row % 4 == 0], [at % 1200 // 4 for at in columns if at % 4 == 0])]


@pytest.mark.parametrize("order", ["quality", "level"])
@pytest.mark.parametrize("transport", ["ws", "http"])
@pytest.mark.long
def test_streams_receive_it_alone(
    address: str, container: bytes, asynchronous: bool, transport: str, order: ls.Order
) -> None:
    level, index = level_of(container), index_of(container)
    target = ls.Target(region=REGION, level=level, order=order)
    chosen = plan(index, target, windows=read_window_errors(index, lambda at, n: container[at : at + n]))
    stream = follow(address, asynchronous, transport, target)
    assert stream.ended == "level"
    view = stream.decoder.view()
    np.testing.assert_array_equal(view.points, cut(container, level))
    assert view.surface().attributes.keys() == {"kind"}
    assert stream.planned == stream.received == chosen.bytes < plan(index, ls.Target(region=REGION)).bytes
    assert (view.rms, view.max_error, view.bound, view.complete) == (chosen.rms, chosen.max_error, True, False)


def test_they_go_on_where_the_link_broke(address: str, container: bytes, asynchronous: bool) -> None:
    level = level_of(container)
    target = ls.Target(region=REGION, level=level)
    with linked(address, lambda number: Fault(cut_down=3000) if number < 2 else Fault()) as link:
        stream = follow(link.url, asynchronous, "ws", target, deadline=20)
        assert link.connections > 1
    assert stream._reception.data_bytes == stream._reception.cached.total, "nothing came twice"
    np.testing.assert_array_equal(stream.decoder.view().points, cut(container, level))


def test_a_file_of_any_web_server(container: bytes, asynchronous: bool, tmp_path: Path) -> None:
    (tmp_path / "a.lode").write_bytes(container)
    level = level_of(container)
    with files.ranged(tmp_path) as server:
        stream = follow(f"{server.url}/a.lode", asynchronous, "http", ls.Target(region=REGION, level=level))
        np.testing.assert_array_equal(stream.decoder.view().points, cut(container, level))
        asked = [told for method, told in server.requests if method == "GET" and told]
        taken = sum(int(last) - int(first) + 1 for first, last in (told[6:].split("-") for told in asked))
    assert taken < len(container) / 4


def test_the_command_decodes_and_pulls_it(run: Run, address: str, container: bytes, tmp_path: Path) -> None:
    level, file = level_of(container), tmp_path / "a.lode"
    file.write_bytes(container)
    wanted = cut(container, level)
    options = "--level", level, "--roi", ROI, "--attributes", "none", "--json"
    code, said, _ = run("decode", file, tmp_path / "a.npy", *options)
    assert code == 0
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), wanted)
    told = json.loads(said)
    assert (told["ended"], told["level"], told["bound"]) == ("level", level, True)
    code, said, _ = run("pull", address, tmp_path / "b.npy", *options)
    assert code == 0
    np.testing.assert_array_equal(np.load(tmp_path / "b.npy"), wanted)
    pulled = json.loads(said)
    assert [pulled[key] for key in ("bytes", "rms", "max")] == [told[key] for key in ("bytes", "rms", "max")]
    code, _, errors = run("pull", address, tmp_path / "c.npy", "--level", 0, "--roi", "1:3,1:3")
    assert code != 0
    assert "expected a region with points of level 0" in errors


def test_a_finer_pull_goes_on_from_a_coarser_one(run: Run, address: str, container: bytes, tmp_path: Path) -> None:
    level = level_of(container)
    sizes = []
    for finest in (level - 1, level, level):
        options = "--level", finest, "--roi", ROI, "--attributes", "none", "--resume", "--json"
        code, said, errors = run("pull", address, tmp_path / "a.npy", *options)
        assert code == 0, errors
        sizes.append(json.loads(said)["wire_bytes"])
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), cut(container, level))
    whole = json.loads(run("pull", address, tmp_path / "b.npy", *options[:-2], "--json")[1])["wire_bytes"]
    assert sizes[2] < sizes[1] < whole
