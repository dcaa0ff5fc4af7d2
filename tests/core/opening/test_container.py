"""`lodestream.open`: what its calls return is what a decoder does, and they read no more than they need."""

from __future__ import annotations

import pickle
import subprocess
import sys
import threading
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.decoding.view import View
from lodestream.planning.planner import plan
from tests.core.surfaces import terrain, torus

from .counting import Counting

HEIGHTS = (terrain((300, 400), 3) * 8).round().astype("i2")
MASK = np.ones(HEIGHTS.shape, bool)
MASK[100:140, 200:260] = False
KIND = np.where(MASK, np.abs(HEIGHTS % 7), 0).astype("u1")


@cache
def data() -> bytes:
    surface = ls.Surface(HEIGHTS, (False, True), mask=MASK, attributes={"kind": KIND}, metadata={"name": "hill"})
    return ls.encode(surface)


@cache
def of_blocks() -> bytes:
    return ls.encode(ls.Surface(blocks=[ls.Block(torus(40, 60)), ls.Block(torus(30, 20) + 9)]))


@cache
def states() -> list[View]:
    return ls.Decoder().feed(data())


def same(one: ls.Surface, other: ls.Surface) -> bool:
    return one.metadata == other.metadata and all(
        np.array_equal(a.points, b.points)
        and (a.mask is None) == (b.mask is None)
        and (a.mask is None or b.mask is None or np.array_equal(a.mask, b.mask))
        and a.closed == b.closed
        and a.attributes.keys() == b.attributes.keys()
        and all(np.array_equal(a.attributes[name], b.attributes[name]) for name in a.attributes)
        for a, b in zip(one.blocks, other.blocks, strict=True)
    )


def counted(container: bytes | None = None) -> tuple[ls.Container, Counting]:
    source = Counting(data() if container is None else container)
    opened = ls.Container(source)
    assert source.ranges.total < source.size / 3, "header, index and metadata"
    source.forget()
    return opened, source


@pytest.mark.parametrize("limit", [{"rms": 3}, {"max_error": "1%"}, {"bytes": 9000}, {"rms": {"kind": 0.5}}])
def test_a_limit_reads_the_file_up_to_the_layer_that_meets_it(limit: dict[str, Any]) -> None:
    opened, source = counted()
    view = opened.view(**limit)
    wanted = states()[view.number]
    assert (view.bytes, view.rms, view.max_error, view.complete) == (
        *(wanted.bytes, wanted.rms, wanted.max_error),
        False,
    )
    assert source.ranges.total < view.bytes, "the header was read before"
    assert source.taken == source.ranges.total, "nothing twice"
    assert same(view.surface(), wanted.surface(metadata={"name": "hill"}))
    worse = states()[view.number - 1]
    if "rms" in limit and limit["rms"] == 3:
        assert view.rms <= 3 < worse.rms
    if "bytes" in limit:
        assert view.bytes <= 9000 < states()[view.number + 1].bytes


def test_a_level_reads_its_slices() -> None:
    opened, source = counted()
    level = opened.header.levels - 2
    view = opened.view(level=level)
    assert source.ranges.total < opened.info["levels"][level]["bytes"] < source.size / 2
    assert same(view.surface(level), states()[-1].surface(level))
    assert view.rms == opened.info["levels"][level]["rms"]


def test_without_a_limit_all_is_read_once_and_is_exact() -> None:
    opened, source = counted()
    view = opened.view()
    assert view.complete
    assert view.rms == 0
    assert same(view.surface(), ls.decode(data()))
    assert source.taken == source.ranges.total < source.size


@pytest.mark.parametrize("level", [None, 8, 6])
@pytest.mark.parametrize(("rows", "columns"), [((40, 90), (10, 80)), ((90, 150), (380, 420)), ((0, 300), (0, 400))])
def test_a_window_reads_its_slices(rows: tuple[int, int], columns: tuple[int, int], level: int | None) -> None:
    opened, source = counted()
    window = opened.window(rows, columns, level)
    assert same(window, states()[-1].window((rows, columns), level))
    target = ls.Target(region=(rows, columns), level=level)
    planned = sum(place.length for place in plan(opened.index, target).ranges)
    assert planned - 512 <= source.taken <= planned, "the slices without the header"
    if rows != (0, 300):
        assert source.taken < 0.8 * source.size
    source.forget()
    alone = opened.window(rows, columns, level, attributes=())
    assert alone.attributes == {}
    assert np.array_equal(alone.points, window.points)
    assert source.taken < planned


def test_iteration_reads_a_layer_at_a_time() -> None:
    opened, source = counted()
    seen = []
    for view, wanted in zip(opened, states(), strict=True):
        assert (view.number, view.bytes, view.rms, view.complete) == (
            *(wanted.number, wanted.bytes, wanted.rms),
            wanted.complete,
        )
        assert source.ranges.total <= view.bytes
        seen.append(view)
    assert same(seen[-1].surface(), ls.decode(data()))
    assert same(seen[2].surface(2), states()[2].surface(2, {"name": "hill"}))


