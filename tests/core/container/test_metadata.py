"""Metadata have a bound: readers drop the largest entries beyond it and say so, an encoder refuses them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from lodestream import formats
from lodestream.container import read_index
from lodestream.container.metadata import MAX_BYTES, check, fitted, packed, with_notes
from lodestream.container.sections import parse_metadata
from lodestream.container.shape import parse_extras
from lodestream.coordinates.height_fields import coordinates
from lodestream.decoding.decoder import Decoder, decode
from lodestream.encoding.encode import encode
from lodestream.errors import FormatWarning, InputError
from lodestream.surface import Surface
from tests.reference.fields import unpack_map

HEIGHTS = np.add.outer(np.arange(6.0), np.arange(5.0))


def test_an_encoder_takes_what_fits_and_refuses_a_byte_more() -> None:
    empty = len(packed({"a": "", "values_sha256": "0" * 64})) + 2  # a long text needs three bytes for its length
    most = {"a": "x" * (MAX_BYTES - empty)}
    container = encode(Surface(HEIGHTS, metadata=most))
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    assert len(packed({**most, "values_sha256": index.digest})) == MAX_BYTES
    assert decode(container).metadata["a"] == most["a"]
    more = {"a": most["a"] + "x", "unit": "m"}
    expected = r"metadata of at most 65,536 bytes, got 65,544, of which 65,4\d\d are 'a'"
    for kwargs in ({}, {"precision": 0.1}, {"rms": 0.1}):
        with pytest.raises(InputError, match=expected):
            encode(Surface(HEIGHTS, metadata=more), **kwargs)  # type: ignore[call-overload]


def test_what_messagepack_cannot_hold_is_refused() -> None:
    for value in (object(), 2**70, 1j):
        with pytest.raises(InputError, match="metadata that MessagePack can hold"):
            check({"a": value})


def test_foreign_metadata_are_passed_on_unchanged() -> None:
    foreign = {"org.example.tool": {"list": [1, 2.5, None, b"raw"], "map": {"a": True}}, "com.example": "text"}
    points = np.add.outer(np.arange(40.0), np.arange(50.0))
    container = encode(Surface(points, metadata={"foreign": foreign, "geotransform": [0, 1, 0, 0, 0, 1]}))
    decoder = Decoder()
    view = decoder.feed(container)[-1]
    for surface in (decoder.surface(), view.surface(2), view.window(((3, 9), (5, 7)))):
        assert surface.metadata["foreign"] == foreign
    again = decode(encode(decode(container)))
    assert again.metadata["foreign"] == foreign
    kept, dropped = fitted({"foreign": {**foreign, "large": "x" * MAX_BYTES}})
    assert kept["foreign"] == foreign
    assert [name for name, _ in dropped] == ["foreign large"]


@pytest.mark.parametrize("foreign", [5, [], "org.example", {3: "a"}])
def test_foreign_metadata_are_a_map_from_names(foreign: Any) -> None:
    with pytest.raises(InputError, match="map from names of authors"):
        encode(Surface(HEIGHTS, metadata={"foreign": foreign}))


def test_the_largest_entries_go_first_and_only_as_many_as_must() -> None:
    metadata: dict[str, Any] = {
        "name": "a",
        "crs": "W" * 30_000,
        "tags": {"": {"short": "s", "long": "t" * 50_000}, "OURS": {"note": "n" * 20_000}},
        "faces": [{"diagonal": "main", "left_out": {"shape": [1, 2], "cells": "c" * 10_000}}, {"reversed": True}],
        "scalars": {"mach": 0.5},
    }
    before = packed(metadata)
    kept, dropped = fitted(metadata)
    assert dropped == [("tags long", 50_008)]
    assert packed(metadata) == before
    assert kept["tags"] == {"": {"short": "s"}, "OURS": metadata["tags"]["OURS"]}
    assert {key: kept[key] for key in ("name", "crs", "faces", "scalars")} == {
        key: metadata[key] for key in ("name", "crs", "faces", "scalars")
    }
    check({**kept, "notes": ["some"] * 100})
    metadata["faces"][0]["left_out"]["cells"] *= 9
    kept, dropped = fitted(metadata)
    assert [name for name, _ in dropped] == ["faces 0 left_out", "tags long"]
    assert kept["faces"] == [{"diagonal": "main"}, {"reversed": True}]
    small = {"name": "a", "tags": {"": {"a": "b"}}}
    assert fitted(small) == (small, [])


def test_single_numbers_give_way_before_anything_else() -> None:
    scalars = {f"constant {number:03}": float(number) for number in range(700)}
    texts = {"crs#a": "kept", **{f"{name}#units": "m" * 70 for name in scalars}}
    metadata = {"crs": "W" * 8_000, "geotransform": [0.5] * 6, "scalars": scalars, "tags": {"": texts}}
    kept, dropped = fitted(metadata)
    assert (kept["crs"], kept["geotransform"], kept["tags"][""]["crs#a"]) == ("W" * 8_000, [0.5] * 6, "kept")
    assert all(name.startswith("tags constant") for name, _ in dropped)
    check(kept)
    kept, dropped = fitted({**metadata, "crs": "W" * 61_000})
    assert (len(kept["crs"]), kept["tags"]) == (61_000, {"": {"crs#a": "kept"}})
    kept, dropped = fitted({**metadata, "scalars": {"mach": 0.5}, "tags": {"": {"history": "h" * MAX_BYTES}}})
    assert [name for name, _ in dropped] == ["tags history"]


def test_very_many_small_entries_are_dropped_without_taking_long() -> None:
    start = time.process_time()
    kept, dropped = fitted({"tags": {"": {f"key {number}": "x" * 20 for number in range(60_000)}}, "unit": "m"})
    assert time.process_time() - start < 60
    assert len(kept["tags"][""]) + len(dropped) == 60_000
    assert 50_000 < len(packed(kept)) <= MAX_BYTES
    kept, dropped = fitted({"tags": {f"{number}": {} for number in range(50_000)}, "unit": "m"})
    assert kept["unit"] == "m"
    assert len(kept["tags"]) + len(dropped) == 50_000
    check(kept)


def test_notes_take_what_room_there_is() -> None:
    assert with_notes({"unit": "m"}, []) == {"unit": "m"}
    assert with_notes({"unit": "m"}, ["one", "two"]) == {"unit": "m", "notes": ["one", "two"]}
    full = with_notes(fitted({"a": "x" * 60_000})[0], ["n" * 1000] * 50)
    assert full["notes"][-1] == f"and {50 - len(full['notes']) + 1} more notes"
    assert len(full["notes"]) > 3
    check(full)


def files(folder: Path) -> dict[str, tuple[Path, str]]:
    """A file of each format that may have very large metadata, and the names of what must go."""
    long = "long " * 30_000
    made: dict[str, tuple[Path, str]] = {}
    numbers: dict[str, Any] = {f"{number:05}" + "n" * 200: np.array(1.0) for number in range(400)}
    np.savez(folder / "a.npz", z=HEIGHTS, **numbers)
    made["npz"] = folder / "a.npz", "scalars 00000nnn"
    try:
        import rasterio
    except ImportError:
        pass
    else:
        profile = {"driver": "GTiff", "count": 1, "height": 6, "width": 5, "dtype": "float64"}
        transform = rasterio.Affine(2.0, 0.0, 0.0, 0.0, -2.0, 0.0)
        with rasterio.open(folder / "a.tif", "w", transform=transform, **profile) as dataset:
            dataset.write(HEIGHTS[None])
            dataset.update_tags(HISTORY=long, SHORT="kept")
            dataset.update_tags(1, HISTORY=long)
        made["tif"] = folder / "a.tif", "bands tags (150,0"
    try:
        import scipy  # noqa: F401
        import xarray
    except ImportError:
        pass
    else:
        mapping = ((), 0, {"crs_wkt": f'LOCAL_CS["{long}"]'})
        said = {"grid_mapping": "crs", "units": long, "SHORT": "kept"}
        variables = {"z": (("y", "x"), HEIGHTS, said), "crs": mapping}
        xarray.Dataset(variables, attrs={"history": long}).to_netcdf(folder / "a.nc", engine="scipy")
        made["nc"] = folder / "a.nc", "crs (150,0"
    comment = f'# crs LOCAL_CS["{long}"]\n'
    (folder / "a.obj").write_text(comment + "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 4 3\n")
    made["obj"] = folder / "a.obj", "crs (150,0"
    lines = ["ply", "format ascii 1.0", f"comment unit {long}", "element vertex 4"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    (folder / "a.ply").write_text("\n".join([*lines, "0 0 0", "1 0 0", "0 1 0", "1 1 0", "4 0 1 3 2", ""]))
    made["ply"] = folder / "a.ply", "unit (150,0"
    try:
        import vtkmodules  # noqa: F401
    except ImportError:
        pass
    else:
        formats.write(Surface(HEIGHTS, metadata={"unit": "SHORT"}), folder / "a.vts")
        content = (folder / "a.vts").read_bytes()
        codes = b" ".join(str(code).encode() for code in b"SHORT\0")
        many = b" ".join(str(code).encode() for code in long.encode() + b"\0")
        assert codes in content
        (folder / "a.vts").write_bytes(content.replace(codes, many))
        made["vts"] = folder / "a.vts", "unit (150,0"
    return made


@pytest.mark.parametrize("kind", ["npz", "tif", "nc", "obj", "ply", "vts"])
def test_every_reader_drops_the_largest_and_says_so(tmp_path: Path, kind: str) -> None:
    found = files(tmp_path)
    if kind not in found:
        pytest.skip("the library for it is not installed")
    path, named = found[kind]
    with pytest.warns(FormatWarning, match="metadata are limited to 65,536 bytes; left out: ") as caught:
        surface = formats.read(path)
    assert len(caught) == 1
    note = str(caught[0].message)
    assert named in note
    assert len(note) < 1200
    check(surface.metadata)
    assert ("kept" in str(surface.metadata)) == (kind in ("tif", "nc"))
    np.testing.assert_array_equal(decode(encode(surface)).points, surface.points)


def test_axes_that_metadata_cannot_hold_are_x_and_y_of_every_point(tmp_path: Path) -> None:
    """Nearly even coordinates without a rule: each is kept bit for bit, with the heights or beside them."""
    rng = np.random.default_rng(7)
    for count, channels in ((500, 2), (9000, 3)):
        x = np.arange(count) + rng.random(count) * 1e-4
        heights = rng.integers(0, 99, (3, count)).astype(np.float64)
        np.savez(tmp_path / "a.npz", z=heights, x=x, y=np.arange(3.0))
        surface = formats.read(tmp_path / "a.npz")
        assert surface.points.ndim == channels
        across = coordinates(surface)[0] if channels == 2 else surface.points[..., 0]
        np.testing.assert_array_equal(across, np.broadcast_to(x, (3, count)))
        np.testing.assert_array_equal(decode(encode(surface)).points, surface.points)


def test_of_a_key_that_a_map_has_twice_the_last_value_counts() -> None:
    """In metadata and in extras, by the reference decoder and here, as docs/format.md says."""
    inner = b"\x82\xa1a\x01\xa1a\x02"
    twice = b"\x83\xa4unit\xa1m\xa4name" + inner + b"\xa4unit\xa2km"
    expected = {"unit": "km", "name": {"a": 2}}
    assert parse_metadata(memoryview(twice), 0) == unpack_map(twice, 0) == expected
    one, other = (msgpack.packb([[name, 8, 0]]) for name in ("first", "last"))
    extras = b"\x82" + b"".join(msgpack.packb("attributes") + value for value in (one, other))
    assert [kind.name for kind in parse_extras(memoryview(extras), 0, 4).attributes] == ["last"]
    assert unpack_map(extras, 0) == {"attributes": [["last", 8, 0]]}
