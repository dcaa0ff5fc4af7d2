"""Windows across the seam of a closed axis, by the command, both clients over both transports, and xarray."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.planning.planner import plan
from lodestream_client import AsyncClient, Client
from lodestream_client.stream.reconnecting import Transport
from tests.core.surfaces import index_of

from .conftest import Run

SHAPE = (120, 360)
REGION = (10, 20), (350, 370)


@pytest.fixture(scope="module")
def globe() -> ls.Surface:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    noise = np.random.default_rng(5).normal(size=SHAPE)
    heights = np.rint(900 * np.sin(columns * np.pi / 60) * np.cos(rows / 20) + 9 * noise).astype("i2")
    metadata = {"geotransform": [-0.5, 1.0, 0.0, 60.0, 0.0, -1.0]}
    attributes = {"t": (heights / 7).astype("f4")}
    return ls.Surface(heights, (False, True), attributes=attributes, metadata=metadata)


@pytest.fixture(scope="module")
def container(globe: ls.Surface, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("seam") / "globe.lode"
    path.write_bytes(ls.encode(globe))
    return path


@pytest.fixture(scope="module")
def served(server: str, globe: ls.Surface) -> str:
    return Client(server).upload(globe).url


def wrapped(array: Any, region: Any = REGION) -> Any:
    return np.take(np.take(array, range(*region[0]), 0), np.arange(*region[1]), 1, mode="wrap")


def test_the_command_decodes_and_pulls_it(
    run: Run, container: Path, served: str, globe: ls.Surface, tmp_path: Path
) -> None:
    assert run("decode", container, tmp_path / "a.npy", "--roi", "10:20,350:370", "--attributes", "none")[0] == 0
    assert np.array_equal(np.load(tmp_path / "a.npy"), wrapped(globe.points))
    assert run("pull", served, tmp_path / "b.npy", "--roi", "10:20,350:370", "--attributes", "none")[0] == 0
    assert np.array_equal(np.load(tmp_path / "b.npy"), wrapped(globe.points))
    for wrong, reason in (
        ("10:20,350:711", "expected columns within 0:360, or across the seam up to 350:710"),
        ("10:20,360:370", "expected columns within 0:360, at least one, got 360:370"),
        ("110:130,0:9", "expected rows within 0:120, at least one, got 110:130"),
    ):
        code, _, errors = run("decode", container, tmp_path / "c.npy", "--roi", wrong)
        assert code != 0
        assert reason in errors
        assert run("pull", served, tmp_path / "c.npy", "--roi", wrong)[0] != 0


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_streams_receive_it_alone(served: str, globe: ls.Surface, transport: Transport) -> None:
    with Client(served).connect(served, target=ls.Target(region=REGION), transport=transport) as stream:
        views = list(stream)
    assert np.array_equal(views[-1].points, wrapped(globe.points))
    assert stream.received == plan(index_of(ls.encode(globe)), ls.Target(region=REGION)).bytes

    async def receive() -> ls.Surface:
        async with (
            AsyncClient(served) as client,
            client.connect(served, target=ls.Target(region=REGION), transport=transport) as other,
        ):
            async for _ in other:
                pass
            return other.decoder.surface()

    found = asyncio.run(receive())
    assert np.array_equal(found.points, wrapped(globe.points))
    assert np.array_equal(found.attributes["t"], wrapped(globe.attributes["t"]))
    with Client(served).connect(served, transport=transport) as stream:
        stream.focus(REGION)
        views = list(stream)
    assert np.array_equal(views[-1].points, globe.points)
    wrong = ls.Target(region=((0, 9), (350, 711)))
    refused = pytest.raises(ls.OptionError, match="expected columns within")
    with Client(served).connect(served, target=wrong, transport=transport) as stream, refused:
        list(stream)


def test_xarray_opens_it_as_a_dataset(container: Path, served: str, globe: ls.Surface) -> None:
    xarray = pytest.importorskip("xarray")
    for place in (container, served):
        with xarray.open_dataset(place, engine="lode", region=REGION) as data:
            assert data.z.shape == (10, 20)
            assert np.array_equal(data.z, wrapped(globe.points))
            assert np.array_equal(data.t[2:5, 8:14], wrapped(globe.attributes["t"])[2:5, 8:14])
            assert int(data.z[3, 15]) == wrapped(globe.points)[3, 15]
            assert np.array_equal(data.z[::3, ::-4], wrapped(globe.points)[::3, ::-4])
            # Longitudes go on beyond the seam.
            assert data.x.values.tolist() == list(range(350, 370))
            assert data.y.values.tolist() == [59.5 - row for row in range(10, 20)]
    with pytest.raises(ls.OptionError, match="points of level 1"):
        xarray.open_dataset(container, engine="lode", region=REGION, level=1)
    with pytest.raises(ls.OptionError, match="expected columns within"):
        xarray.open_dataset(container, engine="lode", region=((0, 9), (350, 711)))


def test_a_window_of_holes_across_the_seam(globe: ls.Surface, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    points = globe.points.astype("f4")
    points[:, 340:] = points[:, :30] = np.nan
    path = tmp_path / "holes.lode"
    path.write_bytes(ls.encode(ls.Surface(points, (False, True))))
    with xarray.open_dataset(path, engine="lode", region=((0, 40), (330, 400))) as data:
        assert np.array_equal(data.z, wrapped(points, ((0, 40), (330, 400))), equal_nan=True)
        assert np.isnan(data.z[3:6, 28:33]).all()