def test_views_up_to_a_target_and_in_another_order() -> None:
    opened, source = counted()
    *_, last = opened.views(ls.Target(until_rms=3))
    assert last.bytes == opened.view(rms=3).bytes
    target = ls.Target(region=((0, 300), (0, 250)), until_rms=20)
    window = opened.view_at(target)
    assert window.bound
    assert window.rms <= 20
    by_level = list(opened.views(ls.Target(order="level")))
    assert sorted({view.level for view in by_level}) == list(range(opened.header.levels + 1))
    assert same(by_level[-1].surface(), ls.decode(data()))
    source.forget()
    with pytest.raises(ls.OptionError, match="level"):
        opened.views(ls.Target(level=99))
    assert source.reads == 0


def test_the_description_is_that_of_the_command() -> None:
    opened, source = counted()
    info = opened.info
    assert info["shape"] == [300, 400]
    assert info["metadata"] == {"name": "hill"}
    assert info["layers"][-1]["bytes"] == states()[len(info["layers"]) - 1].bytes
    assert source.reads == 0
    assert repr(opened) == f"Container('memory', 300 x 400 int16, levels 0 to 9, {len(data())} bytes)"
    assert repr(ls.open(of_blocks())).startswith("Container('memory', 2 blocks float32, ")


def test_a_notebook_shows_it_from_a_coarse_level() -> None:
    pytest.importorskip("matplotlib")
    opened, source = counted()
    page = opened._repr_html_()
    assert "hill" in page
    assert "data:image/png" in page
    assert source.taken < source.size


def test_a_surface_of_several_blocks_has_views_and_no_windows() -> None:
    opened, _ = counted(of_blocks())
    assert same(opened.view().surface(), ls.decode(of_blocks()))
    assert [view.bytes for view in opened] == [view.bytes for view in ls.Decoder().feed(of_blocks())]
    with pytest.raises(ls.OptionError, match="expected a surface of one block for a region, got 2 blocks"):
        opened.window((0, 9), (0, 9))


def test_xarray_has_it_lazily() -> None:
    xr = pytest.importorskip("xarray")
    opened, source = counted()
    found = opened.to_xarray()
    wanted: Any = ls.decode(data()).to_xarray()
    assert source.reads == 0
    xr.testing.assert_equal(found.z[200:260, 100:180], wanted.z[200:260, 100:180])
    assert 0 < source.taken < source.size / 2
    copy = pickle.loads(pickle.dumps(found))
    xr.testing.assert_equal(copy.kind[:9, :9], wanted.kind[:9, :9])
    tree: Any = ls.open(of_blocks()).to_xarray()
    assert np.array_equal(tree["block_1"]["z"].values, torus(30, 20)[..., 2] + 9)


def test_files_paths_and_bytes_are_the_same_container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.lode").write_bytes(data())
    monkeypatch.chdir(tmp_path)
    for source in ("a.lode", tmp_path / "a.lode", data(), bytearray(data()), memoryview(data())):
        with ls.open(source) as opened:
            assert same(opened.window((0, 9), (0, 9)), states()[-1].window(((0, 9), (0, 9))))
    assert ls.open("a.lode").source.place == str(tmp_path / "a.lode")
    monkeypatch.chdir("/")
    again = pickle.loads(pickle.dumps(ls.open(tmp_path / "a.lode")))
    assert again.info == ls.open(data()).info


