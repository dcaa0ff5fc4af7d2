"""Surfaces as files of a folder."""

from __future__ import annotations

from pathlib import Path

import msgpack
import numpy as np
import pytest

from lodestream.encoding.stored_surface import load_surface, save_surface
from lodestream.errors import InputError
from lodestream.scratch import FolderScratch, Room
from lodestream.surface import Block, Surface


def _same(one: Surface, other: Surface) -> None:
    assert one.metadata == other.metadata
    assert len(one.blocks) == len(other.blocks)
    for mine, own in zip(one.blocks, other.blocks, strict=True):
        assert mine.closed == own.closed
        assert mine.points.dtype == own.points.dtype
        assert np.array_equal(mine.points, own.points, equal_nan=mine.points.dtype.kind == "f")
        assert mine.holes == own.holes
        if mine.mask is not None and own.mask is not None:
            assert np.array_equal(mine.mask, own.mask)
        assert list(mine.attributes) == list(own.attributes)
        for name, array in mine.attributes.items():
            assert np.array_equal(array, own.attributes[name])


@pytest.mark.parametrize("holes", [False, True])
def test_a_surface_comes_back(tmp_path: Path, holes: bool) -> None:
    points = np.random.default_rng(1).normal(size=(20, 30, 3)).astype(np.float32)
    mask = np.ones((20, 30), bool)
    mask[3:5, 2:9] = not holes
    attributes = {"speed": np.arange(600).reshape(20, 30), "a/b": np.ones((20, 30, 2), np.float64)}
    block = Block(points, (False, True), mask=mask, attributes=attributes)
    surface = Surface(blocks=[block, block], metadata={"name": "two", "crs": "here"})
    scratch = FolderScratch(tmp_path)
    assert load_surface(scratch) is None
    save_surface(surface, scratch)
    again = load_surface(scratch)
    assert again is not None
    _same(surface, again)


def test_files_of_the_folder_stay(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path)
    heights = scratch.empty("heights", (50, 60), np.int16)
    heights[...] = np.arange(3000).reshape(50, 60)
    save_surface(Surface(heights), scratch)
    assert not list(tmp_path.glob("surface/**/*.npy"))
    again = load_surface(scratch)
    assert again is not None
    assert np.array_equal(again.points, heights)
    save_surface(Surface(heights[:, ::2]), scratch)
    assert len(list(tmp_path.glob("surface/**/*.npy"))) == 1


def test_many_arrays_take_few_files(tmp_path: Path) -> None:
    rng, room = np.random.default_rng(2), Room(lambda: FolderScratch(tmp_path))
    blocks = []
    for number in range(60):
        points = room.empty((4, 5), np.float32) if number % 2 else np.empty((4, 5), np.float32)
        points[...] = rng.normal(size=(4, 5))
        blocks.append(Block(points, attributes={"a": rng.integers(0, 9, (4, 5))}))
    surface = Surface(blocks=blocks)
    save_surface(surface, FolderScratch(tmp_path))
    assert len(list(tmp_path.rglob("*.npy"))) < 24
    again = load_surface(FolderScratch(tmp_path))
    assert again is not None
    _same(surface, again)
    save_surface(again, FolderScratch(tmp_path))  # all of it lies there
    assert len(list(tmp_path.rglob("*.npy"))) < 24
    found = load_surface(FolderScratch(tmp_path))
    assert found is not None
    _same(surface, found)


def _described(place: object, metadata: object = None) -> bytes:
    """A surface of one block, as a file says where its points lie."""
    block = {"arrays": {"points": place}, "closed": [0, 0], "attributes": []}
    described: bytes = msgpack.packb({"blocks": [block], "metadata": {} if metadata is None else metadata})
    return described


@pytest.mark.parametrize(
    "described",
    [
        b"",
        b"\xc1",
        msgpack.packb([]),
        msgpack.packb({"blocks": [], "metadata": {}}),
        msgpack.packb({"blocks": [{}], "metadata": {}}),
        _described(["../x", 0, "float64", [3, 3]]),
        _described(["text", 0, "float64", [3, 3]]),
        _described(["gone", 0, "float64", [3, 3]]),
        _described(["ok", 0, "float64", [3, 3]], 5),
        _described("ok"),
        _described(["ok", 0, "float64", [3, 4]]),
        _described(["ok", 8, "float64", [3, 3]]),
        _described(["ok", -8, "float64", [3, 3]]),
        _described(["ok", 4, "float64", [2, 2]]),
        _described(["ok", 0, "float64", [-3, -3]]),
        _described(["ok", 0, "float64", [2**62, 4]]),
        _described(["ok", 0.0, "float64", [3, 3]]),
        _described(["ok", True, "float64", [3, 3]]),
        _described(["ok", 0, "complex128", [2, 2]]),
        _described(["ok", 0, ["float64"], [3, 3]]),
        _described(["ok", 0, "float64", [[3, 3]]]),
        _described(["ok", 0, "float64", 9]),
        _described(["ok", 0, "float64", [3, 0]]),
        _described(["ok", 0, "bool", [2**60, 0]]),
        _described(["ok", 0, "float64", [2**63] * 100_000]),
        _described(["unfinished", 0, "float64", [3, 3]]),
        _described([["ok"], 0, "float64", [3, 3]]),
        _described(["turned", 0, "float64", [3, 2]]),
    ],
)
def test_what_is_no_surface_is_refused(tmp_path: Path, described: bytes) -> None:
    scratch = FolderScratch(tmp_path / "folder")
    np.save(tmp_path / "x.npy", np.ones((3, 3)))
    scratch.write("text", np.array([["a", "b"], ["c", "d"]]))
    scratch.write("ok", np.ones((3, 3)))
    header = b"{'descr': ("
    whole = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(72)
    (scratch.folder / "unfinished.npy").write_bytes(whole)
    np.save(scratch.folder / "turned.npy", np.asfortranarray(np.ones((3, 2))))
    (scratch.folder / "surface.msgpack").write_bytes(described)
    with pytest.raises(InputError, match="expected"):
        load_surface(scratch)


def test_masks_have_nothing_but_0_and_1(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path)
    save_surface(Surface(np.zeros((4, 5)), mask=np.eye(4, 5) == 0), scratch)
    path = next(tmp_path.rglob("bool-*.npy"))
    data = bytearray(path.read_bytes())
    data[-3] = 7
    path.write_bytes(data)
    with pytest.raises(InputError, match="bytes other than 0 and 1 in a mask"):
        load_surface(scratch)
