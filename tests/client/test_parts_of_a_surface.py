"""A window, and some attributes only, through both clients, by both transports, over real sockets."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import read_index
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.planning.window_errors import read_window_errors
from lodestream_client import AsyncClient, Client
from lodestream_client.stream.stream import BaseStream
from tests.links import Fault, linked

ROWS, COLUMNS = 260, 230
WINDOW = ((31, 90), (120, 203))


def cloud() -> bytes:
    """An organised cloud in whole metres, with two attributes."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    heights = np.rint(400 * np.sin(x / 31) * np.cos(y / 23) + 30 * np.sin(x * y / 70))
    fields = {"x": 10 * x + y % 3, "y": 10 * y + x % 2, "z": heights, "speed": np.sin(x / 7) + y / 90}
    table = np.empty((ROWS, COLUMNS), [*((name, "<f4") for name in fields), ("kind", "u1")])
    for name, values in fields.items():
        table[name] = values
    table["kind"] = x % 5 + y % 3
    head = (
        "VERSION 0.7\nFIELDS x y z speed kind\nSIZE 4 4 4 4 1\nTYPE F F F F U\nCOUNT 1 1 1 1 1\n"
        f"WIDTH {COLUMNS}\nHEIGHT {ROWS}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {ROWS * COLUMNS}\nDATA binary\n"
    )
    return head.encode() + table.tobytes()


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> ls.Surface:
    path = tmp_path_factory.mktemp("cloud") / "cloud.pcd"
    path.write_bytes(cloud())
    return ls.read(path)


@pytest.fixture(scope="module")
def address(server: str) -> str:
    return Client(server).upload(cloud()).url


@pytest.fixture(scope="module")
def container(address: str) -> bytes:
    return Client(address).fetch_range(address, 0, int(Client(address).get(address).details["bytes"]))


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture(params=["ws", "http"])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def follow(url: str, asynchronous: bool, transport: Any, target: ls.Target, **options: Any) -> BaseStream:
    if not asynchronous:
        with Client(url).connect(url, target=target, transport=transport, **options) as stream:
            for _ in stream:
                pass
            return stream

    async def loop() -> BaseStream:
        async with (
            AsyncClient(url) as client,
            client.connect(url, target=target, transport=transport, **options) as stream,
        ):
            async for _ in stream:
                pass
            return stream

    return asyncio.run(loop())


def cut(array: NDArray[Any], region: Any) -> NDArray[Any]:
    return array if region is None else array[slice(*region[0]), slice(*region[1])]


@pytest.mark.parametrize("order", ["quality", "level"])
@pytest.mark.parametrize(
    ("region", "attributes"),
    [(WINDOW, None), (None, ("kind",)), (None, ()), (WINDOW, ("speed",)), (WINDOW, ())],
    ids=["window", "one attribute", "no attribute", "window of one", "window of none"],
)
@pytest.mark.long
def test_it_is_what_cutting_the_whole_gives(
    address: str,
    container: bytes,
    given: ls.Surface,
    asynchronous: bool,
    transport: str,
    order: Any,
    region: Any,
    attributes: Any,
) -> None:
    target = ls.Target(order=order, region=region, attributes=attributes)
    stream = follow(address, asynchronous, transport, target)
    assert stream.ended == "complete"
    found = stream.decoder.surface()
    assert np.array_equal(found.points, cut(given.points, region))
    assert tuple(found.attributes) == (tuple(given.attributes) if attributes is None else attributes)
    for name, values in found.attributes.items():
        assert values.dtype == given.attributes[name].dtype
        assert np.array_equal(values, cut(given.attributes[name], region))
    assert stream.planned == stream.received == stream.decoder.bytes
    everything = ls.Decoder()
    everything.feed(container)
    assert stream.decoder.bytes < everything.bytes, "less than the whole was asked for"


@pytest.mark.parametrize(
    ("limit", "ended"),
    [
        ({"max_bytes": 6000}, "bytes"),
        ({"region": WINDOW, "until_rms": ls.Tolerance(1e-2, True)}, "rms"),
        ({"region": WINDOW, "until_max": ls.Tolerance(3e-2, True), "attributes": ()}, "max"),
        ({"region": WINDOW, "until_max": ls.Tolerance(0.1, True), "order": "level"}, "max"),
        ({"until_rms": ls.Tolerance(2e-2, True), "attributes": ("kind",)}, "rms"),
        ({"level": 4, "attributes": ("speed",)}, "level"),
    ],
    ids=repr,
)
def test_limits_of_a_part(
    address: str,
    container: bytes,
    given: ls.Surface,
    asynchronous: bool,
    transport: str,
    limit: dict[str, Any],
    ended: str,
) -> None:
    chosen = limit if "attributes" in limit else {**limit, "region": WINDOW}
    target = ls.Target(**chosen)
    stream = follow(address, asynchronous, transport, target)
    assert stream.ended == ended
    # A reader with the whole file at hand, given what the plan says and nothing else.
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    windows = read_window_errors(index, lambda offset, length: container[offset : offset + length])
    assert windows is not None
    expected = plan(index, target, windows=windows)
    told = [(view.bytes, view.rms, view.max_error) for view in stream.decoder.layers]
    assert [(mark.bytes, mark.rms, mark.max_error) for mark in expected.marks][-1] == told[-1]
    if target.region is not None:
        found, wanted = stream.decoder.surface().points, cut(given.points, WINDOW)
        squares = ((found.astype(float) - wanted) ** 2).sum(axis=2)
        last = stream.decoder.layers[-1]
        assert last.bound
        assert np.sqrt(squares.mean()) <= last.rms
        assert np.sqrt(squares.max()) <= last.max_error
    assert (stream.decoder.bytes, stream.planned) == (expected.bytes, expected.bytes)
    decoder = ls.Decoder(selection_of(target))
    for place in expected.slices:
        decoder.feed_at(place.offset, container[place.offset : place.end])
    assert np.array_equal(stream.decoder.surface().points, decoder.surface().points)
    assert tuple(stream.decoder.surface().attributes) == tuple(decoder.surface().attributes)


def test_a_part_goes_on_where_a_connection_broke(
    address: str, given: ls.Surface, asynchronous: bool, transport: str
) -> None:
    target = ls.Target(region=WINDOW, attributes=("speed",))
    with linked(address, lambda number: Fault(cut_down=9000) if number < 2 else Fault()) as link:
        stream = follow(link.url, asynchronous, transport, target, window=4000)
    assert np.array_equal(stream.decoder.surface().points, cut(given.points, WINDOW))
    assert np.array_equal(stream.decoder.surface().attributes["speed"], cut(given.attributes["speed"], WINDOW))
    assert stream.data_bytes == stream._reception.cached.total, "nothing came twice"
    assert link.connections > 1


@pytest.mark.parametrize(
    ("target", "words"),
    [
        (ls.Target(region=((0, ROWS + 1), (0, 5))), f"rows within 0:{ROWS}"),
        (ls.Target(region=((0, 5), (COLUMNS, COLUMNS + 1))), f"columns within 0:{COLUMNS}"),
        (ls.Target(attributes=("speed", "colour")), "among speed, kind, got 'colour'"),
    ],
    ids=["rows", "columns", "names"],
)
def test_what_the_surface_does_not_have_is_refused(
    address: str, asynchronous: bool, transport: str, target: ls.Target, words: str
) -> None:
    with pytest.raises(ls.OptionError, match=words):
        follow(address, asynchronous, transport, target)