def test_threads_share_one(tmp_path: Path) -> None:
    (tmp_path / "a.lode").write_bytes(data())
    opened, found = ls.open(tmp_path / "a.lode"), {}

    def take(number: int) -> None:
        rows = (number * 20, number * 20 + 30)
        found[number] = np.array_equal(opened.window(rows, (0, 200)).attributes["kind"], KIND[slice(*rows), :200])

    threads = [threading.Thread(target=take, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == dict.fromkeys(range(8), True)


def test_a_closed_container_reads_nothing_and_views_stay() -> None:
    with ls.open(data()) as opened:
        view = opened.view(rms=3)
    assert view.points.shape == HEIGHTS.shape
    assert opened.info["shape"] == [300, 400]
    with pytest.raises(ls.InputError, match="expected an open container, got memory, which was closed"):
        opened.view(rms=3)


def test_a_file_that_changes_is_noticed(tmp_path: Path) -> None:
    file = tmp_path / "a.lode"
    file.write_bytes(data())
    opened, copy = ls.open(file), pickle.dumps(ls.open(file))
    views = iter(opened)
    next(views)
    (tmp_path / "b.lode").write_bytes(ls.encode(HEIGHTS))
    (tmp_path / "b.lode").replace(file)
    for call in (opened.view, lambda: opened.window((0, 9), (0, 9)), lambda: list(views)):
        with pytest.raises(ls.LodestreamError, match="as it was when this began") as changed:
            call()
        assert changed.value.__notes__ == [f"in {file}"]
    with pytest.raises(ls.LodestreamError, match="as it was when it was opened first"):
        pickle.loads(copy)


def test_damage_is_found_where_it_is_read(tmp_path: Path) -> None:
    damaged = bytearray(data())
    middle = states()[4].bytes - 3
    damaged[middle] ^= 255
    opened = ls.open(damaged)
    assert opened.view(rms=states()[2].rms).bytes == states()[2].bytes
    with pytest.raises(ls.CorruptStreamError):
        opened.view()
    views = iter(opened)
    assert [next(views).number for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ls.CorruptStreamError) as found:
        list(views)
    assert found.value.__notes__ == ["in memory"]
    file = tmp_path / "a.lode"
    for cut in (0, 5, 100, len(data()) // 2, len(data()) - 1):
        file.write_bytes(data()[:cut])
        with pytest.raises(ls.StreamError) as short:
            ls.open(file)
        assert short.value.__notes__[0] == f"in {file}"


@pytest.mark.parametrize(
    ("source", "options", "error", "words"),
    [
        (3, {}, ls.InputError, "expected a file, or an address .* or the bytes of a container, got int"),
        (HEIGHTS, {}, ls.InputError, "got ndarray"),
        (b"something else entirely", {}, ls.CorruptStreamError, "container"),
        ("ftp://host/a.lode", {}, ls.InputError, "got one of ftp://"),
        ("s3:/maps/a.lode", {}, ls.InputError, "a slash is missing after s3:, .* put ./ before a folder or file"),
        ("s3://bucket", {}, ls.InputError, "such as s3://bucket/prefix/NAME.lode, got that of a whole bucket"),
        ("s3://bucket/a/", {}, ls.InputError, "got that of a whole bucket"),
        ("az://box", {}, ls.InputError, "got that of a whole bucket"),
        ("a.lode", {"token": "t"}, ls.OptionError, "expected a URL, to whose server the token belongs, got a.lode"),
        ("s3://b/a.lode", {"token": "t"}, ls.OptionError, "whose credentials come from the environment"),
        ("none.lode", {}, FileNotFoundError, "none.lode"),
        (".", {}, IsADirectoryError, "directory"),
    ],
)
def test_what_cannot_be_opened_is_refused(source: Any, options: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        ls.open(source, **options)


def test_what_cannot_be_had_of_it_is_refused() -> None:
    opened = ls.open(data())
    for wrong in ({"level": 99}, {"level": 1, "rms": 2}, {"rms": "much"}, {"bytes": 3}, {"attributes": "snow"}):
        with pytest.raises(ls.OptionError):
            opened.view(**wrong)
    for read in (opened.view_at, opened.views):
        with pytest.raises(ls.OptionError, match=r"a target such as lodestream.Target\(until_rms=5\), got '0'"):
            read(0)  # type: ignore[arg-type]
    assert opened.view(bytes="20kB").bytes == opened.view(bytes=20_000).bytes
    with pytest.raises(ls.OptionError, match="a number of bytes such as 20000, 20kB or 1MiB, got 'few'"):
        opened.view(bytes="few")
    with pytest.raises(ls.OptionError, match="rows within 0:300"):
        opened.window((290, 310), (0, 9))
    with pytest.raises(ls.TooLargeError):
        ls.open(data(), max_vertices=1000).view()
    with pytest.raises(ls.CorruptStreamError, match="begins with 'a text': lodestream encode makes a container of"):
        ls.open(b"a text")
    with pytest.raises(ls.CorruptStreamError, match=r"begins with the bytes 49 49 2a 00 .*: lodestream encode makes"):
        ls.open(b"II*\0" + bytes(100))


def test_addresses_that_nothing_installed_reads_say_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: ())
    with pytest.raises(ls.UnavailableError, match=r"not installed, or .*: install lodestream with pip, again"):
        ls.open("https://host/a.lode")


@pytest.mark.parametrize("use", ["", "; lodestream.open(sys.argv[1]).window((0, 9), (0, 9))"])
def test_neither_the_package_nor_a_file_needs_anything_of_a_network(use: str, tmp_path: Path) -> None:
    (tmp_path / "a.lode").write_bytes(data())
    script = f"import sys, lodestream{use}; print({{'httpx', 'asyncio', 'obstore', 'xarray'}} & set(sys.modules))"
    command = [sys.executable, "-c", script, str(tmp_path / "a.lode")]
    environment = {"PYTHONPATH": str(Path(ls.__file__).parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "set()\n"
